"""`add_usd`: a stage with robot, prop and soft bodies becomes a model that steps; nothing twice, nothing lost.

Builds what an import must give, to compare fingerprints.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

import newton
import warp as wp

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.status import status_reasons
from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import AssetError, ConfigError, MissingExtraError
from softmode.foreign import process
from softmode.splats.raster.rasterizer import SplatArrays
from softmode.usd import add_usd, read_usd_scene
from tests.marks import rest_but
from tests.usd.stages import KINDS, Author, Gf, Sdf, UsdGeom, UsdPhysics, UsdShade, UsdVol, box, shell, transform

EPSILON = float(np.finfo(np.float32).eps)
SMALL = BuildOptions(mode_count=3, kernel_count=120, cubature_count=128)
FEW: dict[str, Any] = {"build_options": SMALL, "surface_count": 100}
"""Options of a body that nobody looks at closely: samples of the surface take most of its build."""


def everything(path: Path, up: str = "Z", meters: float = 1.0, kilograms: float = 1.0) -> Path:
    """Author a robot, a prop, a soft box with splats above the ground and a soft TetMesh beside it."""
    author = Author.create(path, up, meters, kilograms)
    author.robot("/World/Robot", (0.6, 0.1, 0.0))
    author.prop("/World/Prop", (0.3, 0.0, 0.051))
    author.body("/World/Toy", "Mesh", matrix=transform((0.0, 0.0, 0.035)))
    author.splats(UsdVol.ParticleField3DGaussianSplat.Define(author.stage, "/World/Toy/Splats"), shell(300))
    author.body("/World/Brick", "TetMesh", "omni", matrix=transform((0.0, 0.3, 0.035), turn=0.4))
    author.save()
    return path


def arrays(builder: newton.ModelBuilder) -> dict[str, np.ndarray]:
    """Return what a model says of its rigid and soft bodies."""
    found = rigid_arrays(builder)
    model: Any = builder.finalize()
    for name in ("particle_q", "particle_mass"):
        found[name] = getattr(model, name).numpy()
    for name in ("youngs_modulus", "poissons_ratio", "density", "friction"):
        found[name] = getattr(model.softmode, name).numpy()
    return found


def rigid_arrays(builder: newton.ModelBuilder) -> dict[str, np.ndarray]:
    """Return what a model says of its rigid bodies and of gravity."""
    model: Any = builder.finalize()
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    names = (
        *("body_mass", "body_inertia", "shape_scale", "joint_type", "joint_limit_lower"),
        *("joint_limit_upper", "joint_target_ke", "joint_target_kd", "joint_effort_limit", "gravity"),
    )
    return {name: getattr(model, name).numpy() for name in names} | {"body": state.body_q.numpy()[:, :3]}


def test_everything_in_a_stage(tmp_path: Path) -> None:
    """Robot and prop come through Newton, the soft bodies as reduced bodies; each once."""
    builder = newton.ModelBuilder()
    found = add_usd(builder, everything(tmp_path / "a.usda"), **FEW)
    assert list(found.bodies) == ["/World/Toy", "/World/Brick"]
    assert list(found.instances.values()) == [0, 1]
    assert set(found.newton["path_body_map"]) == {
        "/World/Prop",
        *(f"/World/Robot/{n}" for n in ("base", "link", "finger")),
    }
    assert builder.body_count == 4 and builder.joint_count == 4
    assert builder.shape_count == 4, "no soft geometry among the shapes"
    assert builder.particle_count == 200 and not builder.tet_count and not builder.tri_count
    toy = found.bodies["/World/Toy"]
    assert toy.splats is not None and toy.splats.count == shell(300).count
    placed = toy.placed_splats()
    assert placed is not None
    np.testing.assert_allclose(placed.means, shell(300).means + np.array([0.0, 0.0, 0.035]), atol=8 * EPSILON)
    brick = found.bodies["/World/Brick"]
    np.testing.assert_allclose(brick.position, (0.0, 0.3, 0.035), atol=1e-8)
    assert brick.splats is not None and brick.splats.count == 2000, "samples of its surface"
    assert len(found.reduced_bodies) == 2


@pytest.mark.parametrize(("up", "meters", "kilograms"), [("Y", 0.01, 1.0), ("Z", 0.001, 0.001)])
def test_units_of_everything(tmp_path: Path, up: str, meters: float, kilograms: float) -> None:
    """A stage in other units with another axis up gives the same model as one in metres and kilograms with z up."""
    models = []
    for name, units in (("si", ("Z", 1.0, 1.0)), ("other", (up, meters, kilograms))):
        builder = newton.ModelBuilder()
        add_usd(builder, everything(tmp_path / f"{name}.usda", *units), **FEW)
        models.append(arrays(builder))
    for name, value in models[0].items():
        scale = np.abs(value[np.isfinite(value)]).max(initial=1e-12)
        np.testing.assert_allclose(models[1][name], value, atol=1e-5 * scale, err_msg=name)


@pytest.mark.parametrize(("up", "meters", "kilograms"), [("Z", 1.0, 1.0), ("Y", 0.01, 1.0), ("Z", 0.001, 0.001)])
def test_instances_of_a_prototype_in_the_same_file(tmp_path: Path, up: str, meters: float, kilograms: float) -> None:
    """Robots and props that are instances of a class of their own file have the masses and sizes of plain ones."""
    models = []
    for name, units in (("plain", ("Z", 1.0, 1.0)), ("instanced", (up, meters, kilograms))):
        author = Author.create(tmp_path / f"{name}.usda", *units)
        if name == "plain":
            author.robot("/World/R", (0.0, 0.0, 0.0))
            author.prop("/World/P", (0.3, 0.0, 0.2))
        else:
            author.robot("/Robot", (0.0, 0.0, 0.0))
            author.prop("/Box/Cube", (0.3, 0.0, 0.2))
            for path, prototype in (("/World/R", "/Robot"), ("/World/P", "/Box")):
                prim = UsdGeom.Xform.Define(author.stage, path).GetPrim()
                prim.GetReferences().AddInternalReference(prototype)
                author.stage.GetPrimAtPath(prototype).SetSpecifier(Sdf.SpecifierClass)
                prim.SetInstanceable(True)
        author.save()
        builder = newton.ModelBuilder()
        add_usd(builder, tmp_path / f"{name}.usda")
        models.append(rigid_arrays(builder))
    for name, value in models[0].items():
        scale = np.abs(value[np.isfinite(value)]).max(initial=1e-12)
        np.testing.assert_allclose(models[1][name], value, atol=1e-5 * scale, err_msg=name)


def test_what_moves_is_read_at_its_first_time(tmp_path: Path) -> None:
    """Rigid and soft bodies whose places are only time samples start where the first sample has them."""
    author = Author.create(tmp_path / "a.usda")
    prop = author.prop("/World/Prop", (0.0, 0.0, 0.0))
    toy = author.body("/World/Toy")
    for k, prim in enumerate((prop, toy)):
        xform = UsdGeom.Xformable(prim)
        xform.ClearXformOpOrder()
        prim.RemoveProperty("xformOp:translate")
        op = xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
        for code, height in ((3.0, 1.0 + k), (9.0, 5.0)):
            op.Set((0.0, 0.0, height), code)
    author.save()
    builder = newton.ModelBuilder()
    found = add_usd(builder, tmp_path / "a.usda", **FEW)
    np.testing.assert_allclose(np.array(builder.body_q)[0, :3], (0.0, 0.0, 1.0), atol=EPSILON)
    np.testing.assert_allclose(found.bodies["/World/Toy"].position, (0.0, 0.0, 2.0), atol=1e-8)


@pytest.mark.parametrize("time", [None, 2.0])
def test_rotations_that_are_not_finite_are_refused(tmp_path: Path, time: float | None) -> None:
    """Newton's importer gets no NaN in a quaternion, be it a default or a time sample."""
    author = Author.create(tmp_path / "a.usda")
    op = UsdGeom.Xformable(author.prop("/World/Prop", (0.0, 0.0, 0.0))).AddOrientOp()
    op.Set(Gf.Quatf(1.0, float("nan"), 0.0, 0.0), *(() if time is None else (time,)))
    author.save()
    with pytest.raises(AssetError, match="/World/Prop: xformOp:orient holds NaN"):
        add_usd(newton.ModelBuilder(), tmp_path / "a.usda")


