"""Cost of contact between soft bodies: cubes stacked on the ground, resting, per step and world.

Run: ``python benchmarks/pile.py [--bodies 3] [--worlds 1] [--device cpu] [--modes 8]``
"""

import argparse
import time
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_box
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body, register_custom_attributes
from softmode.deformables.solver.solver_reduced import SolverReduced

DT = 0.004
EDGE = 0.1


def pile(body_count: int, world_count: int, mode_count: int, device: str) -> tuple[float, float]:
    """Return the time of a step [ms] and its mean Newton iterations, after the stack has come to rest."""
    quadrature = quadrature_from_box((EDGE,) * 3, point_count=2000, surface_count=300)
    body = build_body(quadrature, BuildOptions(mode_count=mode_count, kernel_count=300, cubature_count=256))
    world = newton.ModelBuilder()
    for k in range(body_count):
        place = (0.0, 0.0, 0.5 * EDGE + k * 1.001 * EDGE)
        add_reduced_body(world, body, material=Material(youngs_modulus=1.0e5), position=place)
    builder = newton.ModelBuilder()
    register_custom_attributes(builder)
    builder.replicate(world, world_count)
    builder.add_ground_plane()
    model: Any = builder.finalize(device=device)
    solver = SolverReduced(model, [body])
    first, second = model.state(), model.state()

    def two_steps() -> None:
        solver.step(first, second, None, None, DT)
        solver.step(second, first, None, None, DT)

    two_steps()
    with wp.ScopedCapture(device=device) as capture:
        two_steps()
    graph: Any = capture.graph
    clock = time.process_time if device == "cpu" else time.perf_counter
    times, iterations = [], []
    for k in range(150):
        wp.synchronize_device(device)
        start = clock()
        wp.capture_launch(graph)
        wp.synchronize_device(device)
        if k >= 100:
            times.append(0.5e3 * (clock() - start))
            iterations.append(solver.iteration.numpy().mean())
    assert not solver.status.numpy().any()
    return float(np.median(times)), float(np.mean(iterations))


def main() -> None:
    """Print one row per number of bodies."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--modes", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    print("| bodies | worlds | ms per step | Newton iterations |\n|---|---|---|---|")
    for world_count in args.worlds:
        for body_count in args.bodies:
            milliseconds, iterations = pile(body_count, world_count, args.modes, args.device)
            print(f"| {body_count} | {world_count} | {milliseconds:.2f} | {iterations:.1f} |", flush=True)


if __name__ == "__main__":
    main()
