"""Orthonormal functions: the raw functions made orthonormal in mass, ordered, and split at exact regions.

b = raw @ transform with (1 / V) sum_p V_p rho_p b_k b_l = delta_kl. Any rotation of such functions is as good, which
is used twice: functions are ordered by the mean square of their gradient, and on a body with exact regions the first r
("driven") span all traces on the regions while the others vanish there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.errors import BasisError

Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-5
"""Default of `BuildOptions.rank_tolerance`. Directions of the scaled mass Gram matrix under this fraction of the
largest are dropped. That is an amplitude of 0.3 %, the error of the eigenmodes themselves: on a sphere, where
x W_y = y W_x, 8 of 36 functions are such noise. Dropping them changes the compliance of a clamped sphere by 0.1 % and
cuts the cubature's force error tenfold. Rougher functions above the bound matter: a bound of 1e-3 makes a clamped beam
half again as stiff."""
HELD_RANK_TOLERANCE = 1e-7
"""The largest bound on a body with regions, where little is noise: a clamped beam under twice its weight has an error
of 4e-7 with the five functions between the bounds and 3e-6 without them (nMSE, 123 and 108 unknowns)."""
KEPT_TOLERANCE = 1e-10
"""The bound for static responses. What eigenmodes lack in a response is small but decides its energy: under the
bound above, the response of a clamped beam lost its anticlastic part and the beam was 20 % too stiff."""
TRACE_TOLERANCE = 1e-6
"""Singular values of the traces on exact regions under this fraction of the largest count as zero. The weights vanish
there by construction, so what lies between 1e-12 and 1e-3 is empty."""


@dataclass(frozen=True, kw_only=True)
class Functions:
    """The transform and what follows from it."""

    transform: Array
    """b = raw @ transform, shape (R, n)."""
    mean: Array
    """(1 / V) sum_p V_p rho_p b_k, shape (n,)."""
    linear: Array
    """Coefficients c (n, 4) with sum_k b_k c_kj = (X, Y, Z, 1)_j for every X."""
    driven_count: int
    """Number r of functions that do not vanish on the exact regions; they come first."""


def orthonormalise(
    raw: Array,
    raw_gradient: Array,
    mass: Array,
    stiff: Array,
    *,
    leading: NDArray[np.intp],
    length: float,
    kept: NDArray[np.bool_] | None = None,
    held: bool = False,
    rank_tolerance: float = RANK_TOLERANCE,
    trace: Array | None = None,
) -> Functions:
    """Build the orthonormal functions.

    Args:
        raw: Raw functions at the quadrature points, (P, R).
        raw_gradient: Their gradients [1/m], (P, R, 3).
        mass: V_p rho_p / V, shape (P,).
        stiff: Weights of the gradient energy that orders the functions, shape (P,).
        leading: Raw functions that are kept whatever their size, the body's (x, y, z, 1) first.
        length: Unit of length of the raw functions [m].
        kept: Raw functions that come next and are dropped only when they repeat others to rounding, (R,); none when
            None.
        held: Whether the body has regions, which caps the rank tolerance at `HELD_RANK_TOLERANCE`.
        rank_tolerance: Directions of the scaled mass Gram matrix under this fraction of the largest are dropped.
        trace: Raw functions at points that fill the exact regions, (T, R); None without such regions.

    Returns:
        Functions: without `trace` 1, three linear ones, then the others by ascending mean square gradient; with it the
        driven ones first, then the others likewise.

    Raises:
        BasisError: If the weights add nothing to affine motion.
    """
    gram = raw.T @ (mass[:, None] * raw)
    total = len(gram)
    lead = np.concatenate([leading[[3, 0, 1, 2]], leading[4:]])  # 1 first: then only it has a mean.
    both = np.zeros((total, len(lead)))
    both[lead] = np.linalg.inv(np.linalg.cholesky(gram[np.ix_(lead, lead)])).T
    kept = np.zeros(total, dtype=bool) if kept is None else kept
    others = np.ones(total, dtype=bool)
    others[lead] = False
    both = _extend(both, gram, np.flatnonzero(others & kept), KEPT_TOLERANCE)
    bound = min(rank_tolerance, HELD_RANK_TOLERANCE) if held else rank_tolerance
    both = _extend(both, gram, np.flatnonzero(others & ~kept), bound)
    if both.shape[1] == len(lead):
        raise BasisError("the eigenmodes add nothing to affine motion", hint="Use more modes or kernels.")
    both = orthonormal_in_mass(both, raw, mass)
    # Both triangular factors keep the leading functions within the leading raw ones, and the first four within
    # (1, x, y, z): there the linear functions are read off exactly.
    linear = _linear_coordinates(both, leading, length)
    mean = np.eye(1, both.shape[1])[0]
    rotation, driven = np.eye(both.shape[1]), 0
    if trace is not None:
        size, across = np.linalg.svd(np.linalg.qr(trace @ both, mode="r"))[1:]
        driven = int((size > TRACE_TOLERANCE * size[0]).sum())
        rotation = across.T * np.sign(across.T[np.abs(across.T).argmax(axis=0), np.arange(len(across))])
    fixed = driven if trace is not None else 4
    if fixed < both.shape[1]:
        energy = np.zeros((both.shape[1] - fixed,) * 2)
        free = both @ rotation[:, fixed:]
        for d in range(3):
            slope = raw_gradient[:, :, d] @ free
            energy += slope.T @ (stiff[:, None] * slope)
        turn = np.linalg.eigh(energy)[1]
        turn *= np.sign(turn[np.abs(turn).argmax(axis=0), np.arange(turn.shape[1])])
        rotation[:, fixed:] = rotation[:, fixed:] @ turn
    return Functions(transform=both @ rotation, mean=rotation.T @ mean, linear=rotation.T @ linear, driven_count=driven)


def affine_first(transform: Array, leading: NDArray[np.intp], length: float) -> Functions:
    """Return functions of which the first four span (1, x, y, z), 1 first, as they are.

    Args:
        transform: b = raw @ transform, orthonormal in mass, shape (R, n).
        leading: The raw functions x, y, z and 1.
        length: Unit of length of the raw functions [m].
    """
    linear = _linear_coordinates(transform, leading, length)
    return Functions(transform=transform, mean=np.eye(1, transform.shape[1])[0], linear=linear, driven_count=0)


def driven_first(
    driven: Array, free: Array, raw: Array, mass: Array, leading: NDArray[np.intp], length: float
) -> Functions:
    """Return functions of a body with exact regions: those that carry the regions, then those that vanish there.

    Args:
        driven: Functions = raw @ driven that carry the regions, shape (R, r).
        free: Functions = raw @ free that vanish there, orthonormal in mass, shape (R, m); they stay as they are.
        raw: Raw functions at the quadrature points, (P, R).
        mass: V_p rho_p / V, shape (P,).
        leading: The raw functions x, y, z and 1, in the span of all.
        length: Unit of length of the raw functions [m].
    """
    weighted = mass[:, None] * raw
    for _ in range(2):
        driven = driven - free @ (free.T @ (weighted.T @ (raw @ driven)))
    transform = np.concatenate([orthonormal_in_mass(driven, raw, mass), free], axis=1)
    values, fields = raw @ transform, raw[:, leading[:4]]
    linear = np.zeros((values.shape[1], 4))
    for _ in range(2):  # The second pass repairs rounding.
        linear += values.T @ (mass[:, None] * (fields - values @ linear))
    linear *= [length, length, length, 1.0]
    return Functions(transform=transform, mean=linear[:, 3].copy(), linear=linear, driven_count=driven.shape[1])


def orthonormal_in_mass(transform: Array, raw: Array, mass: Array) -> Array:
    """Return a transform (R, n) whose functions are orthonormal, from one whose functions nearly are.

    A pass against the functions themselves repairs what the squared condition number of a Gram matrix cost.

    Args:
        transform: b = raw @ transform, shape (R, n).
        raw: Raw functions at the quadrature points, (P, R).
        mass: V_p rho_p / V, shape (P,).
    """
    values = raw @ transform
    return transform @ np.linalg.inv(np.linalg.cholesky(values.T @ (mass[:, None] * values))).T


def _linear_coordinates(transform: Array, leading: NDArray[np.intp], length: float) -> Array:
    """Return c (n, 4) with sum_k b_k c_kj = (X, Y, Z, 1)_j, where the first four functions span (x, y, z, 1)."""
    linear = np.zeros((transform.shape[1], 4))
    linear[:4] = np.linalg.solve(transform[leading[:4], :4], np.diag([length, length, length, 1.0]))
    return linear


def _extend(basis: Array, gram: Array, index: NDArray[np.intp], tolerance: float) -> Array:
    """Add what raw functions hold beyond an orthonormal basis (R, n), down to a tolerance of the Gram matrix."""
    if not len(index):
        return basis
    rest = np.eye(len(gram))[:, index]
    for _ in range(2):
        rest = rest - basis @ (basis.T @ (gram @ rest))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram)[index], 1e-300))
    value, vector = np.linalg.eigh((rest.T @ gram @ rest) * scale[:, None] * scale)
    keep = value > tolerance * value[-1]
    return np.concatenate([basis, rest @ (scale[:, None] * vector[:, keep] / np.sqrt(value[keep]))], axis=1)
