"""The batched tile rasteriser for 3D Gaussian splats: one code path for CPU and CUDA, no host read-back, capturable.

One frame is a fixed launch sequence over all views (worlds x cameras):

    project -> sort each view by depth -> cover: one bit per (tile, depth rank) -> blend

A tile's splats in depth order are the set bits of its row of words: no list of (tile, splat) pairs is made or sorted,
and nothing can overflow. Images follow the standard splat formula (Kerbl et al. 2023): alpha = min(0.99, o
exp(-d^2/2)), cut below 1/255, front to back until less than 1e-4 of the light is left. The antialiased mode (on by
default; Yu et al. 2024, "Mip-Splatting") scales opacities by the share of the footprint that the pixel filter adds,
which is what keeps small images right.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from softmode.checks import require_number
from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.raster import blend_cpu_kernels, blend_cuda_kernels, cover_cuda_kernels, depth_sort_kernels
from softmode.splats.raster import rasterizer_kernels as kernels
from softmode.splats.raster.pinhole import MAX_EDGE, PinholeCamera
from softmode.splats.splats import MAX_SPLATS, Splats, padded_sh


@dataclass(frozen=True, kw_only=True)
class RasterizerOptions:
    """How splats are drawn; fixed for a rasteriser's life."""

    antialiased: bool = True
    """Compensate opacity for the pixel filter; False is the classic formula."""
    dilation: float | None = None
    """Variance of the pixel filter [px^2]; None is 0.1 antialiased, 0.3 classic. A pixel's own is 1/12; 0.1, as in
    Mip-Splatting, comes 5 to 8 dB nearer to eightfold supersampling than 0.3."""
    near: float = 0.01
    """Nearest visible forward depth [m]."""
    object_ids: bool = False
    """Write the object of the largest weight per pixel."""
    median_depth: bool = False
    """Write the depth at which half of the light is gone."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        # Depths are sorted by their bits, which do so for positive numbers only.
        require_number("near", self.near, above=0.0, unit="m")
        require_number("dilation", self.pixel_variance, at_least=0.0, unit="px^2", hint="None takes the usual one")

    @property
    def pixel_variance(self) -> float:
        """The dilation that is meant [px^2]."""
        if self.dilation is not None:
            return self.dilation
        return 0.1 if self.antialiased else 0.3


@dataclass(frozen=True, kw_only=True)
class SplatArrays:
    """Splats of all objects on the device. Leading sizes are 1 (shared by all worlds) or world_count."""

    means: wp.array
    """Centres [m], vec3, shape (1 or world_count, N)."""
    covariances: wp.array
    """Covariances xx, xy, xz, yy, yz, zz [m^2], vec6, shape (1 or world_count, N)."""
    opacities: wp.array
    """Opacities 0..1, shape (1 or world_count, N)."""
    sh: wp.array
    """Colour coefficients, vec3, shape (1 or world_count, N, K)."""
    object_index: wp.array
    """Object of each splat, int32, shape (N,)."""
    rotations: wp.array
    """Rotation of each splat's colours, rest frame to world, quat, shape (1 or world_count, N); (1, 1) and not read if
    K = 1, where colours are the same from everywhere."""
    spanning: wp.array | None = None
    """Columns of the splats that the map of a shadow spans, int32, shape (world_count, M), where worlds differ in
    them; None where every so many splats do."""

    def without(self, objects: Sequence[int]) -> "SplatArrays":
        """Return them with some objects invisible; the rest is shared memory."""
        shown = np.where(np.isin(self.object_index.numpy(), objects), np.float32(0.0), self.opacities.numpy())
        return replace(self, opacities=wp.array(shown, dtype=float, device=self.opacities.device))

    @classmethod
    def from_splats(
        cls,
        objects: Sequence[Splats | Sequence[Splats]],
        *,
        world_count: int = 1,
        sh_degree: int | None = None,
        device: str | wp.Device | None = None,
    ) -> "SplatArrays":
        """Upload the objects in their rest state; means, covariances and rotations are per world.

        Opacities and colours are shared by all worlds where these are alike, else per world too.

        Args:
            objects: Splats of each object, in the order of their columns. A list of them, one per world, stands for an
                object that differs; it has the columns of the largest, and those that a world leaves are invisible.
            world_count: Number of worlds.
            sh_degree: Degree kept, 0 to 3; None for the highest of the objects. Lower ones are padded with zeros.
            device: Warp device.

        Raises:
            ConfigError: If there are no objects or worlds, or the degree is out of range.
        """
        if isinstance(objects, Splats) or not objects:
            raise ConfigError("objects is empty or no list", hint="Pass a list of at least one Splats")
        require_number("world_count", world_count, at_least=1, hint="Pass model.world_count")
        if sh_degree is not None:
            hint = "Pass None for that of the objects"
            require_number("sh_degree", sh_degree, at_least=0, at_most=3, hint=hint)
        shown = [[thing] if isinstance(thing, Splats) else list(thing) for thing in objects]
        sizes = {len(thing) for thing in shown if len(thing) != 1}
        if not all(shown) or not sizes <= {world_count}:
            hint = "Give one Splats, or one for each world"
            raise ConfigError(f"objects of {sorted(sizes)} worlds, expected {world_count}", hint=hint)
        widths = [max(splats.count for splats in thing) for thing in shown]
        every = [splats for thing in shown for splats in thing]
        degree = max(splats.sh.shape[1] for splats in every) if sh_degree is None else (sh_degree + 1) ** 2
        # Worlds that show the same share a row until it is copied.
        rows: dict[tuple[int, ...], int] = {}
        parts: list[list[Splats]] = []
        row = np.zeros(world_count, dtype=int)
        for world in range(world_count if sizes else 1):
            mine = [thing[world % len(thing)] for thing in shown]
            row[world] = rows.setdefault(tuple(map(id, mine)), len(rows))
            if row[world] == len(parts):
                parts.append(mine)
        means, six, opacities, sh = (
            np.stack(arrays) for arrays in zip(*(_padded_columns(mine, widths, degree) for mine in parts), strict=True)
        )
        index = np.repeat(np.arange(len(shown), dtype=np.int32), widths)
        turns = (world_count, sum(widths)) if degree > 1 else (1, 1)
        kept = row if len(parts) > 1 else row[:1]
        spanning = None
        if len(parts) > 1:
            filled = [_filled_columns(mine, widths) for mine in parts]
            spanning = wp.array(_spanning_columns(filled)[row], dtype=wp.int32, device=device)
        return cls(
            means=wp.array(means.astype(np.float32)[row], dtype=wp.vec3, device=device),
            covariances=wp.array(six.astype(np.float32)[row], dtype=kernels.vec6, device=device),
            opacities=wp.array(opacities[kept], dtype=wp.float32, device=device),
            sh=wp.array(sh[kept], dtype=wp.vec3, device=device),
            object_index=wp.array(index, dtype=wp.int32, device=device),
            rotations=wp.full(turns, wp.quat_identity(), dtype=wp.quat, device=device),
            spanning=spanning,
        )


def spanning_columns(count: int) -> np.ndarray:
    """Return which of so many splats the map of a shadow spans, some of them."""
    return np.arange(0, count, max(1, count // 128))


def _spanning_columns(filled: Sequence[np.ndarray]) -> np.ndarray:
    """Return the columns that the maps of several worlds span, the last of each repeated to the longest row."""
    rows = [columns[spanning_columns(len(columns))] for columns in filled]
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows])


def _filled_columns(objects: Sequence[Splats], widths: Sequence[int]) -> np.ndarray:
    """Return the columns of a world that hold a splat."""
    starts = np.cumsum([0, *widths])
    return np.concatenate([start + np.arange(splats.count) for start, splats in zip(starts, objects, strict=False)])


def _padded_columns(
    objects: Sequence[Splats], widths: Sequence[int], coefficient_count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return means, covariances, opacities and colours of a world; what is missing to a width is not opaque."""
    s = np.concatenate([splats.covariances() for splats in objects])
    six = np.stack([s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]], axis=1)
    means = np.concatenate([splats.means for splats in objects])
    opacities = np.concatenate([splats.opacities for splats in objects])
    given = (means, six, opacities, padded_sh(objects, coefficient_count))
    ends = np.cumsum([splats.count for splats in objects])
    missing = [width - splats.count for width, splats in zip(widths, objects, strict=True)]
    if not any(missing):
        return given
    places = np.repeat(ends, missing)
    means, six, opacities, sh = (np.insert(array, places, 0.0, axis=0) for array in given)
    return means, six, opacities, sh


