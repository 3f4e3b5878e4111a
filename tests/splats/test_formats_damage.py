"""Damaged splat files of every format: a typed error or a valid load, within bounds of time and memory."""

from __future__ import annotations

import gzip
import importlib
import importlib.util
import io
import json
import resource
import time
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from softmode.errors import AssetError
from softmode.splats import read_splats, write_splats
from softmode.splats.formats import READABLE
from tests.splats.test_formats import sog_members, write_sog
from tests.splats.test_formats_quantised import spz_3
from tests.splats.test_splats import random_splats

TIME_LIMIT = 2.0
MEMORY_LIMIT = 256 * 2**20


def usd_files(folder: Path) -> dict[str, bytes]:
    """Return a small splat file of each kind that OpenUSD reads; none without the extra [usd]."""
    if importlib.util.find_spec("pxr") is None:
        return {}
    for suffix in (".usdc", ".usda"):
        write_splats(folder / f"valid{suffix}", random_splats(30))
    with importlib.import_module("pxr.Sdf").ZipFileWriter.CreateNew(str(folder / "valid.usdz")) as archive:
        archive.AddFile(str(folder / "valid.usdc"), "valid.usdc")
    return {suffix: (folder / f"valid{suffix}").read_bytes() for suffix in (".usdc", ".usda", ".usdz")}


def read_damaged(path: Path, data: bytes) -> bool:
    """Read a file; return whether it loads. Fails on anything but a valid asset or an AssetError with a remedy."""
    path.write_bytes(data)
    try:
        splats = read_splats(path)
    except AssetError as error:
        assert error.hint and error.message
        return False
    finite = [np.isfinite(getattr(splats, name)).all() for name in ("means", "quats", "scales", "opacities", "sh")]
    assert all(finite) and (splats.scales > 0.0).all() and splats.count >= 1
    return True


def processor_time() -> float:
    """Return the processor time of this process and its children [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def peak_memory() -> tuple[int, int]:
    """Return the largest resident set of this process and of any child so far [bytes].

    A child starts with the set of its parent: that of the children tells something only where it exceeds the parent's.
    """
    own, children = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own * 1024, children * 1024


def flat_sog(side: int) -> bytes:
    """Return a SOG archive whose images are of one colour: five kilobytes for any number of splats."""
    image, archive = io.BytesIO(), io.BytesIO()
    Image.new("RGBA", (side, side), (128, 128, 128, 255)).save(image, "WEBP", lossless=True)
    names = [f"{i}.webp" for i in range(5)]
    meta = {
        "version": 2,
        "count": side * side,
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": names[:2]},
        "scales": {"codebook": [-3.0] * 256, "files": names[2:3]},
        "quats": {"files": names[3:4]},
        "sh0": {"codebook": [0.0] * 256, "files": names[4:]},
    }
    with zipfile.ZipFile(archive, "w") as members:
        members.writestr("meta.json", json.dumps(meta))
        for name in names:
            members.writestr(name, image.getvalue())
    return archive.getvalue()


def test_images_of_one_colour_may_hold_few_splats(tmp_path: Path) -> None:
    """What packs well is no damage: a small asset of equal splats loads."""
    path = tmp_path / "flat.sog"
    path.write_bytes(flat_sog(256))
    assert read_splats(path).count == 256**2


def bomb(name: str) -> tuple[str, bytes, str]:
    """Return suffix, content and expected refusal of a small file that would unpack to much or declares much."""
    raw = gzip.decompress(spz_3())
    if name == "gzip beyond its header":
        return ".spz", gzip.compress(raw[:16] + bytes(2**26)), "the file holds more than"
    if name == "gzip without header":
        return ".spz", gzip.compress(bytes(2**26)), "no SPZ header"
    if name == "declared in gzip":
        many = raw[:8] + (2**26).to_bytes(4, "little") + raw[12:]
        return ".spz", gzip.compress(many), "cannot hold the 67108864 splats"
    if name == "one colour in sog":
        return ".sog", flat_sog(2048), "cannot hold the 4194304 splats"
    if name == "deflated in sog":
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as members:
            members.writestr("meta.json", json.dumps(sog_members()[0]))
            members.writestr("means_l.webp", bytes(2**26))
        return ".sog", archive.getvalue(), "which no image does"
    fields = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3".split()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {2**26}"]
    header = "\n".join([*lines, *(f"property float {field}" for field in fields), "end_header\n"])
    return ".ply", header.encode() + bytes(100), "the file holds"


@pytest.mark.parametrize(
    "name",
    [
        "gzip beyond its header",
        "gzip without header",
        "declared in gzip",
        "declared in ply",
        "one colour in sog",
        "deflated in sog",
    ],
)
def test_bombs_are_not_unpacked(tmp_path: Path, name: str) -> None:
    """A file that would unpack to much, or declares it, is refused before that memory is taken."""
    suffix, data, message = bomb(name)
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(AssetError, match=message):
            read_splats(path)
        assert tracemalloc.get_traced_memory()[1] < 4 * len(data) + 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("count", [2**28, 2**30])
def test_endless_usd_is_stopped(tmp_path: Path, count: int) -> None:
    """A usdc file that declares far more tokens than it holds, which OpenUSD believes, is refused within the bounds."""
    pytest.importorskip("pxr", reason="needs the extra [usd]")
    data = bytearray(usd_files(tmp_path)[".usdc"])
    contents = int.from_bytes(data[16:24], "little")
    entry = data.index(b"TOKENS", contents)
    tokens = int.from_bytes(data[entry + 16 : entry + 24], "little")
    data[tokens : tokens + 8] = count.to_bytes(8, "little")
    # a child starts with its parent's memory, which may be more than the limit, and a few pages of its own
    before, memory = processor_time(), max(*peak_memory(), MEMORY_LIMIT) + 2**20
    assert not read_damaged(tmp_path / "damaged.usdc", bytes(data))
    assert processor_time() - before < TIME_LIMIT
    assert peak_memory()[1] <= memory


@given(header=st.text(max_size=200), body=st.binary(max_size=200))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_arbitrary_bytes_are_refused(tmp_path: Path, header: str, body: bytes) -> None:
    """No arbitrary file is taken for a splat file, whatever its suffix; `.splat`, which has no header, may load."""
    starts = {".ply": b"ply\nformat binary_little_endian 1.0\n", ".spz": b"NGSP\x04\x00\x00\x00"}
    for suffix in (s for s in READABLE if not s.startswith(".usd")):
        data = starts.get(suffix, b"") + header.encode("utf-8", "surrogatepass") + b"\nend_header\n" + body
        assert not read_damaged(tmp_path / f"x{suffix}", data) or suffix == ".splat"


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd", ".usdz"])
def test_arbitrary_usd_is_refused(tmp_path: Path, suffix: str) -> None:
    """Neither nothing nor noise is a stage."""
    pytest.importorskip("pxr", reason="needs the extra [usd]")
    for data in (b"", b"#usda 1.0\ndef", b"PXR-USDC" + bytes(range(256))):
        assert not read_damaged(tmp_path / f"x{suffix}", data)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
        max_leaves=8,
    ),
    st.sampled_from(["version", "count", "means", "scales", "quats", "sh0", "shN"]),
)
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_arbitrary_json_values_are_refused(tmp_path: Path, value: Any, key: str) -> None:
    """Any JSON value in place of an entry gives a typed error (or the asset, if the value happens to fit)."""
    meta, images, _ = sog_members()
    path = write_sog(tmp_path / "sog", meta | {key: value}, images) / "meta.json"
    read_damaged(path, path.read_bytes())
