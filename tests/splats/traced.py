"""Pictures of meshes by Newton's ray tracer, which the rasterised ones are compared with."""

from __future__ import annotations

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from numpy.typing import NDArray

from softmode.splats.cameras.camera import CameraOptions
from softmode.splats.raster.pinhole import PinholeCamera


@dataclass(frozen=True, eq=False)
class Traced:
    """What a ray through the middle of each pixel meets, shapes (height, width) and 3 for `rgb`."""

    rgb: NDArray[np.int64]
    depth: NDArray[np.float32]
    shape: NDArray[np.int64]


def trace(model: newton.Model, state: newton.State, camera: PinholeCamera, options: CameraOptions) -> Traced:
    """Return the picture of a camera that is fixed in the world, of world 0; the sky is 0, 0 and -1."""
    sensor = SensorCamera(model, load_textures=False)
    ahead = np.asarray(options.light_direction) / np.linalg.norm(options.light_direction)
    sensor.create_default_light(enable_shadows=options.shadows, direction=wp.vec3f(*ahead), color=options.light_color)
    sensor.set_ambient_light(*options.ambient)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.zeros((camera.height, camera.width, 1, 2, 3), np.float32)
    across = [(columns - camera.cx) / camera.fx, -(rows - camera.cy) / camera.fy, -np.ones_like(rows)]
    direction = np.stack(across, axis=-1)
    rays[:, :, 0, 1] = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    half_turn = wp.transform(wp.vec3(), wp.quat(1.0, 0.0, 0.0, 0.0))
    pose = wp.transform(camera.position, camera.quat) * half_turn
    size = (max(int(model.world_count), 1), camera.height, camera.width)
    color, shape = (wp.zeros(size, dtype=wp.uint32, device=model.device) for _ in range(2))
    depth = wp.zeros(size, dtype=wp.float32, device=model.device)
    model.bvh_refit_shapes(state)
    config = SensorCamera.RenderConfig(enable_particles=False, enable_shadows=options.shadows)
    sensor.update(
        state,
        wp.array([pose] * size[0], dtype=wp.transform, device=model.device),
        wp.array(rays, dtype=wp.vec3, device=model.device),
        color_image=color,
        forward_depth_image=depth,
        shape_index_image=shape,
        render_config=config,
    )
    packed = color.numpy()[0].astype(np.int64)
    rgb = np.stack([packed & 255, (packed >> 8) & 255, (packed >> 16) & 255], axis=-1)
    return Traced(rgb, depth.numpy()[0], shape.numpy()[0].astype(np.int32).astype(np.int64))
