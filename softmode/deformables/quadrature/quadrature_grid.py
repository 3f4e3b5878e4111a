"""Quadrature: interior points with volumes and surface samples with areas, on the cells of a grid.

Every source is cut into small pieces, of which volume, centroid and second moment are known, each inside an eighth
(octant) of a grid cell. A cell becomes eight points that have the volume, the centroid and the second moments of what
lies inside it: in a full cell the points of Gauss's rule of two points per axis, which integrates the strain energy of
a bent plate exactly with one cell across it. One point per cell made two layers of cells 25 % too soft in bending.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.errors import AssetError

Array = NDArray[np.float64]

SUBDIVISION = 8
"""Each grid cell is integrated by this many sub-cells per axis."""
POINTS_PER_CELL = 8
"""Points of a cell: two per axis."""
EMPTY = 1.0e-6
"""Cells filled less than this are dropped; their volume is spread by the final scaling."""
SPARSE = 0.04
"""Cells filled less than this get one point, at their centroid."""
HOLLOW = 0.02
"""A point may not lie in an octant that is filled less than this: such a cell (two walls with a gap between them) gets
one point per octant, at its centroid."""


@dataclass(frozen=True, kw_only=True)
class Cells:
    """The grid behind the points: what a face of a region cuts, which points alone do not say."""

    of_point: NDArray[np.int64]
    """Cell of each point, shape (P,)."""
    octants: Array
    """Centroids of what lies in the eighths of the cells [m], shape (Q, 3)."""
    weights: Array
    """Their volumes [m^3], shape (Q,)."""
    of_octant: NDArray[np.int64]
    """Cell of each octant, shape (Q,)."""
    place: NDArray[np.int64] | None = None
    """Place of each octant in the grid of octants, shape (Q, 3); None in files written before 0.3."""
    borders: Array | None = None
    """Borders of the octants along each axis of the grid [m], rows filled up by infinity, shape (3, B); None in files
    of bodies of version 2."""
    axes: Array | None = None
    """Axes of the grid, unit vectors in rows, shape (3, 3); None: those of the coordinates."""
    severed: NDArray[np.int64] | None = None
    """Pairs of octants that a cut divides, though they are neighbours, the lower one first, shape (E, 2)."""


@dataclass(frozen=True, kw_only=True)
class Quadrature:
    """Interior points, their volumes, and the sampled surface of one object, in asset coordinates, float64."""

    points: Array
    """Points inside the object, eight in most cells [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], positive, sum = `volume`, shape (P,)."""
    spacing: float
    """Distance between points (geometric mean of the three axes): half the edge of a grid cell [m]."""
    surface_points: Array
    """Surface samples [m], near-uniform, shape (S, 3)."""
    surface_normals: Array
    """Outward unit normals, shape (S, 3)."""
    surface_areas: Array
    """Areas [m^2], sum = surface area, shape (S,)."""
    volume: float
    """Volume [m^3]."""
    bounds: Array
    """Lower and upper corner of the bounding box [m], shape (2, 3)."""
    report: dict[str, Any] = field(default_factory=dict)
    """How the numbers came about: source, counts, scaling applied."""
    members: NDArray[np.bool_] | None = None
    """Of splats and points: which inputs belong to the object (the others are floaters or surroundings), shape (N,)."""
    satellites: NDArray[np.bool_] | None = None
    """Of splats: smaller detached parts close to the object; not part of the solid, shape (N,)."""
    cells: Cells | None = None
    """The grid's cells, where there is one."""

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        shapes = {
            "points": (self.points, (len(self.weights), 3)),
            "weights": (self.weights, (len(self.points),)),
            "surface_points": (self.surface_points, (len(self.surface_areas), 3)),
            "surface_normals": (self.surface_normals, (len(self.surface_areas), 3)),
            "bounds": (self.bounds, (2, 3)),
        }
        for name, (value, shape) in shapes.items():
            if value.shape != shape:
                raise AssetError(f"{name}: expected shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise AssetError(f"{name}: not all finite")
        if not (len(self.points) >= 4 and (self.weights > 0.0).all() and self.volume > 0.0):
            raise AssetError(
                f"the object has no volume ({len(self.points)} points, {self.volume:.3g} m^3)",
                hint="Give a closed object of positive volume.",
            )


def check_counts(point_count: int, surface_count: int) -> None:
    """Refuse counts that are too small.

    Raises:
        ConfigError: If there are fewer than 32 points or 8 samples.
    """
    require_number("point_count", point_count, at_least=32)
    require_number("surface_count", surface_count, at_least=8)


def grid_shape(extent: Array, volume: float, area: float, point_count: int) -> NDArray[np.int64]:
    """Choose cells per axis so that interior plus boundary cells, V / h^3 + 0.35 A / h^2, meet the target.

    At least two lie across: with the two layers of points of one cell, z^2 could not be told from a constant.
    """
    cells = point_count / POINTS_PER_CELL
    inverse = (cells / volume) ** (1.0 / 3.0)
    for _ in range(20):  # Newton on x -> V x^3 + 0.35 A x^2; half of the boundary's cells lie outside the volume count.
        value = volume * inverse**3 + 0.35 * area * inverse**2 - cells
        inverse -= value / (3.0 * volume * inverse**2 + 0.7 * area * inverse)
    shape = np.empty(3, dtype=np.int64)
    order = np.argsort(extent, kind="stable")
    for k, axis in enumerate(order):  # What rounding takes from a thin axis, the longer ones get.
        shape[axis] = max(round(float(extent[axis] * inverse)), 2)
        if k < 2:
            inverse *= float(extent[axis] * inverse / shape[axis]) ** (1.0 / (2 - k))
    return shape


def sum_pieces(octant: ArrayLike, volume: Array, centre: Array, spread: Array, count: int) -> Array:
    """Return volume, first and second moments of the pieces in every octant.

    Args:
        octant: Octant of every piece, shape (N,).
        volume: Their volumes [m^3], shape (N,).
        centre: Their centroids [m], shape (N, 3).
        spread: Their own second moments over volume, along the axes [m^2], shape (N, 3).
        count: Number of octants.

    Returns:
        Sums of v, v x (3) and v (xx, yy, zz, xy, yz, zx), shape (count, 10).
    """
    x, y, z = centre.T
    second = [x * x + spread[:, 0], y * y + spread[:, 1], z * z + spread[:, 2], x * y, y * z, z * x]
    index = np.asarray(octant)
    found = np.empty((count, 10))
    for k, factor in enumerate((np.ones(len(x)), x, y, z, *second)):
        found[:, k] = np.bincount(index, volume * factor, minlength=count)
    return found


@dataclass(frozen=True, kw_only=True)
class CellPoints:
    """Points of a grid's cells."""

    points: Array
    """Positions about the middle of the grid [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], shape (P,)."""
    cells: Cells
    """Where they come from, octants about the same middle."""
    counted: float
    """Volume before empty cells were dropped [m^3]."""


def cell_points(moments: Array, lines: Sequence[Array]) -> CellPoints:
    """Turn the moments of octants into points.

    Args:
        moments: As :func:`sum_pieces` returns them, about the middle of the grid, shape (8 cells, 10).
        lines: Borders of the cells along the three axes, about the same middle [m].
    """
    shape = tuple(len(line) - 1 for line in lines)
    split = moments.reshape(shape[0], 2, shape[1], 2, shape[2], 2, 10).transpose(0, 2, 4, 1, 3, 5, 6).reshape(-1, 8, 10)
    edges = np.stack(np.meshgrid(*[np.diff(line) for line in lines], indexing="ij"), axis=-1).reshape(-1, 3)
    middle = np.stack(np.meshgrid(*[0.5 * (b[1:] + b[:-1]) for b in lines], indexing="ij"), axis=-1).reshape(-1, 3)
    counted, size = float(moments[:, 0].sum()), edges.prod(axis=1)
    kept = split[:, :, 0].sum(axis=1) > EMPTY * size
    split, size, middle = split[kept], size[kept], middle[kept]
    whole = split.sum(axis=1)
    volume, centre = whole[:, 0], whole[:, 1:4] / whole[:, :1]
    second = whole[:, [[4, 7, 9], [7, 5, 8], [9, 8, 6]]] / volume[:, None, None]
    second -= centre[:, :, None] * centre[:, None]
    spread, axes = np.linalg.eigh(second)
    corner = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = centre[:, None] + np.einsum(
        "cij,cj,kj->cki", axes, np.sqrt(np.maximum(spread, 0.0)), corner, optimize=True
    )
    at = ((points > middle[:, None]) * np.array([4, 2, 1])).sum(axis=2)
    full = np.take_along_axis(split[:, :, 0], at, axis=1) > HOLLOW / 8.0 * size[:, None]
    sparse = volume < SPARSE * size
    eight, apart = full.all(axis=1) & ~sparse, ~full.all(axis=1) & ~sparse
    filled = split[:, :, 0] > EMPTY / 8.0 * size[:, None]
    of_octant, where = np.nonzero(filled)
    octants = split[of_octant, where]
    first = np.stack(np.unravel_index(np.flatnonzero(kept)[of_octant], shape), axis=1)
    alone = apart[of_octant]
    return CellPoints(
        points=np.concatenate([
            points[eight].reshape(-1, 3), octants[alone, 1:4] / octants[alone, :1], centre[sparse]
        ]),
        weights=np.concatenate([np.repeat(volume[eight] / 8.0, 8), octants[alone, 0], volume[sparse]]),
        cells=Cells(
            of_point=np.concatenate([np.repeat(np.flatnonzero(eight), 8), of_octant[alone], np.flatnonzero(sparse)]),
            octants=octants[:, 1:4] / octants[:, :1],
            weights=octants[:, 0],
            of_octant=of_octant,
            place=2 * first + np.stack([where // 4, where // 2 % 2, where % 2], axis=1),
            borders=_octant_borders(lines),
        ),
        counted=counted,
    )  # fmt: skip


def _octant_borders(lines: Sequence[Array]) -> Array:
    """Return the borders of the octants of cells, rows filled up by infinity, shape (3, B) [m]."""
    found = np.full((3, 2 * max(len(line) for line in lines) - 1), np.inf)
    for row, line in zip(found, lines, strict=True):
        row[: 2 * len(line) - 1] = np.interp(0.5 * np.arange(2 * len(line) - 1), np.arange(len(line)), line)
    return found


def match_moments(points: Array, weights: Array, centre: Array, second: Array) -> Array:
    """Move points, by the affine map nearest to none, so that centroid and second moments are the given ones.

    Args:
        points: Positions [m], shape (P, 3).
        weights: Volumes [m^3], shape (P,).
        centre: Centroid [m], shape (3,).
        second: Second moments about it over the volume [m^2], shape (3, 3).
    """
    share = weights / weights.sum()
    away = points - share @ points
    root = _root(second)
    # A S A^T = second for A = R (R S R)^(-1/2) R with R the root of `second`: symmetric, and the identity if S matches.
    inner = np.linalg.inv(_root(root @ ((away * share[:, None]).T @ away) @ root))
    return centre + away @ (root @ inner @ root)


def _root(matrix: Array) -> Array:
    """Return the square root of a symmetric positive definite matrix."""
    value, vector = np.linalg.eigh(matrix)
    return (vector * np.sqrt(value)) @ vector.T


def finish_quadrature(
    found: CellPoints,
    middle: Array,
    volume: float,
    edges: Array,
    surface: tuple[Array, Array, Array],
    bounds: Array,
    report: dict[str, Any],
) -> Quadrature:
    """Scale the weights to the volume and pack the result.

    Args:
        found: The points.
        middle: Middle of the grid, about which they are given [m], shape (3,).
        volume: Volume of the object [m^3].
        edges: Edges of a cell [m], shape (3,).
        surface: Points, normals and areas of the surface samples.
        bounds: Corners of the bounding box [m], shape (2, 3).
        report: How the numbers came about.
    """
    if not len(found.points) or not volume > 0.0:
        raise AssetError("the object has no volume", hint="Give a closed object of positive volume.")
    scaling = float(volume / found.weights.sum())
    cells = found.cells
    return Quadrature(
        points=found.points + middle,
        weights=found.weights * scaling,
        spacing=0.5 * float(edges.prod() ** (1.0 / 3.0)),
        surface_points=surface[0],
        surface_normals=surface[1],
        surface_areas=surface[2],
        volume=float(volume),
        bounds=bounds,
        report={
            **report,
            "points": len(found.points),
            "counted_volume": found.counted,
            "weight_scaling": scaling,
            "box_fill": float(volume / np.prod(bounds[1] - bounds[0])),
        },
        cells=replace(
            cells,
            octants=cells.octants + middle,
            weights=cells.weights * scaling,
            borders=None if cells.borders is None else cells.borders + middle[:, None],
        ),
    )
