"""Skinning weights and the raw functions they carry: weights times monomials, before orthonormalisation.

Weight 0 is the constant handle. The others are combinations of reproducing kernels; on a body with exact regions they
are multiplied by an envelope that vanishes there, and the weights of regions add a blend that is one on their region.
A weight carries the monomials up to its degree: 0 (translation), 1 (affine), 2 (quadratic handles).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.regions import Envelope
from softmode.deformables.body.rkpm import ShapeFunctions

Array = NDArray[np.float64]

MONOMIALS = ((3,), (0, 1, 2, 3), (0, 1, 2, 3, 4, 5, 6, 7, 8, 9))
"""Of each degree, the monomials among (x, y, z, 1, xx, yy, zz, xy, yz, zx)."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


def enveloped(shape: ShapeFunctions, envelope: Envelope | None) -> tuple[ShapeFunctions, Array, Array]:
    """Multiply kernels by the envelope.

    Returns:
        The kernels, the blends (N, R) and their gradients [1/m] (N, R, 3); R = 0 without an envelope.
    """
    if envelope is None:
        return shape, np.zeros((len(shape.points), 0)), np.zeros((len(shape.points), 0, 3))
    factor, slope, blend, blend_slope = envelope.evaluate(shape.points)
    return shape.scaled(factor, slope), blend, blend_slope


@dataclass(frozen=True, kw_only=True)
class SkinningWeights:
    """Coefficients of the weights, and what each carries."""

    coefficients: Array
    """Coefficients in the (enveloped) kernels, shape (K, J); column 0 belongs to the constant handle."""
    degrees: NDArray[np.int64]
    """Degree of the monomials each weight carries, shape (J,)."""
    blends: NDArray[np.int64]
    """Exact region whose blend is added to a weight, or -1, shape (J,)."""

    @property
    def owner(self) -> NDArray[np.int64]:
        """Weight of every raw function, shape (R,)."""
        return np.repeat(np.arange(len(self.degrees)), [len(MONOMIALS[d]) for d in self.degrees])

    @property
    def monomial(self) -> NDArray[np.int64]:
        """Monomial of every raw function, shape (R,)."""
        return np.concatenate([np.array(MONOMIALS[d]) for d in self.degrees])

    @property
    def leading(self) -> NDArray[np.intp]:
        """Raw functions of affine motion, of the body and of its exact regions, (x, y, z, 1) of the body first."""
        return np.flatnonzero(((self.owner == 0) | (self.blends[self.owner] >= 0)) & (self.monomial < 4))

    @property
    def translating(self) -> NDArray[np.bool_]:
        """Raw functions of weights that carry a translation only, the static responses; shape (R,)."""
        return self.degrees[self.owner] == 0

    def evaluate(self, shape: ShapeFunctions, blend: Array, blend_gradient: Array) -> tuple[Array, Array]:
        """Return the weights (N, J) and, where kernels have gradients, theirs [1/m] (N, J, 3)."""
        value = shape.value @ self.coefficients
        axes = len(shape.gradient)
        gradient = np.empty((axes, *value.shape)).transpose(1, 2, 0)  # Axis by axis, as `products` reads it.
        for d, along in enumerate(shape.gradient):
            gradient[:, :, d] = along @ self.coefficients
        value[:, 0], gradient[:, 0] = 1.0, 0.0  # Exact, so that affine motion is; the kernels give it to rounding only.
        for weight in np.flatnonzero(self.blends >= 0):
            value[:, weight] += blend[:, self.blends[weight]]
            gradient[:, weight] += blend_gradient[:, self.blends[weight], :axes]
        return value, gradient

    def products(self, value: Array, gradient: Array, points: Array, length: float) -> tuple[Array, Array]:
        """Return the raw functions W_j Z_c, (N, R), and gradients [1/m] (N, R, 3); Z in coordinates over `length`."""
        count = len(points)
        z, slope = np.ones((count, 10)), np.zeros((count, 10, 3))
        z[:, :3] = points / length
        slope[:, range(3), range(3)] = 1.0 / length
        for k, (a, b) in enumerate(_PAIRS):
            z[:, 4 + k] = z[:, a] * z[:, b]
            slope[:, 4 + k, a] += z[:, b] / length
            slope[:, 4 + k, b] += z[:, a] / length
        owner, monomial = self.owner, self.monomial
        weight, factor = value[:, owner], z[:, monomial]
        found = np.empty((gradient.shape[2], count, len(owner)))  # Axis by axis: the largest arrays of a build.
        for d in range(len(found)):
            np.multiply(gradient[:, owner, d], factor, out=found[d])
            sloping = np.flatnonzero(np.any(slope[:, :, d], axis=0)[monomial])
            found[d][:, sloping] += weight[:, sloping] * slope[:, monomial[sloping], d]
        return weight * factor, found.transpose(1, 2, 0)


def constant_handle(kernel_count: int) -> SkinningWeights:
    """Return the constant handle alone, with all ten monomials, over so many kernels."""
    return SkinningWeights(
        coefficients=np.ones((kernel_count, 1)),
        degrees=np.full(1, 2, dtype=np.int64),
        blends=np.full(1, -1, dtype=np.int64),
    )
