"""Cubature: few weighted points that reproduce the reduced forces of many.

The cost of a step grows with the number of points at which stress is evaluated. The reduced force of pose t is f_t =
sum_p w_p P(F_tp) grad b(X_p), linear in the weights, so sparse non-negative weights are sought that give the same
forces over a set of training poses (An, Kim and James 2008), the same volume, and exactly as many as asked for.

Why not `scipy.optimize.nnls` on the whole problem: it stops at its own number of points (as many as there are rows),
and every step solves a full least-squares problem. The active-set method here (Lawson and Hanson 1974) adds the most
useful point at a time, or eight where many are asked for, to a growing normal system, stops at the count asked for, and
sees the forces through a few seeded random projections per pose. The forces of the lowest elastic modes are fitted each
in its own energy: the bending of a thin body, soft beside its stretching, would otherwise come out a quarter too stiff.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from softmode.checks import require_number
from softmode.deformables.reduction.reduced_stiffness import elastic_modes, reduced_stiffness
from softmode.deformables.reduction.static_response import lame_parameters
from softmode.errors import BasisError

Array = NDArray[np.float64]
Real = NDArray[Any]
"""Of single or double precision."""

POISSON_RATIO = 0.4
"""Poisson's ratio of the training material; the points serve any other."""
_ROWS_PER_POSE = 8
POSE_COUNT = 168
"""Training poses."""
MANY_POSES = 504
"""Training poses of bodies whose held-out forces want more: 384 points of a dumbbell fit 168 too closely. Its held-out
error falls from 4.0 to 2.9 % with 504, at as many points."""
_HELD_OUT_COUNT = 24
_TEST_COUNT = 128
_MOMENT_COUNT = 6
_SOFT_MODE_COUNT = 12
_SOFT_TEST_COUNT = 24
_SOFT_WEIGHT = 3.0
_RIDGE = 1e-11
_FIT_TOLERANCE = 3e-5
"""Relative misfit of the rows at which no more points are added. The ridge and single precision end the descent at 1e-5
to 2e-5: beyond, points came and went for 15 to 45 s (24 functions, 768 points asked for) and the misfit stayed."""
_MOMENT_WEIGHT = 3.0
_GROUPS, _FEWER = 8, 4
"""Groups in which candidates are searched: for one point at a time, and for several."""
_TOGETHER, _ONE_BY_ONE = 8, 384
"""Points that come at once, where more than so many are asked for: 960 points then take 0.8 s instead of 2.8, and the
forces of the beam with 152 functions are off by 3.0 % instead of 2.8. Fewer points come one by one."""
_POOL, _WORTH = 4, 0.3
"""Those that come at once are found among four times as many, and gain this fraction of the best one at least."""


@dataclass(frozen=True, kw_only=True)
class Cubature:
    """Chosen points, their weights, and what was lost."""

    index: NDArray[np.intp]
    """Rows of the full quadrature, ascending, shape (C,)."""
    weights: Array
    """Volumes [m^3], > 0, sum = the volume of the full quadrature, shape (C,)."""
    force_error: float
    """Root mean square over held-out poses of |f - f_full| / |f_full|, in the energy norm (components over the
    functions' rms gradients: the error in the displacement that the force would cause)."""
    stiffness_error: float
    """Relative error of the linearised (rest) force over random small deformations, root mean square."""
    soft_mode_error: float
    """Root mean square relative error of the lowest 12 eigenvalues > 0 of the reduced stiffness at rest."""
    trade_off: dict[int, float]
    """Held-out force error when the choice stops at fewer points."""


