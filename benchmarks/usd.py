"""Size and time of OpenUSD stages: a toy written and read, and an animation of it with handles and baked.

The toy is the built-in plush with as many splats as asked for, dropped on the ground and recorded at 30 Hz. Times are
processor time of this process and of the one that opens files, the least of three; baked stages are written once.
``--imports`` times imports instead, the least of five.

Run: ``python -m benchmarks.usd [--splats 20000] [--frames 60] [--imports]``
"""

import argparse
import dataclasses
import os
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.objects import Placed, load
from softmode.splats import Splats, make_plush
from softmode.splats import write_usd as write_splats
from softmode.usd import (
    UsdAnimation,
    UsdAnimationOptions,
    UsdExportOptions,
    add_usd,
    read_animation,
    read_usd_scene,
    write_usd,
)
from tests.usd.test_import_newton import SMALL, everything

DT = 1.0 / 240.0
HALF = UsdExportOptions(weights="half", kaolin=False, splats="half")
FULL = UsdExportOptions()
"""Float weights and Kaolin's attributes."""
BARE = UsdExportOptions(weights="none", kaolin=False)


def toy_with(count: int) -> Placed:
    """Return the plush with a number of splats, in the air."""
    thing = load(size=0.08)
    splats = make_plush(count=count)
    low, high = splats.bounds()
    scale = 0.08 / float((high - low).max())
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    shown = splats.transformed(translation=-scale * centre, scale=scale).transformed(translation=-thing.body.offset)
    toy = dataclasses.replace(thing, splats=shown, material=Material(youngs_modulus=2e4))
    return Placed(object=toy, position=(0.0, 0.0, 0.1), name="toy")


def coloured(splats: Splats, degree: int) -> Splats:
    """Return the splats with random coefficients up to a degree."""
    more = 0.1 * np.random.default_rng(0).normal(size=(splats.count, (degree + 1) ** 2 - 1, 3))
    return dataclasses.replace(splats, sh=np.concatenate([splats.sh, more.astype(np.float32)], axis=1))


def seconds(work: Callable[[], Any], repeats: int = 3) -> float:
    """Return the least processor time of a piece of work, child processes included."""
    best = np.inf
    for _ in range(repeats):
        before = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        work()
        after = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        spent = (b.ru_utime + b.ru_stime - a.ru_utime - a.ru_stime for a, b in zip(before, after, strict=True))
        best = min(best, sum(spent))
    return best


def row(name: str, path: Path, wrote: float, read: float, peak: str = "") -> None:
    """Print a line of the table."""
    print(f"| {name} | {path.stat().st_size / 1e6:.2f} | {wrote:.2f} | {read:.2f} | {peak} |", flush=True)


def report_imports() -> None:
    """Print the table of imports: a robot, a prop and two soft bodies, and a large set of splats."""
    rng, count = np.random.default_rng(0), 300_000
    quats, scales, opacities = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.full((count, 3), 0.01), np.full(count, 0.9)
    with tempfile.TemporaryDirectory() as folder:
        stage, splats = everything(Path(folder) / "a.usda"), Path(folder) / "b.usdc"
        write_splats(
            splats,
            Splats(
                means=rng.normal(size=(count, 3)),
                quats=quats,
                scales=scales,
                opacities=opacities,
                sh=rng.normal(size=(count, 16, 3)),
            ),
        )
        print("| what | size [MB] | time [s] |\n|---|---|---|")
        for name, path, work in (
            ("read_usd_scene, robot, prop, two bodies", stage, lambda: read_usd_scene(stage)),
            (
                "add_usd, the same, bodies cached",
                stage,
                lambda: add_usd(newton.ModelBuilder(), stage, build_options=SMALL),
            ),
            ("read_usd_scene, 300,000 splats of degree 3", splats, lambda: read_usd_scene(splats)),
        ):
            print(f"| {name} | {path.stat().st_size / 1e6:.2f} | {seconds(work, 5):.2f} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, default=20000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--imports", action="store_true", help="time imports instead")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if options.imports:
        report_imports()
        return
    toy = toy_with(options.splats)
    assert toy.splats is not None
    world = newton.ModelBuilder()
    world.add_ground_plane()
    add_reduced_body(world, toy.body, material=toy.material, position=toy.position)
    model: Any = world.finalize(device="cpu")
    solver, state, after = SolverReduced(model, [toy.body]), model.state(), model.state()
    states = []
    for _ in range(options.frames):
        for _ in range(4):
            solver.step(state, after, None, None, DT)
            solver.step(after, state, None, None, DT)
        kept = model.state()
        kept.assign(state)
        states.append(kept)
    print("| what | size [MB] | write [s] | read [s] | record a frame [ms] |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "toy.usdc"
        for name, export in (("toy", FULL), ("toy, weights and Kaolin left out", BARE), ("toy, half", HALF)):
            wrote = seconds(lambda export=export: write_usd(path, toy, options=export))
            row(name, path, wrote, seconds(lambda: add_usd(newton.ModelBuilder(), path)))
        cases: list[tuple[str, Splats, dict[str, Any]]] = [
            ("handles", toy.splats, {}),
            ("handles, float weights and Kaolin", toy.splats, {"export": FULL}),
            ("handles, weights left out", toy.splats, {"export": BARE}),
            ("handles, half", toy.splats, {"export": HALF}),
            ("handles, degree 3", coloured(toy.splats, 3), {}),
            ("handles, degree 3, half", coloured(toy.splats, 3), {"export": HALF}),
            ("baked", toy.splats, {"mode": "baked"}),
            ("baked, half", toy.splats, {"mode": "baked", "export": HALF}),
            ("baked, degree 3", coloured(toy.splats, 3), {"mode": "baked"}),
        ]
        for name, splats, given in cases:
            path = Path(folder) / "animation.usdc"
            settings = UsdAnimationOptions(**given)
            bodies = [dataclasses.replace(toy, splats=splats)]
            animation = UsdAnimation(path, model, bodies, options=settings)
            clock = time.process_time()
            for kept in states:
                animation.record(kept)
            spot = 1e3 * (time.process_time() - clock) / len(states)
            wrote = seconds(animation.publish, 1 if "baked" in name else 3)
            row(
                f"{options.frames} frames, {name}",
                path,
                wrote,
                seconds(lambda p=path: read_animation(p)),
                f"{spot:.2f}",
            )
            os.unlink(path)


if __name__ == "__main__":
    main()
