"""SOG version 2 (read): quantised attributes in lossless WebP images; a folder, its `meta.json`, or a `.sog` archive.

Reference:
    PlayCanvas, "The SOG format", version 2.
"""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from softmode.errors import AssetError
from softmode.files import open_file, open_zip, read_file
from softmode.foreign.child.layers import inside
from softmode.splats.formats.common import (
    ANTIALIASED,
    FREE_BYTES,
    MAX_RATIO,
    exp_scales,
    quats_from_smallest_three,
    sound_splats,
    unreadable,
)
from softmode.splats.splats import MAX_SPLATS, Splats

_META_LIMIT = 16 * 1024 * 1024
_IMAGE_FILE_LIMIT = 512 * 1024 * 1024
_WHOLE = "Copy the whole folder, with all .webp files"
_ARCHIVE_RATIO = 16
"""Largest ratio of unpacked to packed bytes of a large member of an archive; WebP images are packed already."""


def read_sog(path: str | os.PathLike[str]) -> Splats:
    """Read a SOG v2 asset: a folder, its `meta.json` or a `.sog` archive.

    Raises:
        AssetError: If a member is missing, damaged or contradicts `meta.json`, or there are no usable splats.
    """
    file = Path(path)
    if file.is_dir():
        if not (file / "meta.json").is_file():
            raise AssetError(
                f"splat folder {file}: no meta.json in it", hint="Name a SOG v2 folder, or a splat file such as .ply"
            )
        return _decode(str(file), _folder_reader(file))
    if file.suffix.lower() == ".json":
        return _decode(str(file), _folder_reader(file.parent, file.name))
    with open_file(file, "splat file") as stream, open_zip(stream) as archive:
        return _decode(str(file), _archive_reader(archive, str(file)))


_Reader = Callable[[str, int], bytes]
"""Return the bytes of a named member, refusing more than the given number."""


