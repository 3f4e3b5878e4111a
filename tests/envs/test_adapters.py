"""Adapters: what each library asks of an environment, and a short training with each on a softmode environment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.adapters.common import infos_of_worlds
from softmode.errors import ConfigError
from tests.envs.walks import GoalWalkVectorEnv, WalkVectorEnv
from tests.needs import needs

pytestmark = needs("torch")

LIMIT = 20
"""Control steps of an episode."""


@pytest.fixture(scope="module")
def lift() -> Iterator[Any]:
    """Return two worlds of LiftSoft with tensors, shared by the tests."""
    env = gym.make_vec(
        "softmode/LiftSoft-v0",
        num_envs=2,
        output="torch",
        autoreset_mode=AutoresetMode.SAME_STEP,
        max_episode_steps=LIMIT,
    )
    yield env
    env.close()


@pytest.fixture(scope="module")
def pixels() -> Iterator[Any]:
    """Return one world with small pictures."""
    from softmode.envs.tasks.push_soft.task import PushSoftConfig

    env = gym.make_vec(
        "softmode/PushSoft-v0",
        num_envs=1,
        output="torch",
        obs_type="pixels_agent_pos",
        autoreset_mode=AutoresetMode.SAME_STEP,
        config=PushSoftConfig(image_size=36),
    )
    yield env
    env.close()


def changed(before: dict[str, Any], after: dict[str, Any]) -> bool:
    """Whether every parameter is finite and most of them moved."""
    import torch

    assert all(torch.isfinite(value).all() for value in after.values())
    moved = [not torch.equal(before[name], after[name]) for name in before]
    return sum(moved) > len(moved) / 2


def copies(state: dict[str, Any]) -> dict[str, Any]:
    """Copy a state dict."""
    return {name: value.detach().clone() for name, value in state.items()}


# -- which environments -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("library", "name"),
    [("stable_baselines3", "StableBaselinesVecEnv"), ("rsl_rl", "RslRlVecEnv"), ("skrl", "SkrlWrapper")],
)
def test_other_environments_are_refused(library: str, name: str) -> None:
    """Single environments, other autoreset modes, and arrays where tensors are needed raise ConfigError."""
    pytest.importorskip(library)
    from softmode.envs import adapters

    adapter = getattr(adapters, name)
    with pytest.raises(ConfigError, match="TimeLimit"):
        adapter(gym.make("Pendulum-v1"))
    with pytest.raises(ConfigError, match="SAME_STEP"):
        adapter(WalkVectorEnv(2, output="torch"))
    if name != "StableBaselinesVecEnv":
        with pytest.raises(ConfigError, match="output='torch'"):
            adapter(WalkVectorEnv(2, autoreset_mode=AutoresetMode.SAME_STEP))


def test_unknown_adapter() -> None:
    """The package knows its three adapters by name."""
    from softmode.envs import adapters

    with pytest.raises(AttributeError, match="Keras"):
        _ = adapters.Keras


def test_infos_of_worlds_undoes_the_masks() -> None:
    """Gymnasium's own gathering of infos, undone, gives the infos of the worlds."""
    rows = [{"a": 1.5, "inner": {"b": True}}, {"a": 2.5, "text": "x"}, {}]
    env = WalkVectorEnv(3)
    infos: dict[str, Any] = {}
    for world, row in enumerate(rows):
        infos = env._add_info(infos, row, world)
    back = infos_of_worlds(infos, 3)
    assert back == rows
    assert type(back[0]["a"]) is float and type(back[0]["inner"]["b"]) is bool


# -- Stable-Baselines3 ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_stable_baselines_sees_the_ends_of_episodes(output: str) -> None:
    """A step that ends an episode returns the next one's first observation, and in the info, as `DummyVecEnv` does, the
    last observation and whether the time limit cut the episode short.
    """  # noqa: D205
    pytest.importorskip("stable_baselines3")
    from softmode.envs.adapters import StableBaselinesVecEnv

    env = StableBaselinesVecEnv(WalkVectorEnv(3, autoreset_mode=AutoresetMode.SAME_STEP, output=output))
    twin = WalkVectorEnv(3, autoreset_mode=AutoresetMode.SAME_STEP)
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), twin.reset(seed=5)[0])
    assert [set(info) for info in env.reset_infos] == [{"distance", "is_success", "reward_terms"}] * 3
    random, causes = np.random.default_rng(0), set()
    for _ in range(40):
        action = random.uniform(-0.2, 1.0, (3, 2)).astype(np.float32)
        observation, reward, done, infos = env.step(action)
        theirs = twin.step(action)
        np.testing.assert_array_equal(observation, theirs[0])
        np.testing.assert_array_equal(done, theirs[2] | theirs[3])
        np.testing.assert_allclose(reward, theirs[1], rtol=1e-6)
        assert reward.dtype == np.float32
        for world, info in enumerate(infos):
            assert info["TimeLimit.truncated"] == bool(theirs[3][world] and not theirs[2][world])
            assert ("terminal_observation" in info) == done[world]
            source = theirs[4]["final_info"] if done[world] else theirs[4]
            assert info["distance"] == pytest.approx(source["distance"][world])
            assert set(info["reward_terms"]) == {"x"}
            if done[world]:
                np.testing.assert_array_equal(info["terminal_observation"], theirs[4]["final_obs"][world])
                causes.add(info["TimeLimit.truncated"])
    assert causes == {True, False}


