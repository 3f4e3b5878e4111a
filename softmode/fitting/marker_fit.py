"""`fit_markers`: what an object is made of that is held by one end and let go, from markers on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError, FitError
from softmode.fitting.estimates import Estimate, Fitted, asked_for
from softmode.fitting.film_fit import SPECIFIC
from softmode.fitting.least_squares import Solution, Space, cost_of, minimise
from softmode.fitting.tables import Markers
from softmode.fitting.worlds import FREE, HeldWorlds, physics_rows
from softmode.objects.frame import in_body
from softmode.objects.soft_object import SoftObject

Array = NDArray[np.float64]
REST = 1.0
"""Last part of a take in which the object has to hang still, for its sag [s]."""
STILL = 0.02
"""Speed below which it hangs still, over the largest way per second."""
PLACE = 0.02
"""Standard deviation of ln E for where the markers and the clamp are: 3 mm of overhang of 100 are 4.5 % of E."""
STEP = 1.0 / 400.0
"""Step of the worlds [s]."""
LOADED = 24
"""Surface samples that a load is spread over."""


@dataclass(frozen=True, kw_only=True)
class MarkerPlaces:
    """How markers lie on the object."""

    points: Mapping[str, Sequence[float]]
    """Places of markers on the object at rest, in the axes of its file [m]; others are not used."""
    axes: Sequence[str] = ("+x", "+y", "+z")
    """Which axes of the markers' file are x, y and z of the object's."""
    load: Sequence[float] = (0.0, 0.0, 0.0)
    """Force that hangs on it, in the axes of the object's file [N]."""
    load_at: Sequence[float] | None = None
    """Where."""

    @property
    def rotation(self) -> Array:
        """What turns the markers' axes into the object's, shape (3, 3).

        Raises:
            ConfigError: If the axes are no right-handed three.
        """
        found = np.zeros((3, 3))
        for row, axis in zip(found, map(str, self.axes), strict=False):
            if len(axis) == 2 and axis[0] in "+-" and axis[1] in "xyz":
                row["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
        if len(self.axes) != 3 or not np.isclose(np.linalg.det(found), 1.0):
            hint = "say which axes of the markers are x, y and z of the object, right-handed, like +z -y +x"
            raise ConfigError(f"axes are {' '.join(map(str, self.axes))}", hint=hint)
        return found


class MarkerFit:
    """A held object beside markers on it.

    Args:
        thing: The object with its end held, see `held_object`.
        places: How markers lie on it.
        material: Density and Poisson's ratio.
        device: Warp device.

    Raises:
        ConfigError: If no marker has a place, or one lies far from the object.
    """

    def __init__(
        self, thing: SoftObject, places: MarkerPlaces, *, material: Material, device: wp.DeviceLike = None
    ) -> None:
        """Find the functions at the markers."""
        if not places.points:
            hint = 'say where they are on the object: "markers": {"m0": [x, y, z], ...}'
            raise ConfigError("markers: none has a place", hint=hint)
        self.thing, self.places, self.material, self._device = thing, places, material, device
        body = thing.body
        rest = in_body(body, list(places.points.values()))
        off = np.linalg.norm(rest[:, None] - body.surface.points, axis=2).min(axis=1)
        size = float(np.ptp(body.bounds, axis=0).max())
        if off.max() > 0.1 * size:
            name = list(places.points)[int(off.argmax())]
            raise ConfigError(f"marker {name} lies {off.max():.3g} m from the object", hint="check places and --size")
        self._basis = body.evaluate(rest)[0]
        self._load = np.zeros((body.surface_count, 3))
        if any(places.load):
            if places.load_at is None:
                raise ConfigError("load hangs nowhere", hint='say where: "load": {"force": [...], "at": [x, y, z]}')
            at = in_body(body, places.load_at)
            near = np.argsort(np.linalg.norm(body.surface.points - at, axis=1))[:LOADED]
            self._load[near] = np.array(places.load) / len(near)

    def _worlds(self, count: int, dt: float) -> HeldWorlds:
        """Return worlds of the object with the load on it."""
        worlds = HeldWorlds(self.thing.body, self.material, count, dt=dt, device=self._device)
        worlds.hang(self._load)
        return worlds

    def moved(self, markers: Markers) -> Array:
        """Return how far the markers are from where they were before the release [m], (F, M, 3), in the object's axes.

        Raises:
            FitError: If the file lacks a marker.
        """
        some = markers.of(list(self.places.points))
        still = some.places[max(some.release - 30, 0) : max(some.release - 2, 3)].mean(axis=0)
        return (some.places - still) @ self.places.rotation.T

    def sag(self, moduli: ArrayLike) -> Array:
        """Return where the markers rest under gravity and the load, for each Young's modulus [m], (W, M, 3)."""
        moduli = np.atleast_1d(np.asarray(moduli, float))
        worlds = self._worlds(len(moduli), 0.05)
        q = worlds.run({"youngs_modulus": moduli, "viscosity": 0.05}, 8.0, every=160)[1]
        return np.einsum("mk,wkc->wmc", self._basis, q[-1] - q[0])

    def fit_rest(self, rest: Array, about: float) -> float:
        """Return the Young's modulus [Pa] with which the markers sag as far as they do at rest (M, 3), on average.

        NaN where no modulus from a half to twice a value that it is about [Pa] does.
        """
        moduli = about * np.geomspace(0.5, 2.0, 8)
        down, sag = np.maximum(-self.sag(moduli)[:, :, 2].mean(axis=1), 1e-12), max(-float(rest[:, 2].mean()), 1e-15)
        at = np.interp(np.log(sag), np.log(down[::-1]), np.log(moduli)[::-1], left=np.nan, right=np.nan)
        return float(np.exp(at))

    def fit_motion(self, markers: Markers, free: Sequence[str] = ()) -> tuple[Solution, dict[str, float], float]:
        """Fit the motion after the release.

        Args:
            markers: Where they are.
            free: Which of `FREE` are fitted.

        Returns:
            The solution, of which the last parameter is the start of the motion; the standard deviations of its free
            parameters by name; and the rms of what is left [m].
        """
        moved, markers = self.moved(markers), markers.of(list(self.places.points))
        release = markers.times[markers.release]
        last = min(len(moved) - 1, int(np.searchsorted(markers.times, release + 1.5)))
        frames = np.arange(markers.release, last + 1)
        times, noise = markers.times[frames], max(markers.noise, 2.0e-4)
        worlds = self._worlds(5 + len(free), STEP)
        start = (release, 2.0 * float(np.median(np.diff(markers.times))), 0.002, release - 0.05, release + 0.05)
        space = Space.of({**physics_rows(self.material), "start": start})
        names = [name for name in space.names if name not in FREE or name in free]

        def residuals(sets: Array) -> Array:
            q = worlds.states(sets[:, :-1], sets[:, -1], times)  # zero at rest
            return ((np.einsum("mk,wtkc->wtmc", self._basis, q) - moved[frames]) / noise).reshape(len(sets), -1)

        starts = np.repeat(space.mean[None], len(SPECIFIC), axis=0)
        starts[:, 0] = np.log(SPECIFIC * self.material.density)
        costs = cost_of(residuals(starts))
        best = min(
            (minimise(residuals, space, starts[k], names, rounds=30, tolerance=1e-4) for k in np.argsort(costs)[:2]),
            key=lambda one: one.cost,
        )
        blocks = np.array_split(np.arange(len(best.residuals)).reshape(len(frames), -1), 12)
        deviations = dict(zip(names, best.deviations([b.ravel() for b in blocks]), strict=True))
        return best, deviations, float(np.sqrt((best.residuals**2).mean()) * noise)


def fit_markers(
    thing: SoftObject,
    markers: Markers,
    places: MarkerPlaces,
    *,
    material: Material,
    free: Sequence[str] = (),
    device: wp.DeviceLike = None,
) -> Fitted:
    """Fit Young's modulus and viscosity to the motion of markers, and Young's modulus to where they come to rest.

    Args:
        thing: The object with its end held, see `held_object`.
        markers: Where they are.
        places: How they lie on the object.
        material: Density and Poisson's ratio.
        free: What is fitted besides, of `worlds.FREE` and `estimates.UNSEEN`.
        device: Warp device.

    Raises:
        FitError: If nothing moves.
    """
    fit = MarkerFit(thing, places, material=material, device=device)
    best, deviation, left = fit.fit_motion(markers, [name for name in free if name in FREE])
    x, moved = best.x, fit.moved(markers)
    if left > 0.4 * float(np.sqrt((moved**2).mean())):
        what = f"{markers.source}: not observable, because the twin does not follow the markers ({1e3 * left:.2g} mm)"
        raise FitError(what, hint="check places and axes of the markers, --held, and that it is let go")
    motion = Estimate.of_logarithm(x[0], float(np.hypot(deviation["youngs_modulus"], PLACE)), unit="Pa")
    estimates = {"youngs_modulus": motion}
    notes = [f"what is left of the motion: {1e3 * left:.2g} mm rms"]
    tail = markers.times > markers.times[-1] - REST
    ways = np.linalg.norm(moved, axis=2)
    if ways[tail].std(axis=0).max() < STILL * ways.max() and tail.sum() > 5:
        still = fit.fit_rest(moved[tail].mean(axis=0), motion.value)
        stiffer = motion.value / still - 1.0
        if np.isnan(still):
            notes.append("where it rests needs less than half or more than twice that E: check axes and load")
        else:
            at_rest = Estimate.of_logarithm(float(np.log(still)), PLACE, unit="Pa")
            estimates = {"youngs_modulus": at_rest, "youngs_modulus_in_motion": motion}
        if abs(stiffer) > 3.0 * deviation["youngs_modulus"]:
            word = "stiffer" if stiffer > 0 else "softer"
            notes.append(f"{word} in motion by {abs(stiffer):.0%}: the material is rate dependent")
    viscosity = Estimate.of_logarithm(x[1], float(np.hypot(deviation["viscosity"], 0.1)), unit="s")
    estimates |= {"viscosity": viscosity} | asked_for(free, material, best.space, x, deviation)
    return Fitted.of(markers, estimates, material, notes, start=float(x[-1]), rms=left)
