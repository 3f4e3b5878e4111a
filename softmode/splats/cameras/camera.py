"""`SplatCamera`: deforming splats and the meshes of a Newton model in one picture, for all worlds at once.

Meshes (robot, table) come from `MeshImages`, splats from `SplatRasterizer`; the two meet by forward depth.
Cameras are pinholes with the OpenCV frame, see `softmode.splats.raster.pinhole`.
"""

import fnmatch
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, Protocol, get_args

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.cameras import camera_kernels as kernels
from softmode.splats.cameras.camera_labels import segmentation_table
from softmode.splats.cameras.camera_meshes import MeshImages
from softmode.splats.cameras.camera_options import CameraOptions
from softmode.splats.cameras.camera_randomization import CameraRandomization, ViewVariation
from softmode.splats.cameras.rigid_splats import world_bodies
from softmode.splats.cameras.shadow import SplatShadow
from softmode.splats.raster.pinhole import PinholeCamera, Vector
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays

__all__ = ["CameraOptions", "CameraRandomization", "Output", "PinholeCamera", "SplatCamera"]

Output = Literal["rgb", "depth", "median_depth", "alpha", "object_id", "segmentation"]
"""What a camera writes."""


class Overlay(Protocol):
    """Something that is neither mesh nor splat and is put into a picture by its depth, such as a radiance field."""

    hides: tuple[int, ...]
    """Splat objects that it stands for: they cast their shadows, and are not drawn."""

    def draw(
        self,
        views: ViewArrays,
        *,
        mesh_rgb: wp.array,
        mesh_depth: wp.array,
        rgb: wp.array,
        depth: wp.array,
        alpha: wp.array | None,
    ) -> None:
        """Draw into pictures; capturable after a first time.

        Args:
            views: The cameras.
            mesh_rgb: Meshes and sky, vec3, shape (view_count, height, width).
            mesh_depth: Their forward depth [m], 0 for the sky, same shape.
            rgb: Meshes with splats before them, written, same shape; may be `mesh_rgb`.
            depth: Forward depth of what is seen [m], written, same shape; may be `mesh_depth`.
            alpha: Coverage by splats, written, same shape; None without splats.
        """
        ...


