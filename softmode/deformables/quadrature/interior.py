"""Points that fill a body: those it was built from or, where only its file is left, what its surface samples enclose.

A closed surface sampled by points y_i with outward normals n_i and areas a_i winds around a point X
w(X) = sum_i a_i n_i . (y_i - X) / (4 pi |y_i - X|^3) times: once inside, not at all outside (Barill et al. 2018, "Fast
Winding Numbers for Soups and Clouds", eq. 3). The body's own functions take no part in it, so what is integrated over
these points is an independent check of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from softmode.errors import BasisError

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.quadrature.quadrature_grid import Quadrature

Array = NDArray[np.float64]

LINK = 1.8
"""Cells are one part when their centroids are closer than this many edges: a little more than a cell's diagonal."""
FLAT_LINK = 1.3
"""Or closer than this many times the distance to the sixth neighbour."""
_PAIRS_PER_CHUNK = 2_000_000


@dataclass(frozen=True, kw_only=True)
class Interior:
    """Points that integrate over a body, in the body frame."""

    points: Array
    """Positions [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], > 0, shape (P,)."""
    spacing: float
    """Edge of the grid's cells, geometric mean of the three [m]."""
    exact: bool
    """Whether they are those that the body was built from."""

    def parts(self) -> NDArray[np.int64]:
        """Return which connected part each point belongs to, the largest by volume is 0, shape (P,)."""
        tree, count = KDTree(self.points), len(self.points)
        # In a sheet of few layers the cells are flat, and the sixth neighbour is a step within the layer away.
        sixth = float(np.median(tree.query(self.points, k=min(7, count))[0][:, -1]))
        pairs = tree.query_pairs(max(LINK * self.spacing, FLAT_LINK * sixth), output_type="ndarray")
        graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(count, count))
        label = connected_components(graph, directed=False)[1]
        order = np.argsort(-np.bincount(label, self.weights), kind="stable")
        return np.argsort(order)[label].astype(np.int64)


def interior_from_quadrature(body: ReducedBody, quadrature: Quadrature) -> Interior:
    """Return the points that a body was built from.

    Raises:
        BasisError: If the quadrature is not that of the body: volumes or bounding boxes differ.
    """
    bounds = quadrature.bounds - body.offset
    size = float(np.ptp(body.bounds, axis=0).max())
    if abs(quadrature.volume / body.volume - 1.0) > 1e-9 or np.abs(bounds - body.bounds).max() > 1e-9 * size:
        raise BasisError(
            f"quadrature: {quadrature.volume:.4g} m^3, but the body {body.name!r} has {body.volume:.4g} m^3",
            hint="Pass the quadrature that the body was built from.",
        )
    points = quadrature.points - body.offset
    return Interior(points=points, weights=quadrature.weights, spacing=quadrature.spacing, exact=True)


def interior_from_surface(body: ReducedBody, *, point_count: int = 4000) -> Interior:
    """Fill what a body's surface samples enclose with a uniform grid.

    Args:
        body: The body.
        point_count: About so many points.

    Returns:
        The points; their volumes sum to the body's.

    Raises:
        BasisError: If the samples enclose nothing.
    """
    low, high = body.bounds
    extent = np.maximum(high - low, 1e-9 * np.ptp(body.bounds))
    pitch = (body.volume / point_count) ** (1.0 / 3.0)
    shape = np.maximum(np.round(extent / pitch), 2).astype(int)
    edges = extent / shape
    axes = [low[d] + (np.arange(shape[d]) + 0.5) * edges[d] for d in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    around = winding_numbers(grid, body.surface.points, body.surface.normals, body.surface.areas)
    inside = grid[around > 0.5]
    if len(inside) < 4:
        raise BasisError(
            f"body {body.name!r}: its surface samples enclose nothing", hint="Build the body again, with more samples."
        )
    weights = np.full(len(inside), body.volume / len(inside))
    return Interior(points=inside, weights=weights, spacing=float(edges.prod() ** (1.0 / 3.0)), exact=False)


def winding_numbers(points: Array, samples: Array, normals: Array, areas: Array) -> Array:
    """Return how often samples of a surface wind around points (N, 3) [m], shape (N,).

    Within the radius of a sample's own disc the distance is held at that radius, so that no sample outweighs the rest.

    Args:
        points: Where to count [m], shape (N, 3).
        samples: Samples of the surface [m], shape (S, 3).
        normals: Their outward unit normals, shape (S, 3).
        areas: Their areas [m^2], shape (S,).
    """
    found = np.empty(len(points))
    strength = normals * areas[:, None]
    near = areas / np.pi
    step = max(1, _PAIRS_PER_CHUNK // max(len(samples), 1))
    for i in range(0, len(points), step):
        away = samples[None] - points[i : i + step, None]
        distance_sq = np.maximum(np.einsum("nsi,nsi->ns", away, away), near)
        found[i : i + step] = (np.einsum("nsi,si->ns", away, strength) / distance_sq**1.5).sum(axis=1)
    return found / (4.0 * np.pi)
