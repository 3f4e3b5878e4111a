"""OpenUSD splats: stages authored with OpenUSD itself, transforms, units, animation, and what Newton reads."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softmode.errors import AssetError, ConfigError, MissingExtraError, StorageError
from softmode.foreign import process
from softmode.splats import Splats, read_splats, write_splats, write_usd
from softmode.splats.formats import read_usd
from softmode.splats.splats import sh_basis, up_rotation
from tests.splats.test_splats import random_splats

pytest.importorskip("pxr", reason="needs the extra [usd]")
Gf, Sdf, Usd, UsdGeom, UsdVol, Vt = (
    importlib.import_module(f"pxr.{name}") for name in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdVol", "Vt")
)

EPSILON = float(np.finfo(np.float32).eps)


def new_stage(path: Path, *, up: str = "Z", meters: float | None = 1.0) -> Any:
    """Return a new stage."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    if meters is not None:
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    return stage


def author(stage: Any, path: str, splats: Splats, *, half: bool = False) -> Any:
    """Author a splat prim element by element, independently of the writer under test; return it."""
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    vector, quat, number = (Gf.Vec3h, Gf.Quath, float) if half else (Gf.Vec3f, Gf.Quatf, float)
    rows = {
        "positions": [vector(*map(float, row)) for row in splats.means],
        "orientations": [quat(float(w), float(x), float(y), float(z)) for x, y, z, w in splats.quats],
        "scales": [vector(*map(float, row)) for row in splats.scales],
        "opacities": [number(value) for value in splats.opacities],
        "radiance:sphericalHarmonicsCoefficients": [
            vector(*map(float, coefficient)) for splat in splats.sh for coefficient in splat
        ],
    }
    for name, values in rows.items():
        assert prim.GetPrim().GetAttribute(name + ("h" if half else "")).Set(values)
    prim.GetPrim().GetAttribute("radiance:sphericalHarmonicsDegree").Set(splats.sh_degree)
    return prim


def assert_equal(one: Splats, other: Splats, *, step: float = 0.0) -> None:
    """Assert that two sets of splats are equal to a relative step."""
    for name in ("means", "scales", "opacities", "sh"):
        expected = getattr(other, name)
        np.testing.assert_allclose(
            getattr(one, name), expected, rtol=step, atol=step * np.abs(expected).max(), err_msg=name
        )
    np.testing.assert_allclose(one.covariances(), other.covariances(), atol=4 * (step + EPSILON) * 0.1**2)


def seen_colors(splats: Splats, directions: np.ndarray) -> np.ndarray:
    """Return the colour functions of all splats in some directions, shape (N, directions, 3)."""
    return np.einsum("dk,nkc->ndc", sh_basis(directions, splats.sh.shape[1]), splats.sh)


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_round_trip_is_exact(tmp_path: Path, coefficients: int, suffix: str) -> None:
    """All arrays are stored in float32: only normalising the quaternions again may round."""
    splats = random_splats(coefficients=coefficients)
    write_splats(tmp_path / f"a{suffix}", splats)
    again = read_splats(tmp_path / f"a{suffix}")
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again, name), getattr(splats, name))
    np.testing.assert_allclose(again.quats, splats.quats, atol=2 * EPSILON)
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def test_stage_says_what_it_holds(tmp_path: Path) -> None:
    """OpenUSD reads one default prim, z up, metres, an extent around all splats, and x y z w as the writer meant it."""
    splats = random_splats(coefficients=9)
    write_usd(tmp_path / "a.usdc", splats)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and not stage.HasAuthoredTimeCodeRange()
    first = prim.GetAttribute("orientations").Get()[0]
    np.testing.assert_array_equal([*first.GetImaginary(), first.GetReal()], splats.quats[0])
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    coefficients = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()
    np.testing.assert_array_equal(coefficients[9 * 3 + 4], splats.sh[3, 4])
    low, high = np.array(prim.GetAttribute("extent").Get())
    reach = 3.0 * splats.scales.max()
    assert (low <= splats.means.min(axis=0)).all() and (low >= splats.means.min(axis=0) - reach).all()
    assert (high >= splats.means.max(axis=0)).all() and (high <= splats.means.max(axis=0) + reach).all()


@pytest.mark.parametrize("half", [False, True])
def test_reads_what_openusd_authored(tmp_path: Path, half: bool) -> None:
    """Float and half attributes, authored element by element."""
    splats = random_splats(coefficients=4)
    stage = new_stage(tmp_path / "a.usda")
    author(stage, "/World/Splats", splats, half=half)
    stage.GetRootLayer().Save()
    assert_equal(read_splats(tmp_path / "a.usda"), splats, step=2.0**-10 if half else 4 * EPSILON)


def test_float_attributes_win_over_half(tmp_path: Path) -> None:
    """Where both variants have values, the float one counts."""
    splats = random_splats()
    stage = new_stage(tmp_path / "a.usdc")
    author(stage, "/Splats", random_splats(seed=1), half=True)
    author(stage, "/Splats", splats)
    stage.GetRootLayer().Save()
    assert_equal(read_splats(tmp_path / "a.usdc"), splats, step=4 * EPSILON)


