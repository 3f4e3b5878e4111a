"""The experiment that every baseline runs: FreeForm's bending beam, and how its error and time are measured.

The scene and its finite-element frames are those of `tests.oracle`. Error is the paper's: the mean of |x - x_fem|^2
over points of a uniform grid and over frames, divided by the square of the beam's length. Two references: the scene as
the papers step it, implicit Euler at h = 0.01 s, whose damping a method with the same integrator shares; and the motion
itself, the same elements stepped by BDF2, whose error in time is some 3e-7. A method with a better integrator than
implicit Euler is far from the first and near the second. Time is the median processor time of a step in one thread,
which on an idle machine is its wall time.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from softmode.deformables.reduction.cache import cache_directory
from softmode.files import whole_file
from tests.oracle import frames
from tests.oracle.fem import Mesh, simulate
from tests.oracle.scenes import BEND, SCENES, Scene

Array = NDArray[np.float64]

STIFFNESS = 1.0e9
"""Springs per volume of a soft clamp [N/m^4]."""
SOFT = BEND.with_clamp(STIFFNESS).name
"""Scene whose clamp is soft, in the reference too."""
SCENE: Scene = BEND
"""5 x 1 x 1 m, E = 5 MPa, nu = 0.45, 1000 kg/m^3, 0.5 m clamped, gravity, h = 0.01 s x 300."""
CLAMP = -2.0
"""Where the clamp ends [m]. It does not move, so a method with a mesh needs only the 4.5 m beyond."""
FREE = np.array([[CLAMP, -0.5, -0.5], [2.5, 0.5, 0.5]])
"""Corners of that part [m]."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table."""

    method: str
    """Family."""
    variant: str
    """Resolution and settings."""
    unknowns: int
    """Scalar unknowns per step."""
    nmse: float
    """Mean square error / length^2 against implicit Euler; NaN when the run did not stay finite."""
    nmse_motion: float
    """The same against the reference converged in time."""
    ms: float
    """Median processor time of a step [ms]."""
    amplitude: float
    """Largest sag of the tip over that of the reference converged in time."""
    clamp: str
    """"exact" or "soft", in the method and in the reference."""
    note: str = ""
    """What a reader must know."""


def sample() -> tuple[Array, Array]:
    """Return the points at which positions are compared [m] (P, 3) and their volumes [m^3] (P,)."""
    return SCENE.shape.sample(0.1)


def reference(scene: str, points: Array, steps: int, *, motion: bool = False) -> Array:
    """Return the finite-element displacements [m] of rest points (P, 3) at steps 1..steps, (steps, P, 3).

    Args:
        scene: Key of `SCENES`.
        points: Rest points [m].
        steps: Number of steps.
        motion: The reference converged in time instead of implicit Euler.
    """
    if not motion:
        return frames.load(scene).displacement(points, slice(1, steps + 1))
    matrix = Mesh.of(SCENES[scene]).interpolation(points)
    return np.stack([matrix @ frame for frame in _motion(scene)[1 : steps + 1]])


@functools.cache
def _motion(name: str) -> Array:
    """Step the scene's elements by BDF2 (a few minutes), or load what an earlier call left in the cache folder."""
    scene, path = SCENES[name], cache_directory() / "oracle" / f"{name}_bdf2.npz"
    nodes = Mesh.of(scene).nodes
    if path.exists():
        with np.load(path) as file:
            if np.array_equal(file["nodes"], nodes):
                return file["displacement"].astype(np.float64)
    with threadpool_limits(limits=1, user_api="blas"):
        displacement = simulate(scene, bdf2=True)[1]
    with whole_file(path) as file:
        np.savez(file, nodes=nodes, displacement=displacement.astype(np.float32))
    return displacement


