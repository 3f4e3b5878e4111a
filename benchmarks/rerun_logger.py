"""Size and cost of a rerun recording: 20,000 splats over 60 frames, and the lift task with its cameras.

Run: python benchmarks/rerun_logger.py [--splats 20000] [--frames 60]. Prints, per variant, the file's size and the
median process time that a frame of recording adds, beside that of the step itself.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import newton
import numpy as np

import softmode  # noqa: F401  (registers the environments)
from softmode.deformables.materials.material import Material
from softmode.learning.players import policy_factory
from softmode.objects import Placed, SoftObject, load
from softmode.scenes import SplatScene
from softmode.splats import Splats
from softmode.viz.rerun_logger import RerunLogger, RerunOptions


def many_splats(count: int) -> SoftObject:
    """Return the plush with as many splats as asked for, each a jittered copy of one of its own."""
    thing, rng = load(size=0.08, material=Material(youngs_modulus=3.0e4, density=250.0)), np.random.default_rng(0)
    rest = thing.visible_splats
    pick = rng.integers(rest.count, size=count)
    source = rest.subset(pick) if count <= rest.count else None
    arrays = {name: getattr(rest, name)[pick] for name in ("quats", "scales", "opacities", "sh")}
    means = rest.means[pick] + 0.3 * rest.scales[pick] * rng.normal(size=(count, 3))
    splats = source if source is not None else Splats(means=means.astype(np.float32), **arrays, name="many")
    return replace(thing, splats=splats)


def measure(record: Callable[[], None], step: Callable[[], None], frames: int) -> tuple[float, float]:
    """Return the median process times of a recorded frame and of a step [ms]."""
    spent: tuple[list[float], list[float]] = ([], [])
    for _ in range(frames):
        for do, seconds in zip((record, step), spent, strict=True):
            clock = time.process_time()
            do()
            seconds.append(time.process_time() - clock)
    return 1e3 * float(np.median(spent[0])), 1e3 * float(np.median(spent[1]))


def drop(thing: SoftObject, frames: int, options: RerunOptions, path: Path) -> tuple[float, float]:
    """Record a toy that falls on the ground and bounces."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    place = Placed(object=thing, position=(0.0, 0.0, thing.height + 0.05))
    scene, frame = SplatScene(builder, [place]), iter(range(frames + 1))
    scene.step()  # compiles
    with RerunLogger(path, scene, options=options) as log:
        return measure(lambda: log.record(scene.state, time=next(frame) / 30.0), scene.step, frames)


def lift(frames: int, options: RerunOptions, path: Path) -> tuple[float, float]:
    """Record the lift task under its scripted policy."""
    env: Any = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array" if options.images else None)
    seen = [env.reset(seed=0)[0]]
    policy = policy_factory("scripted", env, None)(0)

    def step() -> None:
        seen[0] = env.step(policy(seen[0]))[0]

    try:
        with RerunLogger(path, env, options=options) as log:
            return measure(log.record, step, frames)
    finally:
        env.close()


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--frames", type=int, default=60)
    given = parser.parse_args()
    thing = many_splats(given.splats)
    print(f"{given.frames} frames                                       size [MB]  record [ms]  step [ms]")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.rrd")
        plain = RerunOptions()
        for label, run in (
            (f"{given.splats} splats, covariances within 5 %", lambda: drop(thing, given.frames, plain, path)),
            (
                f"{given.splats} splats, within 20 %",
                lambda: drop(thing, given.frames, replace(plain, covariance_tolerance=0.2), path),
            ),
            (
                f"{given.splats} splats, every change",
                lambda: drop(thing, given.frames, replace(plain, covariance_tolerance=0.0), path),
            ),
            ("lift task, no pictures", lambda: lift(given.frames, replace(plain, images=False), path)),
            ("lift task, two cameras of 256 px", lambda: lift(given.frames, plain, path)),
        ):
            record, step = run()
            print(f"{label:50} {path.stat().st_size / 1e6:9.2f}  {record:11.2f}  {step:9.2f}", flush=True)


if __name__ == "__main__":
    main()