@pytest.mark.parametrize(("up", "axis"), [("Y", "+y"), ("Z", "+z")])
@pytest.mark.parametrize("meters", [0.01, 1.0, None])
def test_up_axis_and_unit(tmp_path: Path, up: str, axis: Any, meters: float | None) -> None:
    """A stage in centimetres with y up becomes metres with z up; a stage that names no unit is in centimetres."""
    splats = random_splats(coefficients=16)
    stage = new_stage(tmp_path / "a.usdc", up=up, meters=meters)
    author(stage, "/Splats", splats)
    stage.GetRootLayer().Save()
    expected = splats.transformed(rotation=up_rotation(axis), scale=meters or 0.01)
    assert_equal(read_splats(tmp_path / "a.usdc"), expected, step=32 * EPSILON)


def test_nested_transforms(tmp_path: Path) -> None:
    """Rotation, translation, mirroring and shear of the parents act on means, covariances and view-dependent colour."""
    splats = random_splats(coefficients=16)
    stage = new_stage(tmp_path / "a.usdc")
    maps = {
        "turn": np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 2.0], [0.0, 0.0, 2.0, 3.0], [0, 0, 0, 1]]),
        "shear": np.array([[1.0, 0.3, 0.0, 0.0], [0.0, 1.5, 0.2, 0.0], [0.1, 0.0, 0.7, 0.5], [0, 0, 0, 1]]),
        "mirror": np.diag([1.0, -1.0, 1.0, 1.0]),
    }
    parent = ""
    for name, matrix in maps.items():
        parent += f"/{name}"
        xform = UsdGeom.Xform.Define(stage, parent)
        xform.AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))  # row vectors
    author(stage, parent + "/Splats", splats)
    stage.GetRootLayer().Save()
    again = read_splats(tmp_path / "a.usdc")
    whole = maps["turn"] @ maps["shear"] @ maps["mirror"]
    linear = whole[:3, :3]
    step = 64 * EPSILON
    np.testing.assert_allclose(again.means, splats.means @ linear.T + whole[:3, 3], atol=step * 10)
    covariances = linear @ splats.covariances() @ linear.T
    np.testing.assert_allclose(again.covariances(), covariances, atol=step * np.abs(covariances).max())
    # Seen from direction d, a splat shows what it showed at rest from Q^T d, Q the orthogonal factor of the map.
    left, _, right = np.linalg.svd(linear)
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(
        seen_colors(again, directions), seen_colors(splats, directions @ (left @ right)), atol=step * 10
    )


def test_several_prims_become_one(tmp_path: Path) -> None:
    """Prims are joined in the order of the stage, lower degrees padded; invisible ones and other prims are skipped."""
    one, two = random_splats(20, coefficients=1), random_splats(30, seed=1, coefficients=9)
    stage = new_stage(tmp_path / "a.usda")
    author(stage, "/a", one)
    author(stage, "/b", two)
    UsdGeom.Imageable(author(stage, "/c", two)).MakeInvisible()
    UsdGeom.Cube.Define(stage, "/d")
    stage.GetRootLayer().Save()
    again = read_splats(tmp_path / "a.usda")
    assert again.count == 50 and again.sh_degree == 2
    assert_equal(again.subset(np.arange(20, 50)), two, step=4 * EPSILON)
    np.testing.assert_array_equal(again.sh[:20, :1], one.sh)
    assert not again.sh[:20, 1:].any()


def test_absent_orientation_opacity_and_colour(tmp_path: Path) -> None:
    """They default to no rotation, opaque and grey; positions and scales must be there."""
    stage = new_stage(tmp_path / "a.usda")
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splats")
    prim.CreatePositionsAttr([(1, 2, 3)])
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match="scales have no value"):
        read_splats(tmp_path / "a.usda")
    prim.CreateScalesAttr([(0.1, 0.2, 0.3)])
    stage.GetRootLayer().Save()
    splats = read_splats(tmp_path / "a.usda")
    np.testing.assert_array_equal(splats.quats, [[0, 0, 0, 1]])
    assert splats.opacities[0] == 1.0 and (splats.colors() == 0.5).all()


