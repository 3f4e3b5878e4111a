"""Device side of the controller of loaded robots: a chain of up to eight joints, and a gripper with a measured gap."""

import warp as wp

from softmode.robots.control_kernels import (
    Command,
    Settings,
    _clamp_into,
    _clean,
    _rotation_between,
    _solve_spd,
    _tool_yaw,
    attained_target,
    down_at,
    held_target,
    mat66,
    moved_opening,
    vec6,
)

wp.set_module_options({"enable_backward": False})

JOINT_MAX = 8

vec8 = wp.types.vector(length=JOINT_MAX, dtype=wp.float32)
"""One number per joint; those beyond the robot's are zero."""
mat68 = wp.types.matrix(shape=(6, JOINT_MAX), dtype=wp.float32)
"""A tool Jacobian: three rows of translation, three of rotation."""


@wp.struct
class RobotChain:
    """The joints between base and tool as a product of exponentials in the world frame, and the gripper."""

    count: int
    axis: wp.array[wp.vec3]  # (count,) directions at zero coordinates
    anchor: wp.array[wp.vec3]  # (count,) points on the axes [m]
    slide: wp.array[int]  # (count,) 1 where a joint slides
    lower: wp.array[float]
    upper: wp.array[float]
    home: vec8
    leader: wp.array[int]  # (count,) the joint of the chain that each one follows, itself for most
    ratio: wp.array[float]
    offset: wp.array[float]
    tool: wp.transform  # at zero coordinates, with the fingers closed
    follow: float  # share of the gap by which it moves along y
    coord_start: wp.array[int]  # (world_count,)
    joint: wp.array[int]  # (count,) coordinate in the robot
    finger: wp.array[int]  # coordinates of the gripper's joints
    closed: wp.array[float]
    open: wp.array[float]
    gap: wp.array[float]  # between the fingers at evenly spaced openings 0..1 [m]


@wp.func
def _tool_at(chain: RobotChain, gap: float):
    """Return the tool at zero coordinates where the fingers are so far apart [m]."""
    return chain.tool * wp.transform(wp.vec3(0.0, chain.follow * gap, 0.0), wp.quat_identity())


@wp.func
def _forward(chain: RobotChain, q: vec8, tool: wp.transform):
    """Return the tool's pose in the world at joint coordinates q."""
    pose = wp.transform_identity()
    for k in range(chain.count):
        axis = chain.axis[k]
        if chain.slide[k] == 1:
            pose = pose * wp.transform(axis * q[k], wp.quat_identity())
        else:
            turn = wp.quat_from_axis_angle(axis, q[k])
            anchor = chain.anchor[k]
            pose = pose * wp.transform(anchor - wp.quat_rotate(turn, anchor), turn)
    return pose * tool


@wp.func
def _jacobian(chain: RobotChain, q: vec8, tool_at_zero: wp.transform, rotation_weight: float):
    """Return d(tool position, rotation_weight * rotation)/dq in the world frame; columns of no joint are zero."""
    tool = wp.transform_get_translation(_forward(chain, q, tool_at_zero))
    jacobian = mat68()
    pose = wp.transform_identity()
    for k in range(chain.count):
        axis = wp.transform_vector(pose, chain.axis[k])
        anchor = chain.anchor[k]
        if chain.slide[k] == 1:
            for i in range(3):
                jacobian[i, k] = axis[i]
            pose = pose * wp.transform(chain.axis[k] * q[k], wp.quat_identity())
        else:
            lever = wp.cross(axis, tool - wp.transform_point(pose, anchor))
            for i in range(3):
                jacobian[i, k] = lever[i]
                jacobian[3 + i, k] = rotation_weight * axis[i]
            turn = wp.quat_from_axis_angle(chain.axis[k], q[k])
            pose = pose * wp.transform(anchor - wp.quat_rotate(turn, anchor), turn)
    return jacobian


@wp.func
def _followed(chain: RobotChain, q: vec8):
    """Return coordinates with those of followers where their ties have them."""
    moved = vec8(q)
    for k in range(chain.count):
        if chain.leader[k] != k:
            moved[k] = chain.offset[k] + chain.ratio[k] * q[chain.leader[k]]
    return moved


