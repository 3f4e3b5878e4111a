"""Run one scene of the oracle with softmode and measure how far it is from the stored finite-element frames.

The metric is FreeForm's: mean over points and frames of |x - x_FEM|^2, over the square of the largest edge of the
bounding box (`nmse`) or of its diagonal (`nmse_diagonal`). The points are the body's full quadrature points, weighted
by their mass. In that inner product the error splits exactly (Pythagoras): the part of the FEM frames that no
coordinates can represent (`basis`), and the distance between the coordinates found and the projected ones (`solver`).
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time
from dataclasses import dataclass
from typing import Any, Literal

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.errors import ConfigError
from tests.oracle import frames
from tests.oracle.scenes import SCENES, Clamp, Scene, rotation

Array = NDArray[np.float64]

MODELS = {
    "stable_neo_hookean": MaterialModel.STABLE_NEO_HOOKEAN,
    "stable_neo_hookean_log": MaterialModel.STABLE_NEO_HOOKEAN_LOG,
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One way to simulate a scene."""

    label: str
    """Name in the tables."""
    scene: str
    """Scene whose frames are the reference, a key of `SCENES`."""
    options: BuildOptions
    """How the body is reduced."""
    stiffness: float | None = 1.0e9
    """Springs per volume of the model's clamps [N/m^4]; None holds them exactly. The reference keeps its own clamp."""
    regions: Literal["none", "soft", "exact"] = "none"
    """Whether the build knows the clamps, as springs or as exact regions."""
    point_count: int = 5000
    """Quadrature points of the build."""
    pin_counts: tuple[int, int, int] = (3, 5, 5)
    """Gauss points per axis of a soft clamp."""
    solver: SolverReducedOptions = dataclasses.field(
        default_factory=lambda: SolverReducedOptions(contact_max=1, keep_spin=False)
    )
    """How a step is solved."""
    steps: int | None = None
    """Number of steps; the scene's own when None."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a row gave."""

    label: str
    """The row's label."""
    scene: str
    """The reference."""
    mode_count: int
    """Skinning eigenmodes m."""
    unknowns: int
    """Unknowns of a step."""
    cubature_count: int
    """Points at which stress is evaluated."""
    stiffness: float | None
    """The model's clamp [N/m^4]; None when exact."""
    nmse: float
    """Error by the largest edge."""
    nmse_diagonal: float
    """Error by the diagonal."""
    basis: float
    """Part that no coordinates of this basis remove, by the largest edge."""
    solver: float
    """The rest, by the largest edge."""
    last: float
    """Error of the last frame alone, by the largest edge."""
    milliseconds: float
    """Median processor time of a captured step."""
    iterations: float
    """Mean Newton iterations per step."""
    status: int
    """Status bits raised by the solver, 0 for none."""
    build_seconds: float
    """Wall time of the build."""


@functools.lru_cache(maxsize=8)
def quadrature_of(shape: Any, point_count: int) -> Quadrature:
    """Integrate a shape of the oracle by softmode's own means."""
    return quadrature_from_mesh(*shape.surface(), point_count=point_count)


@functools.lru_cache(maxsize=4)
def reference_at(name: str, point_count: int) -> Array:
    """Return the FEM displacements at the quadrature points, (steps + 1, P, 3) [m]."""
    stored = frames.load(name)
    return stored.displacement(quadrature_of(stored.scene.shape, point_count).points)


def region_of(index: int, clamp: Clamp, scene: Scene, stiffness: float | None) -> Region:
    """Return a clamp as a region of the build."""
    box = np.array([clamp.region.lower, clamp.region.upper], float)
    relative = None if stiffness is None else stiffness / scene.youngs_modulus
    return Region(name=f"clamp {index}", box=box, stiffness=relative)


@functools.lru_cache(maxsize=8)
def body_of(
    scene: Scene, options: BuildOptions, point_count: int, regions: str, stiffness: float | None
) -> tuple[ReducedBody, float]:
    """Build the body of a scene; return it and the seconds that took."""
    quadrature = quadrature_of(scene.shape, point_count)
    known: list[Region] = []
    if regions != "none":
        soft = stiffness if regions == "soft" else None
        known = [region_of(i, clamp, scene, soft) for i, clamp in enumerate(scene.clamps)]
    body = build_body(
        quadrature,
        options,
        regions=known,
        stiffness_scale=scene.stiffness_scale(quadrature.points),
        progress=False,
    )
    return body, body.build_seconds


