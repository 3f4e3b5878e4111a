"""The controller of loaded robots: the actions of :class:`ArmController` for arms of five to eight joints."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.model.structs import filled
from softmode.robots import robot_control_kernels as kernels
from softmode.robots.arm import ArmDescription, ArmIndices
from softmode.robots.chain import serial_chain
from softmode.robots.control import ArmController, ArmControlOptions, Controller
from softmode.robots.description import RobotIndices
from softmode.robots.table_robot import TableRobot, base_pose


class RobotController(Controller):
    """The controller of a loaded robot, with the actions, methods and attributes of :class:`ArmController`.

    The tool is the frame between the pads (:attr:`ParallelJaw.frame`). A table of measured gaps turns the commanded
    distance between the fingers into the gripper's joints.

    Args:
        model: The finalised model; its worlds are copies of the builder that the robot was added to.
        table_robot: The robot at the table.
        arm: What its `add_to` returned.
        options: The action's meaning.
    """

    kernels = kernels

    def __init__(
        self,
        model: newton.Model,
        table_robot: TableRobot,
        arm: RobotIndices,
        options: ArmControlOptions | None = None,
    ) -> None:
        """Allocate the command of every world and set it to the model's initial coordinates."""
        self.table_robot = table_robot
        super().__init__(model, arm, table_robot.gripper, table_robot.chain.joints, options)

    def _chain_of(self, model: newton.Model) -> Any:
        """Return the joints between base and tool in the world frame, and the gripper."""
        robot, chain = self.table_robot.robot, self.table_robot.chain
        fingers = robot.gripper
        assert fingers is not None
        base = base_pose(self.table_robot.base)
        turn = Rotation.from_quat(base[3:])

        def array(values: object, dtype: type = wp.float32) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=model.device)

        return filled(
            kernels.RobotChain,
            count=self.joint_count,
            axis=array(turn.apply(chain.axis), wp.vec3),
            anchor=array(turn.apply(chain.anchor) + base[:3], wp.vec3),
            slide=array(chain.slide.astype(np.int32), wp.int32),
            lower=array(np.maximum(chain.lower, -1.0e3)),
            upper=array(np.minimum(chain.upper, 1.0e3)),
            home=kernels.vec8(*chain.home.tolist(), *([0.0] * (kernels.JOINT_MAX - self.joint_count))),
            leader=array(chain.leader, wp.int32),
            ratio=array(chain.ratio),
            offset=array(chain.offset),
            tool=_tool_at_zero(self.table_robot),
            follow=self.table_robot.jaw.follow,
            coord_start=self.coord_start,
            joint=self.joint_columns,
            finger=array([robot.joint_names.index(name) for name in fingers.joints], wp.int32),
            closed=array(fingers.closed),
            open=array(fingers.open),
            gap=array(self.table_robot.gaps),
        )


def controller_of(
    model: newton.Model,
    description: ArmDescription | TableRobot,
    arm: ArmIndices | RobotIndices,
    options: ArmControlOptions | None = None,
) -> Controller:
    """Return the controller of a robot at the table, the built-in arm's or a loaded one's."""
    if isinstance(description, TableRobot) and isinstance(arm, RobotIndices):
        return RobotController(model, description, arm, options)
    assert isinstance(arm, ArmIndices)
    return ArmController(model, arm, options)


def _tool_at_zero(table_robot: TableRobot) -> wp.transform:
    """Return the tool in the world at zero coordinates, with the fingers closed."""
    chain, base = serial_chain(table_robot.robot, table_robot.jaw.frame), base_pose(table_robot.base)
    turn = Rotation.from_quat(base[3:])
    position = turn.apply(chain.tool_position) + base[:3]
    rotation = (turn * Rotation.from_matrix(chain.tool_rotation)).as_quat()
    return wp.transform(*position.tolist(), *rotation.tolist())
