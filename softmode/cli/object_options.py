"""The options by which every command takes an object of one's own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from softmode.checks import require_number
from softmode.errors import ConfigError, MaterialError

if TYPE_CHECKING:
    from softmode.envs.task_config import TaskConfig
    from softmode.objects.config import ObjectConfig, StifferBox

Config = TypeVar("Config", bound="TaskConfig")
_MATERIAL = ("youngs_modulus", "density", "friction")
_SPLAT_ONLY = ("crop", "part", "resolution")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectOptions:
    """Your own object, and what it is made of. What is left out is as the task, the policy's run or the file has it."""

    splat: Path | None = None
    """Splat file: .ply, .spz, .splat, .sog, a SOG folder or its meta.json, .usd; a point cloud; or playbot."""
    object: Path | None = None
    """File of any kind: a mesh, a body of `softmode body build`, splats, a radiance field, an OpenUSD stage; or a
    preset's name, see `softmode objects list`."""
    march: bool = False
    """Draw a radiance field ray by ray, not baked."""
    size: float | None = None
    """Longest edge [m]; 0.08 if a file is given, a preset has its own."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Axis of the file that points up; -y for splats, +y for glTF, +z for the rest."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 of a splat file, once turned up; what is outside is dropped."""
    part: Literal["thickest", "tallest", "largest", "all"] | tuple[int, ...] | None = None
    """Which part of a splat file is the object; or numbers of `softmode splat show`, like 1 2."""
    pose: Literal["stable", "captured"] | None = None
    """Lay what cannot stand on its stable side (stable), or leave it as it is."""
    resolution: int | None = None
    """Voxels along the longest edge when a splat file is filled; 64 to 384, as its thin parts need."""
    youngs_modulus: float | None = None
    """Young's modulus [Pa]; many tasks draw it."""
    density: float | None = None
    """Density [kg/m^3]."""
    friction: float | None = None
    """Coulomb's coefficient of the object."""
    stiffness: tuple[str, ...] = ()
    """NAME=x0,y0,z0,x1,y1,z1,FACTOR: a part FACTOR times as stiff, where the object stands [m]."""
    stiffness_by_color: tuple[str, ...] = ()
    """'#rrggbb:FACTOR': what has this colour is FACTOR times as stiff."""
    stiffness_file: Path | None = None
    """.npz of points [m] where the object stands, and factors of stiffness."""
    density_by_color: tuple[str, ...] = ()
    """'#rrggbb:FACTOR': what has this colour is FACTOR times as dense as the rest; the mass stays."""
    density_file: Path | None = None
    """.npz of points and factors of density."""
    material_file: Path | None = None
    """.npz or stage of points with E, nu, density."""

    def check(self) -> None:
        """Refuse what cannot be, before any work is done.

        Raises:
            ConfigError: If two files are given.
            MaterialError: If a property of the material is out of range.
        """
        if self.splat is not None and self.object is not None:
            raise ConfigError(f"--splat {self.splat} and --object {self.object} exclude each other", hint="give one")
        for name, example in (("youngs_modulus", "2e5, in Pa"), ("density", "250, in kg/m^3")):
            if (value := getattr(self, name)) is not None:
                option = name.replace("_", "-")
                require_number(option, value, above=0.0, hint=f"give it like {example}", error=MaterialError)
        if self.friction is not None:
            require_number("friction", self.friction, at_least=0.0, hint="give it like 0.8", error=MaterialError)

    @property
    def file(self) -> Path | None:
        """The file that is given, or the name of a preset."""
        return self.object if self.splat is None else self.splat

    @property
    def preset(self) -> str | None:
        """The preset that is named in place of a file."""
        from softmode.objects.shapes.presets import PRESETS

        return str(self.file) if str(self.object) in PRESETS else None

    @property
    def material(self) -> dict[str, float]:
        """The properties of the material that are given."""
        return {name: getattr(self, name) for name in _MATERIAL if getattr(self, name) is not None}

    @property
    def shape(self) -> dict[str, Any]:
        """The options that say how a file becomes an object, as fields of `ObjectConfig`."""
        names = ("size", "up", "crop", "part", "pose", "resolution", "stiffness_file", "density_file", "material_file")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        given |= {"march": True} if self.march else {}
        if self.stiffness:
            given["stiffness"] = tuple(map(stiffer_box, self.stiffness))
        for what in ("stiffness", "density"):
            if colors := getattr(self, f"{what}_by_color"):
                from softmode.objects.paint import StifferColor

                given[f"{what}_colors"] = tuple(map(StifferColor.parse, colors))
        return given

    @property
    def is_given(self) -> bool:
        """Whether any option is."""
        return self != ObjectOptions()

    def object_of(self, base: ObjectConfig) -> ObjectConfig:
        """Return the object that the options make of another one.

        Raises:
            AssetError: If the file is missing or cannot be read.
            ConfigError: If an option says nothing about this object.
        """
        from softmode.objects.config import PAINTED, ObjectConfig
        from softmode.objects.loader import object_config

        self.check()
        given: dict[str, Any] = self.shape
        like = {"surface_count": base.surface_count, "build": base.build}
        if self.splat is not None:
            base = ObjectConfig(splat=self.splat, **like)
        elif self.object is not None:
            base = object_config(self.object, **like)
        if base.body is not None:
            self._refuse({*given} - {"march"}, f"the body {base.body}", "give them to softmode body build")
        elif base.extents is not None:
            self._refuse(
                set(given) - {*PAINTED},
                f"a {base.shape} of {base.extents} m",
                "give a --splat file too",
            )
        elif base.mesh is not None or base.preset is not None:
            what = f"the mesh {base.mesh}" if base.preset is None else f"the preset {base.preset}"
            self._refuse({*given} & {*_SPLAT_ONLY}, what, "they are for splats: leave them out")
        elif base.radiance is not None:
            self._refuse({*given} & {"part"}, f"the field {base.radiance}", "it is for splats: leave it out")
        return base.changed(**given) if given else base

    def configured(self, config: Config) -> Config:
        """Return the configuration of a task with this object and material, the same in all episodes.

        Raises:
            AssetError: If the file is missing or cannot be read.
            ConfigError: If an option says nothing about this object, or the task cannot have it.
        """
        from softmode.objects.material_field import read_material
        from softmode.objects.object_file import read_object, stored_material
        from softmode.objects.shapes.presets import find_preset

        thing = self.object_of(config.scene.object).pinned()
        stored = {} if thing.body is None else stored_material(read_object(thing.body).body)
        if thing.preset is not None:
            stored = find_preset(thing.preset).properties
        if thing.material_file is not None:
            stored = {**stored, **read_material(thing.material_file).means}
        made = {**stored, **self.material}
        material = dataclasses.replace(config.scene.material, **made)
        scene = dataclasses.replace(config.scene, object=thing, material=material)
        fixed = {f"{name}_range": None for name in made}
        return dataclasses.replace(config, scene=scene, **fixed)

    def env_options(self, env: str, options: dict[str, Any]) -> dict[str, Any]:
        """Return keyword arguments of an environment with this object, as JSON can hold them.

        Raises:
            AssetError: If the file is missing or cannot be read.
            ConfigError: If the environment is not softmode's, or cannot have it.
        """
        from softmode.learning.config_values import joined_config, pinned_options, split_config

        self.check()
        if not self.is_given:
            return pinned_options(env, options)
        config, rest = split_config(env, options)
        return joined_config(env, self.configured(config), rest)

    @staticmethod
    def _refuse(given: Any, what: str, hint: str) -> None:
        """Refuse options that say nothing about an object."""
        if given:
            raise ConfigError(f"{', '.join(map(typed, given))} given for {what}", hint=hint)


def typed(field: str) -> str:
    """Return an option as it is typed, from the field that it becomes."""
    return f"--{field.replace('_colors', '_by_color').replace('_', '-')}"


def named_numbers(option: str, text: str, counts: tuple[int, ...]) -> tuple[str, list[float]]:
    """Return the name and the numbers of NAME=number,number,..."""
    name, _, values = text.partition("=")
    try:
        found = [float(word) for word in values.split(",")]
    except ValueError:
        found = []
    if not name or len(found) not in counts:
        raise ConfigError(
            f"{option} {text!r}: expected NAME= and {' or '.join(map(str, counts))} numbers separated by commas",
            hint=f"give it like --{option} root=-inf,-inf,-inf,inf,inf,0.01" + (",10" if 6 not in counts else ""),
        )
    return name, found


def stiffer_box(text: str) -> StifferBox:
    """Return the part NAME=x0,y0,z0,x1,y1,z1,factor."""
    from softmode.objects.config import StifferBox

    _, (x0, y0, z0, x1, y1, z1, factor) = named_numbers("stiffness", text, (7,))
    return StifferBox(box=(x0, y0, z0, x1, y1, z1), factor=factor)
