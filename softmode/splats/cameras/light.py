"""The sun of a picture: the frame of its light, and linear light to sRGB and back."""

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.splats.raster.scan_kernels import ENCODED


def light_frame(direction: Sequence[float]) -> NDArray[np.float64]:
    """Return two axes across a light and its direction as rows, shape (3, 3)."""
    ahead = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    first = np.cross(ahead, [1.0, 0.0, 0.0] if abs(ahead[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(ahead, first), ahead])


def linear_light(color: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return linear light of sRGB in 0..1, by IEC 61966-2-1."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def encoded_light(device: wp.Device) -> wp.array:
    """Return the sRGB of linear light 0..1 in equal steps, shape (ENCODED + 1,)."""
    light = np.linspace(0.0, 1.0, ENCODED + 1)
    table = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return wp.array(table.astype(np.float32), dtype=wp.float32, device=device)