@wp.func
def _inverse(
    chain: RobotChain,
    settings: Settings,
    tool: wp.transform,
    position: wp.vec3,
    rotation: wp.quat,
    q_start: vec8,
    low: vec8,
    high: vec8,
):
    """Iterate damped least squares towards a tool pose, within joint limits, pulled home in the null space.

    One iteration: dq = J^T (J J^T + lambda^2 I)^-1 (e - J z) + z with z = gain * (q_home - q). An arm of five joints
    has no null space: the pull is left out, it would only bend the pose.
    """
    q = q_start
    gain = wp.where(chain.count > 6, settings.posture_gain, 0.0)
    for _iteration in range(settings.iterations):
        pose = _forward(chain, q, tool)
        e_position = position - wp.transform_get_translation(pose)
        e_rotation = settings.rotation_weight * _rotation_between(rotation, wp.transform_get_rotation(pose))
        jacobian = _jacobian(chain, q, tool, settings.rotation_weight)
        for k in range(chain.count):
            if chain.leader[k] != k:
                for i in range(6):
                    jacobian[i, chain.leader[k]] = jacobian[i, chain.leader[k]] + chain.ratio[k] * jacobian[i, k]
                    jacobian[i, k] = 0.0
        pull = gain * (chain.home - q)
        right = vec6()
        for i in range(3):
            right[i] = e_position[i]
            right[3 + i] = e_rotation[i]
        right = right - jacobian * pull
        scale = settings.damping * wp.min(1.0, wp.length(right) / settings.damping) + 1.0e-3
        normal = mat66(jacobian * wp.transpose(jacobian))
        for i in range(6):
            normal[i, i] = normal[i, i] + scale * scale
        q = q + pull + wp.transpose(jacobian) * _solve_spd(normal, right)
        for k in range(chain.count):
            q[k] = wp.clamp(q[k], low[k], high[k])
        q = _followed(chain, q)
    return q


@wp.func
def _outside(chain: RobotChain, settings: Settings, tool: wp.transform, q: vec8):
    """Return the distance of the tool from the workspace box [m]."""
    position = wp.transform_get_translation(_forward(chain, q, tool))
    return wp.length(position - _clamp_into(position, settings.workspace_lower, settings.workspace_upper))


@wp.func
def _read_arm(chain: RobotChain, world: int, joint_q: wp.array[float]):
    q = vec8()
    for k in range(chain.count):
        q[k] = joint_q[chain.coord_start[world] + chain.joint[k]]
    return q


@wp.func
def _gap_at(chain: RobotChain, opening: float):
    """Return the distance between the fingers at an opening [m]; beyond the ends its slope goes on."""
    last = chain.gap.shape[0] - 1
    x = opening * float(last)
    i = wp.clamp(int(wp.floor(x)), 0, last - 1)
    return chain.gap[i] + (x - float(i)) * (chain.gap[i + 1] - chain.gap[i])


@wp.func
def _opening_at(chain: RobotChain, gap: float):
    """Return the opening at a distance between the fingers, the inverse of `_gap_at`."""
    last = chain.gap.shape[0] - 1
    i = int(0)
    while i < last - 1 and gap > chain.gap[i + 1]:
        i += 1
    return (float(i) + (gap - chain.gap[i]) / (chain.gap[i + 1] - chain.gap[i])) / float(last)


@wp.func
def _read_opening(chain: RobotChain, world: int, joint_q: wp.array[float]):
    """Return the measured distance between the fingers [m]."""
    total = float(0.0)
    for f in range(chain.finger.shape[0]):
        q = joint_q[chain.coord_start[world] + chain.finger[f]]
        total += (q - chain.closed[f]) / (chain.open[f] - chain.closed[f])
    return _gap_at(chain, total / float(chain.finger.shape[0]))


@wp.kernel
def reset_command(
    chain: RobotChain,
    joint_q_in: wp.array[float],
    world_mask: wp.array[wp.bool],
    # Out:
    command: Command,
):
    """Set the command of the masked worlds to the measured configuration."""
    world = wp.tid()
    if not world_mask[world]:
        return
    q = _read_arm(chain, world, joint_q_in)
    opening = _read_opening(chain, world, joint_q_in)
    pose = _forward(chain, q, _tool_at(chain, opening))
    for k in range(chain.count + 2):
        value = 0.5 * opening
        if k < chain.count:
            value = q[k]
        command.commanded_q[world, k] = value
        command.previous_q[world, k] = value
    command.target_position[world] = wp.transform_get_translation(pose)
    command.target_yaw[world] = _tool_yaw(wp.transform_get_rotation(pose))
    command.tool_pose[world] = pose
    command.opening[world] = opening


