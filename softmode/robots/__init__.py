"""Robots: frozen descriptions, the functions that add them to a Newton builder, and their controllers.

The primitive arm (:class:`ArmDescription`) needs no file; :func:`load` reads others by name or path. Names are loaded
when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.robots.arm import ArmDescription as ArmDescription
    from softmode.robots.arm import ArmIndices as ArmIndices
    from softmode.robots.arm import GripperDescription as GripperDescription
    from softmode.robots.arm import add_arm as add_arm
    from softmode.robots.assets import available as available
    from softmode.robots.assets import fetch as fetch
    from softmode.robots.chain import SerialChain as SerialChain
    from softmode.robots.chain import serial_chain as serial_chain
    from softmode.robots.control import ArmController as ArmController
    from softmode.robots.control import ArmControlOptions as ArmControlOptions
    from softmode.robots.description import JointDrive as JointDrive
    from softmode.robots.description import RobotDescription as RobotDescription
    from softmode.robots.description import RobotGripper as RobotGripper
    from softmode.robots.description import RobotIndices as RobotIndices
    from softmode.robots.fingertips import Fingertips as Fingertips
    from softmode.robots.grasp_planner import Grasp as Grasp
    from softmode.robots.grasp_planner import plan_grasps as plan_grasps
    from softmode.robots.jaws import ParallelJaw as ParallelJaw
    from softmode.robots.loading import load as load
    from softmode.robots.robot_control import RobotController as RobotController
    from softmode.robots.soft_fingertips import SoftFingertips as SoftFingertips
    from softmode.robots.soft_fingertips import add_soft_fingertips as add_soft_fingertips
    from softmode.robots.table_robot import TableRobot as TableRobot
    from softmode.robots.table_robot import place_robot as place_robot

__getattr__, __dir__ = lazy_names(__name__)
