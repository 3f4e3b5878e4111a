"""From what a person names to a soft object: a configuration or a file, with another number of functions if asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from softmode.deformables.reduction.options import FUNCTION_LEAST, FUNCTION_LIMIT, BuildOptions
from softmode.errors import ConfigError
from softmode.foreign import tokens
from softmode.objects.config import ObjectConfig
from softmode.objects.loader import Progress, load, object_config
from softmode.objects.models import MODELS, load_model
from softmode.objects.object_file import surface_cover
from softmode.objects.placed import Placed
from softmode.objects.soft_object import SoftObject
from softmode.objects.stage.scene import read_usd_scene
from softmode.objects.stage_body import place_deformable


def load_source(
    source: ObjectConfig | SoftObject | str | Path | None, size: float | None, progress: Progress = None
) -> Placed:
    """Return the object that a person names, at the origin and the scale that its stage gives it.

    Args:
        source: A configuration, an object, a file, the name of a model, or None for the plush. Of an OpenUSD stage with
            deformable bodies the first body is taken, of one without its splats.
        size: Longest edge [m]; None for the source's own.
        progress: Reports the build.

    Raises:
        ConfigError: If a size is given for what has one.
        AssetError: If the file is missing or cannot be used.
    """
    if isinstance(source, SoftObject):
        _refuse_size(size, f"the body {source.body.name!r}")
        return Placed(object=source)
    if isinstance(source, str) and source in MODELS:
        _refuse_size(size, f"the model {source!r}")
        return Placed(object=load_model(source, progress=progress))
    if isinstance(source, str | Path) and Path(source).suffix.lower() in tokens.SUFFIXES:
        deformables = read_usd_scene(source).deformables
        if deformables:
            first = place_deformable(deformables[0], BuildOptions().for_varied_ratio(), progress=progress)
            _refuse_size(size, f"the body {first.body.name!r} of {source}")
            splats = first.splats or surface_cover(first.body)
            return Placed(object=replace(first.object, splats=splats), scale=first.scale)
    config = object_config(source)
    if config.body is not None or config.extents is not None:
        _refuse_size(size, f"the body {config.body}" if config.body else f"a {config.shape} of {config.extents} m")
    elif size is not None:
        config = replace(config, size=size)
    return Placed(object=load(config.for_varied_ratio(), progress=progress))  # Its nu has a slider.


def _refuse_size(size: float | None, what: str) -> None:
    """Refuse a size for what has its own."""
    if size is not None:
        raise ConfigError(f"size given for {what}", hint="leave it out, or build it anew")


def with_functions(config: ObjectConfig | None, count: int) -> ObjectConfig:
    """Return a configuration with another number of functions, chosen by elastic energy.

    Raises:
        ConfigError: If it is of a body that is built, or the count is out of range.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count > FUNCTION_LIMIT:
        raise ConfigError(f"functions must be a whole number in {FUNCTION_LEAST}..{FUNCTION_LIMIT}, got {count!r}")
    if config is None or config.body is not None:
        raise ConfigError("a body that is built cannot be given other functions", hint="open what it was built from")
    varied = config.build.with_functions(int(count)).for_varied_ratio()
    return replace(config, build=varied.with_functions(int(count)))
