"""Environment steps per second of a task against the number of worlds, and where the time goes.

Run: ``python -m benchmarks.envs --device cuda:0 --worlds 64 1024 4096 [--pixels 64] [--actions grasp] [--peer FILE]``.
Protocol of Newton's issue 4141: 100 warm-up and 500 measured control steps, random actions, 4 steps of 1/120 s per
control step. ``--actions grasp`` keeps the fingers on the object, as the peer does. ``--poissons-ratio 0.2 0.49`` draws
Poisson's ratio in every world at every reset, as Young's modulus always is. ``--peer`` runs the given script of
MuJoCo-Warp with VBD (the same beam, no observations) on the same world counts in the same call.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import warp as wp

from softmode.envs.catalogue import config_class
from softmode.envs.throughput import report_throughput


def main() -> None:
    """Print one line per world count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="softmode/LiftSoft-v0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--warmup", type=int, default=100)
    parser.add_argument("--pixels", type=int, default=0, help="edge of pixel observations [px]; 0 for states")
    parser.add_argument("--actions", choices=("random", "grasp"), default="random")
    add_object_options(parser)
    parser.add_argument("--stages", action="store_true", help="print the parts of a step")
    parser.add_argument("--peer", default=None, help="script to run on the same device")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    for count in options.worlds:
        given = environment_options(options)
        report_throughput(
            options.env,
            count,
            given,
            steps=options.steps,
            warmup=options.warmup,
            actions=options.actions,
            stages=options.stages,
        )
    if options.peer:
        counts = ",".join(str(count) for count in options.worlds)
        given = {**os.environ, "STEPS": str(min(options.steps, 100)), "WARMUP": "20", "SHARE": "0"}
        subprocess.run([sys.executable, options.peer, options.device, counts], check=False, env=given)


def add_object_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `configuration` reads."""
    parser.add_argument("--preset", default=None, help="such as beam, Isaac Lab's object")
    parser.add_argument(
        "--poissons-ratio", type=float, nargs=2, default=None, help="range from which each world draws at each reset"
    )


def configuration(name: str, options: argparse.Namespace) -> Any:
    """Return the configuration of an environment, with 4 steps of 1/120 s per control step."""
    known = config_class(name)
    config = known() if options.preset in (None, "plush") else known.preset(options.preset)
    ratios = None if options.poissons_ratio is None else tuple(options.poissons_ratio)
    scene = replace(config.scene, control_hz=30.0, substeps=4)
    return replace(config, scene=scene, poissons_ratio_range=ratios)


def environment_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return keyword arguments of the environment."""
    config = configuration(options.env, options)
    if options.pixels:
        config = replace(config, image_size=options.pixels)
    return {
        "config": config,
        "obs_type": "pixels" if options.pixels else "state",
        "device": options.device,
        "output": "torch" if options.device.startswith("cuda") else "numpy",
        "processes": options.processes,
    }


if __name__ == "__main__":
    main()
