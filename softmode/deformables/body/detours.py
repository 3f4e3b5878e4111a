"""How much farther than the straight line the way through the material is, from a kernel's centre to a place.

Two fingers that come closer than a kernel is wide would move as one if the kernel acted on both, and the sides of an
inner corner are held together by one that reaches across it. So a kernel sees distances along the material: the
diffraction method of meshfree methods (Organ et al. 1996, doi:10.1007/BF00369940), with paths in place of one bend. A
table holds by how much a kernel's distance to points of the material is longer than the straight line. Between the
points it is a smooth mean of those around: functions stay as smooth as they were, and the moment correction over what
the kernels have become reproduces linear functions as before.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import KDTree

Array = NDArray[np.float64]

SOFT = 0.05
"""Detours shorter than this fraction of an octant fade out smoothly."""
WIDTH = 1.5
"""Points of the material count at a place nearer than this many steps: not those beyond a gap of one step."""


@dataclass(frozen=True, kw_only=True)
class Detours:
    """What is added to the distances of some kernels from places beyond a corner or a gap."""

    points: Array
    """Points of the material [m], shape (N, 3)."""
    frame: Array
    """Takes positions to coordinates in which neighbours are one apart, shape (3, 3) [1/m]."""
    pairs: NDArray[np.int64]
    """Kernel * N + point of every pair whose way is longer than the straight line, ascending, shape (H,)."""
    lengths: NDArray[np.float32]
    """By how much [m], > 0, shape (H,)."""

    def added(self, places: Array, kernel_count: int, *, slopes: bool = False) -> list[sparse.csr_matrix]:
        """Return what is added to distances [m], (M, K), and, if asked for, its gradient: three more matrices (M, K).

        Args:
            places: Positions [m], shape (M, 3).
            kernel_count: Number of kernels K.
            slopes: Whether to return the gradient.
        """
        count, size = len(places), len(self.points)
        row, point, share, slope = self._shares(places)
        away = places[row] - self.points[point]
        # Of a linear function at each point: the value times the share, the gradient times the share and the way there.
        factors = [[share, *(share * away.T)]]
        if slopes:
            for d in range(3):
                factors.append([slope[:, d], *(slope[:, d, None] * away).T])
                factors[-1][1 + d] = factors[-1][1 + d] + share
        entries = np.stack(factors)  # (1 or 4, 4, pairs)

        def like(matrix: Any, data: Array) -> Any:
            return sparse.csr_matrix((data, matrix.indices, matrix.indptr), shape=matrix.shape)

        at = np.arange(len(entries))[:, None, None] * count + row, np.arange(4)[:, None] * size + point
        at = tuple(np.broadcast_to(index, entries.shape).ravel() for index in at)
        means: Any = sparse.csr_matrix((entries.ravel(), at), shape=(len(entries) * count, 4 * size))
        table = self._linear
        found = means @ sparse.csr_matrix((table.data, table.indices, table.indptr), shape=(4 * size, kernel_count))
        value, *along = [found[i * count : (i + 1) * count] for i in range(len(entries))]
        # Linear functions go below zero where the shadow begins: from there on nothing is added, without a kink.
        rest = np.maximum(value.data, 0.0)
        soft = SOFT / float(np.linalg.norm(self.frame, axis=1).max())
        factor = like(value, rest * (rest + 2.0 * soft) / (rest + soft) ** 2)
        return [like(value, rest**2 / (rest + soft)), *(slope.multiply(factor).tocsr() for slope in along)]

    def _shares(self, places: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Return which points count at places: rows and points of the pairs, shares (pairs,), gradients (pairs, 3)."""
        scaled = places @ self.frame.T
        near = self._tree.query_ball_point(scaled, WIDTH, return_sorted=True)
        count = np.array([len(found) for found in near], dtype=np.intp)
        row = np.repeat(np.arange(len(places)), count)
        point = np.fromiter(itertools.chain.from_iterable(near), dtype=np.intp, count=count.sum())
        offset = (scaled[row] - self._tree.data[point]) / WIDTH
        rest = np.maximum(1.0 - (offset * offset).sum(axis=1), 0.0)
        bump, slope = rest**3, (offset * (-6.0 * rest**2 / WIDTH)[:, None]) @ self.frame
        size = np.bincount(row, bump, len(places))
        total = np.maximum(size, 1e-300)
        share = bump / total[row]
        for d in range(3):
            slope[:, d] = slope[:, d] / total[row] - share * (np.bincount(row, slope[:, d], len(places)) / total)[row]
        # A place that no point is near goes with the nearest.
        bare = np.flatnonzero(size < 1e-12)
        if len(bare):
            kept = ~np.isin(row, bare)
            row = np.concatenate([row[kept], bare])
            point = np.concatenate([point[kept], np.asarray(self._tree.query(scaled[bare])[1])])
            share = np.concatenate([share[kept], np.ones(len(bare))])
            slope = np.concatenate([slope[kept], np.zeros((len(bare), 3))])
        return row, point, share, slope

    @cached_property
    def _linear(self) -> sparse.csr_matrix:
        """Return values at the points and, below them, gradients along the axes, (4 N, kernels up to the last one)."""
        kernel, point = np.divmod(self.pairs, len(self.points))
        entries: Any = self.lengths.astype(np.float64), (point, kernel)
        table = sparse.csr_matrix(entries, shape=(len(self.points), int(kernel[-1]) + 1))
        acting = sparse.csr_matrix((np.ones(table.nnz), table.indices, table.indptr), shape=table.shape)
        changes: list[Any] = [change @ table for change in self._changes]
        found: Any = sparse.vstack([table, *(change.multiply(acting) for change in changes)], format="csr")
        return found  # Lit: no change.

    @cached_property
    def _changes(self) -> list[sparse.csr_matrix]:
        """Return what makes the gradient at a point of values at all, by least squares of those around, (N, N)."""
        pair = self._tree.query_pairs(WIDTH, output_type="ndarray")
        row, column = np.concatenate([pair, pair[:, ::-1]]).T
        offset = self._tree.data[column] - self._tree.data[row]
        weight = np.maximum(1.0 - ((offset / WIDTH) ** 2).sum(axis=1), 0.0) ** 2
        count = len(self.points)
        moment = np.zeros((count, 3, 3))
        for d in range(3):
            for e in range(3):
                moment[:, d, e] = np.bincount(row, weight * offset[:, d] * offset[:, e], minlength=count)
        moment[:, range(3), range(3)] += 1e-6
        factor = np.einsum("nde,ne->nd", np.linalg.inv(moment)[row], offset * weight[:, None]) @ self.frame
        found = []
        for d in range(3):
            own = -np.bincount(row, factor[:, d], minlength=count)
            entries = (
                np.concatenate([factor[:, d], own]),
                (np.append(row, np.arange(count)), np.append(column, np.arange(count))),
            )
            found.append(sparse.csr_matrix(entries, shape=(count, count)))
        return found

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points @ self.frame.T)
