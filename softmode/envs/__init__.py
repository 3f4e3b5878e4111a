"""Gymnasium environments of soft objects: tasks, what tasks are made of, scripted policies, checks and adapters.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.envs.adapters import RslRlVecEnv, SkrlWrapper, StableBaselinesVecEnv
    from softmode.envs.end_reason import EndReason
    from softmode.envs.env_state import EnvState
    from softmode.envs.observation import Segment
    from softmode.envs.parameters import Parameter
    from softmode.envs.presets import rl_scene
    from softmode.envs.reward_kernels import WorldState
    from softmode.envs.scripted import scripted_policy, scripted_worlds
    from softmode.envs.scripted_base import ScriptedPolicy
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
    from softmode.envs.term_task import TermTask
    from softmode.envs.terms import (
        CurriculumTerm,
        EventTerm,
        MetricTerm,
        ObservationTerm,
        RewardTerm,
        SuccessTerm,
        TermConfig,
        TerminationTerm,
        Terms,
    )
    from softmode.envs.throughput import measure_throughput
    from softmode.vector_check import VectorEnvReport, check_vector_env

__all__ = [
    "CurriculumTerm",
    "EndReason",
    "EnvState",
    "EventTerm",
    "LiftSoft",
    "LiftSoftConfig",
    "LiftSoftEnv",
    "LiftSoftGoal",
    "LiftSoftGoalConfig",
    "LiftSoftGoalEnv",
    "LiftSoftGoalVectorEnv",
    "LiftSoftVectorEnv",
    "MetricTerm",
    "ObservationTerm",
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
    "RewardTerm",
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
    "SuccessTerm",
    "Task",
    "TaskConfig",
    "TermConfig",
    "TermTask",
    "TerminationTerm",
    "Terms",
    "VectorEnvReport",
    "WorldState",
    "check_vector_env",
    "measure_throughput",
    "rl_scene",
    "scripted_policy",
    "scripted_worlds",
]

__getattr__, __dir__ = lazy_names(__name__)
