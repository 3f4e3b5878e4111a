"""`read_usd_scene`: geometry of every kind, schemas of every family, units, transforms, materials, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode.deformables.materials.material import Material
from softmode.errors import AssetError, MaterialError
from softmode.objects.stage_body import _integrate
from softmode.usd import read_usd_scene
from tests.usd.stages import EDGES, FAMILIES, KINDS, MATERIAL, Author, Sdf, UsdGeom, UsdShade, UsdVol, shell, transform

EPSILON = float(np.finfo(np.float32).eps)
VOLUME = float(np.prod(EDGES))
COARSE = {"Mesh": 1e-6, "TetMesh": 1e-6, "Points": 0.03, "ParticleField3DGaussianSplat": 0.08}
"""How near the volume comes: exactly but for float32, or by what a grid of 64 voxels fills of points and splats."""


def read_one(path: Path) -> Any:
    """Return the only deformable of a stage."""
    (found,) = read_usd_scene(path).deformables
    return found


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_and_family(tmp_path: Path, kind: str, family: str) -> None:
    """Each geometry under each family of schemas becomes a body of its volume, with material and place."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", kind, family, matrix=transform((0.1, 0.2, 0.3), turn=0.5))
    author.save()
    found = read_one(tmp_path / "a.usda")
    assert (found.path, found.kind) == ("/World/Toy", kind)
    np.testing.assert_allclose(found.rotation, transform(turn=0.5)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(found.translation, (0.1, 0.2, 0.3), atol=1e-12)
    shape = _integrate(found, 60)  # what its body is built from
    assert shape.volume == pytest.approx(VOLUME, rel=COARSE[kind])
    assert np.abs(shape.weights @ shape.points / shape.volume).max() < 0.02 * min(EDGES)
    material = found.material(shape.volume)
    assert material.youngs_modulus == pytest.approx(MATERIAL["youngsModulus"], rel=EPSILON)
    assert material.poissons_ratio == pytest.approx(MATERIAL["poissonsRatio"], rel=EPSILON)
    assert material.density == pytest.approx(MATERIAL["density"], rel=EPSILON)
    assert material.friction == pytest.approx(MATERIAL["dynamicFriction"], rel=EPSILON)
    assert (found.splats is not None) == (kind == "ParticleField3DGaussianSplat")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("up", "meters", "kilograms"), [("Y", 0.01, 1.0), ("Y", 0.001, 0.001)])
def test_units_and_axes(tmp_path: Path, kind: str, up: str, meters: float, kilograms: float) -> None:
    """A stage in other units with another axis up says the same as one in metres with z up: E in kg / (m s^2)."""
    scenes = []
    for name, units in (("si", ("Z", 1.0, 1.0)), ("other", (up, meters, kilograms))):
        author = Author.create(tmp_path / f"{name}.usda", *units)
        root = author.body("/World/Toy", kind, matrix=transform((0.1, 0.2, 0.3), turn=0.5, scale=(1.0, 1.5, 1.0)))
        root.CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(0.3 / units[2])
        author.save()
        scenes.append(read_one(tmp_path / f"{name}.usda"))
    one, other = scenes
    np.testing.assert_allclose(other.rotation, one.rotation, atol=8 * EPSILON)
    np.testing.assert_allclose(other.translation, one.translation, atol=8 * EPSILON)
    for name in one.properties:
        assert other.properties[name] == pytest.approx(one.properties[name], rel=4 * EPSILON), name
    assert (one.mass, other.mass) == (pytest.approx(0.3), pytest.approx(0.3))
    tolerance = 8 * EPSILON * max(EDGES)
    if kind in ("Mesh", "TetMesh"):
        np.testing.assert_allclose(other.surface.vertices, one.surface.vertices, atol=tolerance)
        np.testing.assert_array_equal(other.surface.faces, one.surface.faces)
    elif kind == "Points":
        np.testing.assert_allclose(other.points, one.points, atol=tolerance)
        np.testing.assert_allclose(other.point_radii, one.point_radii, rtol=8 * EPSILON)
    else:
        np.testing.assert_allclose(other.splats.means, one.splats.means, atol=tolerance)
        np.testing.assert_allclose(other.splats.covariances(), one.splats.covariances(), atol=tolerance * 0.002)


