"""Damaged files of every kind that others' code parses: read, or refused by a typed error that keeps its cause."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals

from softmode import robots
from softmode.errors import AssetError, ConfigError, SoftmodeError
from softmode.objects.mesh_file import read_mesh
from softmode.robots.description import JointDrive
from softmode.splats.colored_mesh import ColoredMesh
from tests.foreign.bombs import flat_png, gltf, shuffled, textured_gltf
from tests.robots.files import MJCF, URDF


def meshes(folder: Path) -> dict[str, bytes]:
    """Return sound files by suffix."""
    ball: Any = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.arange(4 * len(ball.vertices)).reshape(-1, 4) % 255
    scene = gltf(folder, textured_gltf(2, flat_png(16)))
    found = {"gltf": scene.read_bytes()}
    for kind in ("glb", "ply", "stl", "off", "obj"):
        data: Any = ball.export(file_type=kind)
        found[kind] = data if isinstance(data, bytes) else data.encode()
    return found


@pytest.mark.parametrize("trials", [range(120), pytest.param(range(120, 800), marks=pytest.mark.rest)], ids=str)
def test_meshes(tmp_path: Path, trials: range) -> None:
    """Some of each kind are refused and some read, and what is read is finite."""
    sound = meshes(tmp_path)
    refused = 0
    for trial in trials:
        kind = list(sound)[trial % len(sound)]
        path = tmp_path / f"{trial}.{kind}"
        path.write_bytes(shuffled(sound[kind], trial))
        try:
            assert np.isfinite(read_mesh(path).corners).all()
        except SoftmodeError as error:
            assert error.message and error.hint
            refused += 1
        path.unlink()
    assert 0 < refused < len(trials)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_meshes_in_memory() -> None:
    """What is put into a mesh of trimesh and contradicts it ends in a typed error, with its cause."""
    for name, value in (("faces", [[0, 1, 99]]), ("faces", [[0, 1, -1]]), ("vertices", np.full((12, 3), np.nan))):
        mesh = trimesh.creation.icosphere(subdivisions=0)
        setattr(mesh, name, value)
        with pytest.raises(AssetError):
            ColoredMesh.from_trimesh(mesh)
    mesh = trimesh.creation.icosphere(subdivisions=0)
    mesh.visual = TextureVisuals(uv=np.zeros((12, 2)), image=object())
    with pytest.raises(AssetError) as caught:
        ColoredMesh.from_trimesh(mesh)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize("trials", [range(16), pytest.param(range(16, 120), marks=pytest.mark.rest)], ids=str)
def test_robots(tmp_path: Path, trials: range) -> None:
    """Robot files alike; meshes are left out, so that most of the file is numbers and names."""
    mjcf = MJCF.replace('<geom type="mesh" mesh="wedge" mass="0.05"/>', '<geom size="0.01" mass="0.05"/>')
    mjcf = mjcf.replace('<asset><mesh name="wedge" file="wedge.stl"/></asset>', "")
    sound = {"xml": mjcf.encode(), "urdf": URDF.encode()}
    refused = 0
    for trial in trials:
        kind = list(sound)[trial % 2]
        path = tmp_path / f"{trial}.{kind}"
        path.write_bytes(shuffled(sound[kind], trial))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                robot = robots.load(path)
            assert np.isfinite(robot.home_joint_q).all()
        except SoftmodeError as error:
            assert error.message and error.hint
            refused += 1
    assert refused


@pytest.mark.parametrize(
    "wrong",
    [
        {"stiffness": float("nan")},
        {"stiffness": -1.0},
        {"stiffness": 1e300},
        {"damping": float("nan")},
        {"damping": -1.0},
        {"effort_limit": float("nan")},
        {"effort_limit": -1.0},
        {"lower": float("nan")},
    ],
    ids=str,
)
def test_drives(wrong: dict[str, float]) -> None:
    """A drive has gains that are some, and limits that are not NaN."""
    with pytest.raises(ConfigError):
        JointDrive(**({"stiffness": 1.0, "damping": 1.0} | wrong))
