"""INRIA `.ply` and SOG files: round trips, a real asset, and damage to their headers."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from softmode.errors import AssetError, StorageError
from softmode.splats import Splats, read_splats, write_ply
from tests.splats.test_splats import random_splats

FLOAT32 = np.finfo(np.float32).eps


def ply_bytes(tmp_path: Path, **kwargs: Any) -> bytes:
    """Return a valid small .ply."""
    write_ply(tmp_path / "valid.ply", random_splats(**kwargs))
    return (tmp_path / "valid.ply").read_bytes()


def read_bytes(tmp_path: Path, data: bytes, name: str = "case.ply") -> Splats:
    """Write the bytes and read them as a splat file."""
    (tmp_path / name).write_bytes(data)
    return read_splats(tmp_path / name)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_ply_round_trip(tmp_path: Path, coefficients: int) -> None:
    """Reading what was written returns the splats to float32."""
    splats = random_splats(coefficients=coefficients)
    write_ply(tmp_path / "a.ply", splats)
    again = read_splats(tmp_path / "a.ply")
    np.testing.assert_array_equal(again.means, splats.means)
    np.testing.assert_array_equal(again.sh, splats.sh)
    np.testing.assert_allclose(again.quats, splats.quats, atol=2 * FLOAT32)
    np.testing.assert_allclose(again.scales, splats.scales, rtol=10 * FLOAT32)
    np.testing.assert_allclose(again.opacities, splats.opacities, atol=1e-6)


def test_ply_write_is_atomic(tmp_path: Path) -> None:
    """A failing write leaves neither the target nor a temporary file."""
    with pytest.raises(StorageError, match="cannot be written"):
        write_ply(tmp_path / "absent" / "a.ply", random_splats())
    (tmp_path / "taken.ply").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        write_ply(tmp_path / "taken.ply", random_splats())
    assert [path.name for path in tmp_path.iterdir()] == ["taken.ply"]


def test_ply_with_two_scales_uchar_and_crlf(tmp_path: Path) -> None:
    """Disc splats get a thin third axis; foreign uchar properties are skipped; CRLF headers are read."""
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3".split()
    table = np.zeros(3, dtype=[("red", "u1"), *((name, "<f4") for name in names)])
    table["rot_0"], table["scale_0"], table["scale_1"] = 1.0, np.log(0.2), np.log(0.1)
    lines = ["ply", "format binary_little_endian 1.0", "comment made by hand", "element vertex 3", "property uchar red"]
    header = "\r\n".join([*lines, *(f"property float {name}" for name in names), "end_header\r\n"])
    splats = read_bytes(tmp_path, header.encode() + table.tobytes())
    np.testing.assert_allclose(splats.scales, np.tile([0.2, 0.1, 1e-4], (3, 1)), rtol=10 * FLOAT32)
    np.testing.assert_array_equal(splats.quats, np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
    np.testing.assert_array_equal(splats.opacities, 0.5)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"binary_little_endian", b"binary", "expected binary_little_endian"),
        (b"binary_little_endian", b"ascii", "text that is no number"),
        (b"element vertex 50", b"element vertex 51", "the file holds"),
        (b"element vertex 50", b"element vertex 0", "0 splats"),
        (b"element vertex 50", b"element vertex 99999999999", "99999999999 splats"),
        (b"element vertex 50", b"element vertex -5", "unreadable header line"),
        (b"element vertex 50", b"element chunk 50", "elements"),
        (b"property float nx", b"property list uchar bool nx", "unreadable header line"),
        (b"property float nx", b"property list uchar int nx", "the file holds fewer"),
        (b"property float rot_2", b"property float rot_x", "properties rot_2 are missing"),
        (b"property float nx", b"property float x", "declared twice"),
        (b"property float f_rest_0\n", b"property float f_rest_x\n", "f_rest"),
        (b"end_header", b"end_headr", "no PLY header"),
        (b"ply\n", b"plx\n", "no PLY header"),
        (b"element vertex", b"comment " + 70_000 * b"x" + b"\nelement vertex", "no PLY header within"),
    ],
)
def test_ply_header_damage(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    """Every kind of damage to the header has its own message, and all have a remedy."""
    data = ply_bytes(tmp_path)
    assert old in data
    with pytest.raises(AssetError, match=message) as caught:
        read_bytes(tmp_path, data.replace(old, new, 1))
    assert caught.value.hint


@pytest.mark.parametrize("cut", [0, 1, 3, 100, -1, -500])
def test_ply_truncated(tmp_path: Path, cut: int) -> None:
    """A file cut anywhere is refused."""
    with pytest.raises(AssetError):
        read_bytes(tmp_path, ply_bytes(tmp_path)[:cut])


def test_missing_unknown_and_empty(tmp_path: Path) -> None:
    """A missing file, a folder without meta.json, an unknown suffix and empty files are refused."""
    with pytest.raises(AssetError, match="no such file"):
        read_splats(tmp_path / "absent.ply")
    with pytest.raises(AssetError, match=r"no meta\.json"):
        read_splats(tmp_path)
    for name in ("a.ply", "a.sog", "meta.json", "a.obj"):
        with pytest.raises(AssetError) as caught:
            read_bytes(tmp_path, b"", name)
        assert caught.value.hint


def webp(pixels: np.ndarray) -> bytes:
    """Return an RGBA image as lossless WebP, exact under transparent pixels."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def sog_members(count: int = 30, seed: int = 0) -> tuple[dict[str, Any], dict[str, bytes], dict[str, np.ndarray]]:
    """Return meta.json, the images and the decoded truth of a small SOG asset of degree 1, width 8."""
    rng = np.random.default_rng(seed)
    rows = -(-count // 8)

    def image(columns: np.ndarray, alpha: np.ndarray | int = 255) -> bytes:
        pixels = np.zeros((rows * 8, 4), dtype=np.uint8)
        pixels[:count, : columns.shape[1]] = columns
        pixels[:, 3] = 255
        pixels[:count, 3] = alpha
        return webp(pixels.reshape(rows, 8, 4))

    low, high, scale, quat, dc = (rng.integers(0, 256, size=(count, 3)) for _ in range(5))
    alpha, mode, label = (rng.integers(0, n, size=count) for n in (256, 4, 64))
    palette = rng.integers(0, 256, size=(1, 64 * 3, 4)).astype(np.uint8)
    palette[..., 3] = 255
    books = {name: np.sort(rng.normal(size=256)) for name in ("scales", "sh0", "shN")}
    mins, maxs = np.array([-1.0, -2.0, -0.5]), np.array([1.0, 0.5, 2.0])
    quat = 96 + quat // 4
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": books["scales"].tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["sh0.webp"]},
        "shN": {
            "count": 64,
            "bands": 1,
            "codebook": books["shN"].tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        },
    }
    images = {
        "means_l.webp": image(low),
        "means_u.webp": image(high),
        "scales.webp": image(scale),
        "quats.webp": image(quat, 252 + mode),
        "sh0.webp": image(dc, alpha),
        "shN_centroids.webp": webp(palette),
        "shN_labels.webp": image(label[:, None]),
    }
    value = mins + (low + 256 * high) / 65535 * (maxs - mins)
    wxyz = np.zeros((count, 4))
    for i in range(count):
        rest = (quat[i] / 255 - 0.5) * np.sqrt(2)
        wxyz[i] = np.insert(rest, mode[i], np.sqrt(1 - rest @ rest))
    rest = np.stack([books["shN"][palette[0, 3 * entry : 3 * entry + 3, :3]] for entry in label])
    truth = {
        "means": np.sign(value) * np.expm1(np.abs(value)),
        "scales": np.exp(books["scales"][scale]),
        "quats": np.roll(wxyz, -1, axis=1),
        "opacities": alpha / 255,
        "sh": np.concatenate([books["sh0"][dc][:, None], rest], axis=1),
    }
    return meta, images, truth


