"""Device side of PressSoft: contact force, reward, success."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def goal_band(goal: float, share: float, least: float):
    """Return how far the force may be from the goal [N]."""
    return wp.max(share * goal, least)


@wp.kernel
def observe(
    parameters: wp.array2d[float],
    goal_parameter: int,
    scale_parameter: int,
    object_position: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    finger_force: wp.array2d[wp.vec3],
    top: float,  # height of the unscaled pad [m]
    tip_length: float,  # from the tool point down to the finger tips [m]
    gauge: float,  # height of the marker per newton that is missing [m/N]
    goal_column: int,
    # Out:
    observation: wp.array2d[float],
    metrics: wp.array2d[float],
    marker_place: wp.array[wp.transform],
):
    """Write goal force, contact force and their difference; the metrics; and the marker over the pad."""
    w = wp.tid()
    goal = parameters[w, goal_parameter]
    surface = top * parameters[w, scale_parameter]
    p = wp.transform_get_translation(tool_pose[w])
    x = object_position[w, 0]
    # vertical: what the fingers squeeze each other with adds nothing
    force = finger_force[w, 0][2] + finger_force[w, 1][2]
    observation[w, goal_column] = goal
    observation[w, goal_column + 1] = force
    observation[w, goal_column + 2] = goal - force
    metrics[w, 0] = force
    metrics[w, 1] = force - goal
    metrics[w, 2] = surface - (p[2] - tip_length)
    metrics[w, 3] = wp.sqrt((x[0] - p[0]) * (x[0] - p[0]) + (x[1] - p[1]) * (x[1] - p[1]))
    missing = wp.clamp(goal - force, 0.0, goal)
    marker_place[w] = wp.transform(wp.vec3(x[0] + 0.05, x[1] + 0.05, surface + gauge * missing), wp.quat_identity())


@wp.kernel
def evaluate(
    parameters: wp.array2d[float],
    goal_parameter: int,
    metrics: wp.array2d[float],  # force, error [N], indentation, distance from the pad's axis [m]
    share: float,
    least: float,  # [N]
    radius: float,  # [m]
    hold_steps: int,
    # In, out:
    held: wp.array[int],
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
):
    """Reward reaching the middle of the pad, the right force, and keeping it; punish far too much."""
    w = wp.tid()
    goal = parameters[w, goal_parameter]
    force = metrics[w, 0]
    error = wp.abs(metrics[w, 1])
    gap = wp.max(-metrics[w, 2], 0.0)
    aside = wp.max(metrics[w, 3] - 0.5 * radius, 0.0)
    central = metrics[w, 3] <= radius
    there = central and error <= goal_band(goal, share, least)
    steps = int(0)
    if there:
        steps = held[w] + 1
    held[w] = steps
    reach = 1.0 - wp.tanh(25.0 * wp.sqrt(gap * gap + aside * aside))
    # from no force on there is a slope towards the goal, steepest at the goal
    match = wp.max(1.0 - wp.tanh(1.5 * error / goal) / wp.tanh(1.5), 0.0)
    terms[w, 0] = reach
    terms[w, 1] = 1.5 * reach * match
    terms[w, 2] = wp.where(there, 2.0, 0.0)
    terms[w, 3] = -wp.clamp((force - 1.3 * goal) / goal, 0.0, 1.0)
    success[w] = steps >= hold_steps
