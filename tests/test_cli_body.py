"""The command ``softmode body``: what it writes, what it says, how it fails.

Builds bodies by the command, which is what it tests.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.optimize import brentq

from softmode.cli.main import main
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cubature import POISSON_RATIO
from softmode.errors import AssetError, ConfigError
from softmode.objects import ObjectConfig, load, surface_cover, write_object
from softmode.objects.object_file import file_kind, read_object
from softmode.splats import Splats, make_plush, write_ply
from softmode.splats.point_cloud import splats_from_points
from softmode.viz.body_picture import mode_frequencies
from tests.marks import rest_but
from tests.test_cli import listing

QUICK = ["--modes", "2", "--kernels", "60", "--points", "48", "--surface", "120", "--splats", "400"]


def merged(*parts: Splats) -> Splats:
    """Return one set of splats."""
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Splats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


def sphere_points() -> tuple[np.ndarray, np.ndarray]:
    """Return points on a sphere of 5 cm radius and their normals."""
    k = np.arange(2000) + 0.5
    polar, azimuth = np.arccos(1.0 - k / 1000.0), np.pi * (1.0 + np.sqrt(5.0)) * k
    normal = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    return 0.05 * normal, normal


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write assets of every kind, good and bad."""
    folder = tmp_path_factory.mktemp("assets")
    box = trimesh.creation.box((0.05, 0.04, 0.04))
    box.export(folder / "box.obj")
    trimesh.Trimesh(box.vertices, box.faces[2:], process=False).export(folder / "open.obj")
    corners = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(folder / "flat.obj")
    trimesh.creation.annulus(0.015, 0.04, 0.03).export(folder / "ring.glb")
    ball = trimesh.creation.icosphere(2, 0.02)
    other = ball.copy()
    other.apply_translation((0.12, 0.0, 0.0))
    trimesh.util.concatenate([ball, other]).export(folder / "two.stl")
    plush = make_plush(1000)
    write_ply(folder / "plush.ply", plush)
    speck = plush.subset(np.arange(40)).transformed(scale=0.1, translation=(0.12, 0.0, 0.05))
    write_ply(folder / "floater.ply", merged(plush, speck))
    points, normals = sphere_points()
    np.savez(folder / "cloud.npz", points=points, normals=normals, colors=(127.5 * (normals + 1.0)).astype(np.uint8))
    trimesh.PointCloud(points).export(folder / "points.ply")
    return folder


def run(assets: Path, command: str, name: str, *more: str) -> int:
    """Run a command on an asset; splat files of the plush have z up."""
    up = ["--up", "+z"] if name in ("plush.ply", "floater.ply") else []
    return main(["body", command, str(assets / name), *QUICK, *up, *more])


