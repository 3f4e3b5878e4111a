"""What differs between episodes: named columns that are drawn on the device at every reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.structs import StructType, filled
from softmode.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A quantity drawn at reset, one or several numbers, each uniform between its bounds."""

    name: str
    """Key of the reset option and of ``info["parameters"]``."""
    low: tuple[float, ...]
    """Least value of each number."""
    high: tuple[float, ...]
    """Largest value; equal to `low` for what is not random."""
    log: bool = False
    """Uniform in the logarithm."""
    least: tuple[float, ...] | None = None
    """Least value that a reset option may set; `low` if None."""
    most: tuple[float, ...] | None = None
    """Largest value that a reset option may set; `high` if None."""

    def __post_init__(self) -> None:
        """Check the range."""
        ordered = len(self.low) == len(self.high) and all(
            np.isfinite(a) and np.isfinite(b) and a <= b for a, b in zip(self.low, self.high, strict=False)
        )
        if not ordered or (self.log and min(self.low) <= 0.0):
            hint = "give finite bounds, low <= high" + (", above 0" if self.log else "")
            raise ConfigError(f"{self.name} ranges from {self.low} to {self.high}", hint=hint)

    @property
    def size(self) -> int:
        """How many numbers it is."""
        return len(self.low)


class ParameterTable:
    """The parameters of all worlds on the device.

    Args:
        parameters: What is drawn; a later parameter replaces an earlier one of the same name.
        world_count: Number of worlds.
        device: Warp device.
        kinds: Of every kind of worlds the numbers that are not drawn there, by the name of a parameter.
        kind: Which kind each world is, shape (world_count,).

    Attributes:
        values: The drawn numbers, float32, shape (world_count, columns).
        low: Least of each column, shape (kinds, columns).
        high: Largest of each column, likewise.
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        world_count: int,
        device: wp.DeviceLike = None,
        *,
        kinds: Sequence[Mapping[str, float]] = ({},),
        kind: ArrayLike | None = None,
    ) -> None:
        """Lay out the columns and upload their ranges."""
        self.parameters = {parameter.name: parameter for parameter in parameters}
        self.world_count = world_count
        ends = np.cumsum([parameter.size for parameter in self.parameters.values()]).tolist()
        self._column = dict(zip(self.parameters, [0, *ends], strict=False))

        chosen = self.parameters.values()

        def upload(bound: str) -> wp.array:
            rows = [
                [np.array((kept[p.name],) if p.name in kept else getattr(p, bound), np.float32) for p in chosen]
                for kept in kinds
            ]
            return wp.array(np.stack([np.concatenate(row) for row in rows]), dtype=float, device=device)

        self.low, self.high = upload("low"), upload("high")
        logs = np.concatenate([np.full(p.size, p.log) for p in chosen])
        self.log = wp.array(logs, dtype=wp.bool, device=device)
        rows = np.zeros(world_count, np.int32) if kind is None else np.asarray(kind, np.int32)
        self.kind = wp.array(rows, dtype=int, device=device)
        self.values = wp.zeros((world_count, ends[-1]), dtype=float, device=device)

    def column(self, name: str) -> int:
        """Return the first column of a parameter."""
        return self._column[name]

    def columns_in(self, struct: StructType) -> Any:
        """Return a struct of a kernel whose fields are the first columns of the parameters of their names."""
        return filled(struct, **self._column)

    def columns(self, name: str) -> slice:
        """Return the columns of a parameter."""
        return slice(self._column[name], self._column[name] + self.parameters[name].size)


def check_options(
    parameters: Mapping[str, Parameter], options: Mapping[str, object], world_count: int
) -> dict[str, NDArray[np.float32]]:
    """Return reset options as arrays of shape (world_count, size), or raise before anything changes.

    Args:
        parameters: The parameters by name.
        options: A value, or one per world, by the name of a parameter.
        world_count: Number of worlds.

    Raises:
        ConfigError: If a name is unknown, a value no finite number within its range, or a material one in which sound
            is faster than in what is soft: contacts of what is so light and stiff may let steps diverge.
    """
    unknown = sorted(set(options) - set(parameters))
    if unknown:
        if "object" in unknown:
            hint = "choose it when the environment is made, by order or seed of the ObjectSet"
            raise ConfigError("'object' is no reset option: a world keeps its object", hint=hint)
        raise ConfigError(f"unknown reset options {unknown}", hint=f"use {', '.join(parameters)}")
    found = {name: _checked(parameters[name], value, world_count) for name, value in options.items()}
    if _ELASTIC & set(found) and set(parameters) >= _ELASTIC:
        _check_speed({n: found.get(n, np.array(p.low if n == "density" else p.high)) for n, p in parameters.items()})
    return found


_ELASTIC = {"youngs_modulus", "poissons_ratio", "density"}
_SPEED = 1.0e3
"""Fastest compression wave of a material that a reset option may ask for [m/s]; at three times that steps diverged."""


def _check_speed(values: Mapping[str, NDArray[np.floating]]) -> None:
    """Refuse materials beyond the speed; where no value is given the fastest that may be drawn counts."""
    modulus, ratio, density = (values[name].astype(float) for name in ("youngs_modulus", "poissons_ratio", "density"))
    speed = np.sqrt(modulus * (1.0 - ratio) / ((1.0 + ratio) * (1.0 - 2.0 * ratio) * density)).max()
    if speed > _SPEED:
        raise ConfigError(
            f"youngs_modulus, poissons_ratio and density make a sound of {speed:.3g} m/s, over {_SPEED:.0f} m/s",
            hint="give a lower youngs_modulus or poissons_ratio, or a higher density",
        )


def _checked(parameter: Parameter, value: object, world_count: int) -> NDArray[np.float32]:
    """Return one option as an array."""
    try:
        numbers = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan, np.float32)
    size = parameter.size
    if numbers.size == size * world_count:
        numbers = numbers.reshape(world_count, size)
    elif numbers.size == size:
        numbers = np.tile(numbers.reshape(1, size), (world_count, 1))
    if numbers.shape != (world_count, size) or not np.isfinite(numbers).all():
        what = "a finite number" if size == 1 else f"{size} finite numbers"
        each = f", or that for each of {world_count} worlds" if world_count > 1 else ""
        raise ConfigError(f"{parameter.name} must be {what}{each}, got {value!r}")
    least = np.array(parameter.low if parameter.least is None else parameter.least, np.float32)
    most = np.array(parameter.high if parameter.most is None else parameter.most, np.float32)
    if not ((numbers >= least) & (numbers <= most)).all():
        hint = f"stay within {least.tolist()} to {most.tolist()}"
        raise ConfigError(f"{parameter.name} = {value!r} lies outside its range", hint=hint)
    return numbers
