"""`SplatCamera`: deforming splats and the meshes of a Newton model in one picture, for all worlds at once.

Meshes (robot, table) come from Newton's `SensorCamera`, splats from `SplatRasterizer`; the two meet by forward depth.
Cameras are pinholes with the OpenCV frame: x right, y down, z forward, pixel (0, 0) at the top left with its centre
at (0.5, 0.5).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from softmode.errors import ConfigError
from softmode.splats import camera_kernels as kernels
from softmode.splats.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.shadow import ShadowOptions, SplatShadow
from softmode.splats.splats import quat_from_rotation

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """One camera of every world; build it with `PinholeCamera.look_at`, or from a calibrated pose and intrinsics."""

    name: str
    """Unique name; key of the images."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Horizontal focal length [px]."""
    fy: float
    """Vertical focal length [px]."""
    cx: float
    """Horizontal position of the optical axis [px]."""
    cy: float
    """Vertical position of the optical axis [px]."""
    position: Vector
    """Optical centre in the frame of `body`, or in the world [m]."""
    quat: tuple[float, float, float, float]
    """Rotation xyzw from the camera frame (OpenCV) to the frame of `body`, or to the world."""
    body: str | None = None
    """Label of the body that carries the camera (all of it or its last part); None for one fixed in the world."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.position, *self.quat)
        if not all(math.isfinite(x) for x in numbers) or self.fx <= 0.0 or self.fy <= 0.0:
            raise ConfigError(f"camera {self.name!r}: intrinsics and pose must be finite, focal lengths positive")
        if not (0 < self.width <= 2000 and 0 < self.height <= 2000):
            raise ConfigError(f"camera {self.name!r}: {self.width} x {self.height} px, expected 1 to 2000 on each side")
        if abs(sum(x * x for x in self.quat) - 1.0) > 1e-3:
            raise ConfigError(f"camera {self.name!r}: quat {self.quat} is not of unit length")

    @classmethod
    def look_at(
        cls,
        name: str,
        *,
        position: Vector,
        target: Vector,
        up: Vector = (0.0, 0.0, 1.0),
        width: int = 128,
        height: int = 128,
        fov_y: float = 0.8,
        body: str | None = None,
    ) -> "PinholeCamera":
        """Return a camera at `position` that looks at `target`.

        Args:
            name: Unique name.
            position: Optical centre in the frame of `body` or the world [m].
            target: Point in the middle of the picture, in the same frame [m].
            up: Direction that points up in the picture; not parallel to the line of sight.
            width: Image width [px].
            height: Image height [px].
            fov_y: Vertical field of view [rad], in (0, pi).
            body: Label of the body that carries the camera, or None.

        Raises:
            ConfigError: If the field of view is out of range or the directions are degenerate.
        """
        if not 0.0 < fov_y < math.pi:
            raise ConfigError(f"camera {name!r}: fov_y must be in (0, pi) rad, got {fov_y}")
        forward = np.subtract(target, position).astype(np.float64)
        right = np.cross(forward, up)
        if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
            raise ConfigError(
                f"camera {name!r}: position, target and up do not define a view", hint="Move target or up"
            )
        forward /= np.linalg.norm(forward)
        right /= np.linalg.norm(right)
        x, y, z, w = map(float, quat_from_rotation(np.stack([right, np.cross(forward, right), forward], axis=1)))
        focal = 0.5 * height / math.tan(0.5 * fov_y)
        return cls(
            name=name,
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width,
            cy=0.5 * height,
            position=(float(position[0]), float(position[1]), float(position[2])),
            quat=(x, y, z, w),
            body=body,
        )


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """How the scene is lit and drawn."""

    sky: tuple[Vector, Vector] = ((0.93, 0.94, 0.95), (0.62, 0.72, 0.83))
    """Background at and below the horizon, and straight up; sRGB 0..1."""
    light_direction: Vector = (-0.25, 0.5, -1.0)
    """Direction in which the sunlight travels."""
    light_color: Vector = (0.72, 0.70, 0.66)
    """Linear radiance of the sunlight."""
    ambient: tuple[Vector, Vector] = ((0.30, 0.31, 0.34), (0.16, 0.15, 0.14))
    """Linear ambient radiance from above and from below."""
    shadows: bool = True
    """Meshes cast shadows on meshes."""
    splat_shadow: ShadowOptions | None = field(default_factory=ShadowOptions)
    """Shadow that the splats cast on the meshes; None for none."""
    mesh_samples: int = 1
    """Rays per pixel for the meshes: 1, or 4 for smooth edges at about twice the cost."""


class SplatCamera:
    """Renders cameras of one image size in all worlds of a Newton model, with deforming splats.

    Views are ordered by camera, then by world: view = camera * world_count + world. `render` only launches work, so
    it can be captured in a graph on CPU and CUDA (after one frame that compiles the kernels). Outputs, overwritten by
    every frame:

    - `rgb`: uint8, shape (view_count, height, width, 3), sRGB; `images(name)` is one camera's part of it.
    - `depth`: forward depth of splats and meshes [m], 0 for the sky, shape (view_count, height, width).
    - `alpha`: coverage by splats, same shape.
    - `object_id`: splat object per pixel, -1 where none (only with `RasterizerOptions.object_ids`).
    - `median_depth`: see `SplatRasterizer` (only with `RasterizerOptions.median_depth`).

    Args:
        model: The model whose visible shapes are drawn.
        splats: The splats of all objects; means and covariances are read anew by every frame. None draws meshes only.
        cameras: Descriptions, all of one width and height, with unique names.
        options: Light and background.
        rasterizer_options: How the splats are drawn.

    Raises:
        ConfigError: If the cameras disagree in size, share a name, or name a body that some world lacks.
    """

    def __init__(
        self,
        model: newton.Model,
        splats: SplatArrays | None,
        cameras: Sequence[PinholeCamera],
        *,
        options: CameraOptions | None = None,
        rasterizer_options: RasterizerOptions | None = None,
    ) -> None:
        """Allocate images and build the mesh sensor."""
        self.model, self.splats, self.cameras = model, splats, tuple(cameras)
        self.options = options if options is not None else CameraOptions()
        self.device: Any = model.device
        self.world_count = max(int(model.world_count), 1)
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        if len(sizes) != 1 or len({camera.name for camera in self.cameras}) != len(self.cameras):
            raise ConfigError(
                f"cameras have sizes {sorted(sizes)} and names {[camera.name for camera in self.cameras]}",
                hint="Give at least one camera, unique names and one size; use one SplatCamera per image size",
            )
        if self.options.mesh_samples not in (1, 4):
            raise ConfigError(f"mesh_samples must be 1 or 4, got {self.options.mesh_samples}")
        (self.width, self.height) = sizes.pop()
        worlds = self.world_count
        self.view_count = views = len(self.cameras) * worlds

        poses = np.repeat([(*camera.position, *camera.quat) for camera in self.cameras], worlds, axis=0)
        lenses = np.repeat([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in self.cameras], worlds, axis=0)
        bodies = np.concatenate([_carriers(model, camera) for camera in self.cameras])
        self.poses = wp.array(poses.astype(np.float32), dtype=wp.transform, device=self.device)
        """Pose of every view's camera in its body or the world, transform, shape (view_count,); may be overwritten."""
        self._body = wp.array(bodies, dtype=wp.int32, device=self.device)
        self.views = ViewArrays(
            world_to_camera=wp.zeros(views, dtype=wp.mat44, device=self.device),
            intrinsics=wp.array(lenses.astype(np.float32), dtype=wp.vec4, device=self.device),
            world=wp.array(np.tile(np.arange(worlds), len(self.cameras)), dtype=wp.int32, device=self.device),
            background=wp.array([self.options.sky[0]], dtype=wp.vec3, device=self.device),
        )
        self._sensor_pose = wp.zeros(views, dtype=wp.transform, device=self.device)
        self._init_meshes()
        shape = (views, self.height, self.width)
        self._mesh_rgb = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        self.rgb = wp.zeros((*shape, 3), dtype=wp.uint8, device=self.device)
        self.rasterizer: SplatRasterizer | None = None
        self._shadow: SplatShadow | None = None
        if splats is not None:
            self.rasterizer = SplatRasterizer(
                splats.means.shape[1], views, self.width, self.height, options=rasterizer_options, device=self.device
            )
            if self.options.splat_shadow is not None:
                self._shadow = SplatShadow(
                    splats, worlds, self.options.light_direction, options=self.options.splat_shadow, device=self.device
                )

    def _init_meshes(self) -> None:
        """Build Newton's sensor; the rays follow each camera's intrinsics, with OpenGL axes."""
        options, samples = self.options, self.options.mesh_samples
        shape = (self.view_count, self.height, self.width)
        self._mesh_packed = wp.zeros(shape, dtype=wp.uint32, device=self.device)
        self._mesh_depth = wp.zeros(shape, dtype=wp.float32, device=self.device)
        self._sensor: SensorCamera | None = None
        if self.model.shape_count == 0 or self.model.bvh_shapes is None:
            return
        sensor = SensorCamera(self.model, load_textures=False)
        x, y, z = np.asarray(options.light_direction) / np.linalg.norm(options.light_direction)
        sensor.create_default_light(
            enable_shadows=options.shadows, direction=wp.vec3f(x, y, z), color=options.light_color
        )
        sensor.set_ambient_light(*options.ambient)
        self._sensor = sensor
        self._render_config = SensorCamera.RenderConfig(
            enable_particles=False,
            enable_shadows=options.shadows,
            anti_aliasing=SensorCamera.AntiAliasing.NONE if samples == 1 else SensorCamera.AntiAliasing.MSAA,
        )
        # The first sample of a bundle sits in the middle: the sensor shades there.
        spread = [(0.5, 0.5)] if samples == 1 else [(0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72)]
        offset = np.asarray(spread)
        self._rays = []
        for camera in self.cameras:
            columns = (np.arange(self.width)[None, :, None] + offset[:, 0] - camera.cx) / camera.fx
            rows = (np.arange(self.height)[:, None, None] + offset[:, 1] - camera.cy) / camera.fy
            rays = np.zeros((self.height, self.width, samples, 2, 3))
            rays[..., 1, 0], rays[..., 1, 1], rays[..., 1, 2] = columns, -rows, -1.0
            rays[..., 1, :] /= np.linalg.norm(rays[..., 1, :], axis=-1, keepdims=True)
            self._rays.append(wp.array(rays.astype(np.float32), dtype=wp.vec3, device=self.device))

    @property
    def depth(self) -> wp.array:
        """Forward depth of what is seen [m], 0 for the sky, shape (view_count, height, width)."""
        return self._mesh_depth if self.rasterizer is None else self.rasterizer.depth

    @property
    def alpha(self) -> wp.array | None:
        """Coverage by splats, shape (view_count, height, width); None without splats."""
        return None if self.rasterizer is None else self.rasterizer.alpha

    @property
    def object_id(self) -> wp.array | None:
        """Splat object per pixel, shape (view_count, height, width); None without splats."""
        return None if self.rasterizer is None else self.rasterizer.object_id

    @property
    def median_depth(self) -> wp.array | None:
        """Median forward depth [m], shape (view_count, height, width); None without splats."""
        return None if self.rasterizer is None else self.rasterizer.median_depth

    def images(self, name: str) -> wp.array:
        """Return the camera's part of `rgb`: uint8, shape (world_count, height, width, 3), no copy.

        Raises:
            ConfigError: If no camera has that name.
        """
        names = [camera.name for camera in self.cameras]
        if name not in names:
            raise ConfigError(f"no camera {name!r}, there are {names}")
        first = names.index(name) * self.world_count
        part: Any = self.rgb[first : first + self.world_count]
        return part

    def render(self, state: newton.State) -> None:
        """Draw one frame of every camera in every world; capturable.

        The splats are drawn where `splats.means` and `splats.covariances` have them; skin them first.

        Args:
            state: Where the bodies are.
        """
        options = self.options
        size = (self.view_count, self.height, self.width)
        wp.launch(
            kernels.place_cameras,
            dim=self.view_count,
            inputs=[self.poses, self._body, state.body_q],
            outputs=[self.views.world_to_camera, self._sensor_pose],
            device=self.device,
        )
        if self._sensor is not None:
            self._render_meshes(state, self._sensor)
        wp.launch(
            kernels.unpack_meshes,
            dim=size,
            inputs=[
                self._mesh_packed, self._mesh_depth, self._sensor_pose, self.views.intrinsics,
                wp.vec3(*options.sky[0]), wp.vec3(*options.sky[1]), self._sensor is not None,
            ],
            outputs=[self._mesh_rgb],
            device=self.device,
        )  # fmt: skip
        rgb = self._mesh_rgb
        if self.rasterizer is not None and self.splats is not None:
            if self._shadow is not None:
                self._shadow.cast(self.splats, self.views, self._sensor_pose, self._mesh_depth, self._mesh_rgb)
            self.rasterizer.render(self.splats, self.views, mesh_rgb=self._mesh_rgb, mesh_depth=self._mesh_depth)
            rgb = self.rasterizer.rgb
        wp.launch(kernels.pack_bytes, dim=size, inputs=[rgb], outputs=[self.rgb], device=self.device)

    def _render_meshes(self, state: newton.State, sensor: SensorCamera) -> None:
        """Draw the visible shapes of all views."""
        self.model.bvh_refit_shapes(state)
        for index, rays in enumerate(self._rays):
            part = slice(index * self.world_count, (index + 1) * self.world_count)
            pose: Any = self._sensor_pose[part]
            color: Any = self._mesh_packed[part]
            depth: Any = self._mesh_depth[part]
            sensor.update(
                state,
                pose,
                rays,
                color_image=color,
                forward_depth_image=depth,
                render_config=self._render_config,
            )


def _carriers(model: newton.Model, camera: PinholeCamera) -> np.ndarray:
    """Return the body that carries the camera in every world, -1 for none, shape (world_count,)."""
    worlds = max(int(model.world_count), 1)
    if camera.body is None:
        return np.full(worlds, -1, dtype=np.int32)
    named = [
        index
        for index, label in enumerate(model.body_label)
        if camera.body in (label, label.rsplit("/", maxsplit=1)[-1])
    ]
    body_world: Any = model.body_world
    world = body_world.numpy()[named] if named else np.zeros(0, dtype=np.int32)
    if len(named) == worlds == 1 or np.array_equal(world, np.arange(worlds)):
        return np.asarray(named, dtype=np.int32)
    raise ConfigError(
        f"camera {camera.name!r}: {len(named)} bodies are called {camera.body!r}, expected one in each of {worlds}",
        hint=f"Known bodies: {', '.join(sorted({label for label in model.body_label})[:12])}",
    )
