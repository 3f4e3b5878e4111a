"""LiftSoftGoal: lift a soft object to a place in the air, goal-conditioned."""

from __future__ import annotations

from dataclasses import dataclass

from softmode.envs.goals import PositionGoalMethods, PositionGoals
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.tasks.lift_soft.task import LiftSoft, LiftSoftConfig


@dataclass(frozen=True, kw_only=True)
class LiftSoftGoalConfig(LiftSoftConfig):
    """Goal and reward of LiftSoftGoal."""

    terms_follow_mode = True
    reward_mode: str = "sparse"
    """"sparse": 0 at the goal and -1 elsewhere; "dense": minus the distance [m]."""


class LiftSoftGoal(PositionGoals, LiftSoft):
    """lift a soft object to a place in the air, goal-conditioned.

    See `PositionGoals` for observation, reward and success; scene, draws and scripted policy are those of `LiftSoft`.
    """

    config_class = LiftSoftGoalConfig
    goal_size = 3


class LiftSoftGoalEnv(PositionGoalMethods, SoftEnv[LiftSoftGoal]):
    """The environment of one world; see :class:`LiftSoftGoal` and :class:`SoftEnv`."""


class LiftSoftGoalVectorEnv(PositionGoalMethods, SoftVectorEnv[LiftSoftGoal]):
    """Many worlds of it; see :class:`LiftSoftGoal` and :class:`SoftVectorEnv`."""
