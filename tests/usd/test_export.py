"""`write_usd`: exact round trips, what other tools find on the stage, Kaolin's arrays, validation, damage."""

from __future__ import annotations

import dataclasses
import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode.errors import AssetError, ConfigError, MissingExtraError, StorageError
from softmode.objects import Placed, SoftObject
from softmode.usd import UsdExportOptions, add_usd, write_usd, writer
from softmode.usd.handles import handles_from_coordinates
from softmode.usd.writer import set_place
from tests.scenes import rotation
from tests.usd.export_scenes import (
    KINDS,
    MATERIAL,
    TURN,
    assert_same,
    assert_same_splats,
    small_body,
    small_splats,
    some_state,
)
from tests.usd.stages import Author

Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade = (
    importlib.import_module(f"pxr.{name}") for name in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade")
)
EPSILON = float(np.finfo(np.float32).eps)


def placed(kind: str = "affine", *, coefficients: int = 1) -> Placed:
    """Return a bar of an odd material at an odd place."""
    return Placed(
        object=SoftObject(body=small_body(kind), material=MATERIAL, splats=small_splats(coefficients)),
        name="toy",
        position=(0.1, -0.2, 0.3),
        rotation=TURN,
        scale=1.3,
    )


def opened(path: Path) -> Any:
    """Return a stage."""
    return Usd.Stage.Open(str(path))


@pytest.mark.parametrize(
    ("kind", "suffix", "coefficients"), [("affine", "usdc", 1), ("quadratic", "usda", 4), ("regions", "usd", 16)]
)
def test_round_trip_is_exact(tmp_path: Path, kind: str, suffix: str, coefficients: int) -> None:
    """Body, material and splats come back to the bit; the place to the rounding of its quaternion."""
    toy = placed(kind, coefficients=coefficients)
    write_usd(tmp_path / f"toy.{suffix}", toy)
    (found,) = add_usd(newton.ModelBuilder(), tmp_path / f"toy.{suffix}").bodies.values()
    assert_same(found.body, toy.body)
    assert found.material == MATERIAL and found.object.notes == ()
    assert found.splats is not None and toy.splats is not None
    assert_same_splats(found.splats, toy.splats)
    np.testing.assert_allclose(found.position, toy.position, rtol=1e-15)
    np.testing.assert_allclose(found.rotation, toy.rotation, atol=1e-15)
    assert found.scale == pytest.approx(toy.scale, rel=1e-15)
    assert [path.name for path in tmp_path.iterdir()] == [f"toy.{suffix}"]


