"""Checks of arguments and fields, with one wording: what is named, what was expected, what was given."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from softmode.errors import ConfigError, SoftmodeError

SEED_MAX = 2**31 - 1
"""Largest seed of an episode or a run."""


def require_number(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
    unit: str = "",
    hint: str = "",
    error: type[SoftmodeError] = ConfigError,
) -> None:
    """Raise unless a value is a finite number within its limits.

    Args:
        name: What messages call it.
        value: A number.
        above: It must be larger.
        at_least: It must not be smaller.
        below: It must be smaller.
        at_most: It must not be larger.
        unit: Its unit, for the message.
        hint: The remedy.
        error: What is raised.

    Raises:
        ConfigError: Or ``error``, if it is not.
    """
    try:
        number = math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    limits = (
        (above, " > ", number > (above if above is not None else -math.inf)),
        (at_least, " >= ", number >= (at_least if at_least is not None else -math.inf)),
        (below, " < ", number < (below if below is not None else math.inf)),
        (at_most, " <= ", number <= (at_most if at_most is not None else math.inf)),
    )
    if math.isfinite(number) and all(held for limit, _, held in limits if limit is not None):
        return
    unit = f" {unit}" if unit else ""
    if at_least is not None and at_most is not None:
        wanted = f"lie in {_written(at_least)}..{_written(at_most)}{unit}"
    elif isinstance(at_least, int) and isinstance(value, int) and below is None:
        wanted = f"be at least {at_least}{unit}"
    else:
        bounds = " and".join(f"{sign}{_written(limit)}" for limit, sign, _ in limits if limit is not None)
        wanted = f"be a finite number{bounds}{unit}"
    raise error(f"{name} must {wanted}, got {_shown(value)}", hint=hint)


def _shown(value: Any) -> str:
    """Return a value as messages show it, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # a whole number of more than 4,300 digits
        return "a number of too many digits"
    return text if len(text) <= 200 else text[:200] + "..."


def _written(limit: float) -> str:
    """Return a limit as messages show it; a whole number with all of its digits."""
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def require_fields(owner: Any, names: Iterable[str], *, count: int | None = None, **limits: Any) -> None:
    """Raise unless every named field of an object is a finite number within the limits of :func:`require_number`.

    Args:
        owner: The object. The default of a dataclass' field is the remedy, where no other one is given.
        names: Its fields.
        count: How many numbers each of them holds; None for a number alone.
        limits: Keywords of :func:`require_number`.

    Raises:
        ConfigError: If one of them is not.
    """
    defaults = {entry.name: entry.default for entry in fields(owner)} if is_dataclass(owner) else {}
    for name in names:
        default = defaults.get(name, MISSING)
        hint = "" if default is MISSING else f"the default of {type(owner).__name__}.{name} is {default}"
        chosen = {"hint": hint, **limits}
        if count is None:
            require_number(name, getattr(owner, name), **chosen)
        else:
            require_numbers(name, getattr(owner, name), count, **chosen)


def require_numbers(name: str, values: Sequence[float], count: int, **limits: Any) -> None:
    """Raise unless a sequence holds as many finite numbers as it should, each within its limits.

    Args:
        name: What messages call it.
        values: The numbers.
        count: How many.
        limits: Keywords of :func:`require_number`.

    Raises:
        ConfigError: If it does not.
    """
    if not hasattr(values, "__len__") or isinstance(values, str | bytes | dict | set) or len(values) != count:
        raise ConfigError(f"{name} must hold {count} numbers, got {_shown(values)}", hint=limits.get("hint", ""))
    for index, value in enumerate(values):
        require_number(f"{name}[{index}]", value, **limits)


def require_range(name: str, pair: Sequence[float], **limits: Any) -> None:
    """Raise unless a pair is a range, low <= high, of finite numbers within their limits.

    Args:
        name: What messages call it.
        pair: Low and high.
        limits: Keywords of :func:`require_number`, for both.

    Raises:
        ConfigError: If it is not.
    """
    require_numbers(name, pair, 2, **limits)
    if pair[0] > pair[1]:
        raise ConfigError(f"{name} must satisfy low <= high, got {pair!r}", hint=limits.get("hint", ""))


def require_choice(name: str, value: object, choices: Collection[object]) -> None:
    """Raise unless a value is one of those that are allowed.

    Args:
        name: What the message calls it.
        value: What was given.
        choices: What is allowed.

    Raises:
        ConfigError: If it is none of them.
    """
    if value not in list(choices):
        raise ConfigError(f"{name} is {_shown(value)}", hint=f"use one of {', '.join(map(repr, choices))}")
