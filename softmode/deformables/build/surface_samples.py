"""Surface samples: near-uniform points on a surface, each with the area of its cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.rkpm import sample_farthest

Array = NDArray[np.float64]

CANDIDATES_PER_SAMPLE = 24
"""Uniform candidates among which a sample is chosen."""


def select_surface(candidates: Array, normals: Array, area: float, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Choose near-uniform samples among uniform candidates, and give each the area of its cell.

    Farthest points in position and (weakly) normal, so that both sides of a thin sheet are sampled, then two Lloyd
    steps.
    """
    pitch = 0.35 * np.sqrt(area / count)
    space = np.concatenate([candidates, pitch * normals], axis=1)
    chosen = sample_farthest(space, count, seed=seed)
    tree = KDTree(space)
    for _ in range(2):
        size, total = _sum_by(KDTree(space[chosen]).query(space)[1], np.ones(len(space)), space, len(chosen))
        chosen = np.unique(tree.query(total[size > 0] / size[size > 0, None])[1])
    size = np.bincount(KDTree(space[chosen]).query(space)[1], minlength=len(chosen))
    return candidates[chosen], normals[chosen], np.asarray(size * (area / len(candidates)), dtype=np.float64)


def _sum_by(index: ArrayLike, weight: Array, position: Array, count: int) -> tuple[Array, Array]:
    """Return per group the sum of weights (count,) and of weighted positions (count, D)."""
    index = np.asarray(index)
    total = np.bincount(index, weight, minlength=count).astype(np.float64)
    first = [np.bincount(index, weight * column, minlength=count).astype(np.float64) for column in position.T]
    return total, np.stack(first, axis=1)
