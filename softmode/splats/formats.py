"""Splat files: INRIA `.ply` (read, write) and SOG version 2 (read: folder, `meta.json` or `.sog` archive).

Readers return the asset as it is stored, in the asset's own frame and unit. Trained assets mostly keep the OpenCV-like
frame of their training cameras (x right, y down, z forward), so `splats.oriented("-y")` sets them upright; assets made
with modelling tools may need `"+y"`. Both readers are bounded: declared sizes are compared with the file before
anything is allocated.

References:
    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023 (the `.ply` layout of its code).
    PlayCanvas, "The SOG format", version 2.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from softmode.atomic import atomic_write
from softmode.errors import AssetError
from softmode.splats.splats import MAX_SPLATS, Splats

_HEADER_LIMIT = 64 * 1024
_META_LIMIT = 16 * 1024 * 1024
_IMAGE_FILE_LIMIT = 512 * 1024 * 1024
_REEXPORT = "The file is damaged or incomplete: copy or export it again"

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


def read_splats(path: str | os.PathLike[str]) -> Splats:
    """Read a splat file.

    Args:
        path: An INRIA `.ply`, a SOG v2 folder, its `meta.json`, or a `.sog` archive.

    Raises:
        AssetError: If the file is missing, of another kind, truncated, damaged, or holds no usable splats.
    """
    file = Path(path)
    with _typed_errors(str(file)):
        if file.is_dir():
            if not (file / "meta.json").is_file():
                raise AssetError(
                    f"splat folder {file}: no meta.json in it", hint="Name a SOG v2 folder, or a .ply or .sog file"
                )
            return _read_sog(str(file), _folder_reader(file))
        if not file.exists():
            raise AssetError(f"splat file {file}: no such file", hint="Check the path")
        suffix = file.suffix.lower()
        if suffix == ".ply":
            return _read_ply(file)
        if suffix == ".json":
            return _read_sog(str(file), _folder_reader(file.parent, file.name))
        if suffix == ".sog":
            with zipfile.ZipFile(file) as archive:
                return _read_sog(str(file), _archive_reader(archive, str(file)))
        raise AssetError(
            f"splat file {file}: unknown kind {suffix or '(no suffix)'!r}",
            hint="Readable are INRIA .ply, SOG v2 (meta.json, .sog); convert others with SuperSplat or splat-transform",
        )


@contextlib.contextmanager
def _typed_errors(name: str):
    """Turn what the file system and the decoders raise on damaged input into AssetError."""
    try:
        yield
    except AssetError:
        raise
    except (
        OSError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        NotImplementedError,
        RuntimeError,
        SyntaxError,
    ) as error:
        raise AssetError(f"splat file {name}: cannot be read ({error})", hint=_REEXPORT) from error
    except (ValueError, OverflowError, MemoryError, Image.DecompressionBombError) as error:
        raise AssetError(f"splat file {name}: holds invalid data ({error})", hint=_REEXPORT) from error


def _read_ply(path: Path) -> Splats:
    """Read an INRIA `.ply`: log scales, logit opacities, quaternions wxyz, channel-major f_rest."""
    with open(path, "rb") as file:
        head = file.read(_HEADER_LIMIT)
        dtype, count, offset = _parse_ply_header(head, str(path))
        size = os.fstat(file.fileno()).st_size
        if size != offset + count * dtype.itemsize:
            raise AssetError(
                f"splat file {path}: header declares {count} splats of {dtype.itemsize} bytes, "
                f"{offset + count * dtype.itemsize} bytes with the header, the file holds {size}",
                hint=_REEXPORT,
            )
        file.seek(offset)
        table = np.frombuffer(file.read(count * dtype.itemsize), dtype=dtype)
    if len(table) != count:
        raise AssetError(f"splat file {path}: shrank while it was read", hint="Read it again when nothing writes to it")

    def columns(*names: str) -> NDArray[np.float32]:
        return np.stack([table[name] for name in names], axis=1).astype(np.float32)

    names = dtype.names or ()
    rest_count = sum(name.startswith("f_rest_") for name in names)
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest_count:
        rest = columns(*(f"f_rest_{i}" for i in range(rest_count)))
        sh = np.concatenate([sh, rest.reshape(count, 3, -1).transpose(0, 2, 1)], axis=1)
    scales = _exp_scales(columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in names)))
    if scales.shape[1] == 2:  # 2D Gaussian splatting stores discs; a thousandth keeps them solid and invertible
        scales = np.concatenate([scales, 1e-3 * scales.min(axis=1, keepdims=True)], axis=1)
    return Splats(
        means=columns("x", "y", "z"),
        quats=columns("rot_1", "rot_2", "rot_3", "rot_0"),
        scales=scales,
        opacities=_sigmoid(table["opacity"].astype(np.float64)),
        sh=sh,
        name=f"splat file {path}",
    )


def _exp_scales(log_scales: NDArray[Any]) -> NDArray[np.float32]:
    """Return exp(log_scales), kept above float32 underflow; NaN and infinity pass through, `Splats` refuses them."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.exp(np.where(log_scales < -40.0, np.where(np.isinf(log_scales), np.nan, -40.0), log_scales)).astype(
            np.float32
        )


