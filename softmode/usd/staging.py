"""What a recording needs to be looked at: cameras, lights, and whole time codes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from softmode.foreign.openusd import Stage
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import rotations_from_quats
from softmode.usd.openusd import openusd
from softmode.usd.writer import prim_name, set_place

CAMERAS, LIGHTS = "/World/Cameras", "/World/Lights"
_APERTURE = 20.955
"""Width of the film, OpenUSD's own default; only its ratio to the focal length counts."""
_FINEST = 64
"""Most time codes per frame."""


def whole_codes(times: Sequence[float], fps: float) -> tuple[list[float], float]:
    """Return time codes and how many there are in a second: the least multiple of ``fps`` that makes them whole.

    They are not whole where no multiple up to 64 does that; then there are ``fps`` in a second.

    Args:
        times: When the frames are [s].
        fps: Time codes per second, unless they need more.
    """
    for count in range(1, _FINEST + 1):
        codes = np.asarray(times) * (count * fps)
        if np.abs(codes - np.rint(codes)).max() < 1e-6:
            return np.rint(codes).tolist(), count * fps
    return [time * fps for time in times], fps


def author_lights(stage: Stage) -> None:
    """Author a sky and a sun."""
    Gf, UsdGeom, UsdLux = openusd("Gf", "UsdGeom", "UsdLux")
    UsdGeom.Xform.Define(stage, LIGHTS)
    UsdLux.DomeLight.Define(stage, f"{LIGHTS}/Sky").CreateIntensityAttr(400.0)
    sun = UsdLux.DistantLight.Define(stage, f"{LIGHTS}/Sun")
    sun.CreateIntensityAttr(1500.0)
    sun.CreateAngleAttr(1.0)
    sun.AddRotateXYZOp().Set(Gf.Vec3f(25.0, 22.0, 0.0))  # it shines along -z


def author_cameras(stage: Stage, cameras: Sequence[PinholeCamera]) -> None:
    """Author cameras that stand still."""
    Gf, UsdGeom = openusd("Gf", "UsdGeom")
    UsdGeom.Xform.Define(stage, CAMERAS)
    seen: set[str] = set()
    for view in cameras:
        made = UsdGeom.Camera.Define(stage, f"{CAMERAS}/{prim_name(view.name, seen)}")
        turn = rotations_from_quats(np.array([view.quat], dtype=np.float64))[0]
        set_place(made, view.position, turn * [1.0, -1.0, -1.0], 1.0)  # OpenUSD looks along -z with y up
        focal = _APERTURE * view.fx / view.width
        made.CreateFocalLengthAttr(focal)
        made.CreateHorizontalApertureAttr(_APERTURE)
        made.CreateVerticalApertureAttr(view.height * focal / view.fy)
        made.CreateHorizontalApertureOffsetAttr((0.5 * view.width - view.cx) * focal / view.fx)
        made.CreateVerticalApertureOffsetAttr((view.cy - 0.5 * view.height) * focal / view.fy)
        made.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))


def overview(points: NDArray[np.float64]) -> PinholeCamera:
    """Return a camera that sees points, shape (N, 3) [m], from in front and above."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre, reach = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    fov, direction = 0.7, np.array([0.45, -0.8, 0.4]) / np.linalg.norm([0.45, -0.8, 0.4])
    x, y, z = (centre + direction * 1.2 * reach / np.sin(0.5 * fov)).tolist()
    a, b, c = centre.tolist()
    return PinholeCamera.look_at("View", position=(x, y, z), target=(a, b, c), width=640, height=480, fov_y=fov)