@pytest.mark.parametrize(
    "name",
    rest_but(["ring.glb", "cloud.npz"], ["plush.ply", "box.obj", "ring.glb", "cloud.npz", "points.ply"]),
)
def test_build_writes_a_body_with_its_splats(
    name: str, assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every kind of file becomes a body of the wanted size and counts that is found to be well."""
    out = tmp_path / "toy.npz"
    assert run(assets, "build", name, "-o", str(out), "--size", "0.06") == 0
    said = capsys.readouterr().out
    assert f"to {out}" in said and "warning" not in said and "broken" not in said
    assert listing(tmp_path) == ["toy.npz"]
    found = read_object(out)
    body, splats = found.body, found.splats
    assert ReducedBody.load(out).fingerprint == body.fingerprint
    assert splats is not None and splats.count >= 400
    assert np.ptp(body.bounds, axis=0).max() == pytest.approx(0.06, rel=0.02)
    assert (body.mode_count, body.point_count) == (2, 48)
    assert len(body.kernels.centres) in (60, 61)  # Beside a gap, as between the plush's legs, kernels may be added.
    near = np.linalg.norm(splats.means[:, None] - body.surface.points[None], axis=2).min(axis=1)
    assert near.max() < 0.012
    assert main(["body", "check", str(out)]) == 0
    assert f"{body.name}: all is well" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("open.obj", 1, ("warning: open mesh", "fill_holes", "usable, with warnings")),
        ("two.stl", 2, ("broken: loose parts", "separate parts                               2")),
    ],
)
def test_check_names_the_defect(
    name: str, code: int, words: tuple[str, ...], assets: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An open mesh and separate parts are diagnosed; the exit code tells how bad it is."""
    before = listing(assets)
    assert run(assets, "check", name) == code
    said = capsys.readouterr().out
    assert all(word in said for word in words), said
    assert listing(assets) == before


@pytest.mark.rest
def test_a_crop_cures_the_floater(assets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The remedy that is named works."""
    assert run(assets, "check", "floater.ply", "--crop", "-0.1", "-0.1", "-0.1", "0.1", "0.1", "0.2") == 0
    assert "left out" not in capsys.readouterr().out


def test_regions_and_stiffness_are_given_where_the_object_stands(assets: Path, tmp_path: Path) -> None:
    """On z = 0, centred: the lower centimetre is held exactly, the half x > 0 is ten times as stiff, and denser.

    What is not said, such as the number of surface samples, is as everywhere.
    """
    out = tmp_path / "box.npz"
    np.savez(tmp_path / "dense.npz", points=[[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]], factors=[1.0, 3.0])
    wide = "-inf,-inf,{},inf,inf,{}"
    regions = ["--region", "foot=" + wide.format("-inf", 0.01), "top=" + wide.format(0.035, "inf") + ",1e6"]
    stiffness = ["--stiffness", "half=0,-inf,-inf,inf,inf,inf,10"]
    stiffness += ["--density-file", str(tmp_path / "dense.npz")]
    size = ["--size", "0.05", "--modes", "2", "--kernels", "60", "--points", "200"]
    assert main(["body", "build", str(assets / "box.obj"), "-o", str(out), *size, *regions, *stiffness]) == 0
    body = ReducedBody.load(out)
    assert body.regions.names == ("foot", "top") and body.driven_count > 0
    assert body.regions.stiffness.tolist() == [0.0, 1e6]
    np.testing.assert_allclose(
        body.flat()["region_cores"][0, 1, 2] + body.offset[2], body.bounds[0, 2] + body.offset[2] + 0.01
    )
    right = body.cubature.points[:, 0] + body.offset[0] > 0.0
    assert set(body.cubature.stiffness_scale[right]) == {10.0} and set(body.cubature.stiffness_scale[~right]) == {1.0}
    assert body.offset[0] == pytest.approx(0.5 * 0.0125, rel=0.01)  # (3 - 1) / (3 + 1) of a quarter of the box's edge
    assert body.surface_count == ObjectConfig().surface_count and body.provenance["option_poissons_ratio"] is None
    assert main(["body", "check", str(out)]) == 0


def test_show_draws_modes_weights_and_spectra(assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The strip of modes differs from the body at rest, weights are red and blue, the text has the build's errors."""
    out = tmp_path / "toy.png"
    assert run(assets, "show", "box.obj", "-o", str(out)) == 0
    said = capsys.readouterr().out
    for words in (
        "cubature_force_error ",
        "eigenvalues [1/m^2]",
        "frequencies [Hz]",
        "grasp [mm, mm, deg]",
        f"wrote {out}",
    ):
        assert words in said
    assert listing(tmp_path) == ["toy.png"]
    picture = np.asarray(Image.open(out).convert("RGB")).astype(int)
    assert picture.shape[1] == 1400
    columns = np.array_split(picture[90:230], 7, axis=1)
    rest = columns[0].shape[1] - 4
    assert all(np.abs(c[:, :rest] - columns[0][:, :rest]).mean() > 3.0 for c in columns[1:])
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert (red > blue + 80).sum() > 1000 and (blue > red + 60).sum() > 1000  # the two ends of the weights
    found = read_object(_built(assets, tmp_path, "box.obj"))
    assert found.splats is not None and mode_frequencies(found.body, youngs_modulus=1e5, density=300.0)[0] > 0.0


def _built(assets: Path, folder: Path, name: str) -> Path:
    """Build an asset and return the file."""
    assert run(assets, "build", name, "-o", str(folder / "built.npz")) == 0
    return folder / "built.npz"


def timoshenko(length: float, height: float, modulus: float, density: float, poisson: float) -> float:
    """Return the first bending frequency [Hz] of a free square beam (Huang 1961, doi:10.1115/1.3641787, free ends)."""
    r2 = height**2 / 12.0 / length**2
    s2 = r2 * 2.0 * (1.0 + poisson) * (12.0 + 11.0 * poisson) / (10.0 * (1.0 + poisson))  # Cowper's shear factor

    def determinant(b: float) -> float:
        root = np.sqrt((r2 - s2) ** 2 + 4.0 / b**2)
        alpha, beta = np.sqrt(0.5 * (root - r2 - s2)), np.sqrt(0.5 * (root + r2 + s2))
        mixed = b / np.sqrt(1.0 - b**2 * r2 * s2) * (b**2 * r2 * (r2 - s2) ** 2 + 3.0 * r2 - s2)
        return 2.0 - 2.0 * np.cosh(b * alpha) * np.cos(b * beta) + mixed * np.sinh(b * alpha) * np.sin(b * beta)

    b = float(brentq(determinant, 15.0, 4.7301**2 + 1.0))
    return b * np.sqrt(modulus * height**2 / 12.0 / density) / length**2 / (2.0 * np.pi)


def test_first_frequency_of_a_beam() -> None:
    """The free beam of Timoshenko; the points have the second moment of area of its section."""
    length, modulus, density = 0.40, 2e5, 500.0
    quadrature = quadrature_from_box((length, 0.02, 0.02))
    height = float(np.sqrt(12.0 * quadrature.weights @ quadrature.points[:, 2] ** 2 / quadrature.volume))
    assert height == pytest.approx(0.02, rel=1e-9)
    body = build_body(quadrature)
    found = mode_frequencies(body, youngs_modulus=modulus, density=density)
    assert found[0] == pytest.approx(timoshenko(length, height, modulus, density, POISSON_RATIO), rel=0.01)
    assert found[1] == pytest.approx(found[0], rel=0.01)  # the two directions


def test_object_is_loaded_as_it_was_built(built: bytes, tmp_path: Path) -> None:
    """`ObjectConfig(body=...)` gives the same arrays, bit by bit, at the height at which it stands."""
    out = tmp_path / "built.npz"
    out.write_bytes(built)
    found = read_object(out)
    body, splats = found.body, found.splats
    thing = load(ObjectConfig(body=out, contact_radius=0.002))
    assert splats is not None
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(thing.splats, name), getattr(splats, name))
    np.testing.assert_array_equal(thing.body.cubature.grad_basis, body.cubature.grad_basis)
    assert thing.height == pytest.approx(0.002 - body.surface.points[:, 2].min())
    again = tmp_path / "again.npz"
    write_object(again, body, splats)
    assert read_object(again).body.fingerprint == body.fingerprint
    body.save(tmp_path / "bare.npz")  # a body without splats is shown by its surface samples
    bare = load(ObjectConfig(body=tmp_path / "bare.npz"))
    np.testing.assert_allclose(bare.visible_splats.means, surface_cover(body).means)
    for given in ({"splat": "a.ply"}, {"mesh": "a.obj"}, {"clamped_height": 0.01}):
        with pytest.raises(ConfigError):
            ObjectConfig(body=out, **given)


def test_splats_of_points_lie_in_the_surface() -> None:
    """The thin axis is the normal, given or found; the discs are as wide as the points are apart."""
    points, normals = sphere_points()
    pitch = np.sqrt(4.0 * np.pi * 0.05**2 / 2000)
    for given in (normals, None):
        splats = splats_from_points(points, given)
        thin = np.linalg.eigh(splats.covariances())[1][:, :, 0]
        assert np.abs((thin * normals).sum(axis=1)).min() > 0.98
        assert np.median(splats.scales[:, 0]) == pytest.approx(0.6 * pitch, rel=0.25)
    np.testing.assert_allclose(splats_from_points(points, normals, np.full((2000, 3), 51)).colors(), 0.2, atol=1e-6)


BAD_POINTS = {
    "shape": (np.zeros((10, 2)), None),
    "three": (np.eye(3), None),
    "nan": (np.full((10, 3), np.nan), None),
    "one place": (np.zeros((10, 3)), None),
    "normals": (np.random.default_rng(0).normal(size=(10, 3)), np.zeros((9, 3))),
}


@pytest.mark.parametrize("case", BAD_POINTS)
def test_points_that_are_none_are_refused(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Bad arrays are an AssetError, on the command line one line."""
    points, normals = BAD_POINTS[case]
    with pytest.raises(AssetError):
        splats_from_points(points, normals)
    np.savez(tmp_path / "bad.npz", points=points, **({} if normals is None else {"normals": normals}))
    assert main(["body", "check", str(tmp_path / "bad.npz")]) == 2
    assert "bad.npz" in capsys.readouterr().err


def cut(path: Path) -> None:
    """Keep half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def scramble(path: Path) -> None:
    """Change bytes in the middle of an array."""
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 64] = bytes(64)
    path.write_bytes(data)


def rewritten(change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Path], None]:
    """Return what changes the arrays of a file."""

    def apply(path: Path) -> None:
        with np.load(path) as file:
            arrays = {key: file[key] for key in file.files}
        change(arrays)
        np.savez(path, **arrays)

    return apply


