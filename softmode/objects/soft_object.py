"""Soft objects for scenes: splats to look at, with the reduced body that moves them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree, QhullError

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.cache import cached_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_splats
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.build.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.skinning.skin_splats import average_basis
from softmode.errors import AssetError, ConfigError
from softmode.objects.mesh_file import read_mesh
from softmode.objects.object_file import read_object, surface_cover
from softmode.objects.primitives import (
    Color,
    Extents,
    find_axis,
    primitive_mesh,
    primitive_quadrature,
    surface_splats,
    turned,
)
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.components import split_components
from softmode.splats.formats import read_splats
from softmode.splats.plush import make_plush
from softmode.splats.point_cloud import is_point_cloud, read_points
from softmode.splats.splats import Splats, UpAxis, up_rotation
from softmode.stages import tokens

Shape = Literal["plush", "box", "cylinder", "capsule", "sphere"]
Part = Literal["thickest", "tallest", "largest", "all"]
Pose = Literal["stable", "captured"]

RECIPE = 4
"""Part of the cache key; raise it when the way from a file or shape to a body changes."""
DEFAULT_COLORS: tuple[Color, Color] = ((0.93, 0.55, 0.22), (0.97, 0.90, 0.76))
"""Colours of a shape that is given none."""
STABLE_TILT = 0.1
"""A pose is stable if tilting the object by this angle [rad] in any direction raises its centre of mass."""


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """Which soft object, how large, how finely reduced: the built-in plush, a shape, a file, or a body as it is."""

    shape: Shape = "plush"
    """What it is where neither `splat` nor `mesh` is given: "plush", or a "box", "cylinder", "capsule" or "sphere" of
    `extents`."""
    extents: Extents | None = None
    """Edges of a shape's bounding box along x, y and z [m]. A round shape needs two that are equal, a sphere three; a
    capsule lies along the third, its longest, a cylinder along the third, its length or the thickness of a disc."""
    splat: str | Path | None = None
    """Splat file (.ply, SOG v2, .spz, .splat, OpenUSD), or a point cloud (.npz, see `read_points`, or .ply)."""
    mesh: str | Path | None = None
    """Mesh file (.obj, .glb, .stl, ... whatever trimesh reads, OpenUSD). One that is not closed stands for what it
    encloses."""
    body: str | Path | None = None
    """File of a body (`softmode body build`, `ReducedBody.save`, or a stage with one from `usd.write_usd`): taken as it
    is, with its own size, pose, surface samples, regions and splats."""
    size: float = 0.08
    """Longest edge of the bounding box of plush, splat file or mesh, upright [m]; the gripper opens 0.09 m."""
    colors: tuple[Color, Color] | None = None
    """Two colours, 0..1, of a shape or mesh, as a checker pattern; None for orange and cream, or the mesh's own."""
    splat_count: int = 2000
    """Number of splats on a shape or mesh."""
    surface_count: int = 400
    """Number of surface samples, the points that feel contact."""
    up: UpAxis | None = None
    """Axis of the file that points up; None for "-y" (splat files: trained captures mostly have y down), "+y" (glTF) or
    "+z" (OpenUSD, which is read with z up, point clouds, and other meshes)."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box (x0, y0, z0, x1, y1, z1) of the splat file, after turning it up, outside which splats are dropped; cuts an
    object off what it touched when it was captured."""
    part: Part = "thickest"
    """Which of the separate parts of a splat file is the object: the one with the largest least spread, so that neither
    the ground it was captured on, wide but thin, nor loose small parts win; the one with the greatest height; the one
    with most splats; or whatever there is."""
    pose: Pose = "stable"
    """"stable" lays an object from a file that cannot stand as it is there (on a pointed foot, say) on the side that
    needs the least turn; "captured" lets it topple."""
    contact_radius: float = 0.0
    """How far the surface that touches stands out from the body's [m]. Samples are points: one or two millimetres keep
    an edge that presses between them from catching on them."""
    clamped_height: float = 0.0
    """Height of the foot that is fixed to the table [m], 0 for an object that stands free. A clamped object keeps its
    scale."""
    build: BuildOptions = field(default_factory=BuildOptions)
    """How the body is reduced."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0.005 <= self.size <= 1.0:
            raise ConfigError(f"size must lie in 0.005..1 m, got {self.size!r}", hint="give the longest edge in metres")
        for name in ("contact_radius", "clamped_height"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"{name} must be a finite length >= 0 [m], got {getattr(self, name)!r}")
        if self.crop is not None and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise ConfigError(f"crop {self.crop} is empty", hint="give x0 y0 z0 x1 y1 z1 with every 0 below its 1")
        for name, known in (("shape", Shape), ("up", UpAxis), ("part", Part), ("pose", Pose)):
            if getattr(self, name) not in (*get_args(known), *((None,) if name == "up" else ())):
                raise ConfigError(
                    f"{name} is {getattr(self, name)!r}", hint=f"use one of {', '.join(map(repr, get_args(known)))}"
                )
        for name, low in (("splat_count", 100), ("surface_count", 16)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name} must be at least {low}, got {getattr(self, name)!r}")
        files = (self.splat, self.mesh, self.body)
        if sum(file is not None for file in files) + (self.shape != "plush") > 1:
            raise ConfigError(
                f"shape {self.shape!r}, splat {self.splat!r}, mesh {self.mesh!r} and body {self.body!r} exclude each"
                " other",
                hint="give one of them",
            )
        if self.body is not None and self.clamped_height > 0.0:
            raise ConfigError(
                f"clamped_height is {self.clamped_height} m for a body that is built",
                hint="build it with a region for its foot: softmode body build FILE --region foot=...",
            )
        self._check_extents()
        if self.colors is not None:
            if self.shape == "plush" and self.mesh is None:
                raise ConfigError("colors are for shapes and meshes", hint="leave them out; splats have their own")
            if np.shape(self.colors) != (2, 3) or not all(0.0 <= x <= 1.0 for color in self.colors for x in color):
                raise ConfigError(f"colors {self.colors} are not two colours", hint="give two of (r, g, b) in 0..1")

    def _check_extents(self) -> None:
        """Check that a shape has extents that fit it, and nothing else has any."""
        if (self.extents is None) != (self.shape == "plush"):
            raise ConfigError(
                f"shape {self.shape!r} with extents {self.extents}",
                hint="give a box, cylinder, capsule or sphere three lengths in metres, and anything else a size",
            )
        if self.extents is None or self.shape == "plush":
            return
        if len(self.extents) != 3 or not all(1.0e-3 <= x <= 2.0 for x in self.extents):
            raise ConfigError(f"extents must be three lengths in 0.001..2 m, got {self.extents!r}")
        if find_axis(self.shape, self.extents) is None:
            raise ConfigError(
                f"extents {self.extents} are not those of a {self.shape}",
                hint="give a sphere three equal lengths, a cylinder two, a capsule two and a third not below them",
            )


@dataclass(frozen=True)
class SoftObject:
    """A body and its splats in the body frame."""

    body: ReducedBody
    """The reduced body."""
    splats: Splats
    """Splats with centres in the body frame [m]."""
    basis: NDArray[np.float64]
    """Functions averaged over each splat, shape (N, n), by
    :func:`softmode.deformables.skinning.skin_splats.average_basis`."""
    grad_basis: NDArray[np.float64]
    """Their gradients, averaged likewise [1/m], shape (N, n, 3)."""
    height: float
    """Height of the body frame's origin over the table at rest [m]: over the lowest surface sample, and the contact
    radius of an object that is not clamped."""


def load_object(config: ObjectConfig, progress: Callable[[str, float], None] | bool | None = None) -> SoftObject:
    """Read or make the splats, build or recall the body, and tie them together.

    Args:
        config: Which object.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
    """
    if config.body is not None:
        body, shown = read_object(config.body)
        shown = surface_cover(body) if shown is None else shown
        return tied(body, shown, 0.0 if body.driven_count else config.contact_radius)
    splats, solid, name, key = object_source(config)

    def build() -> ReducedBody:
        quadrature, turn = standing_quadrature(config, solid, splats.name)
        regions = ()
        if config.clamped_height > 0.0:
            wide = float("inf")
            top = float(quadrature.bounds[0, 2]) + config.clamped_height
            regions = (Region(name="foot", box=((-wide,) * 3, (wide, wide, top))),)
        body = build_body(quadrature, config.build, name=name, regions=regions, progress=progress)
        return replace(body, provenance={**body.provenance, "turn": json.dumps(turn.tolist())})

    clamp = (config.clamped_height,) if config.clamped_height > 0.0 else ()
    body = cached_body((RECIPE, *key, _may_turn(config), config.surface_count, config.build, *clamp), build)
    turn = np.array(json.loads(str(body.provenance["turn"])))
    return tied(body, shown_splats(splats, body, turn), 0.0 if clamp else config.contact_radius)


def standing_quadrature(
    config: ObjectConfig, solid: Callable[[], Quadrature], name: str
) -> tuple[Quadrature, NDArray[np.float64]]:
    """Integrate an object and lay it on a stable side if its pose is to be stable.

    Args:
        config: Which object.
        solid: Integrates it; see `object_source`.
        name: What messages call it.

    Returns:
        The quadrature, and the rotation that was applied, shape (3, 3).

    Raises:
        AssetError: If it encloses no volume.
    """
    try:
        quadrature = solid()
    except AssetError as error:
        raise AssetError(f"{name}: {error.message}", hint=error.hint) from error
    turn = None
    if _may_turn(config):
        centre = quadrature.weights @ quadrature.points / quadrature.volume
        turn = stable_rotation(quadrature.surface_points - centre)
    return (quadrature, np.eye(3)) if turn is None else (turned(quadrature, turn), turn)


def _may_turn(config: ObjectConfig) -> bool:
    """Return whether an object is laid on a stable side if it has to be."""
    return config.pose == "stable" and (config.splat is not None or config.mesh is not None)


def shown_splats(splats: Splats, body: ReducedBody, turn: NDArray[np.float64]) -> Splats:
    """Return the splats that show a body, turned (3, 3) as it was, in its frame, without floaters far from it."""
    if not np.array_equal(turn, np.eye(3)):
        splats = splats.transformed(rotation=turn)
    return splats.subset(_drawn(splats, body)).transformed(translation=-body.offset)


def tied(body: ReducedBody, shown: Splats, contact_radius: float = 0.0) -> SoftObject:
    """Tie splats in the body frame to the functions that move them.

    Args:
        body: The body.
        shown: Its splats.
        contact_radius: How far the surface that touches stands out below the body's [m].
    """
    basis, grad_basis = average_basis(lambda x: body.evaluate(x)[0], shown.means, shown.covariances())
    return SoftObject(body, shown, basis, grad_basis, float(-body.surface_points[:, 2].min()) + contact_radius)


def choose_part(splats: Splats, rule: Part) -> Splats:
    """Return the part of a capture that is the object, by the rule of `ObjectConfig.part`; all if nothing connects."""
    if rule == "all":
        return splats
    # The wider of a fraction of the capture and what its own pitch calls for: a small file of one object is sparse. Of
    # points strewn at random on a surface, n exp(-5.7 f^2) have no neighbour within f median sixth distances.
    low, high = splats.bounds(quantile=0.01)
    pitch = 1.5 * np.median(KDTree(splats.means).query(splats.means, k=min(7, splats.count))[0][:, -1])
    parts = split_components(splats, gap=max(0.015 * float(np.linalg.norm(high - low)), float(pitch), 1.0e-9))
    if not parts:
        return splats
    if rule == "largest":
        return parts[0]
    if rule == "tallest":
        return max(parts, key=lambda part: float(np.ptp(part.bounds(quantile=0.005)[:, 2])))
    return max(parts, key=lambda part: float(np.linalg.eigvalsh(np.cov(part.means.astype(np.float64).T))[0]))


def stable_rotation(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the least rotation after which an object stands stably, None if it does so already or never does.

    The height of the centre of mass above a plane with outward normal n below the object is h(n) = max_i n . X_i. The
    object rests on a face of its convex hull, and does so stably if h grows when n is tilted.

    Args:
        points: Surface samples relative to the centre of mass [m], shape (S, 3).
    """
    try:
        equations = ConvexHull(points).equations
    except QhullError:
        return None
    down = np.array([[0.0, 0.0, -1.0]])
    candidates = np.concatenate([down, equations[:, :3]])
    height = (candidates @ points.T).max(axis=1)
    side = np.cross(candidates, np.where(np.abs(candidates[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(candidates, side)
    stable = np.ones(len(candidates), bool)
    for azimuth in np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False):
        tilted = np.cos(STABLE_TILT) * candidates + np.sin(STABLE_TILT) * (
            np.cos(azimuth) * side + np.sin(azimuth) * other
        )
        stable &= (tilted @ points.T).max(axis=1) > height
    if stable[0] or not stable.any():
        return None
    normal = candidates[stable][(candidates[stable] @ down[0]).argmax()]
    axis, cosine = np.cross(normal, down[0]), float(normal @ down[0])
    if np.linalg.norm(axis) < 1e-9:  # upside down: any horizontal axis will do
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


_Source = tuple[Splats, Callable[[], Quadrature], str, tuple[Any, ...]]
"""Splats, how their solid is integrated, its name, and what it depends on beside the configuration."""


def object_source(config: ObjectConfig, cropped: Splats | None = None) -> _Source:
    """Return what an object is made of, before it is turned to a stable pose.

    Args:
        config: Which object.
        cropped: What `read_cropped` gives for its splat file, if that has been read already.

    Raises:
        AssetError: If a file cannot be read.
    """
    count = config.surface_count
    if config.mesh is not None:
        mesh = _read_mesh(config)
        splats = surface_splats(mesh, config.splat_count, config.colors)
        return splats, lambda: _mesh_solid(mesh, count), Path(config.mesh).name, ("mesh", mesh.corners)
    if config.shape != "plush" and config.extents is not None:
        shape, extents = config.shape, config.extents
        mesh = ColoredMesh.from_trimesh(primitive_mesh(shape, extents), name=shape)
        splats = surface_splats(mesh, config.splat_count, config.colors or DEFAULT_COLORS)
        return splats, lambda: primitive_quadrature(shape, extents, count), shape, (shape, extents)
    splats = _read_splats(config, cropped)
    name = "plush"
    if config.splat is not None:
        file = Path(config.splat).resolve()
        name = file.parent.name if file.name == "meta.json" else file.name
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities)
    return splats, lambda: quadrature_from_splats(*arrays, surface_count=count), name, ("splats", *arrays)


def _read_mesh(config: ObjectConfig) -> ColoredMesh:
    """Return the mesh upright, standing on z = 0 around the origin, scaled to the wanted size."""
    mesh = read_mesh(str(config.mesh))
    gltf = Path(str(config.mesh)).suffix.lower() in (".glb", ".gltf")
    corners = mesh.corners.astype(np.float64) @ up_rotation(config.up or ("+y" if gltf else "+z")).T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    return replace(mesh, corners=((corners - centre) * (config.size / (high - low).max())).astype(np.float32))


def _mesh_solid(mesh: ColoredMesh, surface_count: int) -> Quadrature:
    """Integrate a mesh or, if it is not closed, what a dense cover of splats encloses."""
    corners = mesh.corners.astype(np.float64).reshape(-1, 3)
    try:
        return quadrature_from_mesh(corners, np.arange(len(corners)).reshape(-1, 3), surface_count=surface_count)
    except AssetError:
        cover = surface_splats(mesh, 8000)
        return quadrature_from_splats(
            cover.means, cover.scales, cover.quats, cover.opacities, surface_count=surface_count
        )


def _read_splats(config: ObjectConfig, cropped: Splats | None = None) -> Splats:
    """Return the splats upright, standing on z = 0 around the origin, scaled to the wanted size."""
    if config.splat is None:
        splats = make_plush()
    else:
        splats = choose_part(read_cropped(config) if cropped is None else cropped, config.part)
    low, high = splats.bounds(quantile=0.0 if config.splat is None else 0.002)
    extent = float((high - low).max())
    if not extent > 0.0:
        raise AssetError(f"{splats.name}: all splats lie at one point", hint="export the asset again")
    scale = config.size / extent
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    return splats.transformed(translation=-scale * centre, scale=scale)


def read_cropped(config: ObjectConfig) -> Splats:
    """Read the splat file or point cloud of a configuration, turn it upright and crop it.

    Raises:
        AssetError: If it cannot be read, or the crop leaves nothing.
    """
    file = Path(str(config.splat))
    if is_point_cloud(file):
        splats, up = read_points(file), "+z"
    else:
        splats, up = read_splats(file), "+z" if file.suffix.lower() in tokens.SUFFIXES else "-y"
    splats = splats.oriented(config.up or up)
    if config.crop is None:
        return splats
    inside = (splats.means >= config.crop[:3]).all(axis=1) & (splats.means <= config.crop[3:]).all(axis=1)
    if not inside.any():
        low, high = np.round(splats.bounds(), 3).tolist()
        raise AssetError(
            f"{splats.name}: no splat lies inside crop {config.crop}",
            hint=f"the splats fill {low} to {high} once turned up",
        )
    return splats.subset(inside)


def _drawn(splats: Splats, body: ReducedBody) -> NDArray[np.bool_]:
    """Keep the splats within an eighth of the body's size of its bounding box: the rest are floaters of the capture."""
    low, high = body.bounds + body.offset
    margin = 0.125 * np.linalg.norm(high - low)
    return ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
