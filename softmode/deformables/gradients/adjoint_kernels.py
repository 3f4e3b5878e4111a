"""Device side of the adjoint: the exact linearisation of one step in float64, its solution, what it gives.

Vectors have the layout of the solver's unknowns, (instance_count, 3 block_count) blocks of eight. An instance is one
linear system: contact couples a body with rigid shapes only. Every sum runs in a fixed order.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import Surface
from softmode.deformables.contact.detection_kernels import Shapes, shape_area, shape_frame
from softmode.deformables.contact.penalty_kernels import (
    ALONG,
    BULK_FACTOR,
    SHEAR_FACTOR,
    beside_ridge,
    beyond_exponent,
    contact_potential,
    dent_exponents,
    elastic_slip,
    friction_potential,
    penalty,
    shear_exponents,
    slip_potential,
    stiffness_exponents,
)
from softmode.deformables.materials.hessian_kernels import stress_derivative
from softmode.deformables.materials.material_kernels import green_strain, hooke_stress, stress
from softmode.deformables.model.declare import struct
from softmode.deformables.model.deformation_kernels import displacement_gradient, elastic_gradient
from softmode.deformables.model.lane_kernels import LANES, free_part, vec8d
from softmode.deformables.model.newton_step_kernels import NewtonArrays
from softmode.deformables.model.struct_kernels import (
    OVERLAP,
    Basis,
    Instances,
    Motion,
    PointConstraints,
    interpolate,
    interpolate_change,
)
from softmode.deformables.potential.evaluate_kernels import material_of
from softmode.deformables.potential.spin_kernels import Spin, turns

wp.set_module_options({"enable_backward": False})


@struct
class Linearised:
    """A recorded step at its root."""

    place: wp.array2d[wp.mat33d]  # (instance_count, point_max), G = F / s - I, s the scale of the body
    place_start: wp.array2d[wp.mat33d]  # the same at the start of the step
    point: wp.array2d[wp.mat33d]  # V times what is summed over the points next [N m]
    constraint_slip: wp.array2d[wp.vec3d]  # pins: x - target [m]; contacts: -d force / d friction coefficient [N]
    constraint_normal: wp.array2d[wp.vec3d]  # contacts: d force / d normal force
    constraint_gain: wp.array2d[wp.vec2d]  # contacts: d normal force / d ln of stiffness, dent compliance [N]
    constraint_hessian: wp.array2d[wp.mat33d]  # -d force / d displacement [N/m]; not symmetric where a contact slips
    constraint: wp.array2d[wp.vec3d]  # what is summed over the constraints next [N]
    memory: wp.array2d[wp.vec3d]  # what the next step feels of a contact's memory, over the stick stiffness
    memory_start: wp.array2d[wp.vec3d]  # the loss by the memory that a step begins with, shape's frame [1/m]
    contact_bar: wp.array2d[wp.vec3d]  # the loss by a contact's displacement [1/m], and
    normal_bar: wp.array2d[wp.vec4d]  # by its normal force, by ln of its dent's compliance and of its depth besides,
    # and of what the dent along the surface is beside that across
    cell_gradient: wp.array2d[wp.mat33d]  # the loss by the gradient of a cell ahead, and
    cell_place: wp.array2d[wp.vec3d]  # by the sample's place ahead [1/m]
    part_bar: wp.array2d[wp.float64]  # by ln of the part of the cell that is under a face, but for its neighbours, and
    middle_bar: wp.array2d[wp.vec3d]  # by the middle of that, at rest [1/m]
    cell_spared: wp.array2d[wp.float64]  # by the share of the neighbourhood that does not touch
    edge_gradient: wp.array2d[wp.mat33d]  # the loss by the gradient of a cell at the start, and
    edge_place: wp.array2d[wp.vec3d]  # by the sample's place there, as edges feel them [1/m]
    cell_fade: wp.array2d[wp.vec2d]  # gap at which a neighbour begins to count, and over which it comes to count [m]
    sample_place: wp.array2d[wp.vec3d]  # (instance_count, sample_max), the loss by its place at the start [1/m]


@struct
class Sums:
    """Gradients that are gathered over the steps."""

    log_modulus: wp.array2d[wp.float64]  # (instance_count, point_max), as the next two
    poissons_ratio: wp.array2d[wp.float64]
    viscosity: wp.array2d[wp.float64]
    point_scale: wp.array2d[wp.float64]  # by ln s
    friction: wp.array2d[wp.float64]  # (instance_count, constraint_max)
    contact: wp.array2d[wp.vec4d]  # likewise, by ln E, nu, ln m and ln s
    pin_stiffness: wp.array[wp.float64]  # (pin_count,)
    mass: wp.array2d[vec8d]  # (instance_count, 3 block_count), as what follows
    mass_damping: wp.array2d[vec8d]
    gravity: wp.array2d[vec8d]


@struct
class Totals:
    """Gradients by the parameters of the instances, shape (instance_count,)."""

    youngs_modulus: wp.array[wp.float64]
    poissons_ratio: wp.array[wp.float64]
    viscosity: wp.array[wp.float64]
    friction: wp.array[wp.float64]
    density: wp.array[wp.float64]
    mass_damping: wp.array[wp.float64]
    gravity: wp.array[wp.vec3d]
    scale: wp.array[wp.float64]


# -- layout ------------------------------------------------------------------------------------------------------------


@wp.func
def block_of(instances: Instances, values: wp.array2d[wp.vec3d], t: int, i: int, b: int, axis: int):
    """Return a block of a component of vectors of a state, shape (step_count, function_total)."""
    block = vec8d()
    for lane in range(LANES):
        k = LANES * b + lane
        if k < instances.function_count[i]:
            block[lane] = values[t, instances.function_start[i] + k][axis]
    return block


@wp.kernel
def pack(
    instances: Instances,
    values: wp.array2d[wp.vec3d],  # (step_count, function_total), as in a state
    # Out:
    out: wp.array3d[vec8d],  # (step_count, instance_count, 3 block_count)
):
    """Put vectors of a state into blocks."""
    t, i, b = wp.tid()
    for axis in range(3):
        out[t, i, axis * (out.shape[2] / 3) + b] = block_of(instances, values, t, i, b, axis)


@wp.kernel
def unpack(
    instances: Instances,
    values: wp.array3d[vec8d],
    # Out:
    out: wp.array2d[wp.vec3d],
):
    """Put blocks into the layout of a state."""
    t, i, k = wp.tid()
    if k >= instances.function_count[i]:
        return
    stride = values.shape[2] / 3
    b = k / LANES
    lane = k % LANES
    out[t, instances.function_start[i] + k] = wp.vec3d(
        values[t, i, b][lane], values[t, i, stride + b][lane], values[t, i, 2 * stride + b][lane]
    )


@wp.kernel
def add_force(
    instances: Instances,
    force: wp.array2d[wp.vec3d],  # (1, function_total) [N]
    # In and out:
    motion: Motion,
):
    """Add a generalised force to that of a step."""
    i, b = wp.tid()
    for axis in range(3):
        e = axis * (motion.force.shape[1] / 3) + b
        motion.force[i, e] = motion.force[i, e] + block_of(instances, force, 0, i, b, axis)


# -- the linearisation at a recorded step ------------------------------------------------------------------------------


@wp.kernel
def place_points(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    q: wp.array2d[vec8d],
    # Out:
    step: Linearised,
):
    """Evaluate the elastic displacement gradient at both ends of the step."""
    i, p = wp.tid()
    if p >= instances.point_count[i]:
        return
    point = instances.point_start[i] + p
    n = instances.function_count[i]
    s = wp.float64(instances.scale[i])
    step.place[i, p] = elastic_gradient(basis.gradient, q, i, point, n, s)
    step.place_start[i, p] = elastic_gradient(basis.gradient, motion.q_start, i, point, n, s)


@wp.kernel
def place_constraints(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    constraints: PointConstraints,
    stick_range: wp.float64,
    q: wp.array2d[vec8d],
    # Out:
    step: Linearised,
):
    """Linearise pins and contacts, the normal force of friction included, at fixed normals.

    With x = offset + d, p = -n . x and t the tangential part of x, a contact's force is
    f = k psi_n'(p) n - secant(|t|, c k psi_n'(p)) t, see ``penalty_kernels``. psi_n' depends on the ratio r of the
    dent's compliance to the penalty's by r dpsi_n'/dr = -r g / (1 + r)^2, g the slope of the penalty.
    """
    i, e = wp.tid()
    if e >= constraints.count[i]:
        return
    d = interpolate_change(basis.row, constraints.row[i, e], q, motion.q_start, i, instances.function_count[i])
    x = constraints.offset[i, e] + d
    k = constraints.stiffness[i, e]
    identity = wp.identity(n=3, dtype=wp.float64)
    if e < instances.pin_count[i]:
        step.constraint_slip[i, e] = x
        step.constraint_hessian[i, e] = k * identity
        return
    n = constraints.normal[i, e]
    p = -wp.dot(n, x)
    ratio = k * constraints.dent_compliance[i, e]
    _psi, slope, curvature = contact_potential(constraints, p, i, e)
    _share, after = beside_ridge(ratio, constraints.ridge[i, e], constraints.ridge_lead[i, e])
    _penalty, plain_slope, plain_curvature = penalty(p - after, constraints.onset[i, e])
    t = x + p * n
    y = wp.length(t)
    c = constraints.friction[i, e]
    stick = constraints.stick[i, e]
    limit = c * k * slope
    deep = constraints.stick_deep[i, e]
    _energy, secant, tangent = slip_potential(y, limit, stick, deep, constraints.dent_depth[i, e], stick_range)
    _f0, by_limit, _f1_slope = friction_potential(y, stick_range)
    if stick > wp.float64(0.0):
        by_limit = wp.float64(0.0)
        if tangent == wp.float64(0.0) and y > wp.float64(0.0):
            by_limit = wp.float64(1.0) / y
    N = wp.outer(n, n)
    slip = secant * (identity - N)
    if y > wp.float64(1.0e-9) * stick_range:
        slip += (tangent - secant) / (y * y) * wp.outer(t, t)
    step.constraint_slip[i, e] = k * slope * by_limit * t
    step.constraint_normal[i, e] = n - c * by_limit * t
    by_ratio = -ratio / ((wp.float64(1.0) + ratio) * (wp.float64(1.0) + ratio))
    by_ratio *= plain_slope + after * plain_curvature
    step.constraint_gain[i, e] = k * wp.vec2d(slope + by_ratio, by_ratio)
    step.constraint_hessian[i, e] = k * curvature * N + slip - c * k * curvature * by_limit * wp.outer(t, n)


@wp.func
def soft_force(constraints: PointConstraints, i: int, e: int):
    """Return the force [N] from which on the dent along the surface is used up."""
    return constraints.stick[i, e] * ALONG * constraints.dent_depth[i, e]


@wp.kernel
def pull_memory(
    instances: Instances,
    shapes: Shapes,
    constraints: PointConstraints,
    next_count: wp.array[int],  # (instance_count,), point constraints of the next step, and which they are
    next_sample: wp.array2d[int],
    next_shape: wp.array2d[int],
    # In: memory_start of the next step. Out: memory of this one; constraint, what it pulls at the end of the step
    step: Linearised,
):
    """Take over what the next step feels of where the contacts stick.

    A contact ends the step with the elastic slip -y(|P f|) P f / |P f|, P f the tangential force and y
    ``elastic_slip``, whether it sticks or slides.
    """
    i, e = wp.tid()
    if e >= constraints.count[i]:
        return
    memory = wp.vec3d()
    if e >= instances.pin_count[i] and constraints.stick[i, e] > wp.float64(0.0):
        shape = constraints.shape[i, e]
        _origin, rotation = shape_frame(shapes, shape)
        n = constraints.normal[i, e]
        for k in range(instances.pin_count[i], next_count[i]):
            if next_sample[i, k] == constraints.partner_row[i, e] and next_shape[i, k] == shape:
                g = wp.quat_rotate(rotation, step.memory_start[i, k])
                memory = (g - wp.dot(n, g) * n) / constraints.stick[i, e]
                force = constraints.force[i, e] - wp.dot(n, constraints.force[i, e]) * n
                f = wp.length(force)
                if f > soft_force(constraints, i, e):
                    deep = constraints.stick_deep[i, e]
                    slip = elastic_slip(f, constraints.stick[i, e], deep, constraints.dent_depth[i, e])
                    memory *= constraints.stick[i, e] * slip / f
                    memory += (wp.float64(1.0) / deep - slip / f) * wp.dot(g, force) / (f * f) * force
    step.memory[i, e] = memory
    step.constraint[i, e] = wp.transpose(step.constraint_hessian[i, e]) * memory


@wp.kernel
def add_memory(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    step: Linearised,
    # In and out:
    q_bar: wp.array2d[vec8d],
):
    """Add what the memory pulls at the contacts to dL/dq_t."""
    i, e = wp.tid()
    stride = basis.row.shape[1]
    b = e % stride
    axis = e / stride
    total = q_bar[i, e]
    for k in range(instances.pin_count[i], constraints.count[i]):
        total = total + step.constraint[i, k][axis] * vec8d(basis.row[constraints.row[i, k], b])
    q_bar[i, e] = total


@wp.kernel
def measure_residual(
    instances: Instances,
    motion: Motion,
    constraints: PointConstraints,
    resolution: wp.array[wp.float64],  # (instance_count,), motion [m] whose inertia is no force worth naming
    arrays: NewtonArrays,  # chunks of the gradient: forces of points less constraints
    dt: wp.float64,
    # Out:
    ratio_out: wp.array[wp.float64],  # (instance_count,)
    overlap_out: wp.array[wp.float64],  # (instance_count,), deepest contact at the start of the step over its bound
):
    """Compute |r| / |f|: the residual of a step against the largest of the forces that it balances."""
    i = wp.tid()
    rate = motion.rate[i] / dt
    weight = instances.mass[i] * rate * rate
    total = wp.float64(0.0)
    inertial = wp.float64(0.0)
    elastic = wp.float64(0.0)
    external = wp.float64(0.0)
    internal = arrays.gradient_chunk
    for e in range(arrays.q.shape[1]):
        r = arrays.gradient[i, e]
        total += wp.dot(r, r)
        inertia = weight * (arrays.q[i, e] - motion.q_inertial[i, e])
        inertial += wp.dot(inertia, inertia)
        force = motion.force[i, e]
        external += wp.dot(force, force)
        stress = vec8d()
        for chunk in range(internal.shape[1]):
            stress = stress + internal[i, chunk, e]
        elastic += wp.dot(stress, stress)
    scale = wp.sqrt(wp.max(inertial, wp.max(elastic, external)))
    deepest = wp.float64(0.0)
    for e in range(constraints.count[i]):
        scale += wp.length(constraints.force[i, e])
        if e >= instances.pin_count[i]:
            deepest = wp.max(deepest, -wp.dot(constraints.normal[i, e], constraints.offset[i, e]))
    overlap_out[i] = deepest / wp.float64(OVERLAP * instances.size[i])
    ratio_out[i] = wp.sqrt(total) / (scale + weight * resolution[i])


# -- products with H^T -------------------------------------------------------------------------------------------------


@wp.kernel
def apply_points(
    instances: Instances,
    basis: Basis,
    active: wp.array[int],  # (world_count,)
    direction: wp.array2d[vec8d],
    dt: wp.float64,
    # Out:
    step: Linearised,
):
    """Apply the elastic Hessian at the cubature points."""
    i, p = wp.tid()
    if active[instances.world[i]] == 0 or p >= instances.point_count[i]:
        return
    point = instances.point_start[i] + p
    dF = displacement_gradient(basis.gradient, direction, i, point, instances.function_count[i])
    material = material_of(instances, basis, i, point)
    # V s^3 of the energy, less one s for each of the two derivatives by F = s (I + place)
    step.point[i, p] = (
        wp.float64(instances.scale[i])
        * basis.point_weight[point]
        * stress_derivative(material, step.place[i, p], step.place_start[i, p], dt, dF)
    )


@wp.kernel
def apply_constraints(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    active: wp.array[int],
    direction: wp.array2d[vec8d],
    # Out:
    step: Linearised,
):
    """Evaluate the force of pins and contacts: less their transposed Hessian times the direction."""
    i, e = wp.tid()
    if active[instances.world[i]] == 0 or e >= constraints.count[i]:
        return
    d = interpolate(basis.row, constraints.row[i, e], direction, i, instances.function_count[i])
    step.constraint[i, e] = -(wp.transpose(step.constraint_hessian[i, e]) * d)


@wp.kernel
def sum_product(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    active: wp.array[int],
    arrays: NewtonArrays,  # chunks: sums of V dP grad b over the points less b f over the constraints
    direction: wp.array2d[vec8d],
    dt: wp.float64,
    # Out:
    out: wp.array2d[vec8d],  # zero for driven functions
    driven_out: wp.array2d[vec8d],  # zero for the others
):
    """Compute H^T d = m c/dt (c/dt + alpha) d + sum_p V dP grad b + sum_e b H_e^T d_e."""
    i, e = wp.tid()
    if active[instances.world[i]] == 0:
        return
    stride = basis.row.shape[1]
    b = e % stride
    rate = motion.rate[i] / dt
    total = instances.mass[i] * rate * (rate + wp.float64(instances.mass_damping[i])) * direction[i, e]
    if LANES * b < instances.function_count[i]:
        for k in range(arrays.gradient_chunk.shape[1]):
            total = total + arrays.gradient_chunk[i, k, e]
    free = free_part(total, instances.driven_count[i] - LANES * b)
    out[i, e] = free
    driven_out[i, e] = total - free


# -- what lambda gives -------------------------------------------------------------------------------------------------


@wp.kernel
def add_velocity(
    motion: Motion,
    qd_bar: wp.array2d[vec8d],
    dt: wp.float64,
    # In and out:
    q_bar: wp.array2d[vec8d],
):
    """Pass dL/dv_t to q_t: v = c (q - q_rate) / dt."""
    i, e = wp.tid()
    q_bar[i, e] = q_bar[i, e] + motion.rate[i] / dt * qd_bar[i, e]


@wp.kernel
def accumulate_points(
    instances: Instances,
    basis: Basis,
    costate: wp.array2d[vec8d],  # lambda
    dt: wp.float64,
    # In and out:
    sums: Sums,
    # Out:
    step: Linearised,  # point: V dP_start^T[Lambda], what the start of the step feels through dissipation
):
    """Add -V Lambda : dP/d(ln E, nu, tau, ln s); the stress is linear in mu, in lambda and in tau."""
    i, p = wp.tid()
    if p >= instances.point_count[i]:
        return
    point = instances.point_start[i] + p
    s = wp.float64(instances.scale[i])
    V = s * s * basis.point_weight[point]  # of the stress by F = s (I + place)
    G = step.place[i, p]
    G_start = step.place_start[i, p]
    material = material_of(instances, basis, i, point)
    L = displacement_gradient(basis.gradient, costate, i, point, instances.function_count[i])
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    mu = material.mu
    lam = material.lam
    nu = wp.float64(instances.poissons_ratio[i])
    sums.log_modulus[i, p] = sums.log_modulus[i, p] - V * wp.ddot(L, stress(material, G, G_start, dt))

    # d ln(mu)/d nu = -1 / (1 + nu); dlambda/dnu = E (1 + 2 nu^2) / ((1 + nu) (1 - 2 nu))^2, times what lambda is there
    modulus = wp.float64(basis.lame_ratio[point]) * two * mu * (one + nu)
    root = (one + nu) * (one - two * nu)
    material.lam = zero
    by_mu = stress(material, G, G_start, dt) / mu
    material.mu = zero
    material.lam = one
    by_lam = stress(material, G, G_start, dt)
    slope = modulus * (one + two * nu * nu) / (root * root) * by_lam - mu / (one + nu) * by_mu
    sums.poissons_ratio[i, p] = sums.poissons_ratio[i, p] - V * wp.ddot(L, slope)

    # viscous stress: tau / dt F C (E - E_start) with Hooke's tensor C
    material.mu = mu
    material.lam = lam
    F = wp.identity(n=3, dtype=wp.float64) + G
    by_tau = one / dt * (F * hooke_stress(material, green_strain(G) - green_strain(G_start)))
    sums.viscosity[i, p] = sums.viscosity[i, p] - V * wp.ddot(L, by_tau)
    F_start = wp.identity(n=3, dtype=wp.float64) + G_start

    # the elastic F and F_start go with 1 / s, V with s^2
    by_size = two * stress(material, G, G_start, dt) - stress_derivative(material, G, G_start, dt, F)
    by_size += material.viscosity / dt * (F * hooke_stress(material, wp.transpose(F_start) * F_start))
    sums.point_scale[i, p] = sums.point_scale[i, p] - V * wp.ddot(L, by_size)
    strain = wp.float64(0.5) / s * (wp.transpose(F) * L + wp.transpose(L) * F)
    step.point[i, p] = -V * material.viscosity / dt * (F_start * hooke_stress(material, strain))


@wp.func
def turned_back(shapes: Shapes, shape: int, back: wp.vec3d, dt: float):
    """Return (R - I)^T back of a shape that turns by R within the step: its drift grows so with the place."""
    body = shapes.body[shape]
    if body < 0:
        return wp.vec3d()
    spin = wp.float64(dt) * wp.vec3d(wp.spatial_bottom(shapes.body_qd[body]))
    return wp.quat_rotate_inv(wp.quat_from_axis_angle(wp.normalize(spin), wp.length(spin)), back) - back


@wp.kernel
def accumulate_constraints(
    instances: Instances,
    basis: Basis,
    shapes: Shapes,
    constraints: PointConstraints,
    surface: Surface,
    costate: wp.array2d[vec8d],
    dt: float,
    # In and out:
    sums: Sums,
    # Out:
    pin_target_out: wp.array[wp.vec3d],  # (pin_count,), of this step
    step: Linearised,  # constraint: what the start of the step feels through slip; memory_start
):
    """Add the gradients of pins, of friction, of the contacts' stiffness, and of where a contact started."""
    i, e = wp.tid()
    if e >= constraints.count[i]:
        return
    row = constraints.row[i, e]
    L = interpolate(basis.row, row, costate, i, instances.function_count[i])
    step.constraint[i, e] = wp.vec3d()
    if e < instances.pin_count[i]:
        pin = instances.pin_start[i] + e
        pin_target_out[pin] = constraints.stiffness[i, e] * L
        sums.pin_stiffness[pin] = sums.pin_stiffness[pin] - wp.dot(L, step.constraint_slip[i, e])
        return
    # by ln E, nu, ln m and ln s: of the penalty, of k_t, and of the dent
    shape = constraints.shape[i, e]
    none = wp.float64(0.0)
    sample = constraints.partner_row[i, e]
    relative = surface.relative_stiffness[sample]
    partner_area = shape_area(shapes, shape)
    firm = relative * surface.slenderness[sample]
    stiffness_powers = stiffness_exponents(instances, i, BULK_FACTOR, firm, partner_area, dt)
    steep = beyond_exponent(constraints.stiffness[i, e] * constraints.dent_compliance[i, e])
    dent_powers = steep * dent_exponents(instances, i) + (steep - wp.float64(1.0)) * stiffness_powers
    by = step.constraint_gain[i, e]
    normal_gain = by[0] * stiffness_powers + by[1] * dent_powers
    # k_t is that of the spring of friction and of the dent along the surface in series
    stick = constraints.stick[i, e]
    deep = constraints.stick_deep[i, e]
    yields = wp.where(stick > none, wp.float64(1.0) - stick / deep, none)
    deep_powers = stiffness_exponents(instances, i, SHEAR_FACTOR, relative, partner_area, dt)
    shear_powers = deep_powers - yields * (deep_powers + dent_powers + shear_exponents(instances, i))
    # what a contact remembers is its elastic slip under the tangential force; that of one that sticks is by its slip
    force = constraints.force[i, e]
    along = force - wp.dot(constraints.normal[i, e], force) * constraints.normal[i, e]
    limit = constraints.friction[i, e] * wp.length(force - along)
    depth = constraints.dent_depth[i, e]
    felt = step.memory[i, e]
    L -= step.memory[i, e]
    if stick > none and wp.length(constraints.slip[i, e]) <= elastic_slip(limit, stick, deep, depth):
        felt = felt + L
    by_normal = wp.dot(L, step.constraint_normal[i, e])
    by_shear = wp.dot(felt, along)
    by_deep = none
    by_depth = none
    soft = soft_force(constraints, i, e)
    if stick > none and wp.length(along) > soft:
        share = soft / wp.length(along)
        by_deep = (wp.float64(1.0) - share) * by_shear
        by_shear *= share
        by_depth = (wp.float64(1.0) - deep / stick) * by_shear
    sums.contact[i, e] = sums.contact[i, e] + by_normal * normal_gain + by_shear * shear_powers + by_deep * deep_powers
    step.normal_bar[i, e] = wp.vec4d(by_normal, by_normal * by[1] - by_shear * yields, by_depth, -by_shear * yields)
    # of x = gap n + slip - drift + d, the gap grows along n as the sample's place at the start does, d falls by as much
    # as that, and the drift of a shape that turns by R within the step grows by R - I of it
    n = constraints.normal[i, e]
    back = wp.transpose(step.constraint_hessian[i, e]) * L
    step.contact_bar[i, e] = back
    across = back - wp.dot(n, back) * n
    _origin, rotation = shape_frame(shapes, shape)
    step.memory_start[i, e] = -wp.quat_rotate_inv(rotation, across)
    across += turned_back(shapes, shape, back, dt)
    step.constraint[i, e] = across
    # c = sqrt(friction of body * friction of shape)
    if instances.friction[i] > 0.0:
        share = wp.float64(0.5) * constraints.friction[i, e] / wp.float64(instances.friction[i])
        sums.friction[i, e] = sums.friction[i, e] - share * wp.dot(L, step.constraint_slip[i, e])


