"""`load`: whatever describes a soft object, as a soft object."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.cache import cached_body
from softmode.deformables.materials.material import Material
from softmode.errors import AssetError
from softmode.objects.config import ObjectConfig
from softmode.objects.object_file import file_kind, read_object, surface_cover
from softmode.objects.soft_object import SoftObject
from softmode.objects.source import (
    density_scale,
    field_of_body,
    may_turn,
    object_source,
    splats_of_body,
    standing_quadrature,
    stiffness_scale,
    with_origin,
)
from softmode.radiance.grid import RadianceGrid
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.splats import Splats

if TYPE_CHECKING:
    import trimesh

    Source = ObjectConfig | ReducedBody | Splats | RadianceGrid | ColoredMesh | trimesh.Trimesh | trimesh.Scene
    """What can be loaded beside a file."""

RECIPE = 6
"""Part of the cache key; raise it when the way from a file or shape to a body changes."""
Progress = Callable[[str, float], None] | bool | None


def load(
    source: Source | str | os.PathLike[str] | None = None,
    *,
    material: Material | None = None,
    progress: Progress = None,
    **options: Any,
) -> SoftObject:
    """Return a soft object: read or make its splats, build or recall its body.

    Args:
        source: A configuration; a file of splats, of a point cloud, of a mesh, of a radiance field or of a body, or an
            OpenUSD stage with any of these but a field; a body; splats, a field or a mesh (also of trimesh) in memory;
            None for the built-in plush.
        material: What it is made of; None for what its file or preset says. The body is built for its Poisson's ratio,
            unless `BuildOptions` name one.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.
        options: Fields of `ObjectConfig`, such as ``size=0.08``; they replace those of a configuration. A body takes
            only ``contact_radius``.

    Returns:
        The object. A body without splats of its own is covered with some.

    Raises:
        AssetError: If a file is missing, cannot be read, or encloses no volume.
        ConfigError: If an option is out of range.
        TypeError: If the source is none of these, or there is no such option.
    """
    if isinstance(source, ReducedBody):
        return SoftObject(body=source, splats=surface_cover(source), material=material, **options)
    config = object_config(source, **options)
    material = material or config.material
    made = config.for_material(material).build
    if config.body is not None:
        found = read_object(config.body)
        return replace(
            found,
            splats=found.splats or surface_cover(found.body),
            material=material or found.material,
            contact_radius=config.contact_radius,
            config=config,
        )
    parts = object_source(config)

    def build() -> ReducedBody:
        quadrature, turn = standing_quadrature(config, parts)
        regions = ()
        if config.clamped_height > 0.0:
            wide = float("inf")
            top = float(quadrature.bounds[0, 2]) + config.clamped_height
            regions = (Region(name="foot", box=((-wide,) * 3, (wide, wide, top))),)
        scale = stiffness_scale(config, quadrature, parts, turn)
        fields = {"stiffness_scale": scale, "density_scale": density_scale(config, quadrature, parts, turn)}
        body = build_body(quadrature, made, name=parts.name, regions=regions, **fields, progress=progress)
        return replace(body, provenance={**body.provenance, "turn": json.dumps(turn.tolist())})

    clamp = (config.clamped_height,) if config.clamped_height > 0.0 else ()
    key = (RECIPE, *parts.key, may_turn(config), config.surface_count, made, *clamp, *config.stiffness)
    if config.stiffness_colors or config.density_colors:  # A mesh's key does not hold its colours.
        key = (*key, *config.stiffness_colors, parts.splats.means, parts.splats.sh)
    if config.density_colors:
        key = (*key, "density", *config.density_colors)
    for name in ("stiffness_file", "density_file"):
        if (file := getattr(config, name)) is not None:
            if not Path(file).is_file():
                raise AssetError(f"{name} {file}: no such file", hint="check the path")
            key = (*key, name, hashlib.sha256(Path(file).read_bytes()).hexdigest())
    body = cached_body(key, build)
    turn = np.array(json.loads(str(body.provenance["turn"])))
    splats = splats_of_body(parts.splats, body, turn)
    body = with_origin(body, config, parts, splats)
    return SoftObject(
        body=body,
        splats=splats,
        material=material,
        contact_radius=config.contact_radius,
        config=config,
        radiance=field_of_body(parts, body, turn),
    )


def object_config(source: Source | str | os.PathLike[str] | None, **options: Any) -> ObjectConfig:
    """Return the configuration of an object that is no body in memory, with its file where it was found.

    Args:
        source: As for `load`.
        options: Fields of `ObjectConfig`; they replace those of a configuration.

    Raises:
        AssetError: If a file is missing or cannot be read, or has another fingerprint than the configuration says.
        ConfigError: If an option is out of range.
        TypeError: If the source is nothing that can be loaded.
    """
    if isinstance(source, ObjectConfig):
        return source.changed(**options).located()
    if source is None:
        return ObjectConfig(**options)
    if isinstance(source, str | os.PathLike):
        kind = file_kind(source)
        return ObjectConfig(**{"splat" if kind == "points" else kind: Path(source)}, **options)
    if isinstance(source, Splats):
        return ObjectConfig(splat=source, **options)
    if isinstance(source, RadianceGrid):
        return ObjectConfig(radiance=source, **options)
    if isinstance(source, ColoredMesh):
        return ObjectConfig(mesh=source, **options)
    import trimesh

    if isinstance(source, trimesh.Trimesh | trimesh.Scene):
        return ObjectConfig(mesh=ColoredMesh.from_trimesh(source), **options)
    raise TypeError(
        f"source is a {type(source).__name__}: give a file, a configuration, a body, splats, a field or a mesh"
    )