@pytest.mark.parametrize("kind", KINDS)
def test_stretched_and_mirrored(tmp_path: Path, kind: str) -> None:
    """x_world = R (S X) + t: stretch and mirroring go into the shape, whose volume is |det| times the original."""
    matrix = transform((0.0, 0.1, 0.4), turn=0.7, axis=0, scale=(-1.2, 0.8, 1.5))
    shear = np.eye(4)
    shear[0, 1] = 0.2
    author = Author.create(tmp_path / "a.usdc")
    parent = UsdGeom.Xform.Define(author.stage, "/World/Shelf").GetPrim()
    author.place(parent, matrix)
    author.body("/World/Shelf/Toy", kind, matrix=shear)
    author.save()
    found = read_one(tmp_path / "a.usdc")
    whole = matrix @ shear
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    shape = _integrate(found, 100)
    assert shape.volume == pytest.approx(VOLUME * abs(np.linalg.det(whole[:3, :3])), rel=3 * COARSE[kind])
    world = shape.surface_points @ found.rotation.T + found.translation
    rest = np.linalg.solve(whole[:3, :3], (world - whole[:3, 3]).T).T
    beyond = np.abs(rest) / (0.5 * np.array(EDGES))
    assert np.abs(beyond.max(axis=1) - 1.0).max() < (1e-5 if kind in ("Mesh", "TetMesh") else 0.12), "on the box"
    centre = shape.weights @ shape.points / shape.volume
    outwards = (shape.surface_normals * (shape.surface_points - centre)).sum(axis=1)
    assert (outwards > 0.0).all(), "a convex body's normals point away from its centre"


def test_material_of_ancestors_and_purposes(tmp_path: Path) -> None:
    """The binding for physics goes before that for all purposes, is inherited, and a look alone says nothing."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Group/Toy", bound=False)
    group = author.stage.GetPrimAtPath("/World/Group")
    look = UsdShade.Material.Define(author.stage, "/World/Look")
    soft = author.material("/World/Soft", "aousd", {"youngsModulus": 1e4, "staticFriction": 0.9})
    UsdShade.MaterialBindingAPI.Apply(author.stage.GetPrimAtPath("/World/Group/Toy")).Bind(look)
    UsdShade.MaterialBindingAPI.Apply(group).Bind(soft)
    author.save()
    # the nearer binding for all purposes is the look, so nothing is said
    assert read_one(tmp_path / "a.usda").properties == {}
    UsdShade.MaterialBindingAPI(group).Bind(soft, UsdShade.Tokens.weakerThanDescendants, "physics")
    author.save()
    found = read_one(tmp_path / "a.usda")
    assert found.properties == {"youngs_modulus": 1e4, "friction": pytest.approx(0.9, rel=EPSILON)}
    assert found.sources["friction"] == "/World/Soft.physics:staticFriction"
    default = Material(density=123.0, poissons_ratio=0.3)
    material = found.material(VOLUME, default)
    assert (material.youngs_modulus, material.density, material.poissons_ratio) == (1e4, 123.0, 0.3)
    geometry = author.stage.GetPrimAtPath("/World/Group/Toy/Geometry")  # its own binding goes before the body's
    hard = author.material("/World/Hard", "aousd", {"youngsModulus": 2e4})
    UsdShade.MaterialBindingAPI.Apply(geometry).Bind(hard, UsdShade.Tokens.weakerThanDescendants, "physics")
    author.save()
    assert read_one(tmp_path / "a.usda").properties == {"youngs_modulus": 2e4}


def test_mass_goes_before_density(tmp_path: Path) -> None:
    """Mass of the body, then density of the body, then density of the material; zero says nothing."""
    author = Author.create(tmp_path / "a.usda")
    root = author.body("/World/Toy")

    def density() -> float:
        author.save()
        return read_one(tmp_path / "a.usda").material(VOLUME).density

    assert density() == pytest.approx(MATERIAL["density"])
    root.CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(0.0)
    root.CreateAttribute("physics:density", Sdf.ValueTypeNames.Float).Set(100.0)
    assert density() == pytest.approx(100.0)
    root.GetAttribute("physics:mass").Set(0.2)
    assert density() == pytest.approx(0.2 / VOLUME)


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("youngsModulus", -1.0, MaterialError),
        ("youngsModulus", np.nan, MaterialError),
        ("poissonsRatio", 0.5, MaterialError),
        ("density", np.inf, MaterialError),
        ("dynamicFriction", -0.1, MaterialError),
    ],
)
def test_impossible_materials_are_refused(tmp_path: Path, name: str, value: float, error: type[Exception]) -> None:
    """Values outside their range are refused by name, with the prim that holds them."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", bound=False)
    material = author.material("/World/Odd", "aousd", {**MATERIAL, name: value})
    UsdShade.MaterialBindingAPI.Apply(author.stage.GetPrimAtPath("/World/Toy")).Bind(material)
    author.save()
    with pytest.raises(error, match="/World/Odd"):
        read_one(tmp_path / "a.usda").material(VOLUME)


