"""Fingerprints of what a user gets: equal before and after a change that only moves code.

Hashes of 200 control steps of three tasks (observations, rewards and pictures), of a saved body and a USD stage, the
entities of a recording, and the help of every command. Everything goes through Gymnasium and the command line, so that
the same file runs on any version::

    python benchmarks/fingerprints.py --out out/before.json
    python benchmarks/fingerprints.py --out out/after.json --against out/before.json
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import softmode  # noqa: F401  (registers the environments)

TASKS = ("LiftSoft", "PushSoft", "RopeRoute")
STEPS = 200
COMMANDS = (
    "",
    "play",
    "train",
    "evaluate",
    "export",
    "bench",
    "record",
    "view",
    "list-envs",
    "robots",
    "splat",
    "splat from-mesh",
    "splat info",
    "splat convert",
    "body",
    "body build",
    "body show",
    "body check",
)


def episode(task: str) -> dict[str, str]:
    """Return hashes of what 200 steps of seeded random actions show, episode after episode."""
    env: Any = gym.make(f"softmode/{task}-v0", obs_type="pixels_agent_pos", render_mode="rgb_array", device="cpu")
    numbers, pictures, frames = (hashlib.sha256() for _ in range(3))

    def see(observation: dict[str, np.ndarray]) -> None:
        numbers.update(np.ascontiguousarray(observation["agent_pos"]).tobytes())
        pictures.update(np.ascontiguousarray(observation["pixels"]).tobytes())

    see(env.reset(seed=7)[0])
    env.action_space.seed(7)
    for step in range(STEPS):
        action = env.action_space.sample()
        if step < 60:
            action[2] = -abs(action[2])  # go down first, so that something is touched
        observation, reward, terminated, truncated, _ = env.step(action)
        see(observation)
        numbers.update(np.float64(reward).tobytes())
        numbers.update(np.asarray(env.unwrapped.task.observation.numpy()).tobytes())
        if step % 50 == 49:
            frames.update(np.ascontiguousarray(env.render()).tobytes())
        if terminated or truncated:
            see(env.reset()[0])
    env.close()
    return {"numbers": numbers.hexdigest(), "pictures": pictures.hexdigest(), "frames": frames.hexdigest()}


def scripted(task: str) -> str:
    """Return a hash of a scripted episode: every whole observation and reward."""
    from softmode.envs.scripted import scripted_policy

    env: Any = gym.make(f"softmode/{task}-v0", device="cpu")
    numbers = hashlib.sha256()
    observation, _ = env.reset(seed=3)
    play, done = scripted_policy(env), False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(play(observation))
        values = observation.values() if isinstance(observation, dict) else (observation,)
        for value in values:
            numbers.update(np.ascontiguousarray(value).tobytes())
        numbers.update(np.float64(reward).tobytes())
        done = terminated or truncated
    env.close()
    return numbers.hexdigest()


def run(*words: str) -> str:
    """Return what a command of softmode prints."""
    environment = os.environ | {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "softmode", *words], capture_output=True, text=True, env=environment, check=True
    )
    return done.stdout


def digest_of_arrays(path: Path) -> str:
    """Return a hash of the arrays of an .npz, name by name, and of its header without times and paths."""
    found = hashlib.sha256()
    with np.load(path) as file:
        for name in sorted(file.files):
            found.update(name.encode())
            if name == "header":
                found.update(" ".join(sorted(json.loads(file[name].tobytes()))).encode())
            else:
                found.update(np.ascontiguousarray(file[name]).tobytes())
    return found.hexdigest()


def files(folder: Path) -> dict[str, object]:
    """Return hashes of a body's file and of a stage, and the entities of a recording."""
    from rerun.chunk import RrdReader

    splat, body, stage, record = (folder / name for name in ("toy.ply", "toy.npz", "lift.usda", "lift.rrd"))
    from softmode.splats import make_plush, write_ply

    write_ply(splat, make_plush(2000, seed=0))
    run("body", "build", str(splat), "--out", str(body))
    run("play", "softmode/LiftSoft-v0", "--policy", "zero", "--usd", str(stage), "--rerun", str(record))
    chunks = list(RrdReader(record).stream())
    entities = sorted({chunk.entity_path for chunk in chunks})
    columns = sorted(
        {f"{c.entity_path} {name}" for c in chunks for name in c.to_record_batch().schema.names if ":" in name}
    )
    return {
        "body": digest_of_arrays(body),
        "stage": hashlib.sha256(stage.read_bytes()).hexdigest(),
        "entities": hashlib.sha256("\n".join(entities).encode()).hexdigest(),
        "columns": hashlib.sha256("\n".join(columns).encode()).hexdigest(),
    }


def main() -> None:
    """Print the fingerprints; with ``--against``, name those that differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--against", type=Path)
    options = parser.parse_args()
    found: dict[str, object] = {f"help {name}".strip(): run(*name.split(), "--help") for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        for name, value in files(Path(folder)).items():
            found[f"file {name}"] = value
            print(name, value, flush=True)
    for task in TASKS:
        for name, value in episode(task).items():
            found[f"{task} {name}"] = value
        found[f"{task} scripted"] = scripted(task)
        print(task, found[f"{task} numbers"], flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(found, indent=1))
    if options.against:
        before = json.loads(options.against.read_text())
        differ = sorted(name for name in before.keys() | found.keys() if before.get(name) != found.get(name))
        print("differ:", ", ".join(differ) or "nothing")
        sys.exit(bool(differ))


if __name__ == "__main__":
    main()
