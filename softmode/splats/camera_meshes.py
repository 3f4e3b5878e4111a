"""Pictures of the meshes of a Newton model for all views at once, by rasterising their triangles.

A view is one camera in one world. The triangles of worlds with equal shapes are stored once, each in the frame of its
shape; poses, colours and the flag VISIBLE of the shapes are read anew by every frame. A frame is a fixed sequence:

    place shapes -> triangles into samples -> points across the light -> shadows -> light
"""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from newton import GeoType, ShapeFlags
from numpy.typing import NDArray

from softmode.deformables.model.declare import launch
from softmode.splats import camera_mesh_kernels as kernels
from softmode.splats.camera_options import CameraOptions
from softmode.splats.camera_randomization import ViewVariation
from softmode.splats.light import encoded_light, light_frame
from softmode.splats.rasterizer import ViewArrays
from softmode.splats.scan_kernels import NOTHING
from softmode.splats.shadow import SplatShadow, no_shadow
from softmode.splats.shape_triangles import shape_triangles

PLANE_EXTENT = 2000.0
"""Edge of the quad that stands for an infinite plane [m]."""
SEGMENTS = ((160, 24), (1 << 30, 48))
"""Facets around what is round, by the largest edge of the picture [px]."""
LARGE = 0.005
"""Area of a triangle from which many threads share it on CUDA [m^2]."""
TILES = (128, 8)
"""Edge of a tile of a thread on CUDA, for small triangles and for large ones [px]."""
MAX_CELLS = 512
"""Most cells across the light along each side."""
SPOTS = {1: ((0.5, 0.5),), 4: ((0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72))}
"""Samples of a pixel by their number; a shape is lit at the first one that shows it."""


@dataclass(frozen=True, eq=False)
class _Kinds:
    """Triangles of the kinds of worlds that a model has, one kind after the other, the large ones of a kind last."""

    plane: NDArray[np.float32]
    corner: NDArray[np.float32]
    normal: NDArray[np.float32]
    slot: NDArray[np.int32]
    center: NDArray[np.float32]
    half: NDArray[np.float32]
    small: NDArray[np.int32]
    large: NDArray[np.int32]
    of_world: NDArray[np.int32]
    shape: NDArray[np.int32]


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
        self._load(_kinds(model, next(count for edge, count in SEGMENTS if max(width, height) <= edge)))
        self._allocate(shape[0], len(spots))

    def _load(self, kinds: _Kinds) -> None:
        """Upload the triangles."""
        device = self.device
        faces = kernels.Faces()
        faces.plane = wp.array(kinds.plane, dtype=wp.vec4, device=device)
        faces.corner = wp.array(kinds.corner, dtype=wp.vec3, device=device)
        faces.normal = wp.array(kinds.normal, dtype=wp.vec3, device=device)
        faces.slot = wp.array(kinds.slot, dtype=wp.int32, device=device)
        faces.shape = wp.array(kinds.shape, dtype=wp.int32, device=device)
        self._faces = faces
        self._kind = wp.array(kinds.of_world, dtype=wp.int32, device=device)
        self._center, self._half = (wp.array(x, dtype=wp.vec3, device=device) for x in (kinds.center, kinds.half))
        ranges = [(kinds.small, TILES[0]), (kinds.large, TILES[1])]
        if device.is_cpu:  # one thread anyway
            both = np.stack([kinds.small[:, 0], kinds.small[:, 1] + kinds.large[:, 1]], axis=1)
            ranges = [(both, max(*self._size, MAX_CELLS))]
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
        if self._ranges:
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


def _look(options: CameraOptions, device: wp.Device) -> Any:
    """Return the light that is alike in all worlds, as kernels take it."""
    made = kernels.Look()
    made.above, made.below = (wp.vec3(*radiance) for radiance in options.ambient)
    made.sun = wp.vec3(*options.light_color)
    made.encoded = encoded_light(device)
    return made


