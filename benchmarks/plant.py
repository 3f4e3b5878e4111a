"""PIE-NeRF's plant of 78 kernels: steps and pictures a second, and what a step and a picture spend their time on.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.plant [--all] [--ranks] [--edge 256] [--splats 14000]``, on a GPU with
``--device cuda:0``. The plant of ``examples/swaying_plant.py`` in its wind, two physics steps
of 1/60 s for each picture; ``--all`` takes all functions of its handles, 2,340 unknowns less those that repeat others,
instead of 240, and ``--rank-tolerance 1e-12`` those too that hardly differ from others. ``--ranks`` prints how many
there are that add more than some fractions of mass, and nothing else.

Processor time of one core; on CUDA the wall clock, and torch's products and Cholesky of the same sizes beside it. The
floor is the arithmetic of assembly and factorisation, 27 n^2 P and (3 n)^3 / 3 flops for n functions at P points, in
each iteration, at the rate of a large float32 matrix product in this run.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import warp as wp

from benchmarks.clock import Clock
from benchmarks.record import add_record_option, record
from benchmarks.step import product_rate, report_torch, stages
from examples.swaying_plant import RATE, STEPS, blow, make_plant, make_scene
from softmode.deformables import BuildOptions
from softmode.deformables.reduction.sources import unpack_sources

DT = 1.0 / (RATE * STEPS)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--all", action="store_true", help="all functions of the handles")
    parser.add_argument("--rank-tolerance", type=float, default=1e-7, help="least mass that a function of --all adds")
    parser.add_argument("--ranks", action="store_true", help="how many of these there are")
    parser.add_argument("--edge", type=int, default=256, help="edge of the picture [px]")
    parser.add_argument("--splats", type=int, default=14000, help="splats of the plant")
    parser.add_argument("--frames", type=int, default=60, help="pictures that are timed")
    add_record_option(parser)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if given.ranks:
        print_ranks()
        return
    build = None
    if given.all:
        build = BuildOptions(handles="local", local_count=78, cubature_count=4800, rank_tolerance=given.rank_tolerance)
    start = time.process_time()
    plant, places = make_plant(build, given.splats)
    built = time.process_time() - start
    with wp.ScopedDevice(given.device):
        scene = make_scene(plant, places[0], given.edge)
        report(scene, built, given)


def report(scene: Any, built: float, given: argparse.Namespace) -> None:
    """Time steps and pictures in the wind, and print what they take."""
    clock, body = Clock(scene.model.device, 9), scene.objects[0].body
    n, points = body.function_count, body.point_count
    rate = product_rate(given.device)
    print(f"{given.device}: float32 matrix product {rate / 1e12:.3f} Tflop/s; {'; '.join(scene.solver.notes)}")
    print(f"{3 * n} unknowns, {points} points; loaded in {built:.1f} s of processor time")
    steps, pictures, iterations = [], [], []
    for frame in range(given.frames + 2):
        blow(scene, frame / RATE, 6.0)
        steps.append(clock.once(scene.step) / STEPS)
        pictures.append(clock.once(scene.draw))
        iterations.append(int(scene.solver.iteration.numpy().max()))
    step, picture, count = np.median(steps[2:]), np.median(pictures[2:]), np.mean(iterations[2:])
    floor = 1e3 * count * (27.0 * n**2 * points + (3 * n) ** 3 / 3.0) / rate
    print(f"a step {step:.2f} ms, {1e3 / step:.0f} a second; {count:.1f} iterations, floor {floor:.2f} ms")
    print(f"a picture of {given.edge} px and {given.splats} splats {picture:.2f} ms, {1e3 / picture:.0f} a second")
    both = STEPS * step + picture
    print(f"two steps and a picture in turn {both:.1f} ms: {1e3 / both:.0f} pictures a second")
    if given.record:
        seconds = 1e-3 * step if scene.model.device.is_cpu else step
        name = f"all_{'core' if scene.model.device.is_cpu else 'h200'}"
        measured = {name: seconds} if given.all else {"steps": 1e3 / step, "pictures": 1e3 / picture}
        record("plant", measured, given.device)
    constraints = int(scene.solver.tables.constraints.count.numpy().max())
    print(f"status {int(scene.solver.status.numpy().max())}, {constraints} constraints; each phase and a picture:")
    state, (camera,) = scene.state, scene.cameras.values()
    parts = stages(scene.solver, state, state, scene.control, DT)
    parts |= {"picture: warp": lambda: scene.splats.update(state), "picture: draw": lambda: camera.render(state)}
    for name, run in parts.items():
        print(f"    {name:<32}{clock.replay(run):9.3f} ms")
    if scene.model.device.is_cuda:
        report_torch(body, 1, 25)


def print_ranks() -> None:
    """Print how many functions of all handles add more than some fractions of mass."""
    body = make_plant(BuildOptions(handles="local", local_count=78, cubature_count=16), 2000)[0].body
    quadrature = unpack_sources(body).quadrature
    raw = body.raw.evaluate(quadrature.points - body.offset)[0] * np.sqrt(quadrature.weights)[:, None]
    raw /= np.maximum(np.linalg.norm(raw, axis=0), 1e-300)
    value = np.linalg.eigvalsh(raw.T @ raw)
    ranks = {f"{least:.0e}": int((value > least * value[-1]).sum()) for least in (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12)}
    print(f"{raw.shape[1]} functions; above fractions of mass there are {ranks}; the body has {body.function_count}")


if __name__ == "__main__":
    main()
