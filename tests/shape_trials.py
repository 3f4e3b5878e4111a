"""What every shape has to pass: the build against exact moments, and a pull against finite elements.

The pull needs a domain that both methods share exactly, so the shape's voxel relative is taken: the cells of a coarse
grid that it fills enough. Finite elements use these cells as quadratic hexahedra; the reduced body is built from
quadrature points inside them. Its lowest layers are held exactly in both, and both answer to the same two loads, small
enough to be linear: gravity in an oblique direction, and forces on the surface samples of the opposite end.

Builds one body for every shape: the build has to stand all of them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse import linalg as sparse_linalg

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.oracle.fem import Mesh, Solid
from tests.scenes import Scene
from tests.shapes import Shape

Array = NDArray[np.float64]

MATERIAL = Material(youngs_modulus=1.0e5, poissons_ratio=0.4, density=1000.0, viscosity=0.0)
"""Of every trial."""
OBLIQUE = np.array([0.48, 0.6, 0.64])
"""Direction of the loads: no axis of symmetry."""
SMALL, LARGE = 2.0e-3, 0.3
"""Root mean square displacements [m], of bodies of one metre, by linear theory: where the comparison is made, and where
the step must still converge."""
LONG_STEP, SHORT_STEP = 1.0e3, 0.3
"""Steps to a small and to a large deflection, over sqrt(displacement / acceleration), the time of a free fall: the
first are static solves, the second follow the fall, and implicit Euler's damping brings it to rest."""
FEW_ELEMENTS = 64
"""Up to so many, elements are split: corners of the held face make coarse finite elements some percent too stiff."""
SOFTEST = 1.03
"""Largest work over that of finite elements, for what remains of that and for the cubature, which errs both ways."""
REST = 1.0e-3
"""At rest a step moves less than this fraction of the deflection."""


@dataclass(frozen=True, kw_only=True)
class BuildTrial:
    """What a build gave; errors are relative to exact moments."""

    name: str
    """Shape."""
    point_count: int
    """Quadrature points."""
    function_count: int
    """Scalar functions."""
    volume: float
    """Error of the volume."""
    centre: float
    """Error of the centre of mass over the longest edge."""
    inertia: float
    """Error of the central second moments."""
    gram: float
    """Largest entry of M / mass - 1 over the full quadrature."""
    eigenvalue: float
    """Least eigenvalue of the skinning modes [1/m^2]."""
    force: float
    """Cubature's force error on held-out poses."""
    seconds: float
    """Time of quadrature and build [s]."""
    finite: bool
    """Whether all arrays are finite."""

    def problems(self, shape: Shape) -> list[str]:
        """Return which bounds are broken.

        Points of a mesh are moved until its moments match, so only rounding is left. Level sets and parts that overlap
        are integrated by sampling, and so is the figure they are compared with; clouds and splats leave the surface to
        be guessed.
        """
        source = "union" if shape.overlapping else shape.source
        volume, centre, inertia = {
            "mesh": (1e-9, 1e-9, 1e-9),
            "union": (1e-3, 1e-3, 2e-3),
            "implicit": (4e-3, 1e-3, 5e-3),
            "splats": (1e-2, 2e-3, 2e-2),
            "points": (4e-3, 2e-3, 5e-3),
        }[source]
        bounds = {
            "volume": abs(self.volume) < volume,
            "centre": self.centre < centre,
            "inertia": self.inertia < inertia,
            "gram": self.gram < 1e-10,
            "eigenvalue": self.eigenvalue >= 0.0,
            "force": self.force < 3e-2,
            "finite": self.finite,
        }
        return [name for name, good in bounds.items() if not good]


