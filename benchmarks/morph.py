"""Morphs: time per particle and step forward and backward, and of whole morphs, on a CPU core or a GPU.

Run from the repository root: ``python -m benchmarks.morph [--device cuda:0] [--frames 420] [--worlds 1 64] [--spacing
0.5] [--damping 8 0.5]``. A ball of radius 6.93 m becomes newton's bunny of the same volume, with the paper's grid,
material and step (Xu, Song, Levin, Hyde 2025); times are processor time on a CPU, wall clock on a GPU.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh
import warp as wp
from scipy.spatial import KDTree

from softmode.mpm import (
    MORPH_MATERIAL,
    MassLoss,
    MorphOptions,
    MorphPlanner,
    MpmSimulation,
    ParticleBody,
    particles_from_mesh,
    particles_from_shape,
)
from tests.shapes import from_newton

RADIUS = 6.93


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=420)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--spacing", type=float, default=0.5, help="distance between particles [m]")
    parser.add_argument("--target", default="bunny", help="an asset of newton's examples, or torus")
    parser.add_argument("--damping", type=float, nargs="+", default=[8.0], help="zeta [1/s]")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    ball, goal = bodies(options.spacing, options.target)
    print(f"{options.device}: ball of {ball.count} particles to {options.target} of {goal.count}")
    chosen = MorphOptions(frame_count=options.frames)
    time_step(ball, goal, chosen, options.device)
    for worlds in options.worlds:
        for damping in options.damping:
            time_morph(ball, goal, replace(chosen, mpm=replace(chosen.mpm, damping=damping)), options.device, worlds)


def bodies(spacing: float, target: str) -> tuple[ParticleBody, ParticleBody]:
    """Return a ball and a target of its volume, both with their centre of mass at the origin."""
    bounds = [[-RADIUS] * 3, [RADIUS] * 3]
    ball = particles_from_shape(
        lambda x: (x**2).sum(axis=1) <= RADIUS**2, bounds, spacing=spacing, material=MORPH_MATERIAL
    )
    if target == "torus":
        mesh = trimesh.creation.torus(7.0, 3.2, major_sections=96, minor_sections=48)
        vertices, faces = mesh.vertices, mesh.faces
    else:
        vertices, faces = from_newton(target)
    corner = vertices[faces]
    volume = abs(np.einsum("ti,ti->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))) / 6.0
    scale = (ball.count * spacing**3 / volume) ** (1.0 / 3.0)
    goal = particles_from_mesh(vertices * scale, faces, spacing=spacing, material=MORPH_MATERIAL)
    return ball.moved(-ball.centre), goal.moved(-goal.centre)


def time_step(ball: ParticleBody, goal: ParticleBody, options: MorphOptions, device: str) -> None:
    """Print the time of a particle's step, forward and backward with the grid computed again."""
    simulation = MpmSimulation(ball, options.mpm, step_count=options.segment_length, device=device)
    loss = MassLoss(options.mpm.grid, goal, device=device)
    value = wp.zeros(1, dtype=wp.float64, device=device)

    def gradient() -> None:
        """Carry the loss back."""
        bar, mass_bar, _ = simulation.bars()
        bar.zero()
        loss.spread(simulation.last.x, simulation.mass, simulation.grid_mass_bar, bar.x, mass_bar)
        simulation.backward()

    simulation.forward()
    simulation.scatter_mass()
    loss.evaluate(simulation.grid_mass, value, simulation.grid_mass_bar)
    gradient()
    count = ball.count * options.segment_length
    forward, backward = (1e6 * clock(run, device) / count for run in (simulation.forward, gradient))
    print(f"a particle's step: forward {forward:.3f} us, backward {backward:.3f} us")


def time_morph(ball: ParticleBody, goal: ParticleBody, options: MorphOptions, device: str, worlds: int) -> None:
    """Print time and accuracy of a morph, after one segment that compiles."""
    MorphPlanner([ball] * worlds, goal, replace(options, frame_count=20), device=device).run()
    planner = MorphPlanner([ball] * worlds, goal, options, device=device)
    start = time.process_time() if device == "cpu" else time.perf_counter()
    run = planner.run()[0]
    wp.synchronize_device(device)
    seconds = (time.process_time() if device == "cpu" else time.perf_counter()) - start
    far = KDTree(goal.positions).query(run.positions[-1])[0]
    print(
        f"{worlds} morphs, zeta {options.mpm.damping:g}, {len(run.losses) - 1} segments: {seconds:.2f} s, loss "
        f"{run.losses[0]:.0f} -> {run.losses[-1]:.1f} (least {run.losses.min():.1f}), accuracy "
        f"{100.0 * run.accuracy:.2f} %, {run.gradient_count} gradients, {run.trial_count} trials, "
        f"{100.0 * (far > 1.0).mean():.2f} % over a cell away, kinetic energy {run.kinetic_energy[-1]:.3g} J"
    )


def clock(run: Callable[[], None], device: str) -> float:
    """Return the median time of five runs [s]."""
    times = []
    for _ in range(5):
        wp.synchronize_device(device)
        start = time.process_time() if device == "cpu" else time.perf_counter()
        run()
        wp.synchronize_device(device)
        times.append((time.process_time() if device == "cpu" else time.perf_counter()) - start)
    return float(np.median(times))


if __name__ == "__main__":
    main()
