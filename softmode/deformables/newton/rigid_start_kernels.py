"""Device side of Newton's start in an impact: the body moves rigidly to the minimum of inertia and contact.

A body that flies on through what it hits starts Newton far too deep. Newton's first iterations then do little else than
push it out and turn it, which a rigid body does in six unknowns: over the motions y -> X + t + R r of the iterate,

    m/(2 dt^2) |y - q_inertial|^2 - f . y + contact and friction

is minimised, the normal force of friction that of the iterate before. Elastic and viscous energy do not see it.
"""

from typing import Any

import warp as wp

from softmode.deformables.contact.penalty_kernels import contact_potential
from softmode.deformables.contact.response_kernels import KEEP, SET, contact_response
from softmode.deformables.model.lane_kernels import team_sum, team_sum3, team_sum33, vec8d
from softmode.deformables.model.newton_step_kernels import NewtonStep
from softmode.deformables.model.struct_kernels import (
    Instances,
    PointConstraints,
    Rigid,
    Samples,
    blocks_of,
    has_contacts,
    interpolate_change,
)
from softmode.deformables.newton.search_kernels import square_share
from softmode.deformables.potential.spin_kernels import (
    axial,
    centre_of_mass,
    rest_block,
    rotation_of,
    unknown_block,
)

wp.set_module_options({"enable_backward": False})

mat66d: Any = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
vec6d: Any = wp.types.vector(length=6, dtype=wp.float64)

IMPACT_MOTION = wp.constant(wp.float64(0.02))
"""Least motion of a step, over the size of the body (rms), for which a start is looked for: slower ones do well."""
ITERATIONS = 20
"""Steps of the rigid body at most."""
HALVINGS = 16
"""Lengths of such a step that are tried: out of contact it would go centimetres, and what stops it sets in within the
range of the onset, less than a thousandth of the body."""
GAIN_LEAST = wp.constant(wp.float64(1.0e-3))
"""Decrease that the quadratic model promises, over what is left of the potential, below which it stops: the rest is
Newton's. The decrease that was found says less: it is small too where contact has cut a step short."""


@wp.func
def solve_six(H: mat66d, g: vec6d):
    """Return -H^-1 g of a positive definite H, by Cholesky factorisation with floored pivots."""
    L = mat66d()
    x = vec6d()
    for a in range(6):
        for b in range(a + 1):
            value = H[a, b]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            if a == b:
                L[a, a] = wp.sqrt(wp.max(value, wp.float64(1.0e-12) * H[a, a] + wp.float64(1.0e-30)))
            else:
                L[a, b] = value / L[b, b]
        value = -g[a]
        for k in range(a):
            value -= L[a, k] * x[k]
        x[a] = value / L[a, a]
    for reverse in range(6):
        a = 5 - reverse
        value = x[a]
        for k in range(a + 1, 6):
            value -= L[k, a] * x[k]
        x[a] = value / L[a, a]
    return x


@wp.func
def find_displacement(step: NewtonStep, i: int, e: int):
    """Write the displacement of a contact at the iterate, relative to the other side; return offset + d."""
    row = step.constraints.row[i, e]
    count = step.instances.function_count[i]
    d = interpolate_change(step.basis.row, row, step.arrays.q, step.motion.q_start, i, count)
    d -= rigid_motion(step.instances, step.constraints, step.rigid, i, e)
    step.constraints.displacement[i, e] = d
    return step.constraints.offset[i, e] + d


@wp.func
def rigid_motion(instances: Instances, constraints: PointConstraints, rigid: Rigid, i: int, e: int):
    """Return how far the rigid unknowns have moved the other side of a contact."""
    w = instances.world[i]
    moved = wp.vec3d()
    for k in range(constraints.dof_begin[i, e], constraints.dof_end[i, e]):
        moved += rigid.r[w, k] * wp.vec3d(constraints.jacobian[i, e, k])
    return moved


