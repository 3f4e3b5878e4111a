"""PPO from states for LiftSoft on ten presets, played on them and on five that it never saw.

Of the fifteen presets every third by name is unseen. Worlds get another object at every reset.

Run: ``python -m benchmarks.objects_ppo [--time-limit 411] [--num-envs 4096] [--device cuda:0]``, or with
``--policy FILE`` for the table of a policy; on a CPU add ``--device cpu --num-envs 8 --episodes 2 --time-limit 30``,
which is too short to learn anything.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.object_sets import build_all
from benchmarks.robustness import last_infos
from softmode.envs import LiftSoftConfig
from softmode.learning.intervals import wilson_interval
from softmode.learning.policy import EVALUATION_SEED, Policy, load_policy
from softmode.learning.train_options import TrainOptions
from softmode.learning.trainer import train
from softmode.objects import PRESETS, ObjectSet

SEEN, UNSEEN = ([name for k, name in enumerate(sorted(PRESETS)) if (k % 3 == 2) == last] for last in (False, True))
OPTIONS: dict[str, Any] = {
    "config": {"objects": {"objects": SEEN, "resample": True}, "youngs_modulus_range": None},
}
"""Environment of the training."""


def table(policy: Policy, episodes: int, device: str) -> None:
    """Print how often a policy lifts each object, and how often safely."""
    print("| object | success | 95 % | safe success | peak force at the median [N] |\n|---|---|---|---|---|")
    for label, names in (("unseen", UNSEEN), ("seen", SEEN)):
        objects = ObjectSet(tuple(names), order="in_turn")
        config = LiftSoftConfig(objects=objects, youngs_modulus_range=None)
        count = episodes * len(names)
        env: Any = gym.make_vec(policy.env, num_envs=count, config=config, device=device, autoreset_mode="Disabled")
        observation, _ = env.reset(seed=EVALUATION_SEED)
        found = last_infos(env, policy, observation)
        env.close()
        for name, part in [*zip(names, range(len(names)), strict=True), (f"all {len(names)} {label}", None)]:
            own = slice(None) if part is None else slice(part, None, len(names))
            won, safe, force = (found[key][own] for key in ("is_success", "is_safe_success", "peak_force"))
            low, high = (100.0 * bound for bound in wilson_interval(won.sum(), len(won)))
            share = f"{100.0 * won.mean():.1f} % | {low:.0f} to {high:.0f} %"
            print(f"| {name} | {share} | {100.0 * safe.mean():.0f} % | {np.median(force):.1f} |", flush=True)


def main() -> None:
    """Train, unless a policy is given, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", type=Path, help="file of a policy, in place of a training")
    parser.add_argument("--init", type=Path, help="policy from which training starts")
    parser.add_argument("--time-limit", type=float, default=411.0, help="seconds of training")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="of every object")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--run-dir", type=Path, default=Path("out/objects_ppo"))
    given = parser.parse_args()
    build_all(ObjectSet((*SEEN, *UNSEEN)))
    path = given.policy
    if path is None:
        options = {"num_envs": given.num_envs, "device": given.device, "time_limit": given.time_limit}
        started = {"critic_warmup": 8, "initial_std": 0.3, "max_std": 0.6} if given.init else {}
        options |= {"overrides": {"final_std": 0.1, **started}, "seed": given.seed, "init": given.init}
        options |= {"env_options": OPTIONS, "run_dir": given.run_dir, "eval_episodes": 0}
        result = train(TrainOptions(env="softmode/LiftSoft-v0", total_steps=10**10, **options))
        print(f"trained for {result.seconds:.0f} s, {result.env_steps:,} steps")
        path = result.run_dir / "latest.npz"
    table(load_policy(path), given.episodes, given.device)


if __name__ == "__main__":
    main()