@dataclass(frozen=True, kw_only=True)
class ViewArrays:
    """The views of a frame on the device. Pinhole cameras with OpenCV axes: x right, y down, z forward."""

    world_to_camera: wp.array
    """Rigid transforms, mat44, shape (view_count,)."""
    intrinsics: wp.array
    """fx, fy, cx, cy [px], vec4, shape (view_count,). The centre of the first pixel is (0.5, 0.5)."""
    world: wp.array
    """World that each view shows, int32, shape (view_count,)."""
    background: wp.array
    """Colour behind everything, vec3, shape (1 or view_count,)."""
    splat_gain: wp.array | None = None
    """Factor on the colours (xyz) and opacities (w, the product at most 1) of splats, vec4, shape (1 or view_count,);
    None for ones."""

    @classmethod
    def from_cameras(
        cls,
        cameras: Sequence[PinholeCamera],
        *,
        world: Sequence[int] | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        device: str | wp.Device | None = None,
    ) -> "ViewArrays":
        """Return one view per camera fixed in the world.

        Args:
            cameras: Descriptions of one image size, none of them on a body.
            world: World that each of them shows; world 0 if None.
            background: Colour behind everything, 0..1.
            device: Warp device.

        Raises:
            ConfigError: If there is no camera, one is on a body, or sizes or numbers disagree.
        """
        sizes = {(camera.width, camera.height) for camera in cameras}
        carried = [camera.name for camera in cameras if camera.body is not None]
        shown = [0] * len(cameras) if world is None else list(world)
        if len(sizes) != 1 or carried or len(shown) != len(cameras):
            raise ConfigError(
                f"{len(cameras)} cameras of sizes {sorted(sizes)}, {carried} on bodies, {len(shown)} worlds",
                hint="Give fixed cameras of one size and one world for each; SplatCamera draws those on bodies",
            )
        matrices = np.stack([camera.world_to_camera for camera in cameras]).astype(np.float32)
        lenses = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras], dtype=np.float32)
        return cls(
            world_to_camera=wp.array(matrices, dtype=wp.mat44, device=device),
            intrinsics=wp.array(lenses, dtype=wp.vec4, device=device),
            world=wp.array(shown, dtype=wp.int32, device=device),
            background=wp.array([background], dtype=wp.vec3, device=device),
        )


