"""Device side of the line search where a full step goes too far: the length at which contact and friction stop it.

Friction gives way and contact sets in at corners of the potential, which halving the step would have to find by trial:
each trial evaluates the whole body, and the worlds that need most of them decide when a step of all worlds ends. But
the law of a contact along the step is known. So the step goes to the minimum of the contacts' energy, at their
displacements between both ends, and a parabola for all else, which has the value and the slope of the potential at the
start and its value at the end.
"""

import warp as wp

from softmode.deformables.contact.penalty_kernels import contact_potential, slip_potential
from softmode.deformables.model.lane_kernels import rolled, team_sum3
from softmode.deformables.model.struct_kernels import Instances, PointConstraints, instance_end
from softmode.deformables.solver.iteration_kernels import NewtonStep
from softmode.deformables.solver.step_kernels import displacement_of, pair_share

wp.set_module_options({"enable_backward": False})

HALVED = wp.constant(wp.float64(0.5))
"""What ``check_trial`` makes of a full step that it refuses."""
BISECTIONS = 8
"""Bisections of the step, after which its length is known to a five-hundredth."""


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
    steepness = step.state.slope[w]
    bend = trial - step.state.potential[w] - steepness
    alpha = wp.float64(0.0)
    low = wp.float64(0.0)
    high = wp.float64(1.0)
    # one copy of this code serves the start of the step, its end, and the lengths between
    for k in range(BISECTIONS + 2):
        rolled()
        sums = wp.vec3d()
        for i in range(begin, end):
            rolled()
            for e in range(member, step.constraints.count[i], team):
                rolled()
                if k == 0:
                    # room for it until the shorter step is evaluated
                    step.constraints.slip[i, e] = displacement_of(
                        step.instances,
                        step.basis,
                        step.constraints,
                        step.motion.q_start,
                        step.arrays.q,
                        step.rigid.r,
                        i,
                        e,
                    )
                d = step.constraints.slip[i, e]
                way = step.constraints.displacement[i, e] - d
                energy, force = constraint_at(
                    step.instances, step.constraints, step.options.stick_range, d + alpha * way, i, e
                )
                sums += wp.vec3d(energy, -wp.dot(force, way), wp.float64(0.0))
        sums = team_sum3(sums)
        if k == 0:
            # of the potential without the constraints: its slope at the start, and half of its second derivative
            steepness -= sums[1]
            bend += sums[0] + sums[1]
            alpha = high
        else:
            if k == 1:
                bend -= sums[0]
            elif sums[1] + steepness + wp.float64(2.0) * alpha * bend < wp.float64(0.0):
                low = alpha
            else:
                high = alpha
            alpha = wp.float64(0.5) * (low + high)
    if member == 0 and wp.isfinite(bend):
        step.state.step_length[w] = alpha
