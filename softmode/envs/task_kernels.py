"""Device side of a task: draws at reset, proprioception and object in the observation, ends of episodes."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TIME_LIMIT = wp.constant(1)
DIVERGED = wp.constant(2)
DROPPED = wp.constant(3)


@wp.kernel
def draw_parameters(
    world_mask: wp.array[wp.bool],
    seed: wp.array[int],
    low: wp.array[float],
    high: wp.array[float],
    logarithmic: wp.array[wp.bool],
    # In, out:
    episode: wp.array[int],
    # Out:
    parameters: wp.array2d[float],
):
    """Count the episode and draw every column: uniform, or uniform in the logarithm."""
    w = wp.tid()
    if not world_mask[w]:
        return
    episode[w] = episode[w] + 1
    columns = parameters.shape[1]
    for p in range(columns):
        random = wp.rand_init(seed[w], episode[w] * columns + p)
        u = wp.randf(random)
        a = low[p]
        b = high[p]
        value = a + u * (b - a)
        if logarithmic[p]:
            value = a * wp.exp(u * wp.log(b / a))
        parameters[w, p] = wp.clamp(value, a, b)


@wp.kernel
def place_object(
    world_mask: wp.array[wp.bool],
    parameters: wp.array2d[float],
    position_column: int,  # of x and y [m]
    yaw_column: int,  # [rad]
    scale_column: int,
    height: float,  # of the unscaled object's centre [m]
    gap: float,  # [m]
    stride: int,  # soft objects per world
    object_index: int,
    # Out, per instance:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Write where an object is put down."""
    w = wp.tid()
    if not world_mask[w]:
        return
    x = wp.float64(parameters[w, position_column])
    y = wp.float64(parameters[w, position_column + 1])
    position_out[w * stride + object_index] = wp.vec3d(x, y, wp.float64(height * parameters[w, scale_column] + gap))
    yaw_out[w * stride + object_index] = wp.float64(parameters[w, yaw_column])


