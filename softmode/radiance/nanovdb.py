"""What a NanoVDB file says of itself, checked before any of it is handed to Warp.

Layout: PNanoVDB.h and util/IO.h of OpenVDB (Museth 2021, doi:10.1145/3450623.3464653): a file header of 16 bytes, for
each grid 176 bytes and its name, then the grids, each whole or packed by zlib behind its packed size. A grid begins
with 672 bytes about itself and 64 about its tree. Checksums (tools/GridChecksum.h) are CRC-32, of that beginning and,
from version 32.6 on, of the rest in blocks of 4 KiB; all ones where the writer left them out.
"""

from __future__ import annotations

import struct
import zlib

FILE_MAGIC = (0x304244566F6E614E, 0x324244566F6E614E)
"""NanoVDB0 or NanoVDB2: a file."""
GRID_MAGIC = (0x304244566F6E614E, 0x314244566F6E614E)
"""NanoVDB0 or NanoVDB1: a grid."""
MAJOR = 32
"""Version that Warp reads."""
BYTE_LIMIT = 2**31
"""Most bytes of an array, or of all grids, that are read from a file."""
VOXEL_LIMIT = 2**28
"""Most active voxels of a grid."""
_FILE, _META, _GRID, _TREE = 16, 176, 672, 64
_BLOCK, _FREE = 1 << 12, 64 << 20
_EMPTY = 0xFFFFFFFF
_PLAIN, _ZIP = 0, 1


def checked(content: bytes) -> bytes:
    """Return a NanoVDB file with its grids unpacked.

    Args:
        content: The bytes of the file.

    Raises:
        ValueError: If it is no such file, truncated, too large, or anything that it says of itself is not so.
    """
    magic, version, count, codec = struct.unpack("<QIHH", _part(content, 0, _FILE))
    _require(magic in FILE_MAGIC, "no NanoVDB file")
    _require(version >> 21 == MAJOR, f"version {version >> 21}, readable is {MAJOR}")
    _require(count > 0, "no grids")
    _require(codec in (_PLAIN, _ZIP), "packed by Blosc or an unknown codec; write it with zip or none")
    at, total, sizes, about = _FILE, 0, [], []
    for _ in range(count):
        meta = bytearray(_part(content, at, _META))
        size, packed = struct.unpack_from("<QQ", meta)
        name = _part(content, at + _META, struct.unpack_from("<I", meta, 136)[0])
        total += size
        most = min(BYTE_LIMIT, max(_FREE, 8 * len(content)))
        _require(total <= most, f"{total} bytes unpacked, at most {most}")
        _require(codec == _ZIP or size == packed, "sizes that do not match")
        struct.pack_into("<Q", meta, 8, size)
        struct.pack_into("<H", meta, 168, _PLAIN)
        sizes.append((size, packed))
        about += [bytes(meta), name]
        at += _META + len(name)
    grids = []
    for size, packed in sizes:
        length = size
        if codec == _ZIP:
            length = struct.unpack("<Q", _part(content, at, 8))[0]
            _require(packed - length in (0, 8), "sizes that do not match")  # Warp does not count these eight bytes.
            at += 8
        stored = _part(content, at, length)
        grids.append(_unpacked(stored, size) if codec == _ZIP else stored)
        at += length
        _check_grid(grids[-1])
    follows = content[at : at + 8]  # Segments after the first one are not read.
    _require(not follows or follows in [struct.pack("<Q", known) for known in FILE_MAGIC], "bytes after the last grid")
    return b"".join([struct.pack("<QIHH", magic, version, count, _PLAIN), *about, *grids])


def _unpacked(packed: bytes, size: int) -> bytes:
    """Return a grid of so many bytes."""
    stream = zlib.decompressobj()
    found = stream.decompress(packed, size + 1)  # No more, whatever the bytes would become.
    _require(len(found) == size and stream.eof, "sizes that do not match")
    return found


def _check_grid(grid: bytes) -> None:
    """Compare a grid's magic, version, size, number of voxels and checksums with what it is."""
    _part(grid, 0, _GRID + _TREE)
    magic, head, tail, version = struct.unpack_from("<QIII", grid)
    _require(magic in GRID_MAGIC and version >> 21 == MAJOR, f"a grid of magic {magic:#x}, version {version >> 21}")
    size = struct.unpack_from("<Q", grid, 32)[0]
    _require(size == len(grid), f"a grid of {len(grid)} bytes that says {size}")
    upper, voxels = struct.unpack_from("<Q", grid, _GRID + 16)[0], struct.unpack_from("<Q", grid, _GRID + 56)[0]
    most = min(VOXEL_LIMIT, max(2**22, len(grid)))
    _require(voxels <= most, f"{voxels} active voxels in {len(grid)} bytes, at most {most}")
    if head == tail == _EMPTY:
        return
    recent = (version >> 21, version >> 10 & 0x7FF, version & 0x3FF) > (MAJOR, 6, 0)
    middle = _GRID + _TREE if recent else _GRID + upper
    _require(middle <= size and zlib.crc32(grid[16:middle]) == head, "a wrong checksum of its beginning")
    _require(tail == _EMPTY or not recent or _blocked_checksum(grid[middle:]) == tail, "a wrong checksum of its nodes")


def _blocked_checksum(content: bytes) -> int:
    """Return the CRC-32 of those of whole blocks, the last of which takes the rest."""
    count = len(content) // _BLOCK
    ends = [*(i * _BLOCK for i in range(1, count)), len(content)][: max(count, 0)]
    parts = [zlib.crc32(content[i * _BLOCK : end]) for i, end in enumerate(ends)]
    return zlib.crc32(struct.pack(f"<{len(parts)}I", *parts)) if content else _EMPTY


def _part(content: bytes, start: int, length: int) -> bytes:
    """Return bytes that must be there."""
    _require(start + length <= len(content), "the file is truncated")
    return content[start : start + length]


def _require(true: bool, found: str) -> None:
    if not true:
        raise ValueError(found)
