"""What an object is made of: its splats upright at its size, and how its solid is integrated and laid down."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import getsource
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.cache import cached
from softmode.deformables.build.quadrature import quadrature_from_splats
from softmode.deformables.build.quadrature_density import quadrature_from_density
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.build.quadrature_mesh import cap_holes, quadrature_from_mesh
from softmode.errors import AssetError, ConfigError
from softmode.files import read_archive, write_archive
from softmode.objects.config import FILES, ObjectConfig
from softmode.objects.mesh_file import read_mesh
from softmode.objects.paint import color_field, read_field
from softmode.objects.parts import choose_part
from softmode.objects.pose import stable_rotation
from softmode.objects.presets import find_preset, preset_mesh
from softmode.objects.primitives import (
    Color,
    primitive_mesh,
    primitive_quadrature,
    scaled,
    surface_splats,
    turned,
)
from softmode.radiance.bake import splats_from_radiance
from softmode.radiance.formats import read_radiance
from softmode.radiance.grid import RadianceGrid
from softmode.splats import plush
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.formats import read_splats
from softmode.splats.point_cloud import is_point_cloud, read_points
from softmode.splats.splats import Splats, up_rotation
from softmode.stages import tokens

DEFAULT_COLORS: tuple[Color, Color] = ((0.93, 0.55, 0.22), (0.97, 0.90, 0.76))
"""Colours of a shape that is given none."""


SPLATS, PRESET_SPLATS = 2000, 6000
"""Splats on a shape or mesh and on a preset, with its finer colours."""
SIZE_TOLERANCE = 0.02
"""Relative error of the size of a fill that is left: bumps of that height lie on its surface."""


@dataclass(frozen=True)
class ObjectSource:
    """What an object is made of, before it is turned to a stable pose."""

    splats: Splats
    """What shows it, upright, standing on z = 0 around the origin, at its size [m] or near it."""
    integrate: Callable[[], Quadrature]
    """Integrates its solid."""
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
    capture: dict[str, str | int | float] = field(default_factory=dict)
    """What was found in its file beside it, for the report."""


def object_source(config: ObjectConfig) -> ObjectSource:
    """Return what an object is made of.

    Raises:
        AssetError: If a file cannot be read.
    """
    count, splat_count = config.surface_count, config.splat_count or (PRESET_SPLATS if config.preset else SPLATS)
    given = config.mesh if config.preset is None else preset_mesh(config.preset)
    if given is not None:
        mesh = _upright_mesh(config, given)
        splats = surface_splats(mesh, splat_count, config.colors)
        name = mesh.name if isinstance(given, ColoredMesh) else Path(given).name
        key = ("mesh, holes capped", mesh.corners)
        return ObjectSource(splats, partial(_mesh_solid, mesh, count), name, key, splats.count)
    if config.radiance is not None:
        grid = upright_field(config, config.radiance)
        key = ("radiance", *(getattr(grid, name) for name in ("density", "sh", "origin", "axes")))
        baked = baked_splats((*key, splat_count), grid, splat_count)
        box = grid.bounds + np.array([[-1.0], [1.0]]) * grid.spacing
        options = {} if config.resolution is None else {"resolution": config.resolution}
        solid = partial(quadrature_from_density, grid.densities, box, surface_count=count, **options)
        return ObjectSource(baked, solid, grid.name, (*key, config.resolution), baked.count, config.longest_edge, grid)
    if config.shape != "plush" and config.extents is not None:
        shape, extents = config.shape, config.extents
        mesh = ColoredMesh.from_trimesh(primitive_mesh(shape, extents), name=shape)
        splats = surface_splats(mesh, splat_count, config.colors or DEFAULT_COLORS)
        solid = partial(primitive_quadrature, shape, extents, count)
        return ObjectSource(splats, solid, shape, (shape, extents), splats.count)
    splats, capture, name = _upright_splats(config)
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities)
    solid = partial(quadrature_from_splats, *arrays, surface_count=count, resolution=config.resolution)
    key = ("splats", *arrays, config.resolution)
    return ObjectSource(splats, solid, name, key, int(capture["asset_splats"]), config.longest_edge, capture=capture)


def standing_quadrature(config: ObjectConfig, source: ObjectSource) -> tuple[Quadrature, NDArray[np.float64]]:
    """Integrate an object, bring it to its size, and lay it on a stable side if its pose is to be stable.

    Args:
        config: Which object.
        source: What it is made of.

    Returns:
        The quadrature, and the rotation times the factor that was applied, shape (3, 3).

    Raises:
        AssetError: If it encloses no volume.
    """
    try:
        quadrature = source.integrate()
    except AssetError as error:
        raise AssetError(f"{source.splats.name}: {error.message}", hint=error.hint) from error
    quadrature, factor = replace(quadrature, report={**quadrature.report, **source.capture}), 1.0
    if source.fill_size is not None:
        extent = float(np.ptp(quadrature.bounds, axis=0).max())
        if abs(extent / source.fill_size - 1.0) > SIZE_TOLERANCE:
            factor = source.fill_size / extent
            quadrature = scaled(quadrature, factor)
    turn = None
    if may_turn(config):
        centre = quadrature.weights @ quadrature.points / quadrature.volume
        turn = stable_rotation(quadrature.surface_points - centre)
    return (quadrature, factor * np.eye(3)) if turn is None else (turned(quadrature, turn), factor * turn)


def stiffness_scale(
    config: ObjectConfig, quadrature: Quadrature, source: ObjectSource, turn: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the relative stiffness per quadrature point of a standing object (P,), None if it is the same everywhere.

    Args:
        config: Which object.
        quadrature: Its solid.
        source: What it is made of.
        turn: How its solid was laid down and scaled, see :func:`standing_quadrature`.

    Raises:
        ConfigError: If a part of another stiffness holds no point, or no splat has the colour of one.
    """
    if not config.stiffness and not config.stiffness_colors and config.stiffness_file is None:
        return None
    low, high = quadrature.bounds
    points = quadrature.points - [*(0.5 * (low + high))[:2], low[2]]
    found = np.ones(len(points))
    for part in config.stiffness:
        inside = (points >= part.box[:3]).all(axis=1) & (points <= part.box[3:]).all(axis=1)
        if not inside.any():
            low, high = np.round([points.min(axis=0), points.max(axis=0)], 4).tolist()
            raise ConfigError(
                f"stiffness: box {part.box} holds no point of the object", hint=f"the object fills {low} to {high} m"
            )
        found[inside] = part.factor
    if config.stiffness_colors:
        found *= color_field(_laid_down(source.splats, turn), config.stiffness_colors)(quadrature.points)
    if config.stiffness_file is not None:
        found *= read_field(config.stiffness_file)(points)
    return found


