"""Train with Stable-Baselines3: PPO, or SAC with hindsight experience replay where the environment has goals.

The wrapper lines are those of its documentation, with `StableBaselinesVecEnv` in the place of `make_vec_env`.

Run: ``python examples/train_sb3.py --env softmode/LiftSoft-v0 --device cuda:0 --num-envs 1024``, or ``--short``
"""

import argparse
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import StableBaselinesVecEnv


def make_model(env: VecEnv, steps: int, seed: int, device: str) -> BaseAlgorithm:
    """Return PPO for observations that are vectors, SAC with relabelled goals for those that hold goals.

    The figures of SAC are those of RL Zoo for pushing with a Fetch robot, but for a smaller batch on CPU.
    """
    if isinstance(env.observation_space, gym.spaces.Dict):
        return SAC(
            "MultiInputPolicy",
            env,
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
            learning_starts=min(20 * env.num_envs * 10, steps // 2),
            gradient_steps=max(4, env.num_envs // 8),
            batch_size=256 if device == "cpu" else 2048,
            gamma=0.95,
            tau=0.05,
            learning_rate=1e-3,
            verbose=1,
            seed=seed,
            device=device,
        )
    return PPO("MlpPolicy", env, n_steps=64, batch_size=16 * env.num_envs, verbose=1, seed=seed, device="cpu")


def parameters(model: BaseAlgorithm) -> torch.Tensor:
    """Return all parameters of the policy as one vector."""
    return torch.cat([value.detach().flatten() for value in model.policy.parameters()])


def test_final(before: torch.Tensor, model: BaseAlgorithm, again: BaseAlgorithm, episodes: int, ended: int) -> None:
    """The policy has learned something finite, what was saved is what was trained, and no episode was lost."""
    after = parameters(model)
    assert torch.isfinite(after).all() and (after != before).float().mean() > 0.5
    assert torch.equal(parameters(again), after)
    assert ended >= episodes > 0, (ended, episodes)


def main(arguments: list[str] | None = None) -> None:
    """Train, save, load, and play."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="softmode/PushSoft-v0")
    parser.add_argument("--device", default="cpu", help="of the simulation, and of the networks with goals")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=1_000_000, help="environment steps of all worlds together")
    parser.add_argument("--time-limit", type=float, default=float("inf"), help="seconds after which training ends")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/sb3_policy.zip"))
    parser.add_argument("--short", action="store_true", help="a few seconds")
    options = parser.parse_args(arguments)
    limit = {}
    if options.short:
        options.num_envs, options.steps, limit = 4, 512, {"max_episode_steps": 30}

    envs = gym.make_vec(
        options.env,
        num_envs=options.num_envs,
        device=options.device,
        autoreset_mode=AutoresetMode.SAME_STEP,
        **limit,
    )
    vec_env = VecMonitor(StableBaselinesVecEnv(envs), info_keywords=("is_success",))

    model = make_model(vec_env, options.steps, options.seed, options.device)
    before = parameters(model)
    start = time.perf_counter()
    model.learn(total_timesteps=options.steps, callback=lambda *_: time.perf_counter() - start < options.time_limit)
    print(f"{model.num_timesteps} steps in {time.perf_counter() - start:.0f} s")
    ended = len(model.ep_info_buffer or ())
    options.out.parent.mkdir(parents=True, exist_ok=True)
    model.save(options.out)

    again = type(model).load(options.out, env=vec_env, device=model.device)  # HerReplayBuffer needs the environment
    obs, total, won = vec_env.reset(), np.zeros(options.num_envs), np.zeros(options.num_envs, bool)
    length = envs.unwrapped.max_episode_steps  # type: ignore[attr-defined]
    for _ in range(length):
        action, _states = again.predict(obs, deterministic=True)
        obs, rewards, _dones, infos = vec_env.step(action)
        total += rewards
        won |= [info["is_success"] for info in infos]
    print(f"return {total.mean():.2f}, success {100.0 * won.mean():.0f} % of {options.num_envs} episodes")
    test_final(
        before, model, again, min(model.num_timesteps // options.num_envs // length * options.num_envs, 100), ended
    )
    vec_env.close()


if __name__ == "__main__":
    main()
