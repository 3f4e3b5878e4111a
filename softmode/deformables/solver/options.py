"""How a step is solved."""

import math
from dataclasses import dataclass
from typing import Literal

from softmode.checks import require_fields
from softmode.errors import ConfigError

Integrator = Literal["euler", "bdf2"]


@dataclass(frozen=True, kw_only=True)
class SolverReducedOptions:
    """How a step is solved."""

    integrator: Integrator = "euler"
    """"euler": implicit Euler, first order, damps what a step cannot resolve. "bdf2": damps less; without viscosity
    (whose stress is differenced backwards) its order was measured as 1.7 to 1.9 in bending and 0.8 to 1.3 in a free
    motion. It needs equal steps, and takes an Euler step where there is none before, as after a reset, and where a body
    has contacts or is attached to a rigid body. Who writes q or qd must set ``state.softmode.dt_before`` of the
    instance to 0."""
    keep_spin: bool = True
    """Whether Euler steps follow the rotation of a body, so that a free one keeps its spin. Bodies with exact regions,
    and those that turn by more than 1 rad in a step or so fast that they fly apart, take the plain step, which costs
    half of a 10 rad/s spin in a second at 60 Hz, as all do without this."""
    iteration_max: int = 40
    """Newton iterations at most."""
    stiffness_renewal: int = 5
    """The elastic Hessian is assembled every so many iterations at least (contact always is), and"""
    renewal_distance: float = 1.0e-3
    """after an iteration that moved a body by more than this fraction of its size (rms). 0 is Newton's own method."""
    carry_stiffness: bool = False
    """Whether a step may start with the elastic Hessian of the step before, where no body has bent or turned by more
    than that since: half of the time of a body at rest. It changes results within the tolerances; what a step starts
    with is then no longer in its state alone, so that a replayed step agrees within the tolerances, not to the bit."""
    tolerance: float = 1.0e-5
    """Newton stops when every body that touches nothing moved less than this fraction of its size (rms) in an
    iteration, and"""
    force_tolerance: float = 1.0e-5
    """when the residual force on every body near a contact, and on every joint that it may push, is below this fraction
    of the forces on it."""
    friction_lag: int = 8
    """Iterations during which the normal force that limits friction follows the contact; then it is frozen, and what is
    left is the minimisation of one potential. Newton converges linearly until then where bodies slide: fewer make a
    step cheaper, and friction of the last iterate but a few."""
    step_length_min: float = 2.0**-16
    """Shortest step the line search tries."""
    contact_max: int | None = None
    """Contacts per instance at most; more raise the overflow flag and drop those that do not touch yet. None for one
    per surface sample of the body that has most, two where it is so thin that both sides may touch one thing, and 256
    at least. Less than these samples need is refused where there is anything to touch; what others press besides may
    need more."""
    contact_margin: float = 0.01
    """Detection distance as a fraction of the body size, on top of twice the motion of the step."""
    soft_contact: bool = True
    """Whether soft bodies touch each other, and themselves where ``self_contact`` says so."""
    contact_smoothing: float = 8.0e-4
    """Range of the onset of the contact of a level face as a fraction of the body size, or of three times its thickness
    where that is less. That of a tilted or curved one is the range of the gaps of its sample's cell."""
    stick_ratio: float = 1.0
    """Tangential over normal stiffness of a contact that sticks to a shape; friction remembers where, so that nothing
    creeps. 0 forgets: friction is Coulomb's smoothed over ``stick_velocity``, and what it holds creeps at up to it."""
    stick_velocity: float = 1.0e-4
    """Slip velocity [m/s] below which friction without memory counts as sticking."""

    def contact_room(self, sample_room: int) -> int:
        """Return how many contacts an instance may have where its samples may have so many at a time."""
        return self.contact_max or max(256, 64 * math.ceil(sample_room / 64))

    def __post_init__(self) -> None:
        """Check every range."""
        if self.integrator not in ("euler", "bdf2"):
            raise ConfigError(f"integrator must be 'euler' or 'bdf2', got {self.integrator!r}")
        require_fields(self, ("iteration_max", "stiffness_renewal"), at_least=1)
        if self.contact_max is not None:
            require_fields(self, ("contact_max",), at_least=1)
        require_fields(self, ("friction_lag",), at_least=0)
        require_fields(self, ("renewal_distance", "stick_ratio"), at_least=0.0)
        positive = ("tolerance", "force_tolerance", "step_length_min", "contact_margin", "contact_smoothing")
        require_fields(self, (*positive, "stick_velocity"), above=0.0)
