"""Functions chosen by elastic energy: which few scalar functions serve a body best.

A displacement is a sum of scalar functions times 3-vectors. Eigenmodes of a scalar operator know nothing of Poisson's
effect: times affine motion they lack y^2 - z^2, without which a bar cannot bend freely, and a bar of nu = 0.49 comes
out 3.4 times too stiff. Here the functions are chosen for elasticity itself, out of a space that is rich enough:

1. The space: quadratic handles of 48 skinning eigenmodes, or of 96 where 48 are not enough: where the first half of
   them has higher frequencies. Reproducing kernels alone are too stiff for thin bodies.
2. The targets: the lowest free elastic modes at the body's own Poisson's ratio, and the Ritz modes of all quadratic
   displacement fields, which are pure bending and twist: what a clamp needs that the build was not told of.
3. The choice: the three components of every target, each target at unit energy and weighted by w = min(1, omega_1^2 /
   omega^2), are columns of one matrix. Its singular vectors in gradient energy come in the order of what they carry.
4. After the first 48 functions come those of further targets: the same with the root of these weights, and what
   springs do that pull the body's four farthest parts, or its two ends, each along an axis: low modes lack local pulls.

On a body with exact regions the space is made of eigenmodes of the free body times an envelope that vanishes there, and
on one with any regions also of translations along static responses and elastic modes of the kernels, which know how a
section warps. The functions that carry the regions' motion come first. Then
come the static responses to unit body forces, kept exactly: what eigenmodes lack in a response is small but decides its
energy. The targets are the elastic modes of the held body, the second order of the static responses at a turn of half a
radian, where one exact region holds the body the first modes and the responses to loads that vary slowly along it, and
the constraint modes of exact regions that move against each other (Craig and Bampton 1968,
doi:10.2514/3.4741). Weights are w = min(1, omega_1 / omega): a turn between two clamps is far from what linear modes
say, and wants higher ones. With omega^2 a beam that is twisted by 720 degrees has ten times the error. Such a turn also
wants products of slow functions with affine motion, which are targets too; the first modes weigh more than these.

The functions of a smaller count are the first of a larger one, so that more functions never make a body stiffer. The
choice is the one of modal substructuring with all components taken apart (von Tycowicz et al. 2013,
doi:10.1145/2508363.2508392), weighted by energy.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from softmode.deformables.reduction.functions import KEPT_TOLERANCE, RawFunctions, independent, orthonormal_in_mass
from softmode.deformables.reduction.options import FUNCTION_COUNT, FUNCTION_LEAST, FUNCTION_LIMIT, BuildOptions
from softmode.deformables.reduction.reduced_stiffness import elastic_stiffness
from softmode.deformables.reduction.static_response import lame_parameters, second_order_load
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]

SPACE_MODE_COUNTS = 48, 96
"""Skinning eigenmodes whose quadratic handles are the space. Bars and plates need 24. A round tube of nu = 0.3 is 7 %
too stiff with 48 and 1.5 % with 96, for three times the time."""
SPACE_ERROR = 0.02
"""The space is made larger where its second half lowers one of the first six frequencies by more than this."""
EXCESS = {
    "frequency_error": (
        "error of the first frequencies",
        "functions",
        "its first six frequencies are that much too high with its functions",
        "build it with --accuracy 0.03, or more --functions",
    ),
    "space_error": (
        "second half of the space",
        "space",
        "its first six frequencies may be that much too high, by corners, branches or thin walls that its kernels do"
        " not resolve, whatever the number of functions",
        "build it with twice the points (--points): more points allow narrower kernels",
    ),
    "driven_error": (
        "excess of stiffness between regions",
        "regions",
        "its regions may resist each other's motion that much too stiffly",
        "build it with twice the points (--points), or more functions (--functions)",
    ),
}
"""What a build says of its own stiffness: names of a measure and a finding, what it means, and the remedy, by key."""
EXCESS_WARNING = 0.05
"""The report of a body says so where one of these is larger; so does a build, but for what the functions lack, whose
number is asked for."""
TARGET_COUNT = 40
"""Elastic modes among the targets; it does not depend on the number of functions, or these would not be nested."""
JUDGED_COUNT = 6
"""The error of a choice is that of the first so many frequencies."""
SPACE_TOLERANCE, HELD_SPACE_TOLERANCE = 1e-9, 1e-11
"""Directions of the scaled mass Gram matrix of the space under this fraction of the largest are rounding. On a body
with regions a function of little mass may decide the energy: a spiral strip was 5 % too stiff with the first."""
NEGLIGIBLE = 1e-13
"""Singular vectors under this fraction of the largest energy are rounding."""
EQUAL = 0.95
"""Singular vectors whose energies are nearer than this contribute alike: symmetric bodies have clusters of them. Those
of a star differ by 4 % at most within a cluster and by 6 % and more between two."""
TURN_COUNT, TURN_LEVEL = 6, 3.0
"""Where exact regions move against each other, targets are also the first so many eigenmodes times affine motion, those
of the first so many times unit energy. A twist by theta(x) is cos theta y and sin theta z, of which linear modes hold
the first order: a beam turned by 720 degrees has three times the error without them."""
MOVED_LEVEL = 1.5
"""Constraint modes weigh so many times unit energy. Of a plate of nu = 0.49 that is held at two edges the choice was 31
% too stiff against its space with one, 20 % with this; a beam turned by 720 degrees has a tenth more error with 3."""
AMPLITUDE = 0.25
"""Half the angle [rad] through which a body turns where static responses of first and second order weigh alike."""
BLOCK, BLOCK_STEPS = 16, 12
"""Vectors in a block of Lanczos, and the least number of blocks."""
FIRST_MODES, FIRST_LEVEL = 6, 4.0
"""The first so many elastic modes weigh so many times more where exact regions hold the body: a plate of nu = 0.49 that
is held at two edges had its sixth frequency 2.3 times too high when five weighed three times more."""
FEW_TARGETS = 12
"""Elastic modes among the targets of a body with one exact region. With 40 of them a hollow box has its third frequency
8.5 %, a plate its sixth 20 % too high."""
LOAD_COUNT, LOAD_LEVEL = 20, 2.0
"""Such a body has the responses to loads along each axis that are as slow as its first so many scalar eigenmodes among
the targets, the softest of each axis of so many times unit energy: without them loads at its end move a fork by 0.90,
a hollow box by 0.69 and a plate in its plane by 0.89 of what they should."""
FAR_AFTER = 48
"""Functions beyond the first so many, and those that contribute as much as the last of these, serve a free body that is
pulled, too: they follow elastic modes by omega_1 / omega and, at unit energy, what far parts and the two ends do that
springs pull apart. After 40 such targets made the sixth frequency of a plate 20:1 of nu = 0.49 with 48 functions 7.3 %
too high, where it is 1.0 %."""
FAR_SPRINGS = 3000.0
"""These springs per volume, over E and the square of the longest edge."""
RIGID = 6
"""Rigid motions, which cost no energy."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """What the regions of a body ask of its functions."""

    driven: Array
    """Functions = raw @ driven that carry the motion of exact regions, orthonormal in mass, shape (R, r)."""
    motions: Array
    """Rigid motions of every exact region in the driven functions, shape (3 r, M); M = 0 for fewer than two."""
    springs: Array
    """Raw functions at points of soft regions, times the root of kappa V_p / (E V) [1/m], shape (S, R)."""
    turned: NDArray[np.intp]
    """Raw functions that are slow functions times affine motion, shape (T,); none for fewer than two exact regions."""
    level: Array
    """What each of these is to weigh, shape (T,)."""


class Pulled(NamedTuple):
    """A part of a body that is pulled."""

    value: Array
    """Raw functions at its points, shape (N, R)."""
    weight: Array
    """Fractions of the body's volume over the square of its longest edge [1/m^2], shape (N,)."""
    level: float
    """What its pull is to weigh."""


