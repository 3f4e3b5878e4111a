"""What an object is made of: its splats upright at its size, and how its solid is integrated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import getsource
from pathlib import Path
from typing import Any, get_args

import numpy as np

from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.deformables.quadrature.quadrature_density import quadrature_from_density
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import cap_holes, quadrature_from_mesh
from softmode.deformables.reduction.cache import cached
from softmode.errors import AssetError, ConfigError
from softmode.files import read_archive, write_archive
from softmode.foreign import tokens
from softmode.objects.carriers import SURE
from softmode.objects.config import SIZE, ObjectConfig
from softmode.objects.mesh_file import read_mesh
from softmode.objects.parts import choose_part
from softmode.objects.pose import seat_of
from softmode.objects.shapes.presets import preset_mesh
from softmode.objects.shapes.primitives import (
    Color,
    Extents,
    Primitive,
    primitive_mesh,
    primitive_quadrature,
    surface_splats,
)
from softmode.radiance.bake import splats_from_radiance
from softmode.radiance.formats import read_radiance
from softmode.radiance.grid import RadianceGrid
from softmode.splats import plush
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.formats import read_splats
from softmode.splats.formats.common import offset_note
from softmode.splats.point_cloud import is_point_cloud, read_points
from softmode.splats.splats import Splats, up_rotation
from softmode.stages import stage

DEFAULT_COLORS: tuple[Color, Color] = ((0.93, 0.55, 0.22), (0.97, 0.90, 0.76))
"""Colours of a shape that is given none."""


SPLATS, PRESET_SPLATS = 2000, 6000
"""Splats on a shape or mesh and on a preset, with its finer colours."""


@dataclass(frozen=True)
class ObjectSource:
    """What an object is made of, before it is turned to a stable pose."""

    splats: Splats
    """What shows it, upright, standing on z = 0 around the origin, at its size [m] or near it."""
    integrate: Callable[..., Quadrature]
    """Integrates its solid; takes another ``surface_count`` than the configuration's."""
    name: str
    """Name of its body."""
    key: tuple[object, ...]
    """What the body depends on beside the configuration."""
    asset_splats: int
    """Number of splats of its file, once cropped, before one part of them was chosen."""
    fill_size: float | None = None
    """Longest edge to which its solid is scaled, since a fill may hold more or less than its splats [m]."""
    radiance: RadianceGrid | None = None
    """Its radiance field, where the splats are."""
    field_pose: np.ndarray | None = None
    """What takes places of that field's file there, shape (4, 4)."""
    capture: dict[str, str | int | float] = field(default_factory=dict)
    """What was found in its file beside it, for the report."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was taken off the coordinates of its file, which are too far out for float32 [m]."""
    notes: tuple[str, ...] = ()
    """What was read from its file in another way than it was meant."""


def object_source(config: ObjectConfig) -> ObjectSource:
    """Return what an object is made of.

    Raises:
        AssetError: If a file cannot be read.
        ConfigError: If it is a body, which is made already.
    """
    return _READERS[config.kind](config, getattr(config, config.kind, config.extents))


