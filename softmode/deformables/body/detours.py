"""How much farther than the straight line the way through the material is, from a kernel's centre to a place.

Two fingers that come closer than a kernel is wide would move as one if the kernel acted on both, and the sides of an
inner corner are held together by one that reaches across it. So a kernel sees distances along the material: the
diffraction method of meshfree methods (Organ et al. 1996, doi:10.1007/BF00369940), with paths in place of one bend. A
table holds by how much a kernel's distance to points of the material is longer than the straight line. Between the
points it is a smooth mean of those around: functions stay as smooth as they were, and the moment correction over what
the kernels have become reproduces linear functions as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import KDTree

Array = NDArray[np.float64]

WIDTH = 1.5
"""Points of the material count at a place nearer than this many steps: not those beyond a gap of one step."""


@dataclass(frozen=True, kw_only=True)
class Detours:
    """What is added to the distances of some kernels from places beyond a corner or a gap."""

    points: Array
    """Points of the material [m], shape (N, 3)."""
    steps: Array
    """Distance between neighbours along each axis [m], shape (3,)."""
    pairs: NDArray[np.int64]
    """Kernel * N + point of every pair whose way is longer than the straight line, ascending, shape (H,)."""
    lengths: NDArray[np.float32]
    """By how much [m], > 0, shape (H,)."""

    def added(self, places: Array, kernel_count: int) -> tuple[sparse.csr_matrix, list[sparse.csr_matrix]]:
        """Return what is added to distances [m], (M, K), and its gradient, three matrices (M, K).

        Args:
            places: Positions [m], shape (M, 3).
            kernel_count: Number of kernels K.
        """
        scaled = places / self.steps
        near = self._tree.query_ball_point(scaled, WIDTH, return_sorted=True)
        count = np.array([len(found) for found in near], dtype=np.intp)
        row = np.repeat(np.arange(len(places)), count)
        point = np.concatenate([np.zeros(0, dtype=np.intp), *(np.asarray(found, dtype=np.intp) for found in near)])
        offset = (scaled[row] - self._tree.data[point]) / WIDTH
        rest = np.maximum(1.0 - (offset * offset).sum(axis=1), 0.0)
        bump, slope = rest**3, offset * (-6.0 * rest**2 / WIDTH)[:, None] / self.steps
        total = np.maximum(np.bincount(row, bump, len(places)), 1e-300)
        share = bump / total[row]
        for d in range(3):
            slope[:, d] = slope[:, d] / total[row] - share * (np.bincount(row, slope[:, d], len(places)) / total)[row]
        # A place that no point is near goes with the nearest.
        bare = np.flatnonzero(np.bincount(row, bump, len(places)) < 1e-12)
        if len(bare):
            kept = ~np.isin(row, bare)
            row = np.concatenate([row[kept], bare])
            point = np.concatenate([point[kept], np.asarray(self._tree.query(scaled[bare])[1])])
            share = np.concatenate([share[kept], np.ones(len(bare))])
            slope = np.concatenate([slope[kept], np.zeros((len(bare), 3))])
        table = self._table(kernel_count)
        away = places[row] - self.points[point]

        def mean(data: Array) -> sparse.csr_matrix:
            return sparse.csr_matrix((data, (row, point)), shape=(len(places), len(self.points)))

        acting = sparse.csr_matrix(
            (np.ones(table.nnz), table.indices, table.indptr), shape=table.shape
        )  # Lit: no change.
        gradients: list[Any] = []
        for change in self._changes:
            product: Any = change @ table
            gradients.append(product.multiply(acting).tocsr())
        value = mean(share) @ table
        for e in range(3):
            value = value + mean(share * away[:, e]) @ gradients[e]
        slopes = []
        for d in range(3):
            found = mean(slope[:, d]) @ table + mean(share) @ gradients[d]
            for e in range(3):
                found = found + mean(slope[:, d] * away[:, e]) @ gradients[e]
            slopes.append(found)
        return value, slopes

    @cached_property
    def _changes(self) -> list[sparse.csr_matrix]:
        """Return what makes the gradient at a point of values at all, by least squares of those around, (N, N)."""
        pair = self._tree.query_pairs(WIDTH, output_type="ndarray")
        row, column = np.concatenate([pair, pair[:, ::-1]]).T
        offset = self.points[column] - self.points[row]
        weight = np.maximum(1.0 - ((offset / self.steps / WIDTH) ** 2).sum(axis=1), 0.0) ** 2
        count = len(self.points)
        moment = np.zeros((count, 3, 3))
        for d in range(3):
            for e in range(3):
                moment[:, d, e] = np.bincount(row, weight * offset[:, d] * offset[:, e], minlength=count)
        moment[:, range(3), range(3)] += 1e-6 * self.steps**2
        factor = np.einsum("nde,ne->nd", np.linalg.inv(moment)[row], offset * weight[:, None])
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
        return KDTree(self.points / self.steps)

    def _table(self, kernel_count: int) -> sparse.csr_matrix:
        """Return the lengths as a matrix, (N, K)."""
        kernel, point = np.divmod(self.pairs, len(self.points))
        entries: Any = self.lengths.astype(np.float64), (point, kernel)
        return sparse.csr_matrix(entries, shape=(len(self.points), kernel_count))