class Simulation:
    """A scene in softmode: one body, its clamps, two captured half-steps there and back between two states."""

    def __init__(self, scene: Scene, body: ReducedBody, row: Row) -> None:
        """Build the model and capture the step."""
        self.scene, self.body = scene, body
        builder = newton.ModelBuilder()
        register_custom_attributes(builder)
        material = Material(
            model=MODELS[scene.energy],
            youngs_modulus=scene.youngs_modulus,
            poissons_ratio=scene.poissons_ratio,
            density=scene.density,
            viscosity=0.0,
            mass_damping=0.0,
        )
        instance = add_reduced_body(builder, body, material=material, position=body.offset.tolist())
        self.targets: list[tuple[Array, Clamp]] = []
        for clamp in scene.clamps:
            points, weights = scene.shape.gauss(clamp.region, row.pin_counts)
            if row.stiffness is not None:
                add_pins(builder, instance, points - body.offset, stiffness=row.stiffness * weights, targets=points)
            self.targets.append((points, clamp))
        self.driven = body.driven_count
        if row.stiffness is None and scene.clamps and not self.driven:
            raise ConfigError("an exact clamp needs regions='exact'")
        model: Any = builder.finalize(device="cpu")
        model.set_gravity(tuple(scene.gravity))
        self.model = model
        self.solver = SolverReduced(model, [body], options=row.solver)
        self.control: Any = model.control()
        self.states: list[Any] = [model.state(), model.state()]
        self.graphs = []
        for one, other in ((0, 1), (1, 0)):
            with wp.ScopedCapture(device="cpu") as capture:
                self.solver.step(self.states[one], self.states[other], self.control, None, scene.dt)
            self.graphs.append(capture.graph)
        A, spin = np.diag(scene.stretch), np.cross(np.eye(3), scene.spin)
        translation = A @ body.offset
        self.q = body.affine(A, translation)
        speed = np.vstack([(spin @ A).T, spin @ translation])
        self.solver.reset(self.states[0])
        self.states[0].softmode.q.assign(self.q)
        self.states[0].softmode.qd.assign(body.linear_coordinates @ speed)
        self.solver.status.zero_()
        self.moving = any(c.motion.rate or any(c.motion.velocity) for _, c in self.targets)

    def run(self, steps: int) -> tuple[Array, list[float], list[int]]:
        """Take steps; return coordinates (steps + 1, n, 3) [m], processor times [ms] and Newton iterations."""
        q, times, iterations = [self.q], [], []
        for n in range(1, steps + 1):
            if self.moving or n == 1:
                self._move(n * self.scene.dt)
            start = time.process_time()
            wp.capture_launch(self.graphs[(n - 1) % 2])
            times.append(1e3 * (time.process_time() - start))
            q.append(self.states[n % 2].softmode.q.numpy().copy())
            iterations.append(int(self.solver.iteration.numpy()[0]))
        return np.array(q), times, iterations

    def _move(self, time: float) -> None:
        """Tell the solver where the clamps are at the end of a step [s]."""
        if self.driven:
            motions = [clamp.motion for _, clamp in self.targets]
            turns = [rotation(motion.axis, motion.rate * time) for motion in motions]
            shifts = [
                turn @ self.body.offset + time * np.asarray(motion.velocity)
                for turn, motion in zip(turns, motions, strict=True)
            ]
            target = self.q.copy()
            target[: self.driven] = self.body.regions.driven_affine(turns, shifts)
            self.control.softmode.q_driven.assign(target)
        elif self.targets:
            positions = [clamp.motion.position(points, time) for points, clamp in self.targets]
            self.control.softmode.pin_target.assign(np.concatenate(positions))


def compare(
    q: Array, body: ReducedBody, quadrature: Quadrature, reference: Array, scene: Scene
) -> tuple[float, float, float]:
    """Return total error, basis error and error of the last frame [m^2], means over mass (and frames).

    Args:
        q: Coordinates (T, n, 3) [m].
        body: The body.
        quadrature: Its full quadrature.
        reference: FEM displacements at the quadrature points, (T or more, P, 3) [m].
        scene: The scene.
    """
    weight = np.sqrt(quadrature.weights / quadrature.volume)[:, None]
    basis = body.evaluate(quadrature.points - body.offset)[0]
    identity = body.affine(np.eye(3), body.offset)  # the coordinates of the rest pose in the scene's frame
    factor = np.linalg.qr(weight * basis)[0]
    error, best, last = [], [], 0.0
    for found, expected in zip(q, reference, strict=False):
        last = float(((weight * (basis @ (found - identity) - expected)) ** 2).sum())
        error.append(last)
        goal = weight * expected
        best.append(float(((goal - factor @ (factor.T @ goal)) ** 2).sum()))
    return float(np.mean(error)), float(np.mean(best)), last


def run_all(row: Row, references: list[str]) -> list[Result]:
    """Simulate a row once and compare it with several references of one geometry and motion.

    Args:
        row: What to simulate.
        references: Keys of `SCENES`, which differ from `row.scene` in their clamps only.
    """
    scene = SCENES[row.scene]
    body, seconds = body_of(scene, row.options, row.point_count, row.regions, row.stiffness)
    simulation = Simulation(scene, body, row)
    q, times, iterations = simulation.run(row.steps or scene.steps)
    quadrature = quadrature_of(scene.shape, row.point_count)
    results = []
    for name in references:
        total, basis, last = compare(q, body, quadrature, reference_at(name, row.point_count), scene)
        edge, diagonal = scene.edge**2, scene.diagonal**2
        results.append(
            Result(
                label=row.label,
                scene=name,
                mode_count=row.options.mode_count or 0,
                unknowns=3 * body.function_count,
                cubature_count=body.point_count,
                stiffness=row.stiffness,
                nmse=total / edge,
                nmse_diagonal=total / diagonal,
                basis=basis / edge,
                solver=(total - basis) / edge,
                last=last / edge,
                milliseconds=statistics.median(times),
                iterations=float(np.mean(iterations)),
                status=int(simulation.solver.status.numpy()[0]),
                build_seconds=seconds,
            )
        )
    return results


def run(row: Row) -> Result:
    """Simulate a row and compare it with the frames of its own scene."""
    return run_all(row, [row.scene])[0]
