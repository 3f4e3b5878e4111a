"""Robots: frozen descriptions, the functions that add them to a Newton builder, and their controllers.

The primitive arm (:class:`ArmDescription`) needs no file; :func:`load` reads others by name or path. Names are loaded
when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.robots.arm import ArmDescription, ArmIndices, GripperDescription, add_arm
    from softmode.robots.assets import available, fetch
    from softmode.robots.control import ArmController, ArmControlOptions
    from softmode.robots.description import JointDrive, RobotDescription, RobotGripper, RobotIndices
    from softmode.robots.loading import load
    from softmode.robots.soft_fingertips import SoftFingertips, add_soft_fingertips

__all__ = [
    "ArmControlOptions",
    "ArmController",
    "ArmDescription",
    "ArmIndices",
    "GripperDescription",
    "JointDrive",
    "RobotDescription",
    "RobotGripper",
    "RobotIndices",
    "SoftFingertips",
    "add_arm",
    "add_soft_fingertips",
    "available",
    "fetch",
    "load",
]

_HOME = {
    "arm": "ArmDescription ArmIndices GripperDescription add_arm",
    "assets": "available fetch",
    "control": "ArmControlOptions ArmController",
    "description": "JointDrive RobotDescription RobotGripper RobotIndices",
    "loading": "load",
    "soft_fingertips": "SoftFingertips add_soft_fingertips",
}
"""Names by the module that they come from."""


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    for module, names in _HOME.items():
        if name in names.split():
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
