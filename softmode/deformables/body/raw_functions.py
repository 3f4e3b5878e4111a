"""Raw functions: what a body's functions are combinations of, b = raw @ transform."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.body.regions import Envelope
from softmode.deformables.body.rkpm import REACH, BasisRKPM
from softmode.deformables.body.skinning_weights import SkinningWeights, constant_handle, enveloped

Array = NDArray[np.float64]


class RawFunctions(Protocol):
    """Scalar functions of rest points of the body frame, (x, y, z, 1) over a length first."""

    def reach(self, points: Array) -> tuple[Array, Array]:
        """Return how far points lie from the nearest centre that acts there, over its reach (N,), and it (N, 3) [m]."""
        ...

    def covered(self, points: Array) -> NDArray[np.bool_]:
        """Return at which of points (N, 3) within reach the functions can be evaluated, shape (N,)."""
        ...

    def evaluate(self, points: Array, at: Array | None = None, *, gradients: bool = True) -> tuple[Array, Array]:
        """Return values (N, R) and gradients [1/m] (N, R, 3) within reach; all but the kernels `at` other points.

        Gradients that are not wanted may be (N, R, 0).
        """
        ...


@dataclass(frozen=True, kw_only=True)
class SkinningFunctions:
    """Products of skinning weights and monomials."""

    kernels: BasisRKPM
    """Reproducing kernels."""
    skin: SkinningWeights
    """Weights in them."""
    envelope: Envelope | None
    """What makes kernels vanish on exact regions."""
    length: float
    """Unit of length of the monomials [m]."""

    def reach(self, points: Array) -> tuple[Array, Array]:
        """Return how far points lie from the nearest centre that acts there, over its reach (N,), and it (N, 3) [m]."""
        distance, nearest = self.kernels.nearest(points)
        return distance / (REACH * self.kernels.support[nearest]), self.kernels.centres[nearest]

    def covered(self, points: Array) -> NDArray[np.bool_]:
        """Return at which of points (N, 3) within reach there are enough kernels: not in the gap between two leaves."""
        return self.kernels.covered(points)

    def weights(self, points: Array, at: Array | None = None, *, gradients: bool = True) -> tuple[Array, Array]:
        """Return the skinning weights (N, J) and their gradients [1/m] (N, J, 3) at points within reach.

        The envelope and the blends are those `at` other points (N, 3) if these are given.
        """
        shape = self.kernels.evaluate(points, gradients=gradients)
        return self.skin.evaluate(*enveloped(shape if at is None else replace(shape, points=at), self.envelope))

    def evaluate(self, points: Array, at: Array | None = None, *, gradients: bool = True) -> tuple[Array, Array]:
        """Return values (N, R) and gradients [1/m] (N, R, 3) within reach; all but the kernels `at` other points."""
        found = self.weights(points, at, gradients=gradients)
        return self.skin.products(*found, points if at is None else at, self.length)


@dataclass(frozen=True, kw_only=True)
class QuadraticFunctions:
    """The ten monomials up to degree two, and the functions of Q-GMLS, of which those are combinations."""

    kernels: BasisQGMLS
    """Kernels."""
    length: float
    """Unit of length of the monomials [m]."""

    def reach(self, points: Array) -> tuple[Array, Array]:
        """Return how far points lie from the centre that covers each best, over its reach (N,), and it (N, 3) [m]."""
        return self.kernels.reach(points)

    def covered(self, points: Array) -> NDArray[np.bool_]:
        """Return that there are enough kernels at all points (N, 3) within reach: one will do."""
        return np.ones(len(points), dtype=bool)

    def evaluate(self, points: Array, at: Array | None = None, *, gradients: bool = True) -> tuple[Array, Array]:
        """Return values (N, 10 + 10 n) and gradients [1/m] (N, 10 + 10 n, 3) at points within reach."""
        one, flat = np.ones((len(points), 1)), np.zeros((len(points), 1, 3))
        whole = constant_handle(1).products(one, flat, points, self.length)
        own = self.kernels.evaluate(points)
        return np.concatenate([whole[0], own[0]], axis=1), np.concatenate([whole[1], own[1]], axis=1)