def test_places_turn_the_short_way() -> None:
    """Turned on and on, past half a turn and a whole one, a place is right at its samples and half way between them."""
    Usd, UsdGeom = (importlib.import_module(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    stage = Usd.Stage.CreateInMemory()  # which lives as long as its prims are used
    root = UsdGeom.Xform.Define(stage, "/Root")
    for frame in range(9):
        set_place(root, (0.1, 0.2, 0.3), rotation((0.6, 0.0, 0.8), 0.9 * frame), 1.0, frame)
    for time in np.arange(0.0, 8.1, 0.5):
        matrix = np.array(root.GetLocalTransformation(time))
        np.testing.assert_allclose(matrix[:3, :3].T, rotation((0.6, 0.0, 0.8), 0.9 * time), atol=1e-9)
        np.testing.assert_allclose(matrix[3, :3], (0.1, 0.2, 0.3))


def test_several_bodies_and_odd_names(tmp_path: Path) -> None:
    """Names become valid and unlike; bodies keep their order, one without splats has none."""
    toy = placed()
    bodies = [dataclasses.replace(toy, name=name) for name in ("my toy.ply", "my-toy.ply", "3d")]
    bodies.append(dataclasses.replace(toy, name="bare", object=dataclasses.replace(toy.object, splats=None)))
    write_usd(tmp_path / "toys.usdc", bodies)
    found = add_usd(newton.ModelBuilder(), tmp_path / "toys.usdc")
    assert list(found.bodies) == ["/World/my_toy_ply", "/World/my_toy_ply_2", "/World/_3d", "/World/bare"]
    assert found.bodies["/World/bare"].splats is None
    assert len(found.reduced_bodies) == 1


def test_stage_says_what_it_holds(tmp_path: Path) -> None:
    """Plain OpenUSD finds units, mass, material bound for physics, and points that carry the mass."""
    toy = placed()
    write_usd(tmp_path / "toy.usda", toy)
    stage = opened(tmp_path / "toy.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World" and not stage.HasAuthoredTimeCodeRange()
    prim = stage.GetPrimAtPath("/World/toy")
    assert newton.usd.has_applied_api_schema(prim, "PhysicsDeformableBodyAPI")
    assert list(prim.GetAttribute("semantics:labels:class").Get()) == ["toy"]
    mass = MATERIAL.density * toy.body.volume * toy.scale**3
    assert prim.GetAttribute("physics:mass").Get() == np.float32(mass)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    values = {name: material.GetPrim().GetAttribute(f"physics:{name}").Get() for name in ("youngsModulus", "density")}
    assert values == {"youngsModulus": np.float32(MATERIAL.youngs_modulus), "density": np.float32(MATERIAL.density)}
    assert UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get() == np.float32(MATERIAL.friction)
    assert newton.usd.has_applied_api_schema(material.GetPrim(), "PhysicsVolumeDeformableMaterialAPI")
    points = UsdGeom.Points.Get(stage, "/World/toy/Simulation")
    assert newton.usd.has_applied_api_schema(points.GetPrim(), "NewtonPointsDeformableSimAPI")
    masses = np.array(points.GetPrim().GetAttribute("physics:masses").Get())
    assert masses.sum(dtype=np.float64) == pytest.approx(mass, rel=EPSILON)
    np.testing.assert_array_equal(np.array(points.GetPointsAttr().Get()), toy.body.cubature.points.astype(np.float32))
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    np.testing.assert_allclose(matrix[:3, :3], toy.scale * TURN, atol=1e-15)


@pytest.mark.parametrize("precision", ["float", "half"])
@pytest.mark.parametrize("kind", ["affine", "regions"])
def test_weights_move_splats(tmp_path: Path, kind: str, precision: str) -> None:
    """X + sum_j W_j [X, 1] M_j with the primvar equals X + sum_k b_k(X) q_k to the precision of the primvar."""
    toy = placed(kind)
    write_usd(tmp_path / "toy.usdc", toy, options=UsdExportOptions(weights=precision))  # type: ignore[arg-type]
    stage = opened(tmp_path / "toy.usdc")
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/toy/Splats"))
    weights = primvar.GetPrimvar("softmode:weights")
    handles = len(toy.body.handles.degrees)
    assert weights.GetElementSize() == handles and weights.GetInterpolation() == "vertex"
    w = np.array(weights.Get(), dtype=np.float64).reshape(-1, handles)
    assert toy.splats is not None
    x, q = toy.splats.means.astype(np.float64), some_state(toy.body)
    inside = toy.body.covers(x)
    assert inside.sum() > 25
    matrices = handles_from_coordinates(toy.body, q)[0]
    ones = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    moved = x + np.einsum("pj,pi,jik->pk", w, ones, matrices)[:, :3]
    step = EPSILON if precision == "float" else 2.0**-11
    per_handle = np.abs(np.einsum("pj,pi,jik->pjk", w, ones, matrices)[:, :-1]).sum(axis=1).max()
    expected = x + toy.body.evaluate(x)[0] @ q
    np.testing.assert_allclose(moved[inside], expected[inside], atol=step * per_handle + 1e-12)


def test_kaolin_finds_its_arrays(tmp_path: Path) -> None:
    """Types are those of Kaolin's schema; x and F from its arrays are ours; its shares carry mass and stiffness."""
    toy = placed()
    body, count = toy.body, toy.body.point_count
    handles = len(body.handles.degrees)
    write_usd(tmp_path / "toy.usdc", toy)
    stage = opened(tmp_path / "toy.usdc")
    prim = stage.GetPrimAtPath("/World/toy/Splats")
    for schema in ("KaolinSkinnedPhysicsAPI:default", "KaolinPhysicsMaterialAPI:default"):
        assert newton.usd.has_applied_api_schema(prim, schema)
    types = {"pts": "point3f[]", "appx_vol": "float"}
    names = ("pts", "yms", "prs", "rhos", "appx_vol", "skinning_weights", "dwdx", "renderable_skinning_weights")
    values: dict[str, np.ndarray] = {}
    for name in names:
        attribute = prim.GetAttribute(f"kaolin_skinned_physics:default:{name}")
        assert str(attribute.GetTypeName()) == types.get(name, "float[]"), name
        values[name] = np.array(attribute.Get(), dtype=np.float64)
    w = values["skinning_weights"].reshape(count, handles)
    slope = values["dwdx"].reshape(count, handles, 3)
    assert values["renderable_skinning_weights"].size == small_splats().count * handles
    x, q = values["pts"], some_state(body)
    t = handles_from_coordinates(body, q)[0][:, :, :3].transpose(0, 2, 1)  # T_j, shape (J, 3, 4)
    ones = np.concatenate([x, np.ones((count, 1))], axis=1)
    reach = EPSILON * handles * np.abs(t).max()
    moved = x + np.einsum("pj,jki,pi->pk", w, t, ones)
    np.testing.assert_allclose(moved, body.cubature.points + body.evaluate(body.cubature.points)[0] @ q, atol=reach)
    f = np.eye(3) + np.einsum("pj,jki->pki", w, t[:, :, :3]) + np.einsum("pjc,jki,pi->pkc", slope, t, ones)
    own = np.eye(3) + np.einsum("kc,pkd->pcd", q, body.cubature.grad_basis.astype(np.float64))
    np.testing.assert_allclose(f, own, atol=reach * max(1.0, np.abs(slope).max()))
    volume = float(values["appx_vol"])
    assert (values["rhos"] * volume / count).sum() == pytest.approx(MATERIAL.density * body.volume, rel=4 * EPSILON)
    np.testing.assert_allclose(
        values["yms"] * volume / count,
        MATERIAL.youngs_modulus * body.cubature.stiffness_scale * body.cubature.weights,
        rtol=8 * EPSILON,
    )
    plain = np.array(prim.GetAttribute("kaolin_physics_material:default:yms").Get())
    np.testing.assert_array_equal(plain, np.float32(MATERIAL.youngs_modulus * body.cubature.stiffness_scale))


def test_kaolin_is_left_out(tmp_path: Path) -> None:
    """Quadratic handles have no place in Kaolin's arrays, and who does not want them gets none."""
    write_usd(tmp_path / "a.usdc", placed("quadratic"))
    write_usd(tmp_path / "b.usdc", placed(), options=UsdExportOptions(kaolin=False, weights="none"))
    for name in ("a", "b"):
        stage = opened(tmp_path / f"{name}.usdc")
        prim = stage.GetPrimAtPath("/World/toy/Splats")
        assert not [a.GetName() for a in prim.GetAttributes() if "kaolin" in a.GetName()]
        assert prim.HasAttribute("primvars:softmode:weights") == (name == "a")


def test_half_precision(tmp_path: Path) -> None:
    """Splats of half precision are off by half a step of a half, and the body is exact all the same."""
    toy = placed()
    write_usd(tmp_path / "toy.usdc", toy, options=UsdExportOptions(splats="half"))
    (found,) = add_usd(newton.ModelBuilder(), tmp_path / "toy.usdc").bodies.values()
    assert_same(found.body, toy.body)
    assert found.splats is not None and toy.splats is not None
    for name in ("means", "scales", "opacities"):
        expected = getattr(toy.splats, name)
        np.testing.assert_allclose(getattr(found.splats, name), expected, rtol=2.0**-11, atol=2.0**-24)


def test_edited_material_is_heard_and_an_edited_body_refused(tmp_path: Path) -> None:
    """The standard attributes are there to be edited; the arrays of a body are not."""
    write_usd(tmp_path / "toy.usda", placed())
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "toy.usda"))
    for name, value in (("youngsModulus", 5.0e4), ("density", 640.0), ("dynamicFriction", 0.25)):
        layer.GetAttributeAtPath(f"/World/toy/PhysicsMaterial.physics:{name}").default = value
    layer.Save()
    (found,) = add_usd(newton.ModelBuilder(), tmp_path / "toy.usda").bodies.values()
    edited = dataclasses.replace(MATERIAL, youngs_modulus=5.0e4, density=640.0, friction=0.25)
    assert found.material == edited, "although the mass that was written beside them is there still"
    layer.GetAttributeAtPath("/World/toy.physics:mass").default = 0.05
    layer.Save()
    (found,) = add_usd(newton.ModelBuilder(), tmp_path / "toy.usda").bodies.values()
    volume = found.body.volume * found.scale**3
    assert found.material.density * volume == pytest.approx(0.05, rel=2.0**-23), "an edited mass goes before density"
    weights = layer.GetAttributeAtPath("/World/toy.softmode:body:weights")
    weights.default = type(weights.default)([1.01 * w for w in weights.default])
    layer.Save()
    with pytest.raises(AssetError, match="/World/toy: its softmode body was changed"):
        add_usd(newton.ModelBuilder(), tmp_path / "toy.usda")


@pytest.mark.parametrize(("up", "meters", "kilograms"), [("Z", 1.0, 1.0), ("Y", 0.01, 1.0), ("Z", 0.001, 0.001)])
def test_a_body_in_a_stage_of_other_units(tmp_path: Path, up: str, meters: float, kilograms: float) -> None:
    """A stage in other units that turns and scales what it refers to has the body where it was, of the same material.

    One that leaves it as it is, a hundredth of its size, is told what to do.
    """
    write_usd(tmp_path / "toy.usdc", placed())
    author = Author.create(tmp_path / "a.usda", up, meters, kilograms)
    prim = UsdGeom.Xform.Define(author.stage, "/World/Toys").GetPrim()
    prim.GetReferences().AddReference("./toy.usdc")
    turn = np.stack([author.vector(axis) for axis in np.eye(3)], axis=1)  # z up, metres -> the stage's
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))
    author.save()
    (plain,) = add_usd(newton.ModelBuilder(), tmp_path / "toy.usdc").bodies.values()
    (found,) = add_usd(newton.ModelBuilder(), tmp_path / "a.usda").bodies.values()
    assert_same(found.body, plain.body)
    assert found.material == plain.material == MATERIAL
    assert found.scale == pytest.approx(plain.scale, rel=1e-12)
    np.testing.assert_allclose(found.position, plain.position, atol=1e-12)
    np.testing.assert_allclose(found.rotation, plain.rotation, atol=1e-12)
    assert found.splats is not None and plain.splats is not None
    np.testing.assert_allclose(found.splats.means, plain.splats.means, atol=1e-7)
    np.testing.assert_allclose(found.splats.covariances(), plain.splats.covariances(), rtol=1e-4, atol=1e-12)
    UsdGeom.Xformable(prim).ClearXformOpOrder()
    author.save()
    if meters != 1.0:
        with pytest.raises(AssetError, match="scaled by") as caught:
            add_usd(newton.ModelBuilder(), tmp_path / "a.usda")
        assert "metersPerUnit" in caught.value.hint


