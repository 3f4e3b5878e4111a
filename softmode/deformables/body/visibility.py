"""Which part of the material a kernel acts on: what is connected to its centre within its support.

Two fingers that come closer than a kernel is wide would move as one if the kernel acted on both. So a kernel acts only
on the points of the material from which a path leads to its centre through material within its support: the visibility
criterion of meshfree methods (Organ et al. 1996, doi:10.1007/BF00369940), with paths in place of straight lines. Parts
of the material that no such path joins do not touch within the support, and the kernel vanishes on its border: the
functions stay as smooth as they were, and the moment correction over the kernels that remain reproduces linear
functions as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """Points of the material and the kernels that do not act on them; any other place goes with its nearest point."""

    points: Array
    """Points of the material [m], shape (N, 3)."""
    hidden: NDArray[np.int64]
    """Kernel * N + point of every pair that is hidden from each other, ascending, shape (H,)."""

    def hides(self, places: Array, row: NDArray[np.intp], kernel: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which kernels do not act at places.

        Args:
            places: Positions [m], shape (M, 3).
            row: Place of each pair asked for, shape (Q,).
            kernel: Kernel of each pair, shape (Q,).
        """
        index, table = self._table
        found = np.zeros(len(row), dtype=bool)
        # Most kernels act on all they reach: they need no look at the points.
        partial = np.flatnonzero(index[np.minimum(kernel, len(index) - 1)] >= 0)
        rows, back = np.unique(row[partial], return_inverse=True)
        nearest = np.asarray(self._tree.query(places[rows])[1])
        found[partial] = table[index[kernel[partial]], nearest[back]]
        return found

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    @cached_property
    def _table(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Row of each kernel in the table, or -1, and which points are hidden from it."""
        kernel, point = np.divmod(self.hidden, len(self.points))
        partial, row = np.unique(kernel, return_inverse=True)
        index = np.full(partial[-1] + 2, -1)  # The last one stands for all kernels beyond.
        index[partial] = np.arange(len(partial))
        table = np.zeros((len(partial), len(self.points)), dtype=bool)
        table[row, point] = True
        return index, table
