"""Files of strangers: what is small and would become large, is no file, leads elsewhere, or is no number."""

from __future__ import annotations

import io
import json
import os
import socket
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softmode.checks import require_choice, require_number, require_numbers
from softmode.errors import AssetError, ConfigError, RunError, SoftmodeError, StateError
from softmode.files import (
    UNPACKED_FREE,
    array_names,
    open_file,
    read_archive,
    read_arrays,
    read_json,
    write_archive,
    write_compressed,
)
from tests.attack import attack
from tests.fuzz_seeds import READERS, array_seeds


def npy(array: np.ndarray, **header: Any) -> bytes:
    """Return the bytes of a .npy file, with another header if one is given."""
    stream = io.BytesIO()
    told = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape} | header
    np.lib.format.write_array_header_1_0(stream, told)
    return stream.getvalue() + array.tobytes()


def packed(**members: bytes) -> bytes:
    """Return a compressed .npz."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


def overlapping(names: list[str], content: bytes) -> bytes:
    """Return an archive whose members are one content: each local header has those that follow for its extra field."""
    files = [f"{name}.npy".encode() for name in names]
    rest = sum(30 + len(name) for name in files)
    crc, size, heads, table = zlib.crc32(content), len(content), b"", b""
    for name in files:
        rest -= 30 + len(name)
        common = struct.pack("<HHHHHIIIHH", 20, 0, 0, 0, 33, crc, size, size, len(name), rest)
        table += b"PK\1\2\x14\0" + common[:-2] + struct.pack("<HHHHII", 0, 0, 0, 0, 0, len(heads)) + name
        heads += b"PK\3\4" + common + name
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, len(files), len(files), len(table), len(heads) + size, 0)
    return heads + content + table + end


def bombs() -> dict[str, tuple[bytes, str]]:
    """Return small files that would become large, and what their refusal says, by format and name."""
    zeros, many = np.zeros(96 << 20, np.uint8), [f"a{k:04}" for k in range(1200)]
    header = npy(np.frombuffer(json.dumps({"format": "softmode.Checkpoint", "version": 1}).encode(), np.uint8))
    points = npy(zeros.view("<f4").reshape(-1, 3))
    line = np.repeat(np.arange(300_000, dtype="<f4")[:, None], 3, axis=1)
    empty = npy(np.zeros(0), shape=(2**40, 0))
    table = packed(points=b"")[:-22] + struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 9, 9, 5 << 20, 0, 0)
    return {
        "checkpoint@.npz": (overlapping(many, npy(np.zeros(1 << 18))), "overlap"),
        "body@.npz": (packed(header=header, a=header), "packed by method"),
        "points@.npz": (packed(points=points), "unpacks to"),
        "points@ of one place.npz": (packed(points=npy(np.ones((10**6, 3), "<f4"))), "coincide"),
        "points@ that are empty.npz": (packed(points=empty), "shape"),
        "points@ of a table.npz": (table, "table of contents"),
        "points@ on a line.npz": (packed(points=npy(line)), ""),
        "paint@.npz": (packed(points=points, factors=npy(zeros)), "unpacks to"),
        "recording@.npz": (packed(q=npy(zeros)), "unpacks to"),
        "radiance@.npz": (packed(density=npy(np.zeros(192 << 20, "u1")), bounds=npy(np.zeros((2, 3)))), "unpacks to"),
        "radiance@ of links.npz": (
            packed(
                links=npy(np.full((220, 220, 220), -1, "<i4")), density_data=npy(np.ones((1, 1))),
                sh_data=npy(np.ones((1, 12))), radius=npy(np.ones(3)), center=npy(np.zeros(3)),
            ),
            "fill a grid",
        ),
        "state@.npz": (packed(header=header, a=npy(zeros)), "unpacks to"),
    }  # fmt: skip


def test_what_is_small_and_would_become_large(tmp_path: Path) -> None:
    """Members over each other, arrays that unpack without measure, empty ones of great length: refused in time."""
    paths, words = [], []
    (tmp_path / "sound").mkdir()
    for name, (suffix, _, contents) in array_seeds(tmp_path).items():  # read first, so that imports do not count
        (tmp_path / "sound" / f"0@{name}@{suffix}").write_bytes(contents[0])
    for k, (name, (content, word)) in enumerate(bombs().items()):
        paths.append(tmp_path / f"{k}@{name}")
        paths[-1].write_bytes(content)
        words.append(word)
    for path, word, outcome in zip(
        paths, words, attack("tests.fuzz:read", paths, warm=tmp_path / "sound"), strict=True
    ):
        assert outcome.typed and bool(outcome.error) == bool(word) and word in outcome.message, (path, outcome)
        assert outcome.memory <= 8 * path.stat().st_size + 300e6, (path, outcome)


OWN = ("ply", "splat", "spz 3", "sog", "points", "points ply", "paint", "radiance", "nanovdb", "body", "morph",
       "recording", "state", "checkpoint")  # fmt: skip
"""Formats whose files softmode opens itself."""


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder"])
def test_what_is_no_file(tmp_path: Path, kind: str) -> None:
    """A named pipe, a socket, a device and a folder are refused by every reader, and none waits for them."""
    suffixes = {
        "ply": ".ply",
        "points ply": ".ply",
        "splat": ".splat",
        "spz 3": ".spz",
        "sog": ".sog",
        "nanovdb": ".nvdb",
    }
    for name in OWN:
        path = tmp_path / f"{name}{suffixes.get(name, '.npz')}"
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            with socket.socket(socket.AF_UNIX) as server:
                server.bind(str(path))
        elif kind == "device":
            path.symlink_to("/dev/zero")
        else:
            path.mkdir()
        with pytest.raises(SoftmodeError) as caught:
            READERS[name](path)
        assert caught.value.hint


@pytest.mark.parametrize("name", ["a" * 300 + ".npz", "a\0b.npz", os.fsdecode(b"\xff\xfe.npz"), "missing.npz"])
def test_names_that_no_file_has(tmp_path: Path, name: str) -> None:
    """Too long, with a zero byte, in no encoding: a typed error that can be printed anywhere."""
    for reader in (
        *(READERS[name] for name in ("points", "paint", "body", "radiance", "recording")),
        open_file,
        read_json,
    ):
        with pytest.raises(AssetError) as caught:
            reader(tmp_path / name)
        str(caught.value).encode("utf-8")
    shown = str(AssetError("a\x1b[31mred\ud800", hint="do\x07"))
    assert shown == "a\\x1b[31mred\\ud800. Do\\x07"


def test_nothing_outside_of_an_asset_is_read(tmp_path: Path) -> None:
    """Links that lead out of a SOG folder are refused by its reader and by what takes the fingerprint of its files."""
    from softmode.objects.fingerprint import file_fingerprint
    from softmode.splats import read_splats
    from tests.splats.test_formats import sog_members, write_sog

    meta, images, _ = sog_members()
    folder = write_sog(tmp_path / "sog", meta, images)
    assert read_splats(folder).count
    outside = tmp_path / "elsewhere.webp"
    (folder / "means_l.webp").rename(outside)
    (folder / "means_l.webp").symlink_to(outside)
    for read in (read_splats, file_fingerprint):
        with pytest.raises(AssetError, match="outside"):
            read(folder)


def test_what_packs_well_is_read(tmp_path: Path) -> None:
    """Compressed arrays within the limit open; what our writers would pack beyond it they do not pack."""
    noise, zeros = np.random.default_rng(0).random(1000), np.zeros(UNPACKED_FREE // 8 + 1000)
    write_compressed(tmp_path / "a.npz", {"a": noise, "name": np.array("x")})
    assert read_arrays(tmp_path / "a.npz")["a"].tobytes() == noise.tobytes() and array_names(tmp_path / "a.npz") == {
        "a",
        "name",
    }
    write_compressed(tmp_path / "b.npz", {"a": zeros})
    assert read_arrays(tmp_path / "b.npz")["a"].size == zeros.size
    np.savez_compressed(tmp_path / "c.npz", a=zeros, b=noise)
    with pytest.raises(AssetError, match="unpacks to"):
        read_arrays(tmp_path / "c.npz")
    assert list(read_arrays(tmp_path / "c.npz", ("b",))) == ["b"], "only what is asked for counts"
    fortran = np.asfortranarray(noise.reshape(10, 100))
    write_archive(tmp_path / "d.npz", {"format": "x", "version": 1}, {"a": fortran, "e": np.zeros((0, 3))})
    found = read_archive(tmp_path / "d.npz", "x", 1)[1]
    assert np.array_equal(found["a"], fortran) and found["a"].flags.f_contiguous and found["e"].shape == (0, 3)


def test_many_names_and_large_files_are_read(tmp_path: Path) -> None:
    """An archive of a thousand arrays, and one with the table of contents of zip64, are no damage."""
    content = {f"array number {k}": np.arange(3.0) for k in range(1000)}
    np.savez(tmp_path / "a.npz", **content)
    assert read_arrays(tmp_path / "a.npz").keys() == content.keys()
    data = (tmp_path / "a.npz").read_bytes()
    _, _, _, _, count, size, start, _ = struct.unpack("<4sHHHHIIH", data[-22:])
    at = len(data) - 22
    record = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, start)
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, at, 1)
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 2**32 - 1, 2**32 - 1, 0)
    (tmp_path / "b.npz").write_bytes(data[:at] + record + locator + end)
    assert read_arrays(tmp_path / "b.npz").keys() == content.keys()
    larger = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, 1 << 21, start)
    (tmp_path / "b.npz").write_bytes(data[:at] + larger + locator + end)
    with pytest.raises(AssetError, match="table of contents"):
        read_arrays(tmp_path / "b.npz")


@pytest.mark.parametrize("value", [10**400, 10**5000, "x", [1.0], {}, None], ids=["long", "longer", *"abcd"])
def test_numbers_that_no_float_holds(value: object) -> None:
    """They are refused like words, and shown as far as they can be."""
    with pytest.raises(ConfigError, match="x must be a finite number"):
        require_number("x", value)
    with pytest.raises(ConfigError, match="x"):
        require_numbers("x", value, 2)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="x is"):
        require_choice("x", value, {1: 2})


def test_json_without_end(tmp_path: Path) -> None:
    """Nested beyond what Python follows, or larger than a JSON file is: the reader's own error."""
    from softmode.envs.tasks.push_soft.task import PushSoftConfig
    from softmode.learning.config_values import config_of, located_options
    from softmode.learning.run_folder import RunFolder

    tree: dict[str, Any] = {}
    for _ in range(700):
        tree = {"scene": tree}
    for read in (lambda: config_of(PushSoftConfig, tree), lambda: located_options(tree, tmp_path)):
        with pytest.raises(ConfigError):
            read()
    (tmp_path / "latest.npz").touch()
    for content in ("[" * 100_000, "[]", "{", '{"a": ' + "1" * 5000 + "}", " " * (17 << 20)):
        (tmp_path / "config.json").write_text(content)
        with pytest.raises(RunError):
            RunFolder(tmp_path, resume=True).read_config()


