"""Device side of the inertial target that turns: where a body goes in a step without forces, and its velocity after it.

A velocity is v = V + omega x r + w: that of the centre of mass, the rotation that has the angular momentum
L = m I omega of the body as it is deformed, and what is left, which has no momentum of either kind. A straight flight
x + dt v costs a step of implicit Euler the fraction (omega dt)^2 / 2 of its spin: the body that the elastic forces pull
back to its shape moves along the chord. So the target turns:

    R  = exp(dt omega_m),  omega_m = I^-1 (L + R^T L) / 2,  L per unit mass,
    x* = X + dt V + R r + dt b,    b = R^T w - dt R Omega x (Omega x r) less its rotation,   Omega = I^-1 R^T L.

With this omega_m the rigid motion keeps L and L . omega exactly: Simo and Wong's rule (1991,
doi:10.1002/nme.1620310103) with the exponential map. In b, R^T w is w as Coriolis' force turns it against the frame,
the second term is the centrifugal force, which the elastic forces must balance. After the step, which leaves x with the
centre of mass X', the rest is r' = x - X' and the velocity is

    v' = V' + (r' - R r)/dt + chi x r',    chi = I'^-1 (L - sum r' x b),

so that the angular momentum has changed by dt times the moment of all forces about the centre of mass, at their new
places, and by nothing else.

Sums over the mass are sums over coordinates, since functions are orthonormal in mass. All moments are per unit mass.
"""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import LANES, team_sum3, team_sum33, vec8d
from softmode.deformables.model.newton_step_kernels import NewtonStep, mat38d
from softmode.deformables.model.struct_kernels import Basis, Motion, blocks_of

wp.set_module_options({"enable_backward": False})

TURN_MAX = wp.constant(wp.float64(1.0))
"""Largest turn in a step [rad]; what turns faster flies straight and loses spin."""
STRETCH_MAX = wp.constant(4.0)
"""Largest rho L^2 omega^2 / E, likewise: beyond, a body flies apart within steps that take its centrifugal force from
their start."""
MOMENT_FLOOR = wp.constant(wp.float64(1.0e-12))
"""Least moment of inertia over that of the body's size: bodies squeezed to a line have one."""
ROOTS = 20
"""Newton iterations for omega_m at most; four are usual."""


@struct
class Spin:
    """How each instance turns in a step, shape (instance_count,); moments are about the centre of mass, per mass."""

    turns: wp.array[int]  # whether its target turns
    centre: wp.array[wp.vec3d]  # X, of the start [m]
    velocity: wp.array[wp.vec3d]  # V [m/s]
    gain: wp.array[wp.vec3d]  # V less that of the state before [m/s]
    moment: wp.array[wp.mat33d]  # sum r r^T [m^2]
    flow: wp.array[wp.mat33d]  # sum r u^T, u = v - V [m^2/s]
    momentum: wp.array[wp.vec3d]  # L [m^2/s]
    mean: wp.array[wp.vec3d]  # omega_m [rad/s]
    rotation: wp.array[wp.mat33d]  # R
    onward: wp.array[wp.mat33d]  # R^(3/2), from the middle of the step before to the end of this one
    outward: wp.array[wp.mat33d]  # D, b = R^T u + D r [1/s]
    centrifugal: wp.array[wp.mat33d]  # dt^2 times the centrifugal force is this times r
    centre_end: wp.array[wp.vec3d]  # X' [m]
    moment_end: wp.array[wp.mat33d]  # sum r' r'^T [m^2]
    correction: wp.array[wp.vec3d]  # chi [rad/s]


@wp.func
def axial(N: wp.mat33d):
    """Return sum a x b of N = sum a b^T."""
    return wp.vec3d(N[1, 2] - N[2, 1], N[2, 0] - N[0, 2], N[0, 1] - N[1, 0])


