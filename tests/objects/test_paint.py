"""Painted materials: fields by label, colour, file and brush; what is refused; what a body keeps.

Builds bars from painted fields, since paint is a field of the build.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softmode.cli.object_options import ObjectOptions
from softmode.deformables import BuildOptions, ReducedBody, build_body, elastic_modes, paint, quadrature_from_box
from softmode.deformables.reduction.reduced_stiffness import reduced_stiffness
from softmode.deformables.reduction.sources import unpack_sources
from softmode.errors import AssetError, ConfigError, MaterialError
from softmode.objects import ObjectConfig, StifferBox, StifferColor, color_field, load, nearest_field, read_field
from softmode.objects.material_field import read_material
from softmode.objects.paint import brushed
from softmode.splats.point_cloud import splats_from_points

SIZE = (0.1, 0.03, 0.03)
OPTIONS = BuildOptions(function_count=24, cubature_count=48, kernel_count=100)
RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)


def test_painted_late_is_painted_at_once() -> None:
    """Bit for bit the body that a build with the field gives, told of in stages, and softer; the density likewise."""
    quadrature = quadrature_from_box(SIZE, point_count=500, surface_count=60)
    free = build_body(quadrature, OPTIONS, name="bar", progress=False)
    field = np.where(quadrature.points[:, 0] > 0.0, 0.1, 1.0)
    shares: list[float] = []
    options = {"stiffness_scale": field, "progress": lambda stage, share: shares.append(share)}
    told = build_body(quadrature, OPTIONS, name="bar", **options)
    assert len(shares) > 3 and shares == sorted(shares) and shares[-1] == 1.0
    late = paint(free, stiffness_scale=lambda X: np.where(X[:, 0] > 0.0, 0.1, 1.0))
    assert late.fingerprint == told.fingerprint and np.array_equal(late.transform, told.transform)
    heavy = paint(late, density_scale=np.where(field < 1.0, 3.0, 1.0))
    assert heavy.offset[0] > late.offset[0] + 0.2 * SIZE[0] * 0.5
    np.testing.assert_array_equal(unpack_sources(heavy).stiffness_scale, field)
    with pytest.raises(MaterialError, match="finite values > 0"):
        paint(free, stiffness_scale=-field)

    def lowest(body: ReducedBody) -> float:
        """Return the first elastic eigenvalue at rest."""
        gradient = body.cubature.grad_basis.astype(np.float64).transpose(1, 2, 0)
        return float(
            elastic_modes(reduced_stiffness(gradient, body.cubature.weights * body.cubature.stiffness_scale, 0.3))[0][0]
        )

    assert lowest(late) < 0.5 * lowest(free)


def test_labels_and_files(tmp_path: Path) -> None:
    """Every place has the factor of its nearest point."""
    rng = np.random.default_rng(0)
    points, labels = rng.normal(size=(40, 3)), rng.integers(0, 3, 40)
    factors = np.array([0.1, 1.0, 10.0])
    field = nearest_field(points, factors[labels])
    np.testing.assert_array_equal(field(points + 1e-6), factors[labels])
    np.savez(tmp_path / "field.npz", points=points, factors=factors[labels])
    np.testing.assert_array_equal(read_field(tmp_path / "field.npz")(points), factors[labels])
    np.savez(tmp_path / "half.npz", points=points)
    for name in ("none.npz", "half.npz"):
        with pytest.raises(AssetError):
            read_field(tmp_path / name)
    for bad in (1e-4, 2e3, np.nan):
        with pytest.raises(MaterialError, match=r"0\.001"):
            nearest_field(points, np.full(40, bad))
    with pytest.raises(MaterialError, match="expected points"):
        nearest_field(points, factors)


def test_colours() -> None:
    """The nearest colour within reach counts; one that no splat has is refused; text is parsed."""
    points = np.stack([np.linspace(-1.0, 1.0, 60), np.zeros(60), np.zeros(60)], axis=1)
    colors = np.where(points[:, :1] < -0.3, RED, np.where(points[:, :1] > 0.3, BLUE, (0.5, 0.5, 0.1)))
    splats = splats_from_points(points, np.tile([0.0, 0.0, 1.0], (60, 1)), colors)
    field = color_field(splats, [StifferColor(color=RED, factor=0.1), StifferColor.parse("#1a1acc:20")])
    np.testing.assert_array_equal(field(np.array([[-0.8, 0, 0], [0.8, 0.1, 0], [0.0, 0, 0]])), [0.1, 20.0, 1.0])
    with pytest.raises(ConfigError, match="no splat is near"):
        color_field(splats, [StifferColor(color=(0.0, 1.0, 1.0), factor=2.0)])
    with pytest.raises(MaterialError, match="factor"):
        StifferColor.parse("#ff0000:0.0001")
    for text in ("red:2", "#ff00:2", "#ff0000", "#ff0000:soft"):
        with pytest.raises(ConfigError):
            StifferColor.parse(text)


def test_an_object_by_its_colours() -> None:
    """Red squares of the checker pattern are softer and denser, through the options that every command has."""
    shape = {"shape": "box", "extents": SIZE, "splat_count": 800, "surface_count": 80, "build": OPTIONS}
    base = ObjectConfig(**shape, colors=(RED, BLUE))
    painted = {"stiffness_by_color": ("#cc1a1a:0.1",), "density_by_color": ("#cc1a1a:3",)}
    thing = load(ObjectOptions(**painted).object_of(base))
    assert set(thing.body.cubature.stiffness_scale) == {0.1, 1.0}
    given = unpack_sources(thing.body)
    scale, density = given.stiffness_scale, given.density_scale
    assert scale is not None and set(np.unique(scale)) == {0.1, 1.0}
    assert density is not None and density.max() / density.min() == pytest.approx(3.0)
    np.testing.assert_array_equal(density == density.max(), scale == 0.1)
    points = unpack_sources(thing.body).quadrature.points - thing.body.offset
    splats = thing.visible_splats
    near = np.linalg.norm(points[:, None] - splats.means, axis=2).argmin(axis=1)
    red = np.linalg.norm(splats.colors()[near] - RED, axis=1) < 0.25
    assert (scale == np.where(red, 0.1, 1.0)).mean() > 0.995  # all but ties of two splats to rounding
    assert 0.2 < red.mean() < 0.7


def test_an_object_by_files_and_density(tmp_path) -> None:
    """Fields from files say where the object stands; densities are relative, so that the mass stays."""
    shape = {"shape": "box", "extents": SIZE, "splat_count": 800, "surface_count": 80, "build": OPTIONS}
    base = ObjectConfig(**shape, colors=(RED, BLUE))
    points = np.array([[0.0, 0.0, 0.25 * SIZE[2]], [0.0, 0.0, 0.75 * SIZE[2]]])
    for name, factors in (("stiff.npz", [1.0, 5.0]), ("dense.npz", [4.0, 1.0])):
        np.savez(tmp_path / name, points=points, factors=np.array(factors))
    files = {"stiffness_file": tmp_path / "stiff.npz", "density_file": tmp_path / "dense.npz"}
    thing = load(ObjectOptions(**files).object_of(base))
    given = unpack_sources(thing.body)
    assert given.stiffness_scale is not None and given.density_scale is not None
    upper = given.quadrature.points[:, 2] > given.quadrature.bounds[:, 2].mean()
    np.testing.assert_array_equal(given.stiffness_scale, np.where(upper, 5.0, 1.0))
    np.testing.assert_allclose(given.density_scale * given.density_scale[upper][0] ** -1, np.where(upper, 1.0, 4.0))
    assert thing.body.volume == pytest.approx(np.prod(SIZE))
    assert thing.body.offset[2] < 0.45 * SIZE[2]  # the centre of mass, which the lower half draws down
    with pytest.raises(AssetError, match="no such file"):
        load(base.changed(density_file=tmp_path / "none.npz"))
    with pytest.raises(ConfigError, match="density_file"):
        ObjectConfig(body="body.npz", density_file=tmp_path / "dense.npz")


def test_an_object_by_a_material_field(tmp_path) -> None:
    """E, nu and rho of a file are those of the body's points; a box is a factor on top; the mass is the field's.

    Files that do not fit, values out of range, and points beside the object are refused.
    """
    steps = [np.linspace(-0.5 * s, 0.5 * s, 9) for s in SIZE]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3) + np.array([0.0, 0.0, 0.5 * SIZE[2]])
    upper = points[:, 2] > 0.5 * SIZE[2]
    lower = {"youngs_modulus": 1e5, "poissons_ratio": 0.2, "density": 300.0}
    values = {name: np.where(upper, 2.0 * value, value) for name, value in lower.items()}

    def written(**changes: object) -> Path:
        arrays = {"points": points, **values, **changes}
        np.savez(tmp_path / "field.npz", **{name: array for name, array in arrays.items() if array is not None})
        return tmp_path / "field.npz"

    shape = {"shape": "box", "extents": SIZE, "splat_count": 800, "surface_count": 80, "build": OPTIONS}
    wide = (*[-np.inf] * 3, *[np.inf] * 3)
    base = ObjectConfig(**shape, stiffness=(StifferBox(box=wide, factor=3.0),))
    config = base.changed(material_file=written())
    thing = load(config)
    given, made = unpack_sources(thing.body), thing.material
    high = given.quadrature.points[:, 2] - given.quadrature.bounds[0, 2] > 0.58 * SIZE[2]  # beside the jump
    low = given.quadrature.points[:, 2] - given.quadrature.bounds[0, 2] < 0.54 * SIZE[2]
    assert made is not None and given.stiffness_scale is not None and given.poissons_ratio is not None
    for where, factor in ((high, 2.0), (low, 1.0)):
        np.testing.assert_allclose(made.youngs_modulus * given.stiffness_scale[where], factor * 3e5)
        np.testing.assert_allclose(given.poissons_ratio[where], factor * 0.2)
    assert made.poissons_ratio == pytest.approx(given.options.poissons_ratios[0])
    assert given.density_scale is not None
    share = given.quadrature.weights @ given.density_scale / given.quadrature.volume
    np.testing.assert_allclose(made.density * given.density_scale[high] / share, 600.0)
    assert config.material is not None and config.material.density != made.density  # of the points, of the solid
    assert load(config, material=replace(config.material, friction=0.9)).material == replace(made, friction=0.9)
    sparse = base.changed(material_file=written(points=points * (1.0, 1.0, 0.8)))
    with pytest.warns(RuntimeWarning, match="misses .* % of the object"):
        load(sparse)
    bad = {
        "one for each": {"density": np.ones(3)},
        "nu < 0.5": {"poissons_ratio": np.full(len(points), 0.5)},
        "youngs_modulus: expected > 0": {"youngs_modulus": np.zeros(len(points))},
        "finite": {"points": points * np.nan},
        "no property": dict.fromkeys(values),
        "miss": {"points": points + np.array([0.0, 0.0, 0.6 * SIZE[2]])},
    }
    for match, changes in bad.items():
        with pytest.raises(MaterialError, match=match):
            load(base.changed(material_file=written(**changes)))
    with pytest.raises(AssetError, match="holds"):
        load(base.changed(material_file=written(points=None)))


def test_a_material_field_of_a_stage(tmp_path) -> None:
    """`Points` prims with primvars: the stage's unit and up axis act on points, values are SI."""
    Usd, UsdGeom, Sdf = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "Sdf"))
    stage = Usd.Stage.CreateNew(str(tmp_path / "field.usda"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    prim = UsdGeom.Points.Define(stage, "/field")
    prim.CreatePointsAttr([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)])
    UsdGeom.Xformable(prim).AddTranslateOp().Set((0.0, 10.0, 0.0))
    for name, values in (("youngsModulus", [1e4, 3e4]), ("density", [100.0, 300.0])):
        primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, "vertex")
        primvar.Set(values)
    stage.GetRootLayer().Save()
    field = read_material(tmp_path / "field.usda")
    np.testing.assert_allclose(field.points, [[0.01, -0.03, 0.12], [0.04, -0.06, 0.15]], atol=1e-9)
    assert field.means == {"youngs_modulus": 2e4, "density": 200.0}


def test_the_reach_of_a_brush() -> None:
    """A cylinder along the normal, of radius and depth; strokes are unions."""
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 3))
    touched, inward = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]]), np.tile([0.0, 0.0, -1.0], (2, 1))
    one, both = (brushed(points, touched[:k], inward[:k], 0.3, 0.5) for k in (1, 2))
    wide = np.linalg.norm(points[:, :2], axis=1) <= 0.3
    np.testing.assert_array_equal(one, wide & (points[:, 2] >= 0.5))
    assert (both >= one).all() and both.sum() > one.sum()
    with pytest.raises(ConfigError, match="radius"):
        brushed(points, touched, inward, 0.0, 1.0)
