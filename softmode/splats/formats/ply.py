"""INRIA `.ply` (read, write); compressed `.ply` files share the header and are handed on.

Reference:
    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023 (the layout of its code).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.files import open_file, whole_file
from softmode.splats.formats.common import (
    REEXPORT,
    exp_scales,
    sh_from_colors,
    sigmoid,
    sound_splats,
    unit_colors,
    unreadable,
)
from softmode.splats.formats.compressed_ply import decode_compressed
from softmode.splats.formats.ply_table import check_rows, read_header, read_tables
from softmode.splats.splats import Splats

COLORS = tuple(
    tuple(f"{prefix}{channel}" for channel in channels)
    for prefix, channels in (
        ("", ("red", "green", "blue")),
        ("diffuse_", ("red", "green", "blue")),
        ("", ("r", "g", "b")),
    )
)
"""Names of colours, in the order in which they are looked for."""
_KNOWN = ("x", "y", "z", "nx", "ny", "nz", "opacity", "filter_3D", *(n for names in COLORS for n in names), "alpha")
_FAMILIES = ("f_dc_", "f_rest_", "scale_", "rot_")


def read_ply(path: str | os.PathLike[str]) -> Splats:
    """Read an INRIA `.ply` (log scales, logit opacities, quaternions wxyz) or a PlayCanvas `.compressed.ply`.

    Text and both byte orders are read. What has scales and rotations is splats; colours are those of degree 0, else
    red, green and blue, as integers or floats. Discs with two scales (2D Gaussian splatting) get a third one, a
    thousandth of the smaller; the filter of Mip-Splatting, `filter_3D`, is applied. Other elements and properties are
    left out.

    Raises:
        AssetError: If the file is no splat `.ply`, contradicts its header, or holds no usable splats.
    """
    file_path = Path(path)
    with open_file(file_path, "splat file") as file:
        header = read_header(file, str(file_path))
        compressed = "chunk" in header.elements
        names = {name for name, _ in check_rows(header, "vertex", file_path).properties}
        if not compressed:
            _check_columns(names, str(file_path))
        used = ("chunk", "vertex", "sh") if compressed else ("vertex",)
        tables = read_tables(file, header, used, file_path)
    notes = header.unread(used)
    if compressed:
        return decode_compressed(tables["chunk"], tables["vertex"], tables.get("sh"), str(file_path), notes)
    return _decode(tables["vertex"], str(file_path), notes)


def columns_of(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[Any]:
    """Return columns side by side, shape (N, len(names)), of the type that holds all of them."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([table[name] for name in names], axis=1)


def colors_of(table: NDArray[Any]) -> tuple[NDArray[np.float64] | None, str]:
    """Return the colours 0..1 of a table, shape (N, 3), None where it has none, and what to say of them."""
    found = next((names for names in COLORS if set(names) <= set(table.dtype.names or ())), None)
    return (None, "") if found is None else unit_colors(columns_of(table, found))


def _decode(table: NDArray[Any], path: str, notes: list[str]) -> Splats:
    """Decode the vertex table of an INRIA `.ply`; f_rest is channel-major."""
    names = table.dtype.names or ()

    def family(prefix: str) -> NDArray[Any]:
        return columns_of(table, tuple(f"{prefix}{i}" for i in range(sum(name.startswith(prefix) for name in names))))

    if "f_dc_0" in names:
        sh = family("f_dc_").astype(np.float32)[:, None]
    else:
        colors, said = colors_of(table)
        if colors is None:
            colors, said = np.full((len(table), 3), 0.5), "has no colours: grey"
        notes += [said] if said else []
        sh = sh_from_colors(colors).astype(np.float32)
    if "f_rest_0" in names:
        rest = family("f_rest_").astype(np.float32).reshape(len(table), 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, rest[:, :24]], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        scales = exp_scales(family("scale_"))
        opacity = sigmoid(table["opacity"].astype(np.float64)) if "opacity" in names else np.ones(len(table))
        if "opacity" not in names:
            notes.append("has no opacities: opaque")
        if scales.shape[1] == 2:  # 2D Gaussian splatting stores discs; a thousandth keeps them solid and invertible
            scales = np.concatenate([scales, 1e-3 * scales.min(axis=1, keepdims=True)], axis=1)
        elif scales.shape[1] == 1:
            scales = np.repeat(scales, 3, axis=1)
        if "filter_3D" in names:
            notes.append("the filter of Mip-Splatting, filter_3D, is applied to scales and opacities")
            wider = np.sqrt(scales.astype(np.float64) ** 2 + table["filter_3D"].astype(np.float64)[:, None] ** 2)
            opacity, scales = opacity * (scales / wider).prod(axis=1), wider
    unread = [name for name in names if name not in _KNOWN and not name.startswith(_FAMILIES)]
    if unread:
        notes.append(f"properties that are not read: {', '.join(unread[:12])}")
    return sound_splats(
        f"splat file {path}",
        means=columns_of(table, ("x", "y", "z")),
        quats=columns_of(table, ("rot_1", "rot_2", "rot_3", "rot_0")),
        scales=scales,
        opacities=opacity,
        sh=sh,
        notes=notes,
    )


def _check_columns(names: set[str], path: str) -> None:
    """Raise an AssetError unless the vertex element has what splats need."""
    missing = [name for name in ("x", "y", "z", "scale_0", *(f"rot_{i}" for i in range(4))) if name not in names]
    if missing:
        raise unreadable(
            path,
            f"properties {', '.join(missing)} are missing",
            hint="Splats need scale and rot; name a point cloud or a mesh where an object is asked for, as in `load`",
        )
    for prefix, counts in (("f_dc_", (0, 3)), ("f_rest_", (0, 9, 24, 45, 72)), ("scale_", (1, 2, 3)), ("rot_", (4,))):
        found = {name for name in names if name.startswith(prefix)}
        if len(found) not in counts or found != {f"{prefix}{i}" for i in range(len(found))}:
            expected = f"{prefix}0.. of {', '.join(map(str, counts))}"
            raise unreadable(path, f"{len(found)} {prefix[:-1]} properties, expected {expected}", hint=REEXPORT)


def write_ply(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write an INRIA `.ply`; the file appears complete or not at all.

    Float32 throughout: nothing is lost but opacities beyond 1e-6..1-1e-6, which are stored as logits.

    Args:
        path: File to write; its folder must exist.
        splats: What to write, in its own frame.

    Raises:
        StorageError: If the file cannot be written.
    """
    opacity = np.clip(splats.opacities.astype(np.float64), 1e-6, 1.0 - 1e-6)
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, -1)
    named = {
        "x": splats.means[:, 0], "y": splats.means[:, 1], "z": splats.means[:, 2],
        "nx": 0.0, "ny": 0.0, "nz": 0.0,
        **{f"f_dc_{i}": splats.sh[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        "opacity": np.log(opacity / (1.0 - opacity)),
        **{f"scale_{i}": np.log(splats.scales[:, i]) for i in range(3)},
        **{f"rot_{i}": splats.quats[:, (i + 3) % 4] for i in range(4)},
    }  # fmt: skip
    table = np.empty(splats.count, dtype=[(name, "<f4") for name in named])
    for name, column in named.items():
        table[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {splats.count}"]
    header = "\n".join([*lines, *(f"property float {name}" for name in named), "end_header\n"])
    with whole_file(path, "splat file", make_folders=False) as file:
        file.write(header.encode("ascii"))
        file.write(table.tobytes())
