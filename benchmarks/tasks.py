"""Tasks against methods: how often each succeeds, and how gently; the page docs/benchmark_tasks.md.

Run: ``python -m benchmarks.tasks`` writes the page from docs/data/tasks.csv. ``python -m benchmarks.tasks scripted
LiftSoft --episodes 50`` plays a cell and adds its row. In place of ``scripted`` it takes ``MPC``, or the file of a
policy (.npz of softmode, .zip of Stable-Baselines3's SAC), with ``--method``, ``--steps``, ``--seconds``, ``--seed``
and ``--machine`` of its training.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import softmode
from softmode.learning.intervals import wilson_interval

DOCS = Path(__file__).resolve().parents[1] / "docs"
DATA, PAGE = DOCS / "data" / "tasks.csv", DOCS / "benchmark_tasks.md"
IDS = {name.partition("/")[2].rpartition("-")[0]: name for name in softmode.ENVIRONMENTS}
METHODS = ("scripted", "PPO", "PPO from pictures", "SAC with HER", "behaviour cloning", "MPC")
COLUMNS = (
    *("task", "method", "seed", "episodes", "successes", "safe", "steps", "seconds", "machine", "commit", "command"),
)
SECONDS = {"PlaceInBin": 300, "RopeRoute": 290, "LiftSoft": 170}
"""Seconds of training where they are not 120."""
PREAMBLE = """# Tasks and methods

