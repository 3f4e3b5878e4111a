"""Point clouds as splats: one flat disc per point, so that a sampled surface is shown and filled like a capture."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.errors import AssetError
from softmode.files import open_file, read_arrays, require_content
from softmode.foreign import process
from softmode.splats.formats.common import sh_from_colors
from softmode.splats.mesh_samples import frames_of
from softmode.splats.splats import MAX_SPLATS, Splats, quats_from_rotations

GREY = 0.62
"""Colour of points that have none."""
_FAR = 1.0e15
"""Coordinates below it have squares and areas that float32 holds [m]."""
_BLOCK = 1 << 14
_PRIMES = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_POINTS_FREE = 12 << 20
_HINT = "Give an .npz with points (N, 3), and normals and colors (N, 3) if there are any"


def is_point_cloud(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a point cloud: an .npz or .xyz, or a .ply without faces and without splats."""
    file = Path(path)
    if file.suffix.lower() in (".npz", ".xyz"):
        return True
    return file.suffix.lower() == ".ply" and ply_kind(file) == "points"


def ply_kind(path: str | os.PathLike[str]) -> str:
    """Return what a .ply holds by its header: "splats", "mesh" or "points".

    Raises:
        AssetError: If the file is missing, cannot be read, holds nothing, or is no .ply.
    """
    require_content(Path(path), "file")
    with open_file(path) as file:
        head = file.read(64 * 1024).split(b"end_header")[0]
    words = [line.split() for line in head.splitlines()]
    if [b"element", b"vertex", b"0"] in words:
        raise AssetError(f"file {path}: holds no points", hint="Export the asset again")
    names = {line[-1] for line in words if line[:1] == [b"property"]}
    if b"f_dc_0" in names or b"packed_position" in names:
        return "splats"
    faces = [line for line in words if line[:2] == [b"element", b"face"] and len(line) == 3]
    return "mesh" if any(line[2] != b"0" for line in faces) else "points"


def read_points(path: str | os.PathLike[str]) -> Splats:
    """Read a point cloud: an .npz with `points` and, if there are any, `normals` and `colors`, a .ply, or a .xyz.

    Args:
        path: The file; positions keep its frame and unit. Colours are 0..1, or integers 0..255.

    Raises:
        AssetError: If the file is missing, damaged, or holds no points.
    """
    file = Path(path)
    name = f"point cloud {file}"
    require_content(file, "point cloud")
    if file.suffix.lower() == ".npz":
        arrays = read_arrays(file, ("points", "normals", "colors"), what="point cloud", hint=_HINT, free=_POINTS_FREE)
        if "points" not in arrays:
            raise AssetError(f"{name}: holds no points", hint=_HINT)
        return splats_from_points(arrays["points"], arrays.get("normals"), arrays.get("colors"), name=name)
    points, *colors = process.read("mesh", file, name=name, want="points").arrays
    return splats_from_points(points, None, *colors, name=name)


def splats_from_points(
    points: ArrayLike, normals: ArrayLike | None = None, colors: ArrayLike | None = None, *, name: str = "points"
) -> Splats:
    """Return one flat, opaque splat for each point, as wide as the points are apart.

    Args:
        points: Positions on a surface [m], shape (N, 3), N >= 4.
        normals: Normals, of either sign and any length, shape (N, 3); from the twelve nearest points if None.
        colors: Colours 0..1, or integers 0..255, shape (N, 3); grey if None.
        name: Where they come from; used in messages.

    Raises:
        AssetError: If an array has another shape, is not finite, or all points lie at one place.
    """
    x = _array(f"{name}: points", points, None)
    if not 4 <= len(x) <= MAX_SPLATS:
        raise AssetError(f"{name}: {len(x)} points, expected 4 to {MAX_SPLATS}", hint=_HINT)
    first, back = distinct(x)
    places = x if len(first) == len(x) else x[first]
    if not len(x) // 7 < len(places) >= 4:
        raise AssetError(f"{name}: most points coincide", hint="Remove repeated points")
    given = None if normals is None else _array(f"{name}: normals", normals, len(x))[first]
    tree, count = KDTree(places), min(7 if normals is not None else 12, len(places))
    pitch, quats = np.empty(len(places)), np.empty((len(places), 4), dtype=np.float32)
    for start in range(0, len(places), _BLOCK):  # what the neighbours of a point take is many times the point
        part = slice(start, start + _BLOCK)
        away, index = tree.query(places[part], k=count)
        pitch[part] = away[:, : min(7, count)][:, -1] / 1.5  # the sixth neighbour is one and a half spacings away
        if given is None:
            near = places[index] - places[index].mean(axis=1, keepdims=True)
            frame = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, ::-1]
        else:
            frame = _frames(given[part])
        quats[part] = quats_from_rotations(frame * np.sign(np.linalg.det(frame))[:, None, None])
    typical = float(np.median(pitch))
    pitch = np.clip(pitch, 0.5 * typical, 2.0 * typical)[back]
    shade = np.full((1, 3), GREY)
    if colors is not None:
        shade = _array(f"{name}: colors", colors, len(x))
        if np.issubdtype(np.asarray(colors).dtype, np.integer):
            shade = shade / 255.0
    sh = sh_from_colors(np.clip(shade, 0.0, 1.0)).astype(np.float32)
    arrays = {
        "means": x.astype(np.float32),
        "quats": quats[back],
        "scales": np.stack([(pitch * width).astype(np.float32) for width in (0.6, 0.6, 0.05)], axis=1),
        "opacities": np.full(len(x), 0.95, np.float32),
        "sh": np.broadcast_to(sh, (len(x), 1, 3)),
    }
    del x, places, tree, given, shade, pitch  # splats take as much again while they are checked
    return Splats(**arrays, name=name)


def _frames(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return orthogonal frames (N, 3, 3) whose last column is the normal."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return frames_of(np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0]))


def _array(name: str, value: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Return a finite array (N, 3)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise AssetError(f"{name}: no array of numbers", hint=_HINT) from error
    if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
        raise AssetError(f"{name}: expected shape ({count or 'N'}, 3), got {array.shape}", hint=_HINT)
    if array.size and not np.abs(array).max() < _FAR:
        raise AssetError(f"{name}: not all finite", hint=f"Remove what is NaN, infinite or beyond {_FAR:g}")
    return array


def distinct(points: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first point at each place, shape (M,), and which place each point has, shape (N,).

    A tree does not tell points at one place apart: asked for neighbours it looks at all of them, for each of them.
    """
    x, y, z = ((points + 0.0).view(np.uint64) * _PRIMES).T  # places are told apart by 64 mixed bits
    _, first, back = np.unique(
        x ^ (y >> np.uint64(21)) ^ (z >> np.uint64(42)) ^ y ^ z, return_index=True, return_inverse=True
    )
    if len(first) == len(points):
        first = back = np.arange(len(points))
    return first, back