def try_build(shape: Shape, options: BuildOptions, point_count: int = 4000) -> BuildTrial:
    """Build a shape and compare it with its exact moments."""
    quadrature = shape.quadrature(point_count)
    body = build_body(quadrature, options, name=shape.name, progress=False)
    volume, centre, second = shape.moments()
    weight = quadrature.weights
    mean = weight @ quadrature.points / quadrature.volume
    local = quadrature.points - mean
    basis, gradient = body.evaluate(quadrature.points - body.offset)
    gram = basis.T @ (weight[:, None] * basis) / quadrature.volume
    arrays = (
        body.cubature.grad_basis,
        body.surface.basis,
        body.cubature.weights,
        body.surface.areas,
        body.surface.normals,
        gradient,
    )
    return BuildTrial(
        name=shape.name,
        point_count=len(quadrature.points),
        function_count=body.function_count,
        volume=quadrature.volume / volume - 1.0,
        centre=float(np.linalg.norm(mean - centre) / np.ptp(quadrature.bounds, axis=0).max()),
        inertia=float(np.linalg.norm((weight[:, None] * local).T @ local - second) / np.linalg.norm(second)),
        gram=float(np.abs(gram - np.eye(len(gram))).max()),
        eigenvalue=float(body.eigenvalues.min()),
        force=float(body.provenance["cubature_force_error"] or 0.0),
        seconds=body.build_seconds,
        finite=all(np.isfinite(a).all() for a in arrays),
    )


@dataclass(frozen=True, kw_only=True)
class Voxels:
    """Cells of a grid, the domain that both methods share."""

    lines: tuple[Array, Array, Array]
    """Cell borders along each axis [m]."""
    filled: NDArray[np.bool_]
    """Which cells belong to the body."""
    axis: int
    """Axis whose lowest `held` layers are held."""
    held: int = 1
    """Layers held."""

    @property
    def cell(self) -> Array:
        """Edges of a cell [m], (3,)."""
        return np.array([line[1] - line[0] for line in self.lines])

    @property
    def base(self) -> float:
        """Where the held part ends along the axis [m]."""
        return float(self.lines[self.axis][self.held])

    def quadrature(self, point_count: int = 4000) -> Quadrature:
        """Integrate by two Gauss points per axis of equal sub-cells; surface samples at quarters of the outer faces."""
        index = np.argwhere(self.filled)
        volume = float(len(index) * self.cell.prod())
        parts = np.maximum(np.round(0.5 * self.cell / (volume / point_count) ** (1.0 / 3.0)), 1).astype(int)
        corner = np.stack([self.lines[d][index[:, d]] for d in range(3)], axis=1)
        gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
        part = [((np.arange(n)[:, None] + gauss) / n).ravel() for n in parts]
        offset = np.stack(np.meshgrid(*part, indexing="ij"), axis=-1).reshape(-1, 3) * self.cell
        points = (corner[:, None] + offset).reshape(-1, 3)
        surface = [self._faces(axis, side) for axis in range(3) for side in (0, 1)]
        where, normal, area = (np.concatenate(parts) for parts in zip(*surface, strict=True))
        return Quadrature(
            points=points,
            weights=np.full(len(points), volume / len(points)),
            spacing=float((volume / len(points)) ** (1.0 / 3.0)),
            surface_points=where,
            surface_normals=normal,
            surface_areas=area,
            volume=volume,
            bounds=np.array([[line[0] for line in self.lines], [line[-1] for line in self.lines]]),
        )

    def _faces(self, axis: int, side: int) -> tuple[Array, Array, Array]:
        """Return centres, normals and areas of the quarters of the outer faces to one side."""
        padded = np.pad(self.filled, 1)
        outer = np.roll(padded, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
        index = np.argwhere(self.filled & ~outer)
        lower = np.stack([self.lines[d][index[:, d]] for d in range(3)], axis=1)
        steps = [[float(side)] if d == axis else [0.25, 0.75] for d in range(3)]
        offset = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3) * self.cell
        points = (lower[:, None] + offset).reshape(-1, 3)
        normal = np.zeros((len(points), 3))
        normal[:, axis] = 2.0 * side - 1.0
        return points, normal, np.full(len(points), 0.25 * np.delete(self.cell, axis).prod())


