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

In a step of implicit Euler q_inertial and the velocity at the end turn with the body, see ``spin_kernels``.

Precision: basis data float32; q, energy and residual float64; the Newton direction float32.
"""

import warp as wp

from softmode.deformables.materials.material_kernels import (
    MaterialModel,
    needs_volume,
)
from softmode.deformables.model.deformation_kernels import elastic_gradient
from softmode.deformables.model.lane_kernels import (
    LANES,
    team_sum,
    vec8d,
)
from softmode.deformables.model.newton_step_kernels import NewtonStep, add_outer_3d, mat38d
from softmode.deformables.model.status import (
    PARAMETER_BITS,
    WORLD_COLLAPSED,
    WORLD_NOT_FINITE,
    WORLD_PARAMETER_RANGE,
)
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    blocks_of,
    exists,
    has_contacts,
    p_wave_modulus,
    pushes,
)
from softmode.deformables.potential.spin_kernels import (
    Spin,
    rest_block,
    target_block,
    turned_block,
    turns,
    unknown_block,
    velocity_block,
)

wp.set_module_options({"enable_backward": False})

EXTRAPOLATION_INERTIA = wp.constant(wp.float64(0.01))
"""Least rho L^2 / (E dt^2) of a body whose acceleration is carried on."""
ENERGY_ROUNDING = wp.constant(wp.float64(2.0e-17))
"""What rounding leaves of the elastic energy of a body that has turned, over E V: a tenth of float64's unit, since the
errors of its points differ in sign."""
PIVOT_ROUNDING = wp.constant(1.0e-4)
"""What rounding may take of a pivot of the Hessian, over the stiffness P V / L^2 of a body: its rotations have no more
than their inertia left when all else is eliminated."""
COLLAPSED_RATIO = wp.constant(0.01)
"""Points whose volume is below this fraction of their rest volume count as collapsed, and"""
COLLAPSED_SHARE = wp.constant(0.1)
"""a body of which more than this share has collapsed is flagged."""


@wp.kernel
def sum_external(
    step: NewtonStep,
    particle_f: wp.array[wp.vec3],  # (particle_count,) [N]
):
    """Sum b_k f over one chunk of the surface samples."""
    i, chunk, b = wp.tid()
    stride = step.basis.row.shape[1]
    chunk_count = step.arrays.gradient_chunk.shape[1]
    total = mat38d()
    count = step.instances.sample_count[i]
    for s in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        f = wp.vec3d(particle_f[step.instances.particle_start[i] + s])
        total = add_outer_3d(total, f, vec8d(step.basis.row[step.instances.row_start[i] + s, b]))
    for axis in range(3):
        step.arrays.gradient_chunk[i, chunk, axis * stride + b] = total[axis]


@wp.func
def range_bit(value: float, sound: bool, bit: int):
    """Return the status bits of a parameter that is not finite or, as ``sound`` says, outside its range."""
    if sound and wp.isfinite(value):
        return 0
    return bit | WORLD_PARAMETER_RANGE


@wp.func
def parameter_bits(instances: Instances, density: float, scale: float, i: int):
    """Return the status bits of the parameters of an instance that are not finite or not in the range of ``Material``.

    Density and scale are given as written: mass and sizes follow them from ``notify_model_changed`` on.
    """
    E = instances.youngs_modulus[i]
    nu = instances.poissons_ratio[i]
    model = instances.material_model[i]
    tau = instances.viscosity[i]
    alpha = instances.mass_damping[i]
    mu = instances.friction[i]
    kappa = instances.contact_stiffness[i]
    radius = instances.contact_radius[i]
    bits = range_bit(E, E > 0.0, wp.static(PARAMETER_BITS["youngs_modulus"]))
    bits |= range_bit(nu, nu > -1.0 and nu < 0.5, wp.static(PARAMETER_BITS["poissons_ratio"]))
    bits |= range_bit(density, density > 0.0, wp.static(PARAMETER_BITS["density"]))
    bits |= range_bit(scale, scale > 0.0, wp.static(PARAMETER_BITS["scale"]))
    bits |= range_bit(tau, tau >= 0.0, wp.static(PARAMETER_BITS["viscosity"]))
    bits |= range_bit(alpha, alpha >= 0.0, wp.static(PARAMETER_BITS["mass_damping"]))
    bits |= range_bit(mu, mu >= 0.0, wp.static(PARAMETER_BITS["friction"]))
    bits |= range_bit(kappa, kappa >= 0.0, wp.static(PARAMETER_BITS["contact_stiffness"]))
    bits |= range_bit(radius, radius >= 0.0, wp.static(PARAMETER_BITS["contact_radius"]))
    known = model >= 0 and model < wp.static(len(MaterialModel))
    bits |= range_bit(0.0, known, wp.static(PARAMETER_BITS["material_model"]))
    return bits


@wp.kernel
def begin_step(
    step: NewtonStep,
    # Model and state in:
    gravity: wp.array[wp.vec3],  # (world_count,) [m/s^2]
    q_in: wp.array[wp.vec3d],  # (function_total,) [m]
    qd_in: wp.array[wp.vec3d],  # (function_total,) [m/s]
    q_before: wp.array[wp.vec3d],  # q_(n-1)
    qd_before: wp.array[wp.vec3d],  # v_(n-1)
    dt_before: wp.array[wp.float64],  # (instance_count,) [s], 0 where there was no step before
    q_driven: wp.array[wp.vec3d],  # (function_total,), where the driven functions are to be at the end of the step
    density: wp.array[float],  # (instance_count,) [kg/m^3], as the model has them, which may not be in use yet
    scale: wp.array[float],
    spin: Spin,
    bdf2: int,
):
    """Read the state, predict where the body goes, and add gravity to the external forces; flag bad parameters."""
    dt = step.options.dt
    i, b = wp.tid()
    g = gravity[wp.max(step.instances.world[i], 0)]
    bits = int(0)
    if b == 0:
        bits = parameter_bits(step.instances, density[i], scale[i], i)
        bits |= range_bit(0.0, wp.isfinite(g), wp.static(PARAMETER_BITS["gravity"]))
    n = step.instances.function_count[i]
    if LANES * b >= n:
        return
    stride = step.basis.row.shape[1]
    first = step.instances.function_start[i] + LANES * b
    driven = step.instances.driven_count[i] - LANES * b
    again = wp.abs(dt_before[i] - dt) < wp.float64(1.0e-6) * dt
    c = wp.float64(1.0)
    if again and bdf2 != 0:
        c = wp.float64(1.5)
    # Newton starts from the motion that goes on; a material that forbids inversion wants a feasible start
    ahead = wp.float64(1.0)
    if needs_volume(step.instances.material_model[i]):
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
                    bits |= range_bit(0.0, wp.isfinite(start[lane]), wp.static(PARAMETER_BITS["q_driven"]))
                    change[lane] = wp.float64(0.0)
        e = axis * stride + b
        step.motion.q_start[i, e] = q
        step.motion.qd_start[i, e] = qd
        step.motion.q_rate[i, e] = q_rate
        step.motion.q_inertial[i, e] = q_rate + dt / c * qd_rate
        step.motion.change[i, e] = change
        step.arrays.q[i, e] = start
    step.motion.rate[i] = c
    if c == wp.float64(1.0) and spin.turns[i] != 0:
        rest, one = rest_block(step.basis, step.instances.asset[i], b)
        turned, r = turned_block(spin, i, unknown_block(step.motion.q_start, i, b), rest, one)
        target = target_block(spin, i, turned, r, unknown_block(step.motion.qd_start, i, b), one, dt)
        # the acceleration that is carried on balances the centrifugal one
        outward = ahead * (spin.centrifugal[i] * r)
        begin = turned + ahead * (target - turned) - outward
        onward = mat38d()
        if again:
            gain = wp.outer(ahead * dt * spin.gain[i], one)
            onward = gain + spin.onward[i] * (unknown_block(step.motion.change, i, b) - gain) + outward
        for axis in range(3):
            e = axis * stride + b
            step.motion.q_inertial[i, e] = target[axis]
            step.motion.change[i, e] = onward[axis]
            step.arrays.q[i, e] = begin[axis]
    weight = step.instances.mass[i] * vec8d(step.basis.mean[step.instances.asset[i], b])
    if bits != 0:
        wp.atomic_or(step.state.status, step.instances.world[i], bits)
    for axis in range(3):
        force = wp.float64(g[axis]) * weight
        for chunk in range(step.arrays.gradient_chunk.shape[1]):
            force = force + step.arrays.gradient_chunk[i, chunk, axis * stride + b]
        step.motion.force[i, axis * stride + b] = force


@wp.kernel
def fall_back_to_euler(step: NewtonStep, spin: Spin):
    """Let a body near a shape, or fixed to a rigid body, take an Euler step.

    BDF2 would carry its velocity across the jump of an impact; and the rigid body takes Euler steps, in which the same
    force changes its momentum by another amount.
    """
    i, b = wp.tid()
    if not pushes(step.instances, step.constraints, i):
        return
    dt = step.options.dt
    stride = step.basis.row.shape[1]
    q = unknown_block(step.motion.q_start, i, b)
    qd = unknown_block(step.motion.qd_start, i, b)
    target = q + dt * qd
    if spin.turns[i] != 0:
        rest, one = rest_block(step.basis, step.instances.asset[i], b)
        turned, r = turned_block(spin, i, q, rest, one)
        target = target_block(spin, i, turned, r, qd, one, dt)
    step.motion.rate[i] = wp.float64(1.0)
    for axis in range(3):
        e = axis * stride + b
        step.motion.q_rate[i, e] = step.motion.q_start[i, e]
        step.motion.q_inertial[i, e] = target[axis]


@wp.kernel
def begin_newton(step: NewtonStep):
    """Start Newton's iteration in every world."""
    w = wp.tid()
    in_contact = int(0)
    rounding = wp.float64(0.0)
    for i in range(step.state.instance_start[w], step.state.instance_start[w + 1]):
        rate = step.motion.rate[i] / step.options.dt
        mass = float(step.instances.mass[i])
        least = mass * float(rate * (rate + wp.float64(step.instances.mass_damping[i])))
        modulus = p_wave_modulus(step.instances.youngs_modulus[i], step.instances.poissons_ratio[i])
        slack = PIVOT_ROUNDING * modulus * mass / step.instances.inertia[i]
        for k in range(3 * step.basis.row.shape[1]):
            step.arrays.systems.bounds[step.instances.system[i], step.instances.system_block[i] + k] = wp.vec2(
                least, slack
            )
        if pushes(step.instances, step.constraints, i):
            in_contact = 1
        if exists(step.instances, i):
            size = step.instances.size[i]
            volume = step.instances.mass[i] * wp.float64(size * size / step.instances.inertia[i])
            rounding += ENERGY_ROUNDING * wp.float64(step.instances.youngs_modulus[i]) * volume
    step.state.in_contact[w] = in_contact
    step.state.rounding[w] = rounding
    step.state.active[w] = 1
    step.state.searching[w] = 0
    step.state.evaluated[w] = 0
    step.state.extends[w] = 1
    step.state.refresh[w] = 1
    step.state.project[w] = 0
    step.state.failures[w] = 0
    step.state.exact[w] = 0
    step.state.iteration[w] = 0
    step.state.any_active[0] = 1


