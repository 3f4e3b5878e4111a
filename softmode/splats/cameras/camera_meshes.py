"""Pictures of the meshes of a Newton model for all views at once, by rasterising their triangles.

A view is one camera in one world. The triangles of worlds with equal shapes are stored once, each in the frame of its
shape; poses, colours and the flag VISIBLE of the shapes are read anew by every frame. A frame is a fixed sequence:

    place shapes -> triangles into samples -> points across the light -> shadows -> light

A mesh of more triangles than the picture can show is met by rays instead, see `camera_ray_kernels`.
"""

from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.model.declare import launch
from softmode.splats.cameras import camera_mesh_kernels as kernels
from softmode.splats.cameras import camera_ray_kernels as ray_kernels
from softmode.splats.cameras.camera_options import CameraOptions
from softmode.splats.cameras.camera_randomization import ViewVariation
from softmode.splats.cameras.camera_triangles import WorldKinds, world_kinds
from softmode.splats.cameras.light import encoded_light, light_frame
from softmode.splats.cameras.shadow import SplatShadow, no_shadow
from softmode.splats.raster.rasterizer import ViewArrays
from softmode.splats.raster.scan_kernels import NOTHING

SEGMENTS = ((160, 24), (1 << 30, 48))
"""Facets around what is round, by the largest edge of the picture [px]."""
RAYS = 0.25
"""Triangles of a mesh for each pixel from which it is met by rays, whose cost hardly grows with them."""
TILES = (128, 8)
"""Edge of a tile of a thread on CUDA, for small triangles and for large ones [px]."""
MAX_CELLS = 512
"""Most cells across the light along each side."""
SPOTS = {1: ((0.5, 0.5),), 4: ((0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72))}
"""Samples of a pixel by their number; a shape is lit at the first one that shows it."""