class SplatCamera:
    """Renders cameras of one image size in all worlds of a Newton model, with deforming splats.

    Views are ordered by camera, then by world: view = camera * world_count + world. `render` only launches work, so
    it can be captured in a graph on CPU and CUDA (after one frame that compiles the kernels), as can `randomize` and
    `look_at`. Outputs, overwritten by every frame; `images(name, output)` is one camera's part of each:

    - `rgb`: uint8, shape (view_count, height, width, 3), sRGB.
    - `depth`: expected forward depth of splats and meshes [m], 0 for the sky, shape (view_count, height, width).
    - `median_depth`: see `SplatRasterizer` (only with `RasterizerOptions.median_depth`).
    - `alpha`: coverage by splats, same shape.
    - `object_id`: splat object per pixel, -1 where none (only with `RasterizerOptions.object_ids`).
    - `segmentation`: int32, same shape: -1 sky, else an index of `labels` (only with `CameraOptions.segmentation`).

    Args:
        model: The model whose visible shapes are drawn.
        splats: The splats of all objects; means and covariances are read anew by every frame. None draws meshes only.
        cameras: Descriptions, all of one width and height, with unique names.
        options: Light and background.
        rasterizer_options: How the splats are drawn.
        randomization: What `randomize` draws; nothing is drawn before its first call.
        overlay: What else is drawn: `rgb`, `depth` and `alpha` have it, `median_depth` and the ids do not.

    Raises:
        ConfigError: If the cameras disagree in size, share a name, or name a body that some world lacks, or the splats
            are of another number of worlds.
    """

    def __init__(
        self,
        model: newton.Model,
        splats: SplatArrays | None,
        cameras: Sequence[PinholeCamera],
        *,
        options: CameraOptions | None = None,
        rasterizer_options: RasterizerOptions | None = None,
        randomization: CameraRandomization | None = None,
        overlay: Overlay | None = None,
    ) -> None:
        """Upload the meshes and allocate the images."""
        self.model, self.splats, self.cameras, self.overlay = model, splats, tuple(cameras), overlay
        self._drawn = splats if splats is None or overlay is None else splats.without(overlay.hides)
        self.options = options if options is not None else CameraOptions()
        self.device = model.device
        self.world_count = worlds = max(int(model.world_count), 1)
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        if len(sizes) != 1 or len({camera.name for camera in self.cameras}) != len(self.cameras):
            raise ConfigError(
                f"cameras have sizes {sorted(sizes)} and names {[camera.name for camera in self.cameras]}",
                hint="Give at least one camera, unique names and one size; use one SplatCamera per image size",
            )
        if splats is not None and splats.means.shape[0] not in (1, worlds):
            raise ConfigError(
                f"splats are of {splats.means.shape[0]} worlds, the model has {worlds}",
                hint="Build them by SplatArrays.from_splats(objects, world_count=model.world_count)",
            )
        (self.width, self.height) = sizes.pop()
        self.view_count = views = len(self.cameras) * worlds

        self.variation = ViewVariation(
            [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in self.cameras],
            self.options.sky,
            worlds,
            randomization if randomization is not None else CameraRandomization(),
            device=self.device,
        )
        """What `randomize` draws, as arrays that may be overwritten."""
        poses = np.repeat([(*camera.position, *camera.quat) for camera in self.cameras], worlds, axis=0)
        bodies = np.concatenate([_carriers(model, camera) for camera in self.cameras])
        self._poses = wp.array(poses.astype(np.float32), dtype=wp.transform, device=self.device)
        self._body = wp.array(bodies, dtype=wp.int32, device=self.device)
        self.views = ViewArrays(
            world_to_camera=wp.zeros(views, dtype=wp.mat44, device=self.device),
            intrinsics=self.variation.intrinsics,
            world=wp.array(np.tile(np.arange(worlds), len(self.cameras)), dtype=wp.int32, device=self.device),
            background=wp.array([self.options.sky[0]], dtype=wp.vec3, device=self.device),
            splat_gain=self.variation.splat_gain,
        )
        count = 0 if splats is None else int(splats.object_index.numpy().max()) + 1
        table, self.labels = segmentation_table(model, tuple(f"splats/{i}" for i in range(count)))
        """Label of each id of `segmentation`: splat objects, "splats/0" and on, then shapes, "body/shape"."""
        segment = table if self.options.segmentation else None
        self._meshes = MeshImages(model, self.views, self.width, self.height, self.options, segment=segment)
        shape = (views, self.height, self.width)
        self.rgb = wp.zeros((*shape, 3), dtype=wp.uint8, device=self.device)
        self._segmentation: wp.array | None = None
        if self.options.segmentation:
            self._segmentation = wp.full(shape, value=-1, dtype=wp.int32, device=self.device)
        self.rasterizer: SplatRasterizer | None = None
        self._shadow: SplatShadow | None = None
        if splats is not None:
            drawn = rasterizer_options if rasterizer_options is not None else RasterizerOptions()
            if self.options.segmentation:
                drawn = replace(drawn, object_ids=True)
            self.rasterizer = SplatRasterizer(
                splats.means.shape[1], views, self.width, self.height, options=drawn, device=self.device
            )
            if self.options.splat_shadow is not None:
                self._shadow = SplatShadow(worlds, self.options, self.options.splat_shadow, device=self.device)

    @property
    def depth(self) -> wp.array:
        """Forward depth of what is seen [m], 0 for the sky, shape (view_count, height, width)."""
        return self._meshes.depth if self.rasterizer is None else self.rasterizer.depth

    @property
    def alpha(self) -> wp.array | None:
        """Coverage by splats, shape (view_count, height, width); None without splats."""
        return None if self.rasterizer is None else self.rasterizer.alpha

    @property
    def object_id(self) -> wp.array | None:
        """Splat object per pixel, shape (view_count, height, width); None if not written."""
        return None if self.rasterizer is None or not self.rasterizer.options.object_ids else self.rasterizer.object_id

    @property
    def median_depth(self) -> wp.array | None:
        """Median forward depth [m], shape (view_count, height, width); None if not written."""
        written = self.rasterizer is not None and self.rasterizer.options.median_depth
        return self.rasterizer.median_depth if written and self.rasterizer is not None else None

    @property
    def segmentation(self) -> wp.array | None:
        """Index into `labels` per pixel, -1 for the sky, shape (view_count, height, width); None if not written."""
        return self._segmentation

    def images(self, name: str, output: Output = "rgb") -> wp.array:
        """Return one camera's part of an output, shape (world_count, height, width) and 3 for `rgb`; no copy.

        Raises:
            ConfigError: If no camera has that name, or that output is not written.
        """
        array = getattr(self, output) if output in get_args(Output) else None
        if array is None:
            raise ConfigError(
                f"the camera does not write {output!r}",
                hint="Turn it on: CameraOptions.segmentation, RasterizerOptions.object_ids or .median_depth; "
                "alpha needs splats",
            )
        return self._part(array, name)

    def poses(self, name: str) -> wp.array:
        """Return the pose of a camera in its body or the world, OpenCV axes, transform, shape (world_count,); no copy.

        Write to it, from a kernel of your own or by `assign`, to move the camera in each world.
        """
        return self._part(self._poses, name)

    def intrinsics(self, name: str) -> wp.array:
        """Return fx, fy, cx, cy [px] of a camera, vec4, shape (world_count,); no copy.

        Write to it for lenses of your own.
        """
        return self._part(self.variation.intrinsics, name)

    def extrinsics(self, name: str) -> wp.array:
        """Return the world-to-camera matrices of the last frame, draws included, mat44, shape (world_count,); no copy.

        A pixel (u, v) of depth z shows the point R^T (K^-1 (u, v, 1) z - t), K from `intrinsics`.
        """
        return self._part(self.views.world_to_camera, name)

    def _part(self, array: wp.array, name: str) -> Any:
        """Return the views of one camera."""
        names = [camera.name for camera in self.cameras]
        if name not in names:
            raise ConfigError(f"no camera {name!r}, there are {names}")
        first = names.index(name) * self.world_count
        return array[first : first + self.world_count]

    def look_at(self, name: str, position: wp.array, target: wp.array, up: Vector = (0.0, 0.0, 1.0)) -> None:
        """Place a camera in every world; capturable. One that would look along `up` keeps its pose.

        Args:
            name: The camera.
            position: Optical centre in the frame of the camera's body, or the world [m], vec3, shape (1 or
                world_count,).
            target: Point in the middle of the picture, in the same frame [m], same shapes.
            up: Direction that points up in the picture.

        Raises:
            ConfigError: If there is no such camera, or position or target are no such arrays.
        """
        for what, array in (("position", position), ("target", target)):
            if (
                not isinstance(array, wp.array)
                or array.dtype != wp.vec3
                or array.shape not in ((1,), (self.world_count,))
            ):
                raise ConfigError(
                    f"{what} must be a wp.array of wp.vec3 of shape (1,) or ({self.world_count},)",
                    hint="For poses known on the host: camera.poses(name).assign(...), or PinholeCamera.look_at",
                )
        launch(self.device, kernels.look_at, self.world_count, position, target, wp.vec3(*up), self.poses(name))

    @property
    def mesh_rgb(self) -> wp.array:
        """Meshes, sky and shadows without the splats, vec3 0..1, shape (view_count, height, width).

        With `mesh_depth`, `views` and `rasterizer` it is what `AdjointRasterizer` needs for gradients of the frame.
        """
        return self._meshes.rgb

    @property
    def mesh_depth(self) -> wp.array:
        """Forward depth of the meshes alone [m], 0 for the sky, shape (view_count, height, width)."""
        return self._meshes.depth

    def segmentation_ids(self, pattern: str) -> tuple[int, ...]:
        """Return the ids of `segmentation` whose label matches a shell pattern such as "*/finger_left/*"."""
        return tuple(i for i, label in enumerate(self.labels) if fnmatch.fnmatchcase(label, pattern))

    def seed(self, seeds: int | ArrayLike) -> None:
        """Set the seeds of `randomize` and count its draws from zero, see `ViewVariation.seed`."""
        self.variation.seed(seeds)

    def randomize(self, world_mask: wp.array | None = None) -> None:
        """Draw new views for the masked worlds, the others keep theirs; capturable.

        Args:
            world_mask: Which worlds, bool, shape (world_count,); all if None.
        """
        self.variation.draw(world_mask)

    def render(self, state: newton.State) -> None:
        """Draw one frame of every camera in every world; capturable.

        The splats are drawn where `splats.means` and `splats.covariances` have them; skin them first.

        Args:
            state: Where the bodies are.
        """
        views, meshes, variation = self.views, self._meshes, self.variation
        given = (self._poses, variation.offset, self._body, state.body_q)
        launch(self.device, kernels.place_cameras, self.view_count, *given, views.world_to_camera)
        if self._shadow is not None and self.splats is not None:
            self._shadow.draw(self.splats)
        meshes.render(state, variation, self._shadow)
        rgb, alpha, object_id = meshes.rgb, None, None
        if self.rasterizer is not None and self._drawn is not None:
            self.rasterizer.render(self._drawn, views, mesh_rgb=meshes.rgb, mesh_depth=meshes.depth)
            rgb, alpha, object_id = self.rasterizer.rgb, self.rasterizer.alpha, self.rasterizer.object_id
        if self.overlay is not None:
            seen = {"mesh_rgb": meshes.rgb, "mesh_depth": meshes.depth}
            self.overlay.draw(views, **seen, rgb=rgb, depth=self.depth, alpha=alpha)
        launch(self.device, kernels.pack_bytes, rgb.shape, rgb, self.rgb)
        if self._segmentation is not None:
            launch(self.device, kernels.segment, rgb.shape, alpha, object_id, meshes.segment, self._segmentation)


def _carriers(model: newton.Model, camera: PinholeCamera) -> np.ndarray:
    """Return the body that carries the camera in every world, -1 for none, shape (world_count,)."""
    if camera.body is None:
        return np.full(max(int(model.world_count), 1), -1, dtype=np.int32)
    return world_bodies(model, camera.body, f"camera {camera.name!r}")
