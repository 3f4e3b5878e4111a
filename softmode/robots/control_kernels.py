"""Device side of the arm's controller: kinematics of the chain, damped least squares, and the command's update."""

import warp as wp

from softmode.robots.arm import ARM_JOINT_COUNT

wp.set_module_options({"enable_backward": False})

_N = wp.constant(ARM_JOINT_COUNT)


vec7 = wp.types.vector(length=ARM_JOINT_COUNT, dtype=wp.float32)
"""One number per arm joint."""
mat67 = wp.types.matrix(shape=(6, ARM_JOINT_COUNT), dtype=wp.float32)
"""A tool Jacobian: three rows of translation, three of rotation."""
mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
"""The normal matrix of the tool."""
vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""A tool error: translation, then rotation."""


@wp.struct
class Chain:
    """The arm in the model's arrays; the world's first indices, then seven joints and two fingers in a row."""

    joint_X_p: wp.array[wp.transform]  # pose of the joint in its parent
    joint_axis: wp.array[wp.vec3]
    joint_limit_lower: wp.array[float]
    joint_limit_upper: wp.array[float]
    joint_start: wp.array[int]
    coord_start: wp.array[int]
    dof_start: wp.array[int]
    tool_length: wp.float32
    home: vec7


@wp.struct
class Settings:
    """`ArmControlOptions` on the device."""

    joint_mode: wp.int32
    translation_scale: wp.float32
    rotation_scale: wp.float32
    joint_scale: wp.float32
    opening_rate: wp.float32
    stroke: wp.float32
    opening_lead: wp.float32
    workspace_lower: wp.vec3
    workspace_upper: wp.vec3
    max_lead: wp.float32
    max_lead_angle: wp.float32
    damping: wp.float32
    rotation_weight: wp.float32
    posture_gain: wp.float32
    iterations: wp.int32


@wp.struct
class Command:
    """What an action moves, and the measured tool beside it, world first; see `ArmController`."""

    commanded_q: wp.array2d[float]
    previous_q: wp.array2d[float]
    target_position: wp.array[wp.vec3]
    target_yaw: wp.array[float]
    tool_pose: wp.array[wp.transform]
    opening: wp.array[float]


@wp.func
def _forward(chain: Chain, world: int, q: vec7):
    """Return the tool's pose at joint angles q."""
    pose = wp.transform_identity()
    joint = chain.joint_start[world]
    dof = chain.dof_start[world]
    for k in range(_N):
        turn = wp.quat_from_axis_angle(chain.joint_axis[dof + k], q[k])
        pose = pose * chain.joint_X_p[joint + k] * wp.transform(wp.vec3(), turn)
    return pose * wp.transform(wp.vec3(0.0, 0.0, chain.tool_length), wp.quat_identity())


@wp.func
def _jacobian(chain: Chain, world: int, q: vec7, rotation_weight: float):
    """Return d(tool position, rotation_weight * rotation)/dq in the world frame, (6, 7)."""
    tool = wp.transform_get_translation(_forward(chain, world, q))
    jacobian = mat67()
    pose = wp.transform_identity()
    joint = chain.joint_start[world]
    dof = chain.dof_start[world]
    for k in range(_N):
        pose = pose * chain.joint_X_p[joint + k]
        axis = wp.transform_vector(pose, chain.joint_axis[dof + k])
        lever = wp.cross(axis, tool - wp.transform_get_translation(pose))
        for i in range(3):
            jacobian[i, k] = lever[i]
            jacobian[3 + i, k] = rotation_weight * axis[i]
        pose = pose * wp.transform(wp.vec3(), wp.quat_from_axis_angle(chain.joint_axis[dof + k], q[k]))
    return jacobian


@wp.func
def _solve_spd(matrix: mat66, right: vec6):
    """Solve a symmetric positive definite 6x6 system by LDL^T."""
    low = mat66()
    diagonal = vec6()
    for j in range(6):
        d = matrix[j, j]
        for k in range(j):
            d -= low[j, k] * low[j, k] * diagonal[k]
        diagonal[j] = d
        for i in range(j + 1, 6):
            value = matrix[i, j]
            for k in range(j):
                value -= low[i, k] * low[j, k] * diagonal[k]
            low[i, j] = value / d
    x = right
    for i in range(6):
        value = x[i]
        for k in range(i):
            value -= low[i, k] * x[k]
        x[i] = value
    for i in range(6):
        x[i] = x[i] / diagonal[i]
    for step in range(6):
        i = 5 - step
        value = x[i]
        for k in range(i + 1, 6):
            value -= low[k, i] * x[k]
        x[i] = value
    return x


@wp.func
def _rotation_between(a: wp.quat, b: wp.quat):
    """Return the rotation vector that turns b into a, the short way."""
    r = a * wp.quat_inverse(b)
    if r[3] < 0.0:
        r = wp.quat(-r[0], -r[1], -r[2], -r[3])
    v = wp.vec3(r[0], r[1], r[2])
    sine = wp.length(v)
    # 2 atan2(s, c) / s, whose limit at s = 0 is 2.
    return v * wp.where(sine > 1.0e-7, 2.0 * wp.atan2(sine, r[3]) / wp.max(sine, 1.0e-7), 2.0)