@wp.func
def contact_arm(
    instances: Instances,
    constraints: PointConstraints,
    rigid: Rigid,
    samples: Samples,
    X: wp.vec3d,
    i: int,
    e: int,
):
    """Return where the sample of a contact is at the iterate, from X."""
    start = samples.position[i, constraints.partner_row[i, e] - instances.row_start[i]]
    return start + constraints.displacement[i, e] + rigid_motion(instances, constraints, rigid, i, e) - X


@wp.func
def contact_at(
    constraints: PointConstraints,
    stick_range: wp.float64,
    total: wp.vec3d,
    i: int,
    e: int,
    follow: int,
):
    """Return energy, force and Hessian of a contact at offset + d; ``follow``: its friction takes this normal force."""
    mode = wp.where(follow != 0, int(SET), int(KEEP))
    energy, force, H, pressed, _slip = contact_response(
        False,
        total,
        constraints.normal[i, e],
        wp.vec3d(),
        constraints.stiffness[i, e],
        constraints.dent_compliance[i, e],
        constraints.dent_depth[i, e],
        constraints.ridge[i, e],
        constraints.ridge_lead[i, e],
        constraints.friction[i, e],
        constraints.stick[i, e],
        constraints.stick_deep[i, e],
        constraints.normal_force[i, e],
        constraints.onset[i, e],
        stick_range,
        mode,
        0,
    )
    if follow != 0:
        constraints.normal_force[i, e] = pressed
    return energy, force, H


@wp.func
def rigid_share(weight: wp.float64, away: wp.vec3d, C: wp.mat33d, t: wp.vec3d, R: wp.mat33d):
    """Return what inertia and external forces have of the potential of the motion by t and R [J]."""
    turned = wp.ddot(C, R - wp.identity(n=3, dtype=wp.float64))
    return wp.float64(0.5) * weight * wp.dot(t, t + wp.float64(2.0) * away) - turned


@wp.func
def rigid_potential(
    step: NewtonStep,
    samples: Samples,
    i: int,
    X: wp.vec3d,
    away: wp.vec3d,
    C: wp.mat33d,
    t: wp.vec3d,
    R: wp.mat33d,
    member: int,
    team: int,
):
    """Return the potential of the motion by t and R [J], with away = X - X* and C = sum (m/dt^2 r* + f) r^T."""
    share = wp.float64(0.0)
    for e in range(member, step.constraints.count[i] - step.constraints.pair_count[i], team):
        r = contact_arm(step.instances, step.constraints, step.rigid, samples, X, i, e)
        total = step.constraints.offset[i, e] + step.constraints.displacement[i, e]
        value, _f, _H = contact_at(step.constraints, step.options.stick_range, total + t + R * r - r, i, e, 0)
        share += value
    weight = step.instances.mass[i] / (step.options.dt * step.options.dt)
    return team_sum(share) + rigid_share(weight, away, C, t, R)