@dataclass(frozen=True, kw_only=True)
class ElasticChoice:
    """Functions in the order of what they carry."""

    transform: Array
    """Functions = raw @ transform, orthonormal in mass, shape (R, n): without regions 1 and three linear ones first,
    with exact ones those that vanish there."""
    frequency_error: float
    """Largest relative error of the first six frequencies against the whole space, at the worst of the ratios."""
    space_error: float | None
    """By how much the frequencies are higher in the space of the first half of the eigenmodes; None without them."""
    driven_error: float | None
    """By how much exact regions are stiffer against each other, in that space or with the functions chosen, whichever
    is worse; None for fewer than two."""
    space_count: int
    """Dimension of the space."""
    complete_count: int
    """Functions with all that contribute as much as the last of them, those of exact regions included."""
    space_eigenvalues: dict[float, Array]
    """First eigenvalues of the whole space per E / rho [1/m^2], by Poisson's ratio."""

    def report(self) -> dict[str, float]:
        """Return what a body's provenance keeps."""
        return {
            "frequency_error": self.frequency_error,
            **({} if self.space_error is None else {"space_error": self.space_error}),
            **({} if self.driven_error is None else {"driven_error": self.driven_error}),
            "space_functions": float(self.space_count),
            "complete_functions": float(self.complete_count),
            **{
                f"space_eigenvalue_{ratio:g}_{k}": float(value)
                for ratio, values in self.space_eigenvalues.items()
                for k, value in enumerate(values, 1)
            },
        }


