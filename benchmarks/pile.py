"""Cost of contact between soft bodies: cubes stacked on the ground, resting, per step and world.

Run: ``python -m benchmarks.pile [--bodies 3] [--worlds 1] [--device cpu] [--modes 8] [--replays 50]``
"""

import argparse
import time
from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.clock import held
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body, register_custom_attributes
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReduced

DT = 0.004
EDGE = 0.1


SETTLING = 100
"""Replays of two steps before the clock starts."""


def pile(
    body_count: int, world_count: int, mode_count: int, device: str, replays: int = 50
) -> tuple[float, float, float]:
    """Return the time of a step [ms], its mean Newton iterations and the memory per world [bytes], of a stack at rest.

    Args:
        body_count: Bodies in a world.
        world_count: Worlds.
        mode_count: FreeForm's modes of each body.
        device: Warp device.
        replays: Measured replays of two steps, after twice as many in which the stack comes to rest, at most 100.
    """
    before = held(wp.get_device(device))
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
    settling = min(SETTLING, 2 * replays)
    for k in range(settling + replays):
        wp.synchronize_device(device)
        start = clock()
        wp.capture_launch(graph)
        wp.synchronize_device(device)
        if k >= settling:
            times.append(0.5e3 * (clock() - start))
            iterations.append(solver.iteration.numpy().mean())
    assert not solver.status.numpy().any()
    memory = (held(wp.get_device(device)) - before) / world_count
    return float(np.median(times)), float(np.mean(iterations)), memory


def main() -> None:
    """Print one row per number of bodies."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--modes", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--replays", type=int, default=50, help="measured replays of two steps")
    args = parser.parse_args()
    print("| bodies | worlds | ms per step | Newton iterations | memory per world |\n|---|---|---|---|---|")
    for world_count in args.worlds:
        for body_count in args.bodies:
            milliseconds, iterations, memory = pile(body_count, world_count, args.modes, args.device, args.replays)
            print(
                f"| {body_count} | {world_count} | {milliseconds:.2f} | {iterations:.1f} | {memory / 1e3:,.0f} kB |",
                flush=True,
            )


if __name__ == "__main__":
    main()
