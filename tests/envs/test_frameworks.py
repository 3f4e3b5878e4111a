"""Other libraries take the environments as they are: TorchRL, Minari and RLlib, where they are installed."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from tests.needs import needs

ENV_ID = "softmode/PushSoft-v0"


@needs("torchrl")
def test_torchrl_steps_all_worlds_and_one() -> None:
    """A vector environment that waits for resets, and a single one that TorchRL makes; episodes end and go on."""
    from torchrl.envs import GymEnv, GymWrapper
    from torchrl.envs.utils import check_env_specs

    worlds = GymWrapper(gym.make_vec(ENV_ID, num_envs=3, autoreset_mode="Disabled", max_episode_steps=3))
    assert worlds.rollout(5, break_when_any_done=False)["next", "done"].sum() == 3
    one = GymEnv(ENV_ID)
    check_env_specs(one)
    worlds.close()
    one.close()


@needs("minari", "h5py", "jax")
def test_minari_collects_and_makes_the_environment_again(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its dataset holds the episodes, and recovers the environment."""
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(gym.make(ENV_ID, max_episode_steps=3))
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    made = env.create_dataset("soft/push-v0")
    assert made.total_steps == 3 and made.recover_environment().spec.id == ENV_ID
    env.close()


@needs("ray", "tree", "torch")
def test_rllib_trains_an_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    """PPO of RLlib takes two worlds of its own making and learns from one batch of theirs."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    register_env("push", lambda options: gym.make(ENV_ID, **options))
    config = PPOConfig().environment("push", env_config={"max_episode_steps": 8, "device": "cpu"})
    config = config.env_runners(num_env_runners=0, num_envs_per_env_runner=2, rollout_fragment_length=16)
    config = config.training(train_batch_size_per_learner=32, minibatch_size=16, num_epochs=1)
    algorithm = config.build_algo()
    try:
        result = algorithm.train()
        assert result["env_runners"]["num_env_steps_sampled"] >= 32 and result["env_runners"]["num_episodes"] >= 2
        assert np.isfinite(result["learners"]["default_policy"]["total_loss"])
    finally:
        algorithm.stop()
        ray.shutdown()
