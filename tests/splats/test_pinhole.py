"""Descriptions of cameras: frames and intrinsics."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import rotations_from_quats
from tests.splats.camera_scene import camera

mujoco: Any = importlib.import_module("mujoco")


def test_look_at_is_an_opencv_frame() -> None:
    """Columns of the rotation are right, down and forward; the target lies in the middle, z up in the picture."""
    view = camera(position=(1.0, 2.0, 3.0), target=(0.2, -0.3, 0.1), fov_y=0.7, height=100, width=160)
    r = rotations_from_quats([view.quat])[0]
    forward = np.subtract((0.2, -0.3, 0.1), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(r[:, 2], forward / np.linalg.norm(forward), atol=1e-12)
    assert r[2, 1] < 0.0 and abs(r[2, 0]) < 1e-12 and np.linalg.det(r) == pytest.approx(1.0)
    assert view.fy * math.tan(0.35) == pytest.approx(50.0) and (view.cx, view.cy) == (80.0, 50.0)


def test_calibration_matrix_goes_in_and_comes_out() -> None:
    """K is kept as it is, and maps a point of the camera frame to its pixel: K p / p_z."""
    k = np.array([[210.0, 0.0, 47.5], [0.0, 205.5, 40.25], [0.0, 0.0, 1.0]])
    view = PinholeCamera.from_matrix("calibrated", k, width=100, height=75, body="hand")
    np.testing.assert_array_equal(view.matrix, k)
    assert (view.position, view.quat, view.body) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "hand")
    for bad in (k[:2], k + np.eye(3, k=1), 2.0 * k):
        with pytest.raises(ConfigError, match="rectify"):
            PinholeCamera.from_matrix("bad", bad, width=100, height=75)


def test_mujoco_camera_keeps_its_axes() -> None:
    """MuJoCo's camera frame has x right, y up and looks along -z: OpenCV's is (x, -y, -z)."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><camera name="eye" pos="0.3 -0.2 0.5" xyaxes="0.6 0.8 0 -0.4 0.3 0.866" fovy="50"/>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    w, x, y, z = model.cam_quat[0].tolist()
    view = PinholeCamera.from_opengl(
        "eye", fov_y=math.radians(model.cam_fovy[0]), position=(0.3, -0.2, 0.5), quat=(x, y, z, w), width=60, height=40
    )
    axes = data.cam_xmat[0].reshape(3, 3)
    np.testing.assert_allclose(rotations_from_quats([view.quat])[0], axes * [1.0, -1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(rotations_from_quats([view.opengl_quat])[0], axes, atol=1e-12)
    assert view.fy == pytest.approx(20.0 / math.tan(math.radians(25.0))) and (view.cx, view.cy) == (30.0, 20.0)


def test_refuses_bad_descriptions() -> None:
    """Each message names the camera and what is wrong."""
    with pytest.raises(ConfigError, match="do not define a view"):
        camera(position=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="fov_y"):
        camera(fov_y=4.0)
    with pytest.raises(ConfigError, match="'front': 0 x 64"):
        camera(width=0)
    with pytest.raises(ConfigError, match="unit length"):
        PinholeCamera(**{**camera().__dict__, "quat": (0.0, 0.0, 0.0, 2.0)})
    with pytest.raises(ConfigError, match="finite"):
        PinholeCamera(**{**camera().__dict__, "fx": float("nan")})
