"""The shadow that splats cast on meshes: a small orthographic depth map along the light, one per world."""

from typing import Any

import warp as wp

from softmode.deformables.model.declare import launch
from softmode.splats.cameras import shadow_kernels as kernels
from softmode.splats.cameras.camera_options import CameraOptions, ShadowOptions
from softmode.splats.cameras.light import light_frame
from softmode.splats.raster.rasterizer import SplatArrays, spanning_columns


class SplatShadow:
    """The map of the shadow that all splats of a world cast along one light direction; capturable.

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
        self.options = options
        self._frame = wp.mat33(*light_frame(light.light_direction).ravel())
        self.world_count = world_count
        self.device = wp.get_device(device)
        self._bounds = wp.zeros(world_count, dtype=wp.vec4, device=self.device)
        shape = (world_count, self.options.cells, self.options.cells)
        self._map = wp.zeros(shape, dtype=wp.float32, device=self.device)
        self._read = kernels.SplatMap()
        self._read.bounds, self._read.depth = self._bounds, self._map
        self._read.margin, self._read.strength, self._read.softness = options.margin, options.strength, options.softness
        self._spanning: dict[int, wp.array] = {}  # by the number of splats; kept, as graphs may hold them

    @property
    def map(self) -> Any:
        """What the receivers of the shadow read."""
        return self._read

    def draw(self, splats: SplatArrays) -> None:
        """Draw the map.

        Args:
            splats: The splats where they are now.
        """
        count, cast = splats.means.shape[1], (splats.means, splats.opacities)
        options, device = self.options, self.device
        self._map.fill_(1.0e30)
        spanning = splats.spanning
        if spanning is None:
            if count not in self._spanning:
                self._spanning[count] = wp.array(spanning_columns(count)[None], dtype=wp.int32, device=device)
            spanning = self._spanning[count]
        launch(device, kernels.bound_map, self.world_count, *cast, self._frame, spanning, self._bounds)
        place = (self._bounds, self._frame, options.margin)
        launch(device, kernels.fill_map, (self.world_count, count), *cast, *place, self._map)


def no_shadow(device: wp.Device) -> Any:
    """Return the map of no shadow."""
    nothing = kernels.SplatMap()
    nothing.bounds = wp.zeros(1, dtype=wp.vec4, device=device)
    nothing.depth = wp.zeros((0, 0, 0), dtype=wp.float32, device=device)
    return nothing
