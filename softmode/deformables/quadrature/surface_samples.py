"""Surface samples: near-uniform points on a surface, each with the area of its cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.rkpm import sample_farthest

Array = NDArray[np.float64]

SURFACE_COUNT = 800
"""Surface samples of a body by default. With 400 a ball of 50 mm presses 0.3 to 0.8 of what it should when it is
pressed by 1 % of its radius, with 800 0.94; with more the step costs more."""
FEW_SAMPLES = 400
"""Fewer samples than this, as the objects of the tasks have, are those of softmode 0.2, with areas of 24 candidates:
trained policies observe these points, and take no others for them."""
CANDIDATES_PER_SAMPLE = 400
"""Uniform candidates whose number in the cell of a sample is its area: 0.05 of it is noise where they are random."""
FIRST_PER_SAMPLE = 24
"""Candidates among which the first samples are chosen, and"""
MOVED_PER_SAMPLE = 100
"""those that say where the middle of a cell is."""
LLOYD_STEPS = 5
"""Steps that move samples to the middle of their cells; of few samples two."""


def candidate_count(count: int) -> int:
    """Return how many candidates ``count`` samples and their areas take."""
    return (FIRST_PER_SAMPLE if count < FEW_SAMPLES else CANDIDATES_PER_SAMPLE) * count


def select_surface(candidates: Array, normals: Array, area: float, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Choose near-uniform samples among uniform candidates, and give each the area of its cell.

    Farthest points in position and (weakly) normal, so that both sides of a thin sheet are sampled, then Lloyd steps.
    """
    pitch = 0.35 * np.sqrt(area / count)
    space = np.concatenate([candidates, pitch * normals], axis=1)
    first = moved = np.arange(len(space))
    if count >= FEW_SAMPLES:
        first, moved = (_thinned(len(space), share * count) for share in (FIRST_PER_SAMPLE, MOVED_PER_SAMPLE))
    chosen = first[sample_farthest(space[first], count, seed=seed)]
    middle, tree = space[moved], KDTree(space)
    for _ in range(2 if count < FEW_SAMPLES else LLOYD_STEPS):
        size, total = _sum_by(KDTree(space[chosen]).query(middle)[1], np.ones(len(middle)), middle, len(chosen))
        chosen = np.unique(tree.query(total[size > 0] / size[size > 0, None])[1])
    size = np.bincount(KDTree(space[chosen]).query(space)[1], minlength=len(chosen))
    return candidates[chosen], normals[chosen], np.asarray(size * (area / len(candidates)), dtype=np.float64)


def _thinned(total: int, count: int) -> NDArray[np.intp]:
    """Return about ``count`` indices evenly among ``total``, all of them where there are no more."""
    return np.unique(np.linspace(0, total - 1, min(total, count)).astype(np.intp))


def _sum_by(index: ArrayLike, weight: Array, position: Array, count: int) -> tuple[Array, Array]:
    """Return per group the sum of weights (count,) and of weighted positions (count, D)."""
    index = np.asarray(index)
    total = np.bincount(index, weight, minlength=count).astype(np.float64)
    first = [np.bincount(index, weight * column, minlength=count).astype(np.float64) for column in position.T]
    return total, np.stack(first, axis=1)
