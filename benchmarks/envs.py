"""Environment steps per second of a task against the number of worlds, and where the time goes.

Run: ``python -m benchmarks.envs --device cuda:0 --worlds 64 1024 4096 [--pixels 64] [--actions grasp] [--peer FILE]``.
Protocol of Newton's issue 4141: 100 warm-up and 500 measured control steps, random actions, 4 steps of 1/120 s per
control step. ``--actions grasp`` keeps the fingers on the object, as the peer does. ``--peer`` runs the given script of
MuJoCo-Warp with VBD (the same beam, no observations) on the same world counts in the same call.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import gymnasium as gym
import warp as wp
from gymnasium.envs.registration import load_env_creator

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.soft_vector_env import SoftVectorEnv, checked_device
from softmode.envs.throughput import measure_throughput, stage_times


def main() -> None:
    """Print one line per world count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="softmode/LiftSoft-v0")
    parser.add_argument("--preset", default=None, help="such as beam, Isaac Lab's object")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--warmup", type=int, default=100)
    parser.add_argument("--pixels", type=int, default=0, help="edge of pixel observations [px]; 0 for states")
    parser.add_argument("--actions", choices=("random", "grasp"), default="random")
    parser.add_argument("--stages", action="store_true", help="print the parts of a step")
    parser.add_argument("--peer", default=None, help="script to run on the same device")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = checked_device(options.device)
    for count in options.worlds:
        free = device.free_memory if device.is_cuda else 0
        clock = time.perf_counter()
        env = make(options, count)
        made = time.perf_counter() - clock
        result = measure_throughput(
            env, steps=options.steps, warmup=options.warmup, actions=options.actions, free_before=free
        )
        print(
            f"{count} worlds, {options.actions}: {result.rate:,.0f} env-steps/s, "
            f"{1e3 * result.seconds / result.steps:.2f} ms per step, touching {100 * result.touching:.0f} %, "
            f"{result.failures} failures, {result.megabytes:.0f} MB, made in {made:.1f} s",
            flush=True,
        )
        if options.stages and options.processes == 1:
            parts = ", ".join(f"{name} {spent:.2f} ms" for name, spent in stage_times(env.task).items())
            print(f"   {parts}", flush=True)
        env.close()
        del env
    if options.peer:
        counts = ",".join(str(count) for count in options.worlds)
        given = {**os.environ, "STEPS": str(min(options.steps, 100)), "WARMUP": "20", "SHARE": "0"}
        subprocess.run([sys.executable, options.peer, options.device, counts], check=False, env=given)


def make(options: argparse.Namespace, count: int) -> SoftVectorEnv:
    """Return the vector environment with 4 steps of 1/120 s per control step."""
    env_class: Any = load_env_creator(str(gym.spec(options.env).vector_entry_point))
    config_class = env_class.task_class.config_class
    config = config_class() if options.preset is None else config_class.preset(options.preset)
    scene = replace(config.scene, control_hz=30.0, substeps=4)
    if options.pixels:
        config = replace(config, image_size=options.pixels)
    env = gym.make_vec(
        options.env,
        num_envs=count,
        config=replace(config, scene=scene),
        obs_type="pixels" if options.pixels else "state",
        device=options.device,
        output="torch" if options.device.startswith("cuda") else "numpy",
        processes=options.processes,
    )
    assert isinstance(env, SoftVectorEnv)
    return env


if __name__ == "__main__":
    main()