def test_it_rests_on_the_ground(tmp_path: Path) -> None:
    """Two worlds of robot, prop and two soft bodies step with the coupled solver: the soft ones come to rest."""
    world = newton.ModelBuilder()
    found = add_usd(world, everything(tmp_path / "a.usda"), **FEW)
    world.add_ground_plane()
    builder = newton.ModelBuilder()
    builder.replicate(world, 2)
    model: Any = builder.finalize()
    solver = SolverCoupledReduced(model, found.reduced_bodies)
    state, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    for _ in range(240):
        solver.step(state, after, control, None, 1.0 / 240.0)
        state, after = after, state
    assert not any(status_reasons(int(bits)) for bits in solver.status.numpy())
    x = state.particle_q.numpy().reshape(2, 2, 100, 3)
    np.testing.assert_array_equal(x[0], x[1])
    assert -0.002 < x[..., 2].min() < 0.002, "on the ground"
    assert np.abs(x[0, 0, :, 2].max() - 0.06) < 0.006, "as high as it is"
    assert np.abs(state.softmode.qd.numpy()).max() < 0.01, "at rest"
    assert np.isfinite(state.body_q.numpy()).all()
    toy = found.bodies["/World/Toy"]
    assert toy.splats is not None
    skin = SkinSplats(toy.splats.means, toy.splats.covariances(), toy.object.basis, toy.object.grad_basis)
    drawn = SplatArrays.from_splats([toy.splats], world_count=2)
    starts = wp.array(
        model.softmode.function_start.numpy()[found.instances["/World/Toy"] :: len(found.bodies)], dtype=wp.int32
    )
    skin.launch(state.softmode.q, starts, drawn.means, drawn.covariances)
    means = drawn.means.numpy()[0, : toy.splats.count]
    assert abs(means[:, 2].min()) < 0.003 and abs(means[:, 2].max() - 0.06) < 0.006, "they went with the body"


