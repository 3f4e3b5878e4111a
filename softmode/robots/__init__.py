"""Robots: frozen descriptions, the functions that add them to a Newton builder, and their controllers."""

from softmode.robots.arm import ArmDescription, ArmIndices, GripperDescription, add_arm
from softmode.robots.control import ArmController, ArmControlOptions

__all__ = ["ArmControlOptions", "ArmController", "ArmDescription", "ArmIndices", "GripperDescription", "add_arm"]
