"""Solids as level-set functions, distances near their surface and negative inside, and their surfaces as meshes."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import zoom
from scipy.spatial import KDTree

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]
Level = Callable[[Array], Array]
"""Distance of points (N, 3) [m] from a surface, shape (N,)."""

COARSE = 4
"""Cells of the grid along an edge of the coarse one, which says where the surface is."""
CLEARANCE = 2e-5
"""Least value at a node of the grid over the edge of a cell: no triangle is degenerate."""


def ball(radius: float, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Level:
    """Return a ball."""
    return lambda x: np.linalg.norm(x - np.asarray(centre), axis=1) - radius


def ellipsoid(radii: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Level:
    """Return an ellipsoid, a distance to first order at its surface."""
    r = np.asarray(radii)

    def level(x: Array) -> Array:
        local = x - np.asarray(centre)
        k0, k1 = np.linalg.norm(local / r, axis=1), np.linalg.norm(local / r**2, axis=1)
        return np.where(k1 > 1e-9, k0 * (k0 - 1.0) / np.maximum(k1, 1e-9), -r.min())

    return level


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), rounding: float = 0.0) -> Level:
    """Return a box with edges `size`, rounded."""
    half = 0.5 * np.asarray(size) - rounding

    def level(x: Array) -> Array:
        away = np.abs(x - np.asarray(centre)) - half
        return np.linalg.norm(np.maximum(away, 0.0), axis=1) + np.minimum(away.max(axis=1), 0.0) - rounding

    return level


def cylinder(
    radius: float, low: float, high: float, across: ArrayLike = (0.0, 0.0), *, axis: int = 2, rounding: float = 0.0
) -> Level:
    """Return a cylinder from `low` to `high` along an axis, at a place across it, grown by a rounding."""
    others = [d for d in range(3) if d != axis]

    def level(x: Array) -> Array:
        u, v = (x[:, others] - np.asarray(across)).T
        away = np.stack([np.hypot(u, v) - radius, np.abs(x[:, axis] - 0.5 * (low + high)) - 0.5 * (high - low)])
        return np.linalg.norm(np.maximum(away, 0.0), axis=0) + np.minimum(away.max(axis=0), 0.0) - rounding

    return level


def torus(major: float, minor: float, centre: ArrayLike = (0.0, 0.0, 0.0), axis: int = 2) -> Level:
    """Return a ring about an axis."""
    others = [d for d in range(3) if d != axis]

    def level(x: Array) -> Array:
        local = x - np.asarray(centre)
        return np.hypot(np.linalg.norm(local[:, others], axis=1) - major, local[:, axis]) - minor

    return level


def capsule(a: ArrayLike, b: ArrayLike, radius: float, end_radius: float | None = None) -> Level:
    """Return what lies within a radius of the line from a to b; the radius may change along it."""
    start, way = np.asarray(a, np.float64), np.subtract(b, a)
    more = 0.0 if end_radius is None else end_radius - radius

    def level(x: Array) -> Array:
        t = np.clip((x - start) @ way / (way @ way), 0.0, 1.0)
        return np.linalg.norm(x - start - t[:, None] * way, axis=1) - radius - more * t

    return level


def union(*parts: Level) -> Level:
    """Return what lies in any of the parts."""
    return lambda x: np.min([part(x) for part in parts], axis=0)


def without(solid: Level, cavity: Level) -> Level:
    """Return a solid less a cavity."""
    return lambda x: np.maximum(solid(x), -cavity(x))


def blended(width: float, *parts: Level) -> Level:
    """Return the union of the parts with fillets of about a width (polynomial smooth minimum)."""

    def level(x: Array) -> Array:
        found = parts[0](x)
        for part in parts[1:]:
            other = part(x)
            h = np.maximum(width - np.abs(found - other), 0.0) / width
            found = np.minimum(found, other) - 0.25 * h * h * width
        return found

    return level


def carved(width: float, solid: Level, *cavities: Level) -> Level:
    """Return a solid less cavities, its new edges rounded by about a width."""
    rest = blended(width, lambda x: -solid(x), *cavities)
    return lambda x: -rest(x)


def follow(curve: ArrayLike) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Return what gives points (N, 3) in the frame of a level curve: arc length, offset to its left, and up [m].

    Args:
        curve: Points of the curve, close together and of one height [m], shape (K, 3). It goes on straight.
    """
    c = np.asarray(curve, dtype=np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(c, axis=0), axis=1))])
    tangent = np.gradient(c, length, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    tree = KDTree(c)

    def local(x: Array) -> tuple[Array, Array, Array]:
        k = tree.query(x)[1]
        way, t = x - c[k], tangent[k]
        return length[k] + (way * t).sum(axis=1), t[:, 0] * way[:, 1] - t[:, 1] * way[:, 0], way[:, 2]

    return local


def level_mesh(level: Level, low: ArrayLike, high: ArrayLike, cell: float) -> trimesh.Trimesh:
    """Return the surface of a solid as a closed mesh, by marching cubes (Warp's) and a Newton step to the surface.

    The level is evaluated where a grid four times as coarse says that the surface is near.

    Args:
        level: The solid.
        low: Lower corner of a box that holds it [m].
        high: Upper corner.
        cell: Edge of the cells [m]; much less than the thinnest part.
    """
    import trimesh

    start = np.asarray(low, np.float64) - COARSE * cell
    shape = tuple(np.ceil((np.asarray(high) - start) / (COARSE * cell)).astype(int) + 2)
    coarse = level(start + COARSE * cell * np.argwhere(np.ones(shape, bool))).reshape(shape)
    field = np.asarray(zoom(coarse, [(COARSE * (n - 1) + 1) / n for n in shape], order=1))
    near = np.abs(field) < 2.0 * COARSE * cell
    field[near] = level(start + cell * np.argwhere(near))
    field[np.abs(field) < CLEARANCE * cell] = CLEARANCE * cell
    found, faces = marching_cubes(field / cell)
    points = start + cell * found
    slope = level_slope(level, points, 0.05 * cell)
    step = np.clip(-level(points) / np.maximum((slope**2).sum(axis=1), 0.25), -0.3 * cell, 0.3 * cell)
    return trimesh.Trimesh(points + step[:, None] * slope, faces, process=False)


def marching_cubes(field: Array) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (V, 3), in nodes, and triangles (T, 3) of the surface of what is negative in a grid (Warp's)."""
    import warp as wp

    if find_spec("warp.geometry") is None:  # Warp 1.17 has no such module.
        extract = wp.MarchingCubes.extract_surface_marching_cubes
    else:
        from warp.geometry import IsoSurfaceMarchingCubes

        extract = IsoSurfaceMarchingCubes.extract
    given: Any = wp.array(field, dtype=wp.float32, device="cpu")
    found, faces = (x.numpy() for x in extract(given))
    return found.astype(np.float64), np.asarray(faces, dtype=np.int32).reshape(-1, 3)


def level_slope(level: Level, points: Array, step: float) -> Array:
    """Return the gradient of a level-set function by central differences over a step [m], shape (N, 3)."""
    offsets = step * np.concatenate([np.eye(3), -np.eye(3)])
    value = level((points[:, None] + offsets).reshape(-1, 3)).reshape(-1, 2, 3)
    return (value[:, 0] - value[:, 1]) / (2.0 * step)
