"""Demonstrations of environments with goals: every vector observed comes back by its key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softmode.demonstrations import DatasetWriter, environment_features, read_dataset, record_episodes
from softmode.errors import ConfigError
from tests.needs import needs

pytestmark = needs("pyarrow")


class PointToGoal(gym.Env):
    """A point that moves by 0.2 times the action, for six steps."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gym.spaces.Dict(
        {
            key: gym.spaces.Box(-4.0, 4.0, (size,), np.float32)
            for key, size in (("observation", 3), ("achieved_goal", 2), ("desired_goal", 2))
        }
    )

    def __init__(self) -> None:
        """Nothing was seen yet."""
        self.told: list[dict[str, Any]] = []

    def _seen(self) -> dict[str, Any]:
        seen = {"observation": np.append(self.place, self.steps).astype(np.float32)}
        seen |= {"achieved_goal": self.place, "desired_goal": self.goal}
        self.told.append(seen)
        return seen

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Draw place and goal."""
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1.0, 1.0, (2, 2)).astype(np.float32)
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move."""
        self.place, self.steps = (self.place + 0.2 * action).astype(np.float32), self.steps + 1
        return self._seen(), 0.0, False, self.steps == 6, {}


def test_goals_come_back(tmp_path: Path):
    """Of all frames, bit by bit; the last observation of an episode is no frame."""
    env = PointToGoal()

    def script(seen: Any) -> Any:
        return (seen["desired_goal"] - seen["achieved_goal"]).clip(-1.0, 1.0)

    with DatasetWriter(tmp_path / "data", environment_features(env), fps=30) as writer:
        record_episodes(env, lambda seed: script, writer, episodes=3, task="go", noise=0.3)
    data = read_dataset(tmp_path / "data")
    told, found = [seen for k, seen in enumerate(env.told) if k % 7 < 6], data.observations()
    with pytest.raises(ConfigError, match="state"):
        read_dataset(tmp_path / "data", keys=["action"]).observations()
    assert found.keys() == told[0].keys()
    for key, column in found.items():
        np.testing.assert_array_equal(column, [seen[key] for seen in told])
    expected = (found["desired_goal"] - found["achieved_goal"]).clip(-1.0, 1.0)
    np.testing.assert_array_equal(data.columns["action"], expected)
