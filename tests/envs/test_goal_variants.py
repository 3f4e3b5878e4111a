"""PushSoftGoal and LiftSoftGoal: goals in the observation, rewards computed again, and what stays of the other task."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.lift_soft_goal.task import LiftSoftGoalConfig
from softmode.envs.tasks.push_soft_goal.task import PushSoftGoalConfig
from softmode.errors import ConfigError
from tests.envs.conftest import MakeEnv

CONFIGS: dict[str, Any] = {"PushSoft": PushSoftGoalConfig, "LiftSoft": LiftSoftGoalConfig}


@pytest.mark.parametrize("name", CONFIGS)
def test_goals_are_places(make_env: MakeEnv, name: str) -> None:
    """`achieved_goal` is the centre of mass, `desired_goal` the goal; `observation` has nothing of the goal.

    Draws and physics are those of the other task, bit for bit.
    """
    env: Any = make_env(f"{name}Goal").unwrapped
    plain: Any = make_env(name).unwrapped
    size = env.task_class.goal_size
    given, _ = env.reset(seed=3)
    other, _ = plain.reset(seed=3)
    env.action_space.seed(3)
    action = env.action_space.sample()
    for _ in range(3):
        given = env.step(action)[0]
        other = plain.step(action)[0]
    columns = plain.task.segments
    np.testing.assert_array_equal(given["achieved_goal"], other[columns["object_position"][0]][:size])
    np.testing.assert_array_equal(given["desired_goal"], other[columns["goal"][0]])
    arm = slice(0, columns["goal"][0].start)
    thing = slice(columns["object_position"][0].start, columns["object_points"][0].stop)
    np.testing.assert_array_equal(given["observation"], [*other[thing], *other[arm]])
    assert env.observation_space.contains(given) and name in type(env.task).__name__


@pytest.mark.parametrize("name", ["LiftSoft", pytest.param("PushSoft", marks=pytest.mark.rest)])
def test_rewards_are_computed_again(soft_env: MakeEnv, name: str) -> None:
    """The step's reward is -|a - g|; `compute_reward` gives the same bits, for any leading shape and for tensors.

    The environments are others: as they are registered they pay the sparse reward, which a scripted push tells.
    """
    env: Any = soft_env(f"softmode/{name}Goal-v0", reward_mode="dense").unwrapped
    env.reset(seed=1)
    env.action_space.seed(1)
    for _ in range(3):
        seen, reward, _, _, info = env.step(env.action_space.sample())
        apart = np.linalg.norm(seen["achieved_goal"].astype(float) - seen["desired_goal"])
        assert reward == pytest.approx(-apart, rel=1e-5) and reward == info["reward_terms"]["goal"]
        assert reward == env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
    a, g = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 4, 5, env.task_class.goal_size)).astype(np.float32)
    rewards = env.compute_reward(a, g, None)
    assert rewards.shape == (4, 5)
    np.testing.assert_allclose(rewards, -np.linalg.norm(a.astype(float) - g, axis=-1), rtol=1e-5)
    with pytest.raises(ConfigError, match=str(env.task_class.goal_size)):
        env.compute_reward(a[..., :1], g[..., :1])
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(env.compute_reward(torch.tensor(a), torch.tensor(g)).numpy(), rewards)


def test_the_script_reaches_the_goal_and_the_sparse_reward_says_so(make_env: MakeEnv) -> None:
    """-1 until the disc is within the tolerance, 0 there; ten steps there are a success. The script is PushSoft's."""
    env: Any = make_env("PushSoftGoal").unwrapped
    seen, info = env.reset(seed=0)
    policy, rewards, apart = scripted_policy(env), [], []
    while not info["is_success"] and len(rewards) < 120:
        seen, reward, terminated, _, info = env.step(policy(seen))
        assert not terminated
        rewards.append(reward)
        apart.append(np.linalg.norm(seen["achieved_goal"] - seen["desired_goal"]))
    assert info["is_success"] and rewards[0] == -1.0 and rewards[-10:] == [0.0] * 10
    np.testing.assert_array_equal(np.array(rewards) == 0.0, np.array(apart) <= env.config.goal_tolerance)


def test_hindsight_relabels() -> None:
    """Stable-Baselines3's HerReplayBuffer relabels what two worlds stored, with the reward of the new goals."""
    pytest.importorskip("stable_baselines3")
    import torch
    from stable_baselines3 import SAC, HerReplayBuffer

    from softmode.envs import StableBaselinesVecEnv

    envs = gym.make_vec(
        "softmode/PushSoftGoal-v0", num_envs=2, max_episode_steps=10, autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = StableBaselinesVecEnv(envs)
    model = SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=40, train_freq=4,
                batch_size=32, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu")  # fmt: skip
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(80)
    moved = [not torch.equal(before[name], value) for name, value in model.policy.state_dict().items()]
    assert sum(moved) > len(moved) / 2
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    batch = model.replay_buffer.sample(64)
    after = batch.next_observations
    apart = torch.linalg.vector_norm(after["achieved_goal"] - after["desired_goal"], dim=1)
    torch.testing.assert_close(batch.rewards[:, 0], torch.where(apart <= 0.02, 0.0, -1.0))
    assert (apart <= 0.02).any() and (apart > 0.02).any()  # some goals are what was reached
    env.close()


def test_wrong_configurations_are_refused() -> None:
    """An unknown reward, and a goal for yaw, which a place has not."""
    with pytest.raises(ConfigError, match="reward"):
        LiftSoftGoalConfig(reward_mode="distance")
    with pytest.raises(ConfigError, match="yaw_tolerance"):
        PushSoftGoalConfig(yaw_tolerance=0.3)
