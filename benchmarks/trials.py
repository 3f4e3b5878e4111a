"""How many iterations and trials of a step length the worlds of a step take: the slowest worlds hold a GPU's others.

Run: ``python -m benchmarks.trials [--preset beam] [--actions grasp] [--worlds 256] [--warmup 60] [--steps 8]``, on CPU.

LiftSoft is stepped without a recording, so that every iteration of every world can be watched. Printed are means over
all worlds and steps, the 99th percentile, and the mean over steps of what the slowest world takes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from benchmarks import envs, scaling
from softmode.deformables.solver import minimise
from softmode.envs.throughput import _Source
from softmode.scenes import capture


class Unrecorded:
    """Launches that are called, where a recording would repeat them."""

    def __init__(self, launches: Callable[[], None], _device: wp.DeviceLike) -> None:
        """Keep the launches."""
        self.launch = launches


class Watch:
    """Iterations and trials of every world in every step, while it listens."""

    def __init__(self) -> None:
        """Listen."""
        self.iterations: list[np.ndarray] = []
        self.trials: list[np.ndarray] = []
        self._iterate, self._try_step = minimise._iterate, minimise._try_step
        minimise._iterate, minimise._try_step = self.iterate, self.try_step

    def iterate(self, tables: Any, dt: float) -> None:
        """Take an iteration; the first of a step has none before it."""
        if not tables.newton.iteration.numpy().any():
            self.iterations.append(np.zeros(tables.layout.world_count, int))
            self.trials.append(np.zeros(tables.layout.world_count, int))
        self._iterate(tables, dt)
        self.iterations[-1] = tables.newton.iteration.numpy().copy()

    def try_step(self, tables: Any, dt: float) -> None:
        """Take a trial in every world that searches."""
        self.trials[-1] += tables.newton.searching.numpy()
        self._try_step(tables, dt)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    envs.add_object_options(parser)
    parser.add_argument("--actions", choices=("random", "grasp"), default="random")
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--warmup", type=int, default=60, help="control steps that are not counted")
    parser.add_argument("--steps", type=int, default=8)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    capture.Recording = Unrecorded
    env = scaling.make(options.worlds, envs.configuration(scaling.ENVIRONMENT, options), wp.get_device("cpu"))
    reduced = env.task.scene.solver.reduced
    reduced.tables = replace(reduced.tables, one_launch=False)
    source = _Source(env, options.actions, 0)
    env.reset(seed=0)
    watch = Watch()
    for step in range(options.warmup):
        env.step(source(step))
    watch.iterations.clear()
    watch.trials.clear()
    for step in range(options.warmup, options.warmup + options.steps):
        env.step(source(step))
    env.close()
    print(f"{options.preset or 'plush'}, {options.actions}, {options.worlds} worlds, {len(watch.trials)} steps\n")
    print("| | mean | 99 % | slowest world, mean over steps |\n|---|---|---|---|")
    for name, found in (("iterations", watch.iterations), ("trials", watch.trials)):
        all_worlds = np.array(found)
        slowest = all_worlds.max(axis=1).mean()
        print(f"| {name} | {all_worlds.mean():.2f} | {np.percentile(all_worlds, 99):.0f} | {slowest:.1f} |")


if __name__ == "__main__":
    main()
