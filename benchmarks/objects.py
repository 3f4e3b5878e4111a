"""What the preset objects cost, and how far a rope bends with which handles.

The first table has one line per object of `softmode.objects.task_objects`: sizes, processor time of the build without a
cache, time of a step at rest on the ground. The second one presses on their tops and compares with many functions. The
third one holds a rope in its middle and compares the drop of its ends with the heavy elastica's.

Run: ``python -m benchmarks.objects [--load 2.5]``
"""

import argparse
import os
import tempfile
import time
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.clock import Clock
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.reduced_stiffness import reduced_stiffness
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.objects import ObjectConfig, load, task_objects
from tests.objects.test_primitives import hang, heavy_elastica
from tests.scenes import GRAVITY

DT = 1.0 / 240.0
PATCH = 0.024
"""Diameter of what presses on an object [m]."""
FINE = BuildOptions(mode_count=16, handles="quadratic", rank_tolerance=1e-9)
ROPES = (
    BuildOptions(mode_count=6),
    BuildOptions(mode_count=16),
    BuildOptions(mode_count=16, rank_tolerance=1e-9),
    BuildOptions(mode_count=6, handles="quadratic"),
    BuildOptions(mode_count=3, handles="quadratic", rank_tolerance=1e-9),
    BuildOptions(mode_count=4, handles="quadratic", rank_tolerance=1e-9),
    BuildOptions(mode_count=6, handles="quadratic", rank_tolerance=1e-9),
)


def step_time(name: str) -> str:
    """Return the table row of a preset."""
    clock = time.process_time()
    thing, material = load(getattr(task_objects, name), progress=False), getattr(task_objects, f"{name}_MATERIAL")
    seconds = time.process_time() - clock
    world = newton.ModelBuilder()
    add_reduced_body(world, thing.body, material=material, position=(0.0, 0.0, thing.height))
    world.add_ground_plane()
    model: Any = world.finalize(device="cpu")
    solver, first, second = SolverReduced(model, [thing.body]), model.state(), model.state()

    def two_steps() -> None:
        solver.step(first, second, None, None, DT)
        solver.step(second, first, None, None, DT)

    for _ in range(60):
        two_steps()
    step, body = 0.5 * Clock("cpu", 60).replay(two_steps), thing.body
    sizes = f"{body.function_count} | {body.point_count} | {body.surface_count} | {thing.visible_splats.count}"
    return f"| {name} | {sizes} | {seconds:.2f} | {step:.2f} |"


def compliance(config: ObjectConfig, ratio: float, build: BuildOptions) -> float:
    """Return how far a free object gives, per unit of force, under a round patch in the middle of its top [1/m]."""
    body = load(replace(config, build=replace(build, cubature_count=None)), progress=False).body
    gradient = body.cubature.grad_basis.astype(np.float64).transpose(1, 2, 0)
    value, mode = np.linalg.eigh(reduced_stiffness(gradient, body.cubature.weights, ratio))
    across = PATCH * (np.mgrid[-10:11, -10:11].reshape(2, -1).T / 20.0)
    across = across[np.linalg.norm(across, axis=1) <= 0.5 * PATCH]
    top = body.bounds[:, :2].mean(axis=0), body.bounds[1, 2]
    force = body.evaluate(np.column_stack([top[0] + across, np.full(len(across), top[1])]))[0].mean(axis=0)
    load_on = mode[2 * body.function_count :].T @ force
    return float((load_on[6:] ** 2 / value[6:]).sum())  # The object accelerates under the force.


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--load", type=float, default=2.5, help="w (L/2)^3 / (E I) of the rope")
    pull = parser.parse_args().load
    wp.config.log_level = wp.LOG_WARNING
    print("| preset | functions | points | samples | splats | build [s] | ms per step |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SOFTMODE_CACHE"] = folder
        load(task_objects.CUBE, progress=False)  # imports what builds need
        for name in ("BEAM", "CUBE", "PAD", "ROPE"):
            os.environ["SOFTMODE_CACHE"] = os.path.join(folder, name)
            print(step_time(name), flush=True)
        print(f"\npatch of {1e3 * PATCH:.0f} mm: compliance over that of quadratic handles of 16 modes")
        for name in ("BEAM", "CUBE", "PAD"):
            config, ratio = getattr(task_objects, name), getattr(task_objects, f"{name}_MATERIAL").poissons_ratio
            print(name, round(compliance(config, ratio, config.build) / compliance(config, ratio, FINE), 2), flush=True)
        half, radius = 0.5 * task_objects.ROPE.extents[0], 0.5 * task_objects.ROPE.extents[1]  # type: ignore[index]
        modulus = 1000.0 * GRAVITY * 4.0 * half**3 / (pull * radius**2)
        material = replace(task_objects.ROPE_MATERIAL, youngs_modulus=modulus, density=1000.0)
        exact = half * heavy_elastica(pull)[0]
        print(f"\nelastica: {exact / half:.3f} of half the length")
        print("| handles | modes | rank tolerance | functions | drop over the elastica's |\n|---|---|---|---|---|")
        for build in ROPES:
            thing = load(replace(task_objects.ROPE, build=build), progress=False)
            drop = float(np.asarray(hang(thing, material, half))[0])
            row = f"{build.handles} | {build.mode_count} | {build.rank_tolerance:g} | {thing.body.function_count}"
            print(f"| {row} | {drop / exact:.3f} |", flush=True)


if __name__ == "__main__":
    main()