def select_cubature(
    weights: Array,
    grad_basis: Array,
    count: int,
    *,
    stiffness_scale: Array | None = None,
    lame_ratio: Array | None = None,
    poissons_ratio: float = POISSON_RATIO,
    driven_count: int = 0,
    pose_count: int = POSE_COUNT,
    seed: int = 0,
    quick: bool = False,
) -> Cubature:
    """Choose `count` points whose weighted stresses reproduce the reduced forces of all points.

    Training poses: a random stretch (principal stretches 0.6..1.6) with random modal displacements on top, whose mean
    strain runs from 2 % to 40 %. Rotations and translations add nothing: the energy is objective, so forces turn with
    the pose. The first moments sum_p w_p grad b are fitted too, so that every homogeneous deformation keeps its force,
    and the energies of the lowest elastic modes, of their pairs, and of each with random mixtures of all, each mode of
    unit energy.

    Args:
        weights: Full weights [m^3], shape (P,).
        grad_basis: Gradients of functions that are orthonormal in mass [1/m], shape (P, n, 3).
        count: Number of points to keep; fewer where these fit the forces to 3e-5.
        stiffness_scale: Relative shear modulus per point, shape (P,); ones when None.
        lame_ratio: lambda / mu per point over that of `poissons_ratio`, shape (P,); ones when None.
        poissons_ratio: Of the training material.
        driven_count: The first so many functions are prescribed and take no part in the elastic modes.
        pose_count: Number of training poses.
        seed: Seed of the poses and projections.
        quick: Whether points come several at once, as they do in any case where more than 384 are asked for.

    Returns:
        The cubature; all points with their own weights when count >= P.

    Raises:
        ConfigError: If count is less than 8.
        BasisError: If the forces are not finite.
    """
    require_number("cubature_count", count, at_least=8)
    point_count = len(grad_basis)
    if count >= point_count:
        return Cubature(
            index=np.arange(point_count),
            weights=weights.copy(),
            force_error=0.0,
            stiffness_error=0.0,
            soft_mode_error=0.0,
            trade_off={},
        )
    rng = np.random.default_rng(seed)
    modulus = np.ones(point_count) if stiffness_scale is None else np.asarray(stiffness_scale, dtype=np.float64)
    fraction = weights / weights.sum()
    # Functions without gradient carry no force. The others count per unit of rms gradient: the length of a force is
    # then its energy norm.
    gradient = np.asarray(grad_basis, dtype=np.float64).transpose(1, 2, 0)
    if not np.isfinite(gradient).all():
        raise BasisError("grad_basis: not all finite")
    slope = np.sqrt(np.square(gradient).sum(axis=1) @ (fraction * modulus))
    live = slope > 1e-9 * slope.max()
    driven = int(live[:driven_count].sum())
    slope = slope[live]
    gradient = np.ascontiguousarray(gradient[live] / slope[:, None, None])  # (n, 3, P)
    full = _Sampler(gradient, fraction * modulus, poissons_ratio, lame_ratio)
    # What is fitted may be rounded, it is the same on both sides: half the time in half the digits.
    modulus32 = modulus.astype(np.float32)
    short = _Sampler(gradient.astype(np.float32), (fraction * modulus).astype(np.float32), poissons_ratio, lame_ratio)

    # Rows: the virtual work of each pose's stress on a few random test displacements, per unit of the pose's force.
    tests = rng.normal(size=(3 * _TEST_COUNT, len(slope))) @ gradient.reshape(len(slope), -1) / np.sqrt(_ROWS_PER_POSE)
    tests = tests.reshape(_TEST_COUNT, 9, point_count).astype(np.float32)
    moments = tests[:_MOMENT_COUNT].reshape(-1, point_count)
    rows = [
        _MOMENT_WEIGHT * np.ones((1, point_count)),
        _MOMENT_WEIGHT * moments / np.sqrt((moments**2 @ fraction).mean()),
    ]
    for poses in _batches(_poses(pose_count, slope, rng)):
        stress = short.stress(poses)
        scale = 1.0 / np.linalg.norm(short.force(stress), axis=(1, 2))
        for one, factor in zip(stress, scale, strict=True):
            picked = tests[rng.choice(_TEST_COUNT, _ROWS_PER_POSE, replace=False)]
            rows.append(np.einsum("rcp,cp->rp", picked, one.reshape(9, -1)) * (factor * modulus32))
    eigenvalue, mode = elastic_modes(_free_stiffness(full, slope, driven))
    rows.append(_soft_rows(full, eigenvalue, _per_slope(mode, slope, driven), rng) * modulus)
    columns = np.ascontiguousarray(np.concatenate(rows, dtype=np.float32).T)
    sizes = {k for k in (32, 64, 96, 128, 192, 256, 384) if k < count} | {count}
    # Thousands of small products: threads of a BLAS would wait for each other on a busy machine.
    with threadpool_limits(limits=1, user_api="blas"):
        together = _TOGETHER if quick or count > _ONE_BY_ONE else 1
        path = _nonnegative_path(columns, fraction @ columns, sizes, rng, together)

    fresh = np.random.default_rng([seed, 1])
    held_out = _poses(_HELD_OUT_COUNT, slope, fresh)
    small = [(np.eye(3), 1e-5 * fresh.normal(size=(len(slope), 3))) for _ in range(8)]
    reference = np.concatenate([full.force(full.stress(poses)) for poses in _batches(held_out + small)])
    errors, linear = {}, 0.0
    for size, (index, value) in path.items():
        few = full.at(index, value * modulus[index])
        found = few.force(few.stress(held_out + small))
        ratio = np.linalg.norm(found - reference, axis=(1, 2)) / np.linalg.norm(reference, axis=(1, 2))
        errors[size] = float(np.sqrt((ratio[:_HELD_OUT_COUNT] ** 2).mean()))
        linear = float(np.sqrt((ratio[_HELD_OUT_COUNT:] ** 2).mean()))
    index, value = path[max(path)]
    order = np.argsort(index)
    lowest = eigenvalue[:_SOFT_MODE_COUNT]
    few = full.at(index, value * modulus[index])
    rigid = 3 * (len(slope) - driven) - len(eigenvalue)
    found = np.linalg.eigvalsh(_free_stiffness(few, slope, driven))[rigid : rigid + len(lowest)]
    return Cubature(
        index=index[order],
        weights=value[order] * weights.sum(),
        force_error=errors[max(path)],
        stiffness_error=linear,
        soft_mode_error=float(np.sqrt(np.mean((found / lowest - 1.0) ** 2))) if len(lowest) else 0.0,
        trade_off=errors,
    )


