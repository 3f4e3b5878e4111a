"""Contact of surface samples with the rigid shapes of the Newton model: detection, energy, reaction.

Once per step every sample is tested against the shapes near its body; gap, normal and lever arm are frozen for the
step. An *entry* is one row of the step's point constraints: first the pins of the instance, then its contacts in sample
order. With the displacement d of the sample relative to the shape during the step, a contact adds

    E(d) = A [ kappa psi_n(g0 + n . d) ] + mu f_n psi_t(|d_t|),

psi_n the C2 penalty p^3/(6 eps) for p < eps, p^2/2 - eps p/2 + eps^2/6 beyond (p the penetration), psi_t the smoothed
Coulomb potential of Li et al. 2020 (IPC, doi:10.1145/3386569.3392425, eq. 13) with the normal force f_n of the last
Newton iterate. Shapes without closed-form distance (heightfield, convex decomposition, ellipsoid) are refused.

The queries are ours because Newton's public ``sdf_*`` functions come without their gradients, and because its soft
contact records are appended by an atomic counter: fixed slots per sample keep the order, and so the bits, reproducible.
"""

import warp as wp

from softmode.deformables.shape_queries import PLANE, query_shape

wp.set_module_options({"enable_backward": False})

LAG_ITERATIONS = wp.constant(8)
"""Newton iterations during which the normal force of friction follows the contact; then it is frozen, and what is left
is the minimisation of one potential."""

SLOTS = 2
"""Contacts kept per surface sample: the deepest two."""


@wp.kernel
def place_samples(
    # Instances:
    function_count: wp.array[int],
    row_start: wp.array[int],
    sample_count: wp.array[int],
    # Assets:
    row_point: wp.array[wp.vec3d],
    row_basis: wp.array2d[float],
    # State in:
    q_start: wp.array2d[wp.vec3d],
    q_inertial: wp.array2d[wp.vec3d],
    # Out:
    position_out: wp.array2d[wp.vec3d],  # (instance_count, sample_max) [m]
    drift_out: wp.array2d[wp.vec3],  # (instance_count, sample_max), dt v [m]
):
    """Compute where the surface samples are at the start of the step and how far they would drift during it."""
    i, s = wp.tid()
    if s >= sample_count[i]:
        return
    row = row_start[i] + s
    x = row_point[row]
    drift = wp.vec3d()
    for k in range(function_count[i]):
        b = wp.float64(row_basis[row, k])
        x += b * q_start[i, k]
        drift += b * (q_inertial[i, k] - q_start[i, k])
    position_out[i, s] = x
    drift_out[i, s] = wp.vec3(drift)


@wp.kernel
def bound_samples(
    sample_count: wp.array[int],
    position: wp.array2d[wp.vec3d],
    drift: wp.array2d[wp.vec3],
    margin: wp.array[float],
    # Out:
    lower_out: wp.array[wp.vec3],
    upper_out: wp.array[wp.vec3],
):
    """Bound the samples of an instance, grown by margin and drift."""
    i = wp.tid()
    lower = wp.vec3(1.0e30)
    upper = wp.vec3(-1.0e30)
    reach = float(0.0)
    for s in range(sample_count[i]):
        x = wp.vec3(position[i, s])
        lower = wp.min(lower, x)
        upper = wp.max(upper, x)
        reach = wp.max(reach, wp.length(drift[i, s]))
    grow = wp.vec3(margin[i] + 2.0 * reach)
    lower_out[i] = lower - grow
    upper_out[i] = upper + grow


@wp.func
def point_velocity(body_q: wp.transform, body_qd: wp.spatial_vector, com: wp.vec3, point: wp.vec3):
    """Return the velocity [m/s] of a world point that moves with a body."""
    arm = point - wp.transform_point(body_q, com)
    return wp.spatial_top(body_qd) + wp.cross(wp.spatial_bottom(body_qd), arm)


