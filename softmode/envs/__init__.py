"""Gymnasium environments of soft objects: tasks, what tasks are made of, scripted policies, checks and adapters.

Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.envs.adapters import RslRlVecEnv, SkrlWrapper, StableBaselinesVecEnv
    from softmode.envs.check import VectorEnvReport, check_vector_env
    from softmode.envs.end_reason import EndReason
    from softmode.envs.observation import Segment
    from softmode.envs.parameters import Parameter
    from softmode.envs.presets import rl_scene
    from softmode.envs.scripted import scripted_policy
    from softmode.envs.soft_env import SoftEnv
    from softmode.envs.soft_vector_env import SoftVectorEnv
    from softmode.envs.task import Task
    from softmode.envs.task_config import TaskConfig
    from softmode.envs.tasks.lift_soft.task import LiftSoft, LiftSoftConfig, LiftSoftEnv, LiftSoftVectorEnv
    from softmode.envs.tasks.place_in_bin.task import PlaceInBin, PlaceInBinConfig, PlaceInBinEnv, PlaceInBinVectorEnv
    from softmode.envs.tasks.press_soft.task import PressSoft, PressSoftConfig, PressSoftEnv, PressSoftVectorEnv
    from softmode.envs.tasks.push_soft.task import PushSoft, PushSoftConfig, PushSoftEnv, PushSoftVectorEnv
    from softmode.envs.tasks.rope_route.task import RopeRoute, RopeRouteConfig, RopeRouteEnv, RopeRouteVectorEnv
    from softmode.envs.tasks.shape_soft.config import ShapeSoftConfig
    from softmode.envs.tasks.shape_soft.task import ShapeSoft, ShapeSoftEnv, ShapeSoftVectorEnv
    from softmode.envs.throughput import measure_throughput

__all__ = [
    "EndReason",
    "LiftSoft",
    "LiftSoftConfig",
    "LiftSoftEnv",
    "LiftSoftVectorEnv",
    "Parameter",
    "PlaceInBin",
    "PlaceInBinConfig",
    "PlaceInBinEnv",
    "PlaceInBinVectorEnv",
    "PressSoft",
    "PressSoftConfig",
    "PressSoftEnv",
    "PressSoftVectorEnv",
    "PushSoft",
    "PushSoftConfig",
    "PushSoftEnv",
    "PushSoftVectorEnv",
    "RopeRoute",
    "RopeRouteConfig",
    "RopeRouteEnv",
    "RopeRouteVectorEnv",
    "RslRlVecEnv",
    "Segment",
    "ShapeSoft",
    "ShapeSoftConfig",
    "ShapeSoftEnv",
    "ShapeSoftVectorEnv",
    "SkrlWrapper",
    "SoftEnv",
    "SoftVectorEnv",
    "StableBaselinesVecEnv",
    "Task",
    "TaskConfig",
    "VectorEnvReport",
    "check_vector_env",
    "measure_throughput",
    "rl_scene",
    "scripted_policy",
]

_HOME = {
    "adapters": "RslRlVecEnv SkrlWrapper StableBaselinesVecEnv",
    "check": "VectorEnvReport check_vector_env",
    "end_reason": "EndReason",
    "observation": "Segment",
    "parameters": "Parameter",
    "presets": "rl_scene",
    "scripted": "scripted_policy",
    "soft_env": "SoftEnv",
    "soft_vector_env": "SoftVectorEnv",
    "task": "Task",
    "task_config": "TaskConfig",
    "tasks.lift_soft.task": "LiftSoft LiftSoftConfig LiftSoftEnv LiftSoftVectorEnv",
    "tasks.place_in_bin.task": "PlaceInBin PlaceInBinConfig PlaceInBinEnv PlaceInBinVectorEnv",
    "tasks.press_soft.task": "PressSoft PressSoftConfig PressSoftEnv PressSoftVectorEnv",
    "tasks.push_soft.task": "PushSoft PushSoftConfig PushSoftEnv PushSoftVectorEnv",
    "tasks.rope_route.task": "RopeRoute RopeRouteConfig RopeRouteEnv RopeRouteVectorEnv",
    "tasks.shape_soft.config": "ShapeSoftConfig",
    "tasks.shape_soft.task": "ShapeSoft ShapeSoftEnv ShapeSoftVectorEnv",
    "throughput": "measure_throughput",
}
"""Names by the module that they come from."""


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    for module, names in _HOME.items():
        if name in names.split():
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
