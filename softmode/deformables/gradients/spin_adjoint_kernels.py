"""Device side of the adjoint of a target that turns, see ``spin_kernels``: of the velocity after a step, of the target.

Both are sums over the functions of an instance, with factors that depend on the moments S = sum r r^T and
U = sum r u^T. Losses by these factors are gathered first; tangents of the factors along each of the fifteen entries of
S and U then give the loss by the moments.
"""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.newton_step_kernels import mat38d
from softmode.deformables.model.struct_kernels import Basis, Instances, Motion, blocks_of
from softmode.deformables.potential.spin_kernels import (
    Spin,
    axial,
    left_jacobian,
    mean_spin_tangent,
    rest_block,
    tensor_of_inertia,
    turned_block,
    turns,
    unknown_block,
)

wp.set_module_options({"enable_backward": False})


@struct
class SpinLoss:
    """What the velocity at the end of a step passes on, shape (instance_count,)."""

    momentum: wp.array[wp.vec3d]  # loss by L, which is less that by sum r' x b [1/m^2 s]


@struct
class Turn:
    """How an instance turns, or a tangent of it; names as in ``Spin``."""

    S: wp.mat33d
    U: wp.mat33d
    L: wp.vec3d
    omega: wp.vec3d
    omega_m: wp.vec3d
    R: wp.mat33d
    D: wp.mat33d


@wp.func
def add_block(values: wp.array2d[vec8d], i: int, b: int, block: mat38d):
    """Add eight coordinates of a field to one in blocks."""
    stride = values.shape[1] / 3
    for axis in range(3):
        e = axis * stride + b
        values[i, e] = values[i, e] + block[axis]


@wp.kernel
def pull_velocity(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    spin: Spin,
    q: wp.array2d[vec8d],  # at the end of the step
    qd_bar: wp.array2d[vec8d],
    # In and out:
    q_bar: wp.array2d[vec8d],
    # Out:
    loss: SpinLoss,
):
    """Pass dL/dv_t through the rotation chi x r' to q_t and to what the target made of the start."""
    i = wp.tid()
    loss.momentum[i] = wp.vec3d()
    if not turns(spin, motion, i):
        return
    a = instances.asset[i]
    blocks = blocks_of(instances.function_count[i])
    chi = spin.correction[i]
    inverse = wp.inverse(tensor_of_inertia(spin.moment_end[i], instances.size[i]))
    moment = wp.mat33d()
    for b in range(blocks):
        rest, one = rest_block(basis, a, b)
        r = unknown_block(q, i, b) + rest - wp.outer(spin.centre_end[i], one)
        moment += r * wp.transpose(unknown_block(qd_bar, i, b))
    zeta = inverse * axial(moment)
    loss.momentum[i] = zeta
    # by r': of chi x r', of sum r' x b and of the inertia
    by_r = (
        wp.outer(zeta, chi)
        + wp.outer(chi, zeta)
        - wp.float64(2.0) * wp.dot(zeta, chi) * wp.identity(n=3, dtype=wp.float64)
    )
    total = wp.vec3d()
    for b in range(blocks):
        rest, one = rest_block(basis, a, b)
        total += velocity_loss(instances, basis, motion, spin, q, qd_bar, zeta, by_r, i, b, rest, one) * one
    for b in range(blocks):
        rest, one = rest_block(basis, a, b)
        found = velocity_loss(instances, basis, motion, spin, q, qd_bar, zeta, by_r, i, b, rest, one)
        add_block(q_bar, i, b, found - wp.outer(total, basis.mean[a, b]))


@wp.func
def velocity_loss(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    spin: Spin,
    q: wp.array2d[vec8d],
    qd_bar: wp.array2d[vec8d],
    zeta: wp.vec3d,
    by_r: wp.mat33d,
    i: int,
    b: int,
    rest: mat38d,
    one: vec8d,
):
    """Return eight coordinates of the loss by r', less that by the chord."""
    r = unknown_block(q, i, b) + rest - wp.outer(spin.centre_end[i], one)
    start = unknown_block(motion.q_start, i, b) + rest - wp.outer(spin.centre[i], one)
    u = unknown_block(motion.qd_start, i, b) - wp.outer(spin.velocity[i], one)
    away = wp.transpose(spin.rotation[i]) * u + spin.outward[i] * start
    # d (chi x r') . v_bar = r' . (v_bar x chi), -zeta . (r' x b) = r' . (zeta x b)
    return wp.skew(zeta) * away - wp.skew(spin.correction[i]) * unknown_block(qd_bar, i, b) + by_r * r


