"""Point clouds as splats: one flat disc per point, so that a sampled surface is shown and filled like a capture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.errors import AssetError
from softmode.files import damage_errors, open_file, read_arrays, read_file, require_content
from softmode.splats.formats.common import count_dropped, near_zero, offset_note, sh_from_colors, unit_colors
from softmode.splats.formats.ply import COLORS, colors_of, columns_of
from softmode.splats.formats.ply_table import check_rows, read_header, read_tables
from softmode.splats.mesh_samples import frames_of
from softmode.splats.splats import MAX_SPLATS, Splats, quats_from_rotations

GREY = 0.62
"""Colour of points that have none."""
_FAR = 1.0e15
"""Coordinates below it have squares and areas that float32 holds [m]."""
_BLOCK = 1 << 14
_PRIMES = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_POINTS_FREE = 12 << 20
_TEXT_LIMIT = 1 << 30
_NORMALS = ("nx", "ny", "nz")
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
        header = read_header(file, str(path))
    if "vertex" in header.elements and not header.elements["vertex"].count:
        raise AssetError(f"file {path}: holds no points", hint="Export the asset again")
    return header.kind


def read_points(path: str | os.PathLike[str]) -> Splats:
    """Read a point cloud: an .npz with `points` and, if there are any, `normals` and `colors`, a .ply, or a .xyz.

    Args:
        path: The file; positions keep its frame and unit. Colours are integers, or floats of 0..1 or 0..255.

    Raises:
        AssetError: If the file is missing, damaged, or holds no points.
    """
    file = Path(path)
    name = f"point cloud {file}"
    require_content(file, "point cloud")
    with damage_errors(name, hint=_HINT):
        if file.suffix.lower() == ".npz":
            wanted = ("points", "normals", "colors")
            arrays = read_arrays(file, wanted, what="point cloud", hint=_HINT, free=_POINTS_FREE)
            if "points" not in arrays:
                raise AssetError(f"{name}: holds no points", hint=_HINT)
            return splats_from_points(arrays["points"], arrays.get("normals"), arrays.get("colors"), name=name)
        found = _ply_points(file) if file.suffix.lower() == ".ply" else _text_points(file, name)
        return splats_from_points(found.points, found.normals, found.colors, name=name, notes=found.notes)


class _Cloud(NamedTuple):
    """What a file of points holds."""

    points: NDArray[Any]
    normals: NDArray[Any] | None
    colors: NDArray[Any] | None
    notes: list[str]


def _ply_points(file: Path) -> _Cloud:
    """Read the points of a .ply."""
    with open_file(file, "point cloud") as stream:
        header = read_header(stream, str(file))
        check_rows(header, "vertex", file)
        table = read_tables(stream, header, ["vertex"], file)["vertex"]
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise AssetError(f"point cloud {file}: vertices without x, y and z", hint=_HINT)
    normals = columns_of(table, _NORMALS) if set(_NORMALS) <= set(names) else None
    colors, said = colors_of(table)
    used = {"x", "y", "z", *_NORMALS, "alpha", "a", *(name for names in COLORS for name in names)}
    unread = [name for name in names if name not in used]
    notes = header.unread(("vertex",)) + ([said] if said else [])
    notes += [f"properties that are not read: {', '.join(unread[:12])}"] if unread else []
    if normals is not None and not np.any(normals):
        normals = None
    return _Cloud(columns_of(table, ("x", "y", "z")), normals, colors, notes)


def _text_points(file: Path, name: str) -> _Cloud:
    """Read the points of a .xyz: x y z, then normals, colours or both; what precedes the numbers is a header."""
    text = read_file(file, "point cloud", limit=_TEXT_LIMIT).decode("utf-8", "replace")
    lines = [line.split() for line in text.translate(str.maketrans(",;\t", "   ")).splitlines()]
    rows = [line for line in lines if line and not line[0].startswith(("#", "//"))]
    first = next((i for i, row in enumerate(rows) if len(row) > 2 and _is_number(row[0])), len(rows))
    notes = [f"header: {' '.join(word for row in rows[:first] for word in row)[:120]}"] if first else []
    width = min((len(row) for row in rows[first:]), default=0)
    if width < 3:
        raise AssetError(f"{name}: has lines of fewer than three numbers", hint="Give x y z in every line")
    table = np.array([row[:width] for row in rows[first:]], dtype=np.float64)
    extra, normals, colors = table[:, 3:], None, None
    if extra.shape[1] >= 3 and np.allclose(np.linalg.norm(extra[:, :3], axis=1), 1.0, atol=0.02):
        normals, extra = extra[:, :3], extra[:, 3:]
    if extra.shape[1] == 4:  # an intensity before the colours, as scanners write
        notes.append("the number before the colours is not read")
        extra = extra[:, 1:]
    if extra.shape[1] >= 3:
        colors, extra = extra[:, :3], extra[:, 3:]
        if colors.max() > 1.0 and (colors == np.round(colors)).all():  # bytes, written as text
            colors = colors.astype(np.int64)
    if extra.shape[1]:
        notes.append(f"{extra.shape[1]} more numbers in each line are not read")
    return _Cloud(table[:, :3], normals, colors, notes)


def _is_number(word: str) -> bool:
    """Return whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def splats_from_points(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    name: str = "points",
    notes: Sequence[str] = (),
) -> Splats:
    """Return one flat, opaque splat for each point, as wide as the points are apart.

    Args:
        points: Positions on a surface [m], shape (N, 3), N >= 4.
        normals: Normals, of either sign and any length, shape (N, 3); from the twelve nearest points if None.
        colors: Colours, integers, or floats of 0..1 or 0..255, shape (N, 3); grey if None.
        name: Where they come from; used in messages.
        notes: What is to be said beside.

    Points that are not finite are dropped and counted; those far from zero are counted from an offset on, in float64.

    Raises:
        AssetError: If an array has another shape, or all points lie at one place.
    """
    x = _array(f"{name}: points", points, None)
    told = list(notes)
    normals = None if normals is None else _array(f"{name}: normals", normals, len(x))
    colors = None if colors is None else np.asarray(colors)
    with np.errstate(invalid="ignore"):
        good = (np.abs(x) < _FAR).all(axis=1)
        good &= True if normals is None else (np.abs(normals) < _FAR).all(axis=1)
    if len(x) and not good.all():
        told += count_dropped(name, {"not finite": good}, "points")
        colors = colors if colors is None or len(colors) != len(x) else colors[good]
        x, normals = x[good], None if normals is None else normals[good]
    x, offset = near_zero(x)
    told += offset_note(offset)
    if not 4 <= len(x) <= MAX_SPLATS:
        raise AssetError(f"{name}: {len(x)} points, expected 4 to {MAX_SPLATS}", hint=_HINT)
    first, back = distinct(x)
    places = x if len(first) == len(x) else x[first]
    if not len(x) // 7 < len(places) >= 4:
        raise AssetError(f"{name}: most points coincide", hint="Remove repeated points")
    given = None if normals is None else normals[first]
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
        _array(f"{name}: colors", colors, len(x))
        shade, said = unit_colors(np.where(np.isfinite(colors), colors, 0.0) if colors.dtype.kind == "f" else colors)
        told += [said] if said else []
    sh = sh_from_colors(shade).astype(np.float32)
    arrays = {
        "means": x.astype(np.float32),
        "quats": quats[back],
        "scales": np.stack([(pitch * width).astype(np.float32) for width in (0.6, 0.6, 0.05)], axis=1),
        "opacities": np.full(len(x), 0.95, np.float32),
        "sh": np.broadcast_to(sh, (len(x), 1, 3)),
    }
    del x, places, tree, given, shade, pitch  # splats take as much again while they are checked
    return Splats(**arrays, name=name, offset=offset, notes=tuple(told))


def _frames(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return orthogonal frames (N, 3, 3) whose last column is the normal."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return frames_of(np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0]))


def _array(name: str, value: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Return an array (N, 3)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise AssetError(f"{name}: no array of numbers", hint=_HINT) from error
    if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
        raise AssetError(f"{name}: expected shape ({count or 'N'}, 3), got {array.shape}", hint=_HINT)
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
