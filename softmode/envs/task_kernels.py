"""Device side of a task: draws at reset, proprioception and object in the observation, ends of episodes."""

import warp as wp

from softmode.envs.end_reason import EndReason
from softmode.envs.reward_kernels import StepResult, WorldState, surface_point, tool_position
from softmode.robots.arm import ARM_JOINT_COUNT

wp.set_module_options({"enable_backward": False})

_LEFT = wp.constant(ARM_JOINT_COUNT)
_RIGHT = wp.constant(ARM_JOINT_COUNT + 1)


@wp.struct
class ArmState:
    """Joints and command of the arm in every world."""

    coord_start: wp.array[int]
    joint_q: wp.array[float]
    opening: wp.array[float]
    target_position: wp.array[wp.vec3]
    target_yaw: wp.array[float]
    commanded_q: wp.array2d[float]


@wp.struct
class ArmColumns:
    """First columns of the proprioception."""

    tool_position: int
    tool_heading: int
    opening: int
    finger_force: int
    joint_angles: int
    command_lead: int
    command_turn: int
    command_opening: int


@wp.struct
class ObjectColumns:
    """First columns of object 0."""

    object_position: int
    object_velocity: int
    object_offset: int
    object_points: int


@wp.struct
class Placement:
    """Columns of the parameters that say where an object is put down."""

    position: int  # of x and y [m]
    yaw: int  # [rad]
    scale: int


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
    state: WorldState,
    drawn: Placement,
    height: float,  # of the unscaled object's centre [m]
    gap: float,  # [m]
    object_index: int,
    # Out, per instance:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Write where an object is put down."""
    w = wp.tid()
    if not world_mask[w]:
        return
    x = wp.float64(state.parameters[w, drawn.position])
    y = wp.float64(state.parameters[w, drawn.position + 1])
    z = wp.float64(height * state.parameters[w, drawn.scale] + gap)
    position_out[w * state.stride + object_index] = wp.vec3d(x, y, z)
    yaw_out[w * state.stride + object_index] = wp.float64(state.parameters[w, drawn.yaw])


@wp.kernel
def spread_materials(
    state: WorldState,
    columns: wp.array[int],
    # Out, (columns, instance_count):
    values: wp.array2d[float],
):
    """Give all soft objects of a world the drawn material and scale."""
    i = wp.tid()
    for m in range(values.shape[0]):
        values[m, i] = state.parameters[i // state.stride, columns[m]]


@wp.kernel
def observe_arm(
    state: WorldState,
    arm: ArmState,
    column: ArmColumns,
    # Out:
    observation: wp.array2d[float],
):
    """Write proprioception: tool, heading, opening, finger forces, joints, and how far the command leads."""
    w = wp.tid()
    p = tool_position(state, w)
    forward = wp.quat_rotate(wp.transform_get_rotation(state.tool_pose[w]), wp.vec3(1.0, 0.0, 0.0))
    length = wp.max(wp.sqrt(forward[0] * forward[0] + forward[1] * forward[1]), 1.0e-9)
    c = -forward[0] / length
    s = -forward[1] / length
    lead = arm.target_position[w] - p
    for k in range(3):
        observation[w, column.tool_position + k] = p[k]
        observation[w, column.command_lead + k] = lead[k]
    observation[w, column.tool_heading] = c
    observation[w, column.tool_heading + 1] = s
    observation[w, column.opening] = arm.opening[w]
    for f in range(2):
        observation[w, column.finger_force + f] = wp.length(state.finger_force[w, f])
    start = arm.coord_start[w]
    for j in range(ARM_JOINT_COUNT):
        observation[w, column.joint_angles + j] = arm.joint_q[start + j]
    # sine of the angle from the measured heading to the commanded one
    observation[w, column.command_turn] = c * wp.sin(arm.target_yaw[w]) - s * wp.cos(arm.target_yaw[w])
    observation[w, column.command_opening] = arm.commanded_q[w, _LEFT] + arm.commanded_q[w, _RIGHT]


@wp.kernel
def observe_object(
    state: WorldState,
    column: ObjectColumns,
    # Out:
    observation: wp.array2d[float],
):
    """Write centre, velocity, centre relative to the tool, and surface points relative to the centre of object 0."""
    w = wp.tid()
    x = state.object_position[w, 0]
    v = state.object_velocity[w, 0]
    offset = x - tool_position(state, w)
    for k in range(3):
        observation[w, column.object_position + k] = x[k]
        observation[w, column.object_velocity + k] = v[k]
        observation[w, column.object_offset + k] = offset[k]
    for i in range(state.points.shape[0]):
        r = surface_point(state, w, i) - x
        for k in range(3):
            observation[w, column.object_points + 3 * i + k] = r[k]


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
    state: WorldState,
    lowest: float,  # height under which object 0 is lost [m]
    # In, out:
    result: StepResult,
    episode: Episode,
):
    """Sum the reward, count the step and decide whether the episode ends."""
    w = wp.tid()
    if fresh[w]:
        episode.reward[w] = 0.0
        episode.terminated[w] = False
        episode.truncated[w] = False
        episode.end[w] = EndReason.RUNNING
        episode.done[w] = False
        for t in range(result.terms.shape[1]):
            result.terms[w, t] = 0.0
        return
    why = result.failure[w]
    if not (state.object_position[w, 0][2] >= lowest):
        why = EndReason.DROPPED
    if (status[w] & not_finite) != 0 or not finite[w]:
        why = EndReason.DIVERGED
    total = float(0.0)
    for t in range(result.terms.shape[1]):
        if not wp.isfinite(result.terms[w, t]):
            result.terms[w, t] = 0.0
        total += result.terms[w, t]
    steps = episode.elapsed[w] + 1
    failed = why != EndReason.RUNNING
    late = limit > 0 and steps >= limit
    episode.elapsed[w] = steps
    result.failure[w] = why
    episode.reward[w] = total
    episode.terminated[w] = failed
    episode.truncated[w] = late
    episode.end[w] = why
    if late and not failed:
        episode.end[w] = EndReason.TIME_LIMIT
    over = failed or late
    episode.done[w] = over
    if over:
        wp.atomic_max(episode.any_done, 0, 1)
