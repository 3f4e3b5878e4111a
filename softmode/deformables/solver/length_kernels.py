"""Device side of the line search where a full step goes too far: the length at which contact and friction stop it.

Friction gives way and contact sets in at corners of the potential, which halving the step would have to find by trial:
each trial evaluates the whole body, and the worlds that need most of them decide when a step of all worlds ends. But
the law of a contact along the step is known. So the step goes to the minimum of the contacts' energy, at their
displacements between both ends, and a parabola for all else, which has the value and the slope of the potential at the
start and its value at the end.
"""

import warp as wp

from softmode.deformables.contact.penalty_kernels import contact_potential, slip_potential
from softmode.deformables.model.lane_kernels import LANES, rolled, team_sum33, vec8d
from softmode.deformables.model.struct_kernels import Instances, PointConstraints, instance_end
from softmode.deformables.solver.iteration_kernels import NewtonStep
from softmode.deformables.solver.step_kernels import displacement_of, pair_share

wp.set_module_options({"enable_backward": False})

HALVED = wp.constant(wp.float64(0.5))
"""What ``check_trial`` makes of a full step that it refuses."""
LENGTHS = wp.constant(vec8d(0.0, 0.0625, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0))
"""Lengths at which the constraints are looked at; between two of them the slope is taken as linear."""


@wp.func
def constraint_at(
    instances: Instances, constraints: PointConstraints, stick_range: wp.float64, d: wp.vec3d, i: int, e: int
):
    """Return energy [J] and force [N] of a constraint at a displacement, with the normal force friction goes by."""
    x = constraints.offset[i, e] + d
    k = constraints.stiffness[i, e]
    if e < instances.pin_count[i]:
        return wp.float64(0.5) * k * wp.length_sq(x), -k * x
    n = constraints.normal[i, e]
    smoothing, share = pair_share(instances, constraints, i, e)
    psi, slope, _curvature = contact_potential(constraints, smoothing, -wp.dot(n, x), i, e)
    t = x - wp.dot(n, x) * n
    limit = constraints.friction[i, e] * constraints.normal_force[i, e]
    f0, secant, _tangent = slip_potential(wp.length(t), limit, constraints.stick[i, e], stick_range)
    return share * (k * psi + f0), share * (k * slope * n - secant * t)


@wp.func
def shorten_step(step: NewtonStep, trial: wp.float64, team: int, w: int, member: int):
    """Shorten a full step that has just been refused; every thread of the team must call it.

    Args:
        step: The step.
        trial: Potential at the full step [J], where all constraints are evaluated.
        team: Threads that share the world.
        w: World.
        member: Thread among them.
    """
    if step.state.searching[w] == 0 or step.state.step_length[w] != HALVED:
        return
    begin = step.state.instance_start[w]
    end = instance_end(step.instances, step.state.instance_start, w)
    # slopes of the constraints' energy at all lengths but the last, its values at the first and at the last
    sums = wp.mat33d()
    lengths = LENGTHS
    count = int(LANES)  # no constant: the loop is not to be unrolled
    for i in range(begin, end):
        rolled()
        for e in range(member, step.constraints.count[i], team):
            rolled()
            d = displacement_of(
                step.instances,
                step.basis,
                step.constraints,
                step.motion.q_start,
                step.arrays.q,
                step.rigid.r,
                i,
                e,
            )
            way = step.constraints.displacement[i, e] - d
            for k in range(count):
                rolled()
                energy, force = constraint_at(
                    step.instances, step.constraints, step.options.stick_range, d + lengths[k] * way, i, e
                )
                if k < LANES - 1:
                    sums[k / 3, k % 3] = sums[k / 3, k % 3] - wp.dot(force, way)
                if k == 0:
                    sums[2, 1] = sums[2, 1] + energy
                if k == LANES - 1:
                    sums[2, 2] = sums[2, 2] + energy
    sums = team_sum33(sums)
    if member != 0:
        return
    # of the potential without the constraints: its slope at the start, and half of its second derivative
    fall = step.state.slope[w]
    steepness = fall - sums[0, 0]
    bend = trial - sums[2, 2] - step.state.potential[w] + sums[2, 1] - steepness
    low = wp.float64(0.0)
    high = wp.float64(0.0)
    for k in range(1, count - 1):
        rolled()
        if high == wp.float64(0.0):
            alpha = lengths[k]
            rise = sums[k / 3, k % 3] + steepness + wp.float64(2.0) * alpha * bend
            if rise < wp.float64(0.0):
                low = alpha
                fall = rise
            else:
                high = low + (alpha - low) * fall / (fall - rise)
    if high == wp.float64(0.0):
        high = wp.float64(0.5) * (low + wp.float64(1.0))
    if high > step.options.step_length_min and high < wp.float64(1.0):
        step.state.step_length[w] = high