def pose_of(linear: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) of a linear map (3, 3) and a move (3,)."""
    return np.block([[linear, move[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def upright_field(config: ObjectConfig, given: str | Path | RadianceGrid) -> tuple[RadianceGrid, np.ndarray]:
    """Return a field upright, cropped, standing on z = 0 around the origin, at its size, and what took it there."""
    grid = given if isinstance(given, RadianceGrid) else read_radiance(given)
    up = config.up or "+z"
    grid = grid.oriented(up)
    if config.crop is not None:
        grid = grid.cropped(config.crop[:3], config.crop[3:])
    extent = float(np.ptp(grid.bounds, axis=0).max())
    scale = config.size / extent if config.size is not None else grid.metres or SIZE / extent
    move = -scale * seat_of(grid.bounds)
    pose = pose_of(scale * up_rotation(up), move)
    return grid.transformed(translation=move, scale=scale), pose


def baked_splats(key: tuple[object, ...], grid: RadianceGrid, count: int) -> Splats:
    """Return the splats baked of a field, from the cache if they are there."""
    return _cached_splats(key, grid.name, lambda: splats_from_radiance(grid, count=count).splats)


def _cached_splats(key: tuple[object, ...], name: str, make: Callable[[], Splats]) -> Splats:
    """Return splats from the cache, or make them if they are not there."""
    fields = ("means", "quats", "scales", "opacities", "sh")

    def read(path: Path) -> Splats:
        arrays: dict[str, Any] = read_archive(path, "softmode.baked", 1)[1]
        return Splats(**arrays, name=name)

    def write(splats: Splats, path: Path) -> None:
        write_archive(
            path, {"format": "softmode.baked", "version": 1}, {name: getattr(splats, name) for name in fields}
        )

    return cached("baked", key, make, read, write)


def _upright_mesh(config: ObjectConfig, given: str | Path | ColoredMesh) -> ColoredMesh:
    """Return the mesh upright, standing on z = 0 around the origin, scaled to the wanted size."""
    up = "+z"
    if isinstance(given, ColoredMesh):
        mesh = given
    else:
        mesh = read_mesh(given)
        up = "+y" if Path(given).suffix.lower() in (".glb", ".gltf") else up
    turn = up_rotation(config.up or up)
    corners = mesh.corners.astype(np.float64) @ turn.T
    bounds = np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    scale = 1.0 if config.longest_edge is None else config.longest_edge / np.ptp(bounds, axis=0).max()
    x, y, z = (turn @ mesh.offset).tolist()
    return replace(mesh, corners=((corners - seat_of(bounds)) * scale).astype(np.float32), offset=(x, y, z))


def _preset_source(config: ObjectConfig, name: str) -> ObjectSource:
    """Make the mesh of a preset."""
    return _mesh_source(config, preset_mesh(name), PRESET_SPLATS)


def _mesh_source(config: ObjectConfig, given: str | Path | ColoredMesh, splat_count: int = SPLATS) -> ObjectSource:
    """Read a mesh."""
    mesh = _upright_mesh(config, given)
    splats = surface_splats(mesh, config.splat_count or splat_count, config.colors)
    name = mesh.name if isinstance(given, ColoredMesh) else Path(given).name
    solid = partial(_mesh_solid, mesh, surface_count=config.surface_count)
    key, notes = ("mesh, holes capped", mesh.corners), (*mesh.notes, *offset_note(mesh.offset))
    return ObjectSource(splats, solid, name, key, splats.count, offset=mesh.offset, notes=notes)


def _field_source(config: ObjectConfig, given: str | Path | RadianceGrid) -> ObjectSource:
    """Read a radiance field, and bake it into splats."""
    (grid, pose), splat_count = upright_field(config, given), config.splat_count or SPLATS
    key = ("radiance", *(getattr(grid, name) for name in ("density", "sh", "origin", "axes")))
    baked = baked_splats((*key, splat_count), grid, splat_count)
    options = {} if config.resolution is None else {"resolution": config.resolution}
    solid = partial(
        quadrature_from_density, grid.densities, grid.surroundings, surface_count=config.surface_count, **options
    )
    fitted = config.size if config.size is not None or grid.metres else SIZE
    doubt: dict[str, str | int | float] = {"contradicted": grid.contradicted or 0.0, "allowed": grid.allowed or 0.0}
    made = ("depth", *key, *doubt.values(), config.resolution)
    return ObjectSource(baked, solid, grid.name, made, baked.count, fitted, grid, pose, capture=doubt)


def _shape_source(shape: Primitive, config: ObjectConfig, extents: Extents) -> ObjectSource:
    """Make a box, cylinder, capsule or sphere."""
    mesh = ColoredMesh.from_trimesh(primitive_mesh(shape, extents), name=shape)
    splats = surface_splats(mesh, config.splat_count or SPLATS, config.colors or DEFAULT_COLORS)
    solid = partial(primitive_quadrature, shape, extents, surface_count=config.surface_count)
    return ObjectSource(splats, solid, shape, (shape, extents), splats.count)


def _splat_source(config: ObjectConfig, given: str | Path | Splats | None) -> ObjectSource:
    """Read splats or a point cloud; None makes the plush."""
    splats, told, capture, name = _upright_splats(config, given)
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities)
    solid = partial(quadrature_from_splats, *arrays, surface_count=config.surface_count, resolution=config.resolution)
    key = ("splats, shown", *arrays, config.resolution)
    count = int(capture["asset_splats"])
    size, offset, notes = config.longest_edge, told.offset, told.notes
    return ObjectSource(splats, solid, name, key, count, size, capture=capture, offset=offset, notes=notes)


def _body_source(config: ObjectConfig, given: str | Path) -> ObjectSource:
    """Refuse what is built."""
    raise ConfigError(f"{given} is a body already", hint="give the file that it was built from")


def _mesh_solid(mesh: ColoredMesh, surface_count: int) -> Quadrature:
    """Integrate a mesh, its holes capped; if that leaves no closed surface, what a dense cover of splats encloses."""
    corners = mesh.corners.astype(np.float64).reshape(-1, 3)
    try:
        vertices, faces, holes = cap_holes(corners, np.arange(len(corners)).reshape(-1, 3))
        found = quadrature_from_mesh(vertices, faces, surface_count=surface_count)
        return replace(found, report={**found.report, "capped_holes": holes})
    except AssetError:
        cover = surface_splats(mesh, 8000)
        return quadrature_from_splats(
            cover.means, cover.scales, cover.quats, cover.opacities, surface_count=surface_count
        )


def _upright_splats(
    config: ObjectConfig, source: str | Path | Splats | None
) -> tuple[Splats, Splats, dict[str, str | int | float], str]:
    """Return the object's splats upright, standing on z = 0, scaled; those of the file; what else there was; a name."""
    capture: dict[str, str | int | float] = {}
    if source is None:
        splats = cropped = _cached_splats(("plush", getsource(plush)), "plush", plush.make_plush)
        name, stray, given = "plush", 0.0, splats.count
    else:
        cropped, name = _cropped_splats(config, source)
        with stage("finding the object in the capture"):
            choice = choose_part(cropped, config.part)
        splats, stray, given, capture = choice.part, 0.002, cropped.count, dict(choice.told)
        if float(choice.told.get("arm", 0.0)) > SURE:
            raise AssetError(f"{name}: {choice.told['doubt']}", hint=str(choice.told["doubt_remedy"]))
    bounds = splats.bounds(quantile=stray)
    extent = float(np.ptp(bounds, axis=0).max())
    if not extent > 0.0:
        raise AssetError(f"{splats.name}: all splats lie at one point", hint="export the asset again")
    scale = (config.longest_edge or extent) / extent
    capture["asset_splats"] = given
    return splats.transformed(translation=-scale * seat_of(bounds), scale=scale), cropped, capture, name


