"""PlayCanvas `.compressed.ply` (read, write): chunks of 256 splats, quantised within the bounds of their chunk.

Positions and log scales take 11, 10 and 11 bits per axis, rotations 2 + 3 x 10 bits (the largest of w, x, y, z left
out), colour and opacity 4 x 8 bits: 16 bytes a splat, and one byte for every higher spherical-harmonic coefficient.

Reference:
    PlayCanvas, "The compressed PLY format" (PlayCanvas developer manual, Gaussian splatting, file formats).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.files import whole_file
from softmode.splats.formats.common import (
    exp_scales,
    quats_from_smallest_three,
    sh_from_colors,
    smallest_three_from_quats,
    sound_splats,
    to_unsigned,
    unreadable,
)
from softmode.splats.splats import SH_DC, Splats

_CHUNK = 256
_BOUNDS = [f"{side}_{axis}" for side in ("min", "max") for axis in "xyz"]
_SCALE_BOUNDS = [f"{side}_scale_{axis}" for side in ("min", "max") for axis in "xyz"]
_COLOR_BOUNDS = [f"{side}_{channel}" for side in ("min", "max") for channel in "rgb"]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def decode_compressed(
    chunk: NDArray[Any], vertex: NDArray[Any], sh: NDArray[Any] | None, path: str, notes: Sequence[str] = ()
) -> Splats:
    """Decode the tables of a compressed `.ply`.

    Args:
        chunk: One row of bounds per 256 splats: 12 columns, or 18 with bounds of the colour.
        vertex: Four packed integers per splat.
        sh: 9, 24 or 45 coefficients per splat as bytes, channel-major; None for degree 0.
        path: Name of the file, for messages.
        notes: What is to be said of the file.

    Raises:
        AssetError: If the tables do not belong together or hold no usable splats.
    """
    count = len(vertex)
    with_colors = "min_r" in (chunk.dtype.names or ())
    _require_columns(chunk, [*_BOUNDS, *_SCALE_BOUNDS, *(_COLOR_BOUNDS if with_colors else [])], "<f4", "chunk", path)
    _require_columns(vertex, _PACKED, "<u4", "vertex", path)
    if len(chunk) != -(-count // _CHUNK):
        raise unreadable(path, f"{len(chunk)} chunks for {count} splats of 256 each")
    row = np.arange(count) // _CHUNK

    def within(bounds: list[str], fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = (np.stack([chunk[name] for name in names], axis=1)[row] for names in (bounds[:3], bounds[3:]))
        with np.errstate(over="ignore", invalid="ignore"):
            return low.astype(np.float64) * (1.0 - fraction) + high * fraction

    rotation = vertex["packed_rotation"]
    others = (_fields(rotation, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2.0)
    wxyz = quats_from_smallest_three(rotation >> 30, others)
    color = _fields(vertex["packed_color"], (24, 8), (16, 8), (8, 8), (0, 8))
    rgb = within(_COLOR_BOUNDS, color[:, :3]) if with_colors else color[:, :3]
    coefficients = sh_from_colors(rgb)
    if sh is not None:
        names = [f"f_rest_{i}" for i in range(len(sh.dtype.names or ()))]
        if len(sh) != count or len(names) not in (9, 24, 45):
            raise unreadable(path, f"{len(sh)} rows of {len(names)} spherical harmonics for {count} splats")
        _require_columns(sh, names, "u1", "sh", path)
        first, coefficients = coefficients, np.empty((count, 1 + len(names) // 3, 3), dtype=np.float32)
        coefficients[:, 0] = first[:, 0]
        for k, name in enumerate(names):
            channel, order = divmod(k, len(names) // 3)
            coefficients[:, 1 + order, channel] = _SH_CODES[sh[name]]
    return sound_splats(
        f"splat file {path}",
        means=within(_BOUNDS, _fields(vertex["packed_position"], (21, 11), (11, 10), (0, 11))),
        quats=wxyz[:, [1, 2, 3, 0]],
        scales=exp_scales(within(_SCALE_BOUNDS, _fields(vertex["packed_scale"], (21, 11), (11, 10), (0, 11)))),
        opacities=color[:, 3],
        sh=coefficients,
        notes=notes,
    )


# A byte of a coefficient stands for the middle of its interval of [-4, 4], but for the ends, which are exact.
_SH_CODES = ((np.arange(256) + 0.5) / 256.0 - 0.5) * 8.0
_SH_CODES[[0, 255]] = -4.0, 4.0


def _require_columns(table: NDArray[Any], names: list[str], kind: str, element: str, path: str) -> None:
    """Raise an AssetError unless the table has exactly these columns, all of this type."""
    if sorted(table.dtype.names or ()) != sorted(names) or any(table.dtype[name] != np.dtype(kind) for name in names):
        raise unreadable(
            path,
            f"element {element!r} of a compressed .ply has unexpected properties",
            hint="Convert it with splat-transform to an ordinary .ply",
        )


def _fields(packed: NDArray[np.uint32], *fields: tuple[int, int]) -> NDArray[np.float64]:
    """Return bit fields (shift, bits) of packed integers as fractions 0..1, shape (N, number of fields)."""
    return np.stack([((packed >> shift) & ((1 << bits) - 1)) / ((1 << bits) - 1) for shift, bits in fields], axis=1)


def write_compressed_ply(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write a PlayCanvas `.compressed.ply`; the file appears complete or not at all.

    Splats keep their order. Positions and log scales are rounded to 1/2047 (y: 1/1023) and colours to 1/255 of the
    range in their chunk of 256 splats, rotations to 0.0014 in a component, higher coefficients to 1/32 within -4..4.

    Args:
        path: File to write; its folder must exist.
        splats: What to write, in its own frame.

    Raises:
        StorageError: If the file cannot be written.
    """
    starts = np.arange(0, splats.count, _CHUNK)
    row = np.arange(splats.count) // _CHUNK

    def bounded(values: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the bounds of every chunk, shape (chunks, 6), and the values as fractions of them."""
        values = values.astype(np.float32)
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        span = (high.astype(np.float64) - low)[row]
        fraction = (values - low[row].astype(np.float64)) / np.where(span > 0.0, span, 1.0)
        return np.concatenate([low, high], axis=1), fraction

    def pack(fractions: NDArray[Any], *bits: int) -> NDArray[np.uint32]:
        packed = np.zeros(splats.count, dtype=np.uint32)
        for column, width in enumerate(bits):
            packed = (packed << np.uint32(width)) | to_unsigned(fractions[:, column], width)
        return packed

    position_bounds, position = bounded(splats.means)
    scale_bounds, scale = bounded(np.log(splats.scales))
    color_bounds, color = bounded(0.5 + SH_DC * splats.sh[:, 0])
    largest, others = smallest_three_from_quats(splats.quats[:, [3, 0, 1, 2]])
    vertex = np.stack(
        [
            pack(position, 11, 10, 11),
            pack(others / np.sqrt(2.0) + 0.5, 10, 10, 10) | largest.astype(np.uint32) << np.uint32(30),
            pack(scale, 11, 10, 11),
            pack(np.column_stack([color, splats.opacities]), 8, 8, 8, 8),
        ],
        axis=1,
    )
    chunk = np.concatenate([position_bounds, scale_bounds, color_bounds], axis=1)
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, -1)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunk)}"]
    lines += [f"property float {name}" for name in [*_BOUNDS, *_SCALE_BOUNDS, *_COLOR_BOUNDS]]
    lines += [f"element vertex {splats.count}", *(f"property uint {name}" for name in _PACKED)]
    if rest.shape[1]:
        lines += [f"element sh {splats.count}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    with whole_file(path, "splat file", make_folders=False) as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        file.write(chunk.astype("<f4").tobytes())
        file.write(vertex.astype("<u4").tobytes())
        file.write(np.clip(np.floor((rest / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8).tobytes())
