"""What the commands share: a quiet Warp, a device by name, the pace of progress bars."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from softmode.errors import ConfigError


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Start Warp and silence what it tells about every module it loads; its warnings stay."""
    import warp as wp

    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_WARNING)
    try:
        wp.init()
        yield
    finally:
        wp.config.log_level = before


def warp_device(name: str | None) -> Any:
    """Return the device, or raise ConfigError when it is not there."""
    import warp as wp

    if name is None:
        return None
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise ConfigError(f"device {name!r} is not available", hint=f"use one of {known}") from error


def bar_interval() -> float:
    """Return how often a progress bar is drawn [s]: smoothly on a terminal, seldom in a log."""
    return 0.1 if sys.stderr.isatty() else 5.0
