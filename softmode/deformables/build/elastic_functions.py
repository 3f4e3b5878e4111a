"""Functions chosen by elastic energy: which few scalar functions serve a body best.

A displacement is a sum of scalar functions times 3-vectors. Eigenmodes of a scalar operator know nothing of Poisson's
effect: times affine motion they lack y^2 - z^2, without which a bar cannot bend freely, and a bar of nu = 0.49 comes
out 3.4 times too stiff. Here the functions are chosen for elasticity itself, out of a space that is rich enough:

1. The space: quadratic handles of 48 skinning eigenmodes. Reproducing kernels alone are too stiff for thin bodies.
2. The targets: the lowest free elastic modes at the body's own Poisson's ratio, and the Ritz modes of all quadratic
   displacement fields, which are pure bending and twist: what a clamp needs that the build was not told of.
3. The choice: the three components of every target, each target at unit energy and weighted by w = min(1, omega_1^2 /
   omega^2), are columns of one matrix. Its singular vectors in gradient energy come in the order of what they carry.

The functions of a smaller count are the first of a larger one, so that more functions never make a body stiffer. The
choice is the one of modal substructuring with all components taken apart (von Tycowicz et al. 2013,
doi:10.1145/2508363.2508392), weighted by energy.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from softmode.deformables.build.functions import orthonormal_in_mass
from softmode.deformables.build.options import FUNCTION_COUNT, FUNCTION_LIMIT
from softmode.deformables.build.reduced_stiffness import elastic_stiffness
from softmode.deformables.build.static_response import lame_parameters
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]

SPACE_MODE_COUNT = 48
"""Skinning eigenmodes whose quadratic handles are the space. Bars and plates need 24; with 32 a cross is 5.6 % too
stiff, with 48 3.9 %, with 64 2.7 % at twice the time."""
TARGET_COUNT = 40
"""Elastic modes among the targets; it does not depend on the number of functions, or these would not be nested."""
JUDGED_COUNT = 6
"""The error of a choice is that of the first so many frequencies."""
SPACE_TOLERANCE = 1e-9
"""Directions of the scaled mass Gram matrix of the space under this fraction of the largest are rounding."""
BLOCK, BLOCK_STEPS = 16, 12
"""Vectors in a block of Lanczos, and the least number of blocks."""
RIGID = 6
"""Rigid motions, which cost no energy."""


@dataclass(frozen=True, kw_only=True)
class ElasticChoice:
    """Functions in the order of what they carry."""

    transform: Array
    """Functions = raw @ transform, orthonormal in mass, 1 and three linear ones first, shape (R, n)."""
    frequency_error: float
    """Largest relative error of the first six free frequencies against the whole space, at the worst of the ratios."""
    space_count: int
    """Dimension of the space."""

    def report(self) -> dict[str, float]:
        """Return what a body's provenance keeps."""
        return {"frequency_error": self.frequency_error, "space_functions": float(self.space_count)}


def choose_functions(
    raw: Array,
    raw_gradient: Array,
    mass: Array,
    stiff: Array,
    *,
    quadratic: NDArray[np.intp],
    count: int | None,
    accuracy: float | None,
    poissons_ratios: tuple[float, ...],
) -> ElasticChoice:
    """Choose functions by elastic energy.

    Args:
        raw: Raw functions at the quadrature points, (P, R).
        raw_gradient: Their gradients [1/m], (P, R, 3).
        mass: Fractions of mass, shape (P,).
        stiff: Fractions of volume times relative Young's modulus, shape (P,).
        quadratic: The ten raw functions x, y, z, 1, xx, ..., zx.
        count: Number of functions, the four affine ones among them; None for 48, or for as many as `accuracy` takes.
        accuracy: Largest relative error of the first six frequencies, or None.
        poissons_ratios: The body's own, or several.

    Warns:
        RuntimeWarning: If there are fewer functions than asked for, which begins at about 130.

    Raises:
        ConfigError: If the accuracy is not reached within 120 functions.
        BasisError: If the elastic stiffness is singular.
    """
    space = _ElasticSpace(raw, raw_gradient, mass, stiff, quadratic[:4])
    fields = space.transform.T @ (raw.T @ (mass[:, None] * raw[:, quadratic]))
    limit = min(FUNCTION_LIMIT if accuracy is not None else count or FUNCTION_COUNT, space.count)
    order, modes = space.order(fields, poissons_ratios, limit)
    errors = {limit: space.frequency_error(order, modes)}
    chosen = limit
    if accuracy is not None:
        if errors[limit] > accuracy:
            raise ConfigError(
                f"accuracy: {limit} functions reach {errors[limit]:.2g}, {accuracy:g} was asked for",
                hint="ask for less, or give function_count",
            )
        low = 4  # The error falls with the number of functions, because they are nested.
        while chosen - low > 1:
            middle = (low + chosen) // 2
            errors[middle] = space.frequency_error(order[:, :middle], modes)
            low, chosen = (low, middle) if errors[middle] <= accuracy else (middle, chosen)
    if count is not None and order.shape[1] < count:
        warnings.warn(
            f"function_count: {count} asked for, the object's elastic modes make {order.shape[1]}",
            RuntimeWarning,
            stacklevel=2,
        )
    transform = orthonormal_in_mass(space.transform @ order[:, :chosen], raw, mass)
    return ElasticChoice(transform=transform, frequency_error=errors[chosen], space_count=space.count)