def test_validators_find_nothing(tmp_path: Path) -> None:
    """All validators that OpenUSD registers pass a full stage, in a process without softmode; a poor one fails."""
    other = Placed(object=SoftObject(body=small_body("quadratic"), material=MATERIAL), name="toy")
    write_usd(tmp_path / "toys.usdc", [placed(), other])
    poor = Usd.Stage.CreateNew(str(tmp_path / "poor.usda"))
    poor.DefinePrim("/A", "Xform")
    poor.GetRootLayer().Save()
    script = (
        "import json, sys; from pxr import Usd, UsdValidation as V\n"
        "every = V.ValidationRegistry().GetOrLoadAllValidators()\n"
        "found = [[e.GetErrorAsString() for e in V.ValidationContext(every).Validate(Usd.Stage.Open(name))]"
        " for name in sys.argv[1:]]; print(json.dumps([len(every), *found]))"
    )
    files = [str(tmp_path / "toys.usdc"), str(tmp_path / "poor.usda")]
    done = subprocess.run([sys.executable, "-c", script, *files], capture_output=True, text=True, check=True)
    count, toys, bad = json.loads(done.stdout.splitlines()[-1])
    assert count >= 20 and toys == [] and bad


def test_extents_of_points_are_those_of_openusd(tmp_path: Path) -> None:
    """The box around points counts their widths: what OpenUSD computes, bit for bit."""
    write_usd(tmp_path / "toys.usdc", placed())
    stage = opened(tmp_path / "toys.usdc")
    points = UsdGeom.Boundable(stage.GetPrimAtPath("/World/toy/Simulation"))
    assert points.GetExtentAttr().Get() == UsdGeom.Boundable.ComputeExtentFromPlugins(points, Usd.TimeCode.Default())