@wp.func
def _inverse(
    chain: Chain,
    settings: Settings,
    world: int,
    position: wp.vec3,
    rotation: wp.quat,
    q_start: vec7,
    low: vec7,
    high: vec7,
):
    """Iterate damped least squares towards a tool pose, within joint limits, pulled home in the null space.

    One iteration: dq = J^T (J J^T + lambda^2 I)^-1 (e - J z) + z with z = gain * (q_home - q).
    """
    q = q_start
    for _iteration in range(settings.iterations):
        pose = _forward(chain, world, q)
        e_position = position - wp.transform_get_translation(pose)
        e_rotation = settings.rotation_weight * _rotation_between(rotation, wp.transform_get_rotation(pose))
        jacobian = _jacobian(chain, world, q, settings.rotation_weight)
        pull = settings.posture_gain * (chain.home - q)
        right = vec6()
        for i in range(3):
            right[i] = e_position[i]
            right[3 + i] = e_rotation[i]
        right = right - jacobian * pull
        # The damping fades with the error: near the target the step is Newton's, far from it the step is bounded.
        scale = settings.damping * wp.min(1.0, wp.length(right) / settings.damping) + 1.0e-4
        normal = jacobian * wp.transpose(jacobian)
        for i in range(6):
            normal[i, i] = normal[i, i] + scale * scale
        q = q + pull + wp.transpose(jacobian) * _solve_spd(normal, right)
        for k in range(_N):
            q[k] = wp.clamp(q[k], low[k], high[k])
    return q


@wp.func
def _tool_yaw(rotation: wp.quat):
    """Return the yaw of a tool that points down: zero where its x axis points along -x."""
    x_axis = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(-x_axis[1], -x_axis[0])


@wp.func
def _clamp_into(position: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    return wp.min(wp.max(position, lower), upper)


@wp.func
def _outside(chain: Chain, settings: Settings, world: int, q: vec7):
    """Return the distance of the tool from the workspace box [m]."""
    position = wp.transform_get_translation(_forward(chain, world, q))
    return wp.length(position - _clamp_into(position, settings.workspace_lower, settings.workspace_upper))


@wp.func
def _clean(value: float):
    """Clamp an action to [-1, 1]; what is not finite counts as zero."""
    return wp.where(wp.isfinite(value), wp.clamp(value, -1.0, 1.0), 0.0)


@wp.func
def _within_half_turn(angle: float):
    return angle - 2.0 * wp.pi * wp.round(angle / (2.0 * wp.pi))


@wp.func
def held_target(
    settings: Settings, position: wp.vec3, yaw: float, measured: wp.transform, move: wp.vec3, turn_entry: float
):
    """Return position and yaw of the target after an action: moved, held back by lead and workspace.

    Args:
        settings: What actions mean.
        position: Commanded position of the tool [m].
        yaw: Its yaw [rad].
        measured: Measured pose of the tool.
        move: The action's entries for the position, -1..1.
        turn_entry: That for the yaw.
    """
    measured_position = wp.transform_get_translation(measured)
    moved = position + settings.translation_scale * move
    ahead = moved - measured_position
    distance = wp.length(ahead)
    if distance > settings.max_lead:
        moved = measured_position + ahead * (settings.max_lead / distance)
    moved = _clamp_into(moved, settings.workspace_lower, settings.workspace_upper)
    wanted = yaw + settings.rotation_scale * turn_entry
    measured_yaw = _tool_yaw(wp.transform_get_rotation(measured))
    turn = _within_half_turn(wanted - measured_yaw)
    return moved, measured_yaw + wp.clamp(turn, -settings.max_lead_angle, settings.max_lead_angle)


@wp.func
def down_at(yaw: float):
    """Return the rotation of a tool that points down: half a turn about y, then the yaw about the vertical."""
    return wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw) * wp.quat(0.0, 1.0, 0.0, 0.0)


@wp.func
def attained_target(position: wp.vec3, yaw: float, pose: wp.transform):
    """Return the target, or what the joints attain of it where limits or reach hold them back: it waits there."""
    attained = wp.transform_get_translation(pose)
    at = position
    if wp.length(attained - position) > 0.002:
        at = attained
    attained_yaw = _tool_yaw(wp.transform_get_rotation(pose))
    missing = _within_half_turn(yaw - attained_yaw)
    return at, wp.where(wp.abs(missing) > 0.01, attained_yaw, yaw)


@wp.func
def moved_opening(settings: Settings, opening: float, measured: float, entry: float):
    """Return the commanded opening after an action's entry for the gripper, -1..1.

    The range of commands starts below zero, so that the drives reach their limit on thin objects too. The lead is taken
    from both fingers together: with equal targets an off-centre grasp is pushed back to the middle.
    """
    lead = settings.opening_lead
    wanted = wp.lerp(-lead, settings.stroke, 0.5 * (1.0 + entry))
    moved = opening + wp.clamp(wanted - opening, -settings.opening_rate, settings.opening_rate)
    return wp.clamp(moved, measured - lead, measured + lead)