def test_splats_of_a_body_are_its_picture(tmp_path: Path) -> None:
    """Splats beneath a body, or that name it, move with it; others are scenery; invisible ones are left out."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", matrix=transform((0.0, 0.0, 0.5), turn=0.3))
    author.body("/World/Other", matrix=transform((1.0, 0.0, 0.5)))
    for path, color in (
        ("/World/Toy/Splats", 0.1),
        ("/World/Toy/Hidden", 0.2),
        ("/World/Named", 0.3),
        ("/World/Room", 0.4),
    ):
        prim = UsdVol.ParticleField3DGaussianSplat.Define(author.stage, path)
        author.splats(prim, shell(200, color))
        if path == "/World/Named":
            author.place(prim.GetPrim(), transform((1.0, 0.0, 0.5)))
            prim.GetPrim().CreateRelationship("softmode:splats:body").SetTargets(["/World/Other"])
    UsdGeom.Imageable(author.stage.GetPrimAtPath("/World/Toy/Hidden")).MakeInvisible()
    author.save()
    scene = read_usd_scene(tmp_path / "a.usda")
    toy, other = scene.deformables
    expected = shell(200)
    assert scene.scenery is not None and (scene.scenery.sh == np.float32(0.4)).all()
    np.testing.assert_array_equal(scene.scenery.means, expected.means)
    for body, color in ((toy, 0.1), (other, 0.3)):
        assert body.splats.count == expected.count
        assert (body.splats.sh == np.float32(color)).all()
        np.testing.assert_allclose(body.splats.means, expected.means, atol=4 * EPSILON)


def test_which_prims_are_bodies(tmp_path: Path) -> None:
    """Disabled bodies are left out, an automatic Omni body takes its source, a lone simulation schema is enough."""
    author = Author.create(tmp_path / "a.usda")
    disabled = author.body("/World/Off")
    disabled.CreateAttribute("physics:bodyEnabled", Sdf.ValueTypeNames.Bool).Set(False)
    automatic = UsdGeom.Xform.Define(author.stage, "/World/Auto").GetPrim()
    automatic.AddAppliedSchema("PhysxAutoDeformableBodyAPI")
    author.geometry("/World/Source", "Mesh")
    automatic.CreateRelationship("physxDeformableBody:cookingSourceMesh").SetTargets(["/World/Source"])
    author.geometry("/World/Lone", "TetMesh").AddAppliedSchema("PhysicsVolumeDeformableSimAPI")
    author.save()
    found = {body.path: body.kind for body in read_usd_scene(tmp_path / "a.usda").deformables}
    assert found == {"/World/Auto": "Mesh", "/World/Lone": "TetMesh"}


def test_bodies_inside_instances(tmp_path: Path) -> None:
    """Two instances of one asset are two bodies of one shape at two places."""
    asset = Author.create(tmp_path / "toy.usda")
    asset.body("/World/Toy")
    asset.save()
    author = Author.create(tmp_path / "a.usda")
    for name, x in (("A", 0.0), ("B", 0.5)):
        prim = UsdGeom.Xform.Define(author.stage, f"/World/{name}").GetPrim()
        prim.GetReferences().AddReference("./toy.usda")
        prim.SetInstanceable(True)
        author.place(prim, transform((x, 0.0, 0.2)))
    author.save()
    one, two = read_usd_scene(tmp_path / "a.usda").deformables
    assert (one.path, two.path) == ("/World/A/Toy", "/World/B/Toy")
    np.testing.assert_array_equal(one.surface.vertices, two.surface.vertices)
    np.testing.assert_allclose(two.translation - one.translation, (0.5, 0.0, 0.0), atol=1e-12)


def test_unusable_bodies_are_refused(tmp_path: Path) -> None:
    """No geometry, two, one of another kind, and singular transforms are refused with a remedy."""

    def refused(change: Any, message: str) -> None:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.usda"
        author = Author.create(path)
        root = author.body("/World/Toy")
        change(author, root)
        author.save()
        with pytest.raises(AssetError, match=message) as caught:
            read_usd_scene(path)
        assert caught.value.hint

    def second(author: Author, root: Any) -> None:
        author.geometry("/World/Toy/Second", "TetMesh").AddAppliedSchema("PhysicsVolumeDeformableSimAPI")

    def curves(author: Author, root: Any) -> None:
        author.stage.RemovePrim("/World/Toy/Geometry")
        prim = UsdGeom.BasisCurves.Define(author.stage, "/World/Toy/Geometry").GetPrim()
        prim.AddAppliedSchema("PhysicsVolumeDeformableSimAPI")

    refused(lambda author, root: author.stage.RemovePrim("/World/Toy/Geometry"), "without geometry")
    refused(second, "2 simulation geometries")
    refused(curves, "type BasisCurves")
    refused(lambda author, root: author.place(root, transform(scale=(1.0, 0.0, 1.0))), "singular")
    refused(lambda author, root: author.place(root, transform((0.0, 0.0, np.inf))), "not finite")
    refused(lambda author, root: author.stage.SetMetadata("metersPerUnit", 0.0), "metersPerUnit is 0")
    refused(lambda author, root: author.stage.SetMetadata("upAxis", "W"), "upAxis is 'W'")
