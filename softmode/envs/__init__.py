"""Gymnasium environments of soft objects: tasks, what tasks are made of, scripted policies, checks and adapters.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.envs.adapters import RslRlVecEnv as RslRlVecEnv
    from softmode.envs.adapters import SkrlWrapper as SkrlWrapper
    from softmode.envs.adapters import StableBaselinesVecEnv as StableBaselinesVecEnv
    from softmode.envs.env_state import EnvState as EnvState
    from softmode.envs.observation import Segment as Segment
    from softmode.envs.parameters import Parameter as Parameter
    from softmode.envs.presets import rl_scene as rl_scene
    from softmode.envs.reward_kernels import EndReason as EndReason
    from softmode.envs.reward_kernels import StepResult as StepResult
    from softmode.envs.reward_kernels import WorldState as WorldState
    from softmode.envs.reward_kernels import count_held as count_held
    from softmode.envs.reward_kernels import surface_point as surface_point
    from softmode.envs.reward_kernels import tool_position as tool_position
    from softmode.envs.reward_kernels import write as write
    from softmode.envs.scripted import ScriptedPolicy as ScriptedPolicy
    from softmode.envs.scripted import scripted_policy as scripted_policy
    from softmode.envs.scripted import scripted_worlds as scripted_worlds
    from softmode.envs.soft_env import SoftEnv as SoftEnv
    from softmode.envs.soft_vector_env import SoftVectorEnv as SoftVectorEnv
    from softmode.envs.spec import env_spec as env_spec
    from softmode.envs.task import Task as Task
    from softmode.envs.task_config import TaskConfig as TaskConfig
    from softmode.envs.tasks.lift_soft.task import LiftSoft as LiftSoft
    from softmode.envs.tasks.lift_soft.task import LiftSoftConfig as LiftSoftConfig
    from softmode.envs.tasks.lift_soft.task import LiftSoftEnv as LiftSoftEnv
    from softmode.envs.tasks.lift_soft.task import LiftSoftVectorEnv as LiftSoftVectorEnv
    from softmode.envs.tasks.lift_soft_goal.task import LiftSoftGoal as LiftSoftGoal
    from softmode.envs.tasks.lift_soft_goal.task import LiftSoftGoalConfig as LiftSoftGoalConfig
    from softmode.envs.tasks.lift_soft_goal.task import LiftSoftGoalEnv as LiftSoftGoalEnv
    from softmode.envs.tasks.lift_soft_goal.task import LiftSoftGoalVectorEnv as LiftSoftGoalVectorEnv
    from softmode.envs.tasks.place_in_bin.task import PlaceInBin as PlaceInBin
    from softmode.envs.tasks.place_in_bin.task import PlaceInBinConfig as PlaceInBinConfig
    from softmode.envs.tasks.place_in_bin.task import PlaceInBinEnv as PlaceInBinEnv
    from softmode.envs.tasks.place_in_bin.task import PlaceInBinVectorEnv as PlaceInBinVectorEnv
    from softmode.envs.tasks.press_soft.task import PressSoft as PressSoft
    from softmode.envs.tasks.press_soft.task import PressSoftConfig as PressSoftConfig
    from softmode.envs.tasks.press_soft.task import PressSoftEnv as PressSoftEnv
    from softmode.envs.tasks.press_soft.task import PressSoftVectorEnv as PressSoftVectorEnv
    from softmode.envs.tasks.push_soft.task import PushSoft as PushSoft
    from softmode.envs.tasks.push_soft.task import PushSoftConfig as PushSoftConfig
    from softmode.envs.tasks.push_soft.task import PushSoftEnv as PushSoftEnv
    from softmode.envs.tasks.push_soft.task import PushSoftVectorEnv as PushSoftVectorEnv
    from softmode.envs.tasks.push_soft_goal.task import PushSoftGoal as PushSoftGoal
    from softmode.envs.tasks.push_soft_goal.task import PushSoftGoalConfig as PushSoftGoalConfig
    from softmode.envs.tasks.push_soft_goal.task import PushSoftGoalEnv as PushSoftGoalEnv
    from softmode.envs.tasks.push_soft_goal.task import PushSoftGoalVectorEnv as PushSoftGoalVectorEnv
    from softmode.envs.tasks.rope_route.task import RopeRoute as RopeRoute
    from softmode.envs.tasks.rope_route.task import RopeRouteConfig as RopeRouteConfig
    from softmode.envs.tasks.rope_route.task import RopeRouteEnv as RopeRouteEnv
    from softmode.envs.tasks.rope_route.task import RopeRouteVectorEnv as RopeRouteVectorEnv
    from softmode.envs.tasks.shape_soft.config import ShapeSoftConfig as ShapeSoftConfig
    from softmode.envs.tasks.shape_soft.task import ShapeSoft as ShapeSoft
    from softmode.envs.tasks.shape_soft.task import ShapeSoftEnv as ShapeSoftEnv
    from softmode.envs.tasks.shape_soft.task import ShapeSoftVectorEnv as ShapeSoftVectorEnv
    from softmode.envs.throughput import measure_throughput as measure_throughput
    from softmode.vector_check import VectorEnvReport as VectorEnvReport
    from softmode.vector_check import check_vector_env as check_vector_env

__getattr__, __dir__ = lazy_names(__name__)