class _ElasticSpace:
    """A space of scalar functions, orthonormal in mass, with the products of their gradients."""

    def __init__(self, raw: Array, raw_gradient: Array, mass: Array, stiff: Array, leading: NDArray[np.intp]) -> None:
        lead = leading[[3, 0, 1, 2]]  # 1 first: then only it has a mean.
        others = np.setdiff1d(np.arange(raw.shape[1]), lead)
        weighted = raw * np.sqrt(mass)[:, None]
        scale = 1.0 / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
        weighted *= scale
        affine, upper = np.linalg.qr(weighted[:, lead])
        sign = np.sign(np.diag(upper))
        affine *= sign
        rest, content = weighted[:, others], np.zeros((4, len(others)))
        for _ in range(2):
            found = affine.T @ rest
            rest -= affine @ found
            content += found
        value, vector = linalg.eigh(rest.T @ rest, check_finite=False)
        keep = value > SPACE_TOLERANCE * value[-1]
        turn = vector[:, keep] / np.sqrt(value[keep])
        affine_part = np.zeros((raw.shape[1], 4))
        affine_part[lead] = np.linalg.inv(upper * sign[:, None])
        other_part = np.zeros((raw.shape[1], turn.shape[1]))
        other_part[others] = turn
        other_part -= affine_part @ (content @ turn)
        self.transform = np.concatenate([affine_part, other_part], axis=1) * scale[:, None]
        """Functions = raw @ transform, 1 and three linear ones first, shape (R, V)."""
        self.count = self.transform.shape[1]
        root = np.sqrt(stiff)[:, None]
        slopes = [raw_gradient[:, :, d] * root for d in range(3)]
        self.products = np.empty((3, self.count, 3, self.count))
        """sum_p s_p d_i b_k d_j b_l, shape (3, V, 3, V)."""
        for d in range(3):
            for e in range(d + 1):
                block = self.transform.T @ (slopes[d].T @ slopes[e]) @ self.transform
                self.products[d, :, e], self.products[e, :, d] = block, block.T

    def order(self, fields: Array, poissons_ratios: tuple[float, ...], count: int) -> tuple[Array, dict[float, Array]]:
        """Return functions (V, count) in the order of what they carry, and the first eigenvalues by Poisson's ratio.

        Args:
            fields: The ten monomials up to degree two in this space, shape (V, 10).
            poissons_ratios: At which targets are sought.
            count: How many functions.
        """
        energy = np.einsum("kakb->ab", self.products)
        scalar = linalg.eigh(energy[4:, 4:], eigvals_only=True, check_finite=False)
        columns, judged = [], {}
        for ratio in poissons_ratios:
            floor = 1e-5 * lame_parameters(ratio)[0] * float(scalar[scalar > 1e-9 * scalar[-1]][0])
            target, value = self._targets(fields, ratio, floor)
            judged[ratio] = value[:JUDGED_COUNT]
            first = value[value > floor][0]  # Of a body in several parts, these move against each other for nothing.
            scaled = target * (np.minimum(1.0, first / np.maximum(value, floor)) / np.sqrt(np.maximum(value, floor)))
            columns.append(scaled.reshape(3, self.count, -1).transpose(1, 0, 2).reshape(self.count, -1))
        stacked = np.concatenate(columns, axis=1)
        stacked[:4] = 0.0
        value, vector = linalg.eigh(stacked.T @ energy @ stacked, check_finite=False)
        best = np.argsort(-value, kind="stable")[: count - 4]
        best = best[value[best] > 1e-13 * value[-1]]
        # In order: the first n span what the first n singular vectors span.
        found, upper = np.linalg.qr(stacked @ (vector[:, best] / np.sqrt(value[best])))
        return np.concatenate([np.eye(self.count, 4), found * np.sign(np.diag(upper))], axis=1), judged

    def frequency_error(self, chosen: Array, modes: dict[float, Array]) -> float:
        """Return the largest relative error of the first frequencies of chosen functions (V, n)."""
        part = np.einsum("ak,iajb,bl->ikjl", chosen, self.products, chosen, optimize=True)
        worst = 0.0
        for ratio, value in modes.items():
            last = min(RIGID + len(value), 3 * chosen.shape[1]) - 1
            found = linalg.eigh(
                elastic_stiffness(part, ratio), eigvals_only=True, subset_by_index=[RIGID, last], check_finite=False
            )
            real = value[: len(found)] > 1e-9 * value[-1]
            worst = max(worst, float((np.sqrt(found[real] / value[: len(found)][real]) - 1.0).max()))
        return worst

    def _targets(self, fields: Array, poissons_ratio: float, floor: float) -> tuple[Array, Array]:
        """Return the lowest elastic modes, then Ritz modes of fields, (3 V, T), and their eigenvalues (T,)."""
        stiffness = elastic_stiffness(self.products, poissons_ratio)
        value, mode = _lowest(stiffness, 1e3 * floor, min(TARGET_COUNT + RIGID, 3 * self.count - 1))
        span = np.kron(np.eye(3), np.linalg.qr(fields)[0])
        ritz, turn = linalg.eigh(span.T @ stiffness @ span, check_finite=False)
        modes = np.concatenate([mode[:, RIGID:], span @ turn[:, RIGID:]], axis=1)
        return modes, np.concatenate([value[RIGID:], ritz[RIGID:]])


