"""Splats in the layout that viser sends to browsers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.view.live_types import SplatPicture

LARGEST = 30.0
"""Standard deviation of the widest splat in viser's units."""
HALF_MAX = float(np.finfo(np.float16).max)
UPPER = np.array([0, 1, 2, 4, 5, 8])


class GaussianBuffer:
    """Packs splats into eight 32-bit words each.

    Centre (three float32), a word that is free, covariance (six float16, upper triangle), colour and opacity (bytes).

    Half precision knows nothing below 6e-8, and the covariance of a splat of a millimetre is 1e-6 m^2. Lengths are
    hence given in a `unit` in which the widest splat at the start has a standard deviation of 30: it may grow by 8,
    and one that is thinner by 3,800 keeps its full precision. The node that shows them is scaled by `unit`.

    Args:
        picture: The splats at the start; their colours and opacities are kept.
    """

    def __init__(self, picture: SplatPicture) -> None:
        """Choose the unit and pack what does not change."""
        covariances = picture.covariances
        widest = float(covariances.trace(axis1=1, axis2=2).max(initial=0.0)) if len(covariances) else 0.0
        self.unit = float(np.sqrt(widest)) / LARGEST if widest > 0.0 else 1.0
        self.words = np.zeros((len(picture.means), 8), np.uint32)
        rgba = np.concatenate([picture.colors, picture.opacities.reshape(-1, 1)], axis=1).clip(0.0, 1.0)
        self.words[:, 7:].view(np.uint8)[:] = np.rint(255.0 * rgba)

    def pack(self, means: NDArray[np.float32], covariances: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Write centres [m], shape (N, 3), and covariances [m^2], shape (N, 3, 3), and return the words, shape (N, 8).

        The array is the same at each call.
        """
        words = self.words
        words[:, :3].view(np.float32)[:] = means * np.float32(1.0 / self.unit)
        half = covariances.reshape(-1, 9)[:, UPPER] * np.float32(self.unit**-2)
        np.clip(half, -HALF_MAX, HALF_MAX, out=half)
        words[:, 4:7].view(np.float16)[:] = half
        return words
