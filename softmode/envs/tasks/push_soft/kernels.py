"""Device side of PushSoft: goal, yaw, reward, success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, surface_point, tool_position, write

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach progress goal rest", start=0)
Metric = IntEnum("Metric", "goal_distance yaw_error", start=0)


@wp.struct
class Plan:
    """Columns, where the tool pushes, and when the goal is met."""

    drawn_position: int
    drawn_yaw: int
    drawn_scale: int
    drawn_goal: int  # distance [m] and direction [rad] from the object's first place
    drawn_goal_yaw: int  # relative to its first yaw [rad]
    column_goal: int
    column_goal_heading: int
    column_goal_offset: int
    column_object_goal: int
    column_object_heading: int
    column_push_offset: int
    rest: wp.array2d[wp.vec3]  # of the observed points, relative to the centre of mass [m], (world_count, points)
    before: wp.array[float]  # distance one step earlier [m], negative in the first step
    push_distances: wp.array[float]  # from the unscaled object's centre to the tool behind it [m]
    push_height: float  # [m]
    goal_tolerance: float  # [m]
    yaw_tolerance: float  # [rad], negative where yaw does not matter
    rest_speed: float  # [m/s]
    hold_steps: int
    translation_scale: float  # longest tool step [m]


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write the goal, the ways of object and tool, distance and error of yaw."""
    w = wp.tid()
    reach = state.parameters[w, plan.drawn_goal]
    direction = state.parameters[w, plan.drawn_goal + 1]
    goal = wp.vec2(
        state.parameters[w, plan.drawn_position] + reach * wp.cos(direction),
        state.parameters[w, plan.drawn_position + 1] + reach * wp.sin(direction),
    )
    yaw = state.parameters[w, plan.drawn_yaw] + state.parameters[w, plan.drawn_goal_yaw]
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    x = state.object_position[w, 0]
    # the rotation about z from the goal's heading to the object's: least squares over the points
    along = float(0.0)
    across = float(0.0)
    for i in range(plan.rest.shape[1]):
        r = plan.rest[w, i]
        a = wp.vec2(c * r[0] - s * r[1], s * r[0] + c * r[1])
        b = surface_point(state, w, i) - x
        along += a[0] * b[0] + a[1] * b[1]
        across += a[0] * b[1] - a[1] * b[0]
    length = wp.max(wp.sqrt(along * along + across * across), 1.0e-12)
    tool = tool_position(state, w)
    way = goal - wp.vec2(x[0], x[1])
    distance = wp.length(way)
    towards = way / wp.max(distance, 1.0e-6)
    back = plan.push_distances[w] * state.parameters[w, plan.drawn_scale]
    push = wp.vec3(x[0] - back * towards[0], x[1] - back * towards[1], plan.push_height)
    write(result.observation, w, plan.column_goal, goal)
    write(result.observation, w, plan.column_goal_heading, wp.vec2(c, s))
    write(result.observation, w, plan.column_goal_offset, goal - wp.vec2(tool[0], tool[1]))
    write(result.observation, w, plan.column_object_goal, way)
    write(result.observation, w, plan.column_object_heading, wp.vec2(along / length, across / length))
    write(result.observation, w, plan.column_push_offset, push - tool)
    result.metrics[w, Metric.goal_distance] = distance
    result.metrics[w, Metric.yaw_error] = wp.abs(wp.atan2(across, along))
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    result.marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], 0.0), turn)


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward getting behind the object, moving it to the goal, and leaving it there."""
    w = wp.tid()
    distance = result.metrics[w, Metric.goal_distance]
    yaw_error = result.metrics[w, Metric.yaw_error]
    p = plan.column_push_offset
    push = wp.vec3(result.observation[w, p], result.observation[w, p + 1], result.observation[w, p + 2])
    there = distance <= plan.goal_tolerance
    nearness = 1.0 - wp.tanh(10.0 * distance)
    if plan.yaw_tolerance >= 0.0:
        there = there and yaw_error <= plan.yaw_tolerance
        nearness = nearness * (0.5 + 0.5 * wp.cos(yaw_error))
    reach = 1.0 - wp.tanh(8.0 * wp.length(push))
    if there:
        reach = 1.0
    resting = there and wp.length(state.object_velocity[w, 0]) <= plan.rest_speed
    progress = float(0.0)
    if plan.before[w] >= 0.0:
        progress = wp.clamp((plan.before[w] - distance) / plan.translation_scale, -1.0, 1.0)
    plan.before[w] = distance
    result.terms[w, Term.reach] = 0.5 * reach
    result.terms[w, Term.progress] = progress
    result.terms[w, Term.goal] = nearness
    result.terms[w, Term.rest] = wp.where(resting, 2.0, 0.0)
    count_held(resting, plan.hold_steps, result, w)