def test_the_body_is_the_one_built_by_hand(tmp_path: Path) -> None:
    """The same arrays, options and name give the same fingerprint, for a mesh and for splats alone.

    The options take the Poisson's ratio of the stage's material.
    """
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", "Mesh", matrix=transform((0.3, 0.2, 0.1), turn=1.0))
    author.body("/World/Plush", "ParticleField3DGaussianSplat")
    author.save()
    found = add_usd(newton.ModelBuilder(), tmp_path / "a.usda", **FEW)
    mesh, own = box(), dataclasses.replace(SMALL, poissons_ratio=found.bodies["/World/Toy"].material.poissons_ratio)
    quadrature = quadrature_from_mesh(mesh.vertices.astype(np.float32), mesh.faces, surface_count=100)
    assert own != SMALL
    assert found.bodies["/World/Toy"].body.fingerprint == build_body(quadrature, own, name="Toy").fingerprint
    splats = shell()
    quadrature = quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities, surface_count=100)
    assert found.bodies["/World/Plush"].body.fingerprint == build_body(quadrature, own, name="Plush").fingerprint


def test_what_the_stage_does_not_say(tmp_path: Path) -> None:
    """Missing properties come from the argument, and a mesh that is not closed stands for what it encloses."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", bound=False)
    prim = author.stage.GetPrimAtPath("/World/Toy/Geometry")
    prim.GetAttribute("faceVertexCounts").Set([3] * 11)
    prim.GetAttribute("faceVertexIndices").Set(box().faces.ravel()[:33].tolist())
    author.save()
    given = Material(youngs_modulus=3e4, density=150.0)
    asked = {"only": "/World/Toy"}  # a surface that is not closed is cloth unless one asks for a solid
    found = add_usd(newton.ModelBuilder(), tmp_path / "a.usda", material=given, **FEW, **asked)
    toy = found.bodies["/World/Toy"]
    assert toy.material == given
    assert toy.body.volume == pytest.approx(0.1 * 0.08 * 0.06, rel=0.05)
    assert any("surface deformable" in note for note in toy.object.notes)


def test_picture_from_a_visible_mesh(tmp_path: Path) -> None:
    """A body without splats is shown by samples of its visible meshes in their display colour."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Brick", "TetMesh", matrix=transform((0.0, 0.0, 0.2), turn=0.3))
    mesh = author.geometry("/World/Brick/Look", "Mesh")
    UsdGeom.Mesh(mesh).CreateDisplayColorAttr([(0.2, 0.4, 0.8)])
    author.save()
    toy = add_usd(newton.ModelBuilder(), tmp_path / "a.usda", splat_count=500, **FEW).bodies["/World/Brick"]
    assert toy.splats is not None and toy.splats.count == 500
    gamma = 1.055 * np.array([0.2, 0.4, 0.8]) ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(toy.splats.colors(), np.tile(gamma, (500, 1)), atol=1e-5)
    on_face = np.abs(np.abs(toy.splats.means) / (0.5 * np.array([0.1, 0.08, 0.06])) - 1.0).min(axis=1)
    assert on_face.max() < 1e-4