How often a method succeeds in a task, with its 95 % interval (Wilson), and how often it does so within the
[limits of force and strain](environments.md#gentle-hands). Episodes are whole ones on seeds that training does not use,
in the task's default ranges or those of its command; policies act without noise. Steps and time are those of the
training. What was not run is empty and has its command; what does not apply has the reason. A policy's range is
measured by
`python -m benchmarks.robustness policies/lift_soft_robust.npz`.

This page is written by `python -m benchmarks.tasks` from `docs/data/tasks.csv`.
"""


def cell(task: str, method: str) -> tuple[str, str]:
    """Return the command of a cell that was not run, or an empty one and why there is none."""
    env, goals = IDS[task], task.endswith("Goal")
    train = (
        f"softmode train {env} --device cuda:0 --num-envs 4096 --time-limit {SECONDS.get(task, 120)} --eval-every 20"
    )
    pictures = """ --obs-type pixels_agent_pos --env-options '{"config": {"image_size": 64}}'"""
    if method == "scripted":
        return f"python -m benchmarks.tasks scripted {task} --episodes 50", ""
    if method.startswith("PPO"):
        return ("", "rewards are sparse") if goals else (train + pictures * ("pictures" in method), "")
    if method == "SAC with HER":
        return (f"python examples/train_sb3.py --env {env}", "") if goals else ("", "observations have no goal")
    if method == "behaviour cloning":
        return f"python examples/behaviour_cloning.py --env {env}", ""
    if task != "PushSoft":
        return "", "no example yet"
    return "python -m benchmarks.tasks MPC PushSoft --episodes 20", ""


def known() -> list[dict[str, str]]:
    """Return the rows that were measured."""
    with DATA.open(newline="") as file:
        return list(csv.DictReader(file))


def page(rows: list[dict[str, str]]) -> str:
    """Return the page."""
    text = PREAMBLE
    for task in IDS:
        text += (
            f"\n## {task}\n\n| method | seed | success | safe success | steps | time | machine, commit | command |\n"
        )
        text += "|---|---|---|---|---|---|---|---|\n"
        for method in METHODS:
            found = [row for row in rows if (row["task"], row["method"]) == (task, method)]
            for row in found:
                low, high = wilson_interval(float(row["successes"]), int(row["episodes"]))
                of = row["episodes"]
                success = f"{row['successes']} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"
                safe = f"{row['safe']} of {of}" if row["safe"] else ""
                time = f"{float(row['seconds']):.0f} s" if row["seconds"] else ""
                steps = f"{int(row['steps']):,}" if row["steps"] else ""
                cells = (method, row["seed"], success, safe, steps, time, f"{row['machine']}, {row['commit']}")
                text += f"| {' | '.join(cells)} | `{row['command']}` |\n"
            if not found:
                command, reason = cell(task, method)
                text += f"| {method} | | {reason or 'not run'} | | | | | {f'`{command}`' if command else ''} |\n"
    return text


def play_mpc(episodes: int, seed: int, worlds: int = 32) -> tuple[int, int]:
    """Return in how many episodes examples/mpc_push.py succeeded, and in how many safely; the arm rests once it has."""
    from examples.mpc_push import ENV, PLANS, actions_of, drive

    env: Any = gym.make(ENV)
    model: Any = gym.make_vec(ENV, num_envs=worlds, autoreset_mode="Disabled")
    won = safe = 0
    for episode in range(seed, seed + episodes):
        _, _, info = drive(env, model, episode, PLANS)
        done = False
        while not done:
            *_, terminated, truncated, info = env.step(actions_of(np.zeros(2, np.float32)))
            done = terminated or truncated
        won, safe = won + info["is_success"], safe + info["is_safe_success"]
    return int(won), int(safe)


def sac_player(path: str) -> Any:
    """Return the policy that examples/train_sb3.py wrote."""
    from stable_baselines3 import SAC

    without = {"replay_buffer_class": None, "replay_buffer_kwargs": {}}
    model = SAC.load(path, custom_objects=without, device="cpu")
    return lambda seen: model.predict(seen, deterministic=True)[0]


def play(task: str, policy: str, episodes: int, seed: int, device: str | None) -> tuple[int, int]:
    """Return in how many episodes a policy succeeded, and in how many safely."""
    from benchmarks.robustness import last_infos
    from softmode.envs import scripted_policy
    from softmode.learning.config_values import with_config
    from softmode.learning.policy import load_policy

    if policy == "MPC":
        return play_mpc(episodes, seed)
    trained = None if policy == "scripted" or policy.endswith(".zip") else load_policy(policy)
    whole = {"terminate_when_rough": False}
    options: dict[str, Any] = {} if trained is None else with_config(trained.env, {**trained.env_options, **whole})
    env: Any = gym.make_vec(IDS[task], num_envs=episodes, autoreset_mode="Disabled", device=device, **options)
    player: Any = trained or (scripted_policy(env) if policy == "scripted" else sac_player(policy))
    observation, _ = env.reset(seed=seed)
    found = last_infos(env, player, observation)
    env.close()
    return int(found["is_success"].sum()), int(found["is_safe_success"].sum())


def main(arguments: list[str] | None = None) -> None:
    """Play a cell, if one is given, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("policy", nargs="?", help="scripted, MPC, or the file of a policy")
    parser.add_argument("task", nargs="?", choices=tuple(IDS))
    parser.add_argument("--method", choices=METHODS)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=1_000_000_000)
    parser.add_argument("--device")
    for name in ("seed", "steps", "seconds", "command"):
        parser.add_argument(f"--{name}", default="")
    parser.add_argument("--machine", default="one core")
    args = parser.parse_args(arguments)
    if args.policy and not (args.task and (args.method or args.policy in METHODS)):
        parser.error("give the task, and --method with the file of a policy")
    rows = known()
    if args.policy:
        method = args.method or args.policy
        won, safe = play(args.task, args.policy, args.episodes, args.first_seed, args.device)
        commit = subprocess.run(
            ["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True
        ).stdout.strip()
        told = {**vars(args), "method": method, "successes": won, "safe": safe, "commit": commit}
        told["command"] = args.command or cell(args.task, method)[0]
        print(f"{args.task}, {method}: {won} of {args.episodes}, {safe} safely")
        key = (args.task, method, args.seed)
        rows = [row for row in rows if (row["task"], row["method"], row["seed"]) != key]
        rows.append({name: str(told[name]) for name in COLUMNS})
        with DATA.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    PAGE.write_text(page(rows))


if __name__ == "__main__":
    main()