def choose_functions(
    raw: RawFunctions,
    *,
    lead: Array,
    kept: NDArray[np.intp],
    others: NDArray[np.intp],
    options: BuildOptions,
    half: NDArray[np.intp] | None = None,
    quadratic: NDArray[np.intp] | None = None,
    held: Held | None = None,
    pulled: Sequence[Sequence[Pulled]] = (),
) -> ElasticChoice:
    """Choose functions by elastic energy.

    Args:
        raw: Raw functions.
        lead: Functions = raw @ lead that come first, shape (R, f): 1, x, y, z of a body without exact regions.
        kept: Raw functions that come next: affine motions of soft regions.
        others: Raw functions that the rest is chosen from. On a body with exact regions all of these vanish there.
        options: How many functions, all that come first among them, or how accurate; and for which Poisson's ratios.
        half: The others without those that the second half of the eigenmodes makes; None without eigenmodes.
        quadratic: The ten raw functions x, y, z, 1, xx, ..., zx; None on a body with exact regions.
        held: What regions ask for; None for a body without regions.
        pulled: Parts of a free body, those together that are pulled apart.

    Warns:
        RuntimeWarning: If there are fewer functions than asked for, which begins at about 130.

    Raises:
        ConfigError: If the accuracy is not reached within 120 functions, or the regions alone need more than `count`.
        BasisError: If the elastic stiffness is singular.
    """
    count, accuracy = options.function_count, options.accuracy
    space = _ElasticSpace(raw, lead, kept, others, held)
    fields = None if quadratic is None else space.transform.T @ raw.products(quadratic)
    driven = 0 if held is None else held.driven.shape[1]
    most = FUNCTION_LIMIT if accuracy is not None else count or FUNCTION_COUNT
    least = driven + space.fixed
    if most <= least:
        raise ConfigError(
            f"function_count: {most} asked for, affine motions of the body and its regions are {least}",
            hint=f"give {least + FUNCTION_LEAST} or more",
        )
    order, shares, modes = space.order(fields, options.poissons_ratios, min(most - driven, space.count), pulled)
    chosen = order.shape[1]
    few = space.restricted(order)
    error = space.frequency_error(few, modes)
    smaller = None if half is None else space.restricted(space.spanned(raw.products(half)))
    if accuracy is not None:
        if error > accuracy:
            raise ConfigError(
                f"accuracy: {chosen + driven} functions reach {error:.2g}, {accuracy:g} was asked for",
                hint="ask for less, or give function_count",
            )
        low = space.fixed  # The error falls with the number of functions, because they are nested.
        while chosen - low > 1:
            middle = (low + chosen) // 2
            reached = space.frequency_error(space.restricted(order[:, :middle]), modes)
            low, chosen = (low, middle) if reached <= accuracy else (middle, chosen)
        chosen = min(_complete(shares, chosen), order.shape[1])
        few = space.restricted(order[:, :chosen])
        error = space.frequency_error(few, modes)
    if count is not None and chosen + driven < count:
        warnings.warn(
            f"function_count: {count} asked for, the object's elastic modes make {chosen + driven}",
            RuntimeWarning,
            stacklevel=2,
        )
    return ElasticChoice(
        transform=orthonormal_in_mass(space.transform @ order[:, :chosen], raw),
        frequency_error=error,
        space_error=None if smaller is None else space.frequency_error(smaller, modes),
        driven_error=space.driven_error([few, *([] if smaller is None else [smaller])]),
        space_count=space.count + driven,
        complete_count=_complete(shares, chosen) + driven,
        space_eigenvalues=modes,
    )