def _lowest(stiffness: Array, shift: float, count: int) -> tuple[Array, Array]:
    """Return the lowest eigenpairs of a stiffness (N, N), ascending: block Lanczos on the shifted inverse.

    A block is wider than any cluster of equal frequencies, of which single vectors find one at a time, and is solved
    for at once. The first 46 frequencies of solids come out to 1e-9.
    """
    size, steps = len(stiffness), BLOCK_STEPS + count // 16
    if size <= 2 * BLOCK * steps:
        value, vector = linalg.eigh(stiffness, subset_by_index=[0, count - 1], check_finite=False)
    else:
        shifted = stiffness.copy()
        shifted[np.diag_indices(size)] += shift
        try:
            factor = linalg.cho_factor(shifted, check_finite=False, overwrite_a=True)
        except linalg.LinAlgError as error:
            raise BasisError("the elastic stiffness is singular", hint="Use fewer kernels or more points.") from error
        basis, small = np.empty((size, 0)), np.zeros((BLOCK * steps, BLOCK * steps))
        block = np.random.default_rng(0).normal(size=(size, BLOCK))
        for end in range(BLOCK, BLOCK * steps + 1, BLOCK):
            basis = np.concatenate([basis, np.linalg.qr(block)[0]], axis=1)
            block = linalg.cho_solve(factor, basis[:, -BLOCK:], check_finite=False)
            for _ in range(2):
                inner = basis.T @ block
                block -= basis @ inner
                small[:end, end - BLOCK : end] += inner
        value, vector = linalg.eigh(small, lower=False, check_finite=False)
        value, vector = 1.0 / value[: -count - 1 : -1] - shift, basis @ vector[:, : -count - 1 : -1]
    return value, vector * np.sign(vector[np.abs(vector).argmax(axis=0), np.arange(count)])
