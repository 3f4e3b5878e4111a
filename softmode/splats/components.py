"""Split a capture into its separate objects: the thing, the ground it stood on, loose parts."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.splats.splats import Splats

DENSE = 20_000
"""Above so many splats a capture is thinned out before its splats are linked."""


def split_components(
    splats: Splats, *, gap: float | None = None, min_opacity: float = 0.2, min_count: int = 20
) -> list[Splats]:
    """Return the connected parts of a capture, the one with most splats first.

    Two splats belong together if a chain of centres, each within `gap` of the next, joins them. Only splats of at least
    `min_opacity` make chains, since faint haze would join everything; fainter ones go with the part nearest to
    them, or are dropped beyond `gap`, as are parts of fewer than `min_count` solid splats.

    Args:
        splats: The capture.
        gap: Largest distance that counts as touching [m]; None for 1.5 % of the diagonal of the capture.
        min_opacity: Least opacity of a splat that joins others, 0..1.
        min_count: Least number of solid splats of a part.

    Raises:
        ConfigError: If the gap is not positive.
    """
    if gap is None:
        low, high = splats.bounds(quantile=0.01)
        gap = max(0.015 * float(np.linalg.norm(high - low)), 1e-9)
    require_number("gap", gap, above=0.0, hint="Give a distance in the unit of the asset")
    solid = np.flatnonzero(splats.opacities >= min_opacity)
    if len(solid) == 0:
        return []
    # Of a dense capture one splat in each cell of a quarter of the gap makes the chains.
    links = solid
    if len(solid) > DENSE:
        cell = np.floor(splats.means[solid] / (0.25 * gap)).astype(np.int64)
        links = solid[np.sort(np.unique(cell, axis=0, return_index=True)[1])]
    tree = KDTree(splats.means[links])
    pairs = tree.query_pairs(gap, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(len(links), len(links)))
    label = connected_components(graph, directed=False)[1]
    distance, nearest = tree.query(splats.means)
    every = np.where(distance <= gap, label[nearest], -1)
    count = np.bincount(every[solid], minlength=label.max() + 1)
    order = np.argsort(-count, kind="stable")
    return [splats.subset(every == part) for part in order if count[part] >= min_count]
