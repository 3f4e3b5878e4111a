"""Quadrature of closed triangle meshes: integrated column by column, exactly along z."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softmode.deformables.quadrature.quadrature_grid import (
    SUBDIVISION,
    Quadrature,
    cell_points,
    check_counts,
    finish_quadrature,
    grid_shape,
    match_moments,
    sum_pieces,
)
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT, candidate_count, select_surface
from softmode.errors import AssetError

Array = NDArray[np.float64]

COLUMNS = 32
"""Columns across an axis, at least."""
LARGE_FACE = 0.05
"""A face of more than this share of all area across an axis gets a grid plane."""


def quadrature_from_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, point_count: int = 4000, surface_count: int = SURFACE_COUNT, seed: int = 0
) -> Quadrature:
    """Integrate a closed triangle mesh.

    Rays along z through every sub-column give exact chords between crossings (signed, so overlapping parts count
    once); edge tests use one vertex order per edge, so no ray slips between two triangles.

    Args:
        vertices: Vertex positions [m], shape (V, 3).
        faces: Vertex indices of the triangles, counter-clockwise seen from outside, shape (T, 3). If they are all the
            other way round they are turned, and the report says `inside_out`.
        point_count: Target number of quadrature points; the result is near it.
        surface_count: Number of surface samples.
        seed: Seed of the surface samples.

    Returns:
        The quadrature; weights sum to the mesh volume, less what overlapping parts count repeatedly (by the chords).

    Raises:
        AssetError: If the mesh is empty, not finite, not closed, not consistently oriented, or of zero volume.
    """
    check_counts(point_count, surface_count)
    vertex, face = _load_mesh(vertices, faces)
    corner = vertex[face]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    twice_area = np.linalg.norm(normal, axis=1)
    area = 0.5 * float(twice_area.sum())
    lower, upper = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    centre = 0.5 * (lower + upper)
    local = corner - centre
    volume = float(np.einsum("ti,ti->", local[:, 0], np.cross(local[:, 1], local[:, 2]))) / 6.0
    inside_out = volume < 0.0
    if inside_out:
        face, corner, local, normal, volume = face[:, ::-1], corner[:, ::-1], local[:, ::-1], -normal, -volume
    if not volume > 1e-9 * float(np.prod(upper - lower)) or not volume > 0.0:
        raise AssetError(
            f"mesh: the enclosed volume is {volume:.3g} m^3, it must be positive", hint="Close and thicken the mesh."
        )
    aligned = (np.abs(normal).max(axis=1) > (1.0 - 1e-9) * twice_area) | (twice_area == 0.0)
    shape = grid_shape(upper - lower, volume, 0.5 * float(twice_area[~aligned].sum()), point_count)
    edges = (upper - lower) / shape
    lines = [_grid_lines(local, normal, axis, float(edges[axis])) for axis in range(3)]
    moments, signed = _integrate_columns(local, normal[:, 2], lines)
    found = cell_points(moments, lines)
    overlapping = signed > 1.001 * found.counted
    if overlapping:
        volume *= found.counted / signed
    else:
        found = replace(found, points=match_moments(found.points, found.weights, *_mesh_moments(local, volume)))
    rng = np.random.default_rng(seed)
    candidates = candidate_count(surface_count)
    pick = np.searchsorted(
        np.cumsum(twice_area),
        (np.arange(candidates) + rng.random(candidates)) / candidates * twice_area.sum(),
    ).clip(0, len(face) - 1)
    r, t = np.sqrt(rng.random(candidates)), rng.random(candidates)
    bary = np.stack([1.0 - r, r * (1.0 - t), r * t], axis=1)
    surface = select_surface(
        np.einsum("nk,nki->ni", bary, corner[pick]), normal[pick] / twice_area[pick, None], area, surface_count, seed
    )
    report = {"source": "mesh", "triangles": len(face), "overlapping": overlapping, "inside_out": inside_out}
    extent = np.stack([lower, upper])
    return finish_quadrature(found, centre, volume, edges, surface, extent, report)


def cap_holes(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, NDArray[np.int64], int]:
    """Close the holes of a triangle mesh by fans about the middle of each rim; flat where the rim is.

    Trimesh's own `fill_holes` closes holes of three and four edges only.

    Args:
        vertices: Vertex positions [m], shape (V, 3).
        faces: Vertex indices of the triangles, oriented alike, shape (T, 3).

    Returns:
        The vertices and faces with equal vertices merged and the caps at the end, and how many holes were closed.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=True)
    vertex, face = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    edge = np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]])
    rim = edge[~np.isin(edge @ [len(vertex), 1], edge @ [1, len(vertex)])]
    if not len(rim):
        return vertex, face, 0
    graph = coo_array((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), shape=(len(vertex), len(vertex)))
    _, hole = np.unique(connected_components(graph, directed=False)[1][rim[:, 0]], return_inverse=True)
    count = int(hole.max()) + 1
    length = np.linalg.norm(vertex[rim[:, 0]] - vertex[rim[:, 1]], axis=1)
    middle = np.zeros((count, 3))
    np.add.at(middle, hole, length[:, None] * 0.5 * vertex[rim].sum(axis=1))
    middle /= np.bincount(hole, length)[:, None]
    caps = np.column_stack([rim[:, ::-1], len(vertex) + hole])
    return np.concatenate([vertex, middle]), np.concatenate([face, caps]), count


