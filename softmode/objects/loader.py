"""`load`: whatever describes a soft object, as a soft object, in one line of stages.

`object_config` says of which kind a source is, :func:`softmode.objects.source.object_source` reads that kind by its
table, `build_standing` integrates it, lays it down and reduces it, `dressed` gives the body its splats.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material, warn_of_units
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.cache import cached_body
from softmode.errors import ConfigError
from softmode.objects.captures import bundled
from softmode.objects.config import ObjectConfig
from softmode.objects.object_file import file_kind, read_object, surface_cover
from softmode.objects.pipeline import body_key, build_standing, dressed
from softmode.objects.shapes.presets import PRESETS
from softmode.objects.soft_object import KEPT_FROM, SoftObject
from softmode.objects.source import ObjectSource, object_source
from softmode.radiance.grid import RadianceGrid
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.splats import Splats
from softmode.stages import stage

if TYPE_CHECKING:
    import trimesh

    Source = ObjectConfig | ReducedBody | Splats | RadianceGrid | ColoredMesh | trimesh.Trimesh | trimesh.Scene
    """What can be loaded beside a file."""

Progress = Callable[[str, float], None] | bool | None

AVERAGES = 0.15
"""Share of the time in which averages over many splats are made; the rest goes into the body."""
_IN_MEMORY: dict[type, str] = {Splats: "splat", RadianceGrid: "radiance", ColoredMesh: "mesh"}
"""Which option of a configuration takes what has been read."""


def load(
    source: Source | str | os.PathLike[str] | None = None,
    *,
    material: Material | None = None,
    progress: Progress = None,
    **options: Any,
) -> SoftObject:
    """Return a soft object: read or make its splats, build or recall its body.

    Args:
        source: A configuration; the name of a preset, such as "mug", or of the capture "playbot"; a file of splats, of
            a point cloud, of a mesh, of a radiance field or of a body, or an OpenUSD stage with any of these but a
            field; a body; splats, a field or a mesh (also of trimesh) in memory; None for the built-in plush.
        material: What it is made of; None for what its file or preset says. The body is built for its Poisson's ratio,
            unless `BuildOptions` name one.
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`. A callable is also told of
            averages over many splats, which are then made here.
        options: Fields of `ObjectConfig`, such as ``size=0.08``; they replace those of a configuration. A body takes
            only ``contact_radius``.

    Returns:
        The object. A body without splats of its own is covered with some.

    Raises:
        AssetError: If a file is missing, cannot be read, or encloses no volume.
        ConfigError: If an option is out of range.
        TypeError: If the source is none of these, or there is no such option.
    """
    if material is not None:
        warn_of_units(material, "material")
    if isinstance(source, ReducedBody):
        return SoftObject(body=source, splats=surface_cover(source), material=material, **options)
    config = object_config(source, **options)
    if config.body is not None:
        found = read_object(config.body)
        if config.march and found.radiance is None:
            hint = "build it from a field (softmode body build toy.npz), or leave it out"
            raise ConfigError(f"march: the body {config.body} has no radiance field", hint=hint)
        return replace(
            found,
            splats=found.splats or surface_cover(found.body),
            material=material or found.material,
            contact_radius=config.contact_radius,
            config=config,
        )
    parts, material, made = _read(config, material)
    if not callable(progress) or parts.splats.count < KEPT_FROM:
        body = cached_body(body_key(made, parts), lambda: build_standing(made, parts, progress=progress)[0])
        return dressed(body, config, parts, material)
    tell, share = progress, 1.0 - AVERAGES
    body = cached_body(
        body_key(made, parts),
        lambda: build_standing(made, parts, progress=lambda name, done: tell(name, share * done))[0],
    )
    found = dressed(body, config, parts, material)
    found.average(lambda done: tell("averaging functions over splats", share + AVERAGES * done))
    return found


def build_object(
    source: Source | str | os.PathLike[str],
    *,
    regions: Sequence[Region] = (),
    material: Material | None = None,
    progress: Progress = None,
    **options: Any,
) -> tuple[SoftObject, Quadrature]:
    """Build an object anew and not in the cache, as `load` does, with regions that a scene holds.

    Regions and boxes are given in the coordinates of the standing object: metres, z up, its bounding box centred over
    the origin and standing on z = 0. The body's `provenance` tells the kind of the asset and how much of it was left
    out.

    Args:
        source: Which object, as for `load`; not a body.
        regions: Parts that a scene holds, moves or grasps.
        material: What the object is made of, as for `load`.
        progress: As for `load`.
        options: Fields of `ObjectConfig`, such as ``size=0.08``.

    Returns:
        The object, and the quadrature that it was built from, in the coordinates of the standing object.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
        ConfigError: If the configuration names a body, or a box holds nothing.
        BasisError: If the basis cannot be built, or a region holds too little.
    """
    config = object_config(source, **options)
    parts, material, made = _read(config, material)
    body, quadrature = build_standing(made, parts, regions=regions, progress=progress)
    return dressed(body, config, parts, material), quadrature


def _read(config: ObjectConfig, material: Material | None) -> tuple[ObjectSource, Material | None, ObjectConfig]:
    """Return what an object is made of, its material, and the configuration of a body for that."""
    with stage(f"reading {config.preset or (config.kind if config.file is None else config.file[1].name)}"):
        parts = object_source(config)
    material = material or config.material
    return parts, material, config.for_material(material)


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
        if os.fspath(source) in PRESETS:
            return ObjectConfig(preset=os.fspath(source), **options)
        if bundled(source):
            return ObjectConfig(splat=os.fspath(source), **options)
        kind = file_kind(source)
        return ObjectConfig(**{"splat" if kind == "points" else kind: Path(source)}, **options)
    for known, kind in _IN_MEMORY.items():
        if isinstance(source, known):
            return ObjectConfig(**{kind: source}, **options)
    import trimesh

    if isinstance(source, trimesh.Trimesh | trimesh.Scene):
        return ObjectConfig(mesh=ColoredMesh.from_trimesh(source), **options)
    raise TypeError(
        f"source is a {type(source).__name__}: give a file, a configuration, a body, splats, a field or a mesh"
    )
