"""Local handles: skinning weights that are one on a part of the material and vanish beyond its neighbours.

W_i = sum_k s_ki Phi_k over the reproducing kernels, with sum_i s_ki = 1, so that the weights sum to one. s is a bump
(1 - d^2 / R_i^2)^3 of the length d of the shortest path from a kernel's centre to that of the handle, over kernels that
act on each other's centres: such a path does not cross gaps, and a handle does not leak from a leaf to the next one.
R_i is 1.6 times the path to the fourth nearest handle, and is enlarged until every kernel is covered: PIE-NeRF's rule,
which kernels of Q-GMLS follow in straight lines.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.body.rkpm import BasisRKPM, sample_farthest
from softmode.deformables.quadrature.quadrature_cuboids import LLOYD_ROUNDS, nearest_cells
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

WIDTH = 1.6
"""Radius over the distance to the fourth nearest other centre: spheres, bars, plates 40:1 and rods 50:1 of 8 to 60
centres are covered by two at least; with 1.3 parts are covered by one."""
NEIGHBOUR = 4
COVERED = 0.05
"""The least that the largest bump may be at a point."""
ENLARGEMENTS, ENLARGED = 10, 1.1
"""How often radii are enlarged where points are not covered, and by how much."""


def gather_weights(kernels: BasisRKPM, count: int, added: Array) -> Array:
    """Return the coefficients s of local handles in the kernels, shape (K, J); every row sums to one.

    Args:
        kernels: Reproducing kernels.
        count: Number of handles, placed by farthest points along the paths, then moved to the middle of their parts.
        added: Places and radii of further handles [m], shape (A, 4).

    Raises:
        ConfigError: If there are fewer kernels than handles, or an added one lies outside or is too narrow.
        BasisError: If kernels stay uncovered, as where the object has more parts than handles.
    """
    centres = kernels.centres
    _require_fewer(count, len(centres), "kernels")
    home = np.asarray(KDTree(centres).query(added[:, :3])[1])
    away = kernels.nearest(added[:, :3])[0] if len(added) else np.zeros(0)
    if (away > kernels.support[home]).any():
        raise ConfigError(
            f"add_kernels: the place of number {away.argmax()} lies {away.max():.3g} m away from the object's kernels",
            hint="give places of the object, in its own coordinates",
        )
    lengths = _path_lengths(kernels)
    seeds = _farthest(count, lengths, np.arange(len(centres)))
    away = lengths(seeds)
    for _ in range(LLOYD_ROUNDS):
        owner = away.argmin(axis=0)
        middle = np.stack([centres[owner == i].mean(axis=0) for i in range(count)])
        gap = np.where(owner == np.arange(count)[:, None], _distances(middle, centres), np.inf)
        seeds = gap.argmin(axis=1)
        away = lengths(seeds)
    bump = _bump(away, covering_radii(away[:, seeds], away))
    if len(added):
        path = lengths(home)
        for radius, row in zip(added[:, 3], path, strict=True):
            next_one = np.partition(row, 1)[1]
            if not radius > next_one:
                raise ConfigError(
                    f"add_kernels: a radius of {radius:g} m holds one kernel, the next is {next_one:.3g} m away",
                    hint="give a larger radius, or more kernels (kernel_count)",
                )
        bump = np.concatenate([bump, _bump(path, added[:, 3])])
    return (bump / bump.sum(axis=0)).T


def gather_at_lips(kernels: BasisRKPM, lips: Array, count: int) -> Array:
    """Return the coefficients of handles along the lips of slits in the kernels, shape (K, J), J = count at most.

    The paths around the tip of a slit are long, so a handle acts on its own lip. Nothing sums to one.

    Args:
        kernels: Reproducing kernels that do not act across the slits.
        lips: Points on both sides of the severed links [m], shape (N, 3).
        count: Number of handles.
    """
    beside = np.unique(KDTree(kernels.centres).query(lips)[1])
    lengths = _path_lengths(kernels)
    seeds = _farthest(min(count, len(beside)), lengths, beside)
    away = lengths(seeds)
    return _bump(away, _spread(away[:, seeds], away)).T


def _path_lengths(kernels: BasisRKPM) -> Callable[[Any], Array]:
    """Return what gives the lengths of paths [m] from some kernels (J,) to all, (J, K)."""
    centres = kernels.centres
    acting = kernels.evaluate(centres).value.tocoo()
    apart = np.linalg.norm(centres[acting.row] - centres[acting.col], axis=1)
    graph = coo_matrix((apart, (acting.row, acting.col)), shape=acting.shape).tocsr()
    return lambda at: np.asarray(dijkstra(graph, directed=False, indices=at))


def place_kernels(points: Array, volumes: Array, count: int, added: Array, *, seed: int) -> BasisQGMLS:
    """Return kernels of Q-GMLS: farthest points, moved to the centroids of their cells, with radii that cover.

    Args:
        points: What must be covered: quadrature points [m], shape (P, 3).
        volumes: Their volumes [m^3], shape (P,).
        count: Number of kernels.
        added: Places and radii of further kernels [m], shape (A, 4).
        seed: Seed of the first centre.

    Raises:
        ConfigError: If there are fewer points than kernels.
        BasisError: If points stay uncovered.
    """
    _require_fewer(count, len(points), "points")
    centres = points[sample_farthest(points, count, seed=seed)]
    for _ in range(LLOYD_ROUNDS):
        centres = nearest_cells(points, volumes, centres)[2]
    radii = covering_radii(_distances(centres, centres), _distances(centres, points))
    return BasisQGMLS(centres=np.concatenate([centres, added[:, :3]]), radii=np.concatenate([radii, added[:, 3]]))


def covering_radii(between: Array, away: Array) -> Array:
    """Return radii of bumps that cover all points with `COVERED` at least.

    Args:
        between: Distances between the centres [m], shape (n, n).
        away: Distances of the points from the centres [m], shape (n, P); infinite where no path leads.

    Raises:
        BasisError: If points stay uncovered after ten enlargements.
    """
    radii = _spread(between, away)
    for left in range(ENLARGEMENTS, -1, -1):
        bare = _bump(away, radii).max(axis=0) < COVERED
        if not bare.any():
            break
        if not left:
            raise BasisError(
                f"local_count: {int(bare.sum())} of {len(bare)} places are covered by none of {len(radii)} handles"
                f" after {ENLARGEMENTS} enlargements",
                hint="give more, or build one body for each part of the object",
            )
        radii[np.unique((away[:, bare] / radii[:, None]).argmin(axis=0))] *= ENLARGED
    return radii


def _spread(between: Array, away: Array) -> Array:
    """Return radii by the distance to the fourth nearest other centre; arguments as of `covering_radii`."""
    apart = np.sort(between, axis=1)[:, : NEIGHBOUR + 1]
    # Of a part that has fewer handles, the farthest of these.
    radii = WIDTH * np.where(np.isfinite(apart), apart, 0.0).max(axis=1)
    return np.where(radii > 0.0, radii, np.where(np.isfinite(away), away, 0.0).max(axis=1))


def _distances(a: Array, b: Array) -> Array:
    return np.linalg.norm(a[:, None] - b, axis=2)


def _bump(away: Array, radii: Array) -> Array:
    return np.maximum(1.0 - (away / radii[:, None]) ** 2, 0.0) ** 3


def _farthest(count: int, lengths: Callable[[Any], Array], among: Indices) -> Indices:
    """Return which of some places of a graph are farthest from each other along its paths, the first from the first."""
    nearest, seeds = lengths(among[:1])[0][among], np.zeros(count, dtype=np.intp)
    for i in range(count):
        seeds[i] = among[nearest.argmax()]
        nearest = np.minimum(nearest if i else np.inf, lengths(seeds[i : i + 1])[0][among])
    return seeds


def _require_fewer(count: int, most: int, what: str) -> None:
    if count > most:
        raise ConfigError(f"local_count: {count} asked for, the object has {most} {what}", hint="ask for fewer")
