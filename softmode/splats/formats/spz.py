"""SPZ (read versions 1 to 4, write 3 and 4): quantised attributes, one array each, compressed as a whole.

Versions 1 to 3 are one gzip stream of a 16-byte header and the arrays. Version 4 has a plain 32-byte header, a table of
sizes and one Zstandard frame per array; Python before 3.14 needs the extra `[spz]` for it.

Reference:
    Niantic Labs, "SPZ", file format section of the reference implementation (nianticlabs/spz).
"""

from __future__ import annotations

import gzip
import os
import struct
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softmode.errors import ConfigError, MissingExtraError
from softmode.files import open_file, whole_file
from softmode.splats.formats.common import (
    ANTIALIASED,
    FREE_BYTES,
    MAX_RATIO,
    check_count,
    exp_scales,
    quats_from_smallest_three,
    read_exactly,
    smallest_three_from_quats,
    sound_splats,
    unreadable,
)
from softmode.splats.splats import Splats

_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_ENTRY = struct.Struct("<QQ")
_MAGIC = b"NGSP"
_ANTIALIASED, _EXTENDED = 1, 2
_EXTENSION_LIMIT = 1024 * 1024
_DC_SCALE = 0.15


@dataclass(frozen=True)
class _Header:
    """What the header of any version says."""

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int

    def sizes(self) -> dict[str, int]:
        """Return the bytes of every array in the order of the file; empty ones are left out."""
        per_splat = {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colors": 3,
            "scales": 3,
            "rotations": 3 if self.version < 3 else 4,
            "sh": 3 * ((self.degree + 1) ** 2 - 1),
        }
        return {name: size * self.count for name, size in per_splat.items() if size}


def read_spz(path: str | os.PathLike[str]) -> Splats:
    """Read a `.spz` file of version 1 to 4; SPZ keeps y up.

    Spherical harmonics of degree 4 are cut to 3. Extensions (camera limits and the like) are skipped.

    Raises:
        AssetError: If the file is damaged, contradicts its header, or holds no usable splats.
        MissingExtraError: If it is of version 4 and Zstandard is not installed (Python before 3.14).
    """
    file_path = Path(path)
    with open_file(file_path, "splat file") as file:
        data = read_exactly(file, os.fstat(file.fileno()).st_size, file_path)
    unpack = _unpack_gzip if data[:2] == b"\x1f\x8b" else _unpack_zstd
    return _decode(*unpack(data, str(file_path)), str(file_path))


def _check_header(fields: tuple[Any, ...], versions: range, packed_size: int, path: str) -> _Header:
    """Return the header if its values are possible for a file of this size."""
    magic, version, count, degree, fractional_bits, flags = fields[:6]
    if magic != _MAGIC:
        raise unreadable(path, "no SPZ header")
    if version not in versions:
        raise unreadable(
            path,
            f"SPZ version {version}, expected {versions[0]} to {versions[-1]}",
            hint="Convert it with splat-transform to a newer SPZ or to .ply",
        )
    if degree > 4 or fractional_bits > 30:
        raise unreadable(
            path, f"spherical-harmonic degree {degree} and {fractional_bits} fractional bits, expected at most 4 and 30"
        )
    header = _Header(version, check_count(count, path), degree, fractional_bits, flags)
    if sum(header.sizes().values()) > max(FREE_BYTES, MAX_RATIO * packed_size):
        raise unreadable(path, f"{packed_size} bytes cannot hold the {count} splats that the header declares")
    return header


