"""Device side of ShapeSoft: target shapes, error, reward, success."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TURN = wp.constant(6.283185307179586)


@wp.func
def target_point(
    parameters: wp.array2d[float],
    yaw_parameter: int,
    goal_parameter: int,  # displacement [m] and direction [rad]
    press: wp.array3d[wp.vec3],  # along y: (directions, levels, points)
    displacement_max: float,  # of the last level [m]
    w: int,
    i: int,
):
    """Return a point of the target shape: the press that was recorded, turned about the vertical.

    A post at yaw psi that is pressed in direction alpha + 90 degrees: R(alpha) x(R(psi - alpha) X), x the press.
    """
    directions = press.shape[0]
    levels = press.shape[1]
    alpha = parameters[w, goal_parameter + 1] - 0.25 * TURN
    turns = (parameters[w, yaw_parameter] - alpha) / TURN
    at = (turns - wp.floor(turns)) * float(directions)
    j = wp.min(int(at), directions - 1)
    u = at - float(j)
    depth = wp.clamp(parameters[w, goal_parameter] / displacement_max, 0.0, 1.0) * float(levels - 1)
    k = wp.min(int(depth), levels - 2)
    v = depth - float(k)
    m = (j + 1) % directions
    near = (1.0 - v) * press[j, k, i] + v * press[j, k + 1, i]
    far = (1.0 - v) * press[m, k, i] + v * press[m, k + 1, i]
    x = (1.0 - u) * near + u * far
    c = wp.cos(alpha)
    s = wp.sin(alpha)
    return wp.vec3(c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])


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
def reward_terms(
    error: float,  # [m]
    sparse: int,
    length: float,  # [m]
    tolerance: float,  # [m]
):
    """Return the terms `shape` and `there`."""
    there = float(0.0)
    if error <= tolerance:
        there = 1.0
    shape = 1.0 - wp.tanh(error / length)
    if sparse != 0:
        shape = 0.0
        there = there - 1.0
    return wp.vec2(shape, there)


@wp.kernel
def observe_points(
    parameters: wp.array2d[float],
    position_parameter: int,
    yaw_parameter: int,
    goal_parameter: int,
    press: wp.array3d[wp.vec3],
    displacement_max: float,
    particle_start: wp.array[int],
    particle_q: wp.array[wp.vec3],
    points: wp.array[int],
    stride: int,  # soft objects per world
    desired_column: int,
    achieved_column: int,
    # Out:
    observation: wp.array2d[float],
):
    """Write a point of the target shape and where it is now, relative to the foot on the table."""
    w, i = wp.tid()
    x = target_point(parameters, yaw_parameter, goal_parameter, press, displacement_max, w, i)
    foot = wp.vec3(parameters[w, position_parameter], parameters[w, position_parameter + 1], 0.0)
    now = particle_q[particle_start[w * stride] + points[i]] - foot
    for a in range(3):
        observation[w, desired_column + 3 * i + a] = x[a]
        observation[w, achieved_column + 3 * i + a] = now[a]


@wp.kernel
def observe(
    desired_column: int,
    achieved_column: int,
    point_count: int,
    arm_column: int,
    arm_size: int,
    # In, out:
    observation: wp.array2d[float],
    # Out:
    metrics: wp.array2d[float],
):
    """Write the error, and proprioception once more."""
    w = wp.tid()
    for k in range(arm_size):
        observation[w, arm_column + k] = observation[w, k]
    metrics[w, 0] = shape_error(observation, achieved_column, observation, desired_column, point_count, w)


@wp.kernel
def shape_marker(
    parameters: wp.array2d[float],
    position_parameter: int,
    yaw_parameter: int,
    goal_parameter: int,
    press: wp.array3d[wp.vec3],
    displacement_max: float,
    first: int,  # of the marker's points in the table
    # Out:
    marker_points: wp.array2d[wp.vec3],
    marker_place: wp.array[wp.transform],
):
    """Bend the marker into the target shape."""
    w, i = wp.tid()
    marker_points[w, i] = target_point(parameters, yaw_parameter, goal_parameter, press, displacement_max, w, first + i)
    if i == 0:
        foot = wp.vec3(parameters[w, position_parameter], parameters[w, position_parameter + 1], 0.0)
        marker_place[w] = wp.transform(foot, wp.quat_identity())


@wp.kernel
def evaluate(
    observation: wp.array2d[float],
    achieved_column: int,
    desired_column: int,
    point_count: int,
    sparse: int,
    length: float,
    tolerance: float,
    hold_steps: int,
    # In, out:
    held: wp.array[int],
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
):
    """Reward nearness to the target shape, and being there."""
    w = wp.tid()
    error = shape_error(observation, achieved_column, observation, desired_column, point_count, w)
    pair = reward_terms(error, sparse, length, tolerance)
    terms[w, 0] = pair[0]
    terms[w, 1] = pair[1]
    steps = int(0)
    if error <= tolerance:
        steps = held[w] + 1
    held[w] = steps
    success[w] = steps >= hold_steps


@wp.kernel
def compute_reward(
    achieved: wp.array2d[float],
    desired: wp.array2d[float],
    point_count: int,
    sparse: int,
    length: float,
    tolerance: float,
    # Out:
    reward: wp.array[float],
):
    """Compute the reward of any pairs of goals as `evaluate` and the step's sum do."""
    n = wp.tid()
    pair = reward_terms(shape_error(achieved, 0, desired, 0, point_count, n), sparse, length, tolerance)
    reward[n] = pair[0] + pair[1]
