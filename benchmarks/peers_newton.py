"""Newton's ray-traced Gaussians on the splats of `camera_scene`: one view, at rest, in its fast mode."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from softmode.splats.splats import Splats, quats_from_rotations


class NewtonCamera:
    """`SensorCamera` looking at one `newton.Gaussian`; defaults of Newton wherever it has them.

    Args:
        splats: The splats; Newton draws their degree 0.
        world_to_camera: Pose, OpenCV axes, shape (4, 4).
        lens: fx, fy, cx, cy [px].
        size: Image edge [px].
        device: Warp device.
    """

    def __init__(
        self,
        splats: Splats,
        world_to_camera: np.ndarray,
        lens: tuple[float, float, float, float],
        size: int,
        *,
        device: str = "cpu",
    ) -> None:
        """Build the model, its trees and the rays."""
        gaussian = newton.Gaussian(
            splats.means, splats.quats, splats.scales, splats.opacities, splats.sh[:, 0], sh_degree=0
        )  # fmt: skip
        builder = newton.ModelBuilder()
        builder.add_shape_gaussian(-1, gaussian=gaussian)
        self.model = builder.finalize(device=device)
        self.state = self.model.state()
        self.sensor = SensorCamera(self.model, load_textures=False)
        rotation = world_to_camera[:3, :3].T
        position = -rotation @ world_to_camera[:3, 3]
        turned = quats_from_rotations(rotation @ np.diag([1.0, -1.0, -1.0]))
        self.pose: Any = wp.array([wp.transform(position, turned)], dtype=wp.transform, device=device)
        fx, fy, cx, cy = lens
        rays = np.zeros((size, size, 1, 2, 3))
        rays[..., 0, 1, 0] = (np.arange(size) + 0.5 - cx) / fx
        rays[..., 0, 1, 1] = -((np.arange(size) + 0.5 - cy) / fy)[:, None]
        rays[..., 1, 2] = -1.0
        rays[..., 1, :] /= np.linalg.norm(rays[..., 1, :], axis=-1, keepdims=True)
        self.rays: Any = wp.array(rays.astype(np.float32), dtype=wp.vec3, device=device)
        self.color: Any = wp.zeros((1, size, size), dtype=wp.uint32, device=device)

    def draw(self) -> None:
        """Draw a frame of splats that have not moved: nothing is refitted."""
        self.sensor.update(self.state, self.pose, self.rays, color_image=self.color)

    def image(self) -> np.ndarray:
        """Return the last frame on black, shape (size, size, 3)."""
        packed = self.color.numpy()[0]
        channels = np.stack([packed >> shift & 255 for shift in (0, 8, 16)], axis=-1)
        return np.where((packed >> 24)[..., None] > 0, channels, 0) / 255.0
