"""Device side of PlaceInBin: the bin as seen from tool and objects, reward, success, spills."""

import warp as wp

from softmode.envs.grasp_kernels import grasped, touched

wp.set_module_options({"enable_backward": False})

SPILLED = wp.constant(4)


@wp.func
def beyond(x: wp.vec3, centre: wp.vec3, half: wp.vec2):
    """Return the horizontal distance of a point from a rectangle, 0 inside [m]."""
    dx = wp.max(wp.abs(x[0] - centre[0]) - half[0], 0.0)
    dy = wp.max(wp.abs(x[1] - centre[1]) - half[1], 0.0)
    return wp.sqrt(dx * dx + dy * dy)


@wp.kernel
def observe(
    rim: wp.vec3,  # centre of the bin's opening [m]
    half: wp.vec2,  # half of its inner edges [m]
    highest: float,  # height of the centre of what counts as inside [m]
    object_position: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    goal_column: int,
    object_column: int,
    # Out:
    observation: wp.array2d[float],
    metrics: wp.array2d[float],
):
    """Write the ways to the bin and to the other objects, the distance, and how many of these are inside."""
    w = wp.tid()
    tool = wp.transform_get_translation(tool_pose[w])
    x = object_position[w, 0]
    for k in range(3):
        observation[w, goal_column + k] = rim[k]
        observation[w, goal_column + 3 + k] = rim[k] - tool[k]
        observation[w, object_column + k] = rim[k] - x[k]
    inside = float(0.0)
    for o in range(1, object_position.shape[1]):
        other = object_position[w, o]
        if beyond(other, rim, half) == 0.0 and other[2] <= highest:
            inside += 1.0
        for k in range(3):
            observation[w, object_column + 3 * o + k] = other[k] - x[k]
    metrics[w, 0] = x[2]
    metrics[w, 1] = beyond(x, rim, half)
    metrics[w, 2] = inside


@wp.kernel
def evaluate(
    parameters: wp.array2d[float],
    scale_parameter: int,
    rim: wp.vec3,  # [m]
    half: wp.vec2,  # [m]
    margin: float,  # of the part of the bin over which to lower the object, from its walls [m]
    wall: float,  # thickness of the walls [m]
    floor: float,  # height of the bin's floor [m]
    highest: float,  # height of the centre of what counts as inside [m]
    height: float,  # of the unscaled object's centre at rest [m]
    radius: float,  # from there to the farthest point [m]
    clearance: float,  # over the rim while carrying [m]
    rest_speed: float,  # [m/s]
    hold_steps: int,
    object_position: wp.array2d[wp.vec3],
    object_velocity: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    finger_force: wp.array2d[wp.vec3],
    metrics: wp.array2d[float],  # height, distance from the bin [m], other objects inside
    # In, out:
    held: wp.array[int],
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
    failure: wp.array[int],
):
    """Reward grasping, lifting, carrying, lowering, letting go and leaving the object at rest."""
    w = wp.tid()
    x = object_position[w, 0]
    size = parameters[w, scale_parameter]
    distance = wp.length(x - wp.transform_get_translation(tool_pose[w]))
    inside = metrics[w, 1] == 0.0 and x[2] <= highest
    # fingers may feel another object: only near the first one they hold that one
    grip = grasped(finger_force, w) and distance < size * radius + 0.02
    low = height * size
    carried = rim[2] + low + clearance
    aside = beyond(x, rim, half - wp.vec2(margin, margin))
    held_or_in = wp.where(grip or inside, 1.0, 0.0)
    lift = wp.clamp((x[2] - low) / (carried - low), 0.0, 1.0)
    lowered = float(0.0)
    if aside == 0.0:
        lift = 1.0
        lowered = wp.clamp((carried - x[2]) / (carried - low - floor), 0.0, 1.0)
    near = 1.0 - wp.tanh(6.0 * aside)
    reach = 1.0 - wp.tanh(5.0 * distance)
    if inside:
        reach = 1.0
        lift = 1.0
        near = 1.0
    free = inside and not touched(finger_force, w)
    complete = int(metrics[w, 2]) == object_position.shape[1] - 1
    resting = free and complete and wp.length(object_velocity[w, 0]) <= rest_speed
    steps = int(0)
    if resting:
        steps = held[w] + 1
    held[w] = steps
    terms[w, 0] = reach
    terms[w, 1] = 0.5 * held_or_in
    terms[w, 2] = lift * held_or_in
    terms[w, 3] = lift * near * held_or_in
    terms[w, 4] = lowered * held_or_in
    terms[w, 5] = wp.where(free, 1.0, 0.0)
    terms[w, 6] = wp.where(resting, 2.0, 0.0)
    success[w] = steps >= hold_steps
    for o in range(1, object_position.shape[1]):
        if not (beyond(object_position[w, o], rim, half + wp.vec2(wall, wall)) == 0.0):
            failure[w] = SPILLED
