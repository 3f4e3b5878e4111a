"""Tasks whose goal is a place of the object, in the form that goal-conditioned learners take."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import warp as wp

from softmode.deformables.model.structs import filled
from softmode.envs import goal_kernels as kernels
from softmode.envs.goals import GoalMethods
from softmode.envs.observation import PROPRIOCEPTION, Segment
from softmode.envs.task import Task


def goal_rules(config: Any, goal_size: int) -> Any:
    """Return what the reward depends on beside the goals, of a configuration with the fields of `PositionGoals`."""
    sparse = int(config.reward_mode == "sparse")
    arm_size = sum(segment.size for segment in PROPRIOCEPTION)
    return filled(kernels.GoalRules, config, goal_size=goal_size, sparse=sparse, arm_size=arm_size)


class PositionGoals(Task):
    """A goal-conditioned variant of a task that observes a place as ``goal``; put it before that task.

    A state observation is a dict: ``achieved_goal`` is the object's centre of mass [m], ``desired_goal`` where it is to
    be, the first `goal_size` of x, y, z, and ``observation`` the object's part and proprioception, nothing of the goal.
    The full vector has the parts of the other task as well, so that its scripted policy plays this one too.

    The reward is a function of both goals, ``GoalMethods.compute_reward``; its one term is ``goal``. Success: within
    ``goal_tolerance`` for ``hold_steps`` steps in a row.
    """

    goal_size: ClassVar[int] = 3
    """Numbers of a goal."""
    term_names = ("goal",)

    def object_segments(self) -> tuple[Segment, ...]:
        """Proprioception again, so that what does not depend on the goal is one range, both goals, and the task's."""
        low, high = (np.concatenate(part) for part in zip(*(s.bounds() for s in PROPRIOCEPTION), strict=True))
        return (
            Segment("arm", len(low), tuple(low.tolist()), tuple(high.tolist())),
            Segment("achieved_goal", self.goal_size, -2.0, 2.0),
            Segment("desired_goal", self.goal_size, -2.0, 2.0),
            *super().object_segments(),
        )

    def state_keys(self) -> dict[str, slice]:
        """Return the columns of observation and goals."""
        goals = {name: self.segments[name][0] for name in ("achieved_goal", "desired_goal")}
        return {"observation": slice(self.column("object_position"), self.column("achieved_goal")), **goals}

    def build(self) -> None:
        """Find the columns."""
        super().build()
        self._goal_columns = self.layout.columns_in(kernels.GoalColumns)
        self._goal_rules = goal_rules(self.config, self.goal_size)

    def observe(self) -> None:
        """Write both goals."""
        super().observe()
        self.launch(kernels.observe_goals, [self._goal_columns, self._goal_rules], [self.result])

    def evaluate(self) -> None:
        """Write the reward and whether the goal is met."""
        self.launch(kernels.evaluate_goals, [self._goal_columns, self._goal_rules], [self.result])


class PositionGoalMethods(GoalMethods):
    """Rewards of places."""

    config: Any

    def launch_reward(self, achieved: wp.array, desired: wp.array, reward: wp.array) -> None:
        """Compute the rewards of pairs of places."""
        inputs = [achieved, desired, goal_rules(self.config, self.goal_size)]
        wp.launch(kernels.compute_goal_reward, reward.shape[0], inputs=inputs, outputs=[reward], device=reward.device)
