"""Copies of PointInstancers, colours and textures of stages, and what is said of the rest.

Builds one box, to see that a stage with two copies of it makes two objects.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from softmode.errors import AssetError
from softmode.objects import load
from softmode.objects.stage.scene import read_usd_scene
from softmode.objects.stage_asset import read_usd_mesh
from softmode.splats import read_splats
from tests.usd.stages import EDGES, Author, Gf, Sdf, Usd, UsdGeom, UsdShade, box, shell

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def instancer(author: Author, path: str, targets: list[str], indices: list[int], **values: Any) -> Any:
    """Author a PointInstancer whose instances stand 0.2 m apart along x."""
    made = UsdGeom.PointInstancer.Define(author.stage, path)
    made.CreatePrototypesRel().SetTargets(targets)
    made.CreateProtoIndicesAttr(indices)
    made.CreatePositionsAttr([author.vector((0.2 * i, 0.0, 0.1)) for i in range(len(indices))])
    for name, value in values.items():
        made.GetPrim().GetAttribute(name).Set(value)
    return made


def places(path: Path) -> list[list[float]]:
    """Return where the bodies of a stage are [m]."""
    return [np.round(body.translation, 6).tolist() for body in read_usd_scene(path).deformables]


@pytest.mark.parametrize(("up", "meters"), [("Z", 1.0), ("Y", 0.01)])
def test_copies_are_bodies_and_prototypes_are_none(tmp_path: Path, up: str, meters: float) -> None:
    """Each instance is a body at its place with the prototype's material; masked ones and the prototype are none."""
    author = Author.create(tmp_path / "a.usda", up, meters)
    author.body("/World/Copies/Brick")
    made = instancer(author, "/World/Copies", ["/World/Copies/Brick"], [0, 0, 0])
    half = float(np.sqrt(0.5))
    axis = {"Z": Gf.Quath(half, 0, 0, half), "Y": Gf.Quath(half, 0, half, 0)}[up]  # a quarter about what is up
    made.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0), axis, axis])
    made.GetPrim().SetMetadata("inactiveIds", Sdf.Int64ListOp.CreateExplicit([2]))
    author.save()
    bodies = read_usd_scene(tmp_path / "a.usda").deformables
    assert places(tmp_path / "a.usda") == [[0.0, 0.0, 0.1], [0.2, 0.0, 0.1]]
    np.testing.assert_allclose(bodies[1].rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-3)
    assert {round(body.properties["density"]) for body in bodies} == {240}


def test_nested_shared_and_beside(tmp_path: Path) -> None:
    """An instancer in a prototype is copied along; a prototype beside its instancers is none, and a note says so."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Brick")
    UsdGeom.Xform.Define(author.stage, "/World/Row")
    instancer(author, "/World/Row/Inner", ["/World/Brick"], [0, 0])
    outer = instancer(author, "/World/Outer", ["/World/Row"], [0, 0])
    outer.GetPositionsAttr().Set([Gf.Vec3f(0, 0, 0), Gf.Vec3f(0, 1, 0)])
    author.save()
    found = sorted(places(tmp_path / "a.usda"))
    assert found == [[0.0, 0.0, 0.1], [0.0, 1.0, 0.1], [0.2, 0.0, 0.1], [0.2, 1.0, 0.1]]
    notes = read_usd_scene(tmp_path / "a.usda").notes
    assert any("/World/Brick: a prototype of" in note for note in notes)


def test_copies_of_meshes_splats_and_props(tmp_path: Path) -> None:
    """Meshes, splats and rigid props are copied too; a prototype without a place gets one."""
    author = Author.create(tmp_path / "mesh.usda")
    UsdGeom.Scope.Define(author.stage, "/World/P/Proto")
    author.geometry("/World/P/Proto/Mesh", "Mesh")
    instancer(author, "/World/P", ["/World/P/Proto"], [0, 0])
    author.save()
    corners = read_usd_mesh(tmp_path / "mesh.usda").corners
    assert len(corners) == 24
    np.testing.assert_allclose(np.ptp(corners, axis=(0, 1)), [EDGES[0] + 0.2, *EDGES[1:]], atol=1e-6)

    author = Author.create(tmp_path / "splats.usda")
    author.geometry("/World/P/Proto", "ParticleField3DGaussianSplat")
    author.geometry("/World/Curve", "Points")
    instancer(author, "/World/P", ["/World/P/Proto"], [0, 0, 0])
    author.save()
    splats = read_splats(tmp_path / "splats.usda")
    assert splats.count == 3 * shell().count
    assert splats.notes == ("/World/Curve: a Points, which is not read",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protoIndices": [0, 1]}, "protoIndices 0..1 for 1 prototypes"),
        ({"protoIndices": [0, -1]}, r"protoIndices -1\.\.0"),
        ({"protoIndices": [0]}, "1 protoIndices for 2 positions"),
        ({"scales": [(1, 1, 1)]}, "1 scales for 2 instances"),
        ({"prototypes": "/World/Absent"}, "does not exist"),
        ({"prototypes": "/World"}, "copies itself"),
        ({"protoIndices": [0] * 5000, "positions": [(0, 0, 0)] * 5000}, "more than 4096 copies"),
    ],
)
def test_instancers_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    """Indices out of range, counts that differ and prototypes that are none are refused by name."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/P/Brick")
    target = change.pop("prototypes", "/World/P/Brick")
    instancer(author, "/World/P", [target], [0, 0], **change)
    author.save()
    with pytest.raises(AssetError, match=message) as caught:
        read_usd_scene(tmp_path / "a.usda")
    assert "/World/P" in caught.value.message and caught.value.hint