@wp.func
def tensor_of_inertia(moment: wp.mat33d, size: float):
    """Return the tensor of inertia per unit mass of sum r r^T, with a floor."""
    floor = MOMENT_FLOOR * wp.float64(size) * wp.float64(size)
    return (wp.trace(moment) + floor) * wp.identity(n=3, dtype=wp.float64) - moment


@wp.func
def rotation_coefficients(angle: wp.float64):
    """Return sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3."""
    one = wp.float64(1.0)
    square = angle * angle
    if angle < wp.float64(0.02):
        a = one - square / wp.float64(6.0) * (one - square / wp.float64(20.0))
        b = wp.float64(0.5) - square / wp.float64(24.0) * (one - square / wp.float64(30.0))
        c = one / wp.float64(6.0) - square / wp.float64(120.0) * (one - square / wp.float64(42.0))
        return wp.vec3d(a, b, c)
    half = wp.sin(wp.float64(0.5) * angle)
    return wp.vec3d(
        wp.sin(angle) / angle, wp.float64(2.0) * half * half / square, (angle - wp.sin(angle)) / (square * angle)
    )


@wp.func
def rotation_of(turn: wp.vec3d):
    """Return exp([turn])."""
    k = rotation_coefficients(wp.length(turn))
    T = wp.skew(turn)
    return wp.identity(n=3, dtype=wp.float64) + k[0] * T + k[1] * (T * T)


@wp.func
def left_jacobian(turn: wp.vec3d):
    """Return J with d exp([turn]) = [J d turn] exp([turn])."""
    k = rotation_coefficients(wp.length(turn))
    T = wp.skew(turn)
    return wp.identity(n=3, dtype=wp.float64) + k[1] * T + k[2] * (T * T)


@wp.func
def mean_spin_tangent(inverse: wp.mat33d, momentum: wp.vec3d, mean: wp.vec3d, dt: wp.float64):
    """Return the derivative of omega_m - I^-1 (L + R^T L) / 2 by omega_m."""
    R = rotation_of(dt * mean)
    back = wp.transpose(R) * (wp.skew(momentum) * left_jacobian(dt * mean))
    return wp.identity(n=3, dtype=wp.float64) - wp.float64(0.5) * dt * (inverse * back)


@wp.func
def mean_spin(inverse: wp.mat33d, momentum: wp.vec3d, dt: wp.float64):
    """Return the root omega_m of omega_m = I^-1 (L + R^T L) / 2, and the size of the last change over its own."""
    mean = inverse * momentum
    change = wp.float64(0.0)
    for _k in range(ROOTS):
        R = rotation_of(dt * mean)
        error = mean - wp.float64(0.5) * (inverse * (momentum + wp.transpose(R) * momentum))
        d = wp.inverse(mean_spin_tangent(inverse, momentum, mean, dt)) * error
        mean = mean - d
        change = wp.length(d)
        if change <= wp.float64(1.0e-14) * wp.length(mean):
            break
    return mean, change


@wp.func
def rest_block(basis: Basis, a: int, b: int):
    """Return eight of the coordinates of the rest position X, and of the constant field 1."""
    X = mat38d()
    one = vec8d()
    for lane in range(LANES):
        c = basis.linear[a, LANES * b + lane]
        one[lane] = c[3]
        for axis in range(3):
            X[axis, lane] = c[axis]
    return X, one


@wp.func
def state_block(values: wp.array[wp.vec3d], first: int, count: int):
    """Return eight of the coordinates of a field in a state, with zeros behind the last of ``count``."""
    block = mat38d()
    for lane in range(LANES):
        if lane < count:
            value = values[first + lane]
            for axis in range(3):
                block[axis, lane] = value[axis]
    return block


@wp.func
def unknown_block(values: wp.array2d[vec8d], i: int, b: int):
    """Return eight of the coordinates of a field in blocks."""
    stride = values.shape[1] / 3
    block = mat38d()
    for axis in range(3):
        block[axis] = values[i, axis * stride + b]
    return block


