"""What goal-conditioned learners, such as hindsight experience replay, ask of ShapeSoft's environments."""

from __future__ import annotations

from typing import Any

import warp as wp

from softmode.deformables.model.structs import filled
from softmode.envs.goals import GoalMethods
from softmode.envs.tasks.shape_soft import kernels
from softmode.envs.tasks.shape_soft.config import ShapeSoftConfig

POINTS = 12
"""Points of a goal."""


def reward_rules(config: ShapeSoftConfig) -> Any:
    """Return what the reward depends on beside the goals."""
    rules = filled(kernels.Rules, config, point_count=POINTS, sparse=int(config.reward_mode == "sparse"))
    if config.reward_mode == "log_mass":
        rules.reward_length, rules.goal_tolerance = config.log_mass_length, config.log_mass_tolerance
    else:
        rules.log_mass_spacing = 0.0
    return rules


class ShapeGoals(GoalMethods):
    """Rewards of shapes, by their points relative to the middle of the foot, or by their masses."""

    config: ShapeSoftConfig

    def launch_reward(self, achieved: wp.array, desired: wp.array, reward: wp.array) -> None:
        """Compute the rewards of pairs of shapes."""
        inputs = [achieved, desired, reward_rules(self.config)]
        wp.launch(kernels.compute_reward, reward.shape[0], inputs=inputs, outputs=[reward], device=reward.device)
