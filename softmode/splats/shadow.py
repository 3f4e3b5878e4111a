"""The shadow that splats cast on meshes: a small orthographic depth map along the light, one per world."""

import numpy as np
import warp as wp

from softmode.deformables.model.declare import launch
from softmode.splats import shadow_kernels as kernels
from softmode.splats.camera_meshes import MeshImages
from softmode.splats.camera_options import CameraOptions, ShadowOptions
from softmode.splats.rasterizer import SplatArrays, ViewArrays, spanning_columns


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
        self, world_count: int, light: CameraOptions, options: ShadowOptions, *, device: str | wp.Device | None = None
    ) -> None:
        """Allocate the map."""
        self._light = [wp.vec3(*radiance) for radiance in (*light.ambient, light.light_color)]
        self.options = options
        ahead = np.asarray(light.light_direction, dtype=np.float64) / np.linalg.norm(light.light_direction)
        first = np.cross(ahead, [1.0, 0.0, 0.0] if abs(ahead[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        self._frame = wp.mat33(*np.stack([first, np.cross(ahead, first), ahead]).ravel())
        self.world_count = world_count
        self.device = wp.get_device(device)
        self._bounds = wp.zeros(world_count, dtype=wp.vec4, device=self.device)
        shape = (world_count, self.options.cells, self.options.cells)
        self._map = wp.zeros(shape, dtype=wp.float32, device=self.device)
        self._spanning: dict[int, wp.array] = {}  # by the number of splats; kept, as graphs may hold them

    def cast(
        self, splats: SplatArrays, views: ViewArrays, sensor_pose: wp.array, meshes: MeshImages, mesh_rgb: wp.array
    ) -> None:
        """Take the sunlight from `mesh_rgb` where the splats stand in it; what has none already stays as it is.

        Args:
            splats: The splats where they are now.
            views: The cameras.
            sensor_pose: Camera to world with OpenGL axes, transform, shape (view_count,).
            meshes: The meshes as the sensor saw them, with their surfaces.
            mesh_rgb: Colours of the meshes, vec3, shape (view_count, height, width); changed in place.
        """
        count, cast = splats.means.shape[1], (splats.means, splats.opacities)
        options, device, place = self.options, self.device, (self._bounds, self._frame, self.options.margin)
        self._map.fill_(1.0e30)
        spanning = splats.spanning
        if spanning is None:
            if count not in self._spanning:
                self._spanning[count] = wp.array(spanning_columns(count)[None], dtype=wp.int32, device=device)
            spanning = self._spanning[count]
        launch(device, kernels.bound_map, self.world_count, *cast, self._frame, spanning, self._bounds)
        launch(device, kernels.fill_map, (self.world_count, count), *cast, *place, self._map)
        seen = (views.world, views.intrinsics, sensor_pose)
        shown = (meshes.depth, meshes.packed, meshes.albedo, meshes.normal)
        strength = (options.strength, options.softness)
        launch(
            device,
            kernels.darken,
            meshes.depth.shape,
            *place,
            self._map,
            *seen,
            *shown,
            *self._light,
            *strength,
            mesh_rgb,
        )
