"""Advantages, episode statistics and what a reset does to them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from softmode.learning.hyperparameters import Hyperparameters
from tests.learning.point_env import PointVectorEnv
from tests.needs import needs

if TYPE_CHECKING:
    import torch

    from softmode.learning.ppo import PPO
    from softmode.learning.rollout import Collector

pytestmark = needs("torch")

OPTIONS = Hyperparameters(rollout_steps=40, hidden=(16,), scale_rewards=False, normalize_observations=False)


def collector(env: gym.vector.VectorEnv, options: Hyperparameters = OPTIONS) -> tuple[Collector, PPO]:
    """Return a collector and a learner with networks of seed 0."""
    import torch

    from softmode.learning.distributed import Ranks
    from softmode.learning.networks import ActorCritic
    from softmode.learning.ppo import PPO
    from softmode.learning.rollout import Collector
    from softmode.learning.vector_tensors import TensorVectorEnv

    worlds = TensorVectorEnv(env, torch.device("cpu"))
    first = worlds.reset(5)
    torch.manual_seed(0)
    model = ActorCritic(worlds.interface, 0, options)
    return Collector(worlds, model, first, options.rollout_steps, options.discount), PPO(model, options, Ranks())


def test_advantage_is_the_sum_of_discounted_errors():
    """A_t = sum_k (gamma lambda)^k delta_(t+k), up to the end of the episode."""
    import torch

    from softmode.learning.rollout import generalized_advantage

    rng = np.random.default_rng(0)
    steps, n, gamma, decay = 20, 3, 0.9, 0.8
    reward, value, following = (rng.normal(size=(steps, n)) for _ in range(3))
    terminated = rng.random((steps, n)) < 0.1
    done = terminated | (rng.random((steps, n)) < 0.1)
    expected = np.zeros((steps, n))
    for i in range(n):
        for t in range(steps):
            for k in range(t, steps):
                delta = reward[k, i] + gamma * following[k, i] * (not terminated[k, i]) - value[k, i]
                expected[t, i] += (gamma * decay) ** (k - t) * delta
                if done[k, i]:
                    break
    given = [torch.tensor(x) for x in (reward, value, following, terminated, done)]
    found = generalized_advantage(*given, gamma, decay)
    np.testing.assert_allclose(found.numpy(), expected, atol=20 * np.finfo(np.float64).eps * steps)


def actions(step: torch.Tensor, worlds: int) -> torch.Tensor:
    """Return actions that depend on the step of the episode alone, some of which leave the square."""
    import torch

    angle = 0.7 * torch.arange(worlds)
    out = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
    return out * (1.0 - 0.05 * step[:, None])


def test_both_autoreset_modes_give_the_same_advantages():
    """The transitions of an episode do not depend on when the next one begins: neither do their advantages."""
    import torch

    class Scripted(torch.nn.Module):
        """Stands for the perceptron of the actor: actions by the age of the episodes."""

        def __init__(self, env: PointVectorEnv) -> None:
            super().__init__()
            self.env = env

        def forward(self, encoding: torch.Tensor) -> torch.Tensor:
            """Return the means of the actions."""
            return actions(self.env.age, self.env.num_envs)

    tables = []
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        env = PointVectorEnv(6, mode=mode)
        collect, ppo = collector(env)
        ppo.model.actor.mean = torch.nn.Sequential(Scripted(env))
        with torch.no_grad():
            ppo.model.actor.log_std.fill_(-30.0)  # no exploration
        rollout = collect.collect(torch.Generator())
        advantage, value = ppo.advantages(rollout)
        assert rollout.terminated.any() and rollout.truncated.any()
        rows = []
        for i in range(6):
            keep = rollout.valid[:, i] > 0
            columns = [rollout.reward, advantage, value, (rollout.terminated | rollout.truncated).float()]
            row = torch.stack([column[keep, i] for column in columns])
            rows.append(row[:, : int(row[3].nonzero()[-1]) + 1])  # whole episodes
        tables.append(rows)
    for following, same in zip(*tables, strict=True):
        length = min(following.shape[1], same.shape[1])  # NEXT_STEP fits fewer episodes in a rollout
        assert length >= 20
        torch.testing.assert_close(following[:, :length], same[:, :length], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_truncation_bootstraps_from_the_last_state(mode: AutoresetMode):
    """At a truncation A = r + gamma V(s') - V(s) with the value of the episode's own last state."""
    import torch

    env = PointVectorEnv(4, mode=mode)
    collect, ppo = collector(env)
    rollout = collect.collect(torch.Generator())
    advantage, value = ppo.advantages(rollout)
    t, i = (int(x[0]) for x in rollout.truncated.nonzero(as_tuple=True))
    moved = rollout.observation["state"][t, i].clone()
    moved[:2] += 0.2 * rollout.sample[t, i].clamp(-1.0, 1.0)
    last = ppo.model.values({"state": moved[None]})[0]
    expected = rollout.reward[t, i] + OPTIONS.discount * last - value[t, i]
    torch.testing.assert_close(advantage[t, i], expected, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_gymnasium_environments_bootstrap_too(mode: AutoresetMode):
    """Arrays with None where an episode goes on are read: truncations get the value of the pendulum's last state."""
    import torch

    env = gym.make_vec(
        "Pendulum-v1", 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, max_episode_steps=9
    )
    collect, ppo = collector(env)
    rollout = collect.collect(torch.Generator().manual_seed(1))
    advantage, value = ppo.advantages(rollout)
    assert int(rollout.truncated.sum()) == 3 * 4
    reference = gym.make("Pendulum-v1", max_episode_steps=9)
    observation, _ = reference.reset(seed=5)
    for t in range(9):
        observation, reward, _, _, _ = reference.step(2.0 * rollout.sample[t, 0].clamp(-1.0, 1.0).numpy())
        assert float(rollout.reward[t, 0]) == pytest.approx(float(reward), abs=1e-5)
    last = ppo.model.values({"state": torch.tensor(observation)[None]})[0]
    expected = rollout.reward[8, 0] + OPTIONS.discount * last - value[8, 0]
    torch.testing.assert_close(advantage[8, 0], expected, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_statistics_count_whole_episodes(mode: AutoresetMode, monkeypatch: pytest.MonkeyPatch):
    """Sums of returns, lengths and successes equal those of a loop over worlds; reset steps do not count."""
    import torch

    env, wins = PointVectorEnv(40, mode=mode, limit=7), []
    step = env.step

    def noted(actions: torch.Tensor) -> Any:
        """Step, and note the successes of the episodes that end."""
        *found, terminated, truncated, info = step(actions)
        wins.append(int((info.get("final_info", info)["is_success"] & (terminated | truncated)).sum()))
        return *found, terminated, truncated, info

    monkeypatch.setattr(env, "step", noted)
    collect, _ = collector(env)
    rollout = collect.collect(torch.Generator().manual_seed(0))
    done = (rollout.terminated | rollout.truncated).numpy()
    returns, lengths = [], []
    for i in range(40):
        total, length = 0.0, 0
        for t in range(rollout.steps):
            if rollout.valid[t, i]:
                total, length = total + float(rollout.reward[t, i]), length + 1
            if done[t, i]:
                returns.append(total)
                lengths.append(length)
                total, length = 0.0, 0
    sums = collect.statistics.take().tolist()
    assert sums[0] == len(returns) and sums[2] == sum(lengths) and sums[4] == float(rollout.valid.sum())
    assert sums[1] == pytest.approx(sum(returns), rel=1e-5)
    assert sums[3] == sum(wins) > 0
    assert sums[5] == pytest.approx(float(rollout.reward.sum()), rel=1e-5)
    assert collect.statistics.take().tolist() == [0.0] * 6


def test_stagger_spreads_the_ages():
    """After `limit` steps of staggering the worlds are at all ages, evenly."""
    import torch

    limit = 40
    env = PointVectorEnv(80, limit=limit)
    collect, ppo = collector(env)
    with torch.no_grad():
        ppo.model.actor.log_std.fill_(-30.0)  # points stay where they are
    collect.stagger(limit)
    collect.collect(torch.Generator())
    assert np.array_equal(np.sort(env.age.numpy()), np.repeat(np.arange(1, limit + 1), 2))


@pytest.mark.gpu
def test_a_rollout_reads_nothing_back():
    """No step of a rollout waits for the device."""
    import torch

    from softmode.learning.networks import ActorCritic
    from softmode.learning.rollout import Collector
    from softmode.learning.vector_tensors import TensorVectorEnv

    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    worlds = TensorVectorEnv(PointVectorEnv(64, device="cuda"), torch.device("cuda"))
    first = worlds.reset(0)
    model = ActorCritic(worlds.interface, 0, OPTIONS).cuda()
    collect = Collector(worlds, model, first, 8, 0.9)
    generator = torch.Generator("cuda").manual_seed(0)
    collect.collect(generator)
    torch.cuda.set_sync_debug_mode("error")
    try:
        collect.collect(generator)
    finally:
        torch.cuda.set_sync_debug_mode("default")
