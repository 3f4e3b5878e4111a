"""Handles: the state of a body as one matrix per skinning weight, in Kaolin's order, and back to coordinates.

x(X) = X + sum_j W_j(X) T_j [X; 1]: a handle adds to the rest position, so that at rest every matrix is zero. Matrices
are 4 x 4 for row vectors as everywhere in OpenUSD, [X, 1] M_j = (T_j [X; 1], 0): linear part transposed in the upper
left, the translation in the last row, zeros in the last column. The constant handle, W = 1, comes last, as Kaolin has
it; softmode's own order has it first. A quadratic handle adds six rows more, the factors of xx, yy, zz, xy, yz and zx.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.skinning_weights import MONOMIALS

Array = NDArray[np.float64]


def handle_order(body: ReducedBody) -> NDArray[np.intp]:
    """Return softmode's index of each handle of a file: all but the constant one, then that."""
    return np.roll(np.arange(len(body.handles.degrees)), -1)


def handle_weights(body: ReducedBody, points: ArrayLike) -> tuple[Array, Array]:
    """Return the skinning weights, shape (N, J), and gradients [1/m], (N, J, 3), in the order of a file.

    Args:
        body: The body.
        points: Rest positions in the body frame [m], shape (N, 3).
    """
    weight, gradient = body.skinning_weights(points)
    order = handle_order(body)
    return weight[:, order], gradient[:, order]


def handles_from_coordinates(body: ReducedBody, q: ArrayLike) -> tuple[Array, Array]:
    """Return the matrices of the handles, shape (J, 4, 4), and the rows of quadratic ones [1/m], shape (K, 6, 3).

    Args:
        body: The body.
        q: Its reduced coordinates [m], shape (n, 3).
    """
    raw = body.transform @ np.asarray(q, dtype=np.float64)
    starts = _starts(body)
    matrices, quadratic = np.zeros((len(body.handles.degrees), 4, 4)), []
    for k, j in enumerate(handle_order(body)):
        rows = raw[starts[j] : starts[j + 1]]
        degree = body.handles.degrees[j]
        if degree == 0:
            matrices[k, 3, :3] = rows[0]
            continue
        matrices[k, :3, :3], matrices[k, 3, :3] = rows[:3] / body.length, rows[3]
        if degree == 2:
            quadratic.append(rows[4:] / body.length**2)
    return matrices, np.array(quadratic).reshape(-1, 6, 3)


def coordinates_from_handles(body: ReducedBody, matrices: ArrayLike, quadratic: ArrayLike) -> Array:
    """Return the reduced coordinates, shape (..., n, 3), that `handles_from_coordinates` was given, to rounding.

    The functions of a body are combinations of what its handles carry, b = (W Z) transform, with a transform of full
    column rank: the coordinates are the least-squares solution of transform q = raw.

    Args:
        body: The body.
        matrices: Of one state, shape (J, 4, 4), or of several, (F, J, 4, 4).
        quadratic: Rows of the quadratic handles [1/m], shape (K, 6, 3) or (F, K, 6, 3).
    """
    m, rows = np.asarray(matrices, dtype=np.float64), np.asarray(quadratic, dtype=np.float64)
    starts = _starts(body)
    raw = np.zeros((*m.shape[:-3], len(body.transform), 3))
    seen = 0
    for k, j in enumerate(handle_order(body)):
        first, degree = starts[j], body.handles.degrees[j]
        if degree == 0:
            raw[..., first, :] = m[..., k, 3, :3]
            continue
        raw[..., first : first + 3, :] = m[..., k, :3, :3] * body.length
        raw[..., first + 3, :] = m[..., k, 3, :3]
        if degree == 2:
            raw[..., first + 4 : first + 10, :] = rows[..., seen, :, :] * body.length**2
            seen += 1
    return np.linalg.pinv(body.transform) @ raw


def _starts(body: ReducedBody) -> NDArray[np.int64]:
    """Return the first raw function of every handle, and their number."""
    return np.concatenate([[0], np.cumsum([len(MONOMIALS[d]) for d in body.handles.degrees])])


def rigid_motion(body: ReducedBody, q: ArrayLike) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) [m] that carry the body frame along with a state.

    The translation is the motion of the centre of mass, the rotation that of the affine motion in the coordinates: the
    proper one nearest to its matrix.

    Args:
        body: The body.
        q: Its reduced coordinates [m], shape (n, 3).
    """
    q = np.asarray(q, dtype=np.float64)
    affine = np.linalg.lstsq(body.linear_coordinates, q, rcond=None)[0]
    u, _, v = np.linalg.svd(np.eye(3) + affine[:3].T)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ v)])
    return u @ flip @ v, body.mean_basis @ q


def local_coordinates(body: ReducedBody, q: ArrayLike, rotation: Array, translation: Array, scale: float) -> Array:
    """Return the coordinates (n, 3) of a state as seen from a frame: x = scale rotation x' + translation."""
    matrix = rotation.T / scale
    return body.affine(matrix, -matrix @ translation) + np.asarray(q, dtype=np.float64) @ matrix.T


def world_coordinates(body: ReducedBody, q: ArrayLike, rotation: Array, translation: Array, scale: float) -> Array:
    """Return the coordinates (n, 3) in the world of a state seen from a frame: x = scale rotation x' + translation."""
    matrix = scale * rotation
    return body.affine(matrix, translation) + np.asarray(q, dtype=np.float64) @ matrix.T