def test_asset_validator_finds_nothing(tmp_path: Path) -> None:
    """NVIDIA's validator passes a stage of two toys, and fails one whose extents leave out the widths."""
    validator = pytest.importorskip("omni.asset_validator", reason="needs omniverse-asset-validator")
    write_usd(tmp_path / "toys.usdc", [placed(), placed("quadratic")])
    assert not list(validator.ValidationEngine().validate(str(tmp_path / "toys.usdc")).issues())
    stage = opened(tmp_path / "toys.usdc")
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/toy/Simulation"))
    points.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(points.GetPointsAttr().Get()))
    stage.GetRootLayer().Save()
    assert list(validator.ValidationEngine().validate(str(tmp_path / "toys.usdc")).issues())


def test_newton_reads_the_rest(tmp_path: Path) -> None:
    """A scene that refers to a toy beside a rigid body: Newton reads that and leaves the toy, softmode takes both."""
    write_usd(tmp_path / "toy.usdc", placed())
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Scene").GetPrim())
    stage.DefinePrim("/Scene/Toys").GetReferences().AddReference("./toy.usdc")
    cube = UsdGeom.Cube.Define(stage, "/Scene/Cube")
    cube.CreateSizeAttr(0.1)
    UsdPhysics.RigidBodyAPI.Apply(cube.GetPrim())
    UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    UsdPhysics.MassAPI.Apply(cube.GetPrim()).CreateMassAttr(0.25)
    stage.GetRootLayer().Save()
    alone = newton.ModelBuilder()
    alone.add_usd(str(tmp_path / "scene.usda"))
    assert alone.body_count == 1 and alone.body_mass[0] == pytest.approx(0.25) and alone.particle_count == 0
    both = newton.ModelBuilder()
    found = add_usd(both, tmp_path / "scene.usda")
    assert both.body_count == 1 and list(found.bodies) == ["/Scene/Toys/toy"]
    assert_same(found.bodies["/Scene/Toys/toy"].body, small_body("affine"))


