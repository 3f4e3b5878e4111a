"""Shapes of deformables as triangle meshes, and transforms split into a stretch and a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import AssetError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SIMILAR = 1.0e-9
"""Relative deviation up to which a transform is a rotation with one scale: what rounding makes of one."""
_MIRROR = np.diag([-1.0, 1.0, 1.0])
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Faces of a tetrahedron of positive volume, counter-clockwise seen from outside."""
_GREY = (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh."""

    vertices: Array
    """Positions [m], shape (V, 3)."""
    faces: Indices
    """Vertex indices, counter-clockwise seen from outside, shape (T, 3)."""
    colors: Array
    """Colours 0..1 (linear, as `primvars:displayColor` is) of the corners of each triangle, shape (T, 3, 3)."""
    uvs: Array
    """Texture coordinates of the corners, shape (T, 3, 2)."""
    picture: Indices
    """Which of `pictures` each triangle shows, -1 for none, shape (T,)."""
    pictures: tuple[NDArray[np.uint8], ...] = ()
    """Textures, first row at v = 1, each of shape (height, width, 3)."""
    notes: tuple[str, ...] = ()
    """What of its look was not read."""


def split_transform(matrix: ArrayLike, where: str) -> tuple[Array, Array]:
    """Split the linear part L = R S of a transform into a rotation R (3, 3) and what is baked into the shape, S (3, 3).

    S is symmetric (polar decomposition), s I to the bit where L is a rotation with one scale, and mirrors x first where
    L mirrors.

    Args:
        matrix: Transform, column vectors, shape (4, 4).
        where: Named by errors.

    Raises:
        AssetError: If the transform is singular or not finite.
    """
    transform = np.asarray(matrix, dtype=np.float64)
    linear = transform[:3, :3]
    if not (np.isfinite(transform).all() and np.abs(transform[3] - [0, 0, 0, 1]).max() == 0.0):
        raise AssetError(f"{where}: its transform is not finite and affine", hint="Mend its xformOps")
    left, size, right = np.linalg.svd(linear)
    if not size[2] > 1e-9 * size[0]:
        raise AssetError(f"{where}: its transform is singular", hint="Give the prim scales other than zero")
    mirrored = np.linalg.det(linear) < 0.0
    if mirrored:
        left, size, right = np.linalg.svd(linear @ _MIRROR)
    rotation: Array = np.asarray(left @ right, dtype=np.float64)
    if size[0] - size[2] <= _SIMILAR * size[0]:
        scale = float(np.round(size.mean(), 12))
        stretch = (scale if scale > 0.0 else float(size.mean())) * np.eye(3)
    else:
        stretch = right.T @ np.diag(size) @ right
    whole = np.round(rotation)
    if np.abs(rotation - whole).max() < 1e-14:  # a turn onto axes has no rounding
        rotation = np.asarray(whole, dtype=np.float64)
    return rotation, stretch @ _MIRROR if mirrored else stretch


def mesh_surface(parts: dict[str, Any], linear: Array, where: str, offset: ArrayLike = (0.0, 0.0, 0.0)) -> SurfaceMesh:
    """Return the triangles of a polygon mesh under an affine map; faces that mirror keep facing outwards.

    Args:
        parts: Its `points` (V, 3), `counts`, `indices`, `left_handed` and `look`, as authored.
        linear: Matrix of the map, shape (3, 3).
        where: Named by errors.
        offset: Translation of the map [m].

    Raises:
        AssetError: If it has no faces, indices point nowhere, or positions are not finite.
    """
    points = finite_points(parts, where)
    counts, indices = (np.asarray(parts.get(name, ()), dtype=np.int64) for name in ("counts", "indices"))
    if not len(counts) or counts.min() < 0 or counts.sum() != len(indices):
        raise AssetError(
            f"{where}: {len(counts)} face counts for {len(indices)} indices", hint="Export the mesh with its faces"
        )
    if indices.min() < 0 or indices.max() >= len(points):
        raise AssetError(
            f"{where}: indices {indices.min()}..{indices.max()} for {len(points)} points", hint="Export the mesh again"
        )
    start = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), fans)
    corner = np.arange(len(face)) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    slots = np.stack([start[face], start[face] + corner, start[face] + corner + 1], axis=1)
    if parts["left_handed"] != (np.linalg.det(linear) < 0.0):
        slots = slots[:, ::-1]
    moved = points @ linear.T + np.asarray(offset, dtype=np.float64)
    triangles = indices[slots]
    return SurfaceMesh(moved, triangles, **_look(parts, triangles, face, slots, len(points)))


def tet_surface(parts: dict[str, Any], linear: Array, where: str, offset: ArrayLike = (0.0, 0.0, 0.0)) -> SurfaceMesh:
    """Return the boundary of a tetrahedral mesh under a linear map: the faces that one tetrahedron alone has.

    Args:
        parts: Its `points` (V, 3), `tets` (T, 4), `left_handed` and `look`, as authored.
        linear: Matrix of the map, shape (3, 3).
        where: Named by errors.
        offset: Translation of the map [m].

    Raises:
        AssetError: If it has no tetrahedra, indices point nowhere, or positions are not finite.
    """
    points = finite_points(parts, where) @ linear.T + np.asarray(offset, dtype=np.float64)
    tets = np.asarray(parts.get("tets", np.zeros((0, 4))), dtype=np.int64).reshape(-1, 4)
    if not len(tets) or tets.min() < 0 or tets.max() >= len(points):
        raise AssetError(f"{where}: tetVertexIndices do not fit {len(points)} points", hint="Export the mesh again")
    corner = points[tets]
    edges = corner[:, 1:] - corner[:, :1]
    volume = np.einsum("ti,ti->t", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2])
    tets = np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)
    faces = tets[:, _FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = np.sort(first[count == 1])
    boundary = faces[outer]
    kept, renumbered = np.unique(boundary, return_inverse=True)
    look = _look(parts, boundary, outer // 4, 3 * outer[:, None] + np.arange(3), len(points))
    return SurfaceMesh(points[kept], renumbered.reshape(-1, 3).astype(np.int64), **look)


def finite_points(parts: dict[str, Any], where: str) -> Array:
    """Return the positions (V, 3) of a geometry, all finite; raise AssetError otherwise."""
    points = parts["points"]
    if not len(points):
        raise AssetError(f"{where}: has no points", hint="Export it with its points")
    lost = int((~np.isfinite(points).all(axis=1)).sum())
    if lost:
        raise AssetError(f"{where}: {lost} of {len(points)} points are NaN or infinite", hint="Export it again")
    return points


def _look(parts: dict[str, Any], corners: Indices, face: Indices, slots: Indices, count: int) -> dict[str, Any]:
    """Return the fields of a `SurfaceMesh` that say how it looks.

    Args:
        parts: What `look` says, as authored: `colors`, `materials` (the first for all, others for faces), `notes`.
        corners: Vertex of each corner, shape (T, 3).
        face: Authored face of each triangle, shape (T,).
        slots: Where faceVarying values have those of each corner, shape (T, 3).
        count: Number of vertices.
    """
    look = parts.get("look", {})
    notes = list(look.get("notes", ()))

    def spread(given: dict[str, Any] | None, width: int) -> Array | None:
        """Return the values of a primvar at each corner, shape (T, 3, width)."""
        if given is None:
            return None
        values = np.asarray(given["values"], dtype=np.float64)
        kind, size = given["interpolation"], len(values)
        fits = values.ndim == 2 and values.shape[1] == width and bool(np.isfinite(values).all())
        if fits and (kind == "constant" or size == 1):
            return np.broadcast_to(values[0], (*corners.shape, width))
        if fits and kind == "uniform" and face.max(initial=-1) < size:
            return np.broadcast_to(values[face][:, None], (*corners.shape, width))
        if fits and kind in ("vertex", "varying") and size == count:
            return values[corners]
        if fits and kind == "faceVarying" and slots.max(initial=-1) < size:
            return values[slots]
        notes.append(f"primvar {given['name']} is not read: {size} values of interpolation {kind}")
        return None

    shown = spread(look.get("colors"), 3)
    colors = np.array(np.broadcast_to(_GREY, (*corners.shape, 3)) if shown is None else shown)
    uvs, picture, pictures = np.zeros((*corners.shape, 2)), np.full(len(corners), -1), []
    for one in look.get("materials", ()):
        here = np.ones(len(corners), bool) if one["faces"] is None else np.isin(face, one["faces"])
        if "texture" in one:
            at = spread(one["uvs"], 2)
            if at is None:
                notes.append("a texture is not shown: its coordinates are missing")
                continue
            uvs[here], colors[here], picture[here] = at[here], 1.0, len(pictures)
            pictures.append(one["texture"])
        else:
            color = one["color"] if "color" in one else spread(one["primvar"], 3)
            if color is not None:
                colors[here], picture[here] = np.broadcast_to(color, colors.shape)[here], -1
    colors = np.clip(colors, 0.0, 1.0)
    told = tuple(dict.fromkeys(f"{parts['path']}: {note}" for note in notes))
    return {"colors": colors, "uvs": uvs, "picture": picture, "pictures": tuple(pictures), "notes": told}