def test_animation(tmp_path: Path) -> None:
    """A turning, stretching object: one sample a frame of what changes, one value of what does not, short way round."""
    # Well separated scales: the axes of a nearly round splat turn by any angle as it is stretched.
    rest = dataclasses.replace(random_splats(coefficients=4), scales=np.tile([0.02, 0.05, 0.12], (50, 1)))
    frames = []
    for angle in np.linspace(0.0, 4.0 * np.pi, 25):
        c, s = np.cos(angle), np.sin(angle)
        gradient = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0 + 0.2 * s]])
        frames.append(rest.deformed(rest.means @ gradient.T, gradient))
    write_usd(tmp_path / "a.usdc", frames, fps=30.0)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 24.0, 30.0)
    prim = stage.GetDefaultPrim()
    assert prim.GetAttribute("opacities").GetNumTimeSamples() == 0
    assert prim.GetAttribute("positions").GetTimeSamples() == [float(i) for i in range(25)]
    for i in (0, 7, 24):
        assert_equal(read_usd(tmp_path / "a.usdc", time_code=float(i)), frames[i], step=4 * EPSILON)
    assert_equal(read_splats(tmp_path / "a.usdc"), frames[0], step=4 * EPSILON)
    quats = np.stack([np.array(prim.GetAttribute("orientations").Get(float(i))) for i in range(25)])
    assert ((quats[1:] * quats[:-1]).sum(axis=2) > np.cos(np.pi / 6.0)).all(), "a turn of 30 degrees a frame"


def test_newton_reads_the_same(tmp_path: Path) -> None:
    """Newton's own reader finds the arrays that were written."""
    newton = pytest.importorskip("newton")
    splats = random_splats(coefficients=9)
    write_usd(tmp_path / "a.usdc", splats)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    gaussian = newton.Gaussian.create_from_usd(stage.GetDefaultPrim())
    np.testing.assert_array_equal(gaussian.positions, splats.means)
    np.testing.assert_array_equal(gaussian.scales, splats.scales)
    np.testing.assert_array_equal(gaussian.opacities, splats.opacities)
    np.testing.assert_allclose(gaussian.rotations, splats.quats, atol=2 * EPSILON)
    np.testing.assert_array_equal(np.asarray(gaussian.sh_coeffs).reshape(-1, 9, 3), splats.sh)


def test_contradictory_stages(tmp_path: Path) -> None:
    """Arrays that do not match, linear radiance, singular transforms and stages without splats are refused."""
    splats = random_splats(coefficients=4)

    def refused(change: Any, message: str) -> None:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.usda"
        stage = new_stage(path)
        change(author(stage, "/Splats", splats).GetPrim())
        stage.GetRootLayer().Save()
        with pytest.raises(AssetError, match=message) as caught:
            read_splats(path)
        assert caught.value.hint

    refused(lambda prim: prim.GetAttribute("scales").Set([(1, 1, 1)]), "1 scales for 50 splats")
    refused(lambda prim: prim.GetAttribute("positions").Set([(np.nan, 1, 1)] * 50), "50 with means not finite")
    refused(lambda prim: prim.GetAttribute("orientations").Set([Gf.Quatf(0, 0, 0, 0)] * 50), "50 without a rotation")
    refused(lambda prim: prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(2), "degree 2")
    refused(lambda prim: prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(-1), "degree -1")
    refused(
        lambda prim: prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").SetColorSpace("lin_rec709_scene"),
        "linear",
    )
    refused(lambda prim: UsdGeom.Xformable(prim).AddScaleOp().Set((1, 0, 1)), "singular")
    refused(lambda prim: UsdGeom.Imageable(prim).MakeInvisible(), "no visible ParticleField3DGaussianSplat")
    refused(lambda prim: prim.GetStage().SetMetadata("upAxis", "W"), "upAxis is 'W'")
    with pytest.raises(AssetError, match="cannot be read"):
        read_usd(tmp_path / "nowhere.usda")


def test_refusals_of_the_writer(tmp_path: Path) -> None:
    """Frames of different sizes, no frames, impossible rates and missing folders are refused without a trace."""
    for frames in ([], [random_splats(5), random_splats(6)], [random_splats(5), random_splats(5, coefficients=1)]):
        with pytest.raises(ConfigError, match="animation"):
            write_usd(tmp_path / "a.usdc", frames)
    with pytest.raises(ConfigError, match="fps"):
        write_usd(tmp_path / "a.usdc", random_splats(), fps=0.0)
    with pytest.raises(StorageError, match="cannot be written"):
        write_usd(tmp_path / "absent" / "a.usdc", random_splats())
    with pytest.raises(AssetError, match="cannot write"):
        write_usd(tmp_path / "a.usdz", random_splats())
    assert not list(tmp_path.iterdir())


def test_a_broken_installation_is_not_blamed_on_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the process of its own cannot load OpenUSD, the message says what is missing."""
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "pxr").mkdir()
    (tmp_path / "pxr" / "__init__.py").touch()
    process._stop()  # the one that is kept has loaded OpenUSD
    monkeypatch.setattr(process, "library_folder", lambda _: str(tmp_path))
    with pytest.raises(AssetError, match=r"No module named .pxr\.Sdf."):
        read_splats(tmp_path / "a.usda")


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without usd-core both directions say which extra to install."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    with pytest.raises(MissingExtraError, match=r"softmode\[usd\]"):
        read_splats(tmp_path / "a.usda")
    with pytest.raises(MissingExtraError, match=r"softmode\[usd\]"):
        write_usd(tmp_path / "b.usda", random_splats())
