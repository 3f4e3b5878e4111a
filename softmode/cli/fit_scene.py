"""`FitScene`: what a user tells of a film, markers or a force log, from the options of a command or a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from softmode.checks import require_number, require_numbers
from softmode.errors import ConfigError, MaterialError
from softmode.files import read_json
from softmode.fitting.estimates import UNSEEN
from softmode.fitting.marker_fit import MarkerPlaces
from softmode.fitting.worlds import FREE
from softmode.splats.raster.pinhole import PinholeCamera

KINDS = ("held", "press", "between")
"""What may happen to an object that is fitted."""


@dataclass(frozen=True, kw_only=True)
class FitScene:
    """How an object is held, filmed and weighed; lengths in the axes of its file as `splat show` draws them."""

    kind: str | None = None
    """ "held": held by one end and let go; "press", "between": see `Press`; None for what the file and options say."""
    held: str | None = None
    """Its end, as `Held.parse` takes it."""
    fps: float | None = None
    """Frames per second at which a film was taken that plays at another rate."""
    exposure: float = 0.0
    """For how long a frame sees [s]."""
    free: Sequence[str] = ()
    """What is fitted besides."""
    mass: float | None = None
    """[kg]."""
    density: float | None = None
    """[kg/m^3]."""
    poissons_ratio: float | None = None
    """Poisson's ratio."""
    camera: dict[str, Any] = field(default_factory=dict)
    """``position``, and ``target`` or ``quat`` (xyzw, OpenCV's axes); ``fov_y`` [rad], or ``matrix`` for the pixels of
    the file."""
    markers: dict[str, list[float]] = field(default_factory=dict)
    """Places of markers on the object."""
    axes: Sequence[str] = ("+x", "+y", "+z")
    """Axes of the markers' file that are the object's."""
    load: dict[str, list[float]] = field(default_factory=dict)
    """``force`` [N] that hangs on it, and ``at`` [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.kind is not None and self.kind not in KINDS:
            hint = f"hold it by one end and let it go, or press it with a scale: kind is one of {', '.join(KINDS)}"
            raise ConfigError(f"kind is {self.kind!r}: what is thrown, dropped or poked shows no E for sure", hint=hint)
        kinds = {
            "held": str | None,
            "camera": dict,
            "markers": dict,
            "load": dict,
            "axes": list | tuple,
            "free": list | tuple,
        }
        for name, kind in kinds.items():
            if not isinstance(value := getattr(self, name), kind):
                hint = "give held as text, camera, markers and load as objects, axes and free as lists"
                raise ConfigError(f"scene: {name} is {value!r}", hint=hint)
        for name, example in (("mass", "0.142, in kg"), ("density", "300, in kg/m^3")):
            if (value := getattr(self, name)) is not None:
                require_number(name, value, above=0.0, hint=f"give it like {example}", error=MaterialError)
        if self.mass is not None and self.density is not None:
            raise ConfigError("mass and density are given", hint="give one of them")
        if self.poissons_ratio is not None:
            require_number("poissons_ratio", self.poissons_ratio, above=-1.0, below=0.5, error=MaterialError)
        if odd := [name for name in self.free if name not in (*FREE, *UNSEEN)]:
            raise ConfigError(f"free: {odd} is not known", hint=f"use {', '.join((*FREE, *UNSEEN))}")
        require_number("exposure", self.exposure, at_least=0.0, at_most=1.0, hint="give it in seconds, like 0.01")
        if self.fps is not None:
            require_number("fps", self.fps, above=0.0, at_most=1.0e5, hint="give frames per second, like 240")

    @classmethod
    def read(cls, path: Path | None, **options: Any) -> FitScene:
        """Return what a JSON file says, or nothing; options that are given replace it.

        Raises:
            AssetError: If the file cannot be read.
            ConfigError: If it says what is not known, or a value is out of range.
        """
        told = {} if path is None else read_json(path, "scene file")
        known = [entry.name for entry in fields(cls)]
        if not isinstance(told, dict) or set(told) - set(known):
            odd = ", ".join(sorted(set(told) - set(known))) if isinstance(told, dict) else json.dumps(told)[:60]
            raise ConfigError(f"scene file {path}: {odd} is not known", hint=f"use {', '.join(known)}")
        given = {name: value for name, value in options.items() if value is not None}
        if "mass" in given or "density" in given:
            told = {name: value for name, value in told.items() if name not in ("mass", "density")}
        return cls(**{**told, **given})

    def check_kind(self, what: str, kind: str) -> None:
        """Refuse a scene of another kind than that of what is fitted."""
        if self.kind not in (None, kind):
            hint = "leave it out, or give the file and the options of that kind"
            raise ConfigError(f"kind is {self.kind!r}, and what is given is {what}: {kind}", hint=hint)

    def density_of(self, volume: float, otherwise: float) -> tuple[float, bool]:
        """Return the density [kg/m^3] of an object of a volume [m^3], else another one, and whether it was told."""
        if self.mass is not None:
            return self.mass / volume, True
        return (otherwise, False) if self.density is None else (self.density, True)

    def places(self) -> MarkerPlaces:
        """Return how markers lie on the object."""
        force, at = self.load.get("force", [0.0, 0.0, 0.0]), self.load.get("at")
        require_numbers("load force", force, 3)
        if at is not None:
            require_numbers("load at", at, 3)
        for name, point in self.markers.items():
            require_numbers(f"marker {name}", point, 3)
        return MarkerPlaces(points=self.markers, axes=self.axes, load=force, load_at=at)

    def pinhole(self, width: int, height: int, shrink: float) -> PinholeCamera:
        """Return the camera for frames of a size [px] that are a file's made smaller.

        Raises:
            ConfigError: If it is not told.
        """
        hint = 'give --camera X Y Z, or a scene file with "camera": {"position": [...], "target": [...], "fov_y": 0.8}'
        told = dict(self.camera)
        known = {"position", "target", "quat", "fov_y", "matrix"}
        if "position" not in told or set(told) - known or ("target" in told) == ("quat" in told):
            raise ConfigError(f"camera is {told or 'not told'}", hint=hint)
        for name, count in (("position", 3), ("target", 3), ("quat", 4)):
            if name in told:
                require_numbers(f"camera {name}", told[name], count, hint=hint)
        place: Any = tuple(told["position"])
        fov = told.get("fov_y", 0.8)
        require_number("camera fov_y", fov, above=0.0, below=np.pi, hint=hint)
        target: Any = told.get("target", np.add(place, (0.0, 1.0, 0.0)))
        camera = PinholeCamera.look_at("film", position=place, target=target, fov_y=fov, width=width, height=height)
        if "quat" in told:
            camera = replace(camera, quat=tuple(told["quat"]))
        if "matrix" in told:
            rows = told["matrix"]
            for row in rows if isinstance(rows, list) and len(rows) == 3 else (rows,):
                require_numbers("a row of the camera's matrix", row, 3, hint=hint)
            k = np.asarray(told["matrix"], float) * shrink
            camera = replace(camera, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2])
        return camera