class MeshImages:
    """Colour, forward depth and shape of the visible meshes in every view; views are ordered by camera, then world.

    Args:
        model: The model; what is visible now is drawn.
        views: The cameras.
        width: Image width [px].
        height: Image height [px].
        options: Light and sampling.
        segment: Id of each shape of the model, shape (shape_count,); None writes none.
    """

    def __init__(
        self,
        model: newton.Model,
        views: ViewArrays,
        width: int,
        height: int,
        options: CameraOptions,
        *,
        segment: NDArray[np.int32] | None,
    ) -> None:
        """Upload the triangles and allocate the images."""
        self.model, self.device, self._options = model, model.device, options
        self._size, device = (width, height), model.device
        shape = (views.world_to_camera.shape[0], height, width)
        self.rgb = wp.zeros(shape, dtype=wp.vec3, device=device)
        """Meshes, sky and shadows, vec3 0..1, shape (view_count, height, width)."""
        self.depth = wp.zeros(shape, dtype=wp.float32, device=device)
        """Forward depth [m], 0 where no mesh is, shape (view_count, height, width)."""
        named = segment is not None
        self.segment = wp.full(shape if named else (1, 1, 1), value=-1, dtype=wp.int32, device=device)
        """Id of the shape, -1 for the sky, shape (view_count, height, width)."""
        self._shape_segment = wp.array(segment if named else np.zeros(0), dtype=wp.int32, device=device)
        self._views = kernels.Views()
        self._views.world_to_camera, self._views.intrinsics = views.world_to_camera, views.intrinsics
        self._views.world = views.world
        self._frame = wp.mat33(*light_frame(options.light_direction).ravel())
        self._look = _look(options, device)
        self._no_shadow = no_shadow(device)
        spots = np.array(SPOTS[options.mesh_samples], np.float32) - 0.5
        self._spots, self._reach = wp.array(spots, dtype=wp.vec2, device=device), float(np.abs(spots).max())
        segments = next(count for edge, count in SEGMENTS if max(width, height) <= edge)
        self._load(world_kinds(model, segments, int(RAYS * width * height)))
        self._allocate(shape[0], len(spots))

    def _load(self, kinds: WorldKinds) -> None:
        """Upload the triangles."""
        device, drawn = self.device, kinds.triangles
        faces = kernels.Faces()
        faces.plane = wp.array(drawn.plane, dtype=wp.vec4, device=device)
        faces.corner = wp.array(drawn.corner, dtype=wp.vec3, device=device)
        faces.normal = wp.array(drawn.normal, dtype=wp.vec3, device=device)
        faces.slot = wp.array(drawn.slot, dtype=wp.int32, device=device)
        faces.shape = wp.array(kinds.shape, dtype=wp.int32, device=device)
        self._faces = faces
        self._kind = wp.array(kinds.of_world, dtype=wp.int32, device=device)
        self._center, self._half = (wp.array(x, dtype=wp.vec3, device=device) for x in (kinds.center, kinds.half))
        self._rays = None
        if kinds.ray_count.any():
            rays = ray_kernels.Rays()
            rays.count, rays.slot, rays.first = (
                wp.array(x, dtype=wp.int32, device=device) for x in (kinds.ray_count, kinds.ray_slot, kinds.ray_first)
            )
            rays.center, rays.half, rays.kind = self._center, self._half, self._kind
            rays.mesh, rays.scale = self.model.shape_source_ptr, self.model.shape_scale
            self._rays = rays
        ranges = [(kinds.small, TILES[0]), (kinds.large, TILES[1])]
        if device.is_cpu:  # one thread anyway
            ranges = [(kinds.both, max(*self._size, MAX_CELLS))]
        self._ranges = [
            (int(part[:, 1].max()), wp.array(part[kinds.of_world], dtype=wp.vec2i, device=device), edge)
            for part, edge in ranges
            if part[:, 1].any()
        ]
        """Number of triangles, those of each world, and the edge of a tile, of each launch over triangles."""

    def _allocate(self, views: int, samples: int) -> None:
        """Allocate what a frame writes on its way."""
        device, (width, height) = self.device, self._size
        worlds, slots = self._faces.shape.shape
        self._cells = min(max(width, height), MAX_CELLS)
        self._to_camera = wp.zeros((views, slots), dtype=wp.mat44, device=device)
        self._to_light = wp.zeros((worlds, slots), dtype=wp.mat44, device=device)
        self._albedo = wp.zeros((worlds, slots), dtype=wp.vec3, device=device)
        self._casts = wp.zeros((views, slots), dtype=wp.bool, device=device)
        self._grid = wp.zeros(views, dtype=wp.vec3, device=device)
        count = width * height * samples
        self._key = wp.full((views, count), value=NOTHING, dtype=wp.uint64, device=device)
        points = kernels.Points()
        points.width = width
        points.place = wp.zeros((views, count), dtype=wp.vec2, device=device)
        points.depth = wp.zeros((views, count), dtype=wp.float32, device=device)
        points.facing = wp.zeros((views, count), dtype=wp.vec2, device=device)
        points.following = wp.zeros((views, count), dtype=wp.int32, device=device)
        points.first = wp.zeros((views, self._cells**2), dtype=wp.int32, device=device)
        self._points = points

    def render(self, state: newton.State, variation: ViewVariation, shadow: SplatShadow | None) -> None:
        """Draw the meshes of all views; capturable.

        Args:
            state: Where the bodies are.
            variation: Sky and light of the worlds.
            shadow: The map of the splats' shadow.
        """
        device, faces, views, points, model = self.device, self._faces, self._views, self._points, self.model
        count, height, width = self.rgb.shape
        size, span = wp.vec2i(width, height), width if device.is_cpu else 1
        rows = (count, height, width // span)
        if self._ranges or self._rays is not None:
            shapes = (model.shape_flags, model.shape_transform, model.shape_body)
            boxes = (self._kind, self._center, self._half)
            launch(
                device, kernels.place_shapes, self._to_camera.shape,
                faces, views, *shapes, state.body_q, *boxes, size, self._frame, self._to_camera, self._casts,
            )  # fmt: skip
            given = (*shapes, model.shape_color, state.body_q)
            placed = (self._to_light, self._albedo)
            launch(device, kernels.light_shapes, self._to_light.shape, faces, self._frame, *given, *placed)
            for number, part, edge in self._ranges:
                dim = (count, number, -(-width // edge) * -(-height // edge))
                lens = (self._to_camera, self._spots, self._reach, edge, size)
                launch(device, kernels.fill_samples, dim, faces, part, views, *lens, self._key)
            if self._rays is not None:
                given = (faces, self._rays, views, self._to_camera, self._spots, size, span)
                launch(device, ray_kernels.trace_samples, rows, *given, self._key)
            self._cast(rows, size, span)
        drawn = (variation.horizon, variation.zenith, variation.light_gain, self._shape_segment)
        splats = self._no_shadow if shadow is None else shadow.map
        launch(
            device, kernels.shade_pixels, rows,
            faces, views, points, self._albedo, self._look, splats, *drawn, self._spots.shape[0], span, self._key,
            self.rgb, self.depth, self.segment,
        )  # fmt: skip

    def _cast(self, rows: tuple[int, int, int], size: Any, span: int) -> None:
        """Find what the samples show, and which of it stands in the shadow of a mesh."""
        device, faces, views, points, cells = self.device, self._faces, self._views, self._points, self._cells
        if self._options.shadows:
            points.first.fill_(-1)
            place = (self._casts, self._to_light, self._kind, self._center, self._half, cells)
            launch(device, kernels.bound_casters, self._grid.shape[0], views, *place, self._grid)
        seen = (self._to_camera, self._to_light, self._grid, cells, self._spots, size, span, self._key)
        launch(device, kernels.list_points, rows, faces, views, *seen, points)
        if not self._options.shadows:
            return
        for number, part, edge in self._ranges:
            dim = (rows[0], number, (-(-cells // edge)) ** 2)
            place = (self._casts, self._to_light, self._grid, cells, edge, self._key)
            launch(device, kernels.cast_shadows, dim, faces, part, views, *place, points)
        if self._rays is not None:
            given = (faces, self._rays, views, self._casts, self._to_light, self._spots.shape[0], span)
            launch(device, ray_kernels.trace_shadows, rows, *given, points)


def _look(options: CameraOptions, device: wp.Device) -> Any:
    """Return the light that is alike in all worlds, as kernels take it."""
    made = kernels.Look()
    made.above, made.below = (wp.vec3(*radiance) for radiance in options.ambient)
    made.sun = wp.vec3(*options.light_color)
    made.encoded = encoded_light(device)
    return made
