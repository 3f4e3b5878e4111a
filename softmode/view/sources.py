"""From what a person names to a soft object: a configuration or a file, with other handles if asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from softmode.envs.object_build import config_of_file
from softmode.envs.objects import ObjectConfig
from softmode.errors import AssetError, ConfigError

HANDLES_MAX = 64
"""Most eigenmodes that `LiveSession.set_handles` builds."""


def object_config(source: ObjectConfig | str | Path | None, size: float | None) -> ObjectConfig:
    """Return the configuration of what a person names.

    Args:
        source: A configuration, a file, or None for the plush.
        size: Longest edge [m]; None for the configuration's.

    Raises:
        ConfigError: If a size is given for what has one.
        AssetError: If the file is missing or of an unknown kind.
    """
    if isinstance(source, ObjectConfig):
        config = source
    elif source is None:
        config = ObjectConfig()
    elif not Path(source).exists():
        raise AssetError(f"{source} does not exist", hint="give a splat, a mesh, a point cloud or a body file")
    else:
        config = config_of_file(source)
    if size is None:
        return config
    if config.extents is not None or config.body is not None:
        what = f"the body {config.body}" if config.body is not None else f"a {config.shape} of {config.extents} m"
        raise ConfigError(f"size given for {what}", hint="leave it out, or build it anew")
    return replace(config, size=size)


def with_handles(config: ObjectConfig, count: int) -> ObjectConfig:
    """Return a configuration with another number of eigenmodes.

    Raises:
        ConfigError: If it is of a body that is built, or the count is out of range.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= HANDLES_MAX:
        raise ConfigError(f"handles must be a whole number in 0..{HANDLES_MAX}, got {count!r}")
    if config.body is not None:
        raise ConfigError("a saved body cannot be given other handles", hint="open what it was built from")
    return replace(config, build=replace(config.build, mode_count=int(count)))
