"""Galerkin matrices of reproducing kernels: mass, gradient energy, elastic stiffness.

Sums over quadrature points run over compact groups of points (`ShapeFunctions.blocks`) as dense products, which makes
the matrices symmetric to the last bit and costs a tenth of products over all points and kernels.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.rkpm import ShapeFunctions

Array = NDArray[np.float64]


def mass_matrix(shape: ShapeFunctions, weights: Array) -> Array:
    """Return sum_p w_p phi phi^T, shape (K, K)."""
    found = np.zeros((shape.centre_count, shape.centre_count))
    root = np.sqrt(weights)
    for rows, columns, value, _ in _dense_blocks(shape, gradients=False):
        block = value * root[rows, None]
        found[columns[:, None], columns] += block.T @ block
    return found


def mass_and_gradient_matrix(shape: ShapeFunctions, weights: Array, stiff: Array) -> tuple[Array, Array]:
    """Return sum_p w_p phi phi^T and sum_p s_p sum_d (d_d phi) (d_d phi)^T, both (K, K)."""
    count = shape.centre_count
    mass, energy = np.zeros((count, count)), np.zeros((count, count))
    root, stiff_root = np.sqrt(weights), np.sqrt(stiff)
    for rows, columns, value, gradient in _dense_blocks(shape):
        block = value * root[rows, None]
        slope = (gradient * stiff_root[rows, None]).reshape(-1, len(columns))
        mass[columns[:, None], columns] += block.T @ block
        energy[columns[:, None], columns] += slope.T @ slope
    return mass, energy


def elastic_matrix(shape: ShapeFunctions, weights: Array, mu: float, lame: float | Array) -> Array:
    """Return the stiffness of linear elasticity, sum_p w_p (2 mu e_k : e_l + lambda tr e_k tr e_l).

    Args:
        shape: Kernels at the points, (P, K).
        weights: Volumes times relative stiffness, shape (P,).
        mu: Shear modulus.
        lame: Lame's first parameter, at all points or at each, shape (P,).

    Returns:
        Matrix (3 K, 3 K); unknown (component a, kernel k) is row a K + k.
    """
    count = shape.centre_count
    found = np.zeros((3, count, 3, count))
    root = np.sqrt(weights)
    for rows, columns, _, gradient in _dense_blocks(shape):
        slope = gradient * root[rows, None]
        product = [[slope[a].T @ slope[b] for b in range(a + 1)] for a in range(3)]
        trace = product[0][0] + product[1][1] + product[2][2]
        if isinstance(lame, np.ndarray):
            volume = [[slope[a].T @ (lame[rows, None] * slope[b]) for b in range(a + 1)] for a in range(3)]
        else:
            volume = [[lame * one for one in row] for row in product]
        pick = np.ix_(columns, columns)
        for a in range(3):
            for b in range(a + 1):
                block = volume[a][b] + mu * product[a][b].T
                if a == b:
                    block = block + mu * trace
                found[a, :, b, :][pick] += block
    for a, b in ((1, 0), (2, 0), (2, 1)):
        found[b, :, a] = found[a, :, b].T
    return found.reshape(3 * count, 3 * count)


def _dense_blocks(
    shape: ShapeFunctions, *, gradients: bool = True
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]]:
    """Yield per group of points: rows, columns, values (rows, columns), gradients (3, rows, columns)."""
    start, index = shape.value.indptr, shape.value.indices
    for rows, columns in shape.blocks():
        count = start[rows + 1] - start[rows]
        row = np.repeat(np.arange(len(rows)), count)
        entry = np.arange(len(row)) + np.repeat(start[rows] - (np.cumsum(count) - count), count)
        flat = row * len(columns) + np.searchsorted(columns, index[entry])
        dense = np.zeros((4 if gradients else 1, len(rows) * len(columns)))
        dense[0, flat] = shape.value.data[entry]
        if gradients:
            for d in range(3):
                dense[1 + d, flat] = shape.gradient[d].data[entry]
        dense = dense.reshape(len(dense), len(rows), len(columns))
        yield rows, columns, dense[0], dense[1:]