def other_version(arrays: dict[str, np.ndarray]) -> None:
    """Claim another version of the format."""
    header = json.loads(arrays["header"].tobytes())
    arrays["header"] = np.frombuffer(json.dumps({**header, "version": 99}).encode(), dtype=np.uint8)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut": cut,
    "scrambled": scramble,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("hello"),
    "version": rewritten(other_version),
    "no points": rewritten(lambda arrays: arrays.pop("points") is None),
    "nan": rewritten(lambda arrays: arrays.update(weights=np.full_like(arrays["weights"], np.nan))),
    "half of the splats": rewritten(lambda arrays: arrays.update({"splats.means": arrays["splats.means"][::2]})),
    "no colours": rewritten(lambda arrays: arrays.pop("splats.sh") is None),
}


@pytest.fixture(scope="module")
def built(assets: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the bytes of a body's file."""
    return _built(assets, tmp_path_factory.mktemp("built"), "box.obj").read_bytes()


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_bodies_are_typed_errors(
    kind: str, built: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every damaged body is an AssetError that names the file; the command line says so in one line."""
    file = tmp_path / "toy.npz"
    file.write_bytes(built)
    DAMAGE[kind](file)
    with pytest.raises(AssetError, match=r"toy\.npz"):
        file_kind(file)
        load(file)
    assert main(["body", "check", str(file)]) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("softmode: error: ")]
    assert len(error) == 1 and "toy.npz" in error[0] and ". " in error[0]


FAILURES = {
    "missing": (["check", "{folder}/none.ply"], "none.ply"),
    "unknown kind": (["check", "{folder}/text.docx"], "text.docx"),
    "no volume": (["check", "{assets}/flat.obj"], "flat.obj"),
    "out is no npz": (["build", "{assets}/box.obj", "-o", "{folder}/toy.ply"], "toy.ply"),
    "no folder": (["build", "{assets}/box.obj", "-o", "{folder}/none/toy.npz"], "none"),
    "over the source": (["build", "{assets}/cloud.npz"], "cloud.npz"),
    "picture is no png": (["show", "{assets}/box.obj", "-o", "{folder}/toy.jpg"], "toy.jpg"),
    "density": (["show", "{assets}/box.obj", "-o", "{folder}/a.png", "--density", "0"], "density"),
    "crop of a mesh": (["check", "{assets}/box.obj", "--part", "all"], "box.obj"),
    "region without name": (["check", "{assets}/box.obj", "--region", "0,0,0,1,1,1"], "region"),
    "region of five": (["check", "{assets}/box.obj", "--region", "a=0,0,0,1,1"], "region"),
    "region outside": (["check", "{assets}/box.obj", "--region", "a=5,5,5,6,6,6"], "region 'a'"),
    "stiffness outside": (["check", "{assets}/box.obj", "--stiffness", "a=5,5,5,6,6,6,2"], "stiffness"),
    "stiffness of zero": (["check", "{assets}/box.obj", "--stiffness", "a=0,0,0,1,1,1,0"], "factor"),
    "no modes": (["check", "{assets}/box.obj", "--modes", "0"], "mode_count"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_expected_errors_are_one_line_and_leave_nothing(
    case: str, assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, one line that names the argument, no traceback, no new file."""
    (tmp_path / "text.docx").write_text("no mesh")
    arguments, name = FAILURES[case]
    before = listing(tmp_path), listing(assets)
    assert main(["body", *(word.format(folder=tmp_path, assets=assets) for word in arguments)]) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("softmode: error: ")]
    assert len(lines) == 1 and name in lines[0] and "Traceback" not in error
    assert (listing(tmp_path), listing(assets)) == before


def test_a_body_takes_no_options_of_its_asset(built: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is built cannot be built again from its own file, nor resized in play."""
    file = tmp_path / "toy.npz"
    file.write_bytes(built)
    assert main(["body", "check", str(file), "--size", "0.1"]) == 2
    assert "--size" in capsys.readouterr().err
    assert main(["body", "build", str(file), "-o", str(tmp_path / "other.npz")]) == 2
    assert "is a body already" in capsys.readouterr().err
    assert main(["play", "softmode/LiftSoft-v0", "--object", str(file), "--size", "0.1"]) == 2
    assert "size given for the body" in capsys.readouterr().err


@pytest.mark.slow
def test_play_lifts_a_body(assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A body file is an object of the environments."""
    out = tmp_path / "box.npz"
    assert main(["body", "build", str(assets / "box.obj"), "-o", str(out), "--size", "0.06"]) == 0
    assert main(["play", "softmode/LiftSoft-v0", "--object", str(out), "--youngs-modulus", "1e5"]) == 0
    said = capsys.readouterr().out
    assert "body 'box.obj'" in said and "success: True" in said


def test_cut_writes_the_parts(assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A mesh and a saved body are cut at heights over the ground; volumes add up, a plane beside says so."""
    whole = tmp_path / "box.npz"
    assert main(["body", "build", str(assets / "box.obj"), *QUICK, "-o", str(whole)]) == 0
    height = 0.04 * 0.08 / 0.05
    plane = f"0,0,{0.4 * height},0,0,1"
    assert main(["body", "cut", str(whole), "--plane", plane, "--inside", "1", "0", "0"]) == 0
    assert "is cut into 2 parts" in capsys.readouterr().out
    parts = [read_object(tmp_path / f"box-{k}.npz") for k in (1, 2)]
    body = ReducedBody.load(whole)
    assert abs(sum(part.body.volume for part in parts) / body.volume - 1.0) < 1e-12
    np.testing.assert_allclose(parts[0].body.volume / body.volume, 0.6, atol=0.01)
    assert all(part.visible_splats.count > 50 for part in parts)
    across = f"0,0,{0.5 * height},1,0,0"
    arguments = ["body", "cut", str(assets / "box.obj"), *QUICK, "--plane", plane, across]
    assert main([*arguments, "-o", str(tmp_path / "four.npz")]) == 0
    assert len(list(tmp_path.glob("four-*.npz"))) == 4
    capsys.readouterr()
    assert main(["body", "cut", str(whole), "--plane", "0,0,1,0,0,1", "-o", str(tmp_path / "none.npz")]) == 1
    assert "misses" in capsys.readouterr().out and not list(tmp_path.glob("none*"))
    for wrong, told in (([], "no plane"), (["--plane", "0,0,1"], "6 numbers"), (["--plane", "0,0,0,0,0,0"], "normal")):
        assert main(["body", "cut", str(whole), *wrong]) == 2
        assert told in capsys.readouterr().err
