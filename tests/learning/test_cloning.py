"""Cloning: demonstrations of an environment with goals become a policy that is loaded like any other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softmode.errors import ConfigError
from tests.needs import needs

pytestmark = [needs("torch"), needs("pyarrow")]
ID = "tests/PointToGoal-v0"


class PointToGoal(gym.Env):
    """A point that moves by 0.2 times the action, for twelve steps; the last entry of the action does nothing."""

    metadata = {"render_fps": 30, "render_modes": []}  # noqa: RUF012
    action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    observation_space = gym.spaces.Dict(
        {key: gym.spaces.Box(-4.0, 4.0, (2,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def seen(self) -> dict[str, Any]:
        """Return the observation."""
        return {"observation": self.speed, "achieved_goal": self.place, "desired_goal": self.goal}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Draw place and goal."""
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1.0, 1.0, (2, 2)).astype(np.float32)
        self.speed, self.steps = np.zeros(2, np.float32), 0
        return self.seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move."""
        self.speed = 0.2 * np.clip(action[:2], -1.0, 1.0).astype(np.float32)
        self.place, self.steps = self.place + self.speed, self.steps + 1
        away = float(np.linalg.norm(self.goal - self.place))
        return self.seen(), -away, False, self.steps == 12, {"is_success": away < 0.05}


def script(seen: Any) -> np.ndarray:
    """Go to the goal as fast as allowed."""
    return np.append((seen["desired_goal"] - seen["achieved_goal"]) / 0.2, 0.5).clip(-1.0, 1.0).astype(np.float32)


def test_a_clone_does_what_was_shown(tmp_path: Path):
    """From 24 demonstrations, into which a learner that goes the wrong way steps, to a policy that gets there.

    While the learner plays, its actions move the point and the script's are recorded.
    """
    from softmode.demonstrations import DatasetWriter, environment_features, read_dataset, record_episodes
    from softmode.learning import clone, evaluate, load_policy, write_checkpoint

    gym.register(ID, entry_point=PointToGoal)
    try:
        env = gym.make(ID, disable_env_checker=True)
        with DatasetWriter(tmp_path / "data", environment_features(env), fps=30) as writer:
            record_episodes(
                env, lambda seed: script, writer, episodes=24, task="go", learner=lambda seen: -0.5 * script(seen)
            )
        data = read_dataset(tmp_path / "data")
        seen, action = data.observations(), data.columns["action"]
        away = seen["desired_goal"] - seen["achieved_goal"]
        np.testing.assert_allclose(action[:, :2], (away / 0.2).clip(-1.0, 1.0), atol=1e-6)
        moved = (seen["observation"][1:] * action[:-1, :2]).sum(axis=1)[np.diff(data.columns["episode_index"]) == 0]
        assert 0.1 < (moved < 0.0).mean() < 0.7  # in the learner's steps it went away from the goal
        write_checkpoint(clone(env, {}, seen, action, steps=600, batch=256), tmp_path / "clone.npz")
        found = evaluate(env, load_policy(tmp_path / "clone.npz"), 50)
        assert found.success_rate is not None and found.success_rate > 0.9
        with pytest.raises(ConfigError, match="actions"):
            clone(env, {}, {"state": away}, action)
        env.close()
    finally:
        gym.registry.pop(ID)
