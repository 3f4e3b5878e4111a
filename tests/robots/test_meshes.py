"""Meshes of a URDF: packages are found, other formats are converted, what is only seen may be missing."""

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import pdist

from softmode import robots
from softmode.errors import AssetError, MissingExtraError
from tests.robots.files import URDF, write_urdf

mujoco: Any = importlib.import_module("mujoco")

WEDGE = "package://lifter/meshes/wedge.stl"
ARM = "package://lifter/meshes/arm.dae"

DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0  40 0 0  0 10 0  0 0 20</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
"""A tetrahedron of 40 x 10 x 20 mm."""


def diagonal(robot: robots.RobotDescription, link: str) -> float:
    """Return the longest distance between corners of the mesh of a link [m]."""
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    own = model.geom_bodyid == model.body(link).id
    mesh = int(model.geom_dataid[own & (model.geom_dataid >= 0)][0])
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return float(pdist(model.mesh_vert[start : start + count]).max())


def write(folder: Path, name: str, mesh: trimesh.Trimesh | None = None, text: str | bytes | None = None) -> None:
    """Write a mesh beside the wedge."""
    path = folder / "lifter" / "meshes" / name
    if mesh is not None:
        mesh.export(path)
    else:
        path.write_bytes(text.encode() if isinstance(text, str) else text or b"")


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".off", ".stl"])
@pytest.mark.filterwarnings("ignore:robot file:UserWarning")
def test_other_formats_collide(suffix, tmp_path) -> None:
    """A box keeps its size in every format; a text STL, which MuJoCo does not read, counts as one."""
    path = write_urdf(tmp_path, URDF.replace(WEDGE, f"package://lifter/meshes/finger{suffix}"))
    box = trimesh.creation.box((0.04, 0.01, 0.02))
    if suffix == ".stl":
        write(tmp_path, "finger.stl", text=str(box.export(file_type="stl_ascii")))
    else:
        write(tmp_path, f"finger{suffix}", box)
    robot = robots.load(path)
    assert diagonal(robot, "jaw_a") == pytest.approx(np.linalg.norm([0.04, 0.01, 0.02]), abs=1e-6)
    assert robot.gripper is not None and robot.gripper.joints == ("jaw_a", "jaw_b")


def test_collada(tmp_path) -> None:
    """The unit of the file counts, its up axis does not."""
    pytest.importorskip("collada")
    path = write_urdf(tmp_path, URDF.replace(WEDGE, ARM))
    write(tmp_path, "arm.dae", text=DAE)
    robot = robots.load(path)
    assert diagonal(robot, "jaw_a") == pytest.approx(np.linalg.norm([0.04, 0.02]), abs=1e-6)
    assert not any("left out" in note for note in robot.notes)


def test_collada_without_its_package(tmp_path, monkeypatch) -> None:
    """What is only seen is left out with a warning that names it; what collides is an error that names the extra."""
    monkeypatch.setitem(__import__("sys").modules, "collada", None)
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path / "cache"))
    path = write_urdf(tmp_path)
    write(tmp_path, "arm.dae", text=DAE)
    with pytest.warns(UserWarning, match=r"only seen.*arm\.dae.*robots"):
        robot = robots.load(path)
    assert any("arm.dae" in note for note in robot.notes)
    path.write_text(URDF.replace(WEDGE, ARM))
    with pytest.raises(MissingExtraError, match=r"arm\.dae.*softmode\[robots\]"):
        robots.load(path)


@pytest.mark.parametrize(
    ("name", "data", "words"), [("arm.ply", b"ply\nnonsense", "cannot be read"), ("arm.fbx", b"?", "unknown kind")]
)
def test_unreadable(name, data, words, tmp_path) -> None:
    """The same for a damaged file and one of an unknown kind; nothing of them is kept."""
    path = write_urdf(tmp_path, URDF.replace("arm.dae", name))
    write(tmp_path, name, text=data)
    with pytest.warns(UserWarning, match=name):
        assert robots.load(path).gripper is not None
    path.write_text(URDF.replace("wedge.stl", name))
    with pytest.raises(AssetError, match=f"{name}.*{words}"):
        robots.load(path)


@pytest.mark.filterwarnings("ignore:robot file:UserWarning")
def test_package_by_its_name(tmp_path) -> None:
    """A package lies in the robot's own or a named root, or is the folder whose package.xml has its name: not any."""
    path = write_urdf(tmp_path)
    assert robots.load(path).gripper is not None
    (path.parent / "deep").mkdir()
    path = path.rename(path.parent / "deep" / path.name)
    with pytest.raises(AssetError, match="asset_root"):  # the folder above is called so, which says nothing
        robots.load(path)
    assert robots.load(path, asset_root=tmp_path).gripper is not None
    (tmp_path / "lifter" / "package.xml").write_text("<package><name>lifter</name></package>")
    assert robots.load(path).gripper is not None
    path.write_text(URDF.replace("package://lifter", "package://lifter_description"))
    with pytest.raises(AssetError, match="asset_root"):
        robots.load(path)
    (tmp_path / "lifter" / "package.xml").write_text("<package><name>lifter_description</name></package>")
    assert robots.load(path).gripper is not None
    path = path.rename(path.parents[1] / path.name)
    path.write_text(URDF.replace(WEDGE, "../meshes/wedge.stl"))
    assert robots.load(path).gripper is not None


def test_nothing_outside_the_package(tmp_path) -> None:
    """A link out of the package, dots behind its name, and packages beyond a named root are refused."""
    path = write_urdf(tmp_path, URDF.replace(WEDGE, "package://lifter/meshes/link.stl"))
    os.rename(tmp_path / "lifter" / "meshes" / "wedge.stl", tmp_path / "secret.stl")
    os.symlink(tmp_path / "secret.stl", tmp_path / "lifter" / "meshes" / "link.stl")
    for name in ("lifter/meshes/link.stl", "lifter/../secret.stl", "../secret.stl", "./secret.stl"):
        path.write_text(URDF.replace("lifter/meshes/wedge.stl", name))
        with pytest.raises(AssetError, match=r"lifter\.urdf"):
            robots.load(path)
    path.write_text(URDF)
    os.rename(tmp_path / "secret.stl", tmp_path / "lifter" / "meshes" / "wedge.stl")
    with pytest.raises(AssetError, match="asset_root"):
        robots.load(path, asset_root=path.parent)


@pytest.mark.filterwarnings("ignore:robot file:UserWarning")
def test_inertia_of_careless_files(tmp_path) -> None:
    """Of several inertias the first counts; one that is not positive keeps its diagonal."""
    wrong = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="3e-4" ixz="0" iyz="0"/></inertial>'
    right = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    twice = f'{wrong}<inertial><mass value="9"/>{right}'
    robot = robots.load(write_urdf(tmp_path, URDF.replace(right, twice, 1)))
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    assert model.body("jaw_a").mass == pytest.approx(0.1)
    np.testing.assert_allclose(model.body("jaw_a").inertia, 1e-4, rtol=1e-6)
    assert sum(note.startswith("link 'jaw_a'") for note in robot.notes) == 2
