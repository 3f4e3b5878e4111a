"""The product's own particles (`softmode.mpm`) in the column MPM: explicit steps on a grid, held by springs.

Springs act on particles before each step, implicitly, so that they do not bound its length; particles are where they
are compared. The scheme keeps energy, where implicit Euler, the reference's, loses some.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from benchmarks.accuracy import KAPPA
from benchmarks.freeform.explicit_kernels import pull_particles
from benchmarks.freeform.grips import DENSITY, DT, POISSONS_RATIO, Grip
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.mpm.grid import Grid
from softmode.mpm.options import MpmOptions
from softmode.mpm.particles import ParticleBody
from softmode.mpm.simulation import MpmSimulation
from tests.oracle import frames
from tests.oracle.scenes import SCENES, Scene

Array = NDArray[np.float64]

COURANT = 0.4
"""Part of a cell that sound crosses in a step."""
PARTS = 2
"""Particles along the edge of a cell."""


@dataclass(frozen=True, kw_only=True)
class Springs:
    """What holds particles."""

    index: NDArray[np.intp]
    """Particles, (S,)."""
    stiffness: Array
    """Of each [N/m], (S,)."""
    targets: Callable[[float], Array]
    """Where they pull at a time [s], (S, 3) [m]."""


class ExplicitParticles:
    """An object as particles.

    Args:
        points: Rest positions [m], (N, 3).
        volumes: Volumes [m^3], (N,).
        spacing: Edge of the grid's cells [m].
        material: Young's modulus [Pa], Poisson's ratio and density [kg/m^3].
        gravity: Acceleration [m/s^2].
        springs: What holds them.
        dt: Duration of a frame [s].
        reach: How far particles may move [m].
    """

    def __init__(
        self,
        points: Array,
        volumes: Array,
        spacing: float,
        material: tuple[float, float, float],
        gravity: Any,
        springs: Springs,
        dt: float,
        reach: float,
    ) -> None:
        """Put them at rest on a grid."""
        modulus, ratio, density = material
        made = Material(
            model=MaterialModel.STABLE_NEO_HOOKEAN,
            youngs_modulus=modulus,
            poissons_ratio=ratio,
            density=density,
            viscosity=0.0,
        )
        sound = math.sqrt(modulus * (1.0 - ratio) / ((1.0 + ratio) * (1.0 - 2.0 * ratio)) / density)
        self.substeps = math.ceil(dt * sound / (COURANT * spacing))
        body = ParticleBody(positions=points, masses=density * volumes, material=made)
        self.rest, self.dt, self.springs, self.time = points, dt, springs, 0.0
        grid = Grid.around(points, spacing=spacing, room=math.ceil(reach / spacing))
        pull: Any = tuple(map(float, gravity))
        options = MpmOptions(grid=grid, dt=dt / self.substeps, gravity=pull)
        self.simulation = MpmSimulation(body, options, step_count=1, device="cpu")
        self.index = wp.array(springs.index, dtype=int, device="cpu")
        self.stiffness = wp.array(springs.stiffness, dtype=float, device="cpu")

    def step(self) -> Array:
        """Take a frame; return displacements [m], (N, 3)."""
        simulation, small = self.simulation, self.dt / self.substeps
        for _ in range(self.substeps):
            self.time += small
            target = wp.array(self.springs.targets(self.time), dtype=wp.vec3, device="cpu")
            state = simulation.first
            inputs = [state.x, state.v, simulation.mass, self.index, self.stiffness, target, small]
            wp.launch(pull_particles, len(self.index), inputs=inputs, device="cpu")
            simulation.forward()
            state.copy_from(simulation.last)
        simulation.check()
        return simulation.last.x.numpy()[0].astype(np.float64) - self.rest


def beam_particles(scene: Scene, spacing: float) -> ExplicitParticles:
    """Return the beam of a scene, its clamps held by springs of `KAPPA`."""
    lower, upper = scene.shape.bounds
    count = np.round((upper - lower) / spacing * PARTS).astype(int)
    width = (upper - lower) / count
    axes = [lower[d] + (np.arange(count[d]) + 0.5) * width[d] for d in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    held = [(np.flatnonzero(clamp.region.contains(points)), clamp.motion) for clamp in scene.clamps]
    index = np.concatenate([rows for rows, _ in held])
    springs = Springs(
        index=index,
        stiffness=np.full(len(index), KAPPA * width.prod()),
        targets=lambda at: np.concatenate([motion.position(points[rows], at) for rows, motion in held]),
    )
    material = scene.youngs_modulus, scene.poissons_ratio, scene.density
    volumes = np.full(len(points), width.prod())
    return ExplicitParticles(points, volumes, spacing, material, scene.gravity, springs, scene.dt, 4.0)


def run_beam(name: str, steps: int, spacing: float) -> dict[str, Any]:
    """Run a scene of the beam; return its error against the exact clamp, and the median processor time of a step."""
    scene = SCENES[name]
    beam = beam_particles(scene, spacing)
    expected = frames.load(name).displacement(beam.rest, slice(1, steps + 1))
    errors, clock = [], []
    for frame in expected:
        start = time.process_time()
        found = beam.step()
        clock.append(1e3 * (time.process_time() - start))
        errors.append(float(((found - frame) ** 2).sum(axis=1).mean()))
    return {
        "unknowns": 3 * len(beam.rest),
        "ms": float(np.median(clock)),
        "iterations": float(beam.substeps),
        "status": 0,
        "same": None,
        "exact": float(np.mean(errors)) / scene.edge**2,
        "steps": steps,
        "particles": len(beam.rest),
    }


def thing_motion(thing: Any, grip: Grip, spacing: float, steps: int) -> Array:
    """Return displacements of an object's quadrature points, which are its particles [m], (steps, P, 3)."""
    points, weights = thing.quadrature.points, thing.quadrature.weights
    order = np.lexsort(points.T)
    index = order[np.searchsorted(_keys(points[order]), _keys(grip.points))]
    springs = Springs(
        index=index,
        stiffness=grip.stiffness,
        targets=lambda at: grip.targets(at / DT, steps),  # type: ignore[arg-type]
    )
    material = thing.youngs_modulus, POISSONS_RATIO, DENSITY
    body = ExplicitParticles(points, weights, spacing, material, grip.gravity * thing.down, springs, DT, 0.5)
    return np.array([body.step() for _ in range(steps)])


def _keys(points: Array) -> NDArray[Any]:
    """Return points as values that sort by their last coordinate first."""
    return np.ascontiguousarray(points[:, ::-1]).view([("", np.float64)] * 3).ravel()
