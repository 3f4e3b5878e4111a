"""Device side of PushSoft: goal, yaw, reward, success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, surface_point, tool_position

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach progress goal rest", start=0)
Metric = IntEnum("Metric", "goal_distance yaw_error", start=0)


@wp.struct
class Drawn:
    """Columns of the parameters."""

    position: int
    yaw: int
    scale: int
    goal: int  # distance [m] and direction [rad] from the object's first place
    goal_yaw: int  # relative to its first yaw [rad]


@wp.struct
class Columns:
    """Columns of the observation."""

    goal: int
    goal_heading: int
    goal_offset: int
    object_goal: int
    object_heading: int
    push_offset: int


@wp.struct
class Push:
    """Where the tool pushes."""

    push_distance: float  # from the unscaled object's centre to the tool behind it [m]
    push_height: float  # [m]


@wp.struct
class Rules:
    """When the goal is met."""

    goal_tolerance: float  # [m]
    yaw_tolerance: float  # [rad], negative where yaw does not matter
    rest_speed: float  # [m/s]
    hold_steps: int
    translation_scale: float  # longest tool step [m]


@wp.kernel
def observe(
    state: WorldState,
    drawn: Drawn,
    column: Columns,
    push: Push,
    rest: wp.array[wp.vec3],  # of the observed points, relative to the centre of mass [m]
    # Out:
    result: StepResult,
):
    """Write the goal, the ways of object and tool, distance and error of yaw."""
    w = wp.tid()
    reach = state.parameters[w, drawn.goal]
    direction = state.parameters[w, drawn.goal + 1]
    goal = wp.vec2(
        state.parameters[w, drawn.position] + reach * wp.cos(direction),
        state.parameters[w, drawn.position + 1] + reach * wp.sin(direction),
    )
    yaw = state.parameters[w, drawn.yaw] + state.parameters[w, drawn.goal_yaw]
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    x = state.object_position[w, 0]
    # the rotation about z from the goal's heading to the object's: least squares over the points
    along = float(0.0)
    across = float(0.0)
    for i in range(rest.shape[0]):
        a = wp.vec2(c * rest[i][0] - s * rest[i][1], s * rest[i][0] + c * rest[i][1])
        b = surface_point(state, w, i) - x
        along += a[0] * b[0] + a[1] * b[1]
        across += a[0] * b[1] - a[1] * b[0]
    length = wp.max(wp.sqrt(along * along + across * across), 1.0e-12)
    tool = tool_position(state, w)
    way = goal - wp.vec2(x[0], x[1])
    distance = wp.length(way)
    towards = way / wp.max(distance, 1.0e-6)
    back = push.push_distance * state.parameters[w, drawn.scale]
    for k in range(2):
        result.observation[w, column.goal + k] = goal[k]
        result.observation[w, column.goal_offset + k] = goal[k] - tool[k]
        result.observation[w, column.object_goal + k] = way[k]
        result.observation[w, column.push_offset + k] = x[k] - back * towards[k] - tool[k]
    result.observation[w, column.goal_heading] = c
    result.observation[w, column.goal_heading + 1] = s
    result.observation[w, column.object_heading] = along / length
    result.observation[w, column.object_heading + 1] = across / length
    result.observation[w, column.push_offset + 2] = push.push_height - tool[2]
    result.metrics[w, Metric.goal_distance] = distance
    result.metrics[w, Metric.yaw_error] = wp.abs(wp.atan2(across, along))
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    result.marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], 0.0), turn)


@wp.kernel
def evaluate(
    state: WorldState,
    column: Columns,
    rules: Rules,
    # In, out:
    result: StepResult,
    before: wp.array[float],  # distance one step earlier [m], negative in the first step
):
    """Reward getting behind the object, moving it to the goal, and leaving it there."""
    w = wp.tid()
    distance = result.metrics[w, Metric.goal_distance]
    yaw_error = result.metrics[w, Metric.yaw_error]
    p = column.push_offset
    push = wp.vec3(result.observation[w, p], result.observation[w, p + 1], result.observation[w, p + 2])
    there = distance <= rules.goal_tolerance
    nearness = 1.0 - wp.tanh(10.0 * distance)
    if rules.yaw_tolerance >= 0.0:
        there = there and yaw_error <= rules.yaw_tolerance
        nearness = nearness * (0.5 + 0.5 * wp.cos(yaw_error))
    reach = 1.0 - wp.tanh(8.0 * wp.length(push))
    if there:
        reach = 1.0
    resting = there and wp.length(state.object_velocity[w, 0]) <= rules.rest_speed
    progress = float(0.0)
    if before[w] >= 0.0:
        progress = wp.clamp((before[w] - distance) / rules.translation_scale, -1.0, 1.0)
    before[w] = distance
    result.terms[w, Term.reach] = 0.5 * reach
    result.terms[w, Term.progress] = progress
    result.terms[w, Term.goal] = nearness
    result.terms[w, Term.rest] = wp.where(resting, 2.0, 0.0)
    count_held(resting, rules.hold_steps, result, w)


@wp.kernel
def forget_distance(
    world_mask: wp.array[wp.bool],
    # Out:
    before: wp.array[float],
):
    """Forget where the object was."""
    w = wp.tid()
    if world_mask[w]:
        before[w] = -1.0
