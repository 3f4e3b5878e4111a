"""Integrator points: the cells of a coarse partition, each as eight points that have its volume and second moments.

The cubature of PIE-NeRF (Feng et al. 2024, section 4.3), for comparison with `cubature`, which chooses points by the
forces that they must give.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.quadrature.quadrature_grid import Quadrature

Array = NDArray[np.float64]

LLOYD_ROUNDS = 5
"""Times that the centres move to the middle of their cells."""


def with_integrator_points(quadrature: Quadrature, count: int, *, seed: int = 0) -> Quadrature:
    """Return a quadrature of eight points for each of `count` cells; build its body with ``cubature_count=None``.

    Cells are the points nearest to each of the farthest points, after five rounds of Lloyd's algorithm: a partition,
    where the paper sums over several neighbours and counts points more than once. With the centroid and the centred
    second moments C = sum V (x - c)(x - c)^T / sum V, C e_a = l_a e_a, the points are c +- sqrt(l_1) e_1 +- sqrt(l_2)
    e_2 +- sqrt(l_3) e_3: of a cuboid, Gauss's rule of two points per axis. One point per cell, equation 11, loses
    rank: 8 kernels of 10 functions with 64 cells have a mass of rank 64 of 80.

    Args:
        quadrature: Fine points.
        count: Number of cells.
        seed: Seed of the first centre.

    Raises:
        ConfigError: If there are more cells than points, or none.
    """
    require_number("count", count, at_least=1, at_most=len(quadrature.points))
    x, v = quadrature.points, quadrature.weights
    centre = x[sample_farthest(x, count, seed=seed)]
    for _ in range(LLOYD_ROUNDS):
        centre = nearest_cells(x, v, centre)[2]
    cell, volume, centre = nearest_cells(x, v, centre)
    away = x - centre[cell]
    second = np.zeros((len(volume), 3, 3))
    np.add.at(second, cell, v[:, None, None] * away[:, :, None] * away[:, None])
    spread, axes = np.linalg.eigh(second / volume[:, None, None])
    corner: Array = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = centre[:, None] + np.einsum("cij,cj,kj->cki", axes, np.sqrt(np.maximum(spread, 0.0)), corner)
    return replace(
        quadrature,
        points=points.reshape(-1, 3),
        weights=np.repeat(volume / 8.0, 8),
        report={**quadrature.report, "integrator_points": len(volume)},
        cells=None,
    )


def nearest_cells(points: Array, weights: Array, centre: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the cell of each point, and the cells' volumes and centroids; cells without points are dropped."""
    nearest: Any = KDTree(centre).query(points)[1]
    cell: NDArray[np.intp] = np.unique(nearest, return_inverse=True)[1]
    volume: Any = np.bincount(cell, weights)
    return cell, volume, np.stack([np.bincount(cell, weights * x) for x in points.T], axis=1) / volume[:, None]