def test_bad_arguments(tmp_path: Path) -> None:
    """Each names its remedy, and leaves nothing behind."""
    toy = placed()
    with pytest.raises(ConfigError, match="cannot write"):
        write_usd(tmp_path / "toy.obj", toy)
    with pytest.raises(ConfigError, match="empty"):
        write_usd(tmp_path / "toy.usdc", [])
    with pytest.raises(StorageError, match="missing"):
        write_usd(tmp_path / "missing" / "toy.usdc", toy)
    with pytest.raises(ConfigError, match="weights"):
        UsdExportOptions(weights="double")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="scale"):
        dataclasses.replace(toy, scale=9.0)
    with pytest.raises(ConfigError, match="rotation"):
        dataclasses.replace(toy, rotation=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ConfigError, match="position"):
        dataclasses.replace(toy, position=(0.0, 0.0, float("nan")))
    assert list(tmp_path.iterdir()) == []


def test_file_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that fails leaves the file that was there, and no other."""
    write_usd(tmp_path / "toy.usdc", placed())
    before = (tmp_path / "toy.usdc").read_bytes()

    def full(layer: Any) -> None:
        layer.Save()
        raise OSError("no space left on device")

    monkeypatch.setattr(writer, "save", full)
    with pytest.raises(StorageError, match="no space left"):
        write_usd(tmp_path / "toy.usdc", placed("regions"))
    assert (tmp_path / "toy.usdc").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["toy.usdc"]


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without usd-core the message says what to install."""
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(MissingExtraError, match=r"softmode\[usd\]"):
        write_usd(tmp_path / "toy.usdc", placed())


@pytest.mark.parametrize("kind", KINDS)
def test_empty_arrays_are_not_written(tmp_path: Path, kind: str) -> None:
    """What a body does not have takes no attribute, and the header says so."""
    write_usd(tmp_path / "toy.usdc", placed(kind))
    stage = opened(tmp_path / "toy.usdc")
    prim = stage.GetPrimAtPath("/World/toy")
    assert prim.HasAttribute("softmode:body:region_points") == (kind == "regions")
    header = json.loads(prim.GetAttribute("softmode:body:header").Get())
    assert header["arrays"]["region_points"][1][0] == len(small_body(kind).regions.points)