@wp.func
def _read_arm(chain: Chain, world: int, joint_q: wp.array[float]):
    q = vec7()
    for k in range(_N):
        q[k] = joint_q[chain.coord_start[world] + k]
    return q


@wp.func
def _read_opening(chain: Chain, world: int, joint_q: wp.array[float]):
    finger = chain.coord_start[world] + _N
    return joint_q[finger] + joint_q[finger + 1]


@wp.kernel
def reset_command(
    # Model:
    chain: Chain,
    # State in:
    joint_q_in: wp.array[float],
    world_mask: wp.array[wp.bool],
    # Out:
    command: Command,
):
    """Set the command of the masked worlds to the measured configuration."""
    world = wp.tid()
    if not world_mask[world]:
        return
    pose = _forward(chain, world, _read_arm(chain, world, joint_q_in))
    for k in range(_N + 2):
        value = joint_q_in[chain.coord_start[world] + k]
        command.commanded_q[world, k] = value
        command.previous_q[world, k] = value
    command.target_position[world] = wp.transform_get_translation(pose)
    command.target_yaw[world] = _tool_yaw(wp.transform_get_rotation(pose))
    command.tool_pose[world] = pose
    command.opening[world] = _read_opening(chain, world, joint_q_in)


@wp.kernel
def move_command(
    # Model:
    chain: Chain,
    settings: Settings,
    # State in:
    action: wp.array2d[float],
    joint_q_in: wp.array[float],
    # In, out:
    command: Command,
):
    """Apply one action to the command: move, clamp to workspace and lead, solve for the joints, move the gripper."""
    world = wp.tid()
    dof = chain.dof_start[world]
    measured = _read_arm(chain, world, joint_q_in)
    measured_pose = _forward(chain, world, measured)
    command.tool_pose[world] = measured_pose
    q = vec7()
    low = vec7()
    high = vec7()
    for k in range(_N + 2):
        command.previous_q[world, k] = command.commanded_q[world, k]
    for k in range(_N):
        q[k] = command.commanded_q[world, k]
        low[k] = chain.joint_limit_lower[dof + k]
        high[k] = chain.joint_limit_upper[dof + k]

    q_before = vec7(q)
    if settings.joint_mode == 1:
        lead = settings.max_lead_angle
        for k in range(_N):
            moved = q[k] + settings.joint_scale * _clean(action[world, k])
            q[k] = wp.clamp(wp.clamp(moved, measured[k] - lead, measured[k] + lead), low[k], high[k])
        pose = _forward(chain, world, q)
        position = wp.transform_get_translation(pose)
        inside = _clamp_into(position, settings.workspace_lower, settings.workspace_upper)
        if wp.length(inside - position) > 0.0:
            q = _inverse(chain, settings, world, inside, wp.transform_get_rotation(pose), q, low, high)
            # A step that cannot be brought back inside is refused, unless it leads back from farther out.
            if _outside(chain, settings, world, q) > wp.max(_outside(chain, settings, world, q_before), 1.0e-3):
                q = q_before
            pose = _forward(chain, world, q)
            position = wp.transform_get_translation(pose)
        command.target_position[world] = position
        command.target_yaw[world] = _tool_yaw(wp.transform_get_rotation(pose))
    else:
        move = wp.vec3(_clean(action[world, 0]), _clean(action[world, 1]), _clean(action[world, 2]))
        before, before_yaw = command.target_position[world], command.target_yaw[world]
        entry = _clean(action[world, 3])
        position, yaw = held_target(settings, before, before_yaw, measured_pose, move, entry)
        q = _inverse(chain, settings, world, position, down_at(yaw), q, low, high)
        position, yaw = attained_target(position, yaw, _forward(chain, world, q))
        command.target_position[world] = position
        command.target_yaw[world] = yaw

    for k in range(_N):
        command.commanded_q[world, k] = q[k]
    measured_opening = _read_opening(chain, world, joint_q_in)
    command.opening[world] = measured_opening
    opening = command.commanded_q[world, _N] + command.commanded_q[world, _N + 1]
    opening = moved_opening(settings, opening, measured_opening, _clean(action[world, action.shape[1] - 1]))
    command.commanded_q[world, _N] = 0.5 * opening
    command.commanded_q[world, _N + 1] = 0.5 * opening


@wp.kernel
def write_targets(
    chain: Chain,
    command: Command,
    fraction: float,
    # Out:
    joint_target_q_out: wp.array[float],
):
    """Interpolate the position targets between two commands."""
    world, k = wp.tid()
    target = wp.lerp(command.previous_q[world, k], command.commanded_q[world, k], fraction)
    joint_target_q_out[chain.coord_start[world] + k] = target


@wp.kernel
def measure(
    # Model:
    chain: Chain,
    # State in:
    joint_q_in: wp.array[float],
    # Out:
    command: Command,
):
    """Compute the tool's pose and the distance between the pads."""
    world = wp.tid()
    command.tool_pose[world] = _forward(chain, world, _read_arm(chain, world, joint_q_in))
    command.opening[world] = _read_opening(chain, world, joint_q_in)