def _complete(shares: Array, count: int) -> int:
    """Return a number of functions, `count` or the next larger one, after which shares fall, or begin anew."""
    while count < len(shares) and EQUAL < shares[count] / shares[count - 1] < 1.0 / EQUAL:
        count += 1
    return count


class _Part(NamedTuple):
    """A part of a space, with what its functions cost."""

    chosen: Array
    """Its functions in the space, shape (V, n)."""
    products: Array
    """Of their gradients, shape (3, n, 3, n)."""
    volume: Array | None
    """The same with the weights of lambda; None where lambda / mu does not vary."""
    springs: Array
    """What soft regions add for each component, per E, shape (n, n)."""

    def stiffness(self, poissons_ratio: float) -> Array:
        """Return their stiffness with the springs, (3 n, 3 n)."""
        return elastic_stiffness(self.products, poissons_ratio, self.volume) + np.kron(np.eye(3), self.springs)


class _ElasticSpace:
    """A space of scalar functions, orthonormal in mass, with the products of their gradients."""

    def __init__(
        self,
        raw: RawFunctions,
        lead: Array,
        kept: NDArray[np.intp],
        others: NDArray[np.intp],
        held: Held | None,
    ) -> None:
        tolerance = SPACE_TOLERANCE if held is None else HELD_SPACE_TOLERANCE
        self.transform, (self.fixed, self.count) = independent(raw, lead, [(kept, KEPT_TOLERANCE), (others, tolerance)])
        """Functions = raw @ transform, shape (R, V); how many come first in any case, and how many there are."""
        every = self.transform if held is None else np.concatenate([self.transform, held.driven], axis=1)
        self.products = _products(raw.gradient, raw.stiff, every)
        """sum_p s_p d_i b_k d_j b_l, driven functions last, shape (3, V + r, 3, V + r)."""
        self.lame_ratio = raw.lame_ratio
        self.volume = None if raw.lame_ratio is None else _products(raw.gradient, raw.stiff * raw.lame_ratio, every)
        """The same with the weights of lambda; None where lambda / mu does not vary."""
        self.free = self.products[:, : self.count, :, : self.count]
        """Those of the functions that are chosen from, shape (3, V, 3, V)."""
        self.free_volume = None if self.volume is None else self.volume[:, : self.count, :, : self.count]
        self.energy = np.einsum("kakb->ab", self.free)
        self.springs = np.zeros_like(self.energy)
        """What soft regions add to the stiffness of each component, per E, shape (V, V)."""
        self.held, self.exact = held, held is not None and held.driven.shape[1] > 0
        self.rigid = RIGID if held is None else 0
        self.factored: tuple[float, Array, Any] | None = None
        """Poisson's ratio, stiffness of the free functions of a held body, its factor."""
        self.answered: tuple[float, Array, Array, Array] | None = None
        """Poisson's ratio, energy of driven functions, their pull on others, motions of regions of unit energy."""
        self.alone = held is not None and self.exact and not held.motions.shape[1]
        """Whether one exact region holds the body."""
        if held is not None:
            pull = held.springs @ self.transform
            self.springs = pull.T @ pull
            self.energy = self.energy + self.springs
            self.mean = self.transform.T @ (raw.value.T @ raw.mass)
            self.slopes, self.stiff = [raw.gradient[:, :, d] for d in range(3)], raw.stiff
            turned = self.transform.T @ raw.products(held.turned)
            turned *= TURN_LEVEL * held.level / np.sqrt(np.einsum("ak,ab,bk->k", turned, self.energy, turned))
            self.turned = np.concatenate([turned, np.zeros((2 * self.count, turned.shape[1]))])

    def order(
        self,
        fields: Array | None,
        poissons_ratios: tuple[float, ...],
        count: int,
        pulled: Sequence[Sequence[Pulled]] = (),
    ) -> tuple[Array, Array, dict[float, Array]]:
        """Return functions (V, count) in the order of what they carry, what all carry, and eigenvalues by ratio.

        Args:
            fields: The ten monomials up to degree two in this space, shape (V, 10), or None.
            poissons_ratios: At which targets are sought.
            count: How many functions.
            pulled: Parts of a free body, those together that are pulled apart.
        """
        scalar = linalg.eigh(self.energy[self.fixed :, self.fixed :], eigvals_only=True, check_finite=False)
        targets, later, judged = [], [], {}
        for ratio in poissons_ratios:
            floor = 1e-5 * lame_parameters(ratio)[0] * float(scalar[scalar > 1e-9 * scalar[-1]][0])
            target, value = self._targets(fields, ratio, floor)
            judged[ratio] = value[: JUDGED_COUNT + (0 if self.exact else RIGID - self.rigid)]
            first = value[value > floor][0]  # Of a body in several parts, these move against each other for nothing.
            share = np.minimum(1.0, first / np.maximum(value, floor))
            if self.held is not None:
                share = np.sqrt(share)  # What regions drive far from rest wants higher modes.
            if self.exact:
                share[:FIRST_MODES] *= FIRST_LEVEL
            if self.alone:
                target, value, share = target[:, :FEW_TARGETS], value[:FEW_TARGETS], share[:FEW_TARGETS]
            size = np.sqrt(np.maximum(value, floor))
            targets.append(target * (share / size))
            if pulled and count > FAR_AFTER:
                stiffness = elastic_stiffness(self.free, ratio, self.free_volume)
                later.append(target * (np.sqrt(share) / size))
                later += [self._responses_to_pulls(parts, stiffness, 1e3 * floor) for parts in pulled]
        blocks = []
        if self.held is not None:
            responses, more = self._responses(self.held, sum(poissons_ratios) / len(poissons_ratios))
            blocks.append(responses)
            targets += [more, self.turned]
        found, shares = np.eye(self.count, self.fixed), np.full(self.fixed, np.inf)
        blocks.append(np.concatenate(targets, axis=1))
        for block in blocks:
            found, share = self._extend(found, block, count)
            shares = np.concatenate([shares, share])
        if later and (first := _complete(shares, FAR_AFTER)) < count:
            found, share = self._extend(found[:, :first], np.concatenate(later, axis=1), count)
            shares = np.concatenate([shares[:first], share])
        return found, shares, judged

    def spanned(self, products: Array) -> Array:
        """Return an orthonormal basis (V, k) of what comes first and raw functions, from their mass products (R, h)."""
        inside = self.transform.T @ products
        inside[: self.fixed] = 0.0
        inside /= np.maximum(np.linalg.norm(inside, axis=0), 1e-300)
        vector, size, _ = np.linalg.svd(inside, full_matrices=False)
        return np.concatenate([np.eye(self.count, self.fixed), vector[:, size > 1e-5 * size[0]]], axis=1)

    def restricted(self, chosen: Array) -> _Part:
        """Return the part of the space that some functions (V, n) span."""

        def within(products: Array) -> Array:
            return _symmetric(lambda d, e: chosen.T @ products[d, :, e] @ chosen)

        volume = None if self.free_volume is None else within(self.free_volume)
        return _Part(chosen, within(self.free), volume, chosen.T @ self.springs @ chosen)

    def frequency_error(self, few: _Part, modes: dict[float, Array]) -> float:
        """Return the largest relative error of the first frequencies of a part of the space."""
        worst = 0.0
        for ratio, value in modes.items():
            stiffness = few.stiffness(ratio)
            last = min(self.rigid + len(value), len(stiffness)) - 1
            which = [self.rigid, last]
            found = linalg.eigh(stiffness, eigvals_only=True, subset_by_index=which, check_finite=False)
            real = value[: len(found)] > 1e-9 * value[-1]
            worst = max(worst, float((np.sqrt(found[real] / value[: len(found)][real]) - 1.0).max()))
        return worst

    def driven_error(self, parts: list[_Part]) -> float | None:
        """Return by how much exact regions are stiffer against each other in the worst of some parts, or None.

        Of all their motions it is the worst one: the largest ratio of energies, less one.
        """
        if self.answered is None:
            return None
        ratio, base, pull, motion = self.answered
        worst = 1.0
        for few in parts:
            stiffness = few.stiffness(ratio)
            load = np.einsum("ak,iam->ikm", few.chosen, pull.reshape(3, self.count, -1)).reshape(len(stiffness), -1)
            energy = base - load.T @ linalg.solve(stiffness, load, assume_a="pos", check_finite=False)
            worst = max(worst, float(np.linalg.eigvalsh(motion.T @ energy @ motion)[-1]))
        return worst - 1.0

    def _solved(self, poissons_ratio: float) -> tuple[Array, Any]:
        """Return the stiffness of the free functions of a held body (3 V, 3 V), and its factor; the last one is kept.

        Raises:
            BasisError: If nothing holds the body.
        """
        if self.factored is None or self.factored[0] != poissons_ratio:
            stiffness = elastic_stiffness(self.free, poissons_ratio, self.free_volume)
            stiffness += np.kron(np.eye(3), self.springs)
            try:
                factor = linalg.cho_factor(stiffness.T, lower=True, check_finite=False)
            except linalg.LinAlgError as error:
                raise BasisError("the static response has no solution", hint="Hold the body by a region.") from error
            self.factored = poissons_ratio, stiffness, factor
        return self.factored[1:]

    def _targets(self, fields: Array | None, poissons_ratio: float, floor: float) -> tuple[Array, Array]:
        """Return the lowest elastic modes, then Ritz modes of fields, (3 V, T), and their eigenvalues (T,)."""
        count = min(TARGET_COUNT + RIGID, 3 * self.count - 1)
        if self.held is None:
            stiffness = elastic_stiffness(self.free, poissons_ratio, self.free_volume)
            value, mode = _lowest(stiffness, count, 1e3 * floor)
        else:
            stiffness, factor = self._solved(poissons_ratio)
            value, mode = _lowest(stiffness, count, factor=factor)
        value, mode = value[self.rigid :], mode[:, self.rigid :]
        if fields is None:
            return mode, value
        span = np.kron(np.eye(3), np.linalg.qr(fields)[0])
        ritz, turn = linalg.eigh(span.T @ stiffness @ span, check_finite=False)
        modes = np.concatenate([mode, span @ turn[:, self.rigid :]], axis=1)
        return modes, np.concatenate([value, ritz[self.rigid :]])

    def _responses_to_pulls(self, parts: Sequence[Pulled], stiffness: Array, shift: float) -> Array:
        """Return what springs on parts do that pull one of them along an axis, (3 V, 3 parts)."""
        springs, loads, level = np.zeros_like(self.energy), [], np.array([part.level for part in parts])
        for part in parts:
            value = part.value @ self.transform
            load = (FAR_SPRINGS * part.weight)[:, None] * value
            springs += value.T @ load
            loads.append(load.sum(axis=0))
        held = stiffness.copy()
        held[np.diag_indices(len(held))] += shift  # A body in several parts is not held by all of these.
        for i in range(3):
            own = slice(i * self.count, (i + 1) * self.count)
            held[own, own] += springs
        factor = linalg.cho_factor(held.T, lower=True, check_finite=False, overwrite_a=True)
        answer = linalg.cho_solve(factor, np.kron(np.eye(3), np.stack(loads, axis=1)), check_finite=False)
        return answer * (np.tile(level, 3) / np.sqrt(np.einsum("ak,ak->k", answer, stiffness @ answer)))

    def _responses(self, held: Held, poissons_ratio: float) -> tuple[Array, Array]:
        """Return static responses to unit body forces (3 V, 3); those of second order, slow loads and moved regions."""
        factor = self._solved(poissons_ratio)[1]
        force = np.kron(np.eye(3), self.mean[:, None])
        first = linalg.cho_solve(factor, force)
        first /= np.sqrt(np.einsum("ak,ak->k", first, force))
        raw = np.einsum("rv,avm->mar", self.transform, first.reshape(3, self.count, 3))
        load, turn = second_order_load(self.slopes, self.stiff, raw, poissons_ratio, self.lame_ratio)
        reduced = np.einsum("rv,arp->avp", self.transform, load.reshape(3, len(self.transform), -1))
        i, j = np.triu_indices(3)
        load = AMPLITUDE * np.sqrt(turn[i] * turn[j]) * reduced.reshape(len(first), -1)
        second = linalg.cho_solve(factor, load)
        # Of unit energy at most: of a plate, whose plane is stiff, they would leave no room for modes.
        more = [second / np.sqrt(np.maximum(np.einsum("ak,ak->k", second, load), 1.0))]
        if self.alone:
            slow = slice(self.fixed, None)
            count = min(LOAD_COUNT, self.count - self.fixed)
            value, load = linalg.eigh(self.energy[slow, slow], subset_by_index=[0, count - 1], check_finite=False)
            load = np.pad(load * (value[0] / value) ** 0.25, ((self.fixed, 0), (0, 0)))
            for axis in np.eye(3):
                along = np.kron(axis[:, None], load)
                answer = linalg.cho_solve(factor, along)
                more.append(answer * (LOAD_LEVEL / np.sqrt(np.linalg.eigvalsh(along.T @ answer)[-1])))
        if held.motions.shape[1]:
            # Constraint modes: the body's answer to rigid motions of its exact regions, as Ritz modes.
            volume = None if self.volume is None else self.volume[:, :, :, self.count :]
            whole = elastic_stiffness(self.products[:, :, :, self.count :], poissons_ratio, volume)
            whole = whole.reshape(3, -1, len(held.motions)) @ held.motions
            pull, own = (part.reshape(-1, part.shape[2]) for part in (whole[:, : self.count], whole[:, self.count :]))
            answer, base = -linalg.cho_solve(factor, pull), held.motions.T @ own
            value, vector = linalg.eigh(base + pull.T @ answer, held.motions.T @ held.motions + answer.T @ answer)
            motion = vector[:, RIGID:] / np.sqrt(value[RIGID:])
            self.answered = poissons_ratio, base, pull, motion
            more.append(MOVED_LEVEL * answer @ motion)
        return first, np.concatenate(more, axis=1)

    def _extend(self, found: Array, block: Array, count: int) -> tuple[Array, Array]:
        """Add to functions (V, k) singular vectors of the components of a block (3 V, T), up to a count in all.

        Returns:
            All functions, and the energies of all singular vectors of the block, in their order.
        """
        stacked = block.reshape(3, self.count, -1).transpose(1, 0, 2).reshape(self.count, -1)
        affine = 0 if self.exact else self.fixed  # Constants have no energy to be orthogonal in.
        stacked[:affine] = 0.0
        known = found[:, affine:]
        if known.shape[1]:
            inner = known.T @ self.energy
            for _ in range(2):
                stacked = stacked - known @ linalg.solve(inner @ known, inner @ stacked, assume_a="pos")
        value, vector = linalg.eigh(stacked.T @ self.energy @ stacked, check_finite=False)
        best = np.argsort(-value, kind="stable")
        best = best[value[best] > NEGLIGIBLE * value[-1]]
        share, best = value[best], best[: count - found.shape[1]]
        # In order: the first n span what the first n singular vectors span.
        added = stacked @ (vector[:, best] / np.sqrt(value[best]))
        for _ in range(2):
            added -= found @ (found.T @ added)
        more, upper = np.linalg.qr(added)
        return np.concatenate([found, more * np.sign(np.diag(upper))], axis=1), share