def test_cables_are_left_to_newton(tmp_path: Path) -> None:
    """A deformable of curves becomes Newton's cable; it is no reduced body."""
    author = Author.create(tmp_path / "a.usda")
    curves = UsdGeom.BasisCurves.Define(author.stage, "/World/Cable")
    curves.CreateTypeAttr("linear")
    curves.CreatePointsAttr([(0.1 * i, 0.0, 0.5) for i in range(5)])
    curves.CreateCurveVertexCountsAttr([5])
    curves.CreateWidthsAttr([0.01] * 5)
    for schema in ("PhysicsDeformableBodyAPI", "PhysicsCurvesDeformableSimAPI"):
        curves.GetPrim().AddAppliedSchema(schema)
    author.save()
    builder = newton.ModelBuilder()
    assert not add_usd(builder, tmp_path / "a.usda").bodies
    assert builder.body_count == 4, "one for each segment"


@pytest.mark.parametrize("kind", rest_but(["Mesh"], KINDS))
def test_two_of_a_kind_share_a_body(tmp_path: Path, kind: str) -> None:
    """Instances of one asset are built once, whatever their places; a mirrored one is another shape."""
    author = Author.create(tmp_path / "toy.usda")
    author.body("/World/Toy", kind)
    author.save()
    author = Author.create(tmp_path / "a.usda")
    for name, matrix in (("A", transform()), ("B", transform((0.5, 0.1, 0.2), turn=0.8))):
        prim = UsdGeom.Xform.Define(author.stage, f"/World/{name}").GetPrim()
        prim.GetReferences().AddReference("./toy.usda")
        author.place(prim, matrix)
    author.save()
    builder = newton.ModelBuilder()
    found = add_usd(builder, tmp_path / "a.usda", **FEW)
    assert len(found.bodies) == 2 and len(found.reduced_bodies) == 1
    np.testing.assert_allclose(found.bodies["/World/B/Toy"].rotation, transform(turn=0.8)[:3, :3], atol=1e-12)


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options that this function decides, builders with another axis up, absent bodies, and a missing extra."""
    path = everything(tmp_path / "a.usda")
    with pytest.raises(ConfigError, match="source"):
        add_usd(newton.ModelBuilder(), path, newton_options={"source": "b.usda"})
    with pytest.raises(ConfigError, match="up axis"):
        add_usd(newton.ModelBuilder(up_axis=newton.Axis.Y), path)
    with pytest.raises(ConfigError, match="no_such_option"):
        add_usd(newton.ModelBuilder(), path, **FEW, newton_options={"no_such_option": 1})
    author = Author.create(tmp_path / "flat.usda")
    author.body("/World/Toy")
    points = author.stage.GetPrimAtPath("/World/Toy/Geometry").GetAttribute("points")
    points.Set(np.array(points.Get()) * np.array([1.0, 1.0, 0.0], np.float32))
    author.save()
    builder = newton.ModelBuilder()
    with pytest.raises(AssetError, match="/World/Toy"):
        add_usd(builder, tmp_path / "flat.usda")
    assert not builder.particle_count
    monkeypatch.setattr(process.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"softmode\[usd\]"):
        read_usd_scene(path)


def test_options_reach_newton(tmp_path: Path) -> None:
    """`newton_options` are those of `newton.ModelBuilder.add_usd`: without a free joint the prop is fixed."""
    author = Author.create(tmp_path / "a.usda")
    author.prop("/World/Prop", (0.0, 0.0, 0.1))
    author.save()
    for options, count in (({}, 6), ({"floating": False}, 0)):
        builder = newton.ModelBuilder()
        assert not add_usd(builder, tmp_path / "a.usda", newton_options=options).bodies
        assert builder.joint_dof_count == count


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_place_of_a_stage(tmp_path: Path, up: str) -> None:
    """Rigid and soft things of a stage move together: x' = R x + t."""
    author = Author.create(tmp_path / "a.usda", up)
    author.prop("/World/Prop", (0.3, 0.0, 0.1))
    author.body("/World/Toy", "Mesh", matrix=transform((0.0, 0.2, 0.1)))
    author.save()
    place = transform((1.0, 2.0, 0.5), turn=0.5)
    builder = newton.ModelBuilder()
    found = add_usd(builder, tmp_path / "a.usda", position=place[:3, 3].tolist(), rotation=place[:3, :3], **FEW)
    body = found.bodies["/World/Toy"]
    expected = [place[:3, :3] @ np.array(x) + place[:3, 3] for x in ((0.3, 0.0, 0.1), (0.0, 0.2, 0.1))]
    np.testing.assert_allclose(builder.body_q[0][:3], expected[0], atol=1e-6)
    np.testing.assert_allclose(body.position, expected[1], atol=1e-6)
    middle = np.mean([list(q) for q in builder.particle_q], axis=0)
    np.testing.assert_allclose(middle, expected[1], atol=0.01)


