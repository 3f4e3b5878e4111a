"""Quadrature of closed triangle meshes: integrated column by column, exactly along z."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.build.quadrature_grid import (
    SUBDIVISION,
    Quadrature,
    assemble_cells,
    check_counts,
    finish_quadrature,
    grid_shape,
    sum_by,
)
from softmode.deformables.build.surface_samples import CANDIDATES_PER_SAMPLE, select_surface
from softmode.errors import AssetError

Array = NDArray[np.float64]


def quadrature_from_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, point_count: int = 4000, surface_count: int = 400, seed: int = 0
) -> Quadrature:
    """Integrate a closed triangle mesh.

    Rays along z through every sub-column give exact chords between crossings (signed, so overlapping parts count
    once); edge tests use one vertex order per edge, so no ray slips between two triangles.

    Args:
        vertices: Vertex positions [m], shape (V, 3).
        faces: Vertex indices of the triangles, counter-clockwise seen from outside, shape (T, 3).
        point_count: Target number of quadrature points; the result is near it.
        surface_count: Number of surface samples.
        seed: Seed of the surface samples.

    Returns:
        The quadrature; weights sum to the mesh volume, less what overlapping parts count repeatedly (by the chords).

    Raises:
        AssetError: If the mesh is empty, not finite, not closed, not consistently oriented, or of zero or negative
            volume.
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
    if not volume > 1e-9 * float(np.prod(upper - lower)) or not volume > 0.0:
        raise AssetError(
            f"mesh: the enclosed volume is {volume:.3g} m^3, it must be positive",
            hint="Flip the faces (inside out) or close and thicken the mesh.",
        )
    shape = grid_shape(upper - lower, volume, area, point_count)
    cell, first, signed = _integrate_columns(corner, normal[:, 2], lower, upper, shape)
    points, weights, counted = assemble_cells(cell, first, lower, upper, shape)
    volume *= counted / signed
    rng = np.random.default_rng(seed)
    candidate_count = CANDIDATES_PER_SAMPLE * surface_count
    pick = np.searchsorted(
        np.cumsum(twice_area),
        (np.arange(candidate_count) + rng.random(candidate_count)) / candidate_count * twice_area.sum(),
    ).clip(0, len(face) - 1)
    r, t = np.sqrt(rng.random(candidate_count)), rng.random(candidate_count)
    bary = np.stack([1.0 - r, r * (1.0 - t), r * t], axis=1)
    surface = select_surface(
        np.einsum("nk,nki->ni", bary, corner[pick]), normal[pick] / twice_area[pick, None], area, surface_count, seed
    )
    report = {"source": "mesh", "triangles": len(face), "overlapping": signed > 1.001 * counted}
    extent = np.stack([lower, upper])
    return finish_quadrature(points, weights, counted, volume, (upper - lower) / shape, surface, extent, report)


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


def _integrate_columns(
    corner: Array, normal_z: Array, lower: Array, upper: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array, float]:
    """Return volume (cells,) and first moment (cells, 3) per grid cell of a mesh, and the chords' signed volume."""
    fine = shape[:2] * SUBDIVISION
    width = (upper - lower)[:2] / fine
    # Columns stand at sub-cell centres. Triangle-column pairs from each triangle's bounding box, then three edge tests.
    flat = (corner[:, :, :2] - lower[:2]) / width - 0.5
    begin = np.clip(np.ceil(flat.min(axis=1)), 0, fine).astype(np.int64)
    end = np.clip(np.floor(flat.max(axis=1)) + 1, 0, fine).astype(np.int64)
    span = np.maximum(end - begin, 0)
    count = span[:, 0] * span[:, 1]
    triangle = np.repeat(np.arange(len(corner)), count)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    column = begin[triangle] + np.stack([within // span[triangle, 1], within % span[triangle, 1]], axis=1)
    inside = np.ones(len(triangle), dtype=bool)
    bary = np.empty((len(triangle), 3))
    for k in range(3):
        a, b = flat[triangle, (k + 1) % 3], flat[triangle, (k + 2) % 3]
        swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
        a, b = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
        side = (b[:, 0] - a[:, 0]) * (column[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (column[:, 0] - a[:, 0])
        # A column exactly on an edge belongs to its left side, whichever triangle asks.
        left = np.where(side >= 0.0, 1.0, -1.0) * np.where(swap, -1.0, 1.0)
        inside &= left * normal_z[triangle] > 0.0
        bary[:, k] = np.where(swap, -side, side)
    triangle, column, bary = triangle[inside], column[inside], bary[inside]
    height = np.einsum("pk,pk->p", bary / bary.sum(axis=1, keepdims=True), corner[triangle, :, 2])
    key = column[:, 0] * fine[1] + column[:, 1]
    order = np.lexsort((height, key))
    key, height, column = key[order], height[order], column[order]
    # Going up, a downward facing triangle enters the object. Columns balance, so one running sum serves all.
    winding = np.cumsum(np.where(normal_z[triangle[order]] < 0.0, 1, -1))
    same = key[:-1] == key[1:]
    signed = float((winding[:-1] * np.diff(height))[same].sum() * width.prod())
    open_ = np.flatnonzero((winding[:-1] > 0) & same)
    bottom, top, column = height[open_], height[open_ + 1], column[open_]

    # Cut each chord at the cell borders.
    step = (upper[2] - lower[2]) / shape[2]
    k0 = np.clip(np.floor((bottom - lower[2]) / step), 0, shape[2] - 1).astype(np.int64)
    k1 = np.clip(np.floor((top - lower[2]) / step), 0, shape[2] - 1).astype(np.int64)
    count = k1 - k0 + 1
    chord = np.repeat(np.arange(len(bottom)), count)
    k = np.arange(len(chord)) - np.repeat(np.cumsum(count) - count, count) + k0[chord]
    low = np.maximum(bottom[chord], lower[2] + k * step)
    high = np.minimum(top[chord], lower[2] + (k + 1) * step)
    volume = np.maximum(high - low, 0.0) * width.prod()
    fine_xy = column[chord]
    index = np.ravel_multi_index((fine_xy[:, 0] // SUBDIVISION, fine_xy[:, 1] // SUBDIVISION, k), tuple(shape))
    position = np.column_stack([lower[:2] + (fine_xy + 0.5) * width, 0.5 * (low + high)])
    return *sum_by(index, volume, position, int(shape.prod())), signed
