"""`Estimate` and `Fitted`: what a fit found, with bars, as ``fit.json`` and a material have it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from softmode import __version__
from softmode.deformables.materials.material import Material
from softmode.files import PendingFile
from softmode.fitting.film import Clip
from softmode.fitting.least_squares import Array, Space
from softmode.fitting.tables import ForceLog, Markers
from softmode.objects.object_file import write_object
from softmode.objects.soft_object import SoftObject

FLOOR = 0.03
"""Least standard deviation of ln E: bodies that were filled anew from 12,000 splats were off by it (median 2.4 %)."""
THIN = (0.05, 0.12)
"""Mean thickness over size, and what it adds to it: a mug was off by 17 %, its walls filled too thick."""
CERTAIN = 0.35
"""Standard deviation of a logarithm above which a parameter is not observable."""
UNSEEN = {
    "density": "a motion shows E over density and nothing else: weigh the object",
    "friction": "nothing slides on an object that is held",
}
"""Numbers of a material that no fit finds, and why."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A parameter that was fitted."""

    value: float
    """The value."""
    low: float
    """The value one standard deviation lower."""
    high: float
    """One higher."""
    observable: bool
    """Whether the data say it."""
    unit: str = ""
    """Its unit."""
    reason: str = ""
    """Why it is not observable, or what the bar does not hold."""

    @classmethod
    def of_logarithm(cls, mean: float, deviation: float, *, unit: str, reason: str = "") -> Estimate:
        """Return the estimate of a positive number from its logarithm's mean and standard deviation."""
        low, high = math.exp(mean - deviation), math.exp(mean + deviation)
        known = deviation < CERTAIN and not reason
        told = reason or ("" if known else f"the bar spans a factor of {high / low:.2g}")
        return cls(value=math.exp(mean), low=low, high=high, observable=known, unit=unit, reason=told)


def asked_for(
    free: Sequence[str], material: Material, space: Space, x: Array, deviations: Mapping[str, float]
) -> dict[str, Estimate]:
    """Return the estimates of numbers that a fit was asked for; those of `UNSEEN` are what was told.

    Args:
        free: Their names.
        material: What was told.
        space: The parameters of the fit.
        x: Their values.
        deviations: The standard deviations of those that were free.
    """
    found = {}
    for name in free:
        unit, reason = {"mass_damping": "1/s", "density": "kg/m^3"}.get(name, ""), UNSEEN.get(name, "")
        value, deviation = float(getattr(material, name)), 0.0
        low = high = value
        if not reason:
            at = space.names.index(name)
            value, deviation = float(x[at]), deviations[name]
            low, high = max(value - deviation, float(space.low[at])), min(value + deviation, float(space.high[at]))
            if deviation > 0.5 * space.prior[at]:
                reason = f"the data look the same from {low:.2g} to {high:.2g} {unit}".rstrip()
        found[name] = Estimate(value=value, low=low, high=high, observable=not reason, unit=unit, reason=reason)
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """What a fit found."""

    source: str
    """Film, markers or force log."""
    fingerprint: str
    """sha256 of its file."""
    estimates: dict[str, Estimate]
    """By the names of a material's numbers."""
    material: Material
    """What the object is made of: what was found, else what was told."""
    notes: tuple[str, ...] = ()
    """What the user should know."""
    details: dict[str, Any] = field(default_factory=dict)
    """Camera, start, residual of each frame, costs: as JSON holds them."""

    @classmethod
    def of(
        cls,
        data: Clip | Markers | ForceLog,
        estimates: dict[str, Estimate],
        told: Material,
        notes: Sequence[str],
        **details: Any,
    ) -> Fitted:
        """Return what was found of data; the material is what was told, with the numbers that are observable."""
        names = [name for name, one in estimates.items() if one.observable and hasattr(told, name)]
        found = {"material": replace(told, **{name: estimates[name].value for name in names}), "notes": tuple(notes)}
        about = {"source": data.source, "fingerprint": data.fingerprint}
        return cls(estimates=estimates, details=details, **about, **found)

    def __getitem__(self, name: str) -> Estimate:
        """Return an estimate."""
        return self.estimates[name]

    def unweighed(self) -> Fitted:
        """Return what is known of an object whose mass is not: E over density, and E for the material's density."""
        modulus, density = self["youngs_modulus"], self.material.density
        over = {name: getattr(modulus, name) / density for name in ("value", "low", "high")}
        estimates = {"youngs_modulus_over_density": replace(modulus, unit="m^2/s^2", **over), **self.estimates}
        note = f"E is for {density:g} kg/m^3, which was not measured: give --mass for E"
        return replace(self, estimates=estimates, notes=(*self.notes, note))

    @property
    def json(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        told = {name: asdict(found) for name, found in self.estimates.items()}
        about = {"softmode": __version__, "source": self.source, "fingerprint": self.fingerprint}
        return {**about, "parameters": told, "notes": list(self.notes), **self.details}

    def lines(self) -> list[str]:
        """Return what is printed: a line for each parameter, then the notes."""
        found = []
        for name, one in self.estimates.items():
            scale, unit = {"Pa": (1e-3, "kPa"), "s": (1e3, "ms")}.get(one.unit, (1.0, one.unit))
            title = name.replace("youngs_modulus", "Young's modulus").replace("_", " ")
            value = f"{scale * one.value:.3g} {unit} ({scale * one.low:.3g} to {scale * one.high:.3g})"
            found.append(f"{title}: {value}" if one.observable else f"{title}: not observable, because {one.reason}")
        lost = {k: one.unit for k, one in self.estimates.items() if not one.observable and hasattr(self.material, k)}
        kept = [
            f"the twin keeps {k} = {getattr(self.material, k):.3g} {u}, which was not found" for k, u in lost.items()
        ]
        return [*found, *kept, *self.notes]

    def write(self, path: Path) -> None:
        """Write ``fit.json``; it appears whole or not at all."""
        with PendingFile(path, "fit") as file:
            file.temporary.write_text(json.dumps(self.json, indent=1) + "\n")

    def save(self, path: Path, thing: SoftObject) -> SoftObject:
        """Write an object with the material that was found, which `load` brings, and return it.

        Args:
            path: The .npz to write.
            thing: The object, free; what was found and from which film goes into its body's provenance.
        """
        names = ("youngs_modulus", "poissons_ratio", "density", "viscosity", "mass_damping", "friction")
        numbers = {name: getattr(self.material, name) for name in names}
        bars = {name: [one.low, one.value, one.high] for name, one in self.estimates.items() if one.observable}
        fit = {"source": self.source, "fingerprint": self.fingerprint, "parameters": bars}
        told = {"material": json.dumps(numbers), "fit": json.dumps(fit)}
        body = replace(thing.body, provenance={**thing.body.provenance, **told})
        write_object(path, body, thing.splats, thing.radiance)
        return replace(thing, body=body, material=self.material)


def floor_of(thing: SoftObject) -> float:
    """Return the standard deviation of ln E that the filling of an object leaves: more of few splats and thin walls."""
    if thing.config is None or thing.config.kind != "splat" or thing.splats is None:
        return FLOOR
    surface, body = thing.body.surface, thing.body
    thickness = 2.0 * body.volume / float(surface.areas.sum()) / float(np.ptp(body.bounds, axis=0).max())
    few = FLOOR * float(np.clip(np.sqrt(12_000 / max(thing.splats.count, 1)), 1.0, 2.0))
    return float(np.hypot(few, THIN[1] * (THIN[0] / thickness) ** 2))
