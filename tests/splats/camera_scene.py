"""A table, a red box and a hand in each world, with cameras and splats to look at them."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

from softmode.splats import Splats
from softmode.splats.cameras.camera import CameraOptions
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import SplatArrays
from softmode.splats.splats import SH_DC

SIZE = 64
PLAIN = CameraOptions(shadows=False, splat_shadow=None)


def scene(worlds: int = 1, device: str = "cpu") -> newton.Model:
    """Return a table with its top at z = 0, a red box standing on it, and a hand above, in each world."""
    world = newton.ModelBuilder()
    pose = wp.transform
    world.add_shape_box(-1, xform=pose(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity()), hx=0.5, hy=0.5, hz=0.05)
    box = world.add_body(xform=pose(wp.vec3(0.1, 0.1, 0.05), wp.quat_identity()), label="box")
    world.add_shape_box(box, hx=0.03, hy=0.03, hz=0.05, color=(0.9, 0.1, 0.1))
    hand = world.add_body(xform=pose(wp.vec3(0.0, 0.0, 0.4), wp.quat_identity()), label="hand")
    world.add_shape_box(hand, xform=pose(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity()), hx=0.02, hy=0.02, hz=0.02)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder.finalize(device=device)


def camera(name: str = "front", **kwargs) -> PinholeCamera:
    """Return a camera that looks along -x over the table."""
    arguments = {"position": (0.6, 0.0, 0.3), "target": (0.0, 0.0, 0.05), "width": SIZE, "height": SIZE} | kwargs
    return PinholeCamera.look_at(name, **arguments)


def marker(position: tuple[float, float, float], sigma: float = 0.01) -> Splats:
    """Return one opaque green dot."""
    color = (np.array([0.1, 0.9, 0.1]) - 0.5) / SH_DC
    return Splats(
        means=[position], quats=[[0, 0, 0, 1]], scales=[[sigma] * 3], opacities=[1.0], sh=color[None, None]
    )  # fmt: skip


def arrays(splats: Splats, worlds: int = 1) -> SplatArrays:
    """Upload the splats."""
    return SplatArrays.from_splats([splats], world_count=worlds, device="cpu")