@wp.kernel
def propagate(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    arrays: NewtonArrays,  # chunks: sums over points and constraints of what the start of the step feels
    gravity: wp.array[wp.vec3],
    costate: wp.array2d[vec8d],
    driven: wp.array2d[vec8d],  # H^T lambda at the driven functions
    spin: Spin,
    dt: wp.float64,
    t: int,
    # In and out, (T + 2, ...): row t + 2 is dL/dq_t, which becomes dL/d(q_driven); before it those of the steps before
    q_bar: wp.array3d[vec8d],
    qd_bar: wp.array3d[vec8d],
    sums: Sums,
):
    """Subtract lambda^T dr/d(q_(t-1), v_(t-1), q_(t-2), v_(t-2), m, alpha, g).

    Of a target that turns, ``spin_adjoint_kernels`` has the part by the start of the step.
    """
    i, e = wp.tid()
    stride = basis.row.shape[1]
    b = e % stride
    axis = e / stride
    m = instances.mass[i]
    rate = motion.rate[i] / dt
    alpha = wp.float64(instances.mass_damping[i])
    L = costate[i, e]
    start = vec8d()
    if LANES * b < instances.function_count[i]:
        for k in range(arrays.gradient_chunk.shape[1]):
            start = start - arrays.gradient_chunk[i, k, e]
    q_rate = m * rate * (rate + alpha) * L - rate * qd_bar[t + 2, i, e]
    qd_rate = m * rate * L
    if turns(spin, motion, i):
        q_rate = m * rate * alpha * L
        qd_rate = vec8d()
    third = wp.float64(0.0)
    if motion.rate[i] > wp.float64(1.0):
        third = wp.float64(1.0) / wp.float64(3.0)
    q_bar[t + 1, i, e] = q_bar[t + 1, i, e] + start + (wp.float64(1.0) + third) * q_rate
    qd_bar[t + 1, i, e] = qd_bar[t + 1, i, e] + (wp.float64(1.0) + third) * qd_rate
    if third > wp.float64(0.0):
        q_bar[t, i, e] = q_bar[t, i, e] - third * q_rate
        qd_bar[t, i, e] = qd_bar[t, i, e] - third * qd_rate
    here = q_bar[t + 2, i, e]
    q_bar[t + 2, i, e] = here - free_part(here, instances.driven_count[i] - LANES * b) - driven[i, e]

    q = arrays.q
    travel = rate * (q[i, e] - motion.q_rate[i, e])
    mean = basis.mean[instances.asset[i], b]
    g = wp.float64(gravity[wp.max(instances.world[i], 0)][axis])
    per_mass = rate * rate * (q[i, e] - motion.q_inertial[i, e]) + alpha * travel - g * mean
    sums.mass[i, e] = sums.mass[i, e] - wp.cw_mul(L, per_mass)
    sums.mass_damping[i, e] = sums.mass_damping[i, e] - m * wp.cw_mul(L, travel)
    sums.gravity[i, e] = sums.gravity[i, e] + m * wp.cw_mul(mean, L)


