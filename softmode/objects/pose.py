"""How an object comes to rest: the nearest pose in which it stands stably."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

STABLE_TILT = 0.1
"""A pose is stable if tilting the object by this angle [rad] in any direction raises its centre of mass."""
STABLE_RISE = 0.003
"""By this fraction of its height at least: the facets between samples of a round rim, on which it rolls, are lower."""


def seat_of(bounds: NDArray) -> NDArray:
    """Return where an object stands: the middle of the lower face of its bounding box (2, 3)."""
    low, high = bounds
    return np.array([*(0.5 * (low + high))[:2], low[2]])


def stable_rotation(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the least rotation after which an object stands stably, None if it does so already or never does.

    The height of the centre of mass above a plane with outward normal n below the object is h(n) = max_i n . X_i. The
    object rests on a face of its convex hull, and does so stably if h grows when n is tilted.

    Args:
        points: Surface samples relative to the centre of mass [m], shape (S, 3).
    """
    try:
        equations = ConvexHull(points).equations
    except QhullError:
        return None
    down = np.array([[0.0, 0.0, -1.0]])
    candidates = np.concatenate([down, equations[:, :3]])
    height = (candidates @ points.T).max(axis=1)
    side = np.cross(candidates, np.where(np.abs(candidates[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(candidates, side)
    stable = np.ones(len(candidates), bool)
    # Half of it keeps an object where it is, so that what was laid down stays.
    rise = np.where(np.arange(len(candidates)) == 0, 0.5, 1.0) * STABLE_RISE
    for azimuth in np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False):
        tilted = np.cos(STABLE_TILT) * candidates + np.sin(STABLE_TILT) * (
            np.cos(azimuth) * side + np.sin(azimuth) * other
        )
        stable &= (tilted @ points.T).max(axis=1) > (1.0 + rise) * height
    if stable[0] or not stable.any():
        return None
    standing, height = candidates[stable], height[stable]
    least = standing @ standing[(standing @ down[0]).argmax()]
    # of the facets that samples make of one face, the lowest lies flat
    normal = standing[np.where(least > np.cos(2.0 * STABLE_TILT), height, np.inf).argmin()]
    axis, cosine = np.cross(normal, down[0]), float(normal @ down[0])
    if np.linalg.norm(axis) < 1e-9:  # upside down: any horizontal axis will do
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