@wp.func
def centre_of_mass(basis: Basis, values: wp.array2d[vec8d], a: int, n: int, i: int, member: int, team: int):
    """Return the centre of mass of a placement in blocks [m]."""
    X = wp.vec3d()
    for b in range(member, blocks_of(n), team):
        rest, _one = rest_block(basis, a, b)
        X += (unknown_block(values, i, b) + rest) * basis.mean[a, b]
    return team_sum3(X)


@wp.kernel
def find_spin(
    step: NewtonStep,
    team: int,
    q: wp.array[wp.vec3d],  # (function_total,) [m]
    qd: wp.array[wp.vec3d],  # [m/s]
    qd_before: wp.array[wp.vec3d],
    enabled: int,
    # Out:
    spin: Spin,
):
    """Find how each instance turns in the step; one with driven functions goes where it is driven and does not."""
    i, member = wp.tid()
    dt = step.options.dt
    a = step.instances.asset[i]
    n = step.instances.function_count[i]
    start = step.instances.function_start[i]
    if enabled == 0 or n == 0 or step.instances.driven_count[i] > 0:
        if member == 0:
            spin.turns[i] = 0
        return
    X = wp.vec3d()
    V = wp.vec3d()
    V_before = wp.vec3d()
    for b in range(member, blocks_of(n), team):
        rest, _one = rest_block(step.basis, a, b)
        mean = step.basis.mean[a, b]
        X += (state_block(q, start + LANES * b, n - LANES * b) + rest) * mean
        V += state_block(qd, start + LANES * b, n - LANES * b) * mean
        V_before += state_block(qd_before, start + LANES * b, n - LANES * b) * mean
    X = team_sum3(X)
    V = team_sum3(V)
    V_before = team_sum3(V_before)
    S = wp.mat33d()
    U = wp.mat33d()
    for b in range(member, blocks_of(n), team):
        rest, one = rest_block(step.basis, a, b)
        r = state_block(q, start + LANES * b, n - LANES * b) + rest - wp.outer(X, one)
        u = state_block(qd, start + LANES * b, n - LANES * b) - wp.outer(V, one)
        S += r * wp.transpose(r)
        U += r * wp.transpose(u)
    S = team_sum33(S)
    U = team_sum33(U)
    if member != 0:
        return
    size = step.instances.size[i]
    inverse = wp.inverse(tensor_of_inertia(S, size))
    L = axial(U)
    omega = inverse * L
    omega_m, change = mean_spin(inverse, L, dt)
    fast = wp.float64(step.instances.inertia[i]) * wp.length_sq(omega)
    sound = change <= wp.float64(1.0e-10) * wp.length(omega_m)
    sound = sound and wp.length(omega_m) * dt <= TURN_MAX
    sound = sound and fast <= wp.float64(STRETCH_MAX * step.instances.youngs_modulus[i])
    if not sound:
        spin.turns[i] = 0
        return
    R = rotation_of(dt * omega_m)
    D, centrifugal = outward_of(inverse, S, U, omega, omega_m, R, dt)
    spin.turns[i] = 1
    spin.centre[i] = X
    spin.velocity[i] = V
    spin.gain[i] = V - V_before
    spin.moment[i] = S
    spin.flow[i] = U
    spin.momentum[i] = L
    spin.mean[i] = omega_m
    spin.rotation[i] = R
    spin.onward[i] = rotation_of(wp.float64(1.5) * dt * omega_m)
    spin.outward[i] = D
    spin.centrifugal[i] = centrifugal


