"""What the commands share: a quiet Warp, a device by name, the pace of progress bars."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from softmode.errors import ConfigError


def short_name(name: str) -> Any:
    """Return what gives an option a short name; evaluated when tyro reads the annotation, not on import."""
    import tyro

    return tyro.conf.arg(aliases=[name])


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


def same_fields(options: Any, kind: type) -> dict[str, Any]:
    """Return the fields of a dataclass that the options of a command have too, by name."""
    return {field.name: getattr(options, field.name) for field in fields(kind) if hasattr(options, field.name)}


def bar_interval() -> float:
    """Return how often a progress bar is drawn [s]: smoothly on a terminal, seldom in a log."""
    return 0.1 if sys.stderr.isatty() else 5.0


class BuildBar:
    """A progress bar over the build of a body, on stderr; it appears with the first report."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._bar: Any = None

    def __enter__(self) -> BuildBar:
        """Return the bar."""
        return self

    def __call__(self, stage: str, fraction: float) -> None:
        """Show how far a stage of the build is, 0..1."""
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=100, desc="building the body", unit="%", mininterval=bar_interval())
        self._bar.set_postfix_str(stage, refresh=False)
        self._bar.update(round(100.0 * fraction) - self._bar.n)

    def __exit__(self, *_: object) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
