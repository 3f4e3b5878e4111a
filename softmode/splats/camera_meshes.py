"""Pictures of the meshes of a Newton model for many views, by Newton's `SensorCamera`.

The sensor takes one bundle of rays per call and one pose per view. Where all worlds share a camera's lens, its rays
are computed once and every world is a view. Where each world has its own lens, every *pixel* is a view of one by one
pixel: its pose turns the one ray to where the pixel looks, and `world_indices` says which world it sees. Both are one
launch per camera for all worlds; the second keeps a pose and a world of 32 B per pixel of a camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from numpy.typing import NDArray

from softmode.splats import camera_kernels as kernels
from softmode.splats.pinhole import PinholeCamera, Vector


@dataclass(frozen=True, kw_only=True)
class MeshLight:
    """Light on the meshes of all worlds, and how finely they are drawn."""

    direction: Vector
    """Direction in which the sunlight travels."""
    color: Vector
    """Linear radiance of the sunlight."""
    ambient: tuple[Vector, Vector]
    """Linear ambient radiance from above and from below."""
    shadows: bool
    """Meshes cast shadows on meshes."""
    samples: int
    """Rays per pixel, 1 or 4."""


class MeshImages:
    """Colour, forward depth and shape of the visible meshes in every view; views are ordered by camera, then world.

    Args:
        model: The model; what its shape BVH holds is drawn.
        cameras: The cameras, all of one size.
        light: Light and sampling.
        lens_per_world: Worlds have intrinsics of their own.
        shape_index: Write which shape is seen.
        surface: Write albedo and normal of what is seen.
    """

    def __init__(
        self,
        model: newton.Model,
        cameras: Sequence[PinholeCamera],
        light: MeshLight,
        *,
        lens_per_world: bool = False,
        shape_index: bool = False,
        surface: bool = False,
    ) -> None:
        """Allocate the images and build Newton's sensor."""
        self.model, self.lens_per_world = model, lens_per_world
        self._worlds, device = max(int(model.world_count), 1), model.device
        shape = (len(cameras) * self._worlds, cameras[0].height, cameras[0].width)
        self.packed = wp.zeros(shape, dtype=wp.uint32, device=device)
        """Colours RGBA, 8 bit each, sRGB."""
        self.depth = wp.zeros(shape, dtype=wp.float32, device=device)
        """Depth [m], 0 where no mesh is: along the axis of the camera, or of each pixel with `lens_per_world`."""
        self.shape_index = wp.full(
            shape if shape_index else (1, 1, 1), value=0xFFFFFFFF, dtype=wp.uint32, device=device
        )
        """Shape per pixel, 0xFFFFFFFF where none is."""
        part = shape if surface else (1, 1, 1)
        self.albedo = wp.zeros(part, dtype=wp.uint32, device=device)
        """Colours without light RGBA, 8 bit each, sRGB."""
        self.normal = wp.zeros(part, dtype=wp.vec3, device=device)
        """Surface normals in the world."""
        self._wants_shape, self._wants_surface = shape_index, surface
        self._sensor: SensorCamera | None = None
        if model.shape_count == 0 or model.bvh_shapes is None:
            return
        self._sensor = SensorCamera(model, load_textures=False)
        x, y, z = np.asarray(light.direction) / np.linalg.norm(light.direction)
        self._sensor.create_default_light(enable_shadows=light.shadows, direction=wp.vec3f(x, y, z), color=light.color)
        self._sensor.set_ambient_light(*light.ambient)
        self._config = SensorCamera.RenderConfig(
            enable_particles=False,
            enable_shadows=light.shadows,
            anti_aliasing=SensorCamera.AntiAliasing.NONE if light.samples == 1 else SensorCamera.AntiAliasing.MSAA,
        )
        # The first sample of a bundle sits in the middle: the sensor shades there.
        spread = [(0.5, 0.5)] if light.samples == 1 else [(0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72)]
        self._rays: list[Any] = [
            wp.array(_rays(camera, np.asarray(spread), lens_per_world), dtype=wp.vec3, device=device)
            for camera in cameras
        ]
        if lens_per_world:
            pixels = shape[1] * shape[2]
            world = np.repeat(np.arange(self._worlds, dtype=np.int32), pixels)
            self._pixel_world = wp.array(world, dtype=wp.int32, device=device)
            self._pixel_pose = wp.zeros((self._worlds, *shape[1:]), dtype=wp.transform, device=device)

    @property
    def active(self) -> bool:
        """Whether the model has meshes to draw."""
        return self._sensor is not None

    def render(self, state: newton.State, sensor_pose: wp.array, intrinsics: wp.array) -> None:
        """Draw the meshes of all views; capturable.

        Args:
            state: Where the bodies are.
            sensor_pose: Camera to world with OpenGL axes, transform, shape (view_count,).
            intrinsics: fx, fy, cx, cy [px], vec4, shape (view_count,); read only with `lens_per_world`.
        """
        if self._sensor is None:
            return
        self.model.bvh_refit_shapes(state)
        for index, rays in enumerate(self._rays):
            part = slice(index * self._worlds, (index + 1) * self._worlds)
            pose, worlds = _part(sensor_pose, part), None
            images = [_part(image, part) for image in (self.packed, self.depth)]
            images.append(_part(self.shape_index, part) if self._wants_shape else None)
            images += [_part(a, part) if self._wants_surface else None for a in (self.albedo, self.normal)]
            if self.lens_per_world:
                wp.launch(
                    kernels.aim_pixels,
                    dim=self._pixel_pose.shape,
                    inputs=[pose, _part(intrinsics, part)],
                    outputs=[self._pixel_pose],
                    device=self.model.device,
                )
                count = self._pixel_world.shape[0]
                pose, worlds = self._pixel_pose.flatten(), self._pixel_world
                images = [None if image is None else image.reshape((count, 1, 1)) for image in images]
            self._sensor.update(
                state,
                pose,
                rays,
                color_image=images[0],
                forward_depth_image=images[1],
                shape_index_image=images[2],
                albedo_image=images[3],
                normal_image=images[4],
                world_indices=worlds,
                render_config=self._config,
            )


def _part(array: wp.array, part: slice) -> Any:
    """Return a slice of the leading axis; shares memory."""
    return array[part]


def _rays(camera: PinholeCamera, offset: NDArray[np.float64], per_pixel: bool) -> NDArray[np.float32]:
    """Return origins and directions with OpenGL axes, shape (rows, columns, samples, 2, 3).

    Per pixel there is one row and column, about the axis: the pixel's pose does the rest. The samples then spread as in
    the middle of the described lens.
    """
    height, width = (1, 1) if per_pixel else (camera.height, camera.width)
    cx, cy = (0.5, 0.5) if per_pixel else (camera.cx, camera.cy)
    rays = np.zeros((height, width, len(offset), 2, 3), dtype=np.float32)
    rays[..., 1, 0] = (np.arange(width)[None, :, None] + offset[:, 0] - cx) / camera.fx
    rays[..., 1, 1] = -(np.arange(height)[:, None, None] + offset[:, 1] - cy) / camera.fy
    rays[..., 1, 2] = -1.0
    rays[..., 1, :] /= np.linalg.norm(rays[..., 1, :], axis=-1, keepdims=True)
    return rays
