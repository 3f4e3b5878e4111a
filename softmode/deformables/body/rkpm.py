"""Reproducing kernels: shape functions on scattered centres that reproduce every linear function.

Each of the K centres p_k carries a bell phi_k(X) = w(|X - p_k| / R_k). The reproducing kernel is the bell times a
correction,

    phi~_k(X) = phi_k(X) P(xi_k)^T M(X)^-1 P(0),   M(X) = sum_k phi_k P(xi_k) P(xi_k)^T,   P = (1, x, y, z),   xi_k =
    (X - p_k) / h,

so that sum_k phi~_k = 1 and sum_k phi~_k p_k = X. This is eq. (7-10) of FreeForm: the polynomial space does not change
under shift and scale, so the local, scaled coordinates give the same functions and a moment matrix with a condition
number of order ten.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.spatial import KDTree

from softmode.deformables.body.detours import Detours
from softmode.deformables.body.visibility import Visibility
from softmode.errors import BasisError, ConfigError

KernelName = Literal["cubic", "gaussian"]
Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Longer = tuple[Array, Array]
"""What detours add to the distances of pairs [m] (pairs,), and its gradient (pairs, 3) where that is asked for."""

CUBIC_SUPPORT = 3.0
"""Support radius of the cubic spline in units of r_k (measured: faster than, and as accurate as, the Gaussian)."""
GAUSSIAN_SUPPORT = 5.0
"""The Gaussian exp(-(d / r_k)^2) is cut at this many r_k (1e-11); an earlier cut shows in the gradients."""
CONDITION_LIMIT = 1e8
"""Largest 1-norm condition number of the moment matrix that counts as covered."""
REACH = 0.35
"""How far from its nearest kernel centre a point may lie, as a fraction of the kernel's support. Inside an object the
ratio stays under 0.3; beyond, the functions grow as extrapolated polynomials do (tenfold at 0.5), so they are held
constant."""
_PAIRS_PER_CHUNK = 125_000
"""Distances that are looked at together: their tables stay in a processor's second cache."""
_BLOCK_POINTS = 64


