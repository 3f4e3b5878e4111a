"""Splats and points as other programs lay them out: each kind with its right value, and what is left out is said."""

from __future__ import annotations

import gzip
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib import recfunctions

from softmode.cli.main import main
from softmode.errors import AssetError
from softmode.objects.object_file import file_kind
from softmode.splats import Splats, read_splats
from softmode.splats.formats.others import OTHERS
from softmode.splats.point_cloud import read_points, splats_from_points
from tests.splats.test_formats import sog_members, write_sog

NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
FORMS = {"<": "binary_little_endian", ">": "binary_big_endian", "ascii": "ascii"}
INRIA = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
SHAPE = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def tables(count: int = 24, columns: tuple[str, ...] = INRIA + SHAPE, kind: str = "f4") -> np.ndarray:
    """Return a vertex table of splats of scale 0.1 that are half opaque and unrotated."""
    table = np.zeros(count, dtype=[(name, kind) for name in columns])
    for name in columns:
        table[name] = {"x": np.arange(count), "y": np.arange(count) % 5, "rot_0": 1.0}.get(name, 0.0)
        if name.startswith("scale_"):
            table[name] = np.log(0.1)
    return table


def ply_of(
    table: np.ndarray, form: str = "<", *, before: bytes = b"", after: bytes = b"", lists: bool = False
) -> bytes:
    """Return a .ply of a vertex table, with a list of two integers in every row if asked for."""
    order = "=" if form == "ascii" else form
    lines = ["ply", f"format {FORMS[form]} 1.0", "comment by hand", *before.decode().splitlines()]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property {NAMES[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names or ()]
    lines += ["property list uchar int near"] * lists + after.decode().splitlines()
    head = "\n".join([*lines, "end_header\n"]).encode()
    if form == "ascii":
        return head + "\n".join(" ".join(f"{x:.9g}" for x in row) + " 2 7 8" * lists for row in table).encode()
    rows = table.astype(table.dtype.newbyteorder(order))
    tail = np.array([2], "u1").tobytes() + np.array([7, 8], order + "i4").tobytes()
    return head + (b"".join(row.tobytes() + tail for row in rows) if lists else rows.tobytes())


def read(tmp_path: Path, table: np.ndarray, form: str = "<", **options: Any) -> Splats:
    """Write a .ply and read it."""
    (tmp_path / "case.ply").write_bytes(ply_of(table, form, **options))
    return read_splats(tmp_path / "case.ply")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("lists", [False, True])
def test_text_and_both_byte_orders(tmp_path: Path, form: str, kind: str, lists: bool) -> None:
    """Numbers are the same however they are written; a list in each row is passed over."""
    splats = read(tmp_path, tables(kind=kind), form, lists=lists)
    np.testing.assert_array_equal(splats.means[:, 0], np.arange(24))
    np.testing.assert_allclose(splats.scales, 0.1, rtol=1e-6)
    np.testing.assert_array_equal(splats.opacities, 0.5)
    assert splats.quats[0].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("form", FORMS)
def test_elements_beside_vertices_are_skipped_and_said(tmp_path: Path, form: str) -> None:
    """Tables and lists that stand before or after the splats do not matter; notes name them."""
    table = tables()
    face = b"element face 2\nproperty list uchar int vertex_indices\n"
    camera = b"element camera 1\nproperty float focal\n"
    head, _, data = ply_of(table, form, before=face, after=camera).partition(b"end_header\n")
    if form == "ascii":
        between, tail = b"3 0 1 2\n4 0 1 2 3\n", b"\n0.5\n"
    else:
        corners = (np.array(one, form + "i4").tobytes() for one in ((0, 1, 2), (0, 1, 2, 3)))
        between = b"".join(bytes([n]) + one for n, one in zip((3, 4), corners, strict=True))
        tail = np.array([0.5], form + "f4").tobytes()
    (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + between + data + tail)
    splats = read_splats(tmp_path / "a.ply")
    assert splats.count == 24 and splats.means[23, 0] == 23.0
    assert splats.notes == ("elements that are not read: 2 face, 1 camera",)
    assert file_kind(tmp_path / "a.ply") == "splat"


@pytest.mark.parametrize("names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
@pytest.mark.parametrize(("kind", "full"), [("u1", 255), ("u2", 65535), ("f4", 1.0), ("f4", 255.0)])
def test_splats_are_what_has_scales_and_rotations(tmp_path: Path, names: str, kind: str, full: float) -> None:
    """Colours under other names are no reason to lose scales, rotations and opacities."""
    table = tables(columns=("x", "y", "z", "opacity", *SHAPE))
    colors = np.zeros(24, dtype=[(name, kind) for name in names.split()])
    colors[names.split()[0]] = full
    splats = read(tmp_path, recfunctions.merge_arrays([table, colors], flatten=True))
    assert file_kind(tmp_path / "case.ply") == "splat"
    np.testing.assert_allclose(splats.colors(), np.tile([1.0, 0.0, 0.0], (24, 1)), atol=1e-6)
    np.testing.assert_array_equal(splats.opacities, 0.5)
    assert bool(splats.notes) == (kind == "f4" and full > 1.0)


def test_discs_filters_and_degrees(tmp_path: Path) -> None:
    """Scales of -inf make discs, filter_3D widens and fades, degree 4 is cut, and absent columns are said."""
    table = tables()
    table["scale_2"] = -np.inf
    splats = read(tmp_path, table)
    np.testing.assert_allclose(splats.scales[0], [0.1, 0.1, 1e-4], rtol=1e-5)
    assert splats.notes[0].startswith("24 discs")

    filtered = recfunctions.append_fields(tables(), "filter_3D", np.full(24, 0.1, "f4"), usemask=False)
    splats = read(tmp_path, filtered)
    np.testing.assert_allclose(splats.scales, 0.1 * np.sqrt(2.0), rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, 0.5 * 0.5**1.5, rtol=1e-6)
    assert "filter_3D" in splats.notes[0]

    rest = np.tile(np.arange(72.0), (24, 1)).astype("f4")
    high = recfunctions.append_fields(tables(), [f"f_rest_{i}" for i in range(72)], list(rest.T), usemask=False)
    splats = read(tmp_path, high)
    np.testing.assert_array_equal(splats.sh[0, 1:, 1], 24 + np.arange(15))
    assert splats.notes == ("spherical harmonics of degree 4 are cut to degree 3",)

    splats = read(tmp_path, tables(columns=("x", "y", "z", "label", "scale_0", *SHAPE[3:])))
    np.testing.assert_allclose(splats.scales, 0.1, rtol=1e-6)
    assert splats.notes == ("has no colours: grey", "has no opacities: opaque", "properties that are not read: label")


def test_rows_that_are_not_sound_are_dropped_and_counted(tmp_path: Path) -> None:
    """Each row with NaN, no rotation or no size is left out, by count and cause; above 1 % a warning is raised."""
    table = tables(300)
    table["x"][3], table["rot_0"][5], table["scale_0"][7] = np.nan, 0.0, np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        splats = read(tmp_path, table)
    assert splats.count == 297 and splats.dropped_count == 3
    for cause in ("1 with means not finite", "1 with scales not finite", "1 without a rotation"):
        assert cause in splats.notes[0], cause
    table["y"][:3] = np.inf
    with pytest.warns(UserWarning, match=r"6 of 300 splats dropped.*case\.ply CLEAN\.ply --drop-invalid"):
        read(tmp_path, table)
    table["z"] = np.nan
    with pytest.raises(AssetError, match=r"case\.ply: none of 300 splats is sound"):
        read(tmp_path, table)


def test_far_coordinates_are_centred_before_they_are_float32(tmp_path: Path) -> None:
    """Doubles of a map projection keep millimetres: means and offset together are the file's numbers."""
    table = tables(kind="f8")
    table["x"] = 4.0e5 + 1e-3 * np.arange(24)
    table["y"] = 5.0e6 + 1e-3 * (np.arange(24) % 5)
    splats = read(tmp_path, table)
    np.testing.assert_allclose(splats.means + np.array(splats.offset), [list(row)[:3] for row in table], atol=1e-9)
    assert splats.offset[:2] == (4.0e5, 5.0e6) and "offset" in splats.notes[0]
    up = splats.oriented("+y")
    np.testing.assert_allclose(up.means[:, 2] + up.offset[2], table["y"], atol=1e-9)
    assert splats.cropped([4.0e5, 0, -1], [4.0e5 + 0.0045, 6e6, 1]).count == 5


def test_points_of_every_layout(tmp_path: Path) -> None:
    """Points keep colours of any scale, normals, and their place; what is not finite or not read is said."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    away = np.array([4.0e5, 5.0e6, 100.0])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    red = np.tile([255.0, 0.0, 0.0], (200, 1))
    assert splats_from_points(points, None, red).colors()[0].tolist() == [1.0, 0.0, 0.0]
    lost = points.copy()
    lost[7] = np.nan
    found = splats_from_points(lost, None, red)
    assert found.count == 199 and found.notes[0] == "1 of 200 points dropped (1 not finite)"
    found = splats_from_points(points + away)
    np.testing.assert_allclose(found.means + np.array(found.offset), points + away, atol=1e-6)

    def text(name: str, header: str, rows: np.ndarray, comma: str = " ") -> Splats:
        lines = [comma.join(f"{x:.6f}" for x in row) for row in rows]
        (tmp_path / name).write_text("\n".join([header, *lines]))
        return read_points(tmp_path / name)

    for found in (
        text("a.xyz", "X Y Z R G B", np.hstack([points, red])),
        text("b.xyz", "200", np.hstack([points, red]), ","),
        text("c.xyz", "// by a scanner", np.hstack([points, 0.3 * red[:, :1], red])),
        text("d.xyz", "# x y z nx ny nz r g b", np.hstack([points, points, red])),
    ):
        assert found.count == 200 and found.colors()[0].tolist() == [1.0, 0.0, 0.0]
    assert text("e.xyz", "X Y Z", points).notes == ("header: X Y Z",)

    table = np.zeros(200, dtype=[*((n, "f8") for n in ("x", "y", "z")), *((n, "u1") for n in "rgb"), ("time", "f4")])
    table["x"], table["y"], table["z"] = (points + away).T
    table["r"] = 255
    (tmp_path / "a.ply").write_bytes(ply_of(table, ">", after=b"element face 0\nproperty list uchar int i\n"))
    assert file_kind(tmp_path / "a.ply") == "points"
    found = read_points(tmp_path / "a.ply")
    np.testing.assert_allclose(found.means + np.array(found.offset), points + away, atol=1e-6)
    assert found.colors()[0].tolist() == [1.0, 0.0, 0.0] and "time" in found.notes[0]


def test_flags_and_folders_of_archives(tmp_path: Path) -> None:
    """A .sog packed with its folder is read, and SOG and SPZ say that they want an antialiased rasteriser."""
    meta, images, truth = sog_members()
    write_sog(tmp_path / "toy", meta | {"antialias": True}, images)
    with zipfile.ZipFile(tmp_path / "toy.sog", "w") as archive:
        for member in (tmp_path / "toy").iterdir():
            archive.write(member, f"toy/{member.name}")
    splats = read_splats(tmp_path / "toy.sog")
    np.testing.assert_allclose(splats.opacities, truth["opacities"], atol=1e-6)
    assert "antialiased" in splats.notes[0]
    head = struct.pack("<4sIIBBBB", b"NGSP", 2, 4, 0, 12, 1, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(range(4 * 19))))
    assert "antialiased" in read_splats(tmp_path / "a.spz").notes[0]


def test_kinds_that_nobody_reads_name_what_does(tmp_path: Path) -> None:
    """A kind that is known and not read is refused with the command that converts it, with the file in it."""
    for suffix in OTHERS:
        (tmp_path / f"toy{suffix}").write_bytes(b"x")
        for reader in (read_splats, file_kind):
            with pytest.raises(AssetError, match="which softmode does not read") as caught:
                reader(tmp_path / f"toy{suffix}")
            assert "convert it: " in caught.value.hint and "{" not in caught.value.hint
    assert "ns-export" in OTHERS[".ckpt"][1] and "splat-transform" in OTHERS[".ksplat"][1]


def test_convert_drops_invalid_rows_if_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`splat convert` refuses a file with unsound rows, names the option, and with it writes the rest and says so."""
    table = tables()
    table["z"][1] = np.nan
    (tmp_path / "a.ply").write_bytes(ply_of(table))
    command = ["splat", "convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]
    assert main(command) != 0
    assert "--drop-invalid" in capsys.readouterr().err and not (tmp_path / "b.ply").exists()
    assert main([*command, "--drop-invalid"]) == 0
    assert "1 of 24 splats dropped" in capsys.readouterr().out
    assert read_splats(tmp_path / "b.ply").notes == ()
