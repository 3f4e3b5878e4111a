"""Configurations of environments from the values that JSON holds."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any

from softmode.errors import ConfigError


def config_of(cls: type, values: dict[str, Any], start: Any = None) -> Any:
    """Return the configuration whose fields are those of the dict, dicts within it for fields that are configurations.

    Args:
        cls: A frozen dataclass.
        values: Fields that differ from those of `start`.
        start: The configuration to change; the defaults if None. A dict within `values` changes what `start` has there.

    Raises:
        ConfigError: If a field is unknown or a value outside its range.
    """
    hints = typing.get_type_hints(cls)
    known = {field.name for field in dataclasses.fields(cls)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigError(f"{cls.__name__} has no field {unknown[0]!r}", hint=f"use one of {', '.join(sorted(known))}")
    if start is None:
        start = cls()
    given: dict[str, Any] = {}
    for name, value in values.items():
        inner = [kind for kind in (hints[name], *typing.get_args(hints[name])) if dataclasses.is_dataclass(kind)]
        if isinstance(value, dict) and inner:
            value = config_of(inner[0], value, getattr(start, name))  # type: ignore[arg-type]
        given[name] = tuple(value) if isinstance(value, list) else value
    try:
        return dataclasses.replace(start, **given)
    except TypeError as error:
        raise ConfigError(f"a field of {cls.__name__} has another type ({error})", hint="give numbers") from error
