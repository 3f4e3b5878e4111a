"""Datasets with the states in which their episodes begin."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from softmode.demonstrations import DatasetWriter, environment_features, read_dataset, record_episodes
from softmode.errors import ConfigError, StateError
from tests.needs import needs

pytestmark = needs("pyarrow")


def test_an_episode_begins_again_where_it_began(tmp_path: Path) -> None:
    """From an episode's state its actions give its observations and rewards, bit for bit; damage and gaps are told."""
    env = gym.make("softmode/PressSoft-v0", max_episode_steps=6)
    env.action_space.seed(0)
    folder = tmp_path / "data"
    with DatasetWriter(folder, environment_features(env), fps=30) as writer:
        for states in (True, False):
            record_episodes(
                env,
                lambda seed: lambda seen: env.action_space.sample(),
                writer,
                episodes=2,
                task="press",
                states=states,
            )
    found = read_dataset(folder)
    for number in (1, 0):
        played = found.episode(number)
        seen, _ = env.reset(options={"state": found.state(number)})
        size = played["observation.state"].shape[1]
        for k, action in enumerate(played["action"]):
            np.testing.assert_array_equal(seen[:size], played["observation.state"][k])
            np.testing.assert_array_equal(seen[size:], played["observation.environment_state"][k])
            seen, reward, *_ = env.step(action)
            assert np.float32(reward) == played["next.reward"][k, 0]
    with pytest.raises(ConfigError, match="episode 2 has no state"):
        found.state(2)
    with pytest.raises(ConfigError, match="episode 4 is not in"):
        found.state(4)
    file = folder / "meta" / "states" / "episode-000001.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(StateError):
        found.state(1)
    env.close()


def test_other_environments_have_no_states(tmp_path: Path) -> None:
    """An environment that is not softmode's is refused before it is reset."""
    env = gym.make("Pendulum-v1")
    with (
        DatasetWriter(tmp_path / "data", environment_features(env), fps=20) as writer,
        pytest.raises(ConfigError, match="no get_state"),
    ):
        record_episodes(
            env, lambda seed: lambda seen: env.action_space.sample(), writer, episodes=1, task="swing", states=True
        )
