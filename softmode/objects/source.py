"""What an object is made of: its splats upright at its size, and how its solid is integrated and laid down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.quadrature import quadrature_from_splats
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.build.quadrature_mesh import quadrature_from_mesh
from softmode.errors import AssetError, ConfigError
from softmode.objects.config import ObjectConfig
from softmode.objects.mesh_file import read_mesh
from softmode.objects.parts import choose_part
from softmode.objects.pose import stable_rotation
from softmode.objects.primitives import (
    Color,
    primitive_mesh,
    primitive_quadrature,
    scaled,
    surface_splats,
    turned,
)
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.formats import read_splats
from softmode.splats.plush import make_plush
from softmode.splats.point_cloud import is_point_cloud, read_points
from softmode.splats.splats import Splats, up_rotation
from softmode.stages import tokens

DEFAULT_COLORS: tuple[Color, Color] = ((0.93, 0.55, 0.22), (0.97, 0.90, 0.76))
"""Colours of a shape that is given none."""


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
    capture: dict[str, str | int | float] = field(default_factory=dict)
    """What was found in its file beside it, for the report."""


def object_source(config: ObjectConfig) -> ObjectSource:
    """Return what an object is made of.

    Raises:
        AssetError: If a file cannot be read.
    """
    count = config.surface_count
    if config.mesh is not None:
        mesh = _upright_mesh(config, config.mesh)
        splats = surface_splats(mesh, config.splat_count, config.colors)
        name = mesh.name if isinstance(config.mesh, ColoredMesh) else Path(config.mesh).name
        return ObjectSource(splats, partial(_mesh_solid, mesh, count), name, ("mesh", mesh.corners), splats.count)
    if config.shape != "plush" and config.extents is not None:
        shape, extents = config.shape, config.extents
        mesh = ColoredMesh.from_trimesh(primitive_mesh(shape, extents), name=shape)
        splats = surface_splats(mesh, config.splat_count, config.colors or DEFAULT_COLORS)
        solid = partial(primitive_quadrature, shape, extents, count)
        return ObjectSource(splats, solid, shape, (shape, extents), splats.count)
    splats, capture, name = _upright_splats(config)
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities)
    solid = partial(quadrature_from_splats, *arrays, surface_count=count, resolution=config.resolution)
    key = ("splats", *arrays, config.resolution)
    return ObjectSource(splats, solid, name, key, int(capture["asset_splats"]), config.size, capture)


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


def stiffness_scale(config: ObjectConfig, quadrature: Quadrature) -> NDArray[np.float64] | None:
    """Return the relative stiffness per quadrature point of a standing object (P,), None if it is the same everywhere.

    Raises:
        ConfigError: If a part of another stiffness holds no point.
    """
    if not config.stiffness:
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
    return found


def with_origin(body: ReducedBody, config: ObjectConfig, source: ObjectSource, splats: Splats) -> ReducedBody:
    """Return a body whose provenance tells the kind of its asset, and how many of the asset's splats show it."""
    kind = "mesh" if config.mesh is not None else "splat" if config.splat is not None else config.shape
    left_out = source.asset_splats - splats.count
    told = {"asset": source.name, "asset_kind": kind, "asset_splats": source.asset_splats, "asset_left_out": left_out}
    return replace(body, provenance={**body.provenance, **told})


def may_turn(config: ObjectConfig) -> bool:
    """Return whether an object is laid on a stable side if it has to be."""
    return config.pose == "stable" and (config.splat is not None or config.mesh is not None)


def splats_of_body(splats: Splats, body: ReducedBody, turn: NDArray[np.float64]) -> Splats:
    """Return the splats of a source in the frame of the body built from it, without those far from it.

    What lies beyond an eighth of the body's size around its bounding box are floaters of the capture.

    Args:
        splats: Splats of the source, N.
        body: The body.
        turn: The rotation by which it was laid down times the factor that brought it to its size, shape (3, 3).
    """
    if not np.array_equal(turn, np.eye(3)):
        factor = float(np.cbrt(np.linalg.det(turn)))
        rotation = turn / factor
        splats = splats.transformed(None if np.allclose(rotation, np.eye(3), atol=1e-12) else rotation, scale=factor)
    low, high = body.bounds + body.offset
    margin = 0.125 * np.linalg.norm(high - low)
    near = ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
    return splats.subset(near).transformed(translation=-body.offset)


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


def _upright_splats(config: ObjectConfig) -> tuple[Splats, dict[str, str | int | float], str]:
    """Return the object's splats upright, standing on z = 0, scaled; what else there was; the name of the object."""
    capture: dict[str, str | int | float] = {}
    if config.splat is None:
        splats = make_plush()
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
    scale = config.size / extent
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