@wp.kernel
def cull_shapes(
    # Candidates:
    candidate: wp.array2d[int],  # (instance_count, candidate_max), -1 pads
    shape_type: wp.array[int],
    shape_body: wp.array[int],
    shape_transform: wp.array[wp.transform],
    shape_lower: wp.array[wp.vec3],  # bounds in the shape's frame [m]
    shape_upper: wp.array[wp.vec3],
    shape_margin: wp.array[float],
    # State in:
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    dt: float,
    # Out:
    near_out: wp.array2d[int],  # (instance_count, candidate_max)
):
    """Mark the candidate shapes whose bounding sphere reaches the bounds of the instance."""
    i, c = wp.tid()
    shape = candidate[i, c]
    near_out[i, c] = 0
    if shape < 0:
        return
    if shape_type[shape] == PLANE:
        near_out[i, c] = 1
        return
    pose = shape_transform[shape]
    radius = 0.5 * wp.length(shape_upper[shape] - shape_lower[shape])
    body = shape_body[shape]
    if body >= 0:
        pose = body_q[body] * pose
    centre = wp.transform_point(pose, 0.5 * (shape_lower[shape] + shape_upper[shape]))
    reach = radius + shape_margin[shape]
    if body >= 0:
        speed = wp.length(point_velocity(body_q[body], body_qd[body], body_com[body], centre))
        reach += 2.0 * dt * (speed + radius * wp.length(wp.spatial_bottom(body_qd[body])))
    nearest = wp.min(wp.max(centre, lower[i]), upper[i])
    if wp.length(centre - nearest) <= reach:
        near_out[i, c] = 1


@wp.kernel
def find_contacts(
    # Instances:
    sample_count: wp.array[int],
    margin: wp.array[float],  # (instance_count,) [m]
    # Candidates:
    candidate: wp.array2d[int],
    near: wp.array2d[int],
    shape_type: wp.array[int],
    shape_scale: wp.array[wp.vec3],
    shape_source: wp.array[wp.uint64],
    shape_margin: wp.array[float],
    shape_lower: wp.array[wp.vec3],
    shape_upper: wp.array[wp.vec3],
    shape_body: wp.array[int],
    shape_transform: wp.array[wp.transform],
    # State in:
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    position: wp.array2d[wp.vec3d],
    drift: wp.array2d[wp.vec3],
    dt: float,
    # Out:
    slot_shape_out: wp.array3d[int],  # (instance_count, sample_max, SLOTS), -1 where empty
    slot_gap_out: wp.array3d[wp.float64],
    slot_normal_out: wp.array3d[wp.vec3],
):
    """Keep the deepest contacts of each sample within margin plus twice the relative motion of the step."""
    i, s = wp.tid()
    if s >= sample_count[i]:
        return
    slot_shape_out[i, s, 0] = -1
    slot_shape_out[i, s, 1] = -1
    slot_gap_out[i, s, 0] = wp.float64(1.0e30)
    slot_gap_out[i, s, 1] = wp.float64(1.0e30)
    x = position[i, s]
    for c in range(candidate.shape[1]):
        if near[i, c] == 0:
            continue
        shape = candidate[i, c]
        pose = shape_transform[shape]
        body = shape_body[shape]
        motion = drift[i, s]
        if body >= 0:
            pose = body_q[body] * pose
            motion -= dt * point_velocity(body_q[body], body_qd[body], body_com[body], wp.vec3(x))
        reach = margin[i] + 2.0 * wp.length(motion)
        # the difference to the shape's origin in float64: far from the world's origin only the offset is large
        origin = wp.transform_get_translation(pose)
        local = wp.quat_rotate_inv(wp.transform_get_rotation(pose), wp.vec3(x - wp.vec3d(origin)))
        # inside a mesh the surface may be as far away as the mesh is large
        far = wp.max(reach + shape_margin[shape], wp.length(shape_upper[shape] - shape_lower[shape]))
        query = query_shape(shape_type[shape], shape_scale[shape], shape_source[shape], local, far)
        gap = wp.float64(query.distance - shape_margin[shape])
        if gap < wp.float64(reach) and gap < slot_gap_out[i, s, 1]:
            normal = wp.quat_rotate(wp.transform_get_rotation(pose), query.normal)
            slot = int(1)
            if gap < slot_gap_out[i, s, 0]:
                slot_shape_out[i, s, 1] = slot_shape_out[i, s, 0]
                slot_gap_out[i, s, 1] = slot_gap_out[i, s, 0]
                slot_normal_out[i, s, 1] = slot_normal_out[i, s, 0]
                slot = 0
            slot_shape_out[i, s, slot] = shape
            slot_gap_out[i, s, slot] = gap
            slot_normal_out[i, s, slot] = normal


