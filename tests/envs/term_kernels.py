"""PushSoft and PressSoft as terms, and a few terms more, for the tests of tasks that are made of terms."""

import warp as wp

from softmode.envs.reward_kernels import WorldState

wp.set_module_options({"enable_backward": False})


@wp.kernel
def push_reach(
    metrics: wp.array2d[float],
    metric_goal_distance: int,
    goal_tolerance: float,
    observation: wp.array2d[float],
    column_push_offset: int,
    steepness: float,
    out: wp.array[float],
):
    """Reward being behind the object, or having it at the goal."""
    w = wp.tid()
    p = column_push_offset
    push = wp.vec3(observation[w, p], observation[w, p + 1], observation[w, p + 2])
    out[w] = 1.0 - wp.tanh(steepness * wp.length(push))
    if metrics[w, metric_goal_distance] <= goal_tolerance:
        out[w] = 1.0


@wp.kernel
def push_progress(
    metrics: wp.array2d[float],
    metric_goal_distance: int,
    translation_scale: float,
    memory: wp.array[float],  # distance one step earlier, negative in the first
    out: wp.array[float],
):
    """Reward the way that the object made."""
    w = wp.tid()
    distance = metrics[w, metric_goal_distance]
    out[w] = 0.0
    if memory[w] >= 0.0:
        out[w] = wp.clamp((memory[w] - distance) / translation_scale, -1.0, 1.0)
    memory[w] = distance


@wp.kernel
def push_goal(metrics: wp.array2d[float], metric_goal_distance: int, out: wp.array[float]):
    """Reward nearness to the goal."""
    w = wp.tid()
    out[w] = 1.0 - wp.tanh(10.0 * metrics[w, metric_goal_distance])


@wp.func
def resting(speed: float, distance: float, rest_speed: float, goal_tolerance: float):
    """Return whether the object rests at the goal."""
    return distance <= goal_tolerance and speed <= rest_speed


@wp.kernel
def push_rest(
    state: WorldState,
    metrics: wp.array2d[float],
    metric_goal_distance: int,
    rest_speed: float,
    goal_tolerance: float,
    out: wp.array[float],
):
    """Reward rest at the goal."""
    w = wp.tid()
    speed = wp.length(state.object_velocity[w, 0])
    out[w] = wp.where(resting(speed, metrics[w, metric_goal_distance], rest_speed, goal_tolerance), 1.0, 0.0)


@wp.kernel
def push_solved(
    state: WorldState,
    metrics: wp.array2d[float],
    metric_goal_distance: int,
    rest_speed: float,
    goal_tolerance: float,
    out: wp.array[wp.bool],
):
    """Say whether the object rests at the goal."""
    w = wp.tid()
    speed = wp.length(state.object_velocity[w, 0])
    out[w] = resting(speed, metrics[w, metric_goal_distance], rest_speed, goal_tolerance)


@wp.func
def press_near(metrics: wp.array2d[float], w: int, centre_tolerance: float):
    """Return nearness of the finger tips to the middle of the pad."""
    gap = wp.max(-metrics[w, 2], 0.0)
    aside = wp.max(metrics[w, 3] - 0.5 * centre_tolerance, 0.0)
    return 1.0 - wp.tanh(25.0 * wp.sqrt(gap * gap + aside * aside))


@wp.kernel
def press_reach(metrics: wp.array2d[float], centre_tolerance: float, out: wp.array[float]):
    """Reward being over the middle of the pad."""
    w = wp.tid()
    out[w] = press_near(metrics, w, centre_tolerance)


@wp.kernel
def press_force(
    metrics: wp.array2d[float],
    parameters: wp.array2d[float],
    drawn_goal_force: int,
    centre_tolerance: float,
    out: wp.array[float],
):
    """Reward the right force."""
    w = wp.tid()
    error = wp.abs(metrics[w, 1]) / parameters[w, drawn_goal_force]
    match = wp.max(1.0 - wp.tanh(1.5 * error) / wp.tanh(1.5), 0.0)
    out[w] = press_near(metrics, w, centre_tolerance) * match


@wp.kernel
def press_there(
    metrics: wp.array2d[float],
    parameters: wp.array2d[float],
    drawn_goal_force: int,
    centre_tolerance: float,
    force_tolerance: float,
    least_tolerance: float,
    out: wp.array[wp.bool],
):
    """Say whether the force is right."""
    w = wp.tid()
    most = wp.max(force_tolerance * parameters[w, drawn_goal_force], least_tolerance)
    out[w] = metrics[w, 3] <= centre_tolerance and wp.abs(metrics[w, 1]) <= most


@wp.kernel
def press_hold(
    metrics: wp.array2d[float],
    parameters: wp.array2d[float],
    drawn_goal_force: int,
    centre_tolerance: float,
    force_tolerance: float,
    least_tolerance: float,
    out: wp.array[float],
):
    """Reward the right force, all or nothing."""
    w = wp.tid()
    most = wp.max(force_tolerance * parameters[w, drawn_goal_force], least_tolerance)
    out[w] = wp.where(metrics[w, 3] <= centre_tolerance and wp.abs(metrics[w, 1]) <= most, 1.0, 0.0)


@wp.kernel
def press_overshoot(
    metrics: wp.array2d[float], parameters: wp.array2d[float], drawn_goal_force: int, out: wp.array[float]
):
    """Count how far the force is over 1.3 times the goal."""
    w = wp.tid()
    goal = parameters[w, drawn_goal_force]
    out[w] = wp.clamp((metrics[w, 0] - 1.3 * goal) / goal, 0.0, 1.0)


@wp.kernel
def height(object_position: wp.array2d[wp.vec3], out: wp.array[float]):
    """Return the height of object 0 [m]."""
    w = wp.tid()
    out[w] = object_position[w, 0][2]


@wp.kernel
def tool_height(tool_pose: wp.array[wp.transform], out: wp.array2d[float]):
    """Observe the height of the tool, and twice that."""
    w = wp.tid()
    z = wp.transform_get_translation(tool_pose[w])[2]
    out[w, 0] = z
    out[w, 1] = 2.0 * z


@wp.kernel
def late(elapsed: wp.array[int], steps: int, out: wp.array[wp.bool]):
    """Say whether more than some control steps were made before this one."""
    w = wp.tid()
    out[w] = elapsed[w] >= steps


@wp.kernel
def always(out: wp.array[wp.bool]):
    """Say yes."""
    w = wp.tid()
    out[w] = True


@wp.kernel
def harder(success: wp.array[wp.bool], level: wp.array[float], step: float, out: wp.array[float]):
    """Go up by a step after a success, and down after a failure."""
    w = wp.tid()
    out[w] = level[w] + wp.where(success[w], step, -step)


@wp.kernel
def turn(world_mask: wp.array[wp.bool], parameters: wp.array2d[float], drawn_yaw: int, angle: float):
    """Turn every object alike."""
    w = wp.tid()
    if world_mask[w]:
        parameters[w, drawn_yaw] = angle


@wp.kernel
def count_steps(memory: wp.array[float]):
    """Count the control steps of an episode."""
    w = wp.tid()
    memory[w] = memory[w] + 1.0


@wp.kernel
def writes_nothing(elapsed: wp.array[int]):
    """Take no `out`."""
    w = wp.tid()
    elapsed[w] = elapsed[w]
