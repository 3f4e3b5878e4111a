"""Elastic modes of a finished body at rest, by its own cubature."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.reduction.cubature import POISSON_RATIO
from softmode.deformables.reduction.reduced_stiffness import elastic_modes, reduced_stiffness

Array = NDArray[np.float64]


def soft_modes(body: ReducedBody, count: int | None = None) -> tuple[Array, Array]:
    """Return elastic modes at rest.

    Args:
        body: The body.
        count: How many modes, at most; all of them if omitted.

    Returns:
        All eigenvalues lambda > 0 for E = 1 and nu = `cubature.POISSON_RATIO` [m], ascending, with omega^2 = E lambda /
        (rho V); and the lowest modes, of unit energy q . K q = 1, as coordinates q [m^(-1/2)], shape (count, n, 3).
    """
    free = slice(body.driven_count, None)
    few = body.cubature
    gradient = few.grad_basis.astype(np.float64)[:, free].transpose(1, 2, 0)
    weights = few.weights * few.stiffness_scale
    value, mode = elastic_modes(reduced_stiffness(gradient, weights, POISSON_RATIO, few.lame_ratio))
    count = len(value) if count is None else min(count, len(value))
    q = np.zeros((count, body.function_count, 3))
    q[:, free] = mode[:, :count].T.reshape(count, 3, body.function_count - body.driven_count).transpose(0, 2, 1)
    return value, q


def surface_modes(body: ReducedBody) -> Array:
    """Return all those modes at the surface samples, shape (S, 3, M) [m^(-1/2)].

    Forces f on the samples that balance each other move them by u with f . u = sum_m (f . mode_m)^2 / E.
    """
    return np.einsum("sn,mna->sam", body.surface.basis.astype(np.float64), soft_modes(body)[1], optimize=True)