def _unpack_gzip(data: bytes, path: str) -> tuple[_Header, dict[str, memoryview]]:
    """Return header and arrays of versions 1 to 3; unpacks no more than the header declares."""
    stream = zlib.decompressobj(wbits=31)
    head = stream.decompress(data, _HEADER.size)
    if len(head) < _HEADER.size:
        raise unreadable(path, "ends within its header")
    header = _check_header(_HEADER.unpack(head), range(1, 4), len(data), path)
    sizes = header.sizes()
    expected = sum(sizes.values())
    allowed = expected + (_EXTENSION_LIMIT if header.flags & _EXTENDED else 0)
    body = stream.decompress(stream.unconsumed_tail, allowed + 1)
    if not expected <= len(body) <= allowed or not stream.eof or stream.unused_data:
        raise unreadable(
            path,
            f"header declares {header.count} splats, {expected} bytes unpacked, the file holds "
            f"{'more than ' if len(body) > allowed else ''}{min(len(body), allowed)}"
            + ("" if stream.eof and not stream.unused_data else ", or does not end where its gzip stream ends"),
        )
    view, start, arrays = memoryview(body), 0, {}
    for name, size in sizes.items():
        arrays[name] = view[start : start + size]
        start += size
    return header, arrays


def _zstd() -> Any:
    """Return the Zstandard module of Python 3.14 or its backport."""
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:
        raise MissingExtraError(
            "SPZ version 4 needs Zstandard",
            hint="install it with: pip install 'softmode[spz]', or convert the file to SPZ version 3",
        ) from error
    return zstd


def _unpack_zstd(data: bytes, path: str) -> tuple[_Header, dict[str, bytes]]:
    """Return header and arrays of version 4; every frame must unpack to exactly the size its array needs."""
    if len(data) < _HEADER_4.size:
        raise unreadable(path, "ends within its header")
    *fields, stream_count, table = _HEADER_4.unpack_from(data)
    header = _check_header(tuple(fields), range(4, 5), len(data), path)
    sizes = header.sizes()
    start = table + len(sizes) * _ENTRY.size
    if stream_count != len(sizes) or table < _HEADER_4.size or start > len(data):
        raise unreadable(path, f"{stream_count} streams listed at byte {table} of {len(data)}, expected {len(sizes)}")
    entries = [_ENTRY.unpack_from(data, table + i * _ENTRY.size) for i in range(len(sizes))]
    if [entry[1] for entry in entries] != list(sizes.values()) or start + sum(e[0] for e in entries) != len(data):
        raise unreadable(path, f"the sizes of its streams contradict {header.count} splats or {len(data)} bytes")
    zstd = _zstd()
    arrays = {}
    for (name, size), (packed, _) in zip(sizes.items(), entries, strict=True):
        # A frame may ask for a window of its own; one larger than the array it holds is refused, not allocated.
        window = min(max(size.bit_length(), 17), 31)
        stream = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window})
        try:
            arrays[name] = stream.decompress(data[start : start + packed], size + 1)
        except zstd.ZstdError as error:
            raise unreadable(path, f"stream of {name} is damaged ({error})") from error
        if len(arrays[name]) != size or not stream.eof or stream.unused_data:
            raise unreadable(path, f"stream of {name} does not hold {size} bytes")
        start += packed
    return header, arrays


def _decode(header: _Header, arrays: dict[str, Any], path: str) -> Splats:
    """Turn the packed arrays into splats."""

    def table(name: str, columns: int, dtype: str = "u1") -> NDArray[Any]:
        return np.frombuffer(arrays[name], dtype=dtype).reshape(header.count, columns)

    if header.version == 1:
        means = table("positions", 3, "<f2").astype(np.float64)
    else:
        octets = table("positions", 9).reshape(-1, 3, 3).astype(np.int32)
        fixed = octets[..., 0] | octets[..., 1] << 8 | octets[..., 2] << 16
        means = (fixed - ((fixed & 0x800000) << 1)) * 2.0**-header.fractional_bits
    if header.version < 3:
        xyz = table("rotations", 3) / 127.5 - 1.0
        quats = np.column_stack([xyz, np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1)))])
    else:
        packed = table("rotations", 1, "<u4")[:, 0]
        parts = np.stack([packed >> shift & 0x3FF for shift in (20, 10, 0)], axis=1).astype(np.float64)
        others = np.where(parts >= 512.0, 512.0 - parts, parts) * (np.sqrt(0.5) / 511.0)
        quats = quats_from_smallest_three(packed >> 30, others)
    sh = ((table("colors", 3) / 255.0 - 0.5) / _DC_SCALE)[:, None]
    if header.degree:
        rest = table("sh", 3 * ((header.degree + 1) ** 2 - 1)).reshape(header.count, -1, 3)
        steps = np.arange(-128.0, 128.0, dtype=np.float32) / np.float32(128.0)
        sh = np.concatenate([sh.astype(np.float32), steps[rest]], axis=1)
    return sound_splats(
        f"splat file {path}",
        means=means,
        quats=quats,
        scales=exp_scales(table("scales", 3) / 16.0 - 10.0),
        opacities=table("alphas", 1)[:, 0] / 255.0,
        sh=sh,
        notes=[ANTIALIASED] if header.flags & _ANTIALIASED else [],
    )


