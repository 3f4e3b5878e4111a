"""The controller of loaded robots: the actions of :class:`ArmController` for arms of five to eight joints."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.errors import ConfigError
from softmode.robots import robot_control_kernels as kernels
from softmode.robots.arm import ArmDescription, ArmIndices
from softmode.robots.control import ArmController, ArmControlOptions
from softmode.robots.control_kernels import Command, Settings
from softmode.robots.description import RobotIndices
from softmode.robots.table_robot import TableRobot, base_pose


class RobotController:
    """Holds the commanded configuration of a loaded robot in every world and writes the joint targets.

    Actions, methods and attributes are those of :class:`ArmController`. The tool is the frame between the pads
    (:attr:`ParallelJaw.frame`). ``commanded_q`` holds the joints between base and tool, then twice half the commanded
    distance between the fingers [m]; a table of measured gaps turns that into the gripper's joints.

    Args:
        model: The finalised model; its worlds are copies of the builder that the robot was added to.
        table_robot: The robot at the table.
        arm: What its `add_to` returned.
        options: The action's meaning.
    """

    def __init__(
        self,
        model: newton.Model,
        table_robot: TableRobot,
        arm: RobotIndices,
        options: ArmControlOptions | None = None,
    ) -> None:
        """Allocate the command of every world and set it to the model's initial coordinates."""
        self.options = options if options is not None else ArmControlOptions()
        self.arm = arm
        self.world_count = w = max(model.world_count, 1)
        self._device = device = model.device
        world_start = model.joint_coord_world_start
        assert world_start is not None
        start = world_start.numpy()
        offset = start[:w] if start[w] > start[0] else np.zeros(w, dtype=np.int32)
        self.coord_start = wp.array(offset + arm.coord_start, dtype=wp.int32, device=device)
        robot, chain, gripper = table_robot.robot, table_robot.chain, table_robot.gripper
        fingers = robot.gripper
        assert fingers is not None
        self.joint_count = n = len(chain.joints)
        self.action_size = 5 if self.options.mode == "pose_delta" else n + 1
        base = base_pose(table_robot.base)
        turn = Rotation.from_quat(base[3:])
        world, points = turn.apply(chain.axis), turn.apply(chain.anchor) + base[:3]
        rest = _tool_at_zero(table_robot)
        low, high = np.maximum(chain.lower, -1.0e3), np.minimum(chain.upper, 1.0e3)

        def array(values: object, dtype: type = wp.float32) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=device)

        self.joint_columns = array(chain.joints, wp.int32)
        """Coordinates of the joints between base and tool in the robot, (joint_count,)."""
        self._chain = filled(
            kernels.RobotChain,
            count=n,
            axis=array(world, wp.vec3),
            anchor=array(points, wp.vec3),
            slide=array(chain.slide.astype(np.int32), wp.int32),
            lower=array(low),
            upper=array(high),
            home=kernels.vec8(*chain.home.tolist(), *([0.0] * (kernels.JOINT_MAX - n))),
            leader=array(chain.leader, wp.int32),
            ratio=array(chain.ratio),
            offset=array(chain.offset),
            tool=rest,
            coord_start=self.coord_start,
            joint=self.joint_columns,
            finger=array([robot.joint_names.index(name) for name in fingers.joints], wp.int32),
            closed=array(fingers.closed),
            open=array(fingers.open),
            gap=array(table_robot.gaps),
        )
        lead = self.options.squeeze_lead * 2.0 * gripper.force_limit / gripper.drive_stiffness
        joint_mode = int(self.options.mode == "joint_delta")
        self._settings = filled(Settings, self.options, gripper, joint_mode=joint_mode, opening_lead=lead)
        self.commanded_q = wp.zeros((w, n + 2), dtype=wp.float32, device=device)
        self.tool_pose = wp.zeros(w, dtype=wp.transform, device=device)
        self.opening = wp.zeros(w, dtype=wp.float32, device=device)
        self.target_position = wp.zeros(w, dtype=wp.vec3, device=device)
        self.target_yaw = wp.zeros(w, dtype=wp.float32, device=device)
        self.previous_q = wp.zeros_like(self.commanded_q)
        """The command before the last one, from which targets move on."""
        self._command = filled(Command, self)
        self._everywhere = wp.ones(w, dtype=wp.bool, device=device)
        self._reset(model.joint_q, self._everywhere)

    def reset(self, state: newton.State, world_mask: wp.array | None = None) -> None:
        """Set the command of the masked worlds, all if omitted, to the measured configuration."""
        self._reset(state.joint_q, world_mask if world_mask is not None else self._everywhere)

    def _reset(self, joint_q: wp.array | None, world_mask: wp.array) -> None:
        launch(self._device, kernels.reset_command, self.world_count, self._chain, joint_q, world_mask, self._command)

    def command(self, action: wp.array, state: newton.State) -> None:
        """Move the command by one action, shape (world_count, action_size); see :meth:`ArmController.command`."""
        if action.shape != (self.world_count, self.action_size):
            hint = f"expected ({self.world_count}, {self.action_size}) in mode {self.options.mode!r}"
            raise ConfigError(f"action has shape {tuple(action.shape)}", hint=hint)
        arguments = (self._chain, self._settings, action, state.joint_q, self._command)
        launch(self._device, kernels.move_command, self.world_count, *arguments)

    def write_targets(self, control: newton.Control, fraction: float = 1.0) -> None:
        """Write the drives' position targets, on the line from the previous command to the present one."""
        arguments = (self._chain, self._command, fraction, control.joint_target_q)
        launch(self._device, kernels.write_targets, self.world_count, *arguments)

    def measure(self, state: newton.State) -> None:
        """Update `tool_pose` and `opening` from the measured joint coordinates."""
        launch(self._device, kernels.measure, self.world_count, self._chain, state.joint_q, self._command)


def controller_of(
    model: newton.Model,
    description: ArmDescription | TableRobot,
    arm: ArmIndices | RobotIndices,
    options: ArmControlOptions | None = None,
) -> ArmController | RobotController:
    """Return the controller of a robot at the table, the built-in arm's or a loaded one's."""
    if isinstance(description, TableRobot) and isinstance(arm, RobotIndices):
        return RobotController(model, description, arm, options)
    assert isinstance(arm, ArmIndices)
    return ArmController(model, arm, options)


def _tool_at_zero(table_robot: TableRobot) -> wp.transform:
    """Return the tool in the world at zero coordinates."""
    chain, base = table_robot.chain, base_pose(table_robot.base)
    turn = Rotation.from_quat(base[3:])
    position = turn.apply(chain.tool_position) + base[:3]
    rotation = (turn * Rotation.from_matrix(chain.tool_rotation)).as_quat()
    return wp.transform(*position.tolist(), *rotation.tolist())
