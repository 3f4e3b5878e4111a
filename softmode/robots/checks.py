"""Range checks that the descriptions of this package share."""

from __future__ import annotations

import math
from dataclasses import fields

from softmode.errors import ConfigError


def require_positive(owner: object, *names: str) -> None:
    """Raise if a field is not a finite number above zero."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} = {value} must be a finite number above zero", hint=_default_hint(owner, name))


def require_non_negative(owner: object, *names: str) -> None:
    """Raise if a field is not a finite number of at least zero."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value >= 0.0):
            raise ConfigError(
                f"{name} = {value} must be a finite number, zero or more", hint=_default_hint(owner, name)
            )


def require_sequence(
    owner: object, name: str, length: int, *, positive: bool = False, non_negative: bool = False
) -> None:
    """Raise if a field is not a sequence of finite numbers of the given length and sign."""
    values = getattr(owner, name)
    if len(values) != length:
        raise ConfigError(f"{name} has {len(values)} entries, expected {length}", hint=_default_hint(owner, name))
    if not all(math.isfinite(value) for value in values):
        raise ConfigError(f"{name} = {tuple(values)} holds a value that is not finite", hint=_default_hint(owner, name))
    if (positive and min(values) <= 0.0) or (non_negative and min(values) < 0.0):
        bound = "above zero" if positive else "zero or more"
        raise ConfigError(f"{name} = {tuple(values)} must hold values {bound}", hint=_default_hint(owner, name))


def _default_hint(owner: object, name: str) -> str:
    """Return the remedy for a bad field: its default."""
    for entry in fields(owner):  # type: ignore[arg-type]
        if entry.name == name:
            return f"the default of {type(owner).__name__}.{name} is {entry.default}"
    return ""