@wp.func
def tangent(turn: Turn, inverse: wp.mat33d, slope: wp.mat33d, dS: wp.mat33d, dU: wp.mat33d, dt: wp.float64):
    """Return the tangent of L, R and D along a change of S and U.

    Args:
        turn: Where.
        inverse: Inverse of the tensor of inertia.
        slope: Inverse of the tangent of the equation of omega_m.
        dS: Change of S, symmetric.
        dU: Change of U.
        dt: Step [s].
    """
    half = wp.float64(0.5)
    identity = wp.identity(n=3, dtype=wp.float64)
    R = turn.R
    back = wp.transpose(R)
    dJ = wp.trace(dS) * identity - dS
    out = Turn()
    out.S = dS
    out.U = dU
    out.L = axial(dU)
    out.omega = inverse * (out.L - dJ * turn.omega)
    out.omega_m = slope * (inverse * (half * (out.L + back * out.L) - dJ * turn.omega_m))
    phi = wp.skew(left_jacobian(dt * turn.omega_m) * (dt * out.omega_m))
    out.R = phi * R
    d_back = -back * phi
    W = wp.skew(turn.omega)
    dW = wp.skew(out.omega)
    O = wp.skew(wp.float64(2.0) * turn.omega_m - turn.omega)
    dO = wp.skew(wp.float64(2.0) * out.omega_m - out.omega)
    square = O * O
    d_square = dO * O + O * dO
    rest = turn.U + turn.S * W
    d_rest = dU + dS * W + turn.S * dW
    beta = inverse * (axial(rest * (R * R)) - dt * axial(turn.S * square))
    d_beta = axial(d_rest * (R * R) + rest * (out.R * R + R * out.R)) - dt * axial(dS * square + turn.S * d_square)
    d_beta = inverse * (d_beta - dJ * beta)
    out.D = -d_back * W - back * dW - out.R * (dt * square + wp.skew(beta)) - R * (dt * d_square + wp.skew(d_beta))
    return out


@wp.func
def start_losses(
    instances: Instances,
    motion: Motion,
    loss: SpinLoss,
    spin: Spin,
    q: wp.array2d[vec8d],
    costate: wp.array2d[vec8d],
    qd_bar: wp.array2d[vec8d],
    dt: wp.float64,
    i: int,
    b: int,
    rest: mat38d,
    one: vec8d,
):
    """Return the losses by q_inertial, by R r, and by b, of x* = X + dt V + R r + dt b and v' = (r' - R r)/dt + ..."""
    inertial = instances.mass[i] / (dt * dt) * unknown_block(costate, i, b)
    turned = inertial - unknown_block(qd_bar, i, b) / dt
    r = unknown_block(q, i, b) + rest - wp.outer(spin.centre_end[i], one)
    away = dt * inertial - wp.skew(loss.momentum[i]) * r
    return inertial, turned, away


@wp.func
def state_losses(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    loss: SpinLoss,
    spin: Spin,
    turn: Turn,
    S_bar: wp.mat33d,
    U_bar: wp.mat33d,
    q: wp.array2d[vec8d],
    costate: wp.array2d[vec8d],
    qd_bar: wp.array2d[vec8d],
    dt: wp.float64,
    i: int,
    b: int,
):
    """Return eight coordinates of the losses by r and u at the start, those through S and U among them."""
    rest, one = rest_block(basis, instances.asset[i], b)
    _i, turned, away = start_losses(instances, motion, loss, spin, q, costate, qd_bar, dt, i, b, rest, one)
    _x, r = turned_block(spin, i, unknown_block(motion.q_start, i, b), rest, one)
    u = unknown_block(motion.qd_start, i, b) - wp.outer(spin.velocity[i], one)
    by_r = wp.transpose(turn.R) * turned + wp.transpose(turn.D) * away
    by_r += wp.float64(2.0) * S_bar * r + U_bar * u
    by_u = turn.R * away + wp.transpose(U_bar) * r
    return by_r, by_u