def _kinds(model: newton.Model, segments: int) -> _Kinds:
    """Return the triangles of a model; worlds with equal shapes share theirs."""
    worlds = max(int(model.world_count), 1)
    shown = _shown(model)
    types, scales = (x.numpy() if model.shape_count else np.zeros(0) for x in (model.shape_type, model.shape_scale))
    sources = np.array([id(source) for source in model.shape_source], np.int64)
    owner = np.zeros(0, np.int64) if model.shape_world is None else model.shape_world.numpy()[shown]
    starts = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[starts], np.arange(-1, worlds + 1))
    shared = shown[starts[: ends[1]]]
    known: dict[bytes, int] = {}
    of_world, shapes, made = np.zeros(worlds, np.int32), [], []
    for world in range(worlds):
        own = np.concatenate([shared, shown[starts[ends[world + 1] : ends[world + 2]]]])
        key = b"".join(x[own].tobytes() for x in (types, scales, sources))
        if key not in known:
            known[key] = len(made)
            made.append(_faces_of(model, own, types, scales, segments))
        of_world[world] = known[key]
        shapes.append(own)
    slots = max([1, *(len(own) for own in shapes)])
    table = np.full((worlds, slots), -1, np.int32)
    for world, own in enumerate(shapes):
        table[world, : len(own)] = own
    boxes = np.zeros((2, len(made), slots, 3), np.float32)
    for kind, parts in enumerate(made):
        boxes[:, kind, : len(parts[4])] = np.stack([parts[4], parts[5]])
    counts = np.array([(len(parts[0]), parts[6]) for parts in made], np.int32)
    first = np.cumsum(counts[:, 0]) - counts[:, 0]
    plane, corner, normal, slot = (np.concatenate([parts[i] for parts in made]) for i in range(4))
    small = np.stack([first, counts[:, 1]], axis=1)
    large = np.stack([first + counts[:, 1], counts[:, 0] - counts[:, 1]], axis=1)
    return _Kinds(plane, corner, normal, slot, boxes[0], boxes[1], small, large, of_world, table)


def _shown(model: newton.Model) -> NDArray[np.int64]:
    """Return the shapes that are visible and not fully transparent."""
    if model.shape_count == 0 or model.shape_flags is None:
        return np.zeros(0, np.int64)
    visible = (model.shape_flags.numpy() & int(ShapeFlags.VISIBLE)) != 0
    if model.shape_opacity is not None:
        visible &= model.shape_opacity.numpy() > 0.0
    return np.flatnonzero(visible)


def _faces_of(
    model: newton.Model, shapes: NDArray[np.int64], types: Any, scales: Any, segments: int
) -> tuple[Any, Any, Any, Any, Any, Any, int]:
    """Return planes, corners, normals and slots of triangles, middles and half extents of shapes, and the small ones."""
    parts = [(np.zeros((0, 4)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int32))]
    middle, half = np.zeros((2, len(shapes), 3))
    for slot, shape in enumerate(shapes.tolist()):
        kind, source = GeoType(int(types[shape])), model.shape_source[shape]
        found = shape_triangles(kind, scales[shape].tolist(), source, PLANE_EXTENT, segments)
        if found is None or not len(found[1]):
            continue
        vertices, faces, normals = found
        corner = vertices[faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(across, axis=1)
        kept = area > 1e-12 * area.max()
        corner, unit, normal = corner[kept], across[kept] / area[kept, None], normals[faces[kept]]
        if _is_flat(kind, source):
            normal = np.repeat(unit[:, None], 3, axis=1)
        # Neighbours in the list look the same way, so that the threads of a warp see them or do not.
        order = np.lexsort([*corner.mean(axis=1).T, *np.round(1.4 * unit).T])
        plane = np.concatenate([unit, (unit * corner.mean(axis=1)).sum(axis=1)[:, None]], axis=1)
        parts.append((plane[order], corner[order], normal[order], np.full(len(order), slot, np.int32)))
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        middle[slot], half[slot] = 0.5 * (low + high), 0.5 * (high - low)
        if kind != GeoType.PLANE:  # a sheet casts from one side only
            half[slot] = np.maximum(half[slot], 1e-6)
    plane, corner, normal, slots = (np.concatenate(x) for x in zip(*parts, strict=True))
    large = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) > 2.0 * LARGE
    order = np.argsort(large, kind="stable")
    return (*(x[order] for x in (plane, corner, normal, slots)), middle, half, int((~large).sum()))


def _is_flat(kind: GeoType, source: Any) -> bool:
    """Return whether each triangle of a shape is lit as it faces: it brings no normals."""
    if kind in (GeoType.CONVEX_MESH, GeoType.HFIELD):
        return True
    return kind == GeoType.MESH and (source.normals is None or len(source.normals) != len(source.vertices))
