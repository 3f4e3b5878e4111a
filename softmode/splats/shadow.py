"""The shadow that splats cast on meshes: a small orthographic depth map along the light, one per world."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from softmode.checks import require_fields, require_number
from softmode.splats import shadow_kernels as kernels
from softmode.splats.camera_meshes import MeshImages, MeshLight
from softmode.splats.rasterizer import SplatArrays, ViewArrays


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """How dark and how fine the shadow is."""

    strength: float = 1.0
    """How dark full shadow is: 1 as dark as the shadow of a mesh, 0 not at all."""
    cells: int = 40
    """Cells of the depth map along each side; more where small objects lie far apart."""
    margin: float = 1.6
    """Width of the map in units of the extent of the splats across the light, at least 1."""
    softness: float = 1.3
    """Half width of the blurred rim [cells]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_number("strength", self.strength, at_least=0.0, at_most=1.0)
        require_fields(self, ("cells", "margin"), at_least=1)
        require_number("softness", self.softness, at_least=0.0, at_most=8.0)


class SplatShadow:
    """Casts the shadow of all splats of a world along one light direction; capturable.

    The map follows the splats and spans them all. Only meshes receive the shadow: splats carry the light they were
    captured in.

    Args:
        world_count: Number of worlds.
        light: The light on the meshes.
        options: Darkness and resolution.
        device: Warp device.
    """

    def __init__(
        self,
        world_count: int,
        light: MeshLight,
        *,
        options: ShadowOptions | None = None,
        device: str | wp.Device | None = None,
    ) -> None:
        """Allocate the map."""
        self._light = [wp.vec3(*radiance) for radiance in (*light.ambient, light.color)]
        self.options = options if options is not None else ShadowOptions()
        ahead = np.asarray(light.direction, dtype=np.float64) / np.linalg.norm(light.direction)
        first = np.cross(ahead, [1.0, 0.0, 0.0] if abs(ahead[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        self._frame = wp.mat33(*np.stack([first, np.cross(ahead, first), ahead]).ravel())
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
        meshes: MeshImages,
        mesh_rgb: wp.array,
    ) -> None:
        """Take the sunlight from `mesh_rgb` where the splats stand in it; what has none already stays as it is.

        Args:
            splats: The splats where they are now.
            views: The cameras.
            sensor_pose: Camera to world with OpenGL axes, transform, shape (view_count,).
            meshes: The meshes as the sensor saw them, with their surfaces.
            mesh_rgb: Colours of the meshes, vec3, shape (view_count, height, width); changed in place.
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
            dim=meshes.depth.shape,
            inputs=[
                self._bounds, self._frame, self.options.margin, self._map, views.world, views.intrinsics, sensor_pose,
                meshes.depth, meshes.packed, meshes.albedo, meshes.normal, *self._light,
                self.options.strength, self.options.softness,
            ],
            outputs=[mesh_rgb],
            device=self.device,
        )  # fmt: skip
