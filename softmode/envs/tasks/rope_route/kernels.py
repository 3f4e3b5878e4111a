"""Device side of RopeRoute: the rope's axis, its winding about the pegs, reward and success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, grasped, tool_position, write

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach grasp route goal hold", start=0)
Metric = IntEnum("Metric", "goal_distance least_winding highest_point grasp_distance", start=0)


@wp.struct
class Ropes:
    """Points on the axes of the ropes that worlds may have."""

    choice: wp.array[int]  # which rope each world has, (world_count,)
    rest: wp.array2d[wp.vec3d]  # (ropes, points) [m]
    basis: wp.array3d[wp.float64]  # there, (ropes, points, functions)
    function_count: wp.array[int]  # of each rope


@wp.struct
class Plan:
    """Columns, the rope's axis, the pegs, and when the goal is met."""

    drawn_route: int
    drawn_goal: int  # aside of the last peg, and beyond it [m]
    column_goal: int
    column_goal_offset: int
    column_side: int
    column_grasp_offset: int
    column_end_offset: int
    column_end_goal: int
    column_winding: int
    rest_height: wp.array[float]  # of the unscaled rope's axis [m], (world_count,)
    grasp_point: wp.array[int]  # index of the axis point to grasp, (world_count,)
    axis: wp.array2d[wp.vec3]  # from tail to end [m]
    peg_position: wp.array[wp.vec2]  # [m]
    peg_height: float  # of the lowest peg's top [m]
    winding: float  # that counts as passing a peg [rad]
    goal_tolerance: float  # [m]
    hold_steps: int


@wp.func
def peg_side(route: float, peg: int):
    """Return the side on which the rope is to pass a peg: +1 away from the robot, -1 towards it, alternating."""
    side = wp.where(route < 0.0, -1.0, 1.0)
    return wp.where(peg % 2 == 0, side, -side)


@wp.func
def rope_goal(state: WorldState, plan: Plan, world: int):
    """Return where the rope's end is to lie [m]: aside of the last peg, on the rope's side, and beyond it along y."""
    last = plan.peg_position.shape[0] - 1
    side = peg_side(state.parameters[world, plan.drawn_route], last)
    aside = side * state.parameters[world, plan.drawn_goal]
    return plan.peg_position[last] + wp.vec2(aside, state.parameters[world, plan.drawn_goal + 1])


@wp.func
def turn(a: wp.vec2, b: wp.vec2):
    """Return the signed angle from a to b [rad]."""
    return wp.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])


@wp.kernel
def trace_axis(
    state: WorldState,
    ropes: Ropes,
    # Out:
    axis: wp.array2d[wp.vec3],
):
    """Deform the points of the axis: x = X + sum_k b_k(X) q_k."""
    w, i = wp.tid()
    start = state.function_start[w]
    b = ropes.choice[w]
    x = ropes.rest[b, i]
    for k in range(ropes.function_count[b]):
        x += ropes.basis[b, i, k] * state.q[start + k]
    axis[w, i] = wp.vec3(x)


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write goal and sides; the rope's end, what there is to grasp, and the winding; the metrics and the marker."""
    w = wp.tid()
    tool = tool_position(state, w)
    goal = rope_goal(state, plan, w)
    points = plan.axis.shape[1]
    end = plan.axis[w, points - 1]
    grasp = plan.axis[w, plan.grasp_point[w]]
    write(result.observation, w, plan.column_goal, goal)
    write(result.observation, w, plan.column_goal_offset, goal - wp.vec2(tool[0], tool[1]))
    write(result.observation, w, plan.column_grasp_offset, grasp - tool)
    write(result.observation, w, plan.column_end_offset, end - grasp)
    write(result.observation, w, plan.column_end_goal, goal - wp.vec2(end[0], end[1]))
    least = float(1.0e9)
    for p in range(plan.peg_position.shape[0]):
        peg = plan.peg_position[p]
        angle = float(0.0)
        before = wp.vec2(plan.axis[w, 0][0], plan.axis[w, 0][1]) - peg
        for i in range(1, points):
            after = wp.vec2(plan.axis[w, i][0], plan.axis[w, i][1]) - peg
            angle += turn(before, after)
            before = after
        side = peg_side(state.parameters[w, plan.drawn_route], p)
        result.observation[w, plan.column_side + p] = side
        result.observation[w, plan.column_winding + p] = side * angle
        least = wp.min(least, side * angle)
    top = float(0.0)
    for i in range(points):
        top = wp.max(top, plan.axis[w, i][2])
    result.metrics[w, Metric.goal_distance] = wp.length(wp.vec2(end[0], end[1]) - goal)
    result.metrics[w, Metric.least_winding] = least
    result.metrics[w, Metric.highest_point] = top
    result.metrics[w, Metric.grasp_distance] = wp.length(grasp - tool)
    result.marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], plan.rest_height[w]), wp.quat_identity())


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward reaching, grasping, passing every peg on its side, nearing the goal, and being there."""
    w = wp.tid()
    near = result.metrics[w, Metric.grasp_distance]
    distance = result.metrics[w, Metric.goal_distance]
    pegs = plan.peg_position.shape[0]
    passed = float(0.0)
    for p in range(pegs):
        passed += wp.clamp(result.observation[w, plan.column_winding + p] / plan.winding, -1.0, 1.0) / float(pegs)
    low = result.metrics[w, Metric.highest_point] < plan.peg_height
    routed = low and result.metrics[w, Metric.least_winding] >= plan.winding
    there = routed and distance <= plan.goal_tolerance
    result.terms[w, Term.reach] = 1.0 - wp.tanh(10.0 * near)
    result.terms[w, Term.grasp] = wp.where(grasped(state, w) and near < 0.03, 0.5, 0.0)
    result.terms[w, Term.route] = 2.0 * passed
    result.terms[w, Term.goal] = (1.0 + wp.max(passed, 0.0)) * (1.0 - wp.tanh(5.0 * distance))
    result.terms[w, Term.hold] = wp.where(there, 2.0, 0.0)
    count_held(there, plan.hold_steps, result, w)
