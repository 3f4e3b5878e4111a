"""Folders of pictures with poses: lenses, files there and back, and what does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from softmode.errors import AssetError, ConfigError
from softmode.splats import Lens, PinholeCamera, read_transforms, write_transforms

LENS = Lens(k1=0.08, k2=-0.03, p1=0.001, p2=-0.0008, k3=0.01)


def cameras(edge: int = 48) -> list[PinholeCamera]:
    """Return two cameras on the origin."""
    eyes = ((0.5, -0.1, 0.3), (-0.2, 0.6, 0.1))
    return [
        PinholeCamera.look_at(f"{i}", position=eye, target=(0.0, 0.0, 0.0), width=edge, height=edge)
        for i, eye in enumerate(eyes)
    ]


def folder(path: Path) -> Path:
    """Write two pictures of a smooth pattern, with a lens; return their folder."""
    x = np.linspace(0.0, 1.0, 48)
    picture = np.stack(np.broadcast_arrays(x[:, None], x, 0.5), axis=-1)
    write_transforms(path, cameras(), np.stack([picture, picture[::-1]]), LENS)
    return path


def test_there_and_back(tmp_path: Path) -> None:
    """Cameras and lens come back; the picture without the lens is what was written, to half a grey level."""
    found = read_transforms(folder(tmp_path))
    x = np.linspace(0.0, 1.0, 48)
    for given, picture in zip(cameras(), found, strict=True):
        np.testing.assert_allclose(picture.camera.world_to_camera, given.world_to_camera, atol=1e-12)
        np.testing.assert_allclose(picture.camera.matrix, given.matrix)
        assert picture.lens == LENS
    inner = found[0].undistorted()[6:-6, 6:-6]
    np.testing.assert_allclose(inner[..., 1], np.broadcast_to(x, (48, 48))[6:-6, 6:-6], atol=0.003)
    np.testing.assert_allclose(LENS.distorted(LENS.undistorted([[0.3, -0.2]])), [[0.3, -0.2]], atol=1e-12)


def test_rays_meet_what_is_projected(tmp_path: Path) -> None:
    """A point on the ray of a pixel is shown in the middle of that pixel."""
    picture = read_transforms(folder(tmp_path) / "transforms.json")[1]
    places = np.asarray(picture.camera.position) + 0.7 * picture.rays()
    u, v = np.meshgrid(np.arange(48) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose(picture.project(places), np.stack([u, v], axis=-1), atol=1e-9)


def test_the_layout_of_nerf(tmp_path: Path) -> None:
    """A field of view, sizes of the pictures and names without a suffix do."""
    told = json.loads((folder(tmp_path) / "transforms.json").read_text())
    frame = {"file_path": "images/0", "transform_matrix": told["frames"][0]["transform_matrix"]}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
    found = read_transforms(tmp_path)[0]
    assert found.camera.fx == pytest.approx(cameras()[0].fx) and found.lens == Lens()
    assert found.pixels().shape == (48, 48, 3)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"frames": []}, "no frames"),
        ({"camera_model": "OPENCV_FISHEYE"}, "FISHEYE"),
        ({"file_path": "images/9.png"}, "no picture"),
        ({"transform_matrix": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "rotation"),
        ({"transform_matrix": [[1.0]]}, "rotation"),
        ({"fl_x": "a"}, "damaged"),
        ({"w": 60}, "60 x 48"),
    ],
)
def test_what_does_not_fit(tmp_path: Path, changes: dict, word: str) -> None:
    """A pose file that is none, or does not fit its pictures, is refused by what is wrong."""
    told = json.loads((folder(tmp_path) / "transforms.json").read_text())
    (told if set(changes) <= {"frames", "camera_model"} else told["frames"][1]).update(changes)
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    with pytest.raises(AssetError, match=word):
        read_transforms(tmp_path)[1].pixels()
    (tmp_path / "images/0.png").write_bytes(b"no picture")
    with pytest.raises(AssetError):
        read_transforms(tmp_path)[0].pixels()


def test_pictures_for_their_cameras(tmp_path: Path) -> None:
    """Pictures of another size than their cameras are not written; transparency is kept when read."""
    with pytest.raises(ConfigError, match="expected"):
        write_transforms(tmp_path, cameras(), np.zeros((2, 20, 20, 3)))
    Image.new("RGBA", (48, 48), (255, 0, 0, 128)).save(folder(tmp_path) / "images/0.png")
    assert read_transforms(tmp_path)[0].pixels().shape == (48, 48, 4)
