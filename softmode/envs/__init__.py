"""Gymnasium environments of soft objects: tasks, what tasks are made of, scripted policies, checks and adapters.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.envs.adapters import RslRlVecEnv, SkrlWrapper, StableBaselinesVecEnv
    from softmode.envs.env_state import EnvState
    from softmode.envs.observation import Segment
    from softmode.envs.parameters import Parameter
    from softmode.envs.presets import rl_scene
    from softmode.envs.reward_kernels import (
        EndReason,
        StepResult,
        WorldState,
        count_held,
        surface_point,
        tool_position,
        write,
    )
    from softmode.envs.scripted import ScriptedPolicy, scripted_policy, scripted_worlds
    from softmode.envs.soft_env import SoftEnv
    from softmode.envs.soft_vector_env import SoftVectorEnv
    from softmode.envs.task import Task
    from softmode.envs.task_config import TaskConfig
    from softmode.envs.tasks.lift_soft.task import LiftSoft, LiftSoftConfig, LiftSoftEnv, LiftSoftVectorEnv
    from softmode.envs.tasks.lift_soft_goal.task import (
        LiftSoftGoal,
        LiftSoftGoalConfig,
        LiftSoftGoalEnv,
        LiftSoftGoalVectorEnv,
    )
    from softmode.envs.tasks.place_in_bin.task import PlaceInBin, PlaceInBinConfig, PlaceInBinEnv, PlaceInBinVectorEnv
    from softmode.envs.tasks.press_soft.task import PressSoft, PressSoftConfig, PressSoftEnv, PressSoftVectorEnv
    from softmode.envs.tasks.push_soft.task import PushSoft, PushSoftConfig, PushSoftEnv, PushSoftVectorEnv
    from softmode.envs.tasks.push_soft_goal.task import (
        PushSoftGoal,
        PushSoftGoalConfig,
        PushSoftGoalEnv,
        PushSoftGoalVectorEnv,
    )
    from softmode.envs.tasks.rope_route.task import RopeRoute, RopeRouteConfig, RopeRouteEnv, RopeRouteVectorEnv
    from softmode.envs.tasks.shape_soft.config import ShapeSoftConfig
    from softmode.envs.tasks.shape_soft.task import ShapeSoft, ShapeSoftEnv, ShapeSoftVectorEnv
    from softmode.envs.throughput import measure_throughput
    from softmode.vector_check import VectorEnvReport, check_vector_env

__all__ = [
    "EndReason",
    "EnvState",
    "LiftSoft",
    "LiftSoftConfig",
    "LiftSoftEnv",
    "LiftSoftGoal",
    "LiftSoftGoalConfig",
    "LiftSoftGoalEnv",
    "LiftSoftGoalVectorEnv",
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
    "PushSoftGoal",
    "PushSoftGoalConfig",
    "PushSoftGoalEnv",
    "PushSoftGoalVectorEnv",
    "PushSoftVectorEnv",
    "RopeRoute",
    "RopeRouteConfig",
    "RopeRouteEnv",
    "RopeRouteVectorEnv",
    "RslRlVecEnv",
    "ScriptedPolicy",
    "Segment",
    "ShapeSoft",
    "ShapeSoftConfig",
    "ShapeSoftEnv",
    "ShapeSoftVectorEnv",
    "SkrlWrapper",
    "SoftEnv",
    "SoftVectorEnv",
    "StableBaselinesVecEnv",
    "StepResult",
    "Task",
    "TaskConfig",
    "VectorEnvReport",
    "WorldState",
    "check_vector_env",
    "count_held",
    "measure_throughput",
    "rl_scene",
    "scripted_policy",
    "scripted_worlds",
    "surface_point",
    "tool_position",
    "write",
]

__getattr__, __dir__ = lazy_names(__name__)
