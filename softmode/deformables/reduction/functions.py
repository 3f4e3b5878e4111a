"""Orthonormal functions: the raw functions made orthonormal in mass, ordered, and split at exact regions.

b = raw @ transform with (1 / V) sum_p V_p rho_p b_k b_l = delta_kl. Any rotation of such functions is as good, which
is used twice: FreeForm's are ordered by the mean square of their gradient, and on a body with exact regions the first r
("driven") span all traces on the regions while the others vanish there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

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
ROUNDING = 1e-24
"""What is under this fraction of a function's mass is nothing but rounding, as where a soft region is told twice."""
TRACE_TOLERANCE = 1e-6
"""Singular values of the traces on exact regions under this fraction of the largest count as zero. The weights vanish
there by construction, so what lies between 1e-12 and 1e-3 is empty."""


class RawFunctions(NamedTuple):
    """Raw functions at the quadrature points of a body, and what these weigh."""

    value: Array
    """Values, shape (P, R)."""
    gradient: Array
    """Gradients [1/m], shape (P, R, 3)."""
    mass: Array
    """Fractions of mass V_p rho_p / V, shape (P,)."""
    stiff: Array
    """Fractions of volume times relative shear modulus, shape (P,)."""
    lame_ratio: Array | None = None
    """lambda / mu relative to the body's, shape (P,); None where Poisson's ratio does not vary."""

    def products(self, index: NDArray[np.intp]) -> Array:
        """Return the mass products of all functions with some of them, shape (R, len(index))."""
        return self.value.T @ (self.mass[:, None] * self.value[:, index])


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


def independent(
    raw: RawFunctions, lead: Array, groups: Sequence[tuple[NDArray[np.intp], float]]
) -> tuple[Array, list[int]]:
    """Return functions that are orthonormal in mass: those of `lead`, then what groups of raw functions add to them.

    Args:
        raw: Raw functions.
        lead: Functions = raw @ lead that come first, each within the span of those up to it, shape (R, f).
        groups: Raw functions that come next, and for each group the fraction of the largest under which directions of
            the scaled mass Gram matrix are dropped.

    Returns:
        Functions = raw @ transform, (R, V), and how many there are up to the end of each group.
    """
    weighted = raw.value * np.sqrt(raw.mass)[:, None]
    scale = 1.0 / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    weighted *= scale
    lead = lead / scale[:, None]
    lead /= np.abs(lead).max(axis=0)
    value, upper = np.linalg.qr(weighted @ lead)
    sign = np.sign(np.diag(upper))
    value *= sign
    transform, counts = lead @ np.linalg.inv(upper * sign[:, None]), []
    for i, (index, tolerance) in enumerate(groups):
        if len(index):
            rest, content = weighted[:, index], np.zeros((value.shape[1], len(index)))
            for _ in range(2):
                found = value.T @ rest
                rest -= value @ found
                content += found
            size, vector = linalg.eigh(rest.T @ rest, check_finite=False)
            keep = size > max(tolerance * size[-1], ROUNDING)
            turn = vector[:, keep] / np.sqrt(size[keep])
            part = np.zeros((weighted.shape[1], turn.shape[1]))
            part[index] = turn
            transform = np.concatenate([transform, part - transform @ (content @ turn)], axis=1)
            if i + 1 < len(groups):  # What comes after must be apart from these.
                value = np.concatenate([value, rest @ turn], axis=1)
        counts.append(transform.shape[1])
    return transform * scale[:, None], counts


def split_at_regions(lead: Array, raw: RawFunctions, trace: Array) -> tuple[Array, Array]:
    """Return functions that vanish on exact regions, and others of the same span that carry the regions.

    Args:
        lead: Functions = raw @ lead of affine motion, of the body and of its regions, shape (R, f); no others have
            traces.
        raw: Raw functions.
        trace: Raw functions at points that fill the regions, (T, R).
    """
    lead = orthonormal_in_mass(lead, raw)
    size, across = np.linalg.svd(np.linalg.qr(trace @ lead, mode="r"))[1:]
    count = int((size > TRACE_TOLERANCE * size[0]).sum())
    return lead @ across[count:].T, lead @ across[:count].T