@wp.kernel
def propagate_spin(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    loss: SpinLoss,
    spin: Spin,
    q: wp.array2d[vec8d],  # at the end of the step
    costate: wp.array2d[vec8d],
    dt: wp.float64,
    t: int,
    # In and out, (T + 2, ...): row t + 2 is the end of the step, the row before its start
    q_bar: wp.array3d[vec8d],
    qd_bar: wp.array3d[vec8d],
):
    """Pass what the target and the velocity at the end feel of the start of the step to q_(t-1) and v_(t-1)."""
    i = wp.tid()
    if not turns(spin, motion, i):
        return
    a = instances.asset[i]
    blocks = blocks_of(instances.function_count[i])
    turn = Turn()
    turn.S = spin.moment[i]
    turn.U = spin.flow[i]
    turn.L = spin.momentum[i]
    turn.omega_m = spin.mean[i]
    turn.R = spin.rotation[i]
    turn.D = spin.outward[i]
    inverse = wp.inverse(tensor_of_inertia(turn.S, instances.size[i]))
    turn.omega = inverse * turn.L
    slope = wp.inverse(mean_spin_tangent(inverse, turn.L, turn.omega_m, dt))

    end = qd_bar[t + 2]
    R_bar = wp.mat33d()
    D_bar = wp.mat33d()
    X_bar = wp.vec3d()
    V_bar = wp.vec3d()
    for b in range(blocks):
        rest, one = rest_block(basis, a, b)
        inertial, turned, away = start_losses(instances, motion, loss, spin, q, costate, end, dt, i, b, rest, one)
        _x, r = turned_block(spin, i, unknown_block(motion.q_start, i, b), rest, one)
        u = unknown_block(motion.qd_start, i, b) - wp.outer(spin.velocity[i], one)
        R_bar += turned * wp.transpose(r) + u * wp.transpose(away)
        D_bar += away * wp.transpose(r)
        X_bar += turned * one
        V_bar += dt * (inertial * one)

    S_bar = wp.mat33d()
    U_bar = wp.mat33d()
    for k in range(15):
        dS = wp.mat33d()
        dU = wp.mat33d()
        row = k / 3
        column = k % 3
        if k < 9:
            dU[row, column] = wp.float64(1.0)
        else:
            # 00, 11, 22, then 12, 20, 01
            row = (k - 9) % 3
            column = row
            if k >= 12:
                row = (k - 11) % 3
                column = (k - 10) % 3
            dS[row, column] = wp.float64(1.0)
            dS[column, row] = wp.float64(1.0)
        d = tangent(turn, inverse, slope, dS, dU, dt)
        value = wp.ddot(R_bar, d.R) + wp.ddot(D_bar, d.D) + wp.dot(loss.momentum[i], d.L)
        if k < 9:
            U_bar[row, column] = value
        elif k < 12:
            S_bar[row, row] = value
        else:
            S_bar[row, column] = wp.float64(0.5) * value
            S_bar[column, row] = wp.float64(0.5) * value

    r_total = wp.vec3d()
    u_total = wp.vec3d()
    for b in range(blocks):
        _rest, one = rest_block(basis, a, b)
        by_r, by_u = state_losses(instances, basis, motion, loss, spin, turn, S_bar, U_bar, q, costate, end, dt, i, b)
        r_total += by_r * one
        u_total += by_u * one
    for b in range(blocks):
        by_r, by_u = state_losses(instances, basis, motion, loss, spin, turn, S_bar, U_bar, q, costate, end, dt, i, b)
        mean = basis.mean[a, b]
        add_block(q_bar[t + 1], i, b, by_r + wp.outer(X_bar - r_total, mean))
        add_block(qd_bar[t + 1], i, b, by_u + wp.outer(V_bar - u_total, mean))
