"""From what a person names to a soft object: a configuration or a file, with other handles if asked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import newton
import numpy as np

from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.objects.object_build import config_of_file
from softmode.objects.object_file import surface_cover
from softmode.objects.soft_object import ObjectConfig, SoftObject, load_object, tied
from softmode.stages import tokens

HANDLES_MAX = 64
"""Most eigenmodes that `LiveSession.set_handles` builds."""


@dataclass(frozen=True, kw_only=True)
class LoadedObject:
    """An object with what is known of it."""

    thing: SoftObject
    """The object."""
    config: ObjectConfig | None = None
    """What it was made from, to make it with other handles; None if that is not known."""
    material: Material | None = None
    """What its file says that it is made of."""
    scale: float = 1.0
    """Its size over that of `thing`."""


def load_source(
    source: ObjectConfig | SoftObject | str | Path | None, size: float | None, progress: Any = None
) -> LoadedObject:
    """Return the object that a person names.

    Args:
        source: A configuration, an object, a file, or None for the plush. Of an OpenUSD stage with deformable bodies
            the first body is taken, of one without its splats.
        size: Longest edge [m]; None for the source's own.
        progress: Reports the build.

    Raises:
        ConfigError: If a size is given for what has one.
        AssetError: If the file is missing or cannot be used.
    """
    if isinstance(source, SoftObject):
        _refuse_size(size, f"the body {source.body.name!r}")
        return LoadedObject(thing=source)
    if isinstance(source, str | Path) and Path(source).suffix.lower() in tokens.SUFFIXES:
        found = _usd_object(source, progress)
        if found is not None:
            _refuse_size(size, f"the body {found.thing.body.name!r} of {source}")
            return found
    if isinstance(source, str | Path):
        config = config_of_file(source)
    else:
        config = source or ObjectConfig()
    if config.body is not None or config.extents is not None:
        _refuse_size(size, f"the body {config.body}" if config.body else f"a {config.shape} of {config.extents} m")
    elif size is not None:
        config = replace(config, size=size)
    return LoadedObject(thing=load_object(config, progress), config=config)


def _refuse_size(size: float | None, what: str) -> None:
    """Refuse a size for what has its own."""
    if size is not None:
        raise ConfigError(f"size given for {what}", hint="leave it out, or build it anew")


def _usd_object(path: str | Path, progress: Any) -> LoadedObject | None:
    """Return the first deformable body of a stage, None if there is none."""
    from softmode.usd.importer import add_usd

    found = add_usd(newton.ModelBuilder(), path, progress=progress)
    if not found.bodies:
        return None
    first = next(iter(found.bodies.values()))
    body, splats = first.body, first.splats or surface_cover(first.body)
    return LoadedObject(thing=tied(body, splats), material=first.material, scale=first.scale)


def with_handles(config: ObjectConfig | None, count: int) -> ObjectConfig:
    """Return a configuration with another number of eigenmodes.

    Raises:
        ConfigError: If it is of a body that is built, or the count is out of range.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 1 <= count <= HANDLES_MAX:
        raise ConfigError(f"handles must be a whole number in 1..{HANDLES_MAX}, got {count!r}")
    if config is None or config.body is not None:
        raise ConfigError("a body that is built cannot be given other handles", hint="open what it was built from")
    return replace(config, build=replace(config.build, mode_count=int(count)))