def write_sog(folder: Path, meta: Any, images: dict[str, bytes]) -> Path:
    """Write an unbundled SOG asset."""
    folder.mkdir(exist_ok=True)
    (folder / "meta.json").write_text(json.dumps(meta))
    for name, data in images.items():
        (folder / name).write_bytes(data)
    return folder


def zip_sog(path: Path, meta: Any, images: dict[str, bytes]) -> Path:
    """Write a bundled SOG asset."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, data in images.items():
            archive.writestr(name, data)
    return path


def test_sog_decodes_every_attribute(tmp_path: Path) -> None:
    """Folder, meta.json and .sog give the same splats, equal to a decoding by definition."""
    meta, images, truth = sog_members()
    folder = write_sog(tmp_path / "sog", meta, images)
    for path in (folder, folder / "meta.json", zip_sog(tmp_path / "a.sog", meta, images)):
        splats = read_splats(path)
        for name, expected in truth.items():
            np.testing.assert_allclose(getattr(splats, name), expected, rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/passwd", "a/b.webp", "..", "c:x.webp", "a\\b.webp", 7, None])
def test_sog_members_cannot_escape(tmp_path: Path, name: Any) -> None:
    """A member name that is no plain file name is refused."""
    meta, images, _ = sog_members()
    meta["scales"]["files"] = [name]
    with pytest.raises(AssetError, match="not a plain file name"):
        read_splats(write_sog(tmp_path / "sog", meta, images))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("version",), 1, "not SOG version 2"),
        (("count",), 33, "expected"),
        (("count",), 0, "integer"),
        (("count",), 10**12, "integer"),
        (("count",), "30", "integer"),
        (("means",), None, "'files' is missing"),
        (("means", "mins"), [0.0, 0.0], "expected 3 numbers"),
        (("means", "maxs"), [1e9, 1.0, 1.0], "means"),
        (("scales", "codebook"), [0.0] * 255, "expected 256 numbers"),
        (("scales", "codebook"), [float("nan")] * 256, "NaN"),
        (("sh0", "files"), ["absent.webp"], "does not exist"),
        (("shN", "bands"), 4, "integer"),
        (("shN", "bands"), 2, "512 wide"),
    ],
)
def test_sog_meta_damage(tmp_path: Path, path: tuple[str, ...], value: Any, message: str) -> None:
    """A wrong entry of meta.json is refused by name."""
    meta, images, _ = sog_members(32)
    part = meta
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(AssetError, match=message) as caught:
        read_splats(write_sog(tmp_path / "sog", meta, images))
    assert caught.value.hint


def test_sog_refuses_a_decompression_bomb(tmp_path: Path) -> None:
    """An image whose header declares 16384 x 16384 pixels is refused before it is decoded."""
    meta, images, _ = sog_members()
    bomb = bytearray(images["scales.webp"])
    assert bomb[12:16] == b"VP8L"
    bomb[21:25] = (0x3FFF | 0x3FFF << 14 | int.from_bytes(bomb[21:25], "little") & 0xF0000000).to_bytes(4, "little")
    with pytest.raises(AssetError, match="16384 x 16384"):
        read_splats(write_sog(tmp_path / "sog", meta, images | {"scales.webp": bytes(bomb)}))


def test_playbot(playbot: Path) -> None:
    """The trained robot asset: 8,406 splats of degree 2, y down, on a patch of ground."""
    splats = read_splats(playbot)
    assert splats.count == 8406 and splats.sh_degree == 2
    upright = splats.oriented("-y")
    low, high = upright.bounds()
    assert low[2] > -0.1 and 1.0 < high[2] < 1.2, "the head is one unit above the ground"
    assert upright.cropped([-1, -1, 0.2], [1, 1, 2]).count > 1000
    # The face: two cyan eyes in the front of the head.
    r, g, b = upright.colors().T
    assert ((b > r + 0.4) & (g > r + 0.3) & (upright.means[:, 2] > 0.6)).sum() >= 5