def _free_stiffness(points: _Sampler, slope: Array, driven: int) -> Array:
    """Return the stiffness at rest of the functions that are not driven, per unit of mass."""
    scale = np.tile(slope[driven:], 3)
    gradient = points.gradient.reshape(len(slope), 3, -1)[driven:]
    found = reduced_stiffness(gradient, points.weights, points.poissons_ratio, points.lame_ratio)
    return scale[:, None] * found * scale


def _per_slope(mode: Array, slope: Array, driven: int) -> Array:
    """Return modes (3 (n - driven), M) as strains of all functions, (M, 3, n)."""
    strain = np.zeros((mode.shape[1], 3, len(slope)))
    strain[:, :, driven:] = mode.T.reshape(len(strain), 3, -1) * slope[driven:]
    return strain


def _soft_rows(full: _Sampler, eigenvalue: Array, mode: Array, rng: np.random.Generator) -> Array:
    """Return the mutual energies per volume of the lowest elastic modes, and theirs with random combinations of all.

    Args:
        full: All points.
        eigenvalue: Of the elastic modes, ascending, (M,).
        mode: Elastic modes of unit energy, ascending, (M, 3, n).
        rng: Of the combinations.
    """
    mu, lame = full.law
    mixed = rng.normal(size=(_SOFT_TEST_COUNT, len(mode))) @ mode.reshape(len(mode), -1) / np.sqrt(_SOFT_TEST_COUNT)
    soft = full.slopes(mode[:_SOFT_MODE_COUNT])
    tests = np.concatenate([soft, full.slopes(mixed.reshape(-1, *mode.shape[1:]))]).reshape(-1, 9, soft.shape[-1])
    # The softer a mode, the more of the motion it carries: its weight falls with the root of its frequency.
    weight = _SOFT_WEIGHT * (eigenvalue[:1] / eigenvalue[: len(soft)]) ** 0.25
    rows = [np.zeros((0, soft.shape[-1]))]
    for k, slope in enumerate(soft):
        stress = mu * (slope + slope.transpose(1, 0, 2))
        stress[range(3), range(3)] += lame * np.einsum("iip->p", slope)
        rows.append(np.einsum("cp,rcp->rp", weight[k] * stress.reshape(9, -1), tests[k:]))
    return np.concatenate(rows)


