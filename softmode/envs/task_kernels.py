"""Device side of a task: draws at reset, proprioception and object in the observation, ends of episodes."""

from typing import Any

import warp as wp

from softmode.envs.reward_kernels import (
    EndReason,
    StepResult,
    WorldState,
    is_there,
    surface_point,
    tool_position,
    write,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class ArmState:
    """Joints and command of the arm in every world; two entries behind the joints' command the opening."""

    coord_start: wp.array[int]
    joint_columns: wp.array[int]
    joint_q: wp.array[float]
    opening: wp.array[float]
    target_position: wp.array[wp.vec3]
    target_yaw: wp.array[float]
    commanded_q: wp.array2d[float]


@wp.struct
class Columns:
    """First columns of the proprioception and of object 0."""

    tool_position: int
    tool_heading: int
    opening: int
    finger_force: int
    joint_angles: int
    command_lead: int
    command_turn: int
    command_opening: int
    object_position: int
    object_velocity: int
    object_offset: int
    object_points: int
    arm: int  # where proprioception stands again, -1 for nowhere
    arm_size: int


@wp.struct
class Placement:
    """Columns of the parameters that say where an object is put down."""

    position: int  # of x and y [m]
    yaw: int  # [rad]
    scale: int
    turn: float  # what is added to the yaw [rad]
    shift: wp.array[float]  # from the unscaled object's centre to what lies at the position, along the yaw [m]
    height: wp.array2d[float]  # of the unscaled object's centre [m], (world_count, objects)
    gap: float  # [m]
    index: int  # which object of a world


@wp.struct
class Clutter:
    """Columns of what objects beside object 0 are drawn and observed by; those of each follow each other."""

    turn: int  # about object 0 [rad]
    place: int  # angle [rad] and distance [m] from object 0
    yaw: int  # [rad]
    stride: int  # columns from one object to the next
    scale: int
    height: wp.array2d[float]  # of the unscaled objects' centres [m], (world_count, objects)
    gap: float  # [m]


@wp.struct
class Episode:
    """How the episode of every world goes on and ends."""

    elapsed: wp.array[int]  # control steps
    reward: wp.array[float]
    terminated: wp.array[wp.bool]
    truncated: wp.array[wp.bool]
    end: wp.array[int]  # an EndReason
    done: wp.array[wp.bool]
    any_done: wp.array[int]


@wp.kernel
def draw_parameters(
    world_mask: wp.array[wp.bool],
    seed: wp.array[int],
    row: wp.array[int],  # of the bounds
    low: wp.array2d[float],
    high: wp.array2d[float],
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
        a = low[row[w], p]
        b = high[row[w], p]
        value = a + u * (b - a)
        if logarithmic[p]:
            value = a * wp.exp(u * wp.log(b / a))
        parameters[w, p] = wp.clamp(value, a, b)


@wp.kernel
def place_object(
    world_mask: wp.array[wp.bool],
    state: WorldState,
    place: Placement,
    # Out, per instance:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Write where an object is put down."""
    w = wp.tid()
    if not world_mask[w]:
        return
    scale = state.parameters[w, place.scale]
    yaw = place.turn + state.parameters[w, place.yaw]
    x = state.parameters[w, place.position] - scale * place.shift[w] * wp.cos(yaw)
    y = state.parameters[w, place.position + 1] - scale * place.shift[w] * wp.sin(yaw)
    z = place.height[w, place.index] * scale + place.gap
    i = w * state.stride + place.index
    position_out[i] = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(z))
    yaw_out[i] = wp.float64(yaw)


@wp.kernel
def place_beside(
    world_mask: wp.array[wp.bool],
    state: WorldState,
    clutter: Clutter,
    # Out, per instance; that of object 0 is written:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Write where the objects beside object 0 are put down."""
    w, k = wp.tid()
    if not world_mask[w]:
        return
    place = clutter.place + k * clutter.stride
    angle = state.parameters[w, clutter.turn] + state.parameters[w, place]
    distance = state.parameters[w, place + 1]
    middle = position_out[w * state.stride]
    z = clutter.height[w, k + 1] * state.parameters[w, clutter.scale] + clutter.gap
    x = float(middle[0]) + distance * wp.cos(angle)
    y = float(middle[1]) + distance * wp.sin(angle)
    i = w * state.stride + k + 1
    position_out[i] = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(z))
    yaw_out[i] = wp.float64(state.parameters[w, clutter.yaw + k * clutter.stride])


@wp.kernel
def spread_materials(
    parameters: wp.array2d[float],
    stride: int,  # soft bodies of a world
    columns: wp.array[int],
    kept: wp.array2d[float],  # (choices, columns) what is the object's own; no number where it is drawn
    choice: wp.array[int],  # (world_count * slots,)
    slots: int,
    # Out, (columns, instance_count):
    values: wp.array2d[float],
):
    """Give all soft objects of a world the drawn material and scale; beside the first, an object of a set keeps its."""
    i = wp.tid()
    for m in range(values.shape[0]):
        value = parameters[i // stride, columns[m]]
        if slots > 1 and i % slots > 0:
            if choice[i] >= 0 and wp.isfinite(kept[choice[i], m]):
                value = kept[choice[i], m]
        values[m, i] = value


@wp.kernel
def observe(
    state: WorldState,
    arm: ArmState,
    column: Columns,
    # Out:
    observation: wp.array2d[float],
):
    """Write what every observation has.

    Proprioception: tool, heading, opening, finger forces, joints, and how far the command leads. Object 0: centre,
    velocity, centre relative to the tool, and surface points relative to the centre. Of tasks with goals proprioception
    stands behind that again, so that what does not depend on the goal is one range.
    """
    w = wp.tid()
    p = tool_position(state, w)
    forward = wp.quat_rotate(wp.transform_get_rotation(state.tool_pose[w]), wp.vec3(1.0, 0.0, 0.0))
    length = wp.max(wp.sqrt(forward[0] * forward[0] + forward[1] * forward[1]), 1.0e-9)
    c = -forward[0] / length
    s = -forward[1] / length
    write(observation, w, column.tool_position, p)
    write(observation, w, column.tool_heading, wp.vec2(c, s))
    observation[w, column.opening] = arm.opening[w]
    for f in range(2):
        observation[w, column.finger_force + f] = wp.length(state.finger_force[w, f])
    start = arm.coord_start[w]
    count = arm.joint_columns.shape[0]
    for j in range(count):
        observation[w, column.joint_angles + j] = arm.joint_q[start + arm.joint_columns[j]]
    write(observation, w, column.command_lead, arm.target_position[w] - p)
    # sine of the angle from the measured heading to the commanded one
    observation[w, column.command_turn] = c * wp.sin(arm.target_yaw[w]) - s * wp.cos(arm.target_yaw[w])
    observation[w, column.command_opening] = arm.commanded_q[w, count] + arm.commanded_q[w, count + 1]
    x = state.object_position[w, 0]
    write(observation, w, column.object_position, x)
    write(observation, w, column.object_velocity, state.object_velocity[w, 0])
    write(observation, w, column.object_offset, x - p)
    for i in range(state.points.shape[1]):
        write(observation, w, column.object_points + 3 * i, surface_point(state, w, i) - x)
    if column.arm >= 0:
        for k in range(column.arm_size):
            observation[w, column.arm + k] = observation[w, column.tool_position + k]


@wp.kernel
def observe_others(
    state: WorldState,
    offsets: int,  # columns
    present: int,
    # Out:
    observation: wp.array2d[float],
):
    """Write the ways from object 0 to the others and whether these are there; zeros for those that are not."""
    w, k = wp.tid()
    way = wp.vec3()
    there = is_there(state, w, k + 1)
    if there:
        way = state.object_position[w, k + 1] - state.object_position[w, 0]
    write(observation, w, offsets + 3 * k, way)
    observation[w, present + k] = wp.where(there, 1.0, 0.0)


@wp.kernel
def observe_choice(
    choice: wp.array[int],  # (world_count * slots,) objects of the set that each world has
    slots: int,
    count: int,  # objects of the set
    column: int,
    # Out:
    observation: wp.array2d[float],
):
    """Write for each slot 1 for the object of the set that is there, and 0 for the others."""
    w, k = wp.tid()
    observation[w, column + k] = wp.where(choice[w * slots + k / count] == k % count, 1.0, 0.0)


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
    episode: Episode,
    result: StepResult,
):
    """Start the episode of the masked worlds."""
    w = wp.tid()
    if not world_mask[w]:
        return
    episode.elapsed[w] = 0
    episode.done[w] = False
    result.success[w] = False
    result.failure[w] = EndReason.RUNNING


@wp.kernel
def forget(
    world_mask: wp.array[wp.bool],
    value: Any,
    # Out:
    kept: wp.array[Any],
):
    """Set what is kept from step to step back to a value."""
    w = wp.tid()
    if world_mask[w]:
        kept[w] = value


@wp.kernel
def finish_step(
    fresh: wp.array[wp.bool],  # worlds whose step was a reset
    limit: int,  # steps per episode, 0 for none
    sparse: int,  # whether success is paid, and not the terms
    not_finite: int,  # status bits
    status: wp.array[int],
    finite: wp.array[wp.bool],
    state: WorldState,
    lowest: wp.array[float],  # height under which object 0 is lost [m]
    # In, out:
    result: StepResult,
    episode: Episode,
):
    """Sum the reward, count the step and decide whether the episode ends."""
    w = wp.tid()
    played = not fresh[w]
    why = result.failure[w]
    if not (state.object_position[w, 0][2] >= lowest[w]):
        why = EndReason.DROPPED
    if (status[w] & not_finite) != 0 or not finite[w]:
        why = EndReason.DIVERGED
    total = float(0.0)
    for t in range(result.terms.shape[1]):
        if not (played and wp.isfinite(result.terms[w, t])):
            result.terms[w, t] = 0.0
        total += result.terms[w, t]
    if sparse != 0:
        total = wp.where(played and result.success[w], 1.0, 0.0)
    if played:
        episode.elapsed[w] += 1
    else:
        why = EndReason.RUNNING
    failed = why != EndReason.RUNNING
    late = played and limit > 0 and episode.elapsed[w] >= limit
    over = failed or late
    episode.reward[w] = total
    episode.terminated[w] = failed
    episode.truncated[w] = late
    episode.end[w] = why
    if late and not failed:
        episode.end[w] = EndReason.TIME_LIMIT
    episode.done[w] = over
    if over:
        wp.atomic_max(episode.any_done, 0, 1)
