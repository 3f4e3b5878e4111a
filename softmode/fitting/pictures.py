"""Pictures of an object's coverage in many of its states, seen by cameras of one lens that differ in place."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.objects.soft_object import SoftObject
from softmode.scenes.binding import BoundSplats
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import SplatRasterizer, ViewArrays

Array = NDArray[np.float64]
BATCH = 64
"""Pictures at a time."""


class CoverPictures:
    """Draws the coverage of an object by its splats.

    Args:
        thing: The object.
        camera: The lens; where it stands is told with each picture.
        device: Warp device.
    """

    def __init__(self, thing: SoftObject, camera: PinholeCamera, *, device: wp.DeviceLike = None) -> None:
        """Upload the splats."""
        self._device = device
        self._bound = BoundSplats(None, [thing], worlds=range(BATCH), sh_degree=0, device=device)
        count = self._bound.arrays.means.shape[1]
        self._raster = SplatRasterizer(count, BATCH, camera.width, camera.height, device=device)
        self._views = ViewArrays.from_cameras([camera] * BATCH, world=range(BATCH), device=device)

    def draw(self, q: Array, poses: Array, *, color: bool = False) -> NDArray[np.float32]:
        """Return the coverage 0..1 of states, shape (N, H, W), or their colours (N, H, W, 3).

        Args:
            q: Coordinates [m], shape (N, n, 3).
            poses: From the world to the camera, shape (N, 4, 4).
            color: Whether colours are wanted.
        """
        found = []
        for first in range(0, len(q), BATCH):
            rows = np.minimum(np.arange(first, first + BATCH), len(q) - 1)
            self._views.world_to_camera.assign(poses[rows].astype(np.float32))
            self._bound.move(wp.array(q[rows].reshape(-1, 3), dtype=wp.vec3d, device=self._device))
            self._raster.render(self._bound.arrays, self._views)
            picture = self._raster.rgb if color else self._raster.alpha
            found.append(picture.numpy()[: len(q) - first].copy())
        return np.concatenate(found)


def project(camera: PinholeCamera, poses: Array, points: Array) -> tuple[Array, Array]:
    """Return pixels (..., 2) and forward depths [m] of points (..., 3) of the world, with poses (..., 4, 4)."""
    seen = (poses[..., :3, :3] @ points[..., None])[..., 0] + poses[..., :3, 3]
    depth = seen[..., 2]
    pixels = np.stack([camera.fx * seen[..., 0], camera.fy * seen[..., 1]], axis=-1) / depth[..., None]
    return pixels + np.array([camera.cx, camera.cy]), depth
