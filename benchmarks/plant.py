"""PIE-NeRF's plant of 78 kernels: steps and pictures a second, and what a step and a picture spend their time on.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.plant [--all] [--ranks] [--edge 256] [--splats 14000]``. The plant of
``examples/swaying_plant.py`` in its wind, two physics steps of 1/60 s for each picture; ``--all`` takes all functions
of its handles, 2,340 unknowns less those that repeat others, instead of 240. ``--ranks`` prints how many there are that
add more than some fractions of mass, and nothing else. Processor time of one core. The floor is
the arithmetic of assembly and factorisation, 27 n^2 P and (3 n)^3 / 3 flops for n functions at P points, in each
iteration, at the rate of a large float32 matrix product in this run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.step import product_rate
from examples.swaying_plant import BUILD, RATE, STEPS, blow, make_plant, make_scene
from softmode.deformables import BuildOptions
from softmode.deformables.build.sources import unpack_sources
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve

DT = 1.0 / (RATE * STEPS)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="all functions of the handles")
    parser.add_argument("--ranks", action="store_true", help="how many of these there are")
    parser.add_argument("--edge", type=int, default=256, help="edge of the picture [px]")
    parser.add_argument("--splats", type=int, default=14000, help="splats of the plant")
    parser.add_argument("--frames", type=int, default=60, help="pictures that are timed")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if given.ranks:
        print_ranks()
        return
    build = BuildOptions(handles="local", local_count=78, cubature_count=4800) if given.all else BUILD
    start = time.process_time()
    plant, places = make_plant(build, given.splats)
    built = time.process_time() - start
    scene = make_scene(plant, places[0], given.edge)
    n, points = plant.body.function_count, plant.body.point_count
    print(f"{3 * n} unknowns, {points} points; loaded in {built:.1f} s of processor time")
    steps, pictures, iterations = [], [], []
    for frame in range(given.frames + 2):
        blow(scene, frame / RATE, 6.0)
        steps.append(timed(scene.step) / STEPS)
        pictures.append(timed(scene.draw))
        iterations.append(int(scene.solver.iteration.numpy().max()))
    step, picture, count = np.median(steps[2:]), np.median(pictures[2:]), np.mean(iterations[2:])
    floor = 1e3 * count * (27.0 * n**2 * points + (3 * n) ** 3 / 3.0) / product_rate("cpu")
    print(f"a step {step:.2f} ms, {1e3 / step:.0f} a second; {count:.1f} iterations, floor {floor:.2f} ms")
    print(f"a picture of {given.edge} px and {given.splats} splats {picture:.2f} ms, {1e3 / picture:.0f} a second")
    both = STEPS * step + picture
    print(f"two steps and a picture in turn on one core {both:.1f} ms: {1e3 / both:.0f} pictures a second")
    print(f"status {int(scene.solver.status.numpy().max())}; of an iteration with new stiffness, and of a picture:")
    for name, milliseconds in stages(scene).items():
        print(f"    {name:<12}{milliseconds:9.2f} ms")


def print_ranks() -> None:
    """Print how many functions of all handles add more than some fractions of mass."""
    body = make_plant(BuildOptions(handles="local", local_count=78, cubature_count=16), 2000)[0].body
    quadrature = unpack_sources(body).quadrature
    raw = body.raw.evaluate(quadrature.points - body.offset)[0] * np.sqrt(quadrature.weights)[:, None]
    raw /= np.maximum(np.linalg.norm(raw, axis=0), 1e-300)
    value = np.linalg.eigvalsh(raw.T @ raw)
    ranks = {f"{least:.0e}": int((value > least * value[-1]).sum()) for least in (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12)}
    print(f"{raw.shape[1]} functions; above fractions of mass there are {ranks}; the body has {body.function_count}")


def stages(scene: Any) -> dict[str, float]:
    """Return what the stages of an iteration and of a picture take, each recorded on its own [ms]."""
    tables, progress = scene.solver.tables, scene.solver.tables.newton

    def stage(run: Callable[[], None]) -> Callable[[], None]:
        def prepared() -> None:
            progress.active.fill_(1)
            progress.refresh.fill_(1)
            run()

        return prepared

    def assembled() -> None:
        evaluate(tables, DT, derivatives=True)
        gather_gradient(tables, DT)
        assemble(tables, DT)

    (camera,) = scene.cameras.values()
    runs = {
        "assembly": stage(assembled),
        "solve": stage(lambda: solve(tables)),
        "warp": lambda: scene.splats.update(scene.state),
        "draw": lambda: camera.render(scene.state),
    }
    return {name: recorded(run, scene.model.device) for name, run in runs.items()}


def recorded(run: Callable[[], None], device: Any) -> float:
    """Return the median time of a captured call [ms]."""
    run()
    with wp.ScopedCapture(device=device) as capture:
        run()
    graph: Any = capture.graph
    return float(np.median([timed(lambda: wp.capture_launch(graph)) for _ in range(9)]))


def timed(run: Callable[[], object]) -> float:
    """Return the processor time of a call [ms]."""
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


if __name__ == "__main__":
    main()
