"""Device side of ShapeSoft: target shapes, error, reward, success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, surface_point, write
from softmode.mpm.spline_kernels import spline_at

wp.set_module_options({"enable_backward": False})

LOG_MASS_SCALE = wp.constant(0.1)
"""Mass of a node that the logarithm compares with, over the mass of a point."""
TURN = wp.constant(6.283185307179586)
Term = IntEnum("Term", "shape there", start=0)
Metric = IntEnum("Metric", "shape_error", start=0)


@wp.struct
class Target:
    """Recorded presses along y; see `targets.ShapeTargets`."""

    points: wp.array4d[wp.vec3]  # (choices, directions, levels, points) [m]
    displacement_max: wp.array[float]  # of the last level [m], (choices,)
    choice: wp.array[int]  # whose press the target of a world is, (world_count,)


@wp.struct
class Rules:
    """What the reward depends on beside the goals."""

    point_count: int
    sparse: int
    reward_length: float  # [m], or relative for masses
    goal_tolerance: float  # likewise
    log_mass_spacing: float  # of the grid [m]; 0 compares point by point
    hold_steps: int


@wp.struct
class Plan:
    """Columns, the recorded press, and what the reward depends on."""

    drawn_position: int
    drawn_yaw: int
    drawn_goal: int  # displacement [m] and direction [rad]
    column_desired_goal: int
    column_achieved_goal: int
    target: Target
    rules: Rules


@wp.func
def target_point(state: WorldState, plan: Plan, w: int, i: int):
    """Return a point of the target shape: the press that was recorded, turned about the vertical.

    A post at yaw psi that is pressed in direction alpha + 90 degrees: R(alpha) x(R(psi - alpha) X), x the press.
    """
    b = plan.target.choice[w]
    directions = plan.target.points.shape[1]
    levels = plan.target.points.shape[2]
    alpha = state.parameters[w, plan.drawn_goal + 1] - 0.25 * TURN
    turns = (state.parameters[w, plan.drawn_yaw] - alpha) / TURN
    at = (turns - wp.floor(turns)) * float(directions)
    j = wp.min(int(at), directions - 1)
    u = at - float(j)
    displacement = state.parameters[w, plan.drawn_goal] / plan.target.displacement_max[b]
    depth = wp.clamp(displacement, 0.0, 1.0) * float(levels - 1)
    k = wp.min(int(depth), levels - 2)
    v = depth - float(k)
    m = (j + 1) % directions
    near = (1.0 - v) * plan.target.points[b, j, k, i] + v * plan.target.points[b, j, k + 1, i]
    far = (1.0 - v) * plan.target.points[b, m, k, i] + v * plan.target.points[b, m, k + 1, i]
    x = (1.0 - u) * near + u * far
    c = wp.cos(alpha)
    s = wp.sin(alpha)
    return wp.vec3(c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])


@wp.func
def foot_position(state: WorldState, plan: Plan, w: int):
    """Return the middle of the foot, on the table [m]."""
    return wp.vec3(state.parameters[w, plan.drawn_position], state.parameters[w, plan.drawn_position + 1], 0.0)


@wp.func
def shape_error(
    achieved: wp.array2d[float],
    achieved_column: int,
    desired: wp.array2d[float],
    desired_column: int,
    point_count: int,
    w: int,
):
    """Return the root mean square distance of the points from those of the target [m]."""
    total = float(0.0)
    for k in range(3 * point_count):
        d = achieved[w, achieved_column + k] - desired[w, desired_column + k]
        total += d * d
    return wp.sqrt(total / float(point_count))


@wp.func
def place_of(goal: wp.array2d[float], column: int, p: int, w: int, spacing: float):
    """Return a point in cells of the grid."""
    return wp.vec3(goal[w, column + 3 * p], goal[w, column + 3 * p + 1], goal[w, column + 3 * p + 2]) / spacing


@wp.func
def log_mass_error(
    achieved: wp.array2d[float],
    achieved_column: int,
    desired: wp.array2d[float],
    desired_column: int,
    rules: Rules,
    w: int,
):
    """Return sqrt(L / L_0), L the loss of :class:`softmode.mpm.MassLoss` and L_0 that without any achieved point.

    Every point is one unit of mass. The nodes are those around the points, each taken once: its part is divided by the
    number of points that reach it. There is no grid to allocate, and the bits do not depend on the order of threads.
    """
    count = rules.point_count
    total = float(0.0)
    alone = float(0.0)
    for p in range(2 * count):
        at = place_of(achieved, achieved_column, p, w, rules.log_mass_spacing)
        if p >= count:
            at = place_of(desired, desired_column, p - count, w, rules.log_mass_spacing)
        low = wp.vec3(wp.floor(at[0]) - 1.0, wp.floor(at[1]) - 1.0, wp.floor(at[2]) - 1.0)
        for n in range(64):
            node = low + wp.vec3(float(n // 16), float(n // 4 % 4), float(n % 4))
            if spline_at(node - at) > 0.0:
                mass = float(0.0)
                goal = float(0.0)
                sharing = float(0.0)
                for q in range(count):
                    m = spline_at(node - place_of(achieved, achieved_column, q, w, rules.log_mass_spacing))
                    g = spline_at(node - place_of(desired, desired_column, q, w, rules.log_mass_spacing))
                    mass += m
                    goal += g
                    sharing += wp.where(m > 0.0, 1.0, 0.0) + wp.where(g > 0.0, 1.0, 0.0)
                r = wp.log((mass + LOG_MASS_SCALE) / (goal + LOG_MASS_SCALE))
                r0 = wp.log(goal / LOG_MASS_SCALE + 1.0)
                total += r * r / sharing
                alone += r0 * r0 / sharing
    return wp.sqrt(total / alone)


@wp.func
def goal_error(
    achieved: wp.array2d[float],
    achieved_column: int,
    desired: wp.array2d[float],
    desired_column: int,
    rules: Rules,
    w: int,
):
    """Return how far two shapes are apart: by points that correspond [m], or by masses."""
    if rules.log_mass_spacing > 0.0:
        return log_mass_error(achieved, achieved_column, desired, desired_column, rules, w)
    return shape_error(achieved, achieved_column, desired, desired_column, rules.point_count, w)


@wp.func
def reward_terms(error: float, rules: Rules):
    """Return the terms `shape` and `there` of an error."""
    there = float(0.0)
    if error <= rules.goal_tolerance:
        there = 1.0
    shape = 1.0 - wp.tanh(error / rules.reward_length)
    if rules.sparse != 0:
        shape = 0.0
        there = there - 1.0
    return wp.vec2(shape, there)


@wp.kernel
def observe_points(state: WorldState, plan: Plan, result: StepResult):
    """Write a point of the target shape and where it is now, relative to the foot on the table."""
    w, i = wp.tid()
    now = surface_point(state, w, i) - foot_position(state, plan, w)
    write(result.observation, w, plan.column_desired_goal + 3 * i, target_point(state, plan, w, i))
    write(result.observation, w, plan.column_achieved_goal + 3 * i, now)


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write the error."""
    w = wp.tid()
    seen = result.observation
    error = goal_error(seen, plan.column_achieved_goal, seen, plan.column_desired_goal, plan.rules, w)
    result.metrics[w, Metric.shape_error] = error