def _sigmoid(logits: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return 1 / (1 + exp(-x)), NaN preserved."""
    return (1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0)))).astype(np.float32)


def _parse_ply_header(head: bytes, name: str) -> tuple[np.dtype[Any], int, int]:
    """Return the vertex dtype, the vertex count and the offset of the data."""
    match = re.search(rb"(?:^|\n)end_header\r?\n", head)
    if not head.startswith(b"ply") or match is None:
        raise AssetError(f"splat file {name}: no PLY header within {_HEADER_LIMIT} bytes", hint=_REEXPORT)
    properties: list[tuple[str, str]] = []
    elements: list[tuple[str, int]] = []
    form = ""
    for line in head[: match.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 12:
            elements.append((words[1], int(words[2])))
        elif words[0] == "property" and len(words) == 3 and words[1] in _PLY_TYPES and elements:
            properties.append((words[2], _PLY_TYPES[words[1]]))
        else:
            raise AssetError(
                f"splat file {name}: unreadable header line {line[:80]!r}",
                hint="Splat files hold scalar properties only; a mesh .ply is no splat file",
            )
    if form != "binary_little_endian":
        raise AssetError(
            f"splat file {name}: format {form or 'missing'!r}, expected binary_little_endian", hint="Export as binary"
        )
    if [element for element, _ in elements] != ["vertex"]:
        raise AssetError(
            f"splat file {name}: elements {[element for element, _ in elements]}, expected one element 'vertex'",
            hint="Convert compressed or mesh .ply files to an ordinary splat .ply with SuperSplat or splat-transform",
        )
    names = [field for field, _ in properties]
    missing = [field for field in _PLY_COLUMNS if field not in names]
    if missing or len(set(names)) != len(names):
        raise AssetError(
            f"splat file {name}: "
            + (f"properties {', '.join(missing)} are missing" if missing else "a property is declared twice"),
            hint="Only splat .ply files (f_dc, opacity, scale, rot) can be read; a point cloud or a mesh is none",
        )
    rest = {field for field in names if field.startswith("f_rest_")}
    if len(rest) not in (0, 9, 24, 45) or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        raise AssetError(
            f"splat file {name}: {len(rest)} f_rest properties, expected f_rest_0.. of 0, 9, 24 or 45", hint=_REEXPORT
        )
    count = elements[0][1]
    if not 0 < count <= MAX_SPLATS:
        raise AssetError(
            f"splat file {name}: {count} splats, expected 1 to {MAX_SPLATS}", hint="Export the asset again, decimated"
        )
    return np.dtype(properties), count, match.end()


def write_ply(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write an INRIA `.ply`; the file appears complete or not at all.

    Opacities are stored as logits, clipped to 1e-6..1-1e-6.

    Raises:
        AssetError: If the file cannot be written.
    """
    target = Path(path)
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
    try:
        with atomic_write(target) as file:
            file.write(header.encode("ascii"))
            file.write(table.tobytes())
    except OSError as error:
        raise AssetError(
            f"splat file {target}: cannot be written ({error})", hint="Check the folder and its permissions"
        ) from error


_Reader = Callable[[str, int], bytes]
"""Return the bytes of a named member, refusing more than the given number."""


def _check_member(name: Any, source: str) -> str:
    """Return the name if it is a plain file name, so that no member leads out of the asset."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,127}", name):
        raise AssetError(
            f"splat file {source}: member name {str(name)[:80]!r} is not a plain file name",
            hint="Members must lie beside meta.json; do not trust this file",
        )
    return name


def _folder_reader(folder: Path, meta: str = "meta.json") -> _Reader:
    """Return a reader of the members of a SOG folder."""

    def read(name: str, limit: int) -> bytes:
        file = folder / (meta if name == "meta.json" else name)
        if not file.is_file():
            raise AssetError(
                f"splat file {folder / meta}: member {name} is missing",
                hint="Copy the whole folder, with all .webp files",
            )
        with open(file, "rb") as stream:
            data = stream.read(limit + 1)
        if len(data) > limit:
            raise AssetError(f"splat file {file}: larger than {limit} bytes", hint="Decimate the asset first")
        return data

    return read


def _archive_reader(archive: zipfile.ZipFile, source: str) -> _Reader:
    """Return a reader of the members of a `.sog` archive, bounded against decompression bombs."""

    def read(name: str, limit: int) -> bytes:
        try:
            info = archive.getinfo(name)
        except KeyError:
            raise AssetError(f"splat file {source}: member {name} is missing", hint=_REEXPORT) from None
        if info.file_size > limit:
            raise AssetError(
                f"splat file {source}: member {name} larger than {limit} bytes", hint="Decimate the asset first"
            )
        with archive.open(info) as stream:
            return stream.read(limit)

    return read


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return width and height from a WebP header without decoding; (0, 0) if it is none."""
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        return 0, 0
    kind = data[12:16]
    if kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if kind == b"VP8 ":
        return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF
    return 0, 0


class _SogMeta:
    """Typed access to `meta.json`: every lookup that fails names the key."""

    def __init__(self, value: Any, source: str, path: str = "meta.json") -> None:
        self.value = value
        self.source = source
        self.path = path

    def fail(self, problem: str) -> AssetError:
        return AssetError(f"splat file {self.source}: {self.path}: {problem}", hint=_REEXPORT)

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value, dict) and key in self.value

    def __getitem__(self, key: str) -> _SogMeta:
        if key not in self:
            raise self.fail(f"'{key}' is missing")
        return _SogMeta(self.value[key], self.source, f"{self.path}: {key}")

    def integer(self, low: int, high: int) -> int:
        if type(self.value) is not int or not low <= self.value <= high:
            raise self.fail(f"expected an integer in {low}..{high}, found {str(self.value)[:40]!r}")
        return self.value

    def numbers(self, length: int) -> NDArray[np.float64]:
        values = self.value
        if not isinstance(values, list) or len(values) != length or any(type(v) not in (int, float) for v in values):
            raise self.fail(f"expected {length} numbers")
        array = np.array(values, dtype=np.float64)
        if not np.isfinite(array).all():
            raise self.fail("holds NaN or infinity")
        return array

    def files(self, length: int) -> list[str]:
        if not isinstance(self.value, list) or len(self.value) != length:
            raise self.fail(f"expected {length} file names")
        return [_check_member(name, self.source) for name in self.value]