def orthonormalise(
    raw: RawFunctions,
    *,
    lead: Array,
    kept: NDArray[np.intp],
    others: NDArray[np.intp],
    rank_tolerance: float = RANK_TOLERANCE,
) -> Array:
    """Return all functions, orthonormal in mass, those after the first by ascending mean square gradient.

    Args:
        raw: Raw functions.
        lead: Functions = raw @ lead that come first whatever their size, shape (R, f): 1, x, y, z of a body without
            exact regions, else those of affine motion that vanish there.
        kept: Raw functions that come next and are dropped only when they repeat others to rounding.
        others: Raw functions that come last.
        rank_tolerance: Directions of the scaled mass Gram matrix of the others under this fraction of the largest are
            dropped.

    Returns:
        b = raw @ transform, shape (R, n).

    Raises:
        BasisError: If the weights add nothing to affine motion.
    """
    found, _ = independent(raw, lead, [(kept, KEPT_TOLERANCE), (others, rank_tolerance)])
    if found.shape[1] == lead.shape[1]:
        raise BasisError("the eigenmodes add nothing to affine motion", hint="Use more modes or kernels.")
    found, fixed = orthonormal_in_mass(found, raw), lead.shape[1]
    slopes = [raw.gradient[:, :, d] @ found[:, fixed:] for d in range(3)]
    turn = np.linalg.eigh(sum(slope.T @ (raw.stiff[:, None] * slope) for slope in slopes))[1]
    turn *= np.sign(turn[np.abs(turn).argmax(axis=0), np.arange(turn.shape[1])])
    return np.concatenate([found[:, :fixed], found[:, fixed:] @ turn], axis=1)


def affine_first(transform: Array, leading: NDArray[np.intp], length: float) -> Functions:
    """Return functions of which the first four span (1, x, y, z), 1 first, as they are.

    Args:
        transform: b = raw @ transform, orthonormal in mass, shape (R, n).
        leading: The raw functions x, y, z and 1.
        length: Unit of length of the raw functions [m].
    """
    linear = np.zeros((transform.shape[1], 4))
    linear[:4] = np.linalg.solve(transform[leading[:4], :4], np.diag([length, length, length, 1.0]))
    return Functions(transform=transform, mean=np.eye(1, transform.shape[1])[0], linear=linear, driven_count=0)


def driven_first(driven: Array, free: Array, raw: RawFunctions, leading: NDArray[np.intp], length: float) -> Functions:
    """Return functions of a body with exact regions: those that carry the regions, then those that vanish there.

    Args:
        driven: Functions = raw @ driven that carry the regions, shape (R, r).
        free: Functions = raw @ free that vanish there, orthonormal in mass, shape (R, m); they stay as they are.
        raw: Raw functions.
        leading: The raw functions x, y, z and 1, in the span of all.
        length: Unit of length of the raw functions [m].
    """
    weighted = raw.mass[:, None] * raw.value
    for _ in range(2):
        driven = driven - free @ (free.T @ (weighted.T @ (raw.value @ driven)))
    transform = np.concatenate([orthonormal_in_mass(driven, raw), free], axis=1)
    values, fields = raw.value @ transform, raw.value[:, leading[:4]]
    linear = np.zeros((values.shape[1], 4))
    for _ in range(2):  # The second pass repairs rounding.
        linear += values.T @ (raw.mass[:, None] * (fields - values @ linear))
    linear *= [length, length, length, 1.0]
    return Functions(transform=transform, mean=linear[:, 3].copy(), linear=linear, driven_count=driven.shape[1])


def orthonormal_in_mass(transform: Array, raw: RawFunctions) -> Array:
    """Return a transform (R, n) whose functions are orthonormal, from one whose functions nearly are.

    A pass against the functions themselves repairs what the squared condition number of a Gram matrix cost.

    Args:
        transform: b = raw @ transform, shape (R, n).
        raw: Raw functions.
    """
    values = raw.value @ transform
    return transform @ np.linalg.inv(np.linalg.cholesky(values.T @ (raw.mass[:, None] * values))).T