def voxelise(shape: Shape, cells: int) -> Voxels:
    """Return the shape's voxel relative: cells along the longest edge, at least two across any other.

    A cell is filled if the shape fills 0.3 of what it does in its fullest cells, so that thin walls stay closed; only
    the largest face-connected part is kept.
    """
    quadrature = _fine_quadrature(shape)
    lower, upper = quadrature.bounds
    count = np.maximum(np.round((upper - lower) / (upper - lower).max() * cells).astype(int), 2)
    lines = tuple(np.linspace(lower[d], upper[d], count[d] + 1) for d in range(3))
    index = np.stack(
        [
            np.clip(np.searchsorted(lines[d], quadrature.points[:, d], side="right") - 1, 0, count[d] - 1)
            for d in range(3)
        ]
    )
    volume = np.zeros(tuple(count))
    np.add.at(volume, tuple(index), quadrature.weights)
    parts, number = _components(volume > 0.3 * np.quantile(volume[volume > 0.0], 0.9))
    size = np.bincount(parts.ravel())[1:]
    filled = parts == 1 + int(size.argmax()) if number > 1 else parts > 0
    kept = [np.flatnonzero(filled.any(axis=tuple(np.delete(range(3), d)))) for d in range(3)]
    trim = tuple(slice(k[0], k[-1] + 1) for k in kept)
    trimmed = tuple(line[k[0] : k[-1] + 2] for line, k in zip(lines, kept, strict=True))
    return Voxels(lines=trimmed, filled=filled[trim], axis=shape.axis)  # type: ignore[arg-type]


@functools.cache
def _fine_quadrature(shape: Shape) -> Quadrature:
    return shape.quadrature(40_000)