@wp.kernel
def move_command(
    chain: RobotChain,
    settings: Settings,
    action: wp.array2d[float],
    joint_q_in: wp.array[float],
    # In, out:
    command: Command,
):
    """Apply one action to the command: move, clamp to workspace and lead, solve for the joints, move the gripper."""
    world = wp.tid()
    measured = _read_arm(chain, world, joint_q_in)
    measured_opening = _read_opening(chain, world, joint_q_in)
    measured_pose = _forward(chain, measured, _tool_at(chain, measured_opening))
    command.tool_pose[world] = measured_pose
    command.opening[world] = measured_opening
    opening = command.commanded_q[world, chain.count] + command.commanded_q[world, chain.count + 1]
    opening = moved_opening(settings, opening, measured_opening, _clean(action[world, action.shape[1] - 1]))
    tool = _tool_at(chain, opening)
    q = vec8()
    low = vec8()
    high = vec8()
    for k in range(chain.count + 2):
        command.previous_q[world, k] = command.commanded_q[world, k]
    for k in range(chain.count):
        q[k] = command.commanded_q[world, k]
        low[k] = chain.lower[k]
        high[k] = chain.upper[k]
    q_before = vec8(q)
    if settings.joint_mode == 1:
        lead = settings.max_lead_angle
        for k in range(chain.count):
            moved = q[k] + settings.joint_scale * _clean(action[world, k])
            q[k] = wp.clamp(wp.clamp(moved, measured[k] - lead, measured[k] + lead), low[k], high[k])
        q = _followed(chain, q)
        pose = _forward(chain, q, tool)
        position = wp.transform_get_translation(pose)
        inside = _clamp_into(position, settings.workspace_lower, settings.workspace_upper)
        if wp.length(inside - position) > 0.0:
            q = _inverse(chain, settings, tool, inside, wp.transform_get_rotation(pose), q, low, high)
            if _outside(chain, settings, tool, q) > wp.max(_outside(chain, settings, tool, q_before), 1.0e-3):
                q = q_before
            pose = _forward(chain, q, tool)
            position = wp.transform_get_translation(pose)
        command.target_position[world] = position
        command.target_yaw[world] = _tool_yaw(wp.transform_get_rotation(pose))
    else:
        move = wp.vec3(_clean(action[world, 0]), _clean(action[world, 1]), _clean(action[world, 2]))
        before, before_yaw = command.target_position[world], command.target_yaw[world]
        entry = _clean(action[world, 3])
        position, yaw = held_target(settings, before, before_yaw, measured_pose, move, entry)
        q = _inverse(chain, settings, tool, position, down_at(yaw), q, low, high)
        position, yaw = attained_target(position, yaw, _forward(chain, q, tool))
        command.target_position[world] = position
        command.target_yaw[world] = yaw

    for k in range(chain.count):
        command.commanded_q[world, k] = q[k]
    command.commanded_q[world, chain.count] = 0.5 * opening
    command.commanded_q[world, chain.count + 1] = 0.5 * opening


@wp.kernel
def write_targets(
    chain: RobotChain,
    command: Command,
    fraction: float,
    # Out:
    joint_target_q_out: wp.array[float],
):
    """Interpolate the position targets between two commands; the gripper's joints share one opening."""
    world = wp.tid()
    start = chain.coord_start[world]
    n = chain.count
    for k in range(n):
        target = wp.lerp(command.previous_q[world, k], command.commanded_q[world, k], fraction)
        joint_target_q_out[start + chain.joint[k]] = target
    before = command.previous_q[world, n] + command.previous_q[world, n + 1]
    now = command.commanded_q[world, n] + command.commanded_q[world, n + 1]
    opening = _opening_at(chain, wp.lerp(before, now, fraction))
    for f in range(chain.finger.shape[0]):
        joint_target_q_out[start + chain.finger[f]] = wp.lerp(chain.closed[f], chain.open[f], opening)


@wp.kernel
def measure(
    chain: RobotChain,
    joint_q_in: wp.array[float],
    # Out:
    command: Command,
):
    """Compute the tool's pose and the distance between the fingers."""
    world = wp.tid()
    opening = _read_opening(chain, world, joint_q_in)
    command.tool_pose[world] = _forward(chain, _read_arm(chain, world, joint_q_in), _tool_at(chain, opening))
    command.opening[world] = opening