def _cropped_splats(config: ObjectConfig, given: str | Path | Splats) -> tuple[Splats, str]:
    """Read splats or a point cloud, turn them upright and crop them; return them with the name of the object."""
    up = "+z"
    if isinstance(given, Splats):
        splats, name = given, given.name
    else:
        file = Path(given)
        if is_point_cloud(file):
            splats = read_points(file)
        else:
            splats, up = read_splats(file), "+z" if file.suffix.lower() in tokens.SUFFIXES else "-y"
        whole = file.resolve()
        name = whole.parent.name if whole.name == "meta.json" else whole.name
    splats = splats.oriented(config.up or up)
    if config.crop is None:
        return splats, name
    near = np.asarray(config.crop).reshape(2, 3) - splats.offset
    inside = (splats.means >= near[0]).all(axis=1) & (splats.means <= near[1]).all(axis=1)
    if not inside.any():
        low, high = np.round(splats.bounds() + splats.offset, 3).tolist()
        hint = f"the splats fill {low} to {high} once turned up"
        raise AssetError(f"{splats.name}: no splat lies inside crop {config.crop}", hint=hint)
    return splats.subset(inside), name


_READERS: dict[str, Callable[[ObjectConfig, Any], ObjectSource]] = {
    **{shape: partial(_shape_source, shape) for shape in get_args(Primitive)},
    "plush": _splat_source,
    "preset": _preset_source,
    "splat": _splat_source,
    "mesh": _mesh_source,
    "radiance": _field_source,
    "body": _body_source,
}
"""What reads each kind of object; takes what the configuration gives of it, too."""
