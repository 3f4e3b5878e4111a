"""Device side of PushSoft: goal, yaw, reward, success."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def observe(
    parameters: wp.array2d[float],
    position_parameter: int,
    yaw_parameter: int,
    scale_parameter: int,
    goal_parameter: int,  # distance [m] and direction [rad] from the object's first place
    goal_yaw_parameter: int,  # relative to its first yaw [rad]
    object_position: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    particle_start: wp.array[int],
    particle_q: wp.array[wp.vec3],
    points: wp.array[int],
    rest: wp.array[wp.vec3],  # of these points, relative to the centre of mass [m]
    stride: int,  # soft objects per world
    push_distance: float,  # from the unscaled object's centre to the tool behind it [m]
    push_height: float,  # [m]
    height: float,  # of the unscaled object's centre at rest [m]
    goal_column: int,
    object_column: int,
    # Out:
    observation: wp.array2d[float],
    metrics: wp.array2d[float],
    marker_place: wp.array[wp.transform],
):
    """Write the goal, the ways of object and tool, distance and error of yaw."""
    w = wp.tid()
    reach = parameters[w, goal_parameter]
    direction = parameters[w, goal_parameter + 1]
    goal = wp.vec2(
        parameters[w, position_parameter] + reach * wp.cos(direction),
        parameters[w, position_parameter + 1] + reach * wp.sin(direction),
    )
    yaw = parameters[w, yaw_parameter] + parameters[w, goal_yaw_parameter]
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    x = object_position[w, 0]
    # the rotation about z from the goal's heading to the object's: least squares over the points
    along = float(0.0)
    across = float(0.0)
    start = particle_start[w * stride]
    for i in range(points.shape[0]):
        a = wp.vec2(c * rest[i][0] - s * rest[i][1], s * rest[i][0] + c * rest[i][1])
        b = particle_q[start + points[i]] - x
        along += a[0] * b[0] + a[1] * b[1]
        across += a[0] * b[1] - a[1] * b[0]
    length = wp.max(wp.sqrt(along * along + across * across), 1.0e-12)
    tool = wp.transform_get_translation(tool_pose[w])
    way = goal - wp.vec2(x[0], x[1])
    distance = wp.length(way)
    towards = way / wp.max(distance, 1.0e-6)
    back = push_distance * parameters[w, scale_parameter]
    for k in range(2):
        observation[w, goal_column + k] = goal[k]
        observation[w, goal_column + 4 + k] = goal[k] - tool[k]
        observation[w, object_column + k] = way[k]
        observation[w, object_column + 4 + k] = x[k] - back * towards[k] - tool[k]
    observation[w, goal_column + 2] = c
    observation[w, goal_column + 3] = s
    observation[w, object_column + 2] = along / length
    observation[w, object_column + 3] = across / length
    observation[w, object_column + 6] = push_height - tool[2]
    metrics[w, 0] = distance
    metrics[w, 1] = wp.abs(wp.atan2(across, along))
    marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw))


@wp.kernel
def evaluate(
    metrics: wp.array2d[float],  # distance to the goal [m], error of yaw [rad]
    observation: wp.array2d[float],
    push_column: int,
    object_velocity: wp.array2d[wp.vec3],
    tolerance: float,  # [m]
    yaw_tolerance: float,  # [rad], negative where yaw does not matter
    rest_speed: float,  # [m/s]
    hold_steps: int,
    stride_length: float,  # longest tool step [m]
    # In, out:
    held: wp.array[int],
    before: wp.array[float],  # distance one step earlier [m], negative in the first step
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
):
    """Reward getting behind the object, moving it to the goal, and leaving it there."""
    w = wp.tid()
    distance = metrics[w, 0]
    yaw_error = metrics[w, 1]
    push = wp.vec3(observation[w, push_column], observation[w, push_column + 1], observation[w, push_column + 2])
    there = distance <= tolerance
    nearness = 1.0 - wp.tanh(10.0 * distance)
    if yaw_tolerance >= 0.0:
        there = there and yaw_error <= yaw_tolerance
        nearness = nearness * (0.5 + 0.5 * wp.cos(yaw_error))
    reach = 1.0 - wp.tanh(8.0 * wp.length(push))
    if there:
        reach = 1.0
    resting = there and wp.length(object_velocity[w, 0]) <= rest_speed
    steps = int(0)
    if resting:
        steps = held[w] + 1
    held[w] = steps
    progress = float(0.0)
    if before[w] >= 0.0:
        progress = wp.clamp((before[w] - distance) / stride_length, -1.0, 1.0)
    before[w] = distance
    terms[w, 0] = 0.5 * reach
    terms[w, 1] = progress
    terms[w, 2] = nearness
    terms[w, 3] = wp.where(resting, 2.0, 0.0)
    success[w] = steps >= hold_steps


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