def colors_by_side(path: Path) -> dict[int, list[float]]:
    """Return the mean colour of the corners of the triangles that face +x (1) and -x (-1)."""
    mesh = read_usd_mesh(path)
    normals = mesh.normals()
    sides = np.sign(np.round(normals[:, 0], 9))
    faces = np.arange(len(normals))
    colors = mesh.colors_at(faces, np.full((len(faces), 3), 1.0 / 3.0))
    return {side: np.round(colors[sides == side].mean(axis=0), 2).tolist() for side in (-1, 1)}


@pytest.mark.parametrize("interpolation", ["constant", "uniform", "vertex", "varying", "faceVarying"])
@pytest.mark.parametrize("indexed", [False, True])
def test_display_colours_of_every_interpolation(tmp_path: Path, interpolation: str, indexed: bool) -> None:
    """What lies at +x is blue and the rest is red, however it is authored."""
    author = Author.create(tmp_path / "a.usda")
    prim = author.geometry("/World/Mesh", "Mesh")
    mesh = box()
    blue = {
        "constant": np.ones(1, bool),
        "uniform": mesh.face_normals[:, 0] > 0.5,
        "vertex": mesh.vertices[:, 0] > 0.0,
        "varying": mesh.vertices[:, 0] > 0.0,
        "faceVarying": np.repeat(mesh.face_normals[:, 0] > 0.5, 3),
    }[interpolation]
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, interpolation)
    if indexed:
        primvar.Set([Gf.Vec3f(*RED), Gf.Vec3f(*BLUE)])
        primvar.SetIndices(blue.astype(int).tolist())
    else:
        primvar.Set([Gf.Vec3f(*(BLUE if one else RED)) for one in blue])
    author.save()
    found = colors_by_side(tmp_path / "a.usda")
    assert found[1] == list(BLUE) and found[-1] == list(BLUE if interpolation == "constant" else RED)


def textured(path: Path, interpolation: str) -> Author:
    """Author the box with a picture that is red on the left and blue on the right, and u = 1 at +x."""
    Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8).repeat(2, axis=0)).save(path.parent / "t.png")
    author = Author.create(path)
    stage, prim, mesh = author.stage, author.geometry("/World/Mesh", "Mesh"), box()
    at = mesh.vertices[:, 0] if interpolation == "vertex" else mesh.vertices[mesh.faces.ravel(), 0]
    uvs = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    uvs.Set([Gf.Vec2f(0.75 if x > 0 else 0.25, 0.5) for x in at])
    material = UsdShade.Material.Define(stage, "/World/Look")
    shader, texture, reader = (UsdShade.Shader.Define(stage, f"/World/Look/{n}") for n in ("S", "T", "R"))
    for one, kind in ((shader, "UsdPreviewSurface"), (texture, "UsdUVTexture"), (reader, "UsdPrimvarReader_float2")):
        one.CreateIdAttr(kind)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    color = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(texture.ConnectableAPI(), "rgb")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./t.png")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("map1")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    return author


