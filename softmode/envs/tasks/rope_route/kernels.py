"""Device side of RopeRoute: the rope's axis, its winding about the pegs, reward and success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, grasped, tool_position
from softmode.envs.task_kernels import Placement

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach grasp route goal hold", start=0)
Metric = IntEnum("Metric", "goal_distance least_winding highest_point grasp_distance", start=0)


@wp.struct
class Drawn:
    """Columns of the parameters."""

    route: int
    goal: int  # aside of the last peg, and beyond it [m]


@wp.struct
class Columns:
    """Columns of the observation."""

    goal: int
    goal_offset: int
    side: int
    grasp_offset: int
    end_offset: int
    end_goal: int
    winding: int


@wp.struct
class Rope:
    """The rope's axis and the pegs."""

    half_length: float  # of the unscaled rope [m]
    height: float  # of the unscaled rope's axis [m]
    grasp_point: int  # index of the axis point to grasp
    axis: wp.array2d[wp.vec3]  # from tail to end [m]
    peg_position: wp.array[wp.vec2]  # [m]
    peg_height: float  # of the lowest peg's top [m]


@wp.struct
class Rules:
    """When the goal is met."""

    winding: float  # that counts as passing a peg [rad]
    goal_tolerance: float  # [m]
    hold_steps: int


@wp.func
def peg_side(route: float, peg: int):
    """Return the side on which the rope is to pass a peg: +1 away from the robot, -1 towards it, alternating."""
    side = wp.where(route < 0.0, -1.0, 1.0)
    return wp.where(peg % 2 == 0, side, -side)


@wp.func
def rope_goal(state: WorldState, drawn: Drawn, peg_position: wp.array[wp.vec2], world: int):
    """Return where the rope's end is to lie [m]: aside of the last peg, on the rope's side, and beyond it along y."""
    last = peg_position.shape[0] - 1
    side = peg_side(state.parameters[world, drawn.route], last)
    aside = side * state.parameters[world, drawn.goal]
    return peg_position[last] + wp.vec2(aside, state.parameters[world, drawn.goal + 1])


@wp.func
def turn(a: wp.vec2, b: wp.vec2):
    """Return the signed angle from a to b [rad]."""
    return wp.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])


@wp.kernel
def place_rope(
    world_mask: wp.array[wp.bool],
    state: WorldState,
    drawn: Placement,  # of the rope's end, with its yaw from the y axis
    rope: Rope,
    gap: float,  # [m]
    # Out:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Put the rope down along y, its end where the position says."""
    w = wp.tid()
    if not world_mask[w]:
        return
    scale = state.parameters[w, drawn.scale]
    yaw = 0.5 * wp.pi + state.parameters[w, drawn.yaw]
    x = state.parameters[w, drawn.position] - scale * rope.half_length * wp.cos(yaw)
    y = state.parameters[w, drawn.position + 1] - scale * rope.half_length * wp.sin(yaw)
    position_out[w] = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(rope.height * scale + gap))
    yaw_out[w] = wp.float64(yaw)


@wp.kernel
def trace_axis(
    state: WorldState,
    rest: wp.array[wp.vec3d],
    basis: wp.array2d[wp.float64],  # at the points of the axis, (points, functions)
    # Out:
    axis: wp.array2d[wp.vec3],
):
    """Deform the points of the axis: x = X + sum_k b_k(X) q_k."""
    w, i = wp.tid()
    start = state.function_start[w]
    x = rest[i]
    for k in range(basis.shape[1]):
        x += basis[i, k] * state.q[start + k]
    axis[w, i] = wp.vec3(x)


@wp.kernel
def observe(
    state: WorldState,
    drawn: Drawn,
    column: Columns,
    rope: Rope,
    # Out:
    result: StepResult,
):
    """Write goal and sides; the rope's end, what there is to grasp, and the winding; the metrics and the marker."""
    w = wp.tid()
    tool = tool_position(state, w)
    goal = rope_goal(state, drawn, rope.peg_position, w)
    points = rope.axis.shape[1]
    end = rope.axis[w, points - 1]
    grasp = rope.axis[w, rope.grasp_point]
    along = end - grasp
    for k in range(2):
        result.observation[w, column.goal + k] = goal[k]
        result.observation[w, column.goal_offset + k] = goal[k] - tool[k]
        result.observation[w, column.end_goal + k] = goal[k] - end[k]
    for k in range(3):
        result.observation[w, column.grasp_offset + k] = grasp[k] - tool[k]
        result.observation[w, column.end_offset + k] = along[k]
    least = float(1.0e9)
    for p in range(rope.peg_position.shape[0]):
        peg = rope.peg_position[p]
        angle = float(0.0)
        before = wp.vec2(rope.axis[w, 0][0], rope.axis[w, 0][1]) - peg
        for i in range(1, points):
            after = wp.vec2(rope.axis[w, i][0], rope.axis[w, i][1]) - peg
            angle += turn(before, after)
            before = after
        side = peg_side(state.parameters[w, drawn.route], p)
        result.observation[w, column.side + p] = side
        result.observation[w, column.winding + p] = side * angle
        least = wp.min(least, side * angle)
    top = float(0.0)
    for i in range(points):
        top = wp.max(top, rope.axis[w, i][2])
    result.metrics[w, Metric.goal_distance] = wp.length(wp.vec2(end[0], end[1]) - goal)
    result.metrics[w, Metric.least_winding] = least
    result.metrics[w, Metric.highest_point] = top
    result.metrics[w, Metric.grasp_distance] = wp.length(grasp - tool)
    result.marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], rope.height), wp.quat_identity())


@wp.kernel
def evaluate(
    state: WorldState,
    column: Columns,
    rope: Rope,
    rules: Rules,
    # In, out:
    result: StepResult,
):
    """Reward reaching, grasping, passing every peg on its side, nearing the goal, and being there."""
    w = wp.tid()
    near = result.metrics[w, Metric.grasp_distance]
    distance = result.metrics[w, Metric.goal_distance]
    pegs = rope.peg_position.shape[0]
    passed = float(0.0)
    for p in range(pegs):
        passed += wp.clamp(result.observation[w, column.winding + p] / rules.winding, -1.0, 1.0) / float(pegs)
    low = result.metrics[w, Metric.highest_point] < rope.peg_height
    routed = low and result.metrics[w, Metric.least_winding] >= rules.winding
    there = routed and distance <= rules.goal_tolerance
    result.terms[w, Term.reach] = 1.0 - wp.tanh(10.0 * near)
    result.terms[w, Term.grasp] = wp.where(grasped(state, w) and near < 0.03, 0.5, 0.0)
    result.terms[w, Term.route] = 2.0 * passed
    result.terms[w, Term.goal] = (1.0 + wp.max(passed, 0.0)) * (1.0 - wp.tanh(5.0 * distance))
    result.terms[w, Term.hold] = wp.where(there, 2.0, 0.0)
    count_held(there, rules.hold_steps, result, w)