def _poses(count: int, slope: Array, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Return (A, s) of F = A (I + sum_k s_k grad b_k / slope_k): random stretches after random modal strains."""
    poses = []
    for k in range(count):
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        stretch = frame @ np.diag(np.exp(rng.uniform(np.log(0.6), np.log(1.6), size=3))) @ frame.T
        # Odd poses favour the smooth functions, as real motions do; even ones strain all functions alike.
        strain = rng.normal(size=(len(slope), 3)) / (slope ** (k % 2))[:, None]
        strain *= 0.02 * 20.0 ** ((k + 0.5) / count) / np.linalg.norm(strain)
        poses.append((stretch if k % 3 else np.eye(3), strain))
    return poses


def _batches(poses: list[tuple[Array, Array]]) -> list[list[tuple[Array, Array]]]:
    """Split poses into groups: few large matrix products instead of many small ones."""
    return [poses[i : i + 16] for i in range(0, len(poses), 16)]


class _Sampler:
    """Stresses and forces of a set of weighted points, for several poses at a time."""

    def __init__(self, gradient: Real, weights: Real, poissons_ratio: float, lame_ratio: Array | None) -> None:
        self.gradient = np.ascontiguousarray(gradient).reshape(len(gradient), -1)  # (n, 3 P)
        self.weights, self.poissons_ratio, self.lame_ratio = weights, poissons_ratio, lame_ratio
        mu, lame = lame_parameters(poissons_ratio)
        self.law = (mu, lame if lame_ratio is None else (lame * lame_ratio).astype(self.gradient.dtype))
        """Mu and lambda for mu's relative value one; lambda of all points, or of each, (P,)."""

    def at(self, index: NDArray[np.intp], weights: Array) -> _Sampler:
        """Return a few of the points with weights of their own."""
        few = self.gradient.reshape(len(self.gradient), 3, -1)[:, :, index]
        return _Sampler(few, weights, self.poissons_ratio, None if self.lame_ratio is None else self.lame_ratio[index])

    def slopes(self, strain: Array) -> Array:
        """Return grad u of displacements given per function's slope, (N, 3, n) -> (N, 3, 3, P)."""
        return (strain.reshape(-1, len(self.gradient)) @ self.gradient).reshape(len(strain), 3, 3, -1)

    def stress(self, poses: list[tuple[Array, Array]]) -> Array:
        """Return P(F) for E = 1, shape (poses, 3, 3, P)."""
        inner = self.slopes(np.stack([strain.T for _, strain in poses]).astype(self.gradient.dtype))
        inner[:, range(3), range(3)] += 1.0
        turn = np.stack([pose[0] for pose in poses]).astype(inner.dtype)
        turned = (turn @ inner.reshape(len(poses), 3, -1)).reshape(inner.shape)
        return np.stack([_stress(f, *self.law) for f in turned])

    def force(self, stress: Array) -> Array:
        """Return sum_p w_p P_p grad b_p, shape (poses, 3, n)."""
        flat = (stress * self.weights).reshape(len(stress) * 3, -1)
        return (flat @ self.gradient.T).reshape(len(stress), 3, -1)


def _stress(f: Array, mu: float, lame: float | Array) -> Array:
    """Return P(F), (3, 3, P), of stable Neo-Hookean material with origin term (Smith et al. 2018) for E = 1."""
    m, k = 4.0 / 3.0 * mu, lame + 5.0 / 6.0 * mu
    rest = 1.0 + m / k - m / (4.0 * k)
    cofactor = np.empty_like(f)
    for i in range(3):
        a, b = f[(i + 1) % 3], f[(i + 2) % 3]
        for j in range(3):
            p, q = (j + 1) % 3, (j + 2) % 3
            cofactor[i, j] = a[p] * b[q] - a[q] * b[p]
    volume = (f[0] * cofactor[0]).sum(axis=0)
    trace = np.einsum("ijp,ijp->p", f, f)
    return (m * (1.0 - 1.0 / (trace + 1.0))) * f + (k * (volume - rest)) * cofactor


def _nonnegative_path(
    columns: Real, target: Array, sizes: set[int], rng: np.random.Generator, together: int
) -> dict[int, tuple[NDArray[np.intp], Array]]:
    """Grow a non-negative least-squares solution of  x @ columns = target,  sum x = 1.

    Fewer points than asked for remain where the misfit ends in rounding before.

    Candidates are searched in interleaved random groups, one per step: a fresh group costs a part of the search and
    loses nothing visible.

    Args:
        columns: What each point of unit weight brings, single precision, (P, r).
        target: What all bring, (r,).
        sizes: At how many points to keep the solution.
        rng: Of the groups.
        together: How many points come at once.

    Returns:
        For each size reached: indices and weights.
    """
    group = [np.sort(g) for g in np.array_split(rng.permutation(len(columns)), _GROUPS if together == 1 else _FEWER)]
    stored = [columns[g] for g in group]
    inverse_length = 1.0 / np.maximum(np.linalg.norm(columns, axis=1), 1e-30)
    top, size, done = max(sizes), np.linalg.norm(target), False
    points = _ActiveSet(columns, target, top)
    path: dict[int, tuple[NDArray[np.intp], Array]] = {}
    residual = target.copy()
    idle, step = 0, 0
    while not done and points.count < top and idle < len(group) and step < 8 * top:
        candidates, stack = group[step % len(group)], stored[step % len(group)]
        step += 1
        scale = inverse_length[candidates]
        gain = np.where(points.active[candidates], -np.inf, (stack @ residual.astype(np.float32)) * scale)
        room = min(mark for mark in sizes if mark > points.count) - points.count
        some = _apart(gain, stack, scale, min(together, max(1, points.count // 8), room))
        if not points.add(candidates[some[gain[some] > 1e-12]]):
            idle += 1
            continue
        idle = 0
        points.settle()
        residual = target - points.value @ points.support[: points.count]
        done = np.linalg.norm(residual) <= _FIT_TOLERANCE * size
        if points.count in sizes:
            path[points.count] = points.solution()
    path[points.count] = points.solution()
    return path


def _apart(gain: Array, stack: Real, scale: Array, count: int) -> NDArray[np.intp]:
    """Return the candidates that gain most, each beside what the ones before it already bring, `count` at most.

    Args:
        gain: Of each candidate, (N,).
        stack: What each brings, (N, r).
        scale: One over the length of that, (N,).
        count: How many.
    """
    if count == 1:
        return np.array([gain.argmax()])
    pool = np.argpartition(-gain, _POOL * count)[: _POOL * count] if len(gain) > _POOL * count else np.arange(len(gain))
    unit = stack[pool] * scale[pool, None]
    left, alike, found = gain[pool], unit @ unit.T, []
    least = _WORTH * left.max()
    while len(found) < count and left.max() >= least and np.isfinite(left.max()):
        best = int(left.argmax())
        found.append(best)
        left = left - left[best] * alike[best]
        left[found] = -np.inf
    return pool[found]


class _ActiveSet:
    """Points and their non-negative weights, with the inverse of their normal matrix.

    The inverse is bordered and reduced as points come and go.
    """

    def __init__(self, columns: Real, target: Array, most: int) -> None:
        self.columns, self.target = columns, target
        self.active = np.zeros(len(columns), dtype=bool)
        self.chosen, self.value = np.zeros(0, dtype=np.intp), np.zeros(0)
        self.support = np.empty((most, columns.shape[1]))
        """What each chosen point brings, the first `count` rows."""
        self.normal, self.inverse, self.right = np.empty((most, most)), np.empty((most, most)), np.empty(most)

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.chosen)

    def solution(self) -> tuple[NDArray[np.intp], Array]:
        """Return indices and weights."""
        return self.chosen.copy(), self.value / self.value.sum()

    def add(self, index: NDArray[np.intp]) -> bool:
        """Add points that bring what others do not, of weight zero yet; return whether there are any."""
        k = self.count
        columns = self.columns[index].astype(np.float64)
        coupling = self.support[:k] @ columns.T
        length = columns @ columns.T
        length[np.diag_indices(len(index))] *= 1.0 + _RIDGE
        shadow = self.inverse[:k, :k] @ coupling
        rest = length - coupling.T @ shadow
        new = _independent(rest, _RIDGE * np.diag(length))
        if not len(new):
            return False
        index, columns, coupling, shadow = index[new], columns[new], coupling[:, new], shadow[:, new]
        own = np.linalg.inv(rest[np.ix_(new, new)])
        own = 0.5 * (own + own.T)
        edge, end = shadow @ own, k + len(new)
        self.chosen, self.value = np.append(self.chosen, index), np.append(self.value, np.zeros(len(new)))
        self.active[index] = True
        self.support[k:end], self.right[k:end] = columns, columns @ self.target
        self.normal[k:end, :k], self.normal[:k, k:end] = coupling.T, coupling
        self.normal[k:end, k:end] = length[np.ix_(new, new)]
        self.inverse[:k, :k] += edge @ shadow.T
        self.inverse[k:end, :k], self.inverse[:k, k:end], self.inverse[k:end, k:end] = -edge.T, -edge, own
        return True

    def settle(self) -> None:
        """Solve for the weights; drop the points whose weights vanish on the way."""
        while True:
            k = self.count
            inverse = self.inverse[:k, :k]
            trial = inverse @ self.right[:k]
            # Refinement repairs what the updates of the inverse lose.
            trial += inverse @ (self.right[:k] - self.normal[:k, :k] @ trial)
            negative = np.flatnonzero(trial <= 0.0)
            if not len(negative):
                self.value = trial
                return
            # Walk to the first weight that vanishes and drop it: of several new ones, the worst.
            reach = self.value[negative] / np.maximum(self.value[negative] - trial[negative], 1e-300)
            first = negative[reach == reach.min()]
            self.value = np.maximum(self.value + reach.min() * (trial - self.value), 0.0)
            self._drop(int(first[trial[first].argmin()]))

    def _drop(self, gone: int) -> None:
        """Drop a point; the last one takes its place."""
        k = self.count
        inverse, normal, last = self.inverse[:k, :k], self.normal[:k, :k], k - 1
        edge = inverse[:, gone].copy()
        inverse -= edge[:, None] * (edge / edge[gone])
        self.active[self.chosen[gone]] = False
        for matrix in (inverse, normal):
            corner = matrix[last, last]
            matrix[gone], matrix[:, gone] = matrix[last], matrix[:, last]
            matrix[gone, gone] = corner
        for rows in (self.support, self.right, self.chosen, self.value):
            rows[gone] = rows[last]
        self.chosen, self.value = self.chosen[:last].copy(), self.value[:last].copy()


def _independent(gram: Array, least: Array) -> NDArray[np.intp]:
    """Return which of some vectors with a Gram matrix (N, N) hold more than `least` (N,) beside those before them."""
    found, gram = [], gram.copy()
    for i in range(len(gram)):
        if gram[i, i] > least[i]:
            found.append(i)
            gram -= gram[:, i, None] * (gram[i] / gram[i, i])
    return np.array(found, dtype=np.intp)
