"""Device side of the reduced step: state in and out, elastic energy, stress and Hessian, the gradient.

The incremental potential of a world is, over its instances,

    sum_i [ m c^2/(2 dt^2) |q - q_inertial|^2 + m alpha c/(2 dt) |q - q_rate|^2
            + sum_p V_p Psi(F_p) - f . q + contacts and pins ]
    + 1/2 (r - r_predicted)^T M_eff/dt^2 (r - r_predicted)

with r = dt * joint velocity of the rigid dofs that take part (see ``coupling``). The basis is mass-orthonormal, so the
mass matrix of a body is its mass times the identity. With velocity v = c (q - q_rate)/dt and acceleration
c (v - v_rate)/dt, q_inertial = q_rate + dt/c v_rate:

    implicit Euler  c = 1,    q_rate = q_n,                      v_rate = v_n
    BDF2            c = 3/2,  q_rate = (4 q_n - q_(n-1))/3,      v_rate = (4 v_n - v_(n-1))/3

Precision: basis data float32; q, energy and residual float64; the Newton direction float32.
"""

import warp as wp

from softmode.deformables.materials.hessian_kernels import hessian
from softmode.deformables.materials.material_kernels import (
    MaterialModel,
    MaterialParameters,
    determinant_minus_one,
    energy,
    lame,
    stress,
)
from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.deformation_kernels import elastic_gradient
from softmode.deformables.model.lane_kernels import LANES, team_sum, vec8d
from softmode.deformables.model.status import WORLD_COLLAPSED, WORLD_NOT_FINITE
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Rigid,
    blocks_of,
    has_contacts,
    in_mask,
    pushes,
)

wp.set_module_options({"enable_backward": False})

EXTRAPOLATION_INERTIA = wp.constant(wp.float64(0.01))
"""Least rho L^2 / (E dt^2) of a body whose acceleration is carried on."""
NEEDS_FEASIBLE_START = wp.constant(int(MaterialModel.NEO_HOOKEAN))
"""The material that forbids inversion: a step starts where the last one ended."""
COLLAPSED_RATIO = wp.constant(0.01)
"""Points whose volume is below this fraction of their rest volume count as collapsed, and"""
COLLAPSED_SHARE = wp.constant(0.1)
"""a body of which more than this share has collapsed is flagged."""


@wp.kernel
def sum_external(
    instances: Instances,
    basis: Basis,
    particle_f: wp.array[wp.vec3],  # (particle_count,) [N]
    chunk_count: int,
    # Out:
    chunk_out: wp.array3d[vec8d],  # (instance_count, chunk_count, 3 block_count) [N]
):
    """Sum b_k f over one chunk of the surface samples."""
    i, chunk, b = wp.tid()
    stride = basis.row.shape[1]
    x = vec8d()
    y = vec8d()
    z = vec8d()
    count = instances.sample_count[i]
    for s in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        f = wp.vec3d(particle_f[instances.particle_start[i] + s])
        value = vec8d(basis.row[instances.row_start[i] + s, b])
        x = x + f[0] * value
        y = y + f[1] * value
        z = z + f[2] * value
    chunk_out[i, chunk, b] = x
    chunk_out[i, chunk, stride + b] = y
    chunk_out[i, chunk, 2 * stride + b] = z