@wp.kernel
def extrapolate(step: NewtonStep):
    """Let a body that touches nothing start Newton with the acceleration of the step before as well.

    Only where velocities change by less than half in a step: a jerky motion would be thrown from one valley of the
    potential into another, step by step. And not a body so stiff that a step's rotation meets little else than its
    inertia: there a start up the elastic valley costs more iterations than it saves.
    """
    dt = step.options.dt
    i, e = wp.tid()
    if has_contacts(step.instances, step.constraints, i):
        return
    change = wp.float64(0.0)
    moved = wp.float64(0.0)
    for k in range(step.arrays.q.shape[1]):
        change += wp.dot(step.motion.change[i, k], step.motion.change[i, k])
        moved += wp.dot(step.motion.qd_start[i, k], step.motion.qd_start[i, k])
    inertia = wp.float64(step.instances.inertia[i]) / (dt * dt * wp.float64(step.instances.youngs_modulus[i]))
    if inertia > EXTRAPOLATION_INERTIA and change < wp.float64(0.25) * dt * dt * moved:
        step.arrays.q[i, e] = step.arrays.q[i, e] + step.motion.change[i, e]


@wp.kernel
def start_points(step: NewtonStep):
    """Evaluate the deformation at the start of the step, which viscosity goes by, once for all iterations."""
    i, p = wp.tid()
    if p >= step.instances.point_count[i] or step.instances.viscosity[i] <= 0.0:
        return
    point = step.instances.point_start[i] + p
    s = wp.float64(step.instances.scale[i])
    count = step.instances.function_count[i]
    step.points.start[i, p] = elastic_gradient(step.basis.gradient, step.motion.q_start, i, point, count, s)


