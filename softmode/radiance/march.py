"""Rays through radiance fields: at rest, and of deformed bodies through the inverse map, behind and before the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike
from scipy import ndimage

from softmode.checks import require_number
from softmode.deformables.model.declare import launch
from softmode.deformables.tools.inverse_map import InverseMap
from softmode.errors import ConfigError
from softmode.radiance import march_kernels as kernels
from softmode.radiance.grid import RadianceGrid
from softmode.splats.fit.reference_views import ReferenceViews
from softmode.splats.raster.rasterizer import ViewArrays


@dataclass(frozen=True, kw_only=True)
class MarchOptions:
    """How rays are marched."""

    step: float = 0.6
    """Step along a ray over the least distance of nodes, at rest."""
    samples: int = 1
    """Rays per pixel along each axis."""
    nodes: int = 24
    """Nodes of the inverse map's lattice along the longest edge of the body."""
    cells: int = 36
    """Edge of the inverse map's grid."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_number("step", self.step, at_least=0.05, at_most=2.0)
        require_number("samples", self.samples, at_least=1, at_most=16)


def upload_field(grid: RadianceGrid, step: float, device: wp.DeviceLike) -> Any:
    """Return a field for the kernels: float32, with the distance of every node to what is not empty."""
    occupied = grid.occupied if grid.occupied.any() else grid.density > 0.0
    clear: Any = ndimage.distance_transform_cdt(~occupied, metric="chessboard")
    field = kernels.Field()
    field.density = wp.array(grid.density.astype(np.float32), dtype=wp.float32, device=device)
    field.sh = wp.array(grid.spread_sh.astype(np.float32), dtype=wp.vec3, device=device)
    field.clear = wp.array(clear.astype(np.int32), dtype=wp.int32, device=device)
    field.size = wp.vec3i(*grid.shape)
    field.to_index = wp.mat33(*np.linalg.inv(grid.axes).ravel())
    field.origin = wp.vec3(*grid.origin)
    field.to_color = wp.mat33(*grid.rotation.T.ravel())
    field.voxel = float(np.linalg.norm(grid.axes, axis=0).min())
    field.step = step * field.voxel
    return field


def render_radiance(
    grid: RadianceGrid,
    world_to_camera: ArrayLike,
    intrinsics: ArrayLike,
    *,
    width: int,
    height: int,
    samples: int = 1,
    step: float = 0.6,
    device: wp.DeviceLike = None,
) -> ReferenceViews:
    """Draw a field at rest.

    Args:
        grid: The field.
        world_to_camera: Rigid transforms to OpenCV camera axes, shape (V, 4, 4).
        intrinsics: fx, fy, cx, cy [px], shape (V, 4) or (4,).
        width: Image width [px].
        height: Image height [px].
        samples: Rays per pixel along each axis.
        step: Step along a ray over the least distance of nodes.
        device: Warp device.

    Raises:
        ConfigError: If a size or the number of samples is not positive.
    """
    if min(width, height, samples) < 1:
        raise ConfigError(f"images of {width} x {height} px with {samples} samples are empty", hint="give at least 1")
    poses = np.asarray(world_to_camera, dtype=np.float32)
    lenses = np.array(np.broadcast_to(np.asarray(intrinsics, dtype=np.float32), (len(poses), 4)))
    place, shape = wp.get_device(device), (len(poses), height, width)
    layer = wp.zeros(shape, dtype=wp.vec4, device=place)
    depth, count = wp.zeros(shape, dtype=float, device=place), wp.zeros(shape, dtype=int, device=place)
    launch(
        place, kernels.march_views, shape, upload_field(grid, step, place), kernels.RestGrid(), None, False,
        wp.array(poses, dtype=wp.mat44, device=place), wp.array(lenses, dtype=wp.vec4, device=place), None, None,
        samples, layer, depth, count,
    )  # fmt: skip
    pixels = layer.numpy()
    return ReferenceViews(
        world_to_camera=poses,
        intrinsics=lenses,
        rgb=wp.array(np.ascontiguousarray(pixels[..., :3]), dtype=wp.vec3, device=place),
        alpha=wp.array(np.ascontiguousarray(pixels[..., 3]), dtype=float, device=place),
    )


class RadianceMarch:
    """Radiance fields of deformed bodies in the pictures of a camera; an `Overlay` of `SplatCamera`.

    Fields and splats of a pixel are put over each other in the order of their mean depth; rays end at meshes. A field
    of one body is seen at one rest point per place: where a body lies in itself, one of its sheets shows.

    Args:
        fields: Inverse map of each body (with `turns` for view-dependent colours), and its field in the body frame.
        options: How rays are marched.

    Raises:
        ConfigError: If there is no field or more than eight, or a map lacks the turns that its colours need.
    """

    def __init__(
        self, fields: Sequence[tuple[InverseMap, RadianceGrid]], *, options: MarchOptions | None = None
    ) -> None:
        """Upload the fields."""
        self.options = options if options is not None else MarchOptions()
        if not 0 < len(fields) <= kernels.LAYERS:
            raise ConfigError(f"{len(fields)} fields, expected 1 to {kernels.LAYERS}", hint="bake some to splats")
        if any(grid.sh_degree and not inverse.grid.turn.shape[0] for inverse, grid in fields):
            raise ConfigError("a field has view-dependent colours", hint="make its InverseMap with turns=True")
        self.maps = tuple(inverse for inverse, _ in fields)
        self.hides: tuple[int, ...] = ()
        """Bodies whose splats are not drawn: those of `of_bodies`."""
        self.device = self.maps[0].device
        self._fields = [upload_field(grid, self.options.step, self.device) for _, grid in fields]
        self._live = [wp.zeros(inverse.grid.flag.shape, dtype=int, device=self.device) for inverse in self.maps]
        spans = [float(np.ptp(inverse.body.bounds, axis=0).max()) / self.options.cells for inverse in self.maps]
        # A cell may hold twice as much at rest where the body is pressed.
        self._reach = [
            int(np.ceil(2.0 * span / field.voxel)) + 1 for span, field in zip(spans, self._fields, strict=True)
        ]
        self._span = [8.0 * span for span in spans]
        self._images: dict[tuple[int, ...], tuple[wp.array, wp.array, wp.array]] = {}

    @classmethod
    def of_bodies(
        cls, solver: Any, fields: Sequence[tuple[int, RadianceGrid]], *, options: MarchOptions | None = None
    ) -> RadianceMarch:
        """Return the fields of bodies of a solver.

        Args:
            solver: Solver that holds them.
            fields: Index of each body in its world, and its field in the body frame.
            options: How rays are marched.
        """
        chosen = options if options is not None else MarchOptions()
        maps = [
            InverseMap(solver, body, nodes=chosen.nodes, cells=chosen.cells, within=holds_of(grid),
                       turns=grid.sh_degree > 0)
            for body, grid in fields
        ]  # fmt: skip
        made = cls([(inverse, grid) for inverse, (_, grid) in zip(maps, fields, strict=True)], options=chosen)
        made.hides = tuple(body for body, _ in fields)
        return made

    def update(self, state: newton.State) -> None:
        """Follow the bodies to where a state has them; capturable after a first time."""
        for inverse in self.maps:
            inverse.update(state)
        self.mark()

    def mark(self) -> None:
        """Find what may be seen, after the maps have moved."""
        for inverse, field, live, reach, span in zip(
            self.maps, self._fields, self._live, self._reach, self._span, strict=True
        ):
            launch(self.device, kernels.mark_live, live.shape, field, inverse.grid, reach, span, live)

    def march(self, views: ViewArrays, size: tuple[int, int], mesh_depth: wp.array | None = None) -> Any:
        """March all fields; return their layers, vec4 colour times coverage and coverage, depths and sample counts.

        Args:
            views: The cameras.
            size: Height and width of the pictures [px].
            mesh_depth: Forward depth of the meshes [m], 0 where there is none, shape (view_count, height, width).
        """
        shape = (len(self.maps), views.world_to_camera.shape[0], *size)
        if shape not in self._images:
            if self.device.is_capturing:
                raise ConfigError("the first pictures of a size are being captured", hint="draw once before")
            self._images[shape] = (
                wp.zeros(shape, dtype=wp.vec4, device=self.device),
                wp.zeros(shape, dtype=float, device=self.device),
                wp.zeros(shape, dtype=int, device=self.device),
            )
        images = self._images[shape]
        for k, (inverse, field, live) in enumerate(zip(self.maps, self._fields, self._live, strict=True)):
            launch(
                self.device, kernels.march_views, shape[1:], field, inverse.grid, live, True,
                views.world_to_camera, views.intrinsics, views.world, mesh_depth, self.options.samples,
                *(image[k] for image in images), block_dim=128,
            )  # fmt: skip
        return images

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
        """Put the fields into pictures of meshes and splats; capturable after a first time. See `Overlay`."""
        size = (int(rgb.shape[1]), int(rgb.shape[2]))
        layer, far, _ = self.march(views, size, mesh_depth)
        given = (layer, far, mesh_rgb, mesh_depth, alpha is not None)
        launch(self.device, kernels.join_layers, rgb.shape, *given, rgb, depth, alpha)


def holds_of(grid: RadianceGrid) -> Any:
    """Return the function that tells which rest points (N, 3) lie in what is not empty of a field."""
    near: Any = ndimage.maximum_filter(grid.occupied.astype(np.float32), 3)

    def holds(points: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(near, np.linalg.solve(grid.axes, (points - grid.origin).T), order=1) > 0.0

    return holds