def _symmetric(block: Callable[[int, int], Array]) -> Array:
    """Return products (3, n, 3, n) from the blocks (n, n) of d >= e."""
    first = block(0, 0)
    found = np.empty((3, len(first), 3, len(first)))
    for d in range(3):
        for e in range(d + 1):
            one = block(d, e) if d else first
            found[d, :, e], found[e, :, d] = one, one.T
    return found


def _products(gradient: Array, weights: Array, every: Array) -> Array:
    """Return sum_p w_p d_i b_k d_j b_l of functions = raw @ every, (3, V, 3, V), from raw gradients (P, R, 3)."""
    root = np.sqrt(weights)[:, None]
    slopes = [gradient[:, :, d] * root for d in range(3)]
    return _symmetric(lambda d, e: every.T @ (slopes[d].T @ slopes[e]) @ every)


def _lowest(stiffness: Array, count: int, shift: float = 0.0, factor: Any = None) -> tuple[Array, Array]:
    """Return the lowest eigenpairs of a stiffness (N, N), ascending: block Lanczos on the shifted inverse.

    A block is wider than any cluster of equal frequencies, of which single vectors find one at a time, and is solved
    for at once. The first 46 frequencies of solids come out to 1e-9.
    """
    size, steps = len(stiffness), BLOCK_STEPS + count // 16
    if size <= 2 * BLOCK * steps:
        value, vector = linalg.eigh(stiffness, subset_by_index=[0, count - 1], check_finite=False)
    else:
        if factor is None:
            shifted = stiffness.copy()
            shifted[np.diag_indices(size)] += shift
            try:
                factor = linalg.cho_factor(shifted, check_finite=False, overwrite_a=True)
            except linalg.LinAlgError as error:
                raise BasisError(
                    "the elastic stiffness is singular", hint="Use fewer kernels or more points."
                ) from error
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