def normalised_error(displacement: Array, expected: Array, weights: Array) -> float:
    """Return the mean square of the difference of two motions (T, P, 3) [m] over the length squared."""
    if not np.isfinite(displacement).all():
        return float("nan")
    square = ((displacement - expected[: len(displacement)]) ** 2).sum(axis=2) @ (weights / weights.sum())
    return float(square.mean()) / SCENE.edge**2


def measure(
    method: str,
    variant: str,
    unknowns: int,
    steps: int,
    step: Callable[[], Any],
    displacement: Callable[[], Array],
    *,
    points: Array | None = None,
    weights: Array | None = None,
    scene: str = SCENE.name,
    note: str = "",
) -> Row:
    """Run a method and compare it.

    Args:
        method: Family.
        variant: Resolution and settings.
        unknowns: Scalar unknowns.
        steps: Number of steps.
        step: Advances the method by the scene's step and returns when that is done.
        displacement: Gives the displacements [m] of the comparison points, (P, 3).
        points: Comparison points [m] (P, 3) when they are not `sample()`, with their `weights`.
        weights: Volumes of the points [m^3], (P,).
        scene: Scene of the reference.
        note: Remark.
    """
    if points is None or weights is None:
        points, weights = sample()
    recorded, clock = [], []
    for _ in range(steps):
        start = time.process_time()
        step()
        clock.append(time.process_time() - start)
        recorded.append(displacement())
        if not np.isfinite(recorded[-1]).all():
            break
    moved = np.array(recorded)
    tip = points[:, 0] > points[:, 0].max() - 1e-6
    motion = reference(scene, points, steps, motion=True)
    deepest = motion[:, tip, 2].mean(axis=1).min()
    return Row(
        method=method,
        variant=variant,
        unknowns=unknowns,
        nmse=normalised_error(moved, reference(scene, points, steps), weights),
        nmse_motion=normalised_error(moved, motion, weights),
        ms=1e3 * float(np.median(clock)),
        amplitude=float(moved[:, tip, 2].mean(axis=1).min() / deepest),
        clamp="exact" if scene == SCENE.name else "soft",
        note=note,
    )


def hexahedral_interpolation(lines: list[Array], degree: int, points: Array) -> sparse.csr_matrix:
    """Return the Lagrange interpolation (P, N) from the nodes of a box of cells; points outside take no node.

    Args:
        lines: Cell borders along each axis [m].
        degree: 1 (trilinear) or 2 (triquadratic), N nodes numbered with the last axis fastest.
        points: Points (P, 3) [m].
    """
    node, value, inside = [], [], np.ones(len(points), dtype=bool)
    for axis, line in enumerate(lines):
        inside &= (points[:, axis] >= line[0] - 1e-9) & (points[:, axis] <= line[-1] + 1e-9)
        cell = np.clip(np.searchsorted(line, points[:, axis], side="right") - 1, 0, len(line) - 2)
        t = (points[:, axis] - line[cell]) / (line[cell + 1] - line[cell])
        shape = [1.0 - t, t] if degree == 1 else [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]
        node.append(degree * cell[:, None] + np.arange(degree + 1))
        value.append(np.stack(shape, axis=1))
    counts = [degree * (len(line) - 1) + 1 for line in lines]
    i, j, k = node[0][:, :, None, None], node[1][:, None, :, None], node[2][:, None, None, :]
    column = (i * counts[1] + j) * counts[2] + k
    weight = np.einsum("pi,pj,pk->pijk", *value) * inside[:, None, None, None]
    row = np.broadcast_to(np.arange(len(points))[:, None, None, None], column.shape)
    return sparse.csr_matrix((weight.ravel(), (row.ravel(), column.ravel())), shape=(len(points), int(np.prod(counts))))


def lines_of(cells: tuple[int, int, int]) -> list[Array]:
    """Return the cell borders that divide the free part of the beam into cells."""
    return [np.linspace(FREE[0, d], FREE[1, d], cells[d] + 1) for d in range(3)]


def as_record(row: Row) -> dict[str, Any]:
    """Return a row as plain values."""
    return dataclasses.asdict(row)