def _read_sog(source: str, read: _Reader) -> Splats:
    """Decode SOG version 2: quantised attributes in lossless WebP images, one pixel per splat in row order."""
    try:
        meta = _SogMeta(json.loads(read("meta.json", _META_LIMIT)), source)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise AssetError(f"splat file {source}: meta.json is no JSON ({error})", hint=_REEXPORT) from error
    if "version" not in meta or meta["version"].value != 2:
        raise AssetError(
            f"splat file {source}: not SOG version 2", hint="Convert it with splat-transform to SOG v2 or to .ply"
        )
    count = meta["count"].integer(1, MAX_SPLATS)

    def image(name: str, low: int, high: int, width: int | None = None) -> NDArray[np.uint8]:
        data = read(name, _IMAGE_FILE_LIMIT)
        size = _webp_size(data)
        # The header is judged before any decoder sees the data: an image may not unpack to more than its splats need.
        if not low <= size[0] * size[1] <= high or (width is not None and size[0] != width):
            raise AssetError(
                f"splat file {source}: image {name} is {size[0]} x {size[1]} pixels, expected "
                + (f"{width} wide and " if width else "")
                + f"{low} to {high} pixels of lossless WebP for {count} splats",
                hint=_REEXPORT,
            )
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            if picture.size != size:
                raise AssetError(f"splat file {source}: image {name} contradicts its header", hint=_REEXPORT)
            return np.asarray(picture.convert("RGBA"))

    def pixels(name: str) -> NDArray[np.uint8]:
        return image(name, count, 4 * count + 65536).reshape(-1, 4)[:count]

    # Means: 16 bit per axis over two images, in the symmetric logarithm sign(x) log(1 + |x|).
    low, high = (pixels(name)[:, :3].astype(np.float64) for name in meta["means"]["files"].files(2))
    lower, upper = meta["means"]["mins"].numbers(3), meta["means"]["maxs"].numbers(3)
    with np.errstate(over="ignore", invalid="ignore"):
        value = lower + (low + 256.0 * high) / 65535.0 * (upper - lower)
        means = np.sign(value) * np.expm1(np.abs(value))

    scale_index = pixels(meta["scales"]["files"].files(1)[0])[:, :3]
    scales = _exp_scales(meta["scales"]["codebook"].numbers(256)[scale_index])

    # Quaternions: the largest of w, x, y, z is dropped (alpha - 252 names it), the others lie in +-1/sqrt(2).
    packed = pixels(meta["quats"]["files"].files(1)[0])
    if (packed[:, 3] < 252).any():
        raise AssetError(f"splat file {source}: quats hold a mode below 252", hint=_REEXPORT)
    others = (packed[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    wxyz = np.empty((count, 4))
    for mode in range(4):
        chosen = packed[:, 3] == 252 + mode
        wxyz[chosen, mode] = largest[chosen]
        wxyz[np.ix_(chosen, [i for i in range(4) if i != mode])] = others[chosen]

    color = pixels(meta["sh0"]["files"].files(1)[0])
    sh = meta["sh0"]["codebook"].numbers(256)[color[:, :3]][:, None]
    if "shN" in meta:
        sh = np.concatenate([sh, _read_sog_palette(meta["shN"], pixels, image)], axis=1)
    return Splats(
        means=means,
        quats=wxyz[:, [1, 2, 3, 0]],
        scales=scales,
        opacities=color[:, 3] / 255.0,
        sh=sh,
        name=f"splat file {source}",
    )


def _read_sog_palette(
    meta: _SogMeta, pixels: Callable[[str], NDArray[np.uint8]], image: Callable[..., NDArray[np.uint8]]
) -> NDArray[np.float64]:
    """Decode the higher spherical harmonics: one of up to 65536 palette entries per splat, 64 entries per image row."""
    coefficient_count = (meta["bands"].integer(1, 3) + 1) ** 2 - 1
    centroid_file, label_file = meta["files"].files(2)
    palette = image(centroid_file, 64 * coefficient_count, 65536 * coefficient_count, 64 * coefficient_count)
    label = pixels(label_file).astype(np.int64)
    entry = label[:, 0] + 256 * label[:, 1]
    if entry.max() >= 64 * len(palette):
        raise meta.fail(f"a splat names palette entry {entry.max()}, the palette holds {64 * len(palette)}")
    column = (entry % 64)[:, None] * coefficient_count + np.arange(coefficient_count)
    return meta["codebook"].numbers(256)[palette[(entry // 64)[:, None], column][..., :3]]
