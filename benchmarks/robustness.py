"""How far from its training a policy still succeeds: stiffness, density, size, friction, delays, noise, drives.

Run: ``python -m benchmarks.robustness policies/lift_soft_robust.npz``. Every row changes one thing and leaves the rest
as the policy was trained. A row is `--episodes` whole episodes on seeds that training does not use; all rows play the
same seeds. Policies that were trained without delay do not see the last actions. Rough hands end no episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from softmode.envs.disturbances import LIMITS, neutral
from softmode.learning.config_values import with_config
from softmode.learning.intervals import wilson_interval
from softmode.learning.policy import EVALUATION_SEED, Policy, load_policy

FACTORS = {"density": (0.5, 2.0), "friction": (0.5, 0.75, 1.25), "scale": (0.8, 0.9, 1.1, 1.2)}
"""Factors of what the object is by default."""
VALUES = {
    "youngs_modulus": (1e4, 2e4, 2e6, 4e6),
    "action_delay": (1.0, 2.0, 3.0, (0.0, 3.0)),
    "observation_delay": (1.0, 2.0),
    "observation_noise": (1.0, 2.0, 5.0),
    "observation_bias": (1.0, 2.0, 5.0),
    "gain": (0.7, 1.4),
    "drive_friction": (0.02, 0.05),
    "effort": (0.7, 1.4),
}
"""Values, or a range of which every world has its own."""


def rows(table: Mapping[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, value as it is told, and the reset options of every row, the first without any change."""
    found: list[tuple[str, str, dict[str, Any]]] = [("as trained", "", {})]
    for name, factors in FACTORS.items():
        own = 0.5 * (table[name].low[0] + table[name].high[0])
        found += [(name, f"{factor * own:.4g}", {name: factor * own}) for factor in factors]
    for name, values in VALUES.items():
        for value in values:
            told = f"{value[0]:g} to {value[1]:g}, random" if isinstance(value, tuple) else f"{value:g}"
            found.append((name, told, {name: value}))
    return found


def worlds_of(policy: Policy, count: int, **options: Any) -> Any:
    """Return worlds of the policy's environment in which all disturbances can be set, and rough hands end nothing."""
    on = {f"{name}_range": (neutral(name), max(neutral(name), 3.0 * ("delay" in name))) for name in LIMITS}
    given = with_config(policy.env, {**policy.env_options, "terminate_when_rough": False, **on, **options})
    return gym.make_vec(policy.env, num_envs=count, autoreset_mode="Disabled", **given)


def play(env: Any, policy: Policy, options: Mapping[str, Any], seed: int) -> dict[str, np.ndarray]:
    """Play an episode in every world; return what the last infos say."""
    count, segments = env.num_envs, env.unwrapped.task.segments
    random = np.random.default_rng(seed)
    given = {
        name: random.uniform(value[0], value[1], count) if isinstance(value, tuple) else value
        for name, value in options.items()
    }
    given = {**{name: neutral(name) for name in LIMITS}, **given}
    observation, _ = env.reset(seed=seed, options=given)
    hidden = np.r_[segments["last_actions"][0]]
    if observation.shape[1] == policy.interface.vectors["state"]:
        hidden = hidden[:0]
    return last_infos(env, lambda seen: policy(np.delete(seen, hidden, axis=1)), observation)


def last_infos(env: Any, player: Callable[[Any], Any], observation: Any) -> dict[str, np.ndarray]:
    """Play an episode that has begun in every world, none of which begins anew; return what the last infos say."""
    alive, found = np.ones(env.num_envs, bool), {}
    while alive.any():
        observation, _, terminated, truncated, infos = env.step(player(observation))
        ended = alive & (terminated | truncated)
        for name in ("is_success", "is_safe_success", "peak_force"):
            found.setdefault(name, np.zeros(env.num_envs))[ended] = np.asarray(infos[name], float)[ended]
        alive &= ~ended
    return found


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("policy", type=Path)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED)
    parser.add_argument("--only", nargs="*", help="names of what is changed")
    parser.add_argument("--device", default=None)
    args = parser.parse_args(arguments)
    policy = load_policy(args.policy)
    env = worlds_of(policy, args.episodes, device=args.device)
    print("| changed | to | success | 95 % | safe success | peak force at the median [N] |\n|---|---|---|---|---|---|")
    for name, told, options in rows(env.unwrapped.task.table.parameters):
        if args.only and options and name not in args.only:
            continue
        found = play(env, policy, options, args.seed)
        low, high = wilson_interval(found["is_success"].sum(), args.episodes)
        share, safe = (100.0 * found[key].mean() for key in ("is_success", "is_safe_success"))
        cells = (name, told, f"{share:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %", f"{safe:.0f} %")
        print(f"| {' | '.join(cells)} | {np.median(found['peak_force']):.1f} |", flush=True)
    env.close()


if __name__ == "__main__":
    main()
