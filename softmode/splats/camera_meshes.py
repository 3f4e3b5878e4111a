"""Pictures of the meshes of a Newton model for many views, by Newton's `SensorCamera`.

The sensor takes one bundle of rays per call and one pose per view. Where all worlds share a camera's lens, its rays
are computed once and every world is a view. Where each world has its own lens, every *pixel* is a view of one by one
pixel: its pose turns the one ray to where the pixel looks, and `world_indices` says which world it sees. Both are one
launch per camera for all worlds; the second keeps a pose and a world of 32 B per pixel of a camera.
"""

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from numpy.typing import NDArray

from softmode.deformables.model.declare import launch
from softmode.splats import camera_kernels as kernels
from softmode.splats.camera_options import CameraOptions
from softmode.splats.pinhole import PinholeCamera


class MeshImages:
    """Colour, forward depth and shape of the visible meshes in every view; views are ordered by camera, then world.

    Args:
        model: The model; what its shape BVH holds is drawn.
        cameras: The cameras, all of one size.
        options: Light and sampling, and whether to write which shape is seen.
        lens_per_world: Worlds have intrinsics of their own.
        surface: Write albedo and normal of what is seen.
    """

    def __init__(
        self,
        model: newton.Model,
        cameras: Sequence[PinholeCamera],
        options: CameraOptions,
        *,
        lens_per_world: bool,
        surface: bool,
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
            shape if options.segmentation else (1, 1, 1), value=0xFFFFFFFF, dtype=wp.uint32, device=device
        )
        """Shape per pixel, 0xFFFFFFFF where none is."""
        part = shape if surface else (1, 1, 1)
        self.albedo = wp.zeros(part, dtype=wp.uint32, device=device)
        """Colours without light RGBA, 8 bit each, sRGB."""
        self.normal = wp.zeros(part, dtype=wp.vec3, device=device)
        """Surface normals in the world."""
        self._wants_shape, self._wants_surface = options.segmentation, surface
        self._sensor: SensorCamera | None = None
        if model.shape_count == 0 or model.bvh_shapes is None:
            return
        self._sensor = SensorCamera(model, load_textures=False)
        direction = wp.vec3f(*(np.asarray(options.light_direction) / np.linalg.norm(options.light_direction)))
        self._sensor.create_default_light(
            enable_shadows=options.shadows, direction=direction, color=options.light_color
        )
        self._sensor.set_ambient_light(*options.ambient)
        self._config = SensorCamera.RenderConfig(
            enable_particles=False,
            enable_shadows=options.shadows,
            anti_aliasing=SensorCamera.AntiAliasing.NONE
            if options.mesh_samples == 1
            else SensorCamera.AntiAliasing.MSAA,
        )
        # The first sample of a bundle sits in the middle: the sensor shades there.
        spread = [(0.5, 0.5)] if options.mesh_samples == 1 else [(0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72)]
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
            wanted = (True, True, self._wants_shape, self._wants_surface, self._wants_surface)
            images = (self.packed, self.depth, self.shape_index, self.albedo, self.normal)
            images = [_part(image, part) if write else None for image, write in zip(images, wanted, strict=True)]
            if self.lens_per_world:
                lens, device = _part(intrinsics, part), self.model.device
                launch(device, kernels.aim_pixels, self._pixel_pose.shape, pose, lens, self._pixel_pose)
                count = self._pixel_world.shape[0]
                pose, worlds = self._pixel_pose.flatten(), self._pixel_world
                images = [None if image is None else image.reshape((count, 1, 1)) for image in images]
            names = ("color", "forward_depth", "shape_index", "albedo", "normal")
            outputs: dict[str, Any] = {f"{name}_image": image for name, image in zip(names, images, strict=True)}
            self._sensor.update(state, pose, rays, **outputs, world_indices=worlds, render_config=self._config)


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