@dataclass(frozen=True)
class ShapeFunctions:
    """Values and gradients of the reproducing kernels at N points, sparse."""

    value: sparse.csr_matrix
    """phi~ (N, K)."""
    gradient: tuple[sparse.csr_matrix, ...]
    """d phi~ / dX_d [1/m], three matrices (N, K) with the pattern of `value`; none where they were not asked for."""

    points: Array
    """Where they were evaluated [m], shape (N, 3)."""

    @property
    def centre_count(self) -> int:
        """Number of kernels K."""
        rows_and_columns: Any = self.value.shape
        return int(rows_and_columns[1])

    def scaled(self, factor: Array, slope: Array) -> ShapeFunctions:
        """Return the functions times a scalar field of values (N,) and gradients [1/m] (N, 3)."""
        row = np.repeat(np.arange(len(factor)), np.diff(self.value.indptr))

        def like(data: Array) -> sparse.csr_matrix:
            return sparse.csr_matrix((data, self.value.indices, self.value.indptr), shape=self.value.shape)

        gradient = [like(g.data * factor[row] + self.value.data * slope[row, d]) for d, g in enumerate(self.gradient)]
        return ShapeFunctions(like(self.value.data * factor[row]), tuple(gradient), self.points)

    def blocks(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Split the points into compact groups: rows of each, and the kernels that reach them, both ascending.

        Sums over points are dense within a group and skip the kernels that do not reach it: a tenth of the work of
        dense matrices, at the same speed per operation.
        """
        order = KDTree(self.points, leafsize=_BLOCK_POINTS).indices
        found = []
        for rows in np.array_split(order, max(1, len(order) // _BLOCK_POINTS)):
            rows = np.sort(rows)
            found.append((rows, np.unique(self.value[rows].indices).astype(np.intp)))
        return found


@dataclass(frozen=True, kw_only=True)
class BasisRKPM:
    """Reproducing kernels on fixed centres."""

    centres: Array
    """Centres p_k [m], shape (K, 3)."""
    radii: Array
    """Nominal radii r_k [m], shape (K,); the support is `support` times as wide."""
    kernel: KernelName = "cubic"
    visibility: Visibility | None = None
    """What of the material the kernels act on; None: all within their support."""
    detours: Detours | None = None
    """By how much their distances through the material are longer than straight lines; None: nowhere."""

    def __post_init__(self) -> None:
        """Check shapes, finiteness and the kernel's name."""
        if self.kernel not in get_args(KernelName):
            raise ConfigError(f"kernel: expected one of {get_args(KernelName)}, got {self.kernel!r}")
        if self.centres.ndim != 2 or self.centres.shape[1:] != (3,) or self.radii.shape != self.centres.shape[:1]:
            raise BasisError(f"centres (K, 3) and radii (K,): got shapes {self.centres.shape} and {self.radii.shape}")
        if len(self.centres) < 4:
            raise BasisError(f"centres: at least 4 are needed to reproduce linear functions, got {len(self.centres)}")
        if not (np.isfinite(self.centres).all() and np.isfinite(self.radii).all() and (self.radii > 0.0).all()):
            raise BasisError("centres and radii must be finite, radii positive")

    @property
    def kernel_count(self) -> int:
        """Number of centres K."""
        return len(self.centres)

    @property
    def support(self) -> Array:
        """Support radii R_k [m], shape (K,)."""
        return self.radii * (CUBIC_SUPPORT if self.kernel == "cubic" else GAUSSIAN_SUPPORT)

    def evaluate(self, points: ArrayLike, *, gradients: bool = True) -> ShapeFunctions:
        """Evaluate all reproducing kernels and their gradients.

        Args:
            points: Rest positions [m], shape (N, 3).
            gradients: Whether gradients are wanted; values alone take a third of the time.

        Returns:
            Sparse values (N, K) and gradients.

        Raises:
            BasisError: If a point is not covered by enough kernels in general position (singular moment matrix).
        """
        x = np.ascontiguousarray(points, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != 3:
            raise BasisError(f"points: expected shape (N, 3), got {x.shape}")
        if not np.isfinite(x).all():
            raise BasisError("points: not all finite", hint="Remove the points that hold NaN or infinity.")
        if not len(x):
            empty = sparse.csr_matrix((0, self.kernel_count))
            return ShapeFunctions(empty, (empty,) * (3 if gradients else 0), x)
        step = max(1, _PAIRS_PER_CHUNK // self.kernel_count)
        parts = [self._evaluate_chunk(x[i : i + step], i, gradients) for i in range(0, len(x), step)]
        row_count = np.concatenate([p[0] for p in parts])
        column = np.concatenate([p[1] for p in parts])
        value, gradient = np.concatenate([p[2] for p in parts]), np.concatenate([p[3] for p in parts])
        start = np.concatenate([[0], np.cumsum(row_count)])
        shape = (len(x), self.kernel_count)

        def matrix(data: Array) -> sparse.csr_matrix:
            return sparse.csr_matrix((np.ascontiguousarray(data), column, start), shape=shape)

        return ShapeFunctions(matrix(value), tuple(matrix(along) for along in gradient.T), x)

    def conditions(self, points: ArrayLike) -> Array:
        """Return the 1-norm condition numbers of the moment matrices at points (N, 3) [m], shape (N,).

        Infinite where fewer than four kernels reach a point; `evaluate` refuses those over `CONDITION_LIMIT`.
        """
        x = np.asarray(points, dtype=np.float64)
        found = np.full(len(x), np.inf)
        step = max(1, _PAIRS_PER_CHUNK // self.kernel_count)
        for i in range(0, len(x), step):
            count, moment = self._moments(x[i : i + step])
            good = np.flatnonzero((count >= 4) & (moment[:, 0, 0] > 1e-14))
            scaled = moment[good] / moment[good, :1, :1]
            value = np.linalg.cond(scaled, 1)
            found[i + good] = np.where(np.isfinite(value), value, np.inf)
        return found

    def nearest(self, points: Array) -> tuple[Array, NDArray[np.intp]]:
        """Return the distance [m] (N,) to the nearest kernel that acts at each of points (N, 3), and which it is."""
        found: Any = self._tree.query(points)
        distance, nearest = found
        if self.visibility is None and self.detours is None:
            return distance, nearest
        for rows in np.array_split(np.arange(len(points)), 1 + len(points) * self.kernel_count // _PAIRS_PER_CHUNK):
            some = np.arange(len(rows))
            added: Any = None if self.detours is None else self.detours.added(points[rows], self.kernel_count)[0]
            lost = np.zeros(len(rows), dtype=bool) if added is None else np.ravel(added[some, nearest[rows]]) > 0.0
            if self.visibility is not None:
                lost |= self.visibility.hides(points[rows], some, nearest[rows])
            some = np.flatnonzero(lost)
            away = np.linalg.norm(points[rows[some], None] - self.centres, axis=2)
            if added is not None:
                away += added[some].toarray()
            if self.visibility is not None:
                row, column = np.divmod(np.arange(away.size), self.kernel_count)
                away[self.visibility.hides(points[rows[some]], row, column).reshape(away.shape)] = np.inf
            nearest[rows[some]] = away.argmin(axis=1)
            distance[rows[some]] = away.min(axis=1)
        return distance, nearest

    def covered(self, points: Array) -> NDArray[np.bool_]:
        """Return at which of points (N, 3) `evaluate` finds enough kernels, shape (N,)."""
        found = np.zeros(len(points), dtype=bool)
        for some in np.array_split(np.arange(len(points)), 1 + len(points) * self.kernel_count // _PAIRS_PER_CHUNK):
            count, moment = self._moments(points[some])
            found[some] = (count >= 4) & ~_inverted(moment)[1]
        return found

    def _moments(self, x: Array) -> tuple[Indices, Array]:
        """Return kernels per point (N,), and the moment matrices (N, 4, 4)."""
        row, column, count, longer = self._pairs(x)
        offset = x[row] - self.centres[column]
        poly = np.column_stack([np.ones(len(row)), offset / float(self.support.mean())])
        bell, moment = self._bell(offset, column, longer)[0], np.empty((len(x), 4, 4))
        for a, b in zip(*np.triu_indices(4), strict=True):
            entry = np.bincount(row, poly[:, a] * poly[:, b] * bell, minlength=len(x))
            moment[:, a, b] = moment[:, b, a] = entry
        return count, moment

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.centres)

    def _pairs(self, x: Array, *, slopes: bool = False) -> tuple[Indices, Indices, Indices, Longer | None]:
        """Return the row and kernel of every pair within reach, by rows, and kernels per point (N,).

        Last, what detours add to the distances of these pairs [m] (pairs,), and, if asked for, its gradient (pairs, 3),
        else zeros (1, 1); None without detours.
        """
        origin = self.centres.mean(axis=0)
        a, b = x - origin, self.centres - origin
        distance_sq = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T)
        near, tables = distance_sq < self.support**2 * (1.0 + 1e-9), []
        if self.detours is not None:
            tables = [matrix.toarray() for matrix in self.detours.added(x, self.kernel_count, slopes=slopes)]
            straight = np.sqrt(np.maximum(distance_sq, 0.0))
            near &= (tables[0] == 0.0) | (straight + tables[0] < self.support * (1.0 + 1e-9))
        row, column = np.nonzero(near)
        if self.visibility is not None:
            acting = ~self.visibility.hides(x, row, column)
            row, column = row[acting], column[acting]
        longer = None
        if tables:
            along = [table[row, column] for table in tables]
            longer = along[0], np.stack(along[1:], axis=1) if slopes else np.zeros((1, 1))
        return row, column, np.bincount(row, minlength=len(x)), longer

    def _evaluate_chunk(
        self, x: Array, first: int, gradients: bool
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Return kernels per point (N,), column of each pair, value (pairs,) and gradient (pairs, 3) or (pairs, 0)."""
        row, column, count, longer = self._pairs(x, slopes=gradients)
        if count.min() < 4:
            self._raise_uncovered(np.flatnonzero(count < 4) + first, x[count < 4])
        h = float(self.support.mean())
        offset = np.take(x, row, axis=0) - np.take(self.centres, column, axis=0)
        w, slope = self._bell(offset, column, longer)
        poly = np.empty((len(row), 4))
        poly[:, 0] = 1.0
        np.divide(offset, h, out=poly[:, 1:])
        start = np.concatenate([[0], np.cumsum(count)[:-1]])

        # Moment matrix and c = M^-1 P(0); s = P(xi)^T c is the correction.
        upper_i, upper_j = np.triu_indices(4)
        weighted = poly * w[:, None]
        moment = np.empty((len(x), 4, 4))
        for i, j in zip(upper_i, upper_j, strict=True):
            moment[:, i, j] = moment[:, j, i] = np.add.reduceat(weighted[:, i] * poly[:, j], start)
        inverse = self._invert(moment, x, first)
        c = inverse[:, :, 0]
        s = np.einsum("pi,pi->p", poly, np.take(c, row, axis=0))
        value = w * s
        if not gradients:
            return count, column, value, np.empty((len(value), 0))
        # dM_d c = sum_k (d_d w) s P + e_(d+1)/h + M[:, 0] c_(d+1)/h   (because sum_k w s P = M c = e_0);   dc_d =
        # -M^-1 dM_d c.
        slope_s = slope * s[:, None]
        dmc = np.empty((len(x), 3, 4))
        for d in range(3):
            for i in range(4):
                dmc[:, d, i] = np.add.reduceat(slope_s[:, d] * poly[:, i], start)
            dmc[:, d, d + 1] += 1.0 / h
        dmc += c[:, 1:, None] * moment[:, None, :, 0] / h
        dc = -np.einsum("nij,ndj->ndi", inverse, dmc)
        dc[:, :, 0] += c[:, 1:] / h
        gradient = np.einsum("pi,pdi->pd", weighted, np.take(dc, row, axis=0))
        gradient += slope_s
        return count, column, value, gradient

    def _bell(self, offset: Array, column: Indices, longer: Longer | None) -> tuple[Array, Array]:
        """Return w (pairs,) and its gradient (pairs, 3) for offsets X - p_k (pairs, 3) and what detours add."""
        straight = distance = np.sqrt(np.einsum("pd,pd->p", offset, offset))
        if longer is not None:
            distance = straight + longer[0]
        if self.kernel == "gaussian":
            inverse = (1.0 / self.radii)[column]
            w = np.exp(-((distance * inverse) ** 2))
            over_distance = -2.0 * w * inverse**2
        else:
            inverse = (1.0 / self.support)[column]
            q = distance * inverse
            rest = np.maximum(1.0 - q, 0.0)
            near = np.maximum(0.5 - q, 0.0)
            # Cubic B-spline: 4/3 (1-q)^3 - 16/3 (1/2-q)_+^3; the slope over q is regular at q = 0.
            w = (4.0 / 3.0) * rest**3 - (16.0 / 3.0) * near**3
            slope = -4.0 * rest**2 + 16.0 * near**2
            small = q < 1e-8
            over_distance = np.where(small, -8.0, slope / np.where(small, 1.0, q)) * inverse**2
        if longer is not None:  # The gradient of the distance is that of both its parts.
            lengthened = np.where(longer[0] != 0.0, distance / np.maximum(straight, 1e-300), 1.0)
            offset = offset * lengthened[:, None] + longer[1] * distance[:, None]
        return w, offset * over_distance[:, None]

    def _invert(self, moment: Array, x: Array, first: int) -> Array:
        """Invert the moment matrices (N, 4, 4), refusing ill-conditioned ones."""
        inverse, lost = _inverted(moment)
        if lost.any():
            self._raise_uncovered(np.flatnonzero(lost) + first, x[lost])
        return inverse

    def _raise_uncovered(self, index: NDArray[np.intp], x: Array) -> None:
        raise BasisError(
            f"points: {len(index)} of them (first: row {index[0]} at {np.round(x[0], 6).tolist()} m) are not covered by"
            " enough reproducing kernels",
            hint="Use more or wider kernels, or evaluate only points within the object.",
        )


def _inverted(moment: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverses of moment matrices (N, 4, 4), and which are too ill-conditioned to have one (N,)."""
    # Scaling by the zeroth moment keeps the determinant away from underflow at points seen only by kernel rims.
    scale = moment[:, 0, 0].copy()
    lost = ~(scale > 1e-14)
    scaled = moment / np.where(lost, 1.0, scale)[:, None, None]
    scaled[lost] = np.eye(4)
    lost |= np.abs(np.linalg.det(scaled)) < 1e-30
    scaled[lost] = np.eye(4)
    inverse = np.linalg.inv(scaled)
    condition = np.abs(scaled).sum(axis=1).max(axis=1) * np.abs(inverse).sum(axis=1).max(axis=1)
    lost |= ~(condition < CONDITION_LIMIT)
    return inverse / np.where(lost, 1.0, scale)[:, None, None], lost


def sample_farthest(points: ArrayLike, count: int, *, seed: int = 0, first: int | None = None) -> NDArray[np.intp]:
    """Choose `count` points by farthest point sampling.

    Args:
        points: Candidates, shape (N, D).
        count: How many; all of them when count >= N.
        seed: Selects the first point, unless `first` names it.
        first: Index of the first point.

    Returns:
        Indices in the order chosen, shape (min(count, N),); deterministic, ties go to the lowest index.
    """
    axes = np.ascontiguousarray(np.asarray(points, dtype=np.float64).T)
    count = min(count, axes.shape[1])
    chosen = np.empty(count, dtype=np.intp)
    chosen[0] = np.random.default_rng(seed).integers(axes.shape[1]) if first is None else first
    nearest = np.full(axes.shape[1], np.inf)
    distance, scratch = np.empty_like(nearest), np.empty_like(nearest)
    for k in range(count):
        if k:
            chosen[k] = int(nearest.argmax())
        distance.fill(0.0)
        for axis in axes:
            np.subtract(axis, axis[chosen[k]], out=scratch)
            np.multiply(scratch, scratch, out=scratch)
            np.add(distance, scratch, out=distance)
        np.minimum(nearest, distance, out=nearest)
    return chosen


def make_basis(
    points: ArrayLike, kernel_count: int, *, kernel: KernelName = "cubic", spacing: float | None = None, seed: int = 0
) -> BasisRKPM:
    """Place kernels on a point set by farthest point sampling and choose their radii.

    r_k is the distance to the second nearest other centre. The Gaussian, whose flank is narrower, never goes under
    three point spacings: without that bound its eigenvalues lose a factor of three in accuracy. The spline's floor is
    1.5 spacings.

    Args:
        points: Quadrature points [m], shape (P, 3).
        kernel_count: Number of centres K; at most P are used.
        kernel: Name of the bell.
        spacing: Point spacing [m]; estimated from nearest neighbours when None.
        seed: Seed of the farthest point sampling.

    Returns:
        The basis.

    Raises:
        BasisError: If fewer than four distinct points are given.
    """
    x = np.asarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 4:
        raise BasisError(f"points: expected at least 4 points of shape (P, 3), got {x.shape}")
    if kernel_count < 4:
        raise ConfigError(f"kernel_count must be at least 4, got {kernel_count}")
    if spacing is None:
        spacing = float(np.median(KDTree(x).query(x, k=2)[0][:, 1]))
    centres = x[sample_farthest(x, kernel_count, seed=seed)]
    neighbour = KDTree(centres).query(centres, k=3)[0][:, 2]
    floor = spacing * (3.0 if kernel == "gaussian" else 1.5)
    return BasisRKPM(centres=centres, radii=np.maximum(neighbour, floor), kernel=kernel)