def _components(filled: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Number the face-connected parts of a grid from 1; return the labels and their count."""
    found: Any = ndimage.label(filled)
    return found[0], found[1]


@dataclass(frozen=True, kw_only=True)
class Loads:
    """Both loads and the answer of finite elements: work per unit of load squared."""

    surface: NDArray[np.intp]
    """Surface samples that are pulled."""
    gravity: float
    """m g . (mean displacement) per unit of acceleration squared [J s^4/m^2]."""
    pull: float
    """f . u per unit of total force squared [m/N]."""
    unknowns: int
    """Of the finite elements."""


def solve_reference(voxels: Voxels, quadrature: Quadrature, direction: ArrayLike = OBLIQUE) -> Loads:
    """Solve both linear loads, along a unit vector, with quadratic hexahedra: voxels, or their eighths where few."""
    along_load = np.asarray(direction, dtype=np.float64)
    lines, filled = [np.asarray(line) for line in voxels.lines], voxels.filled
    while filled.sum() <= FEW_ELEMENTS:
        lines = [np.interp(np.arange(2 * len(x) - 1) / 2.0, np.arange(len(x)), x) for x in lines]
        filled = filled.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    mesh = Mesh(lines, filled)
    solid = Solid(
        mesh,
        energy="stable_neo_hookean_log",
        youngs_modulus=MATERIAL.youngs_modulus,
        poissons_ratio=MATERIAL.poissons_ratio,
        density=MATERIAL.density,
    )
    along = quadrature.surface_points[:, voxels.axis]
    end = np.flatnonzero(along > along.max() - 0.1 * np.ptp(along))
    matrix = mesh.interpolation(quadrature.surface_points[end])
    force = np.outer(np.asarray(matrix.sum(axis=0)).ravel() / len(end), along_load)
    weight = solid.body_force(along_load)

    free = np.repeat(mesh.nodes[:, voxels.axis] > voxels.base + 1e-9, 3)
    block = solid.tangent(mesh.nodes)
    dof = (3 * mesh.elements[:, :, None] + np.arange(3)).reshape(len(mesh.elements), 81)
    row, column = np.repeat(dof, 81, axis=1).ravel(), np.tile(dof, (1, 81)).ravel()
    K = sparse.csc_matrix((block.ravel(), (row, column)), shape=(solid.size, solid.size))[free][:, free]
    right = np.stack([weight.ravel()[free], force.ravel()[free]], axis=1)
    moved = sparse_linalg.splu(K, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(right)
    work = (moved * right).sum(axis=0)
    return Loads(surface=end, gravity=float(work[0]), pull=float(work[1]), unknowns=int(free.sum()))


@dataclass(frozen=True, kw_only=True)
class PullTrial:
    """How a reduced body answered."""

    name: str
    """Shape."""
    unknowns: int
    """Of a step."""
    gravity: float
    """Work under gravity over that of finite elements."""
    pull: float
    """Work under end forces over that of finite elements."""
    change: float
    """Motion of the last step to a large deflection under gravity, over the deflection; NaN if not finite."""
    status: int
    """Status bits of the solver on the way there."""

    @property
    def at_rest(self) -> bool:
        """Whether the large deflection was found without a warning."""
        return self.change < REST and self.status == 0

    def problems(self) -> list[str]:
        """Return which bounds are broken: a subspace is never softer than finite elements but for its cubature."""
        bounds = {
            "gravity": 0.0 < self.gravity < SOFTEST,
            "pull": 0.0 < self.pull < SOFTEST,
            "rest": self.change < REST,
            "status": self.status == 0,
        }
        return [name for name, good in bounds.items() if not good]


def try_pull(name: str, voxels: Voxels, loads: Loads, body: ReducedBody) -> PullTrial:
    """Load a body built with an exact region named "base" by the solver itself, to rest."""
    mass = MATERIAL.density * body.volume
    # Loads that give the wanted mean displacement by the compliance of finite elements.
    acceleration = SMALL * mass / loads.gravity
    total = SMALL / loads.pull
    time = np.sqrt(SMALL / acceleration)  # The same for every load under which the deflection is linear.

    def rest(gravity: float, force: float, dt: float, steps: int) -> tuple[Any, Array, float]:
        options = SolverReducedOptions(tolerance=1e-7, contact_max=1)
        scene = Scene(
            lambda builder: add_reduced_body(builder, body, material=MATERIAL),
            [body],
            gravity=gravity * OBLIQUE,
            options=options,
            dt=dt,
        )
        start = before = scene.q()
        load = np.zeros((body.surface_count, 3), dtype=np.float32)
        load[loads.surface] = force / len(loads.surface) * OBLIQUE
        change = np.inf
        for _ in range(steps):
            scene.state.particle_f.assign(load)
            scene.step()
            now = scene.q()
            change = float(np.linalg.norm(now - before) / np.linalg.norm(now - start))
            before = now
            if change < REST or not np.isfinite(change):
                break
        return scene, before - start, change

    _, moved, _ = rest(acceleration, 0.0, LONG_STEP * time, 3)
    by_gravity = mass * acceleration * OBLIQUE @ (body.mean_basis @ moved) / acceleration**2
    _, moved, _ = rest(0.0, total, LONG_STEP * time, 3)
    at = np.asarray(body.surface.basis[loads.surface], dtype=float) @ moved
    by_pull = float((at @ OBLIQUE).mean()) / total
    scene, _, change = rest(acceleration * LARGE / SMALL, 0.0, SHORT_STEP * time, 200)
    return PullTrial(
        name=name,
        unknowns=3 * (body.function_count - body.driven_count),
        gravity=float(by_gravity / loads.gravity),
        pull=by_pull / loads.pull,
        change=change,
        status=int(scene.reduced.status.numpy()[0]),
    )


def base_of(voxels: Voxels) -> Region:
    """Return the held part as an exact region."""
    upper = np.full(3, np.inf)
    upper[voxels.axis] = voxels.base
    return Region(name="base", box=np.array([[-np.inf] * 3, upper]))


def drop(body: ReducedBody, steps: int = 20, dt: float = 0.01) -> float:
    """Let a body fall freely; return its error against implicit Euler's own parabola, over the distance."""
    scene = Scene(
        lambda builder: add_reduced_body(builder, body, material=MATERIAL), [body], gravity=(0.0, 0.0, -9.81), dt=dt
    )
    start = scene.q()
    scene.step(steps)
    fall = -0.5 * 9.81 * dt * dt * steps * (steps + 1) * body.linear_coordinates[:, 3:] * np.array([[0.0, 0.0, 1.0]])
    return float(np.linalg.norm(scene.q() - start - fall) / np.linalg.norm(fall))
