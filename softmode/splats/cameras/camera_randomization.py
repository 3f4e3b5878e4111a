"""Randomised views: every world sees the scene through its own lens, from its own place, in its own light.

All draws happen on the device, so that a masked reset stays inside a captured graph. They depend on the seed of the
world, on how often that world was drawn and on the index of the camera, and on nothing else: world i of many equals
a single world with its seed. Host code that draws with NumPy passes its draws on as seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.checks import require_number
from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.cameras import camera_randomization_kernels as kernels


@dataclass(frozen=True, kw_only=True)
class CameraRandomization:
    """Half widths of uniform distributions around the description; 0 keeps a value as described.

    Pose and lens are drawn per world and camera. Sky, light and splats belong to the world: all of its cameras, those
    of other `SplatCamera` objects with the same seeds included, see the same.
    """

    rotation: float = 0.0
    """Rotation vector of the camera, each component about an axis of the camera [rad]."""
    translation: float = 0.0
    """Shift along each axis of the camera [m]."""
    focal: float = 0.0
    """Focal lengths, both by the same factor, relative, < 1."""
    principal_point: float = 0.0
    """Shift of the optical axis in each direction of the image [px]."""
    sky: float = 0.0
    """Each channel of the sky at the horizon and overhead, sRGB 0..1."""
    light: float = 0.0
    """Brightness of the meshes in linear light (sun and ambient alike), relative, < 1."""
    light_tint: float = 0.0
    """Each channel of that light, relative, < 1."""
    splat_opacity: float = 0.0
    """Opacity of all splats of the world, relative, < 1; never above 1."""
    splat_brightness: float = 0.0
    """Colours of all splats of the world, gamma-encoded, relative, < 1."""
    splat_tint: float = 0.0
    """Each channel of those colours, relative, < 1."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        relative = ("focal", "light", "light_tint", "splat_opacity", "splat_brightness", "splat_tint")
        for item in fields(self):
            limit = 1.0 if item.name in relative else None
            hint = "Give half the width of the range around the described value"
            require_number(item.name, getattr(self, item.name), at_least=0.0, below=limit, hint=hint)


class ViewVariation:
    """What the views of a `SplatCamera` differ in beside their description; draws anew for chosen worlds.

    Args:
        lenses: fx, fy, cx, cy [px] of each camera, shape (camera_count, 4).
        sky: Colour at the horizon and overhead.
        world_count: Number of worlds.
        randomization: Ranges of the draws.
        device: Warp device.
    """

    def __init__(
        self,
        lenses: ArrayLike,
        sky: tuple[Sequence[float], Sequence[float]],
        world_count: int,
        randomization: CameraRandomization,
        *,
        device: str | wp.Device | None = None,
    ) -> None:
        """Allocate the arrays with the described values."""
        self.randomization, self.world_count, self.device = randomization, world_count, wp.get_device(device)
        described = np.asarray(lenses, dtype=np.float32)
        self._views = views = len(described) * world_count
        self._lenses = wp.array(described, dtype=wp.vec4, device=device)
        self._sky = (wp.vec3(*sky[0]), wp.vec3(*sky[1]))

        def full(count: int, value: Sequence[float], dtype: type) -> wp.array:
            return wp.array(np.tile(np.asarray(value, np.float32), (count, 1)), dtype=dtype, device=device)

        self.offset = full(views, (0, 0, 0, 0, 0, 0, 1), wp.transform)
        """Drawn pose of each camera in its described frame, transform, shape (view_count,)."""
        self.intrinsics = wp.array(np.repeat(described, world_count, axis=0), dtype=wp.vec4, device=device)
        """fx, fy, cx, cy [px], vec4, shape (view_count,)."""
        self.horizon = full(world_count, sky[0], wp.vec3)
        """Sky at and below the horizon, sRGB, vec3, shape (world_count,)."""
        self.zenith = full(world_count, sky[1], wp.vec3)
        """Sky overhead, sRGB, vec3, shape (world_count,)."""
        self.light_gain = full(world_count, (1, 1, 1), wp.vec3)
        """Factor on the sRGB colours of meshes (a gain g of linear light is g^(1/2.2)), vec3, shape (world_count,)."""
        self.splat_gain = full(views, (1, 1, 1, 1), wp.vec4)
        """Factor on the colour (xyz) and opacity (w) of splats, vec4, shape (view_count,)."""
        self._seed = wp.zeros(world_count, dtype=wp.int32, device=device)
        self._episode = wp.zeros(world_count, dtype=wp.int32, device=device)
        self._all = wp.ones(world_count, dtype=wp.bool, device=device)
        self.seed(0)

    def seed(self, seeds: int | ArrayLike, world_mask: ArrayLike | None = None) -> None:
        """Set the seeds and count draws from zero again; copies to the device, so not for a captured graph.

        Args:
            seeds: One integer s, for s + i in world i; or one per world, shape (world_count,).
            world_mask: Which worlds, shape (world_count,); all if None.

        Raises:
            ConfigError: If there are not as many seeds as worlds.
        """
        values = np.asarray(seeds)
        if values.dtype.kind not in "iu" or values.shape not in ((), (self.world_count,)):
            raise ConfigError(
                f"seeds are {values.dtype} of shape {values.shape}, expected integers, one or {self.world_count}",
                hint="Pass an int, or rng.integers(2**31, size=world_count)",
            )
        values = values + np.arange(self.world_count) if values.ndim == 0 else values
        values = (values.astype(np.int64) & 0x7FFFFFFF).astype(np.int32)
        mask = np.ones(self.world_count, bool) if world_mask is None else np.asarray(world_mask, bool)
        self._seed.assign(np.where(mask, values, self._seed.numpy()))
        self._episode.assign(np.where(mask, 0, self._episode.numpy()).astype(np.int32))

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what draws have written and what the next depends on; views or worlds first."""
        drawn = ("offset", "intrinsics", "horizon", "zenith", "light_gain", "splat_gain")
        arrays = {name: getattr(self, name) for name in drawn}
        return {**arrays, "seed": self._seed, "episode": self._episode}

    def draw(self, world_mask: wp.array | None = None) -> None:
        """Draw new values for the masked worlds; capturable.

        Args:
            world_mask: Which worlds, bool, shape (world_count,); all if None.

        Raises:
            ConfigError: If the mask is no such array.
        """
        if world_mask is not None and not (
            isinstance(world_mask, wp.array) and world_mask.dtype == wp.bool and world_mask.shape == (self.world_count,)
        ):
            raise ConfigError(
                f"world_mask must be a wp.array of wp.bool of shape ({self.world_count},)",
                hint="Pass wp.array(mask, dtype=wp.bool, device=model.device)",
            )
        mask = self._all if world_mask is None else world_mask
        drawn = (self.offset, self.intrinsics, self.horizon, self.zenith, self.light_gain, self.splat_gain)
        given = (mask, self._seed, self._episode, self._lenses, *self._sky, *vars(self.randomization).values())
        launch(self.device, kernels.draw_views, self._views, *given, *drawn)  # half widths in the order of the fields
        launch(self.device, kernels.count_draw, self.world_count, mask, self._episode)
