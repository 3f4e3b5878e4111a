"""`Dents`: what contact dented of a body in one frame, kept for the few samples that touch something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Dents:
    """Dents of K surface samples; all others have none."""

    samples: NDArray[np.int32]
    """Their indices, shape (K,)."""
    vectors: NDArray[np.float32]
    """How far the skin lies outside of what the functions say [m], shape (K, 3)."""

    @classmethod
    def of(cls, dents: ArrayLike) -> Dents:
        """Return those of all samples of a body that are not zero.

        Args:
            dents: One for each sample [m], shape (S, 3).
        """
        every = np.asarray(dents, dtype=np.float32)
        samples = np.flatnonzero(every.any(axis=1)).astype(np.int32)
        return cls(samples=samples, vectors=every[samples])

    def mapped(self, matrix: ArrayLike) -> Dents:
        """Return them as seen from another frame, of which a matrix (3, 3) is the linear part."""
        return Dents(samples=self.samples, vectors=(self.vectors @ np.asarray(matrix).T).astype(np.float32))

    def full(self, count: int) -> NDArray[np.float32]:
        """Return the dents of all samples [m], shape (count, 3)."""
        every = np.zeros((count, 3), dtype=np.float32)
        every[self.samples] = self.vectors
        return every


NO_DENTS = Dents.of(np.zeros((0, 3)))
"""Of a body that nothing touches."""