def density_scale(
    config: ObjectConfig, quadrature: Quadrature, source: ObjectSource, turn: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the relative density per quadrature point of a standing object (P,), None if it is the same everywhere.

    Args:
        config: Which object.
        quadrature: Its solid.
        source: What it is made of.
        turn: As for :func:`stiffness_scale`.

    Raises:
        ConfigError: If no splat has the colour of a part.
        AssetError: If a file cannot be read.
    """
    if not config.density_colors and config.density_file is None:
        return None
    low, high = quadrature.bounds
    found = np.ones(len(quadrature.points))
    if config.density_colors:
        found *= color_field(_laid_down(source.splats, turn), config.density_colors)(quadrature.points)
    if config.density_file is not None:
        found *= read_field(config.density_file)(quadrature.points - [*(0.5 * (low + high))[:2], low[2]])
    return found


def with_origin(body: ReducedBody, config: ObjectConfig, source: ObjectSource, splats: Splats) -> ReducedBody:
    """Return a body whose provenance tells its asset, how many of its splats show it, and a preset's material."""
    kind = next((kind for kind in ("preset", *FILES) if getattr(config, kind) is not None), config.shape)
    left_out = source.asset_splats - splats.count
    told = {"asset": source.name, "asset_kind": kind, "asset_splats": source.asset_splats, "asset_left_out": left_out}
    if config.preset is not None:
        told["material"] = json.dumps(find_preset(config.preset).properties)
    return replace(body, provenance={**body.provenance, **told})


def may_turn(config: ObjectConfig) -> bool:
    """Return whether an object is laid on a stable side if it has to be."""
    kinds = ("preset", *FILES)
    return config.pose == "stable" and any(getattr(config, kind) is not None for kind in kinds)


def splats_of_body(splats: Splats, body: ReducedBody, turn: NDArray[np.float64]) -> Splats:
    """Return the splats of a source in the frame of the body built from it, without those far from it.

    What lies beyond an eighth of the body's size around its bounding box are floaters of the capture.

    Args:
        splats: Splats of the source, N.
        body: The body.
        turn: The rotation by which it was laid down times the factor that brought it to its size, shape (3, 3).
    """
    splats = _laid_down(splats, turn)
    low, high = body.bounds + body.offset
    margin = 0.125 * np.linalg.norm(high - low)
    near = ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
    return splats.subset(near).transformed(translation=-body.offset)


def field_of_body(source: ObjectSource, body: ReducedBody, turn: NDArray[np.float64]) -> RadianceGrid | None:
    """Return the radiance field of a source in the frame of the body built from it; None if it has none.

    Args:
        source: What the body was built from.
        body: The body.
        turn: As for `splats_of_body`.
    """
    if source.radiance is None:
        return None
    factor = float(np.cbrt(np.linalg.det(turn)))
    return source.radiance.transformed(turn / factor, -body.offset, factor)


def upright_field(config: ObjectConfig, given: str | Path | RadianceGrid) -> RadianceGrid:
    """Return a field upright, cropped, standing on z = 0 around the origin, at the wanted size."""
    grid = given if isinstance(given, RadianceGrid) else read_radiance(given)
    grid = grid.oriented(config.up or "+z")
    if config.crop is not None:
        grid = grid.cropped(config.crop[:3], config.crop[3:])
    low, high = grid.bounds
    extent = float((high - low).max())
    scale = (config.longest_edge or extent) / extent
    return grid.transformed(translation=-scale * np.array([*(0.5 * (low + high))[:2], low[2]]), scale=scale)


def baked_splats(key: tuple[object, ...], grid: RadianceGrid, count: int) -> Splats:
    """Return the splats baked of a field, from the cache if they are there."""
    return _cached_splats(key, grid.name, lambda: splats_from_radiance(grid, count=count).splats)


def _cached_splats(key: tuple[object, ...], name: str, make: Callable[[], Splats]) -> Splats:
    """Return splats from the cache, or make them if they are not there."""
    fields = ("means", "quats", "scales", "opacities", "sh")

    def read(path: Path) -> Splats:
        return Splats(**read_archive(path, "softmode.baked", 1)[1], name=name)

    def write(splats: Splats, path: Path) -> None:
        write_archive(
            path, {"format": "softmode.baked", "version": 1}, {name: getattr(splats, name) for name in fields}
        )

    return cached("baked", key, make, read, write)


def _laid_down(splats: Splats, turn: NDArray[np.float64]) -> Splats:
    """Return splats after the rotation times a factor that laid their solid down."""
    if np.array_equal(turn, np.eye(3)):
        return splats
    factor = float(np.cbrt(np.linalg.det(turn)))
    rotation = turn / factor
    return splats.transformed(None if np.allclose(rotation, np.eye(3), atol=1e-12) else rotation, scale=factor)


def _upright_mesh(config: ObjectConfig, given: str | Path | ColoredMesh) -> ColoredMesh:
    """Return the mesh upright, standing on z = 0 around the origin, scaled to the wanted size."""
    up = "+z"
    if isinstance(given, ColoredMesh):
        mesh = given
    else:
        mesh = read_mesh(given)
        up = "+y" if Path(given).suffix.lower() in (".glb", ".gltf") else up
    corners = mesh.corners.astype(np.float64) @ up_rotation(config.up or up).T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    scale = 1.0 if config.longest_edge is None else config.longest_edge / (high - low).max()
    return replace(mesh, corners=((corners - centre) * scale).astype(np.float32))


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


def _upright_splats(config: ObjectConfig) -> tuple[Splats, dict[str, str | int | float], str]:
    """Return the object's splats upright, standing on z = 0, scaled; what else there was; the name of the object."""
    capture: dict[str, str | int | float] = {}
    if config.splat is None:
        splats = _cached_splats(("plush", getsource(plush)), "plush", plush.make_plush)
        name, stray, given = "plush", 0.0, splats.count
    else:
        cropped, name = _cropped_splats(config, config.splat)
        choice = choose_part(cropped, config.part)
        splats, stray, given = choice.part, 0.002, cropped.count
        capture = {"part_splats": splats.count, "ground_splats": choice.ground_count}
        if choice.other is not None:
            low, high = choice.other.bounds(quantile=0.002)
            box = np.concatenate([low - 0.02 * (high - low), high + 0.02 * (high - low)])
            capture |= {"other_splats": choice.other.count, "other_crop": " ".join(f"{x:.4g}" for x in box)}
    low, high = splats.bounds(quantile=stray)
    extent = float((high - low).max())
    if not extent > 0.0:
        raise AssetError(f"{splats.name}: all splats lie at one point", hint="export the asset again")
    scale = (config.longest_edge or extent) / extent
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    capture["asset_splats"] = given
    return splats.transformed(translation=-scale * centre, scale=scale), capture, name


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
    inside = (splats.means >= config.crop[:3]).all(axis=1) & (splats.means <= config.crop[3:]).all(axis=1)
    if not inside.any():
        low, high = np.round(splats.bounds(), 3).tolist()
        hint = f"the splats fill {low} to {high} once turned up"
        raise AssetError(f"{splats.name}: no splat lies inside crop {config.crop}", hint=hint)
    return splats.subset(inside), name