@wp.kernel
def start_rigidly(step: NewtonStep, samples: Samples, team: int):
    """Move the first iterate of a body that would fly into what it hits."""
    i, member = wp.tid()
    count = step.constraints.count[i] - step.constraints.pair_count[i]
    if not has_contacts(step.instances, step.constraints, i):
        return
    if count == 0 or step.instances.pin_count[i] > 0 or step.instances.driven_count[i] > 0:
        return
    dt = step.options.dt
    a = step.instances.asset[i]
    n = step.instances.function_count[i]
    blocks = blocks_of(n)
    weight = step.instances.mass[i] / (dt * dt)
    moved = square_share(step.motion.qd_start, i, member, team)
    moved = dt * dt * team_sum(moved)
    least = IMPACT_MOTION * wp.float64(step.instances.size[i])
    if moved < least * least:
        return
    stored = wp.float64(0.0)
    for e in range(member, count, team):
        total = find_displacement(step, i, e)
        penetration = -wp.dot(step.constraints.normal[i, e], total)
        psi, _slope, _curvature = contact_potential(step.constraints, penetration, i, e)
        stored += step.constraints.stiffness[i, e] * psi
    stored = team_sum(stored)
    if stored < wp.float64(0.5) * weight * moved:
        return

    X = centre_of_mass(step.basis, step.arrays.q, a, n, i, member, team)
    target = centre_of_mass(step.basis, step.motion.q_inertial, a, n, i, member, team)
    force = wp.vec3d()
    for b in range(member, blocks, team):
        _rest, one = rest_block(step.basis, a, b)
        force += unknown_block(step.motion.force, i, b) * one
    away = X - target - team_sum3(force) / weight
    C = wp.mat33d()
    for b in range(member, blocks, team):
        rest, one = rest_block(step.basis, a, b)
        arms = unknown_block(step.arrays.q, i, b) + rest - wp.outer(X, one)
        aim = unknown_block(step.motion.q_inertial, i, b) + rest
        C += (weight * aim + unknown_block(step.motion.force, i, b)) * wp.transpose(arms)
    C = team_sum33(C)

    t = wp.vec3d()
    R = wp.identity(n=3, dtype=wp.float64)
    for _k in range(ITERATIONS):
        N = R * wp.transpose(C)
        even = wp.float64(0.5) * (N + wp.transpose(N))
        inertia = wp.trace(even) * wp.identity(n=3, dtype=wp.float64) - even
        share = wp.float64(0.0)
        push = wp.vec3d()
        moment = wp.vec3d()
        H_tt = wp.mat33d()
        H_tr = wp.mat33d()
        H_rr = wp.mat33d()
        for e in range(member, count, team):
            r = contact_arm(step.instances, step.constraints, step.rigid, samples, X, i, e)
            arm = R * r
            total = step.constraints.offset[i, e] + step.constraints.displacement[i, e]
            value, f, K = contact_at(step.constraints, step.options.stick_range, total + t + arm - r, i, e, 1)
            lever = wp.skew(arm)
            share += value
            push += f
            moment += wp.cross(arm, f)
            H_tt += K
            H_tr -= K * lever
            H_rr -= lever * K * lever
        push = team_sum3(push)
        moment = team_sum3(moment)
        H_tt = team_sum33(H_tt)
        H_tr = team_sum33(H_tr)
        H_rr = team_sum33(H_rr)
        potential = team_sum(share) + rigid_share(weight, away, C, t, R)
        H = mat66d()
        g = vec6d()
        by_t = weight * (t + away) - push
        by_r = -axial(N) - moment
        for c in range(3):
            g[c] = by_t[c]
            g[3 + c] = by_r[c]
            H[c, c] = weight
            for d in range(3):
                H[c, d] += H_tt[c, d]
                H[c, 3 + d] = H_tr[c, d]
                H[3 + d, c] = H_tr[c, d]
                H[3 + c, 3 + d] = inertia[c, d] + H_rr[c, d]
        x = solve_six(H, g)
        alpha = wp.float64(1.0)
        before = potential
        for _trial in range(HALVINGS):
            shift = t + alpha * wp.vec3d(x[0], x[1], x[2])
            turned = rotation_of(alpha * wp.vec3d(x[3], x[4], x[5])) * R
            value = rigid_potential(step, samples, i, X, away, C, shift, turned, member, team)
            if value < potential:
                potential = value
                t = shift
                R = turned
                break
            alpha *= wp.float64(0.5)
        promised = wp.float64(-0.5) * wp.dot(g, x)
        if not (promised > GAIN_LEAST * wp.abs(potential) and before > potential):
            break

    stride = step.basis.row.shape[1]
    for b in range(member, blocks, team):
        rest, one = rest_block(step.basis, a, b)
        arms = unknown_block(step.arrays.q, i, b) + rest - wp.outer(X, one)
        block = R * arms + wp.outer(X + t, one) - rest
        for axis in range(3):
            step.arrays.q[i, axis * stride + b] = vec8d(block[axis])