def test_importing_names_loads_no_openusd() -> None:
    """The reader of scenes itself leaves OpenUSD to another process; `newton`, which `add_usd` needs, brings it."""
    code = "import sys; from softmode.usd import read_usd_scene; sys.exit('pxr' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


GRID = [(0.02 * i - 0.04, 0.02 * j - 0.04, 0.0) for j in range(5) for i in range(5)]
QUADS = [
    corner for j in range(4) for i in range(4) for corner in (5 * j + i, 5 * j + i + 1, 5 * j + i + 6, 5 * j + i + 5)
]


def cloth_and_sand(path: Path, meters: float = 1.0, kilograms: float = 1.0) -> Path:
    """Author a soft box, a cloth over it, and a heap of sand that a scene of Newton's material points owns."""
    author = Author.create(path, "Z", meters, kilograms)
    stage, pressure = author.stage, meters / kilograms
    author.body("/World/Brick", "TetMesh", matrix=transform((0.0, 0.0, 0.035)))
    weave = UsdShade.Material.Define(stage, "/World/Weave").GetPrim()
    weave.AddAppliedSchema("PhysicsSurfaceDeformableMaterialAPI")
    weave.CreateAttribute("physics:youngsModulus", Sdf.ValueTypeNames.Float).Set(1.0e5 * pressure)
    weave.CreateAttribute("physics:density", Sdf.ValueTypeNames.Float).Set(300.0 * meters**3 / kilograms)
    cloth = UsdGeom.Mesh.Define(stage, "/World/Cloth")
    for name in ("PhysicsDeformableBodyAPI", "PhysicsSurfaceDeformableSimAPI"):
        cloth.GetPrim().AddAppliedSchema(name)
    cloth.CreatePointsAttr([author.vector(x) for x in GRID])
    cloth.CreateFaceVertexCountsAttr([4] * 16)
    cloth.CreateFaceVertexIndicesAttr(QUADS)
    cloth.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, 0.12 / meters))
    thickness = cloth.GetPrim().CreateAttribute("physics:thicknesses", Sdf.ValueTypeNames.FloatArray)
    thickness.Set([0.001 / meters])
    element = cloth.GetPrim().CreateAttribute("physics:thicknesses:elementType", Sdf.ValueTypeNames.Token)
    element.Set("constant")
    UsdShade.MaterialBindingAPI.Apply(cloth.GetPrim()).Bind(
        UsdShade.Material(weave), UsdShade.Tokens.weakerThanDescendants, "physics"
    )
    UsdPhysics.Scene.Define(stage, "/World/Physics")
    UsdPhysics.Scene.Define(stage, "/World/Grains").GetPrim().AddAppliedSchema("NewtonMPMSceneAPI")
    grain = UsdShade.Material.Define(stage, "/World/Grain").GetPrim()
    grain.AddAppliedSchema("NewtonMPMMaterialAPI")
    grain.CreateAttribute("newton:mpm:youngsModulus", Sdf.ValueTypeNames.Float).Set(1.0e6 * pressure)
    sand = UsdGeom.Points.Define(stage, "/World/Sand")
    for name in ("PhysicsDeformableBodyAPI", "NewtonPointsDeformableSimAPI"):
        sand.GetPrim().AddAppliedSchema(name)
    sand.GetPrim().CreateRelationship("physics:simulationOwner").SetTargets(["/World/Grains"])
    sand.CreatePointsAttr([author.vector((x + 0.3, y, 0.1)) for x, y, _ in GRID])
    sand.CreateWidthsAttr([0.02 / meters] * len(GRID))
    sand.GetPrim().CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(0.3 / kilograms)
    UsdShade.MaterialBindingAPI.Apply(sand.GetPrim()).Bind(
        UsdShade.Material(grain), UsdShade.Tokens.weakerThanDescendants, "physics"
    )
    author.save()
    return path