@wp.kernel
def gather_entries(
    # Instances:
    world: wp.array[int],
    row_start: wp.array[int],
    sample_count: wp.array[int],
    stiffness: wp.array[float],  # (instance_count,) [Pa/m]
    friction: wp.array[float],
    pin_count: wp.array[int],
    entry_max: int,
    # Shapes:
    row_area: wp.array[float],  # (row_count,) [m^2]
    shape_body: wp.array[int],
    shape_friction: wp.array[float],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    prescribed: int,
    # State in:
    position: wp.array2d[wp.vec3d],
    slot_shape: wp.array3d[int],
    slot_gap: wp.array3d[wp.float64],
    slot_normal: wp.array3d[wp.vec3],
    dt: float,
    overflow_bit: int,
    # Out:
    entry_count_out: wp.array[int],
    entry_row_out: wp.array2d[int],
    entry_shape_out: wp.array2d[int],
    entry_arm_out: wp.array2d[wp.vec3],
    entry_normal_out: wp.array2d[wp.vec3d],
    entry_offset_out: wp.array2d[wp.vec3d],
    entry_stiffness_out: wp.array2d[wp.float64],
    entry_friction_out: wp.array2d[wp.float64],
    status: wp.array[int],
):
    """Compact the slots of an instance behind its pins, in sample order: touching contacts first, then near ones."""
    i = wp.tid()
    count = pin_count[i]
    for turn in range(2):
        for s in range(sample_count[i]):
            for slot in range(SLOTS):
                shape = slot_shape[i, s, slot]
                if shape < 0:
                    continue
                gap = slot_gap[i, s, slot]
                touching = gap <= wp.float64(0.0)
                if touching != (turn == 0):
                    continue
                if count >= entry_max:
                    wp.atomic_or(status, world[i], overflow_bit)
                    continue
                # of unit length in float64: what is left of the gap in the slip must not count against the stick range
                normal = wp.normalize(wp.vec3d(slot_normal[i, s, slot]))
                # both bodies feel the force at the sample, not the shape at its own surface: a pair of forces on two
                # points would make angular momentum out of friction times penetration
                point = wp.vec3(position[i, s])
                drift = wp.vec3()
                arm = wp.vec3()
                body = shape_body[shape]
                if body >= 0:
                    arm = point - wp.transform_point(body_q[body], body_com[body])
                    if prescribed != 0:
                        drift = dt * point_velocity(body_q[body], body_qd[body], body_com[body], point)
                entry_row_out[i, count] = row_start[i] + s
                entry_shape_out[i, count] = shape
                entry_arm_out[i, count] = arm
                entry_normal_out[i, count] = normal
                # d enters as offset + displacement, with the gap along the normal and the shape's own motion taken off
                entry_offset_out[i, count] = gap * normal - wp.vec3d(drift)
                entry_stiffness_out[i, count] = wp.float64(stiffness[i] * row_area[row_start[i] + s])
                entry_friction_out[i, count] = wp.float64(wp.sqrt(friction[i] * shape_friction[shape]))
                count += 1
    entry_count_out[i] = count


@wp.kernel
def gather_pins(
    # Instances:
    function_count: wp.array[int],
    pin_count: wp.array[int],
    pin_start: wp.array[int],
    # Pins:
    pin_row: wp.array[int],
    pin_stiffness: wp.array[float],  # [N/m]
    pin_target: wp.array[wp.vec3d],  # [m]
    row_point: wp.array[wp.vec3d],
    row_basis: wp.array2d[float],
    # State in:
    q_start: wp.array2d[wp.vec3d],
    # Out:
    entry_row_out: wp.array2d[int],
    entry_shape_out: wp.array2d[int],
    entry_offset_out: wp.array2d[wp.vec3d],
    entry_stiffness_out: wp.array2d[wp.float64],
):
    """Write the pins of an instance as its first entries: offset = x_n - target."""
    i, e = wp.tid()
    if e >= pin_count[i]:
        return
    pin = pin_start[i] + e
    row = pin_row[pin]
    x = row_point[row]
    for k in range(function_count[i]):
        x += wp.float64(row_basis[row, k]) * q_start[i, k]
    entry_row_out[i, e] = row
    entry_shape_out[i, e] = -1
    entry_offset_out[i, e] = x - pin_target[pin]
    entry_stiffness_out[i, e] = wp.float64(pin_stiffness[pin])