@wp.kernel
def end_step(
    step: NewtonStep,
    spin: Spin,
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    q_before_out: wp.array[wp.vec3d],
    qd_before_out: wp.array[wp.vec3d],
    dt_before_out: wp.array[wp.float64],
):
    """Write the state: v = c (q - q_rate) / dt, or as ``spin_kernels`` has it where the target turns.

    A world that is not finite stays where it was, at rest. After a step near a shape there is no step before: the next
    one starts over with implicit Euler.
    """
    dt = step.options.dt
    i, b = wp.tid()
    n = step.instances.function_count[i]
    if LANES * b >= n:
        return
    failed = (step.state.status[step.instances.world[i]] & WORLD_NOT_FINITE) != 0
    before = unknown_block(step.motion.q_start, i, b)
    qd_before = unknown_block(step.motion.qd_start, i, b)
    now = unknown_block(step.arrays.q, i, b)
    qd = step.motion.rate[i] / dt * (now - unknown_block(step.motion.q_rate, i, b))
    if turns(spin, step.motion, i):
        qd = velocity_block(step, spin, i, b)
    if failed:
        now = before
        qd = mat38d()
    first = step.instances.function_start[i] + LANES * b
    for lane in range(LANES):
        if LANES * b + lane < n:
            out = first + lane
            q_out[out] = wp.vec3d(now[0, lane], now[1, lane], now[2, lane])
            qd_out[out] = wp.vec3d(qd[0, lane], qd[1, lane], qd[2, lane])
            q_before_out[out] = wp.vec3d(before[0, lane], before[1, lane], before[2, lane])
            qd_before_out[out] = wp.vec3d(qd_before[0, lane], qd_before[1, lane], qd_before[2, lane])
    if b == 0:
        if failed:
            dt_before_out[i] = wp.float64(0.0)
        else:
            dt_before_out[i] = wp.where(has_contacts(step.instances, step.constraints, i), -dt, dt)