def test_stable_baselines_reaches_attributes() -> None:
    """Attributes and methods are those of the one object that all worlds share."""
    pytest.importorskip("stable_baselines3")
    from softmode.envs.adapters import StableBaselinesVecEnv

    env = StableBaselinesVecEnv(GoalWalkVectorEnv(3))
    assert env.get_attr("max_episode_steps") == [6] * 3 and env.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    env.set_attr("max_episode_steps", 9)
    assert env.get_attr("max_episode_steps", indices=0) == [9]
    with pytest.raises(ConfigError, match="share one object"):
        env.set_attr("max_episode_steps", 3, indices=[1])
    goals = np.zeros((5, 2), np.float32)
    (reward,) = env.env_method("compute_reward", goals, goals, [{}] * 5, indices=[0])
    np.testing.assert_array_equal(reward, np.zeros(5))
    assert not env.has_attr("weather") and env.env_is_wrapped(gym.Wrapper) == [False] * 3
    env.set_options([{"a": 1}, {"a": 2}, {}])
    with pytest.raises(ConfigError, match="options"):
        env.reset()


def test_stable_baselines_trains(lift: Any, tmp_path: Path) -> None:
    """PPO takes 256 environment steps with `VecMonitor` and `VecNormalize` around; episodes are counted."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    from softmode.envs.adapters import StableBaselinesVecEnv

    env = VecNormalize(VecMonitor(StableBaselinesVecEnv(lift), info_keywords=("is_success", "end_reason")))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu",
                policy_kwargs={"net_arch": [16]})  # fmt: skip
    before = copies(model.policy.state_dict())
    model.learn(256)
    assert model.num_timesteps == 256 and changed(before, model.policy.state_dict())
    episodes = list(model.ep_info_buffer or ())
    assert len(episodes) >= 256 // LIMIT - 2
    assert all(0 < episode["l"] <= LIMIT and np.isfinite(episode["r"]) for episode in episodes)
    assert all(episode["is_success"] in (True, False) for episode in episodes)


def test_stable_baselines_relabels_goals() -> None:
    """Hindsight experience replay asks a goal environment's `compute_reward` through the adapter, and learns."""
    import torch

    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import DDPG, HerReplayBuffer

    from softmode.envs.adapters import StableBaselinesVecEnv

    env = StableBaselinesVecEnv(GoalWalkVectorEnv(2))
    model = DDPG("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=20, train_freq=2,
                 batch_size=32, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu")  # fmt: skip
    before = copies(model.policy.state_dict())
    calls = env.env.unwrapped.calls  # type: ignore[attr-defined]
    model.learn(200)
    assert changed(before, model.policy.state_dict())
    assert env.env.unwrapped.calls > calls  # type: ignore[attr-defined]
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    batch = model.replay_buffer.sample(64)
    wanted = -torch.linalg.vector_norm(
        batch.next_observations["achieved_goal"] - batch.next_observations["desired_goal"], dim=1
    )
    torch.testing.assert_close(batch.rewards[:, 0], wanted, atol=1e-5, rtol=1e-5)


# -- rsl_rl -----------------------------------------------------------------------------------------------------------

RSL = {
    "num_steps_per_env": 25,
    "save_interval": 2,
    "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
    "algorithm": {"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2},
    "actor": {
        "class_name": "MLPModel",
        "hidden_dims": [16],
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0},
    },
    "critic": {"class_name": "MLPModel", "hidden_dims": [16]},
}
"""A runner's configuration."""


def test_rsl_rl_trains(lift: Any, tmp_path: Path) -> None:
    """The on-policy runner takes 4 x 25 steps of 2 worlds, logs reward terms and successes, and saves its policy."""
    import torch

    pytest.importorskip("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    from softmode.envs.adapters import RslRlVecEnv

    env = RslRlVecEnv(lift, seed=0)
    runner = OnPolicyRunner(env, dict(RSL), log_dir=str(tmp_path), device="cpu")
    before = copies(runner.alg.actor.state_dict())
    runner.learn(4, init_at_random_ep_len=True)
    assert changed(before, runner.alg.actor.state_dict())
    assert (tmp_path / "model_3.pt").is_file()
    lengths = list(runner.logger.lenbuffer)
    assert lengths and max(lengths) <= LIMIT and lengths[0] < LIMIT  # the first ends were spread
    keys = {key for extras in runner.logger.ep_extras for key in extras} or set(env.step(torch.zeros(2, 5))[3]["log"])
    assert {"/episode/is_success"} <= keys and any(key.startswith("/reward/") for key in keys)


def test_rsl_rl_counts_steps(lift: Any) -> None:
    """Setting `episode_length_buf` moves the ends of the episodes: a world one step before the limit is cut next."""
    import torch

    pytest.importorskip("rsl_rl")
    from softmode.envs.adapters import RslRlVecEnv

    env = RslRlVecEnv(lift, seed=1)
    assert env.num_actions == 5 and env.max_episode_length == LIMIT and env.cfg is lift.unwrapped.config
    assert env.episode_length_buf.tolist() == [0, 0]
    env.episode_length_buf = torch.tensor([3, LIMIT - 1])
    observation, reward, done, extras = env.step(torch.zeros(2, 5))
    assert done.tolist() == extras["time_outs"].tolist() == [False, True]
    assert env.episode_length_buf.tolist() == [4, 0]
    assert set(observation.keys()) == {"policy", "critic"} and observation.batch_size == torch.Size([2])
    torch.testing.assert_close(env.get_observations()["policy"], observation["policy"])
    assert reward.shape == (2,) and reward.dtype == torch.float32


def test_rsl_rl_groups_pictures(pixels: Any) -> None:
    """Pictures become channels-first floats in 0..1; the critic sees the state that the policy does not."""
    import torch

    pytest.importorskip("rsl_rl")
    from softmode.envs.adapters import RslRlVecEnv

    env = RslRlVecEnv(pixels, seed=0)
    groups = env.get_observations()
    raw, _ = pixels.reset(seed=0)
    assert groups["pixels"].shape == (1, 3, 36, 36) and groups["pixels"].dtype == torch.float32
    torch.testing.assert_close(groups["pixels"][0], raw["pixels"][0].permute(2, 0, 1).float() / 255.0)
    torch.testing.assert_close(groups["policy"], raw["agent_pos"])
    size = raw["agent_pos"].shape[1]
    assert groups["critic"].shape[1] > size
    torch.testing.assert_close(groups["critic"][:, :size], raw["agent_pos"])


# -- skrl -------------------------------------------------------------------------------------------------------------


def test_skrl_trains(lift: Any, tmp_path: Path) -> None:
    """PPO of skrl takes 100 steps of 2 worlds with its sequential trainer."""
    import torch

    pytest.importorskip("skrl")
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    from softmode.envs.adapters import SkrlWrapper

    env = SkrlWrapper(lift)
    assert env.num_envs == 2 and env.device == torch.device("cpu") and env.state() is None
    network: Any = [{"name": "net", "input": "OBSERVATIONS", "layers": [16], "activations": "elu"}]
    spaces: Any = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    models: Any = {
        "policy": gaussian_model(**spaces, network=network, output="ACTIONS"),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }
    cfg = PPO_CFG(rollouts=25, learning_epochs=2, mini_batches=2)
    cfg.experiment.directory, cfg.experiment.write_interval = str(tmp_path), 25
    agent = PPO(models=models, memory=RandomMemory(memory_size=25, num_envs=2, device=env.device), cfg=cfg, **spaces)
    trainer = SequentialTrainer(
        env=env, agents=agent, cfg={"timesteps": 100, "disable_progressbar": True, "close_environment_at_exit": False}
    )
    for model in models.values():  # its layers are sized by the first batch
        model.act({"observations": env.reset()[0]})
    before = {name: copies(model.state_dict()) for name, model in models.items()}
    trainer.train()
    assert all(changed(before[name], model.state_dict()) for name, model in models.items())
    assert list(tmp_path.rglob("events.out.tfevents.*"))


def test_skrl_shapes(pixels: Any) -> None:
    """Observations are flat, flags are columns, reset starts episodes once, and pictures come with a state."""
    import torch

    pytest.importorskip("skrl")
    from skrl.utils.spaces.torch import unflatten_tensorized_space

    from softmode.envs.adapters import SkrlWrapper

    env = SkrlWrapper(pixels)
    first, _ = env.reset()
    again, _ = env.reset()
    assert again is first
    observation, reward, terminated, truncated, infos = env.step(torch.zeros(1, 5))
    assert reward.shape == terminated.shape == truncated.shape == (1, 1) and "episode" in infos
    parts = unflatten_tensorized_space(env.observation_space, observation)
    assert parts["pixels"].shape == (1, 36, 36, 3) and 0.0 <= parts["pixels"].min() < parts["pixels"].max() <= 255.0
    state = env.state()
    assert state is not None and env.state_space is not None and state.shape[1:] == env.state_space.shape
    torch.testing.assert_close(parts["agent_pos"], state[:, : parts["agent_pos"].shape[1]])