@wp.kernel
def spread_materials(
    parameters: wp.array2d[float],
    column: int,  # of the first
    stride: int,  # soft objects per world
    # Out, (5, instance_count):
    values: wp.array2d[float],
):
    """Give all soft objects of a world the drawn material and scale."""
    i = wp.tid()
    for m in range(values.shape[0]):
        values[m, i] = parameters[i // stride, column + m]


@wp.kernel
def observe_arm(
    coord_start: wp.array[int],
    joint_q: wp.array[float],
    tool_pose: wp.array[wp.transform],
    opening: wp.array[float],
    finger_force: wp.array2d[wp.vec3],
    target_position: wp.array[wp.vec3],
    target_yaw: wp.array[float],
    commanded_q: wp.array2d[float],
    # Out:
    observation: wp.array2d[float],
):
    """Write proprioception: tool, heading, opening, finger forces, joints, and how far the command leads."""
    w = wp.tid()
    pose = tool_pose[w]
    p = wp.transform_get_translation(pose)
    forward = wp.quat_rotate(wp.transform_get_rotation(pose), wp.vec3(1.0, 0.0, 0.0))
    length = wp.max(wp.sqrt(forward[0] * forward[0] + forward[1] * forward[1]), 1.0e-9)
    c = -forward[0] / length
    s = -forward[1] / length
    for k in range(3):
        observation[w, k] = p[k]
    observation[w, 3] = c
    observation[w, 4] = s
    observation[w, 5] = opening[w]
    for f in range(2):
        observation[w, 6 + f] = wp.length(finger_force[w, f])
    start = coord_start[w]
    for j in range(7):
        observation[w, 8 + j] = joint_q[start + j]
    lead = target_position[w] - p
    for k in range(3):
        observation[w, 15 + k] = lead[k]
    # sine of the angle from the measured heading to the commanded one
    observation[w, 18] = c * wp.sin(target_yaw[w]) - s * wp.cos(target_yaw[w])
    observation[w, 19] = commanded_q[w, 7] + commanded_q[w, 8]


@wp.kernel
def observe_object(
    object_position: wp.array2d[wp.vec3],
    object_velocity: wp.array2d[wp.vec3],
    tool_pose: wp.array[wp.transform],
    particle_start: wp.array[int],
    particle_q: wp.array[wp.vec3],
    points: wp.array[int],
    stride: int,  # soft objects per world
    column: int,
    # Out:
    observation: wp.array2d[float],
):
    """Write centre, velocity, centre relative to the tool, and surface points relative to the centre of object 0."""
    w = wp.tid()
    x = object_position[w, 0]
    v = object_velocity[w, 0]
    offset = x - wp.transform_get_translation(tool_pose[w])
    for k in range(3):
        observation[w, column + k] = x[k]
        observation[w, column + 3 + k] = v[k]
        observation[w, column + 6 + k] = offset[k]
    start = particle_start[w * stride]
    for i in range(points.shape[0]):
        r = particle_q[start + points[i]] - x
        for k in range(3):
            observation[w, column + 9 + 3 * i + k] = r[k]


@wp.kernel
def bound_observation(
    low: wp.array[float],
    high: wp.array[float],
    # In, out:
    observation: wp.array2d[float],
    # Out:
    finite: wp.array[wp.bool],
):
    """Clip the observation to its bounds; what is not finite becomes zero (or the nearest bound) and is flagged."""
    w = wp.tid()
    good = bool(True)
    for k in range(observation.shape[1]):
        x = observation[w, k]
        if not wp.isfinite(x):
            good = False
            x = 0.0
        observation[w, k] = wp.clamp(x, low[k], high[k])
    finite[w] = good


@wp.kernel
def clear_worlds(
    world_mask: wp.array[wp.bool],
    # Out:
    elapsed: wp.array[int],
    done: wp.array[wp.bool],
    success: wp.array[wp.bool],
    failure: wp.array[int],
):
    """Start the episode of the masked worlds."""
    w = wp.tid()
    if not world_mask[w]:
        return
    elapsed[w] = 0
    done[w] = False
    success[w] = False
    failure[w] = 0


@wp.kernel
def forget_held(
    world_mask: wp.array[wp.bool],
    # Out:
    held: wp.array[int],
):
    """Forget for how many steps the goal was met."""
    w = wp.tid()
    if world_mask[w]:
        held[w] = 0


@wp.kernel
def finish_step(
    fresh: wp.array[wp.bool],  # worlds whose step was a reset
    limit: int,  # steps per episode, 0 for none
    not_finite: int,  # status bit
    status: wp.array[int],
    finite: wp.array[wp.bool],
    object_position: wp.array2d[wp.vec3],
    lowest: float,  # height under which object 0 is lost [m]
    # In, out:
    terms: wp.array2d[float],
    elapsed: wp.array[int],
    failure: wp.array[int],
    # Out:
    reward: wp.array[float],
    terminated: wp.array[wp.bool],
    truncated: wp.array[wp.bool],
    end: wp.array[int],
    done: wp.array[wp.bool],
    any_done: wp.array[int],
):
    """Sum the reward, count the step and decide whether the episode ends."""
    w = wp.tid()
    if fresh[w]:
        reward[w] = 0.0
        terminated[w] = False
        truncated[w] = False
        end[w] = 0
        done[w] = False
        for t in range(terms.shape[1]):
            terms[w, t] = 0.0
        return
    why = failure[w]
    if not (object_position[w, 0][2] >= lowest):
        why = DROPPED
    if (status[w] & not_finite) != 0 or not finite[w]:
        why = DIVERGED
    total = float(0.0)
    for t in range(terms.shape[1]):
        if not wp.isfinite(terms[w, t]):
            terms[w, t] = 0.0
        total += terms[w, t]
    steps = elapsed[w] + 1
    late = limit > 0 and steps >= limit
    elapsed[w] = steps
    failure[w] = why
    reward[w] = total
    terminated[w] = why != 0
    truncated[w] = late
    end[w] = why
    if late and why == 0:
        end[w] = TIME_LIMIT
    over = why != 0 or late
    done[w] = over
    if over:
        wp.atomic_max(any_done, 0, 1)
