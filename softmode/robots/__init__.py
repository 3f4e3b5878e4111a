"""Robots: frozen descriptions, the functions that add them to a Newton builder, and their controllers.

The primitive arm (:class:`ArmDescription`) needs no file; :func:`load` reads others by name or path. Names are loaded
when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.robots.arm import ArmDescription, ArmIndices, GripperDescription, add_arm
    from softmode.robots.assets import available, fetch
    from softmode.robots.chain import SerialChain, serial_chain
    from softmode.robots.control import ArmController, ArmControlOptions
    from softmode.robots.description import JointDrive, RobotDescription, RobotGripper, RobotIndices
    from softmode.robots.fingertips import Fingertips
    from softmode.robots.grasp_planner import Grasp, plan_grasps
    from softmode.robots.jaws import ParallelJaw
    from softmode.robots.loading import load
    from softmode.robots.robot_control import RobotController
    from softmode.robots.soft_fingertips import SoftFingertips, add_soft_fingertips
    from softmode.robots.table_robot import TableRobot, place_robot

__all__ = [
    "ArmControlOptions",
    "ArmController",
    "ArmDescription",
    "ArmIndices",
    "Fingertips",
    "Grasp",
    "GripperDescription",
    "JointDrive",
    "ParallelJaw",
    "RobotController",
    "RobotDescription",
    "RobotGripper",
    "RobotIndices",
    "SerialChain",
    "SoftFingertips",
    "TableRobot",
    "add_arm",
    "add_soft_fingertips",
    "available",
    "fetch",
    "load",
    "place_robot",
    "plan_grasps",
    "serial_chain",
]

__getattr__, __dir__ = lazy_names(__name__)
