"""What the device holds, on the host; and the solver of the soft bodies behind any solver."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.solver.solver_reduced import SolverReduced

Solver = SolverReduced | SolverCoupledReduced
"""What moves soft bodies."""


def host(array: wp.array | None) -> NDArray[Any]:
    """Return what an array of a model or a state holds, on the host; nothing for one that is not there."""
    return np.zeros(0) if array is None else array.numpy()


def soft_solver(solver: Solver) -> SolverReduced:
    """Return the solver of the soft bodies: the solver itself, or the one that it couples."""
    return solver.reduced if isinstance(solver, SolverCoupledReduced) else solver
