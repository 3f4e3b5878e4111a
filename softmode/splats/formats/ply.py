"""INRIA `.ply` (read, write); compressed `.ply` files share the header and are handed on.

Reference:
    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023 (the layout of its code).
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.files import open_file, whole_file
from softmode.splats.formats.common import check_count, exp_scales, read_exactly, sigmoid, unreadable
from softmode.splats.formats.compressed_ply import decode_compressed
from softmode.splats.splats import Splats

_HEADER_LIMIT = 64 * 1024

_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_PLY_COLUMNS = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3".split()


@dataclass(frozen=True, kw_only=True)
class _Element:
    """One element of a PLY header: a table of `count` rows."""

    name: str
    count: int
    properties: list[tuple[str, str]]

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.properties)

    @property
    def size(self) -> int:
        return self.count * self.dtype.itemsize


def read_ply(path: str | os.PathLike[str]) -> Splats:
    """Read an INRIA `.ply` (log scales, logit opacities, quaternions wxyz) or a PlayCanvas `.compressed.ply`.

    Disc splats with two scales (2D Gaussian splatting) get a third one, a thousandth of the smaller.

    Raises:
        AssetError: If the file is no splat `.ply`, contradicts its header, or holds no usable splats.
    """
    file_path = Path(path)
    with open_file(file_path, "splat file") as file:
        elements, offset = _parse_header(file.read(_HEADER_LIMIT), str(file_path))
        names = [element.name for element in elements]
        if names not in (["vertex"], ["chunk", "vertex"], ["chunk", "vertex", "sh"]):
            raise unreadable(
                file_path,
                f"elements {names[:8]}, expected 'vertex', or 'chunk', 'vertex' and 'sh'",
                hint="Only splat .ply files can be read; sample a mesh with `softmode splat from-mesh`",
            )
        vertex = elements[names.index("vertex")]
        check_count(vertex.count, str(file_path))
        if len(elements) == 1:
            _check_columns(vertex, str(file_path))
        declared, size = offset + sum(element.size for element in elements), os.fstat(file.fileno()).st_size
        if size != declared:
            raise unreadable(
                file_path, f"header declares {vertex.count} splats and {declared} bytes, the file holds {size}"
            )
        file.seek(offset)
        tables = {
            element.name: np.frombuffer(read_exactly(file, element.size, file_path), dtype=element.dtype)
            for element in elements
        }
    if len(elements) > 1:
        return decode_compressed(tables["chunk"], tables["vertex"], tables.get("sh"), str(file_path))
    return _decode(tables["vertex"], str(file_path))


def _decode(table: NDArray[Any], path: str) -> Splats:
    """Decode the vertex table of an INRIA `.ply`; f_rest is channel-major."""

    def columns(*names: str) -> NDArray[np.float32]:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.stack([table[name] for name in names], axis=1).astype(np.float32)

    names = table.dtype.names or ()
    rest_count = sum(name.startswith("f_rest_") for name in names)
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest_count:
        rest = columns(*(f"f_rest_{i}" for i in range(rest_count)))
        sh = np.concatenate([sh, rest.reshape(len(table), 3, -1).transpose(0, 2, 1)], axis=1)
    scales = exp_scales(columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in names)))
    if scales.shape[1] == 2:  # 2D Gaussian splatting stores discs; a thousandth keeps them solid and invertible
        scales = np.concatenate([scales, 1e-3 * scales.min(axis=1, keepdims=True)], axis=1)
    return Splats(
        means=columns("x", "y", "z"),
        quats=columns("rot_1", "rot_2", "rot_3", "rot_0"),
        scales=scales,
        opacities=sigmoid(table["opacity"].astype(np.float64)),
        sh=sh,
        name=f"splat file {path}",
    )


def _parse_header(head: bytes, name: str) -> tuple[list[_Element], int]:
    """Return the elements and the offset of the data."""
    match = re.search(rb"(?:^|\n)end_header\r?\n", head)
    if not head.startswith(b"ply") or match is None:
        raise unreadable(name, f"no PLY header within {_HEADER_LIMIT} bytes")
    elements: list[_Element] = []
    form = ""
    for line in head[: match.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 12:
            elements.append(_Element(name=words[1], count=int(words[2]), properties=[]))
        elif words[0] == "property" and len(words) == 3 and words[1] in _PLY_TYPES and elements:
            if any(words[2] == known for known, _ in elements[-1].properties):
                raise unreadable(name, f"property {words[2][:80]} is declared twice")
            elements[-1].properties.append((words[2], _PLY_TYPES[words[1]]))
        else:
            raise unreadable(
                name,
                f"unreadable header line {line[:80]!r}",
                hint="Splat files hold scalar properties only; a mesh .ply is no splat file",
            )
    if form != "binary_little_endian":
        raise unreadable(name, f"format {form or 'missing'!r}, expected binary_little_endian", hint="Export as binary")
    return elements, match.end()


def _check_columns(vertex: _Element, name: str) -> None:
    """Raise an AssetError unless the vertex element has the columns of an INRIA `.ply`."""
    names = {field for field, _ in vertex.properties}
    missing = [field for field in _PLY_COLUMNS if field not in names]
    if missing:
        raise unreadable(
            name,
            f"properties {', '.join(missing)} are missing",
            hint="Only splat .ply files (f_dc, opacity, scale, rot) can be read; a point cloud or a mesh is none",
        )
    rest = {field for field in names if field.startswith("f_rest_")}
    if len(rest) not in (0, 9, 24, 45) or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        raise unreadable(name, f"{len(rest)} f_rest properties, expected f_rest_0.. of 0, 9, 24 or 45")


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
