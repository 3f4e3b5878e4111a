"""What differs between episodes: named columns that are drawn on the device at every reset, and materials of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.declare import launch
from softmode.deformables.tools.parameters import set_parameters
from softmode.envs import task_kernels as kernels
from softmode.errors import ConfigError
from softmode.scenes.occupancy import Occupancy

Bounds = tuple[float, float]


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
    """The parameters of all worlds on the device, and what their draws depend on.

    Args:
        parameters: What is drawn; a later parameter replaces an earlier one of the same name.
        occupancy: What the worlds hold.
        kept: For each of its choices ranges of its own, least and largest, by the name of a parameter.

    Attributes:
        values: The drawn numbers, float32, shape (world_count, columns).
        low: Least of each column, shape (choices, columns).
        high: Largest of each column, likewise.
        seed: Seed of each world, int32, shape (world_count,).
        episode: Episodes since it was given, likewise.
        options: What a reset option may set, by name: the parameters, and the object where a reset may change it.
    """

    def __init__(
        self, parameters: Sequence[Parameter], occupancy: Occupancy, kept: Sequence[Mapping[str, Bounds]] = ({},)
    ) -> None:
        """Lay out the columns and upload their ranges."""
        self.parameters = {parameter.name: parameter for parameter in parameters}
        self.occupancy, self.world_count, device = occupancy, occupancy.world_count, occupancy.device
        ends = np.cumsum([parameter.size for parameter in self.parameters.values()]).tolist()
        self._column = dict(zip(self.parameters, [0, *ends], strict=False))
        given = self.parameters.values()

        def upload(bound: str) -> wp.array:
            end = ("low", "high").index(bound)
            rows = [
                [np.array((own[p.name][end],) if p.name in own else getattr(p, bound), np.float32) for p in given]
                for own in kept
            ]
            return wp.array(np.stack([np.concatenate(row) for row in rows]), dtype=float, device=device)

        self.low, self.high = upload("low"), upload("high")
        logs = np.concatenate([np.full(p.size, p.log) for p in given])
        self._log = wp.array(logs, dtype=wp.bool, device=device)
        self.values = wp.zeros((self.world_count, ends[-1]), dtype=float, device=device)
        self.seed, self.episode = (wp.zeros(self.world_count, dtype=int, device=device) for _ in range(2))
        self.options = dict(self.parameters)
        if occupancy.resampled:
            last, more = len(occupancy.choices) - 1.0, occupancy.slots - 1
            self.options["object"] = Parameter(name="object", low=(0.0, *[-1.0] * more), high=(last,) * (1 + more))

    def column(self, name: str) -> int:
        """Return the first column of a parameter."""
        return self._column[name]

    def columns(self, name: str) -> slice:
        """Return the columns of a parameter."""
        return slice(self._column[name], self._column[name] + self.parameters[name].size)

    def use_seeds(self, seeds: ArrayLike, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Give the masked worlds seeds, whose episodes count from zero; return the seeds of all."""
        chosen: NDArray[Any] = self.seed.numpy().copy()
        count: NDArray[Any] = self.episode.numpy().copy()
        chosen[mask] = np.asarray(seeds, np.int64)[mask] & 0x7FFFFFFF
        count[mask] = -1
        self.seed.assign(chosen)
        self.episode.assign(count)
        return chosen

    def draw(self, world_mask: wp.array) -> None:
        """Draw objects and parameters of the masked worlds; capturable."""
        self.occupancy.draw(world_mask, self.seed, self.episode)
        inputs = (world_mask, self.seed, self.occupancy.row, self.low, self.high, self._log)
        launch(self.occupancy.device, kernels.draw_parameters, self.world_count, *inputs, self.episode, self.values)

    def draw_with(self, world_mask: wp.array, options: Mapping[str, NDArray[np.float32]]) -> None:
        """Draw what options do not give.

        Args:
            world_mask: Which worlds.
            options: Checked values, see `check_options`.
        """
        mask: NDArray[Any] = world_mask.numpy()
        given = dict(options)
        if "object" in given:
            self.occupancy.ask(given.pop("object"), mask)
        self.draw(world_mask)
        self.occupancy.ask_nothing()
        if given:
            values: NDArray[Any] = self.values.numpy().copy()
            for name, numbers in given.items():
                values[mask, self.columns(name)] = numbers[mask]
            self.values.assign(values)


class Materials:
    """Materials and sizes of all soft bodies, which follow the parameters of their worlds.

    Args:
        solver: What they are set in.
        table: The parameters.
        stride: Soft bodies of a world.
        kept: For each choice of the occupancy ranges of its own; several objects of a world have their middle, all but
            the first.

    Attributes:
        values: Each property by its name, shape (world_count * stride,).
    """

    NAMES = ("youngs_modulus", "poissons_ratio", "density", "friction", "scale")

    def __init__(
        self, solver: Any, table: ParameterTable, stride: int, kept: Sequence[Mapping[str, Bounds]] = ({},)
    ) -> None:
        """Allocate the properties."""
        worlds, device = table.world_count, table.values.device
        self._solver, self._table, self._stride = solver, table, stride
        self._all = wp.zeros((len(self.NAMES), worlds * stride), dtype=float, device=device)
        self.values: dict[str, wp.array] = {name: cast(wp.array, self._all[k]) for k, name in enumerate(self.NAMES)}
        self._columns = wp.array([table.column(name) for name in self.NAMES], dtype=int, device=device)
        ranges = [[each.get(name, (math.nan, math.nan)) for name in self.NAMES] for each in kept]
        own = [[low if low == high else math.sqrt(low * high) for low, high in row] for row in ranges]
        self._own = wp.array(own, dtype=float, device=device)
        self._mask = wp.zeros(worlds + 1, dtype=wp.bool, device=device)

    def apply(self, world_mask: wp.array) -> None:
        """Give the bodies of the masked worlds the materials and sizes of their parameters; capturable."""
        held, values = self._table.occupancy, self._all
        inputs = (self._table.values, self._stride, self._columns, self._own, held.choice, held.slots)
        launch(held.device, kernels.spread_materials, values.shape[1], *inputs, values)
        wp.copy(self._mask, world_mask, count=world_mask.shape[0])
        set_parameters(self._solver, self._mask, **self.values)


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