SHARED_BY_VIEWS = ("background", "splat_gain")
"""Arrays of `ViewArrays` that may have one row for all views."""


def require_shapes(expected: Iterable[tuple[str, wp.array | None, tuple[int, ...] | None]], hint: str) -> None:
    """Raise a ConfigError that names the first array of another shape than expected; a shape of None is not asked."""
    for name, array, shape in expected:
        if shape is not None and (array is None or tuple(array.shape) != tuple(shape)):
            given = "None" if array is None else str(tuple(array.shape))
            raise ConfigError(f"{name} has shape {given}, expected {tuple(shape)}", hint=hint)


class SplatRasterizer:
    """Draws splats into images of one size for a fixed number of views.

    All buffers are allocated once. `render` launches a fixed sequence and reads nothing back, so it can be captured
    with `wp.ScopedCapture` on CPU and CUDA; run it once before capturing so that its kernels are compiled. Outputs,
    overwritten by every frame:

    - `rgb`: vec3, shape (view_count, height, width).
    - `depth`: expected forward depth of what is seen, mesh included [m]; 0 where there is nothing.
    - `alpha`: coverage by splats.
    - `object_id`: object of the largest weight, -1 where there is none (only with `options.object_ids`).
    - `median_depth`: forward depth of the splat, or of the mesh behind them, at which less than half of the light is
      left [m]; 0 where more gets through (only with `options.median_depth`).

    Args:
        splat_count: Number of splats per world, all objects together.
        view_count: Number of views (worlds x cameras).
        width: Image width [px].
        height: Image height [px].
        options: How splats are drawn.
        device: Warp device.

    Raises:
        ConfigError: If a size is out of range.
    """

    def __init__(
        self,
        splat_count: int,
        view_count: int,
        width: int,
        height: int,
        *,
        options: RasterizerOptions | None = None,
        device: str | wp.Device | None = None,
    ) -> None:
        """Allocate the buffers."""
        self.options = options if options is not None else RasterizerOptions()
        self.device = wp.get_device(device)
        self.tile_count = (-(-width // kernels.TILE), -(-height // kernels.TILE))
        self.splat_count, self.view_count, self.width, self.height = splat_count, view_count, width, height
        total = splat_count * view_count
        tiles = self.tile_count[0] * self.tile_count[1] * view_count
        words = -(-splat_count // 32)
        if not (0 < width <= MAX_EDGE and 0 < height <= MAX_EDGE):
            raise ConfigError(
                f"images of {width} x {height} px, expected 1 to {MAX_EDGE} px on each side",
                hint="Draw parts of the image, each with the principal point of its own",
            )
        # Indices are of 32 bits: two sort entries per splat and view, 64 threads per tile.
        if not (
            0 < splat_count <= MAX_SPLATS
            and view_count > 0
            and total < 2**30
            and tiles < 2**25
            and tiles * words < 2**33
        ):
            raise ConfigError(
                f"{splat_count} splats in {view_count} views of {width} x {height} px are out of range",
                hint="Keep splats x views between 1 and 2^30, and pixels below 2^31; render fewer views or smaller "
                "images at a time",
            )
        allocate = functools.partial(wp.zeros, device=self.device)
        self._center = allocate(total, dtype=wp.vec4)
        self._shape = allocate(total, dtype=wp.vec4)
        self._color = allocate(total, dtype=wp.vec4)
        self._box = allocate(total, dtype=wp.vec4us)
        # The sort wants twice the entries as its workspace.
        self._depth_key = allocate(2 * total, dtype=wp.int32)
        self._order = allocate(2 * total, dtype=wp.int32)
        starts = np.arange(0, total + 1, splat_count, dtype=np.int32)
        self._view_start = wp.array(starts, dtype=wp.int32, device=self.device)
        self._cover = allocate((tiles, words), dtype=wp.uint32)
        shape = (view_count, height, width)
        self.rgb = allocate(shape, dtype=wp.vec3)
        self.depth = allocate(shape, dtype=wp.float32)
        self.alpha = allocate(shape, dtype=wp.float32)
        self.object_id = allocate(shape if self.options.object_ids else (1, 1, 1), dtype=wp.int32)
        self.median_depth = allocate(shape if self.options.median_depth else (1, 1, 1), dtype=wp.float32)
        self.frame: object = None
        """Stands for the frame that `render` drew last; replays of a captured graph leave it as it is."""
        self._no_gain = wp.ones(1, dtype=wp.vec4, device=self.device)

    def render(
        self,
        splats: SplatArrays,
        views: ViewArrays,
        *,
        mesh_rgb: wp.array | None = None,
        mesh_depth: wp.array | None = None,
    ) -> None:
        """Draw one frame of all views into the output arrays.

        Args:
            splats: The splats of all worlds.
            views: The cameras.
            mesh_rgb: Colours of opaque meshes and of the sky around them, vec3, shape (view_count, height, width);
                replaces the background of the views.
            mesh_depth: Forward depth of the meshes [m], 0 where there is none. A splat behind a mesh, by its centre, is
                not drawn.

        Raises:
            ConfigError: If only one of the mesh images is given, or an array has another shape than the buffers.
        """
        self._check_shapes(splats, views, mesh_rgb, mesh_depth)
        self.frame = object()
        self._project(splats, views)
        self._sort()
        self._cover_tiles()
        self._blend(splats, views, mesh_rgb, mesh_depth)

    def _check_shapes(
        self, splats: SplatArrays, views: ViewArrays, mesh_rgb: wp.array | None, mesh_depth: wp.array | None
    ) -> None:
        """Raise a ConfigError unless kernels find in every array what they will read."""
        count, coefficients = self.splat_count, splats.sh.shape[2]
        tails: dict[str, tuple[int, ...]] = dict.fromkeys(("means", "covariances", "opacities"), (count,))
        tails["sh"] = (count, next((k for k in (1, 4, 9, 16) if k >= coefficients), 16))
        if coefficients > 1:
            tails["rotations"] = (count,)
        worlds = max(getattr(splats, name).shape[0] for name in tails)
        images = None if mesh_rgb is None and mesh_depth is None else (self.view_count, self.height, self.width)

        def rows(array: wp.array, count: int) -> int:
            return 1 if array.shape[0] == 1 else count

        expected: list[tuple[str, wp.array | None, tuple[int, ...] | None]] = []
        for name, tail in tails.items():
            array = getattr(splats, name)
            expected.append((f"splats.{name}", array, (rows(array, worlds), *tail)))
        expected.append(("splats.object_index", splats.object_index, (count,)))
        for name, array in vars(views).items():
            if array is not None:
                shared = name in SHARED_BY_VIEWS
                expected.append(
                    (f"views.{name}", array, (rows(array, self.view_count) if shared else self.view_count,))
                )
        expected += [("mesh_rgb", mesh_rgb, images), ("mesh_depth", mesh_depth, images)]
        require_shapes(
            expected, "Size the rasteriser for these arrays; arrays have one row, or one for every world or view"
        )

    def _project(self, splats: SplatArrays, views: ViewArrays) -> None:
        options = self.options
        launch(
            self.device, kernels.project, self.view_count * self.splat_count, *self._projected(splats, views),
            wp.vec2i(self.width, self.height), options.near, options.pixel_variance, options.antialiased,
            self._center, self._shape, self._color, self._box, self._depth_key, self._order,
        )  # fmt: skip

    def _projected(self, splats: SplatArrays, views: ViewArrays) -> tuple[wp.array, ...]:
        """Return the splats and views as the projection and its adjoint take them."""
        gain = self._no_gain if views.splat_gain is None else views.splat_gain
        moved = (splats.means, splats.covariances, splats.opacities, splats.sh, splats.rotations)
        return (*moved, views.world_to_camera, views.intrinsics, views.world, gain)

    def _sort(self) -> None:
        total, count, block_dim = self.splat_count * self.view_count, self.splat_count, depth_sort_kernels.BLOCK_DIM
        if self.device.is_cuda and count <= depth_sort_kernels.CAPACITY:
            sort, keys = depth_sort_kernels.sort_kernel(-(-count // block_dim)), (self._depth_key, count, self._order)
            launch(self.device, sort, (self.view_count, block_dim), *keys, block_dim=block_dim)
        elif self.view_count == 1:
            wp.utils.radix_sort_pairs(self._depth_key, self._order, total, end_bit=31)
        else:
            wp.utils.segmented_sort_pairs(self._depth_key, self._order, total, self._view_start)

    def _cover_tiles(self) -> None:
        tiles, given = self.tile_count[0] * self.tile_count[1], (self._order, self._box, self.splat_count)
        words = cover_cuda_kernels.words_per_block(tiles) if self.device.is_cuda else 0
        if words:
            cover, block_dim = cover_cuda_kernels.cover_kernel(tiles, words), cover_cuda_kernels.BLOCK_DIM
            dim = self.view_count * -(-self._cover.shape[1] // words) * block_dim
            launch(self.device, cover, dim, *given, self.tile_count[0], self._cover, block_dim=block_dim)
            return
        self._cover.zero_()
        dim, tile_count = self.view_count * self.splat_count, wp.vec2i(*self.tile_count)
        launch(self.device, kernels.cover_tiles, dim, *given, tile_count, self._cover)

    def _blend(
        self, splats: SplatArrays, views: ViewArrays, mesh_rgb: wp.array | None, mesh_depth: wp.array | None
    ) -> None:
        options = self.options
        variant = (mesh_depth is not None, options.object_ids, options.median_depth)
        blend = blend_cpu_kernels if self.device.is_cpu else blend_cuda_kernels
        dim, block_dim = self._cover.shape[0] * blend.TILE_THREADS, blend_cuda_kernels.BLOCK_DIM
        read = (self._frame(views, mesh_rgb, mesh_depth), splats.object_index)
        images = (self.rgb, self.depth, self.alpha, self.object_id, self.median_depth)
        launch(self.device, blend.blend_kernel(*variant), dim, *read, *images, block_dim=block_dim)

    def _frame(self, views: ViewArrays, mesh_rgb: wp.array | None, mesh_depth: wp.array | None) -> Any:
        """Return the `Frame` that a blend reads."""
        frame = kernels.Frame()
        frame.order, frame.cover = self._order, self._cover
        frame.center, frame.shape, frame.color = self._center, self._shape, self._color
        frame.background = views.background
        frame.mesh_rgb, frame.mesh_depth = mesh_rgb, mesh_depth
        frame.splat_count = self.splat_count
        frame.size = wp.vec2i(self.width, self.height)
        frame.tile_count = wp.vec2i(*self.tile_count)
        return frame
