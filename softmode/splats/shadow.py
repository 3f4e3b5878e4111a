"""The shadow that splats cast on meshes: a small orthographic depth map along the light, one per world."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softmode.splats import camera_kernels as kernels
from softmode.splats.rasterizer import SplatArrays, ViewArrays


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """How dark and how fine the shadow is."""

    strength: float = 0.4
    """Share of the mesh's colour that full shadow takes away, 0..1."""
    cells: int = 40
    """Cells of the depth map along each side."""
    margin: float = 1.6
    """Width of the map in units of the rest extent of the splats."""
    softness: float = 1.3
    """Half width of the blurred rim [cells]."""


class SplatShadow:
    """Casts the shadow of all splats of a world along one light direction; capturable.

    The map follows the splats. Only meshes receive the shadow: splats carry the light they were captured in.

    Args:
        splats: The splats at rest; their extent sizes the map.
        world_count: Number of worlds.
        light_direction: Direction in which the light travels.
        options: Darkness and resolution.
        device: Warp device.
    """

    def __init__(
        self,
        splats: SplatArrays,
        world_count: int,
        light_direction: tuple[float, float, float],
        *,
        options: ShadowOptions | None = None,
        device: Any = None,
    ) -> None:
        """Allocate the map."""
        self.options = options if options is not None else ShadowOptions()
        light = np.asarray(light_direction, dtype=np.float64) / np.linalg.norm(light_direction)
        first = np.cross(light, [1.0, 0.0, 0.0] if abs(light[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        self._frame = wp.mat33(*np.stack([first, np.cross(light, first), light]).ravel())
        means = splats.means.numpy()[0]
        extent = float(np.linalg.norm(np.quantile(means, 0.99, axis=0) - np.quantile(means, 0.01, axis=0)))
        self._cell = self.options.margin * max(extent, 1e-6) / self.options.cells
        self._stride = max(1, len(means) // 64)
        self.world_count = world_count
        self.device = wp.get_device(device)
        self._center = wp.zeros(world_count, dtype=wp.vec3, device=self.device)
        shape = (world_count, self.options.cells, self.options.cells)
        self._map = wp.zeros(shape, dtype=wp.float32, device=self.device)

    def cast(
        self,
        splats: SplatArrays,
        views: ViewArrays,
        sensor_pose: wp.array,
        mesh_depth: wp.array,
        mesh_rgb: wp.array,
    ) -> None:
        """Darken `mesh_rgb` where the splats stand in the light.

        Args:
            splats: The splats where they are now.
            views: The cameras.
            sensor_pose: Camera to world with OpenGL axes, transform, shape (view_count,).
            mesh_depth: Forward depth of the meshes [m], 0 where there is none, shape (view_count, height, width).
            mesh_rgb: Colours of the meshes, vec3, same shape; changed in place.
        """
        wp.launch(
            kernels.center_map,
            dim=self.world_count,
            inputs=[splats.means, self._stride],
            outputs=[self._center],
            device=self.device,
        )
        self._map.fill_(1.0e30)
        wp.launch(
            kernels.fill_map,
            dim=(self.world_count, splats.means.shape[1]),
            inputs=[splats.means, splats.opacities, self._center, self._frame, self._cell],
            outputs=[self._map],
            device=self.device,
        )
        wp.launch(
            kernels.darken,
            dim=mesh_depth.shape,
            inputs=[
                self._center, self._frame, self._cell, self._map, views.world, views.intrinsics, sensor_pose,
                mesh_depth, self.options.strength, self.options.softness,
            ],
            outputs=[mesh_rgb],
            device=self.device,
        )  # fmt: skip
