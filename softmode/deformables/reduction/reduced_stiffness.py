"""Stiffness of a reduced body at rest, and its elastic modes.

The elastic modes of lowest frequency carry most of a body's motion and least of its energy: the bending of a plate of
thickness t and length L strains it by t / L of what it turns. Forces measured by gradients say nothing about them, so
the cubature is trained on them, and judged by their eigenvalues.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.reduction.static_response import lame_parameters

Array = NDArray[np.float64]

NULL_TOLERANCE = 1e-12
"""Eigenvalues under this fraction of the largest are rigid motions. A held rod of 50:1 has 3e-9; rounding is 1e-15."""


def reduced_stiffness(gradient: Array, weights: Array, poissons_ratio: float, lame_ratio: Array | None = None) -> Array:
    """Return K_(ia)(jb) = sum_p w_p (lame d_i b_a d_j b_b + mu d_j b_a d_i b_b + mu delta_ij grad b_a . grad b_b).

    Args:
        gradient: Gradients of n functions [1/m], shape (n, 3, P).
        weights: Volumes times relative shear modulus [m^3], shape (P,).
        poissons_ratio: Poisson's ratio.
        lame_ratio: lambda / mu of the points over that of this ratio, shape (P,); None or empty: one.

    Returns:
        Linear elastic stiffness for E = 1 [m], shape (3 n, 3 n); all x components first, then y, then z.
    """
    count = len(gradient)
    flat = gradient.transpose(1, 0, 2).reshape(3 * count, -1)

    def products(weight: Array) -> Array:
        return ((flat * weight) @ flat.T).reshape(3, count, 3, count)

    volume = None if lame_ratio is None or not len(lame_ratio) else products(weights * lame_ratio)
    return elastic_stiffness(products(weights), poissons_ratio, volume)


def elastic_stiffness(products: Array, poissons_ratio: float, volume: Array | None = None) -> Array:
    """Return the stiffness for E = 1, (3 n, 3 n), from sum_p w_p d_i b_k d_j b_l, (3, n, 3, n); x components first.

    Where lambda / mu varies, ``volume`` has these sums with the w_p of lambda.
    """
    mu, lame = lame_parameters(poissons_ratio)
    found = lame * (products if volume is None else volume) + mu * products.transpose(2, 1, 0, 3)
    trace = mu * np.einsum("kakb->ab", products)
    for i in range(3):
        found[i, :, i] += trace
    return found.reshape(3 * products.shape[1], -1)


def elastic_modes(stiffness: Array) -> tuple[Array, Array]:
    """Return the eigenvalues > 0 of a reduced stiffness, ascending, and modes of unit energy phi^T K phi = 1.

    Args:
        stiffness: K, shape (N, N), of functions that are orthonormal in mass.

    Returns:
        Eigenvalues (M,), modes (N, M).
    """
    value, vector = np.linalg.eigh(stiffness)
    elastic = value > NULL_TOLERANCE * value.max(initial=0.0)
    return value[elastic], vector[:, elastic] / np.sqrt(value[elastic])
