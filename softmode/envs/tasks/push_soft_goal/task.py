"""PushSoftGoal: push a soft object to a place on the table, goal-conditioned."""

from __future__ import annotations

from dataclasses import dataclass

from softmode.envs.goals import PositionGoalMethods, PositionGoals
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.tasks.push_soft.task import PushSoft, PushSoftConfig
from softmode.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class PushSoftGoalConfig(PushSoftConfig):
    """Goal and reward of PushSoftGoal."""

    terms_follow_mode = True
    reward_mode: str = "sparse"
    """"sparse": 0 at the goal and -1 elsewhere; "dense": minus the distance [m]."""

    def __post_init__(self) -> None:
        """Refuse goals that are no places."""
        super().__post_init__()
        if self.yaw_tolerance is not None:
            raise ConfigError(
                f"yaw_tolerance is {self.yaw_tolerance}, the goals of PushSoftGoal are places", hint="leave it None"
            )


class PushSoftGoal(PositionGoals, PushSoft):
    """push a soft object to a place on the table, goal-conditioned.

    See `PositionGoals` for observation, reward and success; scene, draws and scripted policy are those of `PushSoft`.
    """

    config_class = PushSoftGoalConfig
    goal_size = 2


class PushSoftGoalEnv(PositionGoalMethods, SoftEnv[PushSoftGoal]):
    """The environment of one world; see :class:`PushSoftGoal` and :class:`SoftEnv`."""


class PushSoftGoalVectorEnv(PositionGoalMethods, SoftVectorEnv[PushSoftGoal]):
    """Many worlds of it; see :class:`PushSoftGoal` and :class:`SoftVectorEnv`."""
