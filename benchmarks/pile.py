"""Cost of contact between soft bodies: cubes stacked on the ground, resting, per step and world; see `scaling`."""

from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.clock import Clock, held, replayed
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

    play, clock = replayed(two_steps, wp.get_device(device)), Clock(device, replays)
    play(min(SETTLING, 2 * replays))
    times, iterations = [], []
    for _ in range(replays):
        times.append(0.5 * clock.once(lambda: play(1)))
        iterations.append(solver.iteration.numpy().mean())
    assert not solver.status.numpy().any()
    memory = (held(wp.get_device(device)) - before) / world_count
    return float(np.median(times)), float(np.mean(iterations)), memory
