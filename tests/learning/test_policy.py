"""Loaded policies and their evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from softmode.errors import CheckpointError, ConfigError
from softmode.learning.checkpoints import write_checkpoint
from softmode.learning.spaces import Interface
from tests.learning.test_checkpoints import checkpoint
from tests.needs import needs

pytestmark = needs("torch")


def test_one_or_many_observations_arrays_or_tensors(tmp_path: Path):
    """The action comes in the kind and the range of the environment, and a batch is its rows."""
    import torch

    from softmode.learning.policy import load_policy

    write_checkpoint(checkpoint(), tmp_path / "p.npz")
    policy = load_policy(tmp_path / "p.npz")
    batch = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    actions = policy(batch)
    assert isinstance(actions, np.ndarray) and actions.shape == (5, 1) and np.abs(actions).max() <= 2.0
    assert np.ptp(actions) > 0.0
    for k in range(5):
        assert policy(batch[k]).shape == (1,)
        np.testing.assert_allclose(policy(batch[k]), actions[k], atol=1e-6)
    tensors = policy(torch.tensor(batch))
    assert isinstance(tensors, torch.Tensor) and np.allclose(tensors.numpy(), actions)


def test_a_checkpoint_imports_no_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An environment of a module that nobody has imported is refused, and the module is not run."""
    from softmode.learning.policy import load_policy

    (tmp_path / "stranger.py").write_text("raise SystemExit('this has run')")
    monkeypatch.syspath_prepend(tmp_path)
    write_checkpoint(checkpoint(env="stranger:Pendulum-v1"), tmp_path / "p.npz")
    with pytest.raises(CheckpointError, match="of the module stranger"):
        load_policy(tmp_path / "p.npz").make()
    write_checkpoint(checkpoint(), tmp_path / "p.npz")
    load_policy(tmp_path / "p.npz").make().close()


@pytest.mark.parametrize("encoder", ["nature", "impala"])
def test_pictures_and_vectors(tmp_path: Path, encoder: str):
    """A Dict observation goes through both encoders; each part changes the action."""
    import dataclasses

    from softmode.learning.policy import load_policy

    interface = Interface(
        vectors={"agent_pos": 2}, pictures={"pixels": (64, 64, 3)}, action_low=(-1.0, -1.0), action_high=(1.0, 1.0)
    )
    base = checkpoint()
    options = dataclasses.replace(base.hyperparameters, encoder=encoder)
    from softmode.learning.networks import ActorCritic

    model = ActorCritic(interface, 0, options)
    arrays = {name: value.numpy() for name, value in model.state_dict().items()}
    write_checkpoint(
        dataclasses.replace(base, interface=interface, hyperparameters=options, arrays=arrays), tmp_path / "p.npz"
    )
    policy = load_policy(tmp_path / "p.npz")
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (3, 64, 64, 3), np.uint8)
    seen = {"pixels": pixels, "agent_pos": np.zeros((3, 2), np.float32)}
    actions = policy(seen)
    assert actions.shape == (3, 2)
    single = policy({"pixels": pixels[1], "agent_pos": np.zeros(2, np.float32)})
    np.testing.assert_allclose(single, actions[1], atol=1e-5)
    assert not np.allclose(policy({**seen, "pixels": 255 - pixels}), actions, atol=1e-6)
    assert not np.allclose(policy({**seen, "agent_pos": np.ones((3, 2), np.float32)}), actions, atol=1e-6)
    with pytest.raises(ConfigError, match="agent_pos"):
        policy({"pixels": pixels})


class Lottery(gym.Env):
    """Half of the episodes fail after one step, the others succeed after nine: by the seed and the episode's number."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None):
        """Draw."""
        super().reset(seed=seed)
        self.wins, self.age = self.np_random.random() < 0.5, 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        """Wait for the end."""
        self.age += 1
        done = self.age == (9 if self.wins else 1)
        return np.zeros(1, np.float32), 1.0, done, False, {"is_success": bool(done and self.wins)}


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_evaluation_does_not_prefer_short_episodes(mode: AutoresetMode):
    """The rate is that of the first episodes of every world; the first episodes to end would give far less."""
    from softmode.learning.policy import evaluate

    worlds, episodes = 20, 50
    env = gym.vector.SyncVectorEnv([Lottery] * worlds, autoreset_mode=mode)

    def policy(observation: np.ndarray) -> np.ndarray:
        return np.zeros((worlds, 1), np.float32)

    found = evaluate(env, policy, episodes, seed=3)
    outcomes = []
    for i in range(worlds):
        single = Lottery()
        for k in range(episodes // worlds + (i < episodes % worlds)):
            single.reset(seed=3 + i if k == 0 else None)
            outcomes.append(single.wins)
    assert found.episodes == len(outcomes) == episodes
    assert found.success_rate == pytest.approx(np.mean(outcomes))
    assert found.mean_length == pytest.approx(np.mean(np.where(outcomes, 9, 1)))
    assert found.mean_return == pytest.approx(found.mean_length)
    assert 0.3 < np.mean(outcomes) < 0.7


def test_a_single_environment_is_evaluated():
    """Episode k has seed s + k."""
    from softmode.learning.policy import evaluate

    found = evaluate(Lottery(), lambda observation: np.zeros(1, np.float32), 30, seed=7)
    wins = []
    for k in range(30):
        env = Lottery()
        env.reset(seed=7 + k)
        wins.append(env.wins)
    assert found.success_rate == pytest.approx(np.mean(wins))
    with pytest.raises(ConfigError, match="episodes"):
        evaluate(Lottery(), lambda observation: observation, 0)


def test_the_interval_is_wilsons():
    """Wilson's interval of 180 successes in 200 is 85.1 to 93.4 %; of none in 10 it ends at 27.8 %."""
    from softmode.learning.policy import Evaluation

    fields = {"mean_return": 0.0, "std_return": 0.0, "mean_length": 1.0}
    low, high = Evaluation(episodes=200, success_rate=0.9, **fields).interval()
    assert (round(low, 3), round(high, 3)) == (0.851, 0.934)
    low, high = Evaluation(episodes=10, success_rate=0.0, **fields).interval()
    assert low == 0.0 and round(high, 3) == 0.278
