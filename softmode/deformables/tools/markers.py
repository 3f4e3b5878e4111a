"""Markers: points that ride on a body, and the linear maps between their motion and the reduced coordinates."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.solver.solver_base import ReducedSolver

Array = NDArray[np.float64]


class Markers:
    """Points that ride on one body: x_s = X_s + sum_k b_k(X_s) q_k, a linear map of the coordinates.

    Args:
        solver: Solver that holds the body.
        points: Rest points in the frame of the asset, the body of scale 1 [m], shape (K, 3).
        instance: The body.
    """

    def __init__(self, solver: ReducedSolver, points: ArrayLike, *, instance: int = 0) -> None:
        """Evaluate the basis once."""
        body = solver.bodies[solver.view.layout.asset[instance]]
        self.points = np.atleast_2d(np.asarray(points, dtype=np.float64))
        self.basis = body.evaluate(self.points)[0]
        """Functions at the points, shape (K, n)."""
        start = int(solver.parameters.function_start.numpy()[instance])
        self.functions = slice(start, start + body.function_count)
        """Where the instance's coordinates lie among those of all."""
        self.function_total = int(solver.parameters.q.shape[0])

    def positions(self, q: Array) -> Array:
        """Return world positions [m], shape (..., K, 3), from coordinates (..., N, 3)."""
        return self.points + self.interpolate(q)

    def interpolate(self, q: Array) -> Array:
        """Return sum_k b_k q_k, shape (..., K, 3): velocities from qd, dL/d(point force) from dL/d(force)."""
        return self.basis @ q[..., self.functions, :]

    def spread(self, values: ArrayLike) -> Array:
        """Return the transpose: dL/dq (..., N, 3) from dL/dx, or generalised from point forces, shape (..., K, 3)."""
        values = np.asarray(values, dtype=np.float64)
        out = np.zeros((*values.shape[:-2], self.function_total, 3))
        out[..., self.functions, :] = self.basis.T @ values
        return out