@wp.kernel
def begin_step(
    instances: Instances,
    basis: Basis,
    # Model and state in:
    gravity: wp.array[wp.vec3],  # (world_count,) [m/s^2]
    q_in: wp.array[wp.vec3d],  # (function_total,) [m]
    qd_in: wp.array[wp.vec3d],  # (function_total,) [m/s]
    q_before: wp.array[wp.vec3d],  # q_(n-1)
    qd_before: wp.array[wp.vec3d],  # v_(n-1)
    dt_before: wp.array[wp.float64],  # (instance_count,) [s], 0 where there was no step before
    q_driven: wp.array[wp.vec3d],  # (function_total,), where the driven functions are to be at the end of the step
    external: wp.array3d[vec8d],  # (instance_count, chunk_count, 3 block_count) [N]
    dt: wp.float64,
    bdf2: int,
    # Out:
    motion: Motion,
    q_out: wp.array2d[vec8d],
):
    """Read the state, predict where the body goes, and add gravity to the external forces."""
    i, b = wp.tid()
    n = instances.function_count[i]
    if LANES * b >= n:
        return
    stride = basis.row.shape[1]
    first = instances.function_start[i] + LANES * b
    driven = instances.driven_count[i] - LANES * b
    again = wp.abs(dt_before[i] - dt) < wp.float64(1.0e-6) * dt
    c = wp.float64(1.0)
    if again and bdf2 != 0:
        c = wp.float64(1.5)
    # Newton starts from the motion that goes on; a material that forbids inversion wants a feasible start
    ahead = wp.float64(1.0)
    if instances.material_model[i] == NEEDS_FEASIBLE_START:
        ahead = wp.float64(0.0)
    third = wp.float64(1.0) / wp.float64(3.0)
    for axis in range(3):
        q = vec8d()
        qd = vec8d()
        q_rate = vec8d()
        qd_rate = vec8d()
        change = vec8d()
        start = vec8d()
        for lane in range(LANES):
            if LANES * b + lane < n:
                q[lane] = q_in[first + lane][axis]
                qd[lane] = qd_in[first + lane][axis]
                q_rate[lane] = q[lane]
                qd_rate[lane] = qd[lane]
                if c > wp.float64(1.0):
                    q_rate[lane] += third * (q[lane] - q_before[first + lane][axis])
                    qd_rate[lane] += third * (qd[lane] - qd_before[first + lane][axis])
                start[lane] = q[lane] + ahead * dt * qd[lane]
                if again:
                    change[lane] = ahead * dt * (qd[lane] - qd_before[first + lane][axis])
                if lane < driven:
                    start[lane] = q_driven[first + lane][axis]
                    change[lane] = wp.float64(0.0)
        e = axis * stride + b
        motion.q_start[i, e] = q
        motion.qd_start[i, e] = qd
        motion.q_rate[i, e] = q_rate
        motion.q_inertial[i, e] = q_rate + dt / c * qd_rate
        motion.change[i, e] = change
        q_out[i, e] = start
    motion.rate[i] = c
    weight = instances.mass[i] * vec8d(basis.mean[instances.asset[i], b])
    g = wp.vec3d(gravity[wp.max(instances.world[i], 0)])
    fx = g[0] * weight
    fy = g[1] * weight
    fz = g[2] * weight
    for chunk in range(external.shape[1]):
        fx = fx + external[i, chunk, b]
        fy = fy + external[i, chunk, stride + b]
        fz = fz + external[i, chunk, 2 * stride + b]
    motion.force[i, b] = fx
    motion.force[i, stride + b] = fy
    motion.force[i, 2 * stride + b] = fz


@wp.kernel
def fall_back_to_euler(
    instances: Instances,
    constraints: PointConstraints,
    dt: wp.float64,
    # In and out:
    motion: Motion,
):
    """Let a body near a shape, or fixed to a rigid body, take an Euler step.

    BDF2 would carry its velocity across the jump of an impact; and the rigid body takes Euler steps, in which the same
    force changes its momentum by another amount.
    """
    i, e = wp.tid()
    if not pushes(instances, constraints, i):
        return
    motion.rate[i] = wp.float64(1.0)
    motion.q_rate[i, e] = motion.q_start[i, e]
    motion.q_inertial[i, e] = motion.q_start[i, e] + dt * motion.qd_start[i, e]