@wp.kernel
def entry_jacobians(
    # Instances:
    world: wp.array[int],
    entry_count: wp.array[int],
    # Rigid dofs:
    rigid_count: wp.array[int],
    dof_start: wp.array[int],  # (world_count,) first joint dof of a world
    shape_body: wp.array[int],
    body_articulation: wp.array[int],  # (body_count,), -1 for none
    body_link: wp.array[int],  # (body_count,) row block in the articulation's Jacobian
    articulation_dof_start: wp.array[int],
    articulation_dof_count: wp.array[int],
    jacobian: wp.array3d[float],  # (articulation_count, 6 link_max, dof_max), COM twists in the world frame
    # State in:
    entry_shape: wp.array2d[int],
    entry_arm: wp.array2d[wp.vec3],
    # Out:
    entry_jacobian_out: wp.array3d[wp.vec3],  # (instance_count, entry_max, rigid_max)
):
    """Compute the motion of the shape at each contact per unit joint motion: J_v - arm x J_w."""
    i, e, j = wp.tid()
    w = world[i]
    if e >= entry_count[i] or j >= rigid_count[w]:
        return
    value = wp.vec3()
    shape = entry_shape[i, e]
    body = int(-1)
    if shape >= 0:
        body = shape_body[shape]
    if body >= 0:
        a = body_articulation[body]
        if a >= 0:
            local = dof_start[w] + j - articulation_dof_start[a]
            if local >= 0 and local < articulation_dof_count[a]:
                r = 6 * body_link[body]
                linear = wp.vec3(jacobian[a, r, local], jacobian[a, r + 1, local], jacobian[a, r + 2, local])
                angular = wp.vec3(jacobian[a, r + 3, local], jacobian[a, r + 4, local], jacobian[a, r + 5, local])
                value = linear + wp.cross(angular, entry_arm[i, e])
    entry_jacobian_out[i, e, j] = value


@wp.func
def normal_potential(penetration: wp.float64, eps: wp.float64):
    """Return the C2 penalty of a penetration [m] per unit stiffness, and its first two derivatives."""
    p = wp.max(penetration, wp.float64(0.0))
    half = wp.float64(0.5)
    six = wp.float64(6.0)
    if p < eps:
        return p * p * p / (six * eps), half * p * p / eps, p / eps
    return half * p * p - half * eps * p + eps * eps / six, p - half * eps, wp.float64(1.0)