def _check_member(name: object, source: str) -> str:
    """Return the name if it is a plain file name, so that no member leads out of the asset."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,127}", name):
        raise unreadable(
            source,
            f"member name {str(name)[:80]!r} is not a plain file name",
            hint="Members must lie beside meta.json; do not trust this file",
        )
    return name


def _folder_reader(folder: Path, meta: str = "meta.json") -> _Reader:
    """Return a reader of the members of a SOG folder."""

    def read(name: str, limit: int) -> bytes:
        if name == "meta.json":  # the file that was named, wherever it lies
            return read_file(folder / meta, "splat file", limit=limit)
        file = folder / name
        if not inside(str(file), str(folder)):
            raise unreadable(folder / meta, f"member {name} is a link that leads outside of its folder", hint=_WHOLE)
        return read_file(file, f"splat file {folder / meta}: member", limit=limit, hint=_WHOLE)

    return read


def _archive_reader(archive: zipfile.ZipFile, source: str) -> _Reader:
    """Return a reader of the members of a `.sog` archive, bounded against decompression bombs.

    The members may lie in a folder, as where the folder itself was packed.
    """
    metas = [name for name in archive.namelist() if re.fullmatch(r"([^/]+/)?meta\.json", name)]
    folder = min(metas, key=len, default="meta.json").removesuffix("meta.json")

    def read(name: str, limit: int) -> bytes:
        try:
            info = archive.getinfo(folder + name)
        except KeyError:
            raise unreadable(source, f"member {name} is missing") from None
        if info.file_size > limit:
            raise unreadable(source, f"member {name} larger than {limit} bytes", hint="Decimate the asset first")
        if info.file_size > max(FREE_BYTES, _ARCHIVE_RATIO * info.compress_size):
            raise unreadable(
                source,
                f"member {name} unpacks from {info.compress_size} to {info.file_size} bytes, which no image does",
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
        return unreadable(self.source, f"{self.path}: {problem}")

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


def _decode(source: str, read: _Reader) -> Splats:
    """Decode SOG version 2: quantised attributes in lossless WebP images, one pixel per splat in row order."""
    try:
        meta = _SogMeta(json.loads(read("meta.json", _META_LIMIT)), source)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise unreadable(source, f"meta.json is no JSON ({error})") from error
    if "gaussians" in meta and "particles" in meta:
        raise unreadable(
            source,
            "describes a body of particles with Gaussians bound to them, which is no splat file",
            hint="Write its Gaussians to a .ply: means, scales, rotations, opacities, colours",
        )
    if "version" not in meta or meta["version"].value != 2:
        raise unreadable(source, "not SOG version 2", hint="Convert it with splat-transform to SOG v2 or to .ply")
    count = meta["count"].integer(1, MAX_SPLATS)
    file_bytes = image_bytes = 0

    def image(name: str, low: int, high: int, width: int | None = None) -> NDArray[np.uint8]:
        nonlocal file_bytes, image_bytes
        data = read(name, _IMAGE_FILE_LIMIT)
        size = _webp_size(data)
        # The header is judged before any decoder sees the data: an image may not unpack to more than its splats need.
        if not low <= size[0] * size[1] <= high or (width is not None and size[0] != width):
            raise unreadable(
                source,
                f"image {name} is {size[0]} x {size[1]} pixels, expected "
                + (f"{width} wide and " if width else "")
                + f"{low} to {high} pixels of lossless WebP for {count} splats",
            )
        # A single colour packs without bound; together, the images of real splats pack by less than ten.
        file_bytes, image_bytes = file_bytes + len(data), image_bytes + 4 * size[0] * size[1]
        if image_bytes > max(FREE_BYTES, MAX_RATIO * file_bytes):
            raise unreadable(
                source, f"images of {file_bytes} bytes cannot hold the {count} splats that meta.json declares"
            )
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            if picture.size != size:
                raise unreadable(source, f"image {name} contradicts its header")
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
    scales = exp_scales(meta["scales"]["codebook"].numbers(256)[scale_index])

    # Quaternions: the largest of w, x, y, z is dropped (alpha - 252 names it), the others lie in +-1/sqrt(2).
    packed = pixels(meta["quats"]["files"].files(1)[0])
    if (packed[:, 3] < 252).any():
        raise unreadable(source, "quats hold a mode below 252")
    others = (packed[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    wxyz = quats_from_smallest_three(packed[:, 3] - 252, others)

    color = pixels(meta["sh0"]["files"].files(1)[0])
    sh = meta["sh0"]["codebook"].numbers(256)[color[:, :3]][:, None]
    if "shN" in meta:
        with np.errstate(over="ignore"):
            sh = np.concatenate([sh.astype(np.float32), _decode_palette(meta["shN"], pixels, image)], axis=1)
    return sound_splats(
        f"splat file {source}",
        means=means,
        quats=wxyz[:, [1, 2, 3, 0]],
        scales=scales,
        opacities=color[:, 3] / 255.0,
        sh=sh,
        notes=[ANTIALIASED] if "antialias" in meta and meta["antialias"].value else [],
    )


def _decode_palette(
    meta: _SogMeta, pixels: Callable[[str], NDArray[np.uint8]], image: Callable[..., NDArray[np.uint8]]
) -> NDArray[np.float32]:
    """Decode the higher spherical harmonics: one of up to 65536 palette entries per splat, 64 entries per image row."""
    coefficient_count = (meta["bands"].integer(1, 3) + 1) ** 2 - 1
    centroid_file, label_file = meta["files"].files(2)
    palette = image(centroid_file, 64 * coefficient_count, 65536 * coefficient_count, 64 * coefficient_count)
    label = pixels(label_file).astype(np.int64)
    entry = label[:, 0] + 256 * label[:, 1]
    if entry.max() >= 64 * len(palette):
        raise meta.fail(f"a splat names palette entry {entry.max()}, the palette holds {64 * len(palette)}")
    column = (entry % 64)[:, None] * coefficient_count + np.arange(coefficient_count)
    codebook = meta["codebook"].numbers(256).astype(np.float32)
    return codebook[palette[(entry // 64)[:, None], column][..., :3]]