@wp.kernel
def begin_newton(
    state: NewtonState,
    instances: Instances,
    constraints: PointConstraints,
):
    """Start Newton's iteration in every world."""
    w = wp.tid()
    in_contact = int(0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        if pushes(instances, constraints, i):
            in_contact = 1
    state.in_contact[w] = in_contact
    state.active[w] = 1
    state.refresh[w] = 1
    state.project[w] = 0
    state.failures[w] = 0
    state.exact[w] = 0
    state.iteration[w] = 0
    state.any_active[0] = 1


@wp.kernel
def extrapolate(
    instances: Instances,
    motion: Motion,
    constraints: PointConstraints,
    dt: wp.float64,
    # In and out:
    q: wp.array2d[vec8d],
):
    """Let a body that touches nothing start Newton with the acceleration of the step before as well.

    Only where velocities change by less than half in a step: a jerky motion would be thrown from one valley of the
    potential into another, step by step. And not a body so stiff that a step's rotation meets little else than its
    inertia: there a start up the elastic valley costs more iterations than it saves.
    """
    i, e = wp.tid()
    if has_contacts(instances, constraints, i):
        return
    change = wp.float64(0.0)
    moved = wp.float64(0.0)
    for k in range(q.shape[1]):
        change += wp.dot(motion.change[i, k], motion.change[i, k])
        moved += wp.dot(motion.qd_start[i, k], motion.qd_start[i, k])
    inertia = wp.float64(instances.inertia[i]) / (dt * dt * wp.float64(instances.youngs_modulus[i]))
    if inertia > EXTRAPOLATION_INERTIA and change < wp.float64(0.25) * dt * dt * moved:
        q[i, e] = q[i, e] + motion.change[i, e]


@wp.func
def material_of(instances: Instances, basis: Basis, i: int, point: int):
    """Return the material of an instance at a cubature point."""
    parameters = MaterialParameters()
    mu, lam = lame(instances.youngs_modulus[i] * basis.stiffness_scale[point], instances.poissons_ratio[i])
    parameters.model = instances.material_model[i]
    parameters.mu = mu
    parameters.lam = lam
    parameters.viscosity = wp.float64(instances.viscosity[i])
    return parameters


@wp.func
def evaluate_point(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    # State in:
    selected: wp.array[int],  # (world_count,)
    q: wp.array2d[vec8d],
    dt: wp.float64,
    derivatives: int,
    state: NewtonState,
    # Out:
    points: Points,
    i: int,
    p: int,
):
    """Evaluate V_p Psi(F_p) and, where asked, its derivatives by F_p at every cubature point.

    A body of scale s has V_p s^3 and the elastic F_p / s: each derivative takes one s off.
    """
    if selected[instances.world[i]] == 0 or p >= instances.point_count[i]:
        return
    point = instances.point_start[i] + p
    parameters = material_of(instances, basis, i, point)
    s = wp.float64(instances.scale[i])
    weight = s * basis.point_weight[point]

    G = elastic_gradient(basis.gradient, q, i, point, instances.function_count[i], s)
    G_start = G
    if instances.viscosity[i] > 0.0:
        G_start = elastic_gradient(basis.gradient, motion.q_start, i, point, instances.function_count[i], s)
    points.energy[i, p] = s * s * weight * energy(parameters, G, G_start, dt)
    if derivatives != 0:
        points.stress[i, p] = s * weight * stress(parameters, G, G_start, dt)
        points.volume_ratio[i, p] = float(wp.float64(1.0) + determinant_minus_one(G))
    if derivatives != 0 and state.refresh[instances.world[i]] != 0:
        C = float(weight) * hessian(parameters, G, G_start, dt, state.project[instances.world[i]])
        for pair in range(6):
            r = 3 * pair
            points.hessian[i, pair, p] = wp.mat33(
                C[r, 0], C[r, 1], C[r, 2], C[r + 1, 0], C[r + 1, 1], C[r + 1, 2], C[r + 2, 0], C[r + 2, 1], C[r + 2, 2]
            )


evaluate_points = kernel_over(evaluate_point, "evaluate_points", "i", "p")


@wp.func
def sum_force_block(
    instances: Instances,
    basis: Basis,
    points: Points,
    constraints: PointConstraints,
    active: wp.array[int],
    chunk_count: int,
    # Out:
    chunk_out: wp.array3d[vec8d],  # (instance_count, chunk_count, 3 block_count) [N]
    i: int,
    chunk: int,
    b: int,
):
    """Sum V P grad b_k over one chunk of the points, less b_k f over one chunk of the constraints."""
    if active[instances.world[i]] == 0 or LANES * b >= instances.function_count[i]:
        return
    stride = basis.row.shape[1]
    x = vec8d()
    y = vec8d()
    z = vec8d()
    first = instances.point_start[i]
    count = instances.point_count[i]
    for p in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        P = points.stress[i, p]
        gx = vec8d(basis.gradient_across[b, first + p, 0])
        gy = vec8d(basis.gradient_across[b, first + p, 1])
        gz = vec8d(basis.gradient_across[b, first + p, 2])
        x = x + P[0, 0] * gx
        x = x + P[0, 1] * gy
        x = x + P[0, 2] * gz
        y = y + P[1, 0] * gx
        y = y + P[1, 1] * gy
        y = y + P[1, 2] * gz
        z = z + P[2, 0] * gx
        z = z + P[2, 1] * gy
        z = z + P[2, 2] * gz
    count = constraints.count[i]
    for e in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        f = constraints.force[i, e]
        value = vec8d(basis.row[constraints.row[i, e], b])
        x = x - f[0] * value
        y = y - f[1] * value
        z = z - f[2] * value
    chunk_out[i, chunk, b] = x
    chunk_out[i, chunk, stride + b] = y
    chunk_out[i, chunk, 2 * stride + b] = z


sum_forces = kernel_over(sum_force_block, "sum_forces", "i", "chunk", "b")


@wp.func
def gradient_block(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    active: wp.array[int],
    chunk: wp.array3d[vec8d],
    q: wp.array2d[vec8d],
    dt: wp.float64,
    # Out:
    gradient_out: wp.array2d[vec8d],  # [N]; zero for driven functions
    reaction_out: wp.array2d[vec8d],  # [N]; what holds the driven functions, zero for the others
    i: int,
    e: int,
):
    """Compute g = m c^2/dt^2 (q - q_inertial) + m alpha c/dt (q - q_rate) - f + sum_p V P grad b - sum_e b f_e."""
    stride = basis.row.shape[1]
    b = e % stride
    if active[instances.world[i]] == 0 or LANES * b >= instances.function_count[i]:
        return
    c = motion.rate[i]
    mass = instances.mass[i]
    damping = mass * wp.float64(instances.mass_damping[i]) * c / dt
    g = mass * c * c / (dt * dt) * (q[i, e] - motion.q_inertial[i, e])
    g = g + damping * (q[i, e] - motion.q_rate[i, e]) - motion.force[i, e]
    for k in range(chunk.shape[1]):
        g = g + chunk[i, k, e]
    reaction = vec8d()
    for lane in range(LANES):
        if LANES * b + lane < instances.driven_count[i]:
            reaction[lane] = g[lane]
            g[lane] = wp.float64(0.0)
    gradient_out[i, e] = g
    reaction_out[i, e] = reaction


sum_gradient = kernel_over(gradient_block, "sum_gradient", "i", "e")


@wp.kernel
def end_step(
    instances: Instances,
    motion: Motion,
    constraints: PointConstraints,
    # State in:
    status: wp.array[int],
    q: wp.array2d[vec8d],
    stride: int,
    dt: wp.float64,
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    q_before_out: wp.array[wp.vec3d],
    qd_before_out: wp.array[wp.vec3d],
    dt_before_out: wp.array[wp.float64],
):
    """Write the state: v = c (q - q_rate) / dt; a world that is not finite stays where it was, at rest.

    After a step near a shape there is no step before: the next one starts over with implicit Euler.
    """
    i, k = wp.tid()
    if k >= instances.function_count[i]:
        return
    b = k / LANES
    lane = k % LANES
    failed = (status[instances.world[i]] & WORLD_NOT_FINITE) != 0
    before = wp.vec3d()
    qd_before = wp.vec3d()
    now = wp.vec3d()
    qd = wp.vec3d()
    for axis in range(3):
        e = axis * stride + b
        before[axis] = motion.q_start[i, e][lane]
        qd_before[axis] = motion.qd_start[i, e][lane]
        now[axis] = q[i, e][lane]
        qd[axis] = motion.rate[i] / dt * (now[axis] - motion.q_rate[i, e][lane])
    if failed:
        now = before
        qd = wp.vec3d()
    out = instances.function_start[i] + k
    q_out[out] = now
    qd_out[out] = qd
    q_before_out[out] = before
    qd_before_out[out] = qd_before
    if k == 0:
        fresh = failed or has_contacts(instances, constraints, i)
        dt_before_out[i] = wp.where(fresh, wp.float64(0.0), dt)


@wp.kernel
def check_state(
    instances: Instances,
    points: Points,
    rigid: Rigid,
    team: int,
    stride: int,
    # State in:
    q: wp.array2d[vec8d],
    # In and out:
    state: NewtonState,
):
    """Flag a world whose unknowns are not all finite, or one of whose bodies has collapsed."""
    w, member = wp.tid()
    total = wp.float64(0.0)
    if member == 0:
        for j in range(rigid.count[w]):
            total += wp.abs(rigid.r[w, j])
    collapsed = float(0.0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        for e in range(member, 3 * stride, team):
            total += wp.dot(q[i, e], q[i, e])
        share = 1.0 / (COLLAPSED_SHARE * float(instances.point_count[i]))
        flat = float(0.0)
        for p in range(member, instances.point_count[i], team):
            if points.volume_ratio[i, p] < COLLAPSED_RATIO:
                flat += share
        collapsed = wp.max(collapsed, float(team_sum(wp.float64(flat))))
    total = team_sum(total)
    if member == 0:
        if not wp.isfinite(total):
            state.status[w] = state.status[w] | WORLD_NOT_FINITE
        if collapsed > 1.0:
            state.status[w] = state.status[w] | WORLD_COLLAPSED


@wp.kernel
def skin_samples(
    instances: Instances,
    basis: Basis,
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    # Out:
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
):
    """Write position and velocity of the surface samples as Newton particles."""
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    row = instances.row_start[i] + s
    x = basis.row_point[row]
    v = wp.vec3d()
    first = instances.function_start[i]
    n = instances.function_count[i]
    for b in range(blocks_of(n)):
        values = basis.row[row, b]
        for lane in range(wp.min(LANES, n - LANES * b)):
            value = wp.float64(values[lane])
            x += value * q[first + LANES * b + lane]
            v += value * qd[first + LANES * b + lane]
    particle_q_out[instances.particle_start[i] + s] = wp.vec3(x)
    particle_qd_out[instances.particle_start[i] + s] = wp.vec3(v)


@wp.func
def scaled_about_centre(basis: Basis, a: int, k: int, x: wp.vec3d, centre: wp.vec3d, ratio: wp.float64, rest: int):
    """Return coordinate k of centre + ratio (x - centre), of a field with coordinates x and mean ``centre``.

    ``rest`` says whether the field is a placement, which the rest position X is added to, or a velocity.
    """
    c = basis.linear[a, k]
    shift = -c[3] * centre
    if rest != 0:
        shift += wp.vec3d(c[0], c[1], c[2])
    return ratio * x + (ratio - wp.float64(1.0)) * shift


@wp.func
def mean_of_functions(basis: Basis, a: int, q: wp.array[wp.vec3d], first: int, count: int):
    """Return the mean over the mass of a field with coordinates q: of a placement, the centre of mass."""
    total = wp.vec3d()
    for k in range(count):
        total += basis.mean[a, k / LANES][k % LANES] * q[first + k]
    return total


@wp.kernel
def reset_functions(
    instances: Instances,
    basis: Basis,
    placed_scale: wp.array[float],  # (instance_count,), of the initial coordinates
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    positions: int,
    velocities: int,
    q_in: wp.array[wp.vec3d],
    qd_in: wp.array[wp.vec3d],
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    dt_before_out: wp.array[wp.float64],
):
    """Copy the initial coordinates of the bodies in masked worlds and forget the step before.

    A body that has another scale than it was placed with is scaled about its centre of mass, and its motion with it.
    """
    i, k = wp.tid()
    if k >= instances.function_count[i] or not in_mask(instance_world[i], world_mask):
        return
    first = instances.function_start[i]
    f = first + k
    a = instances.asset[i]
    ratio = wp.float64(instances.scale[i]) / wp.float64(placed_scale[i])
    other = ratio != wp.float64(1.0)
    if positions != 0:
        x = q_in[f]
        if other:
            centre = mean_of_functions(basis, a, q_in, first, instances.function_count[i])
            x = scaled_about_centre(basis, a, k, x, centre, ratio, 1)
        q_out[f] = x
    if velocities != 0:
        v = qd_in[f]
        if other:
            centre = mean_of_functions(basis, a, qd_in, first, instances.function_count[i])
            v = scaled_about_centre(basis, a, k, v, centre, ratio, 0)
        qd_out[f] = v
    dt_before_out[i] = wp.float64(0.0)


@wp.kernel
def reset_worlds(
    instances: Instances,
    instance_world: wp.array[int],
    body_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # Out:
    status_out: wp.array[int],
    instance_force_out: wp.array[wp.vec3d],
    body_wrench_out: wp.array[wp.spatial_vector],
    count_out: wp.array[int],
    pair_count_out: wp.array[int],
    cached_out: wp.array[int],
):
    """Clear what the masked worlds report: status, constraints, contact force on bodies, wrench on rigid bodies."""
    i = wp.tid()
    if i < instance_world.shape[0] and in_mask(instance_world[i], world_mask):
        status_out[instances.world[i]] = 0
        instance_force_out[i] = wp.vec3d()
        count_out[i] = 0
        pair_count_out[i] = 0
        cached_out[instances.world[i]] = 0
    if i < body_world.shape[0] and in_mask(body_world[i], world_mask):
        body_wrench_out[i] = wp.spatial_vector()