def write_spz(path: str | os.PathLike[str], splats: Splats, *, version: Literal[3, 4] = 3) -> None:
    """Write a `.spz` file; the file appears complete or not at all.

    Splats keep their order. Positions are rounded to steps of 1 um within 8 m of the origin (2 um within 16 m, and so
    on), scales to steps of 6 % (45 um to 373 m), rotations to 0.0014 in a component, opacities to 1/255, colours to
    1/135 within -0.44..1.44, higher coefficients to 1/128 within -1..1.

    Args:
        path: File to write; its folder must exist.
        splats: What to write, in its own frame; SPZ viewers take y for up.
        version: 3 (gzip; the one that nearly every viewer reads) or 4 (Zstandard).

    Raises:
        AssetError: If a coordinate exceeds the format's 8388607 m.
        StorageError: If the file cannot be written.
        ConfigError: If the version is neither 3 nor 4.
        MissingExtraError: If version 4 is asked for without Zstandard.
    """
    if version not in (3, 4):
        raise ConfigError(f"version must be 3 or 4, got {version!r}")
    reach = max(float(np.abs(splats.means).max()), 2.0**-30)
    fractional_bits = min(20, int(np.floor(np.log2((2**23 - 1) / reach))))
    if fractional_bits < 0:
        raise unreadable(
            path,
            f"a coordinate of {reach:.3g} m exceeds the 8388607 m of SPZ",
            hint="Move the splats to the origin or write .ply",
        )
    fixed = np.rint(splats.means.astype(np.float64) * 2.0**fractional_bits).astype("<i4")
    largest, others = smallest_three_from_quats(splats.quats)
    magnitude = np.minimum(np.rint(np.abs(others) * (511.0 / np.sqrt(0.5))), 511.0).astype(np.uint32)
    parts = magnitude | np.where(others < 0.0, 512, 0).astype(np.uint32)
    rotations = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    arrays = [
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes(),
        _octets(splats.opacities * 255.0),
        _octets((splats.sh[:, 0] * _DC_SCALE + 0.5) * 255.0),
        _octets((np.log(splats.scales) + 10.0) * 16.0),
        rotations.astype("<u4").tobytes(),
        _octets(splats.sh[:, 1:] * 128.0 + 128.0),
    ]
    arrays = [array for array in arrays if array]
    fields = (_MAGIC, version, splats.count, splats.sh_degree, fractional_bits, 0)
    if version == 3:
        packed = gzip.compress(_HEADER.pack(*fields, 0) + b"".join(arrays), mtime=0)
    else:
        zstd = _zstd()
        frames = [zstd.compress(array) for array in arrays]
        table = b"".join(_ENTRY.pack(len(f), len(a)) for f, a in zip(frames, arrays, strict=True))
        packed = _HEADER_4.pack(*fields, len(arrays), _HEADER_4.size) + table + b"".join(frames)
    with whole_file(path, "splat file", make_folders=False) as file:
        file.write(packed)


def _octets(values: NDArray[Any]) -> bytes:
    """Return the values rounded and clipped to 0..255."""
    return np.rint(np.clip(values, 0.0, 255.0)).astype(np.uint8).tobytes()