def test_cloth_and_sand_are_left_to_newton(tmp_path: Path) -> None:
    """One cloth loses no stage and sand becomes no jelly: Newton has both, in any unit."""
    models = []
    for meters, kilograms in ((1.0, 1.0), (0.001, 0.001)):
        path = cloth_and_sand(tmp_path / f"{meters}.usda", meters, kilograms)
        builder = newton.ModelBuilder()
        found = add_usd(builder, path, **FEW)
        assert list(found.bodies) == ["/World/Brick"]
        left = [note for note in found.scene.notes if "left to Newton" in note]
        assert len(left) == 2 and "/World/Cloth: is cloth" in left[0] and "/World/Sand" in left[1]
        models.append((builder.finalize(), found))
    (model, found), (other, _) = models
    assert model.tri_count == 32 and model.particle_count == 25 + 25 + 100
    for name in ("particle_q", "particle_mass", "particle_radius", "tri_materials", "tri_poses"):
        np.testing.assert_allclose(getattr(other, name).numpy(), getattr(model, name).numpy(), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(other.mpm.young_modulus.numpy(), model.mpm.young_modulus.numpy(), rtol=1e-5)
    with pytest.warns(UserWarning, match=r"32 triangles of cloth.*SolverVBD.*25 loose particles.*SolverImplicitMPM"):
        solver = SolverReduced(model, found.reduced_bodies)
    assert solver.instance_count == 1


@pytest.mark.slow
def test_newton_steps_its_own_beside_the_toy(tmp_path: Path) -> None:
    """A step of Newton's solver before softmode's, between the same states, moves the cloth alone."""
    from newton.solvers import SolverXPBD

    builder = newton.ModelBuilder()
    found = add_usd(builder, cloth_and_sand(tmp_path / "a.usda"), **FEW)
    model = builder.finalize()
    solver = SolverReduced(model, found.reduced_bodies)
    cloth, state, after = SolverXPBD(model), model.state(), model.state()
    rest = state.particle_q.numpy().copy()
    for _ in range(4):
        cloth.step(state, after, None, None, 1.0 / 240.0)
        solver.step(state, after, None, None, 1.0 / 240.0)
        state, after = after, state
    fallen = state.particle_q.numpy()[:, 2] - rest[:, 2]
    assert (fallen[:25] < 0.0).all() and (fallen[50:] < 0.0).all()
    single = newton.ModelBuilder()
    found.bodies["/World/Brick"].add_to(single)
    alone = single.finalize()
    lone, first, second = SolverReduced(alone, found.reduced_bodies), alone.state(), alone.state()
    for _ in range(4):
        lone.step(first, second, None, None, 1.0 / 240.0)
        first, second = second, first
    np.testing.assert_array_equal(soft(first).q.numpy(), soft(state).q.numpy())


def test_which_deformables_are_taken(tmp_path: Path) -> None:
    """`only` and `skip` take paths and patterns; what is not taken is Newton's; what matches nothing is refused."""
    path = everything(tmp_path / "a.usda")
    given = FEW
    found = add_usd(newton.ModelBuilder(), path, only="/World/T*", **given)
    assert list(found.bodies) == ["/World/Toy"] and any(
        "/World/Brick: is not asked for" in n for n in found.scene.notes
    )
    found = add_usd(newton.ModelBuilder(), path, skip=["/World/Toy"], **given)
    assert list(found.bodies) == ["/World/Brick"]
    builder = newton.ModelBuilder()
    found = add_usd(builder, path, skip="/World", **given)
    assert not found.bodies and not hasattr(builder.finalize(), "softmode")
    with pytest.raises(AssetError, match="'/World/Toi' matches no deformable; there are: /World/Toy, /World/Brick"):
        add_usd(newton.ModelBuilder(), path, skip=["/World/Toi"], **given)
