"""PPO from states for LiftSoft on 12 objects, played on them and on 6 objects that it never saw.

The objects are fifteen presets, a box, a cylinder and a sphere; every third by name is unseen. Worlds get another
object at every reset. Bodies are built into the cache first; the time limit is that of training.

Run: ``python -m benchmarks.objects_ppo [--time-limit 411] [--num-envs 4096] [--device cuda:0]``; on a CPU add
``--device cpu --num-envs 8 --eval-envs 8 --time-limit 30``, which is too short to learn anything.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import warp as wp

from benchmarks.object_sets import build_all
from softmode.envs import LiftSoftConfig
from softmode.envs.presets import RL_BUILD
from softmode.learning.policy import load_policy
from softmode.learning.train_options import TrainOptions
from softmode.learning.trainer import train
from softmode.objects import PRESETS, ObjectConfig, ObjectSet

EVALUATION_SEED = 1_000_000_000
"""Beyond the seeds of training."""


def eighteen(**options: Any) -> ObjectSet:
    """Return all objects by name."""
    shapes = {"box": (0.06, 0.05, 0.05), "cylinder": (0.05, 0.05, 0.07), "sphere": (0.06, 0.06, 0.06)}
    named: dict[str, str | ObjectConfig] = {name: name for name in PRESETS}
    for shape, extents in shapes.items():
        named[shape] = ObjectConfig(shape=shape, extents=extents, surface_count=200, build=RL_BUILD)  # type: ignore[arg-type]
    return ObjectSet(tuple(named[name] for name in sorted(named)), **options)


def make_env(num_envs: int, device: str, weights: tuple[float, ...]) -> Any:
    """Return LiftSoft with another object at every reset, drawn by weights."""
    config = LiftSoftConfig(objects=eighteen(weights=weights, resample=True), youngs_modulus_range=None)
    return gym.make_vec("softmode/LiftSoft-v0", num_envs=num_envs, config=config, device=device, output="torch")


def play(env: Any, policy: Any, names: tuple[str, ...]) -> None:
    """Play one episode per world; print how many succeeded, per object."""
    observation, info = env.reset(seed=EVALUATION_SEED)
    which = np.asarray(torch.as_tensor(info["object"]).cpu())
    running, won = np.ones(len(which), bool), np.zeros(len(which), bool)
    while running.any():
        observation, _, terminated, truncated, info = env.step(policy(observation))
        won |= running & np.asarray(torch.as_tensor(info["is_success"]).cpu()).astype(bool)
        running &= ~np.asarray((terminated | truncated).cpu())
    for k in np.unique(which):
        own = which == k
        print(f"  {names[k]:10s}{won[own].sum():5d} of {own.sum():4d} = {100 * won[own].mean():5.1f} %")
    print(f"  all       {100 * won.mean():.1f} %", flush=True)


def main() -> None:
    """Train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time-limit", type=float, default=411.0, help="seconds of training")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--eval-envs", type=int, default=1024)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--run-dir", type=Path, default=Path("out/objects_ppo"))
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    objects = eighteen()
    build_all(objects)
    unseen = tuple(float(k % 3 == 2) for k in range(len(objects.names)))
    seen = tuple(1.0 - weight for weight in unseen)
    env = make_env(given.num_envs, given.device, seen)
    options = TrainOptions(
        env="softmode/LiftSoft-v0",
        num_envs=given.num_envs,
        device=given.device,
        time_limit=given.time_limit,
        total_steps=10**10,
        run_dir=given.run_dir,
        eval_episodes=0,
    )
    result = train(options, make=lambda *_: env)
    print(f"trained for {result.seconds:.0f} s, {result.env_steps:,} steps")
    policy = load_policy(result.run_dir / "latest.npz", given.device)
    for label, weights in (("unseen", unseen), ("seen", seen)):
        env = make_env(given.eval_envs, given.device, weights)
        print(f"{label} objects:")
        play(env, policy, objects.names)
        env.close()


if __name__ == "__main__":
    main()
