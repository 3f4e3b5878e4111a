"""The shadow that splats cast on meshes: a small orthographic depth map along the light, one per world."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softmode.errors import ConfigError
from softmode.splats import shadow_kernels as kernels
from softmode.splats.rasterizer import SplatArrays, ViewArrays


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """How dark and how fine the shadow is."""

    strength: float = 0.4
    """Share of the mesh's colour that full shadow takes away, 0..1."""
    cells: int = 40
    """Cells of the depth map along each side; more where small objects lie far apart."""
    margin: float = 1.6
    """Width of the map in units of the extent of the splats across the light, at least 1."""
    softness: float = 1.3
    """Half width of the blurred rim [cells]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (0.0 <= self.strength <= 1.0 and self.cells >= 1 and self.margin >= 1.0 and self.softness >= 0.0):
            raise ConfigError(
                f"{self} is out of range", hint="Give strength in 0..1, cells >= 1, margin >= 1 and softness >= 0"
            )


class SplatShadow:
    """Casts the shadow of all splats of a world along one light direction; capturable.

    The map follows the splats and spans them all. Only meshes receive the shadow: splats carry the light they were
    captured in.

    Args:
        world_count: Number of worlds.
        light_direction: Direction in which the light travels.
        options: Darkness and resolution.
        device: Warp device.
    """

    def __init__(
        self,
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
        self.world_count = world_count
        self.device = wp.get_device(device)
        self._bounds = wp.zeros(world_count, dtype=wp.vec4, device=self.device)
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
        count = splats.means.shape[1]
        self._map.fill_(1.0e30)
        wp.launch(
            kernels.bound_map,
            dim=self.world_count,
            inputs=[splats.means, splats.opacities, self._frame, max(1, count // 128)],
            outputs=[self._bounds],
            device=self.device,
        )
        wp.launch(
            kernels.fill_map,
            dim=(self.world_count, count),
            inputs=[splats.means, splats.opacities, self._bounds, self._frame, self.options.margin],
            outputs=[self._map],
            device=self.device,
        )
        wp.launch(
            kernels.darken,
            dim=mesh_depth.shape,
            inputs=[
                self._bounds, self._frame, self.options.margin, self._map, views.world, views.intrinsics, sensor_pose,
                mesh_depth, self.options.strength, self.options.softness,
            ],
            outputs=[mesh_rgb],
            device=self.device,
        )  # fmt: skip
