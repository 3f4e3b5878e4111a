"""Values that a live session takes and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_fields, require_number
from softmode.errors import ConfigError

SceneName = Literal["hang", "drop"]
"""How an object without an environment is set up: held by a part of it, or dropped on a table."""
HoldName = Literal["top", "base"]
"""Which end of a hanging object is held."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """How a live session runs."""

    substep: float = 1.0 / 240.0
    """Physics step of an object without an environment [s]; an environment has its own."""
    budget: float = 0.7
    """Share of the time of a frame that physics may take; beyond it simulated time falls behind the clock."""
    pin_max: int = 6
    """Regions of an object that may be pinned at a time."""
    pin_points: int = 16
    """Points of an object that hold a pinned region."""
    drag_stiffness: float = 0.25
    """Stiffness of the spring between object and cursor over E times the object's size."""
    drag_rate: float = 250.0
    """The spring is no stiffer than the object's mass times the square of this [1/s]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_number("substep", self.substep, at_least=1.0e-4, at_most=0.05, unit="s")
        require_number("budget", self.budget, at_least=0.001, at_most=1.0e6)
        require_number("pin_max", self.pin_max, at_least=0, at_most=64)
        require_number("pin_points", self.pin_points, at_least=4, at_most=64, hint="four points hold a turn")
        require_fields(self, ("drag_stiffness", "drag_rate"), above=0.0)


@dataclass(frozen=True, kw_only=True)
class LiveParameters:
    """What may be changed while a session runs; the present values."""

    youngs_modulus: float
    """E [Pa]."""
    poissons_ratio: float
    """nu."""
    density: float
    """rho [kg/m^3]."""
    viscosity: float
    """beta of Rayleigh's damping [s]."""
    mass_damping: float
    """alpha of Rayleigh's damping [1/s]."""
    friction: float
    """Coulomb coefficient of the object."""
    gravity: tuple[float, float, float]
    """Gravity [m/s^2]."""
    functions: int
    """Scalar functions of the body; it has three unknowns for each."""


@dataclass(frozen=True, kw_only=True)
class Hit:
    """Where a ray meets an object."""

    point: NDArray[np.float64]
    """Position in the world [m], shape (3,)."""
    rest_point: NDArray[np.float64]
    """The same material point in the body frame at rest [m], shape (3,)."""
    distance: float
    """From the ray's origin [m]."""
    object_index: int
    """Which soft object of the session."""
    splat: int
    """Which splat of `SplatPicture`."""


@dataclass(frozen=True, kw_only=True)
class SplatPicture:
    """All splats of a session; colours do not change, the rest is of one moment."""

    means: NDArray[np.float32]
    """Centres [m], shape (N, 3)."""
    covariances: NDArray[np.float32]
    """Covariances [m^2], shape (N, 3, 3)."""
    colors: NDArray[np.float32]
    """sRGB colours of degree zero, 0..1, shape (N, 3)."""
    opacities: NDArray[np.float32]
    """Opacities 0..1, shape (N,)."""


@dataclass(frozen=True, kw_only=True)
class DragView:
    """A drag as it is now."""

    point: NDArray[np.float64]
    """The gripped point of the object [m], shape (3,)."""
    target: NDArray[np.float64]
    """Where the cursor pulls it [m], shape (3,)."""
    force: NDArray[np.float64]
    """Force of the spring on the object [N], shape (3,)."""


@dataclass(frozen=True, kw_only=True)
class PinView:
    """A pin as it is now."""

    position: NDArray[np.float64]
    """Centre of the pinned region where it should be [m], shape (3,)."""
    wxyz: NDArray[np.float64]
    """Turn of the region since it was pinned, as a unit quaternion (w, x, y, z)."""
    points: NDArray[np.float64]
    """The pinned points of the object where they are [m], shape (n, 3)."""
    error: float
    """Largest distance of a pinned point from where it should be [m]."""
    object_index: int
    """Which soft object is pinned."""


@dataclass(frozen=True, kw_only=True)
class Energies:
    """Energies of all soft objects at the end of the last step [J]."""

    kinetic: float
    """1/2 m v^2."""
    elastic: float
    """Stored in deformation."""
    gravitational: float
    """-m g . x of the centres of mass, zero at the world's origin."""

    @property
    def total(self) -> float:
        """Their sum."""
        return self.kinetic + self.elastic + self.gravitational


@dataclass(frozen=True, kw_only=True)
class LiveStatus:
    """What a session has to tell."""

    time: float
    """Simulated time since the last reset [s]."""
    playing: bool
    """Whether time runs."""
    realtime_factor: float
    """Simulated time over the clock's, during the last second of playing; 0 before there is anything to tell."""
    step_milliseconds: float
    """Mean time that one physics step takes [ms]."""
    solver: tuple[str, ...]
    """Names of the solver's flags in the last frame, empty if all is well; see `softmode.deformables.model.status`."""
    recording: bool
    """Whether a recording is being made."""
    notice: str
    """What a person should know: pins that the body was not built for, a build that is under way. Empty if nothing."""
    reward_terms: dict[str, float]
    """The reward's terms in the last control step, empty without an environment."""
    success: bool
    """Whether the environment's task counts as solved."""
    episode: int
    """Episodes begun, 1 at first."""


Vector = NDArray[np.float64]


def finite_vector(name: str, value: ArrayLike, count: int = 3) -> Vector:
    """Return finite numbers as float64.

    Args:
        name: What messages call them.
        value: The numbers, shape (count,).
        count: How many there must be, 3 or 4.

    Raises:
        ConfigError: If they are not.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ConfigError(f"{name} must be {'three' if count == 3 else 'four'} finite numbers, got {value!r}")
    return numbers
