"""Configurations of environments as the values that JSON holds, there and back; what runs and datasets keep of them."""

from __future__ import annotations

import dataclasses
import types
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.envs.catalogue import config_class, is_soft
from softmode.errors import ConfigError
from softmode.files import damage_errors
from softmode.objects.fingerprint import find_file

if TYPE_CHECKING:
    from softmode.envs.task_config import TaskConfig

_SHORTCUTS = ("splat", "size", "preset")
"""Keyword arguments of environments that change their configuration."""


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
    with damage_errors(f"a field of {cls.__name__} has another type or value", hint="give numbers", error=ConfigError):
        start = cls() if start is None and not _required(cls) else start
        given = {name: _field_of(value, hints[name], getattr(start, name, None)) for name, value in values.items()}
        return cls(**given) if start is None else dataclasses.replace(start, **given)


def values_of(config: Any, start: Any = None) -> dict[str, Any]:
    """Return what `config_of` makes a configuration of, as JSON can hold it.

    Args:
        config: A frozen dataclass.
        start: What `config_of` will start from; the defaults if None.

    Raises:
        ConfigError: If a field holds what JSON cannot, such as splats in memory.
    """
    kind = type(config)
    start = kind() if start is None and not _required(kind) else start
    found = {}
    for field in dataclasses.fields(config):
        value, before = getattr(config, field.name), getattr(start, field.name, dataclasses.MISSING)
        if value is not before and (type(value) is not type(before) or value != before):
            found[field.name] = _value_of(value, before, f"{kind.__name__}.{field.name}")
    return found


def with_config(env: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return keyword arguments of a softmode environment, a ``config`` that is a dict as the configuration it means.

    Beside a preset the dict holds what differs from it.

    Raises:
        ConfigError: If a field is unknown or outside its range, or there is no such preset.
    """
    if not isinstance(options.get("config"), dict) or not is_soft(env):
        return options
    kind, rest = config_class(env), dict(options)
    preset = rest.pop("preset", None)
    start = None if preset is None else kind.preset(preset)
    return {**rest, "config": config_of(kind, options["config"], start)}


def split_config(env: str, options: dict[str, Any]) -> tuple[TaskConfig, dict[str, Any]]:
    """Return the configuration that keyword arguments of a softmode environment mean, and the other ones.

    Raises:
        ConfigError: If an option is unknown or out of range, or the environment is not softmode's.
    """
    from softmode.envs.arguments import Shortcuts, checked_config

    kind = config_class(env)
    rest = with_config(env, options)
    shortcuts = Shortcuts(**{name: rest[name] for name in _SHORTCUTS if name in rest})
    fields = {field.name: rest[field.name] for field in dataclasses.fields(kind) if field.name in rest}
    config = checked_config(kind, rest.get("config"), shortcuts, values=fields)
    return config, {name: value for name, value in rest.items() if name not in (*_SHORTCUTS, "config", *fields)}


def joined_config(env: str, config: TaskConfig, rest: dict[str, Any]) -> dict[str, Any]:
    """Return keyword arguments that `split_config` would split like this, as JSON can hold them."""
    values = values_of(config, config_class(env)())
    return {**rest, "config": values} if values else rest


def pinned_options(env: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return keyword arguments of an environment with the fingerprints of the files that its objects come from.

    Args:
        env: Id of the environment.
        options: Keyword arguments as JSON values. Those of an environment without files stay as they are.

    Raises:
        AssetError: If a file cannot be read.
        ConfigError: If an option is unknown or out of range.
    """
    if not {"config", *_SHORTCUTS} & set(options) or not is_soft(env):
        return options
    config, rest = split_config(env, options)
    first, *others = (thing.pinned() for thing in (config.scene.object, *config.scene.others))
    given = config.object_set
    several = None if given is None else given.resolved(first).pinned()
    every = (first, *others, *(() if several is None else map(several.config, range(several.count))))
    if not any(thing.files for thing in every):
        return options
    scene = dataclasses.replace(config.scene, object=first, others=tuple(others), objects=None)
    return joined_config(env, dataclasses.replace(config, scene=scene, objects=several), rest)


def located_options(options: Any, folder: Path) -> Any:
    """Return pinned options with the files that lie, by name and content, in a folder instead of their place of old.

    Raises:
        ConfigError: If they are no options: of files without a name, or nested without end.
        AssetError: If a file cannot be read.
    """
    with damage_errors("options of the environment", hint="use those of another run", error=ConfigError):
        return _located(options, folder)


def _located(options: Any, folder: Path) -> Any:
    """Return options, or what stands in them, with files that are looked for in a folder."""
    if isinstance(options, list):
        return [_located(part, folder) for part in options]
    if not isinstance(options, dict):
        return options
    from softmode.objects.config import FIELD_FILES, FILES

    found = {name: _located(value, folder) for name, value in options.items()}
    for kind, its in (*((kind, "fingerprint") for kind in FILES), *FIELD_FILES.items()):
        fingerprint = found.get(its)
        if isinstance(fingerprint, str) and isinstance(path := found.get(kind), str):
            found[kind] = str(find_file(Path(path), fingerprint, folder) or path)
    return found


def _required(cls: type) -> bool:
    """Return whether a dataclass has fields without a default."""
    return any(f.default is f.default_factory is dataclasses.MISSING for f in dataclasses.fields(cls))


def _field_of(value: Any, hint: Any, before: Any) -> Any:
    """Return the value of a field: dicts as configurations, lists as tuples."""
    arguments = typing.get_args(hint)
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    kinds = [typing.get_origin(kind) or kind for kind in (arguments if union else (hint,))]
    if value is not None or type(None) not in kinds:
        kinds = [kind for kind in kinds if kind is not type(None)]
        if all(dataclasses.is_dataclass(kind) for kind in kinds) and not isinstance(value, (dict, *kinds)):
            raise ConfigError(f"{value!r} is no {kinds[0].__name__}", hint="give its fields by name")
        if all(kind is tuple for kind in kinds) and not isinstance(value, list | tuple):
            raise ConfigError(f"{value!r} is no list", hint="give one value after the other")
    if isinstance(value, dict):
        kinds = [kind for kind in (hint, *arguments) if dataclasses.is_dataclass(kind)]
        if kinds:
            return config_of(kinds[0], value, before)  # type: ignore[arg-type]
    if isinstance(value, list):
        inner = next((a for a in arguments if typing.get_origin(a) is tuple), hint)
        parts = [part for one in typing.get_args(inner) for part in (one, *typing.get_args(one))]  # of unions too
        kinds = [kind for kind in parts if dataclasses.is_dataclass(kind)]
        return tuple(_field_of(x, kinds[0] if kinds and type(x) not in parts else None, None) for x in value)
    return value


def _value_of(value: Any, before: Any, name: str) -> Any:
    """Return the value of a field as JSON holds it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return values_of(value, before if type(before) is type(value) else None)
    if isinstance(value, list | tuple):
        return [_value_of(part, None, name) for part in value]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(f"{name} is a {type(value).__name__}, which JSON cannot hold", hint="give it by its file")