@wp.kernel
def sum_gradients(
    instances: Instances,
    density: wp.array[float],
    sums: Sums,
    # Out:
    totals: Totals,
):
    """Sum over points, constraints and functions, in order."""
    i = wp.tid()
    modulus = wp.float64(0.0)
    nu = wp.float64(0.0)
    tau = wp.float64(0.0)
    size = wp.float64(0.0)
    for p in range(instances.point_count[i]):
        modulus += sums.log_modulus[i, p]
        nu += sums.poissons_ratio[i, p]
        tau += sums.viscosity[i, p]
        size += sums.point_scale[i, p]
    c = wp.float64(0.0)
    contact = wp.vec4d()
    for e in range(sums.friction.shape[1]):
        c += sums.friction[i, e]
        contact += sums.contact[i, e]
    mass = contact[2]
    alpha = wp.float64(0.0)
    g = wp.vec3d()
    stride = sums.mass.shape[1] / 3
    for e in range(3 * stride):
        for lane in range(LANES):
            mass += instances.mass[i] * sums.mass[i, e][lane]
            alpha += sums.mass_damping[i, e][lane]
            g[e / stride] += sums.gravity[i, e][lane]
    totals.youngs_modulus[i] = (modulus + contact[0]) / wp.float64(instances.youngs_modulus[i])
    totals.poissons_ratio[i] = nu + contact[1]
    totals.viscosity[i] = tau
    totals.friction[i] = c
    totals.density[i] = mass / wp.float64(density[i])
    totals.mass_damping[i] = alpha
    totals.gravity[i] = g
    totals.scale[i] = (size + contact[3] + wp.float64(3.0) * mass) / wp.float64(instances.scale[i])