@wp.func
def friction_potential(y: wp.float64, eps: wp.float64):
    """Return f0(y), f1(y) / y and f1'(y), f1 = f0', of the smoothed Coulomb potential with stick range ``eps`` [m]."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    if y < eps:
        return (
            y * y / eps - y * y * y / (three * eps * eps) + eps / three,
            two / eps - y / (eps * eps),
            two / eps - two * y / (eps * eps),
        )
    return y, one / y, wp.float64(0.0)


@wp.kernel
def evaluate_entries(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    pin_count: wp.array[int],
    smoothing: wp.array[float],  # (instance_count,), eps of the normal potential [m]
    stick_range: wp.float64,  # eps of the friction potential for this step [m]
    # Assets:
    row_basis: wp.array2d[float],
    # State in:
    selected: wp.array[int],
    q_start: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    r: wp.array2d[wp.float64],
    rigid_count: wp.array[int],
    entry_count: wp.array[int],
    entry_row: wp.array2d[int],
    entry_normal: wp.array2d[wp.vec3d],
    entry_offset: wp.array2d[wp.vec3d],
    entry_stiffness: wp.array2d[wp.float64],
    entry_friction: wp.array2d[wp.float64],
    entry_jacobian: wp.array3d[wp.vec3],
    derivatives: int,
    iteration: wp.array[int],  # (world_count,)
    exact: wp.array[int],  # (world_count,), whether friction takes its own curvature
    # In and out:
    entry_normal_force: wp.array2d[wp.float64],  # lagged: renewed where derivatives are asked, until it is frozen
    # Out:
    energy_out: wp.array2d[wp.float64],  # (instance_count, entry_max) [J]
    force_out: wp.array2d[wp.vec3d],  # on the body [N]
    hessian_out: wp.array2d[wp.mat33],  # [N/m]
    coupling_out: wp.array3d[wp.vec3],  # H J (instance_count, entry_max, rigid_max)
):
    """Evaluate pins and contacts at displacement d = sum_k b_k (q_k - q_nk) - J r."""
    i, e = wp.tid()
    w = world[i]
    if selected[w] == 0 or e >= entry_count[i]:
        return
    row = entry_row[i, e]
    d = wp.vec3d()
    for k in range(function_count[i]):
        d += wp.float64(row_basis[row, k]) * (q[i, k] - q_start[i, k])
    for j in range(rigid_count[w]):
        d -= r[w, j] * wp.vec3d(entry_jacobian[i, e, j])
    stiffness = entry_stiffness[i, e]
    identity = wp.identity(n=3, dtype=wp.float64)
    H = stiffness * identity
    if e < pin_count[i]:
        x = entry_offset[i, e] + d
        energy_out[i, e] = wp.float64(0.5) * stiffness * wp.length_sq(x)
        force_out[i, e] = -stiffness * x
    else:
        n = entry_normal[i, e]
        total = entry_offset[i, e] + d
        psi, slope, curvature = normal_potential(-wp.dot(n, total), wp.float64(smoothing[i]))
        if derivatives != 0 and iteration[w] <= LAG_ITERATIONS:
            entry_normal_force[i, e] = stiffness * slope
        normal_force = entry_normal_force[i, e]
        # offset = gap n - drift of the shape: the tangential part is the slip of the step
        t = total - wp.dot(n, total) * n
        y = wp.length(t)
        f0, f1_over_y, f1_slope = friction_potential(y, stick_range)
        limit = entry_friction[i, e] * normal_force
        energy_out[i, e] = stiffness * psi + limit * f0
        force_out[i, e] = stiffness * slope * n - limit * f1_over_y * t
        # f0 is concave in y^2, so the quadratic of curvature f1 / y lies above it and its steps cannot overshoot, from
        # however far away; the potential's own curvature f1' along the slip converges faster once the state is close
        N = wp.outer(n, n)
        H = stiffness * curvature * N + limit * f1_over_y * (identity - N)
        if exact[w] != 0 and y > wp.float64(1.0e-9) * stick_range:
            H += limit * (f1_slope - f1_over_y) / (y * y) * wp.outer(t, t)
    if derivatives != 0:
        hessian_out[i, e] = wp.mat33(H)
        for j in range(rigid_count[w]):
            coupling_out[i, e, j] = wp.mat33(H) * entry_jacobian[i, e, j]


@wp.kernel
def sum_reactions(
    # Worlds:
    instance_start: wp.array[int],
    shape_body: wp.array[int],
    pin_count: wp.array[int],
    # State in:
    entry_count: wp.array[int],
    entry_shape: wp.array2d[int],
    entry_arm: wp.array2d[wp.vec3],
    entry_force: wp.array2d[wp.vec3d],
    # Out:
    body_wrench_out: wp.array[wp.spatial_vector],  # (body_count,) on the rigid bodies, about their COM [N, N m]
    instance_force_out: wp.array[wp.vec3d],  # (instance_count,) total contact force on the body [N]
):
    """Sum contact forces per rigid body (equal and opposite) and per instance, in entry order."""
    w = wp.tid()
    for i in range(instance_start[w], instance_start[w + 1]):
        total = wp.vec3d()
        for e in range(pin_count[i], entry_count[i]):
            f = entry_force[i, e]
            total += f
            body = shape_body[entry_shape[i, e]]
            if body >= 0:
                reaction = -wp.vec3(f)
                body_wrench_out[body] = body_wrench_out[body] + wp.spatial_vector(
                    reaction, wp.cross(entry_arm[i, e], reaction)
                )
        instance_force_out[i] = total
