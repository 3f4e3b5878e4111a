"""`ObjectSet`: several soft objects, of which every world of a scene gets one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from softmode.checks import SEED_MAX, require_choice, require_number
from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.foreign import tokens
from softmode.objects.config import FILES, ObjectConfig
from softmode.objects.object_file import file_kind
from softmode.objects.shapes.presets import PRESETS
from softmode.radiance.formats import SUFFIXES as RADIANCE
from softmode.splats.formats import READABLE

Order = Literal["drawn", "in_turn"]
MOST = 8
"""Most objects of a set that a world may have at a time."""
MESHES = (".obj", ".glb", ".gltf", ".stl", ".off")
_READ = frozenset((*READABLE, *RADIANCE, *MESHES, *tokens.SUFFIXES, ".xyz"))


@dataclass(frozen=True)
class ObjectSet:
    """Soft objects of which every world gets one when it is made, and keeps it; or another one, or several, at resets.

    Objects that are named get the `build` and `surface_count` of the scene's object; configurations are taken as they
    are. World i gets the same object whatever the number of worlds is.

    Raises:
        ConfigError: If it is empty, an object is none, weights or materials are not one per object, or `per_world` lies
            outside 1..8.
        AssetError: If a file that is named is missing.
    """

    objects: tuple[str | Path | ObjectConfig, ...]
    """The objects: names of presets, files, configurations."""
    weights: tuple[float, ...] | None = field(default=None, kw_only=True)
    """How often each is drawn, relative to each other; None for equally often."""
    materials: tuple[Material | None, ...] | None = field(default=None, kw_only=True)
    """What each is made of; None for what its preset or body file says, else what the scene says."""
    size: float | None = field(default=None, kw_only=True)
    """Longest edge of the objects that are named [m]; None for their own. A body file has its own."""
    order: Order = field(default="drawn", kw_only=True)
    """"drawn" draws the object of each world by `seed` and `weights`; "in_turn" deals them out in their order."""
    seed: int = field(default=0, kw_only=True)
    """What draws depend on."""
    first_world: int = field(default=0, kw_only=True)
    """Which world of the draws is the first here: with 5, a single environment has the object of world 5 of many."""
    resample: bool = field(default=False, kw_only=True)
    """Whether a world gets another object at every reset, drawn by the weights and the seed of `reset`, or named by its
    option `object`; all objects of the set are then resident, and each world has room for the largest."""
    per_world: int | tuple[int, int] = field(default=1, kw_only=True)
    """How many objects a world has at a time, a number or (least, most), 1..8; from a range each reset draws it, all
    numbers equally often. The same object may be there several times. More than one needs `resample`."""

    def __post_init__(self) -> None:
        """Check the objects and what belongs to each."""
        given: Any = self.objects
        if isinstance(given, str | Path | ObjectConfig) or not isinstance(given, Sequence):
            hint = "give a list, such as ObjectSet(['mug', 'sponge']), or use ObjectSet.folder"
            raise ConfigError(f"objects is a {type(given).__name__}, expected a list", hint=hint)
        if not given:
            hint = "name presets or files, or give configurations"
            raise ConfigError("objects is empty: a set holds at least one object", hint=hint)
        for name in ("objects", "weights", "materials"):
            values: Any = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, tuple(values))
                if len(getattr(self, name)) != len(given):
                    what = f"{name} has {len(values)} entries for {len(given)} objects"
                    raise ConfigError(what, hint="give one per object")
        for k, one in enumerate(self.objects):
            if not isinstance(one, str | Path | ObjectConfig):
                hint = "give the name of a preset, a file or an ObjectConfig"
                raise ConfigError(f"objects[{k}] is a {type(one).__name__}", hint=hint)
            if not isinstance(one, ObjectConfig) and str(one) not in PRESETS:
                file_kind(one)  # says what is wrong with it
        for k, one in enumerate(self.materials or ()):
            if not isinstance(one, Material | None):
                raise ConfigError(f"materials[{k}] is a {type(one).__name__}", hint="give a Material or None")
        require_choice("order", self.order, get_args(Order))
        require_number("seed", self.seed, at_least=0, at_most=SEED_MAX)
        if self.resample and self.order != "drawn":
            raise ConfigError("resample draws objects, and order deals them out in turn", hint="leave order out")
        self._check_per_world()
        require_number("first_world", self.first_world, at_least=0)
        if self.weights is not None:
            for k, weight in enumerate(self.weights):
                require_number(f"weights[{k}]", weight, at_least=0.0)
            if not sum(self.weights) > 0.0:
                raise ConfigError(f"weights {self.weights} are all zero", hint="give one above zero")
            if self.order != "drawn":
                hint = "leave one of them out"
                raise ConfigError("weights are given, and objects are dealt out in turn", hint=hint)

    def _check_per_world(self) -> None:
        """Check how many objects a world has."""
        given: Any = self.per_world
        pair = given if isinstance(given, tuple | list) else (given, given)
        if len(pair) != 2:
            raise ConfigError(f"per_world is {given!r}", hint="give a number, or the least and the most")
        for number in pair:
            require_number("per_world", number, at_least=1, at_most=MOST)
            if int(number) != number:
                raise ConfigError(f"per_world is {given!r}", hint="give whole numbers")
        least, most = (int(number) for number in pair)
        if least > most:
            raise ConfigError(f"per_world ranges from {least} to {most}", hint="give the least first")
        if most > 1 and not self.resample:
            raise ConfigError(f"per_world is {given!r} and worlds keep their objects", hint="give resample=True")
        object.__setattr__(self, "per_world", most if least == most else (least, most))

    @property
    def number_range(self) -> tuple[int, int]:
        """The least and the most objects that a world has at a time."""
        return self.per_world if isinstance(self.per_world, tuple) else (self.per_world, self.per_world)

    @classmethod
    def folder(cls, path: str | os.PathLike[str], **options: Any) -> Self:
        """Return the set of all objects in a folder, by name.

        Args:
            path: The folder; of its files those count whose suffix is one of splats, meshes, fields, bodies or stages.
            options: Further fields of the set.

        Raises:
            ConfigError: If there is no such folder, or no object in it.
        """
        folder = Path(path)
        if not folder.is_dir():
            raise ConfigError(f"folder {folder}: no such folder", hint="check the path")
        files = sorted(file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in _READ)
        if not files:
            hint = f"put files with one of the suffixes {', '.join(sorted(_READ))} into it"
            raise ConfigError(f"folder {folder} holds no object", hint=hint)
        return cls(tuple(files), **options)

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.objects)

    @property
    def names(self) -> tuple[str, ...]:
        """What the objects are called, each by a name of its own: preset, file without suffix, or shape."""
        names: list[str] = []
        for one in self.objects:
            name = _name(one) if isinstance(one, ObjectConfig) else one if str(one) in PRESETS else Path(one).stem
            again = sum(known == name or known.startswith(f"{name}#") for known in names)
            names.append(f"{name}#{again + 1}" if again else str(name))
        return tuple(names)

    def resolved(self, like: ObjectConfig) -> Self:
        """Return the set with configurations in place of names.

        Args:
            like: Says `build` and `surface_count` of the objects that are named.
        """
        return replace(self, objects=tuple(self._config(one, like) for one in self.objects))

    def pinned(self) -> Self:
        """Return the set, of configurations, with whole paths and fingerprints of the files, see `ObjectConfig.pinned`.

        Raises:
            AssetError: If a file cannot be read.
        """
        return replace(self, objects=tuple(self.config(k).pinned() for k in range(self.count)))

    def for_varied_ratio(self) -> Self:
        """Return the set, of configurations, with bodies for a Poisson's ratio that varies."""
        kinds = [one.for_varied_ratio() if isinstance(one, ObjectConfig) else one for one in self.objects]
        return replace(self, objects=tuple(kinds))

    def chosen(self, world_count: int) -> NDArray[np.intp]:
        """Return which object each world gets, shape (world_count,)."""
        worlds = self.first_world + np.arange(world_count)
        if self.order == "in_turn":
            return worlds % self.count
        draws = np.random.default_rng(self.seed).random(self.first_world + world_count)
        return np.searchsorted(self.ends, draws[self.first_world :], side="right")

    @property
    def ends(self) -> NDArray[np.float64]:
        """Where the share of each object ends in [0, 1], shape (count,), for uniform draws."""
        weights = np.ones(self.count) if self.weights is None else np.array(self.weights, float)
        ends = np.cumsum(weights / weights.sum())
        ends[np.flatnonzero(weights)[-1] :] = 1.0  # rounding must not let a draw beyond the last that may be drawn
        return ends

    def material(self, index: int, default: Material) -> Material | None:
        """Return what an object is made of; None for a body file, which says it itself, or does not.

        Args:
            index: The object, of a set of configurations.
            default: What those are made of that do not say it.
        """
        own, config = None if self.materials is None else self.materials[index], self.config(index)
        return own or config.material or (default if config.body is None else None)

    def config(self, index: int) -> ObjectConfig:
        """Return the configuration of an object.

        Raises:
            ConfigError: If it is named, and `resolved` has not been called.
        """
        config = self.objects[index]
        if not isinstance(config, ObjectConfig):
            raise ConfigError(f"objects[{index}] is the name {config}", hint="use ObjectSet.resolved(like)")
        return config

    def _config(self, one: str | Path | ObjectConfig, like: ObjectConfig) -> ObjectConfig:
        """Return the configuration of an object."""
        if isinstance(one, ObjectConfig):
            return one
        plain: dict[str, Any] = {"surface_count": like.surface_count, "build": like.build}
        if str(one) in PRESETS:
            return ObjectConfig(preset=str(one), size=self.size, **plain)
        kind = file_kind(one)
        if kind == "body":
            return ObjectConfig(body=Path(one))
        return ObjectConfig(**{"splat" if kind == "points" else kind: Path(one)}, size=self.size, **plain)


def _name(config: ObjectConfig) -> str:
    """Return what an object is called."""
    if config.preset is not None:
        return config.preset
    if config.file is not None:
        return config.file[1].stem
    read = next((kind for kind in FILES if getattr(config, kind) is not None), None)
    return config.shape if read is None else read
