"""NanoVDB files: what their headers say is checked, and whatever happened to the bytes, no reader crashes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from softmode.errors import AssetError
from softmode.radiance import read_radiance
from softmode.radiance.nanovdb import checked

GRID, TREE, NAME = 672, 64, 176 + 16
BLOCK = 4096


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return a small field with colours, plain and packed, and one with full checksums."""
    folder, values = tmp_path_factory.mktemp("nanovdb"), np.zeros((8, 8, 8), np.float32)
    values[2:6, 3:6, 1:7] = 40.0
    volume = wp.Volume.load_from_numpy(values, min_world=(1.0, 2.0, 3.0), voxel_size=0.5, bg_value=0.0, device="cpu")
    for codec in ("none", "zip"):
        volume.save_to_nvdb(str(folder / codec), codec=codec)
    found = {codec: (folder / codec).read_bytes() for codec in ("none", "zip")}
    return found | {"checksum": with_checksums(found["none"])}


def start_of_grid(content: bytes) -> int:
    """Return where the only grid of a plain file begins."""
    return NAME + struct.unpack_from("<I", content, 16 + 136)[0]


def with_checksums(content: bytes, tail: bool = True) -> bytes:
    """Return a plain file with the checksums of tools/GridChecksum.h for versions after 32.6.0."""
    at = start_of_grid(content)
    grid = bytearray(content[at:])
    struct.pack_into("<I", grid, 16, 32 << 21 | 9 << 10)
    rest, blocks = bytes(grid[GRID + TREE :]), []
    while len(rest) >= 2 * BLOCK:
        blocks.append(zlib.crc32(rest[:BLOCK]))
        rest = rest[BLOCK:]
    blocks.append(zlib.crc32(rest))
    nodes = zlib.crc32(struct.pack(f"<{len(blocks)}I", *blocks)) if tail else 0xFFFFFFFF
    struct.pack_into("<II", grid, 8, zlib.crc32(grid[16 : GRID + TREE]), nodes)
    return content[:at] + bytes(grid)


@pytest.mark.parametrize("kind", ["none", "zip", "checksum"])
def test_sound_files(files: dict[str, bytes], kind: str, tmp_path: Path) -> None:
    """Plain and packed files hold the same field, with and without checksums."""
    (tmp_path / "a.nvdb").write_bytes(files[kind])
    field = read_radiance(tmp_path / "a.nvdb")
    assert field.density.astype(float).sum() == 40.0 * 4 * 3 * 6
    assert checked(files["zip"])[start_of_grid(files["none"]) :] == files["none"][start_of_grid(files["none"]) :]


@pytest.mark.parametrize("name", ["rocks.nvdb", "torus.nvdb"])
def test_files_of_others(name: str) -> None:
    """Files that OpenVDB wrote, with checksums of two versions, pass; with another byte in their head they do not."""
    file = next(Path(wp.__file__).parent.glob(f"*/assets/{name}"), None)
    if file is None:
        pytest.skip(f"this Warp comes without {name}")
    content = checked(file.read_bytes())
    assert read_radiance(file).density.max() > 0.0
    at = start_of_grid(content) + 300  # its transform
    with pytest.raises(ValueError, match="checksum"):
        checked(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])


@pytest.mark.parametrize(
    ("place", "value", "word"),
    [
        (0, b"\x00", "no NanoVDB file"),
        (8, struct.pack("<I", 31 << 21), "version 31"),
        (12, struct.pack("<H", 0), "no grids"),
        (14, struct.pack("<H", 2), "Blosc"),
        (16, struct.pack("<Q", 2**40), "at most"),
        (24, struct.pack("<Q", 5), "do not match"),
        (152, struct.pack("<I", 2**31), "truncated"),
        ("grid", struct.pack("<Q", 7), "magic 0x7"),
        ("grid + 32", struct.pack("<Q", 7), "says 7"),
        ("grid + 728", struct.pack("<Q", 2**40), "active voxels"),
        ("grid + 300", b"\x07", "checksum of its beginning"),
        ("grid + 900", b"\x07", "checksum of its nodes"),
    ],
)
def test_what_is_refused(files: dict[str, bytes], tmp_path: Path, place: int | str, value: bytes, word: str) -> None:
    """What a file says of itself wrongly is named."""
    content = bytearray(files["checksum"])
    at = place if isinstance(place, int) else start_of_grid(files["checksum"]) + int(f"0{place[6:].strip(' +')}")
    content[at : at + len(value)] = value
    (tmp_path / "a.nvdb").write_bytes(content)
    with pytest.raises(AssetError, match=word):
        read_radiance(tmp_path / "a.nvdb")


def test_what_unpacks_to_too_much(files: dict[str, bytes]) -> None:
    """A grid that unpacks to more than it says is not unpacked further; bytes after the last grid are refused."""
    plain, packed = files["none"], files["zip"]
    bomb = zlib.compress(bytes(2**26))
    at = start_of_grid(packed)
    content = bytearray(packed[:at] + struct.pack("<Q", len(bomb)) + bomb)
    struct.pack_into("<Q", content, 24, len(bomb) + 8)
    with pytest.raises(ValueError, match="do not match"):
        checked(bytes(content))
    with pytest.raises(ValueError, match="bytes after"):
        checked(plain + b"\x00")
    assert checked(plain + packed) == checked(plain)


def packed_again(content: bytes) -> bytes:
    """Return a plain file with its grid packed."""
    at = start_of_grid(content)
    body = zlib.compress(content[at:])
    found = bytearray(content[:at] + struct.pack("<Q", len(body)) + body)
    struct.pack_into("<H", found, 14, 1)
    struct.pack_into("<Q", found, 24, len(body) + 8)
    return bytes(found)