@wp.func
def outward_of(
    inverse: wp.mat33d,
    S: wp.mat33d,
    U: wp.mat33d,
    omega: wp.vec3d,
    omega_m: wp.vec3d,
    R: wp.mat33d,
    dt: wp.float64,
):
    """Return D of b = R^T u + D r, and the matrix of the centrifugal displacement.

    With Omega = 2 omega_m - omega, D = -R^T [omega] - R (dt [Omega]^2 + [beta]), and the rotation beta makes
    sum r~ x b vanish, r~ = R r.
    """
    W = wp.skew(omega)
    O = wp.skew(wp.float64(2.0) * omega_m - omega)
    square = O * O
    beta = inverse * (axial((U + S * W) * (R * R)) - dt * axial(S * square))
    D = -wp.transpose(R) * W - R * (dt * square + wp.skew(beta))
    return D, -dt * dt * (R * square)


@wp.func
def turned_block(spin: Spin, i: int, q: mat38d, rest: mat38d, one: vec8d):
    """Return eight coordinates of the body turned about its centre of mass, X + R r, and those of r."""
    r = q + rest - wp.outer(spin.centre[i], one)
    return spin.rotation[i] * r + wp.outer(spin.centre[i], one) - rest, r


@wp.func
def target_block(spin: Spin, i: int, turned: mat38d, r: mat38d, qd: mat38d, one: vec8d, dt: wp.float64):
    """Return eight coordinates of the target x*."""
    u = qd - wp.outer(spin.velocity[i], one)
    b = wp.transpose(spin.rotation[i]) * u + spin.outward[i] * r
    return turned + dt * (wp.outer(spin.velocity[i], one) + b)


@wp.func
def turns(spin: Spin, motion: Motion, i: int):
    """Return whether an instance takes a step of Euler whose target turns."""
    return spin.turns[i] != 0 and motion.rate[i] == wp.float64(1.0)


@wp.kernel
def end_spin(
    step: NewtonStep,
    team: int,
    # In and out:
    spin: Spin,
):
    """Find the rotation that the velocity at the end of the step lacks."""
    i, member = wp.tid()
    if not turns(spin, step.motion, i):
        return
    a = step.instances.asset[i]
    n = step.instances.function_count[i]
    dt = step.options.dt
    X = centre_of_mass(step.basis, step.arrays.q, a, n, i, member, team)
    S = wp.mat33d()
    G = wp.mat33d()
    free = step.constraints.count[i] == 0
    alpha = wp.float64(step.instances.mass_damping[i])
    for b in range(member, blocks_of(n), team):
        rest, one = rest_block(step.basis, a, b)
        r = unknown_block(step.arrays.q, i, b) + rest - wp.outer(X, one)
        q_start = unknown_block(step.motion.q_start, i, b)
        turned, _r = turned_block(spin, i, q_start, rest, one)
        S += r * wp.transpose(r)
        if free:
            # nothing but the external forces turns it, whatever the iteration left of the elastic ones
            q = unknown_block(step.arrays.q, i, b)
            push = dt / step.instances.mass[i] * unknown_block(step.motion.force, i, b)
            G += r * wp.transpose((q - turned) / dt + alpha * (q - q_start) - push)
        else:
            G += r * wp.transpose(unknown_block(step.motion.q_inertial, i, b) - turned) / dt
    S = team_sum33(S)
    G = team_sum33(G)
    if member != 0:
        return
    inverse = wp.inverse(tensor_of_inertia(S, step.instances.size[i]))
    spin.centre_end[i] = X
    spin.moment_end[i] = S
    spin.correction[i] = inverse * (spin.momentum[i] - axial(G))


@wp.func
def velocity_block(step: NewtonStep, spin: Spin, i: int, b: int):
    """Return eight coordinates of the velocity at the end of a step whose target turns."""
    rest, one = rest_block(step.basis, step.instances.asset[i], b)
    q = unknown_block(step.arrays.q, i, b)
    turned, _r = turned_block(spin, i, unknown_block(step.motion.q_start, i, b), rest, one)
    r = q + rest - wp.outer(spin.centre_end[i], one)
    return (q - turned) / step.options.dt + wp.skew(spin.correction[i]) * r
