"""Other libraries take the environments as they are: TorchRL and Minari, where they are installed."""

from __future__ import annotations

import gymnasium as gym
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
