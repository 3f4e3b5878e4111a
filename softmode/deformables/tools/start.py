"""`set_states`: coordinates, velocities and dents of the soft bodies of a batch of worlds, in one call."""

from __future__ import annotations

import newton
import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.namespaces import soft
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.errors import ConfigError


def set_states(
    solver: ReducedSolver,
    state: newton.State,
    *,
    q: ArrayLike | None = None,
    qd: ArrayLike | None = None,
    dent: ArrayLike | None = None,
) -> None:
    """Put every soft body of a state where it is said to be; what is left out stays.

    No step led there: BDF2 starts over, and friction forgets what the surface stuck to. Particles follow. Writes on the
    host: in a captured loop copy into the arrays on the device instead.

    Args:
        solver: A solver of the model.
        state: The state to write.
        q: Coordinates [m], shape (functions of all bodies, 3), or (worlds, functions, 3), or (functions, 3) of one
            world for all.
        qd: Their velocities [m/s], likewise.
        dent: Dents of the surface samples [m], likewise with samples for functions.

    Raises:
        ConfigError: If an array has another shape, or a number is not finite.
    """
    own, worlds = soft(state), max(require_reduced(solver).world_count, 1)
    for name, given in (("q", q), ("qd", qd), ("dent", dent)):
        if given is not None:
            array = getattr(own, name)
            array.assign(_rows(name, given, array.shape[0], worlds))
    own.dt_before.zero_()
    for name in ("stick_shape", "stick_partner"):
        getattr(own, name).fill_(-1)
    solver.update_particles(state)


def _rows(name: str, given: ArrayLike, count: int, worlds: int) -> NDArray[np.float64]:
    """Return the vectors of all worlds, shape (count, 3)."""
    found = np.asarray(given, dtype=np.float64)
    if found.shape == (count // worlds, 3):
        found = np.broadcast_to(found, (worlds, count // worlds, 3))
    if found.shape not in ((count, 3), (worlds, count // worlds, 3)) or not np.isfinite(found).all():
        hint = (
            f"give finite vectors of shape ({worlds}, {count // worlds}, 3), or ({count // worlds}, 3) for all worlds"
        )
        raise ConfigError(f"{name}: {worlds} worlds have {count} rows, got shape {found.shape}", hint=hint)
    return found.reshape(count, 3)