@wp.kernel
def check_state(step: NewtonStep, team: int):
    """Flag a world whose unknowns are not all finite, or one of whose bodies has collapsed."""
    w, member = wp.tid()
    total = wp.float64(0.0)
    if member == 0:
        for j in range(step.rigid.count[w]):
            total += wp.abs(step.rigid.r[w, j])
    collapsed = float(0.0)
    for i in range(step.state.instance_start[w], step.state.instance_start[w + 1]):
        for e in range(member, step.arrays.q.shape[1], team):
            total += wp.dot(step.arrays.q[i, e], step.arrays.q[i, e])
        share = 1.0 / (COLLAPSED_SHARE * float(step.instances.point_count[i]))
        flat = float(0.0)
        for p in range(member, step.instances.point_count[i], team):
            if step.points.volume_ratio[i, p] < COLLAPSED_RATIO:
                flat += share
        collapsed = wp.max(collapsed, float(team_sum(wp.float64(flat))))
    total = team_sum(total)
    if member == 0:
        if not wp.isfinite(total):
            step.state.status[w] = step.state.status[w] | WORLD_NOT_FINITE
        if collapsed > 1.0:
            step.state.status[w] = step.state.status[w] | WORLD_COLLAPSED


@wp.kernel
def skin_samples(
    instances: Instances,
    basis: Basis,
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    dent: wp.array[wp.vec3],
    # Out:
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
):
    """Write position, dent included, and velocity of the surface samples as Newton particles."""
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
    particle_q_out[instances.particle_start[i] + s] = wp.vec3(x + wp.vec3d(dent[instances.particle_start[i] + s]))
    particle_qd_out[instances.particle_start[i] + s] = wp.vec3(v)
