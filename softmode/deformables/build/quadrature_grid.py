"""Quadrature: interior points with volumes and surface samples with areas, on the cells of a uniform grid."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.errors import AssetError

Array = NDArray[np.float64]

SUBDIVISION = 4
"""Each grid cell is integrated by this many sub-cells per axis."""
SMALLEST_CELL = 0.02
"""Boundary cells filled less than this are dropped; their volume is spread by the final scaling."""


@dataclass(frozen=True, kw_only=True)
class Quadrature:
    """Interior points, their volumes, and the sampled surface of one object, in asset coordinates, float64."""

    points: Array
    """Centroids of the occupied cells [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], positive, sum = `volume`, shape (P,)."""
    spacing: float
    """Edge of a grid cell (geometric mean of the three) [m]."""
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
    """Choose cells per axis so that interior plus boundary cells, V / h^3 + 0.7 A / h^2, meet the target."""
    inverse = (point_count / volume) ** (1.0 / 3.0)
    for _ in range(20):  # Newton on x -> V x^3 + 0.7 A x^2; half of the boundary's cells lie outside the volume count.
        value = volume * inverse**3 + 0.35 * area * inverse**2 - point_count
        inverse -= value / (3.0 * volume * inverse**2 + 0.7 * area * inverse)
    return np.maximum(np.round(extent * inverse), 2).astype(np.int64)


def sum_by(index: ArrayLike, weight: Array, position: Array, count: int) -> tuple[Array, Array]:
    """Return per group the sum of weights (count,) and of weighted positions (count, D)."""
    index = np.asarray(index)
    total = np.bincount(index, weight, minlength=count).astype(np.float64)
    first = [np.bincount(index, weight * column, minlength=count).astype(np.float64) for column in position.T]
    return total, np.stack(first, axis=1)


def assemble_cells(
    cell: Array, first: Array, lower: Array, upper: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array, float]:
    """Drop near-empty cells; return centroids, volumes, and the volume counted before the drop."""
    keep = cell > SMALLEST_CELL * float(((upper - lower) / shape).prod())
    return first[keep] / cell[keep, None], cell[keep], float(cell.sum())


def finish_quadrature(
    points: Array,
    weights: Array,
    counted: float,
    volume: float,
    cell: Array,
    surface: tuple[Array, Array, Array],
    bounds: Array,
    report: dict[str, Any],
) -> Quadrature:
    """Scale the weights to the volume and pack the result."""
    if not len(points) or not volume > 0.0:
        raise AssetError("the object has no volume", hint="Give a closed object of positive volume.")
    return Quadrature(
        points=points,
        weights=weights * (volume / weights.sum()),
        spacing=float(cell.prod() ** (1.0 / 3.0)),
        surface_points=surface[0],
        surface_normals=surface[1],
        surface_areas=surface[2],
        volume=float(volume),
        bounds=bounds,
        report={
            **report,
            "points": len(points),
            "counted_volume": counted,
            "weight_scaling": float(volume / weights.sum()),
            "box_fill": float(volume / np.prod(bounds[1] - bounds[0])),
        },
    )
