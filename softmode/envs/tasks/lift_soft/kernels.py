"""Device side of LiftSoft: goal, reward, success."""

import warp as wp

from softmode.envs.grasp_kernels import grasped

wp.set_module_options({"enable_backward": False})


@wp.kernel
def observe(
    parameters: wp.array2d[float],
    goal_parameter: int,
    object_position: wp.array2d[wp.vec3],
    height: float,  # of the unscaled object's centre at rest [m]
    scale_parameter: int,
    goal_column: int,
    # Out:
    observation: wp.array2d[float],
    metrics: wp.array2d[float],
    marker_place: wp.array[wp.transform],
):
    """Write the goal, relative to the object and as a position, the rise and the distance."""
    w = wp.tid()
    rest_height = height * parameters[w, scale_parameter]
    goal = wp.vec3(
        parameters[w, goal_parameter],
        parameters[w, goal_parameter + 1],
        rest_height + parameters[w, goal_parameter + 2],
    )
    x = object_position[w, 0]
    for k in range(3):
        observation[w, goal_column + k] = goal[k]
    metrics[w, 0] = x[2] - rest_height
    metrics[w, 1] = wp.length(goal - x)
    marker_place[w] = wp.transform(goal, wp.quat_identity())


@wp.kernel
def evaluate(
    parameters: wp.array2d[float],
    goal_parameter: int,
    object_position: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    finger_force: wp.array2d[wp.vec3],
    metrics: wp.array2d[float],  # rise, distance to the goal [m]
    tolerance: float,  # [m]
    hold_steps: int,
    # In, out:
    held: wp.array[int],
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
):
    """Reward reaching, grasping, lifting, nearing the goal, and staying there."""
    w = wp.tid()
    offset = object_position[w, 0] - wp.transform_get_translation(tool_pose[w])
    held_by_both = grasped(finger_force, w)
    grasp = float(0.0)
    if held_by_both:
        grasp = 1.0
    rise = metrics[w, 0]
    distance = metrics[w, 1]
    there = held_by_both and distance <= tolerance
    steps = int(0)
    if there:
        steps = held[w] + 1
    held[w] = steps
    lifted = wp.clamp(rise / wp.max(parameters[w, goal_parameter + 2], 1.0e-3), 0.0, 1.0)
    terms[w, 0] = 1.0 - wp.tanh(6.0 * wp.length(offset))
    terms[w, 1] = 0.5 * grasp
    terms[w, 2] = 1.0 * lifted * grasp
    terms[w, 3] = 2.0 * lifted * grasp * (1.0 - wp.tanh(10.0 * distance))
    terms[w, 4] = wp.where(there, 2.0, 0.0)
    success[w] = steps >= hold_steps