@wp.kernel
def shape_marker(
    state: WorldState,
    plan: Plan,
    first: int,  # of the marker's points in the table
    # Out:
    marker_points: wp.array2d[wp.vec3],
    result: StepResult,
):
    """Bend the marker into the target shape."""
    w, i = wp.tid()
    marker_points[w, i] = target_point(state, plan, w, first + i)
    if i == 0:
        result.marker_place[w] = wp.transform(foot_position(state, plan, w), wp.quat_identity())


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward nearness to the target shape, and being there."""
    w = wp.tid()
    seen = result.observation  # bounded by now, as the goals are that learners compute rewards from
    error = goal_error(seen, plan.column_achieved_goal, seen, plan.column_desired_goal, plan.rules, w)
    pair = reward_terms(error, plan.rules)
    result.terms[w, Term.shape] = pair[0]
    result.terms[w, Term.there] = pair[1]
    count_held(error <= plan.rules.goal_tolerance, plan.rules.hold_steps, result, w)


@wp.kernel
def compute_reward(
    achieved: wp.array2d[float],
    desired: wp.array2d[float],
    rules: Rules,
    # Out:
    reward: wp.array[float],
):
    """Compute the reward of any pairs of goals as `evaluate` and the step's sum do."""
    n = wp.tid()
    pair = reward_terms(goal_error(achieved, 0, desired, 0, rules, n), rules)
    reward[n] = pair[0] + pair[1]
