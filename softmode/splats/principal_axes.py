"""Principal axes of deformed Gaussians: from deformation gradients or covariances back to a frame and scales.

A splat with frame R and standard deviations s that is deformed by F has covariance F R diag(s^2) R^T F^T. The singular
value decomposition F R diag(s) = U diag(s') V^T yields the new frame U and scales s' without squaring them, so that
thin discs keep their thickness. Singular vectors come sorted and with arbitrary signs; here they are ordered to follow
the rotated rest frame, so that the quaternions of an animation do not jump from frame to frame.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_ORDERS = np.array(list(permutations(range(3))))


def nearest_rotations(gradients: ArrayLike) -> NDArray[np.float64]:
    """Return the proper rotations nearest to deformation gradients (polar decomposition), both of shape (N, 3, 3).

    Of an inverted gradient (det F < 0) it is the proper rotation that maximises tr(R^T F).
    """
    left, _, right = np.linalg.svd(np.asarray(gradients, dtype=np.float64))
    left[:, :, 2] *= np.where(np.linalg.det(left @ right) < 0.0, -1.0, 1.0)[:, None]
    return left @ right


def axes_of_gradients(
    gradients: ArrayLike, frames: ArrayLike, scales: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frames and scales of splats after the deformation gradients F.

    Args:
        gradients: Deformation gradients F, shape (N, 3, 3).
        frames: Rest frames R, proper rotations, shape (N, 3, 3).
        scales: Rest standard deviations along the columns of the frames [m], shape (N, 3).

    Returns:
        Right-handed frames, shape (N, 3, 3), and standard deviations [m], shape (N, 3), in the order of the rest axes.
    """
    f, r, s = (np.asarray(value, dtype=np.float64) for value in (gradients, frames, scales))
    left, singular, _ = np.linalg.svd(f @ r * s[:, None, :])
    return _follow(left, singular, nearest_rotations(f) @ r)


def axes_of_covariances(covariances: ArrayLike, frames: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frames and scales of Gaussians with these covariances.

    Args:
        covariances: Symmetric positive semidefinite matrices [m^2], shape (N, 3, 3).
        frames: Frames that the axes shall follow as closely as their order and signs allow, shape (N, 3, 3).

    Returns:
        Right-handed frames, shape (N, 3, 3), and standard deviations [m], shape (N, 3).
    """
    variance, axes = np.linalg.eigh(np.asarray(covariances, dtype=np.float64))
    return _follow(axes, np.sqrt(np.maximum(variance, 0.0)), np.asarray(frames, dtype=np.float64))


def _follow(
    axes: NDArray[np.float64], scales: NDArray[np.float64], frames: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reorder and flip the axes to follow the frames; the least certain sign yields to right-handedness."""
    agreement = np.einsum("nij,nik->njk", frames, axes)
    # Of the six orders take the one whose axes agree best in sum: order[j] is the new axis that follows rest axis j.
    order = _ORDERS[np.abs(agreement[:, np.arange(3), _ORDERS]).sum(axis=2).argmax(axis=1)]
    axes = np.take_along_axis(axes, order[:, None, :], axis=2)
    agreement = np.take_along_axis(agreement, order[:, :, None], axis=2)[:, :, 0]
    axes = axes * np.where(agreement < 0.0, -1.0, 1.0)[:, None, :]
    rows, weakest = np.arange(len(axes)), np.abs(agreement).argmin(axis=1)
    axes[rows, :, weakest] *= np.where(np.linalg.det(axes) < 0.0, -1.0, 1.0)[:, None]
    return axes, np.take_along_axis(scales, order, axis=1)