def _load_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    """Merge duplicate vertices and check that the mesh is a closed, oriented surface."""
    import trimesh

    vertex = np.asarray(vertices, dtype=np.float64)
    face = np.asarray(faces)
    if vertex.ndim != 2 or vertex.shape[1] != 3:
        raise AssetError(f"vertices: expected positions of shape (V, 3), got shape {vertex.shape}")
    if not np.isfinite(vertex).all():
        lost = int((~np.isfinite(vertex).all(axis=1)).sum())
        raise AssetError(f"vertices: expected finite positions, {lost} of {len(vertex)} are NaN or infinite")
    if face.ndim != 2 or face.shape[1] != 3 or len(face) < 4 or not np.issubdtype(face.dtype, np.integer):
        raise AssetError(f"faces: expected at least 4 integer triangles of shape (T, 3), got {face.shape} {face.dtype}")
    if face.min() < 0 or face.max() >= len(vertex):
        raise AssetError(f"faces: indices must lie in 0..{len(vertex) - 1}, got {face.min()}..{face.max()}")
    mesh = trimesh.Trimesh(vertex, face, process=True)
    if not mesh.is_watertight:
        raise AssetError(
            f"mesh: not watertight ({len(face)} triangles), so its interior is not defined",
            hint="Close its holes, for instance with trimesh.repair.fill_holes.",
        )
    if not mesh.is_winding_consistent:
        raise AssetError(
            "mesh: neighbouring triangles are oriented differently", hint="Mend it with trimesh.repair.fix_normals."
        )
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _mesh_moments(corner: Array, volume: float) -> tuple[Array, Array]:
    """Return centroid and central second moments over volume of a closed mesh, by the divergence theorem."""
    share = np.einsum("ti,ti->t", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0 / volume
    total = corner.sum(axis=1)
    centre = 0.25 * share @ total
    second = np.einsum("t,tki,tkj->ij", share, corner, corner) + np.einsum("t,ti,tj->ij", share, total, total)
    return centre, second / 20.0 - np.outer(centre, centre)


def _grid_lines(corner: Array, normal: Array, axis: int, edge: float) -> Array:
    """Return borders of cells along an axis, about `edge` [m] apart, with one on each large face across the axis.

    Such a face at a quarter of a cell would be seen only as well as sub-columns are narrow.
    """
    low, high = float(corner[:, :, axis].min()), float(corner[:, :, axis].max())
    flat = np.abs(normal[:, axis]) > (1.0 - 1e-9) * np.linalg.norm(normal, axis=1)
    place = np.round((corner[flat, 0, axis] - low) / (high - low), 7)
    where, group = np.unique(place, return_inverse=True)
    size = np.bincount(group, np.abs(normal[flat, axis]), minlength=len(where))
    borders = [0.0, 1.0]
    for k in np.argsort(-size, kind="stable"):
        if size[k] > LARGE_FACE * size.sum() and np.abs(np.array(borders) - where[k]).min() > 0.25 * edge / (
            high - low
        ):
            borders.append(float(where[k]))
    border = low + (high - low) * np.sort(borders)
    counts = np.maximum(np.round(np.diff(border) / edge), 1).astype(int)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(border[:-1], border[1:], counts, strict=True)]
    return np.append(np.concatenate(parts), high)


