"""Quadrature of implicit functions: sub-sampled cells with a linear boundary layer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.quadrature.quadrature_grid import (
    SUBDIVISION,
    Quadrature,
    cell_points,
    check_counts,
    finish_quadrature,
    grid_shape,
    sum_pieces,
)
from softmode.deformables.quadrature.surface_samples import FEW_SAMPLES, SURFACE_COUNT, candidate_count, select_surface
from softmode.errors import AssetError

Array = NDArray[np.float64]
SignedDistance = Callable[[Array], ArrayLike]

FINEST = 32
"""Most sub-cells per axis of a cell."""


def quadrature_from_implicit(
    signed_distance: SignedDistance,
    bounds: ArrayLike,
    *,
    point_count: int = 4000,
    surface_count: int = SURFACE_COUNT,
    seed: int = 0,
    volume: float | None = None,
    area: float | None = None,
    detail: float | None = None,
) -> Quadrature:
    """Integrate the inside (negative side) of a level-set function.

    A true distance is not required: values are divided by the length of their gradient near the surface.

    Args:
        signed_distance: Maps points (N, 3) [m] to values (N,), negative inside.
        bounds: Lower and upper corner of a box that holds the object [m], shape (2, 3).
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        seed: Seed of the surface samples.
        volume: Exact volume [m^3] when known; else the sub-sampled one is taken.
        area: Exact surface area [m^2] when known.
        detail: What the function resolves, such as a third of its thinnest walls [m]; None for what an eighth of a
            cell resolves.

    Returns:
        The quadrature.

    Raises:
        AssetError: If nothing lies inside, or values are not finite.
    """
    check_counts(point_count, surface_count)
    box = np.array(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise AssetError(
            f"bounds: expected finite corners (2, 3) with upper > lower, got {np.asarray(bounds).tolist()}"
        )

    def level(x: Array) -> Array:
        value = np.asarray(signed_distance(x), dtype=np.float64)
        if value.shape != (len(x),) or not np.isfinite(value).all():
            raise AssetError(f"signed_distance: expected {len(x)} finite values, got shape {value.shape}")
        return value

    # A coarse pass fits the box to the object and estimates volume and area for the choice of the grid.
    span = box[1] - box[0]
    coarse = 32.0 if detail is None else float(np.clip(span.max() / detail, 32.0, 128.0))
    coarse_shape = np.maximum(np.ceil(span / span.max() * coarse), 4).astype(int)
    distance, value, nodes, width = _sample_grid(level, box, coarse_shape)
    reach = distance < width.max()
    if not (distance < 0.5 * width.max()).any():
        raise AssetError("signed_distance: nothing lies inside the bounds", hint="Check the sign and the bounds.")
    box = np.stack([
        np.maximum(box[0], nodes[reach].min(axis=0) - 0.5 * width),
        np.minimum(box[1], nodes[reach].max(axis=0) + 0.5 * width),
    ])  # fmt: skip
    rough_volume = max(float(_filled(distance, width).sum() * width.prod()), float(width.prod()))
    rough_area = float((np.abs(distance) < width.max()).sum() * width.prod() / (2.0 * width.max()))
    shape = grid_shape(box[1] - box[0], volume or rough_volume, area or rough_area, point_count)

    cuts = np.full(3, SUBDIVISION)
    if detail is not None:
        cuts = np.clip(2 * np.ceil(0.5 * (box[1] - box[0]) / shape / detail), SUBDIVISION, FINEST).astype(int)
    distance, value, nodes, width = _sample_grid(level, box, shape * cuts)
    filled = _filled(distance, width)
    axes = [np.arange(n * cut) // (cut // 2) for n, cut in zip(shape, cuts, strict=True)]
    octant = np.ravel_multi_index(np.meshgrid(*axes, indexing="ij"), tuple(2 * shape)).ravel()
    keep = filled > 0.0
    middle = box.mean(axis=0)
    moments = sum_pieces(
        octant[keep],
        filled[keep] * width.prod(),
        nodes[keep] - middle,
        np.tile(width**2 / 12.0, (int(keep.sum()), 1)),
        int((2 * shape).prod()),
    )
    lines = [np.linspace(box[0, d], box[1, d], shape[d] + 1) - middle[d] for d in range(3)]
    found = cell_points(moments, lines)
    exact_area = area if area is not None else _surface_area(level, distance, value, nodes, width)
    candidates, normals = _project_surface(level, nodes, distance, width, surface_count, seed)
    surface = select_surface(candidates, normals, exact_area, surface_count, seed)
    extent = np.stack([candidates.min(axis=0), candidates.max(axis=0)])
    edges = (box[1] - box[0]) / shape
    return finish_quadrature(found, middle, volume or found.counted, edges, surface, extent, {"source": "implicit"})


def _sample_grid(
    level: Callable[[Array], Array], box: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Return first-order distances (cells,), level values (cells,), cell centres (cells, 3) and cell edges (3,)."""
    width = (box[1] - box[0]) / shape
    axes = [box[0, d] + (np.arange(shape[d]) + 0.5) * width[d] for d in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    value = level(nodes).reshape(tuple(shape))
    slope = np.sqrt(sum(g * g for g in np.gradient(value, *width)))
    distance = (value / np.maximum(slope, 1e-3 * slope.max() + 1e-300)).ravel()
    return distance, value.ravel(), nodes, width


def _gradient(level: Callable[[Array], Array], points: Array, step: float) -> Array:
    """Return central differences of the level function (N, 3)."""
    shifted = (points[:, None] + np.concatenate([np.eye(3), -np.eye(3)]) * step).reshape(-1, 3)
    value = level(shifted).reshape(-1, 2, 3)
    return (value[:, 0] - value[:, 1]) / (2.0 * step)


def _surface_area(level: Callable[[Array], Array], distance: Array, value: Array, nodes: Array, width: Array) -> float:
    """Return the area [m^2] by the co-area formula, int delta(f) |grad f| dX, with a hat for delta."""
    near = np.flatnonzero(np.abs(distance) < 6.0 * width.max())
    slope = np.linalg.norm(_gradient(level, nodes[near], 0.25 * float(width.min())), axis=1)
    reach = 1.5 * float(width.max() * np.median(slope[np.abs(distance[near]) < 0.5 * width.max()]))
    hat = np.maximum(1.0 - np.abs(value[near]) / reach, 0.0) / reach
    return float((hat * slope).sum() * width.prod())


def _filled(distance: Array, width: Array) -> Array:
    """Return the filled fraction of cells at first-order distances from a plane."""
    return np.clip(0.5 - distance / width.prod() ** (1.0 / 3.0), 0.0, 1.0)


def _layer_cells(nodes: Array, distance: Array, width: Array, layer: float) -> Array:
    """Return the centres of all cells (N, 3) that a layer about the zero level may cut.

    Where the surface touches the box of the grid, as a sphere does that is given in its own bounds, half of the layer
    lies outside: there cells are added, or these places would get half as many points as others.
    """
    reach = layer + 0.5 * float(np.linalg.norm(width))
    cells, away = nodes[np.abs(distance) < reach + layer], distance[np.abs(distance) < reach + layer]
    keep = [cells[np.abs(away) < reach]]
    lower, upper = nodes.min(axis=0) + 0.5 * width, nodes.max(axis=0) - 0.5 * width
    for axis in range(3):
        step = width * np.eye(3)[axis]
        beyond = [cells[cells[:, axis] < lower[axis]] - step, cells[cells[:, axis] > upper[axis]] + step]
        keep, cells = [*keep, *beyond], np.concatenate([cells, *beyond])
    return np.concatenate(keep)


def _project_surface(
    level: Callable[[Array], Array], nodes: Array, distance: Array, width: Array, surface_count: int, seed: int
) -> tuple[Array, Array]:
    """Draw points in a thin layer around the zero level, which makes their density uniform, and project them on it."""
    rng = np.random.default_rng(seed)
    layer = 0.5 * float(width.max())
    if surface_count < FEW_SAMPLES:
        cells = nodes[np.abs(distance) < layer + 0.5 * float(np.linalg.norm(width))]
    else:
        cells = _layer_cells(nodes, distance, width, layer)
    wanted = 3 * candidate_count(surface_count)
    pick = rng.permutation(len(cells) * max(1, -(-wanted // max(len(cells), 1))))[:wanted] % len(cells)
    x = cells[pick] + (rng.random((len(pick), 3)) - 0.5) * width
    step = 0.25 * float(width.min())

    value, slope = level(x), _gradient(level, x, step)
    length = np.linalg.norm(slope, axis=1)
    keep = np.abs(value) < layer * length
    x, value, slope = x[keep], value[keep], slope[keep]
    for _ in range(3):
        x = x - slope * (value / np.maximum((slope * slope).sum(axis=1), 1e-300))[:, None]
        value, slope = level(x), _gradient(level, x, step)
    length = np.linalg.norm(slope, axis=1)
    keep = (length > 0.0) & (np.abs(value) < 0.05 * layer * np.maximum(length, np.median(length)))
    if keep.sum() < surface_count:
        raise AssetError("signed_distance: the zero level cannot be sampled", hint="Use a continuous function.")
    return x[keep], slope[keep] / length[keep, None]