def test_states_that_are_no_numbers(tmp_path: Path) -> None:
    """NaN among the numbers of a saved state, and draws in a state that no generator has."""
    from softmode.envs.env_state import EnvState, generator_state

    draws = generator_state(np.random.default_rng(0))
    assert draws is not None
    huge = {**draws, "state": {"state": 2**200, "inc": 1}}
    cases: tuple[tuple[float, Any], ...] = ((np.nan, draws), (np.inf, draws), (0.0, huge), (0.0, [1]), (0.0, {"a": 1}))
    for value, random in cases:
        EnvState(owner={}, arrays={"a": np.full((1, 2), value)}, random=(random,)).save(tmp_path / "a.npz")
        with pytest.raises(StateError):
            EnvState.load(tmp_path / "a.npz")


def test_points_and_normals_beyond_all_measure() -> None:
    """Squares of coordinates that no float holds are refused; points given several times are told apart from others."""
    from softmode.splats.point_cloud import splats_from_points

    x = np.random.default_rng(0).normal(size=(50, 3))
    for points, normals in ((1e200 * x, None), (x, 1e200 * x), (x, np.full_like(x, np.nan))):
        with pytest.raises(AssetError):
            splats_from_points(points, normals)
    once, thrice = splats_from_points(x), splats_from_points(np.repeat(x, 3, axis=0))
    np.testing.assert_array_equal(thrice.scales[::3], once.scales)
    np.testing.assert_array_equal(thrice.quats[::3], once.quats)


def test_memory_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What cannot be allocated is a typed error that says how much was asked for."""
    write_compressed(tmp_path / "a.npz", {"a": np.zeros(5)})

    def empty(count: int, dtype: np.dtype) -> np.ndarray:
        return np.zeros(2**62, np.uint8)

    monkeypatch.setattr("softmode.files.np.empty", empty)
    with pytest.raises(AssetError, match=r"more memory than there is \(.*allocate.*EiB"):
        read_arrays(tmp_path / "a.npz")