def _integrate_columns(corner: Array, normal_z: Array, lines: list[Array]) -> tuple[Array, float]:
    """Return the moments per octant of a mesh (8 cells, 10), see `sum_pieces`, and the chords' signed volume."""
    # Even, for octants; more where few cells lie across.
    parts = [max(SUBDIVISION, 2 * math.ceil(COLUMNS / 2 / (len(line) - 1))) for line in lines[:2]]
    fine = [_split(line, n) for line, n in zip(lines[:2], parts, strict=True)]
    x, y = (0.5 * (line[1:] + line[:-1]) for line in fine)
    wide, deep = (np.diff(line) for line in fine)
    # Columns stand at sub-cell centres. Triangle-column pairs from each triangle's bounding box, then three edge tests.
    plan = corner[:, :, :2]
    begin = np.stack([np.searchsorted(axis, plan[:, :, d].min(axis=1)) for d, axis in enumerate((x, y))], axis=1)
    end = np.stack([np.searchsorted(axis, plan[:, :, d].max(axis=1), "right") for d, axis in enumerate((x, y))], axis=1)
    span = np.maximum(end - begin, 0)
    count = span[:, 0] * span[:, 1]
    triangle = np.repeat(np.arange(len(corner)), count)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    column = begin[triangle] + np.stack([within // span[triangle, 1], within % span[triangle, 1]], axis=1)
    at = np.column_stack([x[column[:, 0]], y[column[:, 1]]])
    inside = np.ones(len(triangle), dtype=bool)
    bary = np.empty((len(triangle), 3))
    for k in range(3):
        a, b = plan[triangle, (k + 1) % 3], plan[triangle, (k + 2) % 3]
        swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
        a, b = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
        side = (b[:, 0] - a[:, 0]) * (at[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (at[:, 0] - a[:, 0])
        # A column exactly on an edge belongs to its left side, whichever triangle asks.
        left = np.where(side >= 0.0, 1.0, -1.0) * np.where(swap, -1.0, 1.0)
        inside &= left * normal_z[triangle] > 0.0
        bary[:, k] = np.where(swap, -side, side)
    triangle, column, bary = triangle[inside], column[inside], bary[inside]
    height = np.einsum("pk,pk->p", bary / bary.sum(axis=1, keepdims=True), corner[triangle, :, 2])
    key = column[:, 0] * len(y) + column[:, 1]
    order = np.lexsort((height, key))
    key, height, column = key[order], height[order], column[order]
    # Going up, a downward facing triangle enters the object. Columns balance, so one running sum serves all.
    winding = np.cumsum(np.where(normal_z[triangle[order]] < 0.0, 1, -1))
    same = key[:-1] == key[1:]
    section = wide[column[:, 0]] * deep[column[:, 1]]
    signed = float((winding[:-1] * np.diff(height) * section[:-1])[same].sum())
    open_ = np.flatnonzero((winding[:-1] > 0) & same)
    bottom, top, column, section = height[open_], height[open_ + 1], column[open_], section[open_]

    # Cut each chord at the octants' borders.
    levels = _split(lines[2], 2)
    k0 = np.clip(np.searchsorted(levels, bottom, "right") - 1, 0, len(levels) - 2)
    k1 = np.clip(np.searchsorted(levels, top, "right") - 1, 0, len(levels) - 2)
    count = k1 - k0 + 1
    chord = np.repeat(np.arange(len(bottom)), count)
    k = np.arange(len(chord)) - np.repeat(np.cumsum(count) - count, count) + k0[chord]
    low, high = np.maximum(bottom[chord], levels[k]), np.minimum(top[chord], levels[k + 1])
    long = np.maximum(high - low, 0.0)
    i, j = column[chord].T
    grid = tuple(2 * (len(line) - 1) for line in lines)
    octant = np.ravel_multi_index((i // (parts[0] // 2), j // (parts[1] // 2), k), grid)
    centre = np.column_stack([x[i], y[j], 0.5 * (low + high)])
    spread = np.column_stack([wide[i], deep[j], long]) ** 2 / 12.0
    return sum_pieces(octant, long * section[chord], centre, spread, int(np.prod(grid))), signed


def _split(line: Array, parts: int) -> Array:
    """Return borders with every interval cut into equal parts."""
    return np.interp(np.arange((len(line) - 1) * parts + 1) / parts, np.arange(len(line)), line)
