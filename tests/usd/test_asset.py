"""A stage as one object: for the body tool, environments and the browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError
from softmode.objects import ObjectConfig, Placed, SoftObject, load
from softmode.objects.mesh_file import read_mesh
from softmode.objects.object_file import file_kind
from softmode.usd import write_usd
from tests.usd.export_scenes import assert_same, assert_same_splats, small_body, small_splats
from tests.usd.stages import EDGES, Author, Gf, UsdGeom, UsdVol, box, shell, transform

SMALL = BuildOptions(mode_count=3, kernel_count=120, cubature_count=128)


def volume(corners: np.ndarray) -> float:
    """Return the volume that triangles facing outwards enclose [m^3]."""
    a, b, c = np.swapaxes(corners.astype(np.float64), 0, 1)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("kind", ["Mesh", "TetMesh"])
@pytest.mark.parametrize(("up", "meters"), [("Z", 1.0), ("Y", 0.01)])
def test_meshes_of_a_stage(tmp_path: Path, kind: str, up: str, meters: float) -> None:
    """In metres with z up, placed, facing outwards even where mirrored; what is invisible or a guide is left out."""
    author = Author.create(tmp_path / "a.usda", up, meters)
    prim = author.geometry("/World/Thing", kind)
    author.place(prim, transform((0.1, 0.2, 0.3)) @ np.diag([-1.0, 1.0, 1.0, 1.0]))
    if kind == "Mesh":
        hidden = author.geometry("/World/Hidden", "Mesh")
        UsdGeom.Imageable(hidden).MakeInvisible()
        UsdGeom.Imageable(author.geometry("/World/Guide", "Mesh")).CreatePurposeAttr("guide")
        author.geometry("/World/Tets", "TetMesh")
        UsdGeom.Mesh(prim).CreateDisplayColorAttr([Gf.Vec3f(0.25, 0.5, 0.0)])
    author.save()
    assert file_kind(tmp_path / "a.usda") == "mesh"
    mesh = read_mesh(tmp_path / "a.usda")
    assert volume(mesh.corners) == pytest.approx(box().volume, rel=1e-5)
    low, high = mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1))
    np.testing.assert_allclose(high - low, EDGES, rtol=1e-5)
    np.testing.assert_allclose(0.5 * (low + high), (0.1, 0.2, 0.3), atol=1e-6)
    if kind == "Mesh":  # linear 0.25 and 0.5, gamma-encoded
        np.testing.assert_allclose(mesh.corner_colors[0, 0], (0.5371, 0.7354, 0.0), atol=1e-4)


def test_a_mesh_in_a_stage_is_the_object_that_it_is_in_other_files(tmp_path: Path) -> None:
    """The body of a stage with a mesh has the volume and the inertia of that of the same mesh as .obj."""
    author = Author.create(tmp_path / "a.usda", "Y", 0.01)
    author.geometry("/World/Thing", "Mesh")
    author.save()
    box().export(tmp_path / "a.obj")
    found = [load(tmp_path / name, build=SMALL, pose="captured", splat_count=200) for name in ("a.usda", "a.obj")]
    one, two = (thing.body for thing in found)
    assert one.volume == pytest.approx(two.volume, rel=1e-5)
    np.testing.assert_allclose(one.bounds, two.bounds, atol=1e-6)


def test_kinds_of_stages(tmp_path: Path) -> None:
    """A body of softmode goes before splats, and those before meshes; several bodies, or nothing, are refused."""
    placed = Placed(object=SoftObject(body=small_body("affine"), splats=small_splats()))
    write_usd(tmp_path / "body.usdc", placed)
    assert file_kind(tmp_path / "body.usdc") == "body"
    thing = load(tmp_path / "body.usdc")
    assert_same(thing.body, small_body("affine"))
    assert_same_splats(thing.visible_splats, small_splats())
    write_usd(tmp_path / "two.usdc", [placed, placed])
    with pytest.raises(AssetError, match="holds 2 bodies"):
        file_kind(tmp_path / "two.usdc")
    with pytest.raises(AssetError, match="holds 2 bodies"):
        load(ObjectConfig(body=tmp_path / "two.usdc"))
    author = Author.create(tmp_path / "splats.usda")
    author.geometry("/World/Thing", "Mesh")
    author.splats(UsdVol.ParticleField3DGaussianSplat.Define(author.stage, "/World/Splats"), shell(50))
    author.save()
    assert file_kind(tmp_path / "splats.usda") == "splat"
    author = Author.create(tmp_path / "empty.usda")
    author.save()
    with pytest.raises(AssetError, match="holds no visible mesh"):
        read_mesh(tmp_path / "empty.usda")
