"""Pictures of triangle meshes by rasterising them, with shadows of soft edges: what a film shows behind its splats.

A pixel has four samples, the triangles that fall on one are compared by depth, and each smooth patch of a pixel is lit
once. The pictures of policies are drawn by `camera_meshes`, with sharp shadows and without layers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softmode.deformables.model.declare import launch
from softmode.splats.cameras import mesh_raster_kernels as kernels
from softmode.splats.cameras.camera_options import CameraOptions
from softmode.splats.cameras.light import encoded_light, light_frame, linear_light
from softmode.splats.raster.pinhole import Vector
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.raster.scan_kernels import NOTHING

CELLS = 640
"""Cells of the map of shadows along each side."""
COPLANAR = 3.0e-5
"""By how much a shape's depth is taken as larger than that of the shape before it, where faces lie in one plane."""
FAR = 1.0e30
"""Depth of nothing along the light [m]."""
BANDS = 32
"""Threads of a triangle on CUDA."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMeshes:
    """The triangles of one world, whose bodies every world has."""

    corners: NDArray[np.float32]
    """Corners in the frame of their body [m], shape (V, 3)."""
    normals: NDArray[np.float32]
    """Unit normals, shape (V, 3)."""
    faces: NDArray[np.int32]
    """Triangles, shape (F, 3)."""
    colors: NDArray[np.float32]
    """Colour of each triangle, sRGB in 0..1, shape (F, 3)."""
    shapes: NDArray[np.int32]
    """Shape of each triangle, shape (F,)."""
    closed: NDArray[np.bool_]
    """Whether each triangle is of a closed mesh, shape (F,)."""
    bodies: NDArray[np.int32]
    """Body of each corner, counted from the first of its world; -1 for none, shape (V,)."""
    wooden: NDArray[np.bool_]
    """Whether each triangle is made of planks, shape (F,)."""


class MeshRaster:
    """Draws meshes into images of one size, in two layers where an edge passes through a pixel.

    Images, overwritten by every frame, of the far layer: `rgb`, vec3 0..1, and `depth` [m], 0 for the sky, shape
    (view_count, height, width).

    Args:
        meshes: The triangles of a world.
        body_start: First body of each world, shape (world_count,).
        center: Middle of what casts shadows [m].
        radius: Distance from there up to which things cast shadows [m].
        view_count: Number of views.
        width: Image width [px].
        height: Image height [px].
        light: Light and sky.
        room: Whether there is a room around all, with a second light, in place of the sky.
        device: Warp device.
    """

    def __init__(
        self,
        meshes: TriangleMeshes,
        body_start: NDArray[np.int32],
        center: NDArray[np.float64],
        radius: float,
        view_count: int,
        width: int,
        height: int,
        *,
        light: CameraOptions,
        room: bool = False,
        device: wp.Device,
    ) -> None:
        """Upload the triangles and allocate the images."""
        self.device, self._worlds = device, len(body_start)
        moves = (meshes.bodies[meshes.faces] >= 0).any(axis=1)
        order = np.argsort(moves, kind="stable")
        patches = _patches(len(meshes.corners), meshes.faces)
        self._still = int((~moves).sum())
        """How many faces, the first ones, stand still."""
        t = kernels.Triangles()
        t.corner = wp.array(meshes.corners, dtype=wp.vec3, device=device)
        t.normal = wp.array(meshes.normals, dtype=wp.vec3, device=device)
        t.body = wp.array(meshes.bodies, dtype=wp.int32, device=device)
        t.face = wp.array(meshes.faces[order], dtype=wp.vec3i, device=device)
        first = 1.0 - COPLANAR * meshes.shapes[order, None]
        t.color = wp.array(np.hstack([linear_light(meshes.colors[order]), first]), dtype=wp.vec4, device=device)
        t.patch = wp.array(patches[order], dtype=wp.int32, device=device)
        t.closed = wp.array(meshes.closed[order], dtype=wp.bool, device=device)
        t.wooden = wp.array(meshes.wooden[order], dtype=wp.bool, device=device)
        t.body_start = wp.array(body_start, dtype=wp.int32, device=device)
        self._triangles = t
        self._light = _light(light, room, center, radius, device)
        self._shadows = light.shadows
        moved = (self._worlds, len(meshes.corners))
        self._corner, self._normal = (wp.zeros(moved, dtype=wp.vec3, device=device) for _ in range(2))
        shape, cells = (view_count, height, width), (self._worlds, CELLS, CELLS)
        self._shadow, self._still_shadow = (wp.full(cells, FAR, dtype=wp.float32, device=device) for _ in range(2))
        self._still_known = False
        samples = (view_count, height * width * kernels.SAMPLES)
        self._key = wp.full(samples, value=NOTHING, dtype=wp.uint64, device=device)
        self._spots = wp.array(kernels.SPOTS, dtype=wp.vec2, device=device)
        self.rgb = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.depth = wp.zeros(shape, dtype=wp.float32, device=device)
        self._near = wp.zeros(shape, dtype=kernels.layer, device=device)
        self._near_depth = wp.zeros(shape, dtype=wp.float32, device=device)
        nothing = wp.zeros((0, 0, 0), dtype=wp.float32, device=device)
        self._no_plate = (wp.zeros((0, 0, 0), dtype=wp.vec3, device=device), nothing, nothing)

    def render(
        self, body_q: wp.array | None, views: ViewArrays, casters: SplatArrays | None, plate: SplatRasterizer | None
    ) -> None:
        """Draw one frame.

        Args:
            body_q: Where the bodies are.
            views: The cameras.
            casters: Splats that cast shadows.
            plate: What is drawn of a scene of splats that the meshes stand in, with its `median_depth`.
        """
        device, triangles, light = self.device, self._triangles, self._light
        seen = _views(views)
        count, height, width = self.rgb.shape
        corner, faces = self._corner, triangles.face.shape[0]
        launch(device, kernels.move_corners, corner.shape, triangles, body_q, corner, self._normal)
        self._cast(casters)
        bands, span = (1, width) if device.is_cpu else (BANDS, 1)
        rows = (count, height, width // span)
        launch(
            device, kernels.fill_samples, (count, faces, bands),
            triangles, corner, seen, self._spots, wp.vec2i(width, height), bands, self._key,
        )  # fmt: skip
        images = self._no_plate if plate is None else (plate.rgb, plate.alpha, plate.median_depth)
        launch(
            device, kernels.shade_pixels, rows,
            triangles, corner, self._normal, seen, light, self._shadow, self._key, *images, span,
            self.rgb, self.depth, self._near, self._near_depth,
        )  # fmt: skip

    def circle(self, center: wp.array, radius: wp.array, color: Vector, views: ViewArrays) -> None:
        """Draw a thin ring around a place of each world into the frame that was drawn, before splats are.

        Args:
            center: The places [m], vec3, shape (world_count,).
            radius: Radii of the rings [m], shape (world_count,).
            color: Their colour, sRGB.
            views: The cameras.
        """
        width = max(1.5, 0.007 * self.rgb.shape[1])
        given = (center, radius, wp.vec3(*color), width, _views(views), self.depth)
        launch(self.device, kernels.draw_rings, self.rgb.shape[:2], *given, self.rgb)

    def _cast(self, casters: SplatArrays | None) -> None:
        """Draw the map of shadows; what stands still is drawn once."""
        if not self._shadows:
            return
        triangles, count, still = self._triangles, self._triangles.face.shape[0], self._still
        given = (triangles, self._corner, self._light)
        if not self._still_known and still:
            launch(self.device, kernels.fill_shadow, (self._worlds, still), *given, 0, self._still_shadow)
        self._still_known = True
        wp.copy(self._shadow, self._still_shadow)
        if count > still:
            launch(self.device, kernels.fill_shadow, (self._worlds, count - still), *given, still, self._shadow)
        if casters is not None:
            splats = (casters.means, casters.covariances, casters.opacities)
            dim = (self._worlds, casters.means.shape[1])
            launch(self.device, kernels.fill_splat_shadow, dim, *splats, self._light, self._shadow)

    def join(self, splats: SplatRasterizer, bytes_out: wp.array) -> None:
        """Put the near layer before the splats that were drawn over the far one.

        Args:
            splats: What was drawn over `rgb` and `depth`.
            bytes_out: The picture, uint8, shape (view_count, height, width, 3).
        """
        drawn = (splats.rgb, splats.alpha, splats.depth)
        layers = (self.rgb, self.depth, self._near, self._near_depth)
        span = self.rgb.shape[2] if self.device.is_cpu else 1
        rows = (*self.rgb.shape[:2], self.rgb.shape[2] // span)
        launch(self.device, kernels.join_layers, rows, *drawn, *layers, span, bytes_out)


def _views(views: ViewArrays) -> Any:
    """Return the cameras as the kernels take them."""
    seen = kernels.Views()
    seen.world_to_camera, seen.intrinsics, seen.world = views.world_to_camera, views.intrinsics, views.world
    return seen


def _light(options: CameraOptions, room: bool, center: NDArray[np.float64], radius: float, device: wp.Device) -> Any:
    """Return what the kernels know of the light, the map of shadows about a centre [m]."""
    frame = light_frame(options.light_direction)
    light = kernels.Light()
    light.frame = wp.mat33(*frame.ravel())
    light.corner = wp.vec2(*(frame[:2] @ center - radius))
    light.cell = 2.0 * radius / CELLS
    light.above, light.below = (wp.vec3(*radiance) for radiance in options.ambient)
    light.sun = wp.vec3(*options.light_color)
    light.room = room
    light.horizon, light.zenith = (wp.vec3(*color) for color in options.sky)
    light.encoded = encoded_light(device)
    return light


def _patches(count: int, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the patch of each face, shape (F,): faces that hang together by some of the `count` corners are of one."""
    one, other = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    return connected_components(graph, directed=False)[1][faces[:, 0]].astype(np.int32)