@pytest.mark.parametrize("interpolation", ["vertex", "faceVarying"])
def test_textures_of_preview_surfaces(tmp_path: Path, interpolation: str) -> None:
    """A texture is looked up at the coordinates that its material names; a subset may have a colour of its own."""
    author = textured(tmp_path / "a.usda", interpolation)
    author.save()
    assert colors_by_side(tmp_path / "a.usda") == {-1: list(RED), 1: list(BLUE)}
    stage, faces = author.stage, np.flatnonzero(box().face_normals[:, 0] > 0.5).tolist()
    green = UsdShade.Material.Define(stage, "/World/Green")
    shader = UsdShade.Shader.Define(stage, "/World/Green/S")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0, 1, 0))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.5)
    green.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    mesh = UsdGeom.Mesh.Get(stage, "/World/Mesh")
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "side", "face", faces, "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(green)
    author.save()
    assert colors_by_side(tmp_path / "a.usda") == {-1: list(RED), 1: [0.0, 1.0, 0.0]}
    assert "/World/Green/S: its opacity is not read" in read_usd_mesh(tmp_path / "a.usda").notes[0]


def test_what_is_not_read_is_said(tmp_path: Path) -> None:
    """Missing textures, foreign materials, opacities, colours that do not fit and other geometry are in the notes."""
    author = textured(tmp_path / "a.usda", "vertex")
    (tmp_path / "t.png").write_bytes(b"no picture")
    prim = author.stage.GetPrimAtPath("/World/Mesh")
    UsdGeom.Gprim(prim).CreateDisplayOpacityAttr([0.3])
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex")
    primvar.Set([Gf.Vec3f(*RED)] * 3)
    UsdGeom.Sphere.Define(author.stage, "/World/Ball")
    author.stage.GetPrimAtPath("/World").SetActive(True)
    author.save()
    told = " | ".join(load(read_usd_mesh(tmp_path / "a.usda"), size=0.1).notes)
    for part in (
        "/World/Ball: a Sphere, which is not read",
        "displayOpacity down to 0.3 is not read",
        "texture ./t.png is no picture",
        "displayColor is not read: 3 values of interpolation vertex",
    ):
        assert part in told, part


def test_units_of_references_and_kinematic_bodies_are_warned_of(tmp_path: Path) -> None:
    """A cube in centimetres in a stage in metres is warned of with prim and remedy, unless the prim is scaled."""
    Author.create(tmp_path / "cube.usda", meters=0.01).save()
    inner = Author(Usd.Stage.Open(str(tmp_path / "cube.usda")), "Z", 0.01)
    inner.body("/World/Brick").CreateAttribute("physics:kinematicEnabled", Sdf.ValueTypeNames.Bool).Set(True)
    inner.save()
    for scale, said in ((1.0, True), (0.01, False)):
        outer = Author.create(tmp_path / f"{said}.usda")
        prim = UsdGeom.Xform.Define(outer.stage, "/World/Cube")
        prim.GetPrim().GetReferences().AddReference("./cube.usda")
        prim.AddScaleOp().Set(Gf.Vec3f(scale))
        outer.save()
        with pytest.warns(UserWarning, match="is kinematic in the stage") as caught:
            scene = read_usd_scene(tmp_path / f"{said}.usda")
        units = [str(one.message) for one in caught if "metersPerUnit" in str(one.message)]
        assert bool(units) == said
        if said:
            assert "/World/Cube" in units[0] and "scale the prim by 0.01" in units[0]
            assert any("scale the prim by 0.01" in note for note in scene.notes)
        volume = scene.deformables[0].surface
        assert volume is not None
        assert np.ptp(volume.vertices, axis=0).max() == pytest.approx(EDGES[0] * 100 * scale, rel=1e-6)
