"""The way from surface samples to points inside the body, along which contact within a body looks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]


def inner_offsets(points: Array, normals: Array, size: float) -> Array:
    """Find for every sample the way to a point inside the body.

    Against the mean normal of the samples around that face the same way, for a tenth of the body's size or as far as
    the nearest sample still is not one of another face: half of a thin sheet. Where samples are farther from each other
    than a wall is thick, none may be near: a point behind the plane of a sample that faces the other way is outside.

    Args:
        points: Surface samples [m], shape (N, 3).
        normals: Outward unit normals, shape (N, 3).
        size: Diagonal of the body [m].

    Returns:
        Offsets [m], shape (N, 3); zero where no point inside was found.
    """
    tree = KDTree(points)
    spacing = 1.5 * float(np.median(tree.query(points, k=min(2, len(points)))[0][:, -1]))
    offsets = np.zeros_like(points)
    todo = np.arange(len(points))
    for length in 0.1 * size * 0.5 ** np.arange(6):
        if len(todo) == 0:
            break
        around = tree.query_ball_point(points[todo], 1.5 * length)
        mean = np.array(
            [normals[k][normals[k] @ normals[i] > -0.1].sum(axis=0) for i, k in zip(todo, around, strict=True)]
        )
        inward = -mean / np.linalg.norm(mean, axis=1)[:, None]
        x = points[todo] + length * inward
        distance, nearest = tree.query(x)
        depth = ((points[nearest] - x) * normals[nearest]).sum(axis=1)
        good = (depth > 0.3 * length) & (distance > 0.5 * length)
        between = tree.query_ball_point(points[todo] + 0.5 * length * inward, np.hypot(0.5 * length, spacing))
        for j in np.flatnonzero(good):
            k = np.array(between[j])
            way = points[k] - points[todo[j]]
            along = way @ inward[j]
            opposite = (normals[k] @ normals[todo[j]] < -0.5) & (along > 0.0)
            opposite &= (way**2).sum(axis=1) - along**2 < spacing**2
            good[j] = not (opposite & (((points[k] - x[j]) * normals[k]).sum(axis=1) < 0.0)).any()
        offsets[todo[good]] = length * inward[good]
        todo = todo[~good]
    return offsets
