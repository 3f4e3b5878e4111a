"""Captures that are scenes: rooms, and several things none of which is the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from softmode.splats.components import label_components, size_of, surface_discs
from softmode.splats.splats import Splats

Array = NDArray[np.float64]

BESIDE = 0.1
"""Share of the object's splats that another thing of weight has."""
ALIKE = 0.3
"""Size of such a thing over that of the object."""
WALLS, INSIDE = 0.45, 0.15
"""Share of the outline along which walls stand, and share of the splats between them, from which on it is a room."""


def crop_of(part: Splats) -> str:
    """Return the box around a part, as an option takes it."""
    low, high = part.bounds(quantile=0.002)
    return " ".join(f"{x:.4g}" for x in (*(low - 0.02 * (high - low)), *(high + 0.02 * (high - low))))


def scene_crop(thing: Splats, others: list[Splats], *, within: bool, grounded: bool) -> str | None:
    """Return a box to begin with where a capture is a scene; None where it shows one object, or two.

    Args:
        thing: The part that would be taken, z up.
        others: The other parts.
        within: Whether it stands in the middle of one of them.
        grounded: Whether there is a ground, which rooms have between their walls: then those are another part.
    """
    size = size_of(thing)
    beside = [part for part in others if part.count >= BESIDE * thing.count and size_of(part) >= ALIKE * size]
    if within or len(beside) >= 3:
        return crop_of(thing)
    inner = None if grounded else _inside_of_walls(thing)
    if inner is None:
        return None
    label = label_components(inner, gap=0.02 * size)
    return crop_of(inner.subset(label == 0) if (label == 0).any() else inner)


def _inside_of_walls(part: Splats) -> Splats | None:
    """Return what stands between walls; None if a part has no walls around it, or nothing between them."""
    solid = part.subset((part.opacities >= 0.2) & (part.scales.max(axis=1) < 0.25 * size_of(part)))
    if solid.count < 500:
        return None
    x = solid.means.astype(np.float64)
    upright = np.abs(surface_discs(solid)[0][:, 2]) < 0.3
    low, high = np.quantile(x, [0.01, 0.99], axis=0)
    plan = x[:, :2][((x > low) & (x < high))[:, :2].all(axis=1)]
    x_edge, y_edge, z_edge = high - low
    if len(plan) < 100 or not min(x_edge, y_edge) > 0.0 or not 0.0 < z_edge < max(x_edge, y_edge):
        return None
    hull = ConvexHull(plan)
    depth = -(x[:, :2] @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    wide, height = float(np.sqrt(hull.volume)), (x[:, 2] - low[2]) / (high[2] - low[2])
    way = x[:, :2] - 0.5 * (low + high)[:2]
    around, wall = np.arctan2(way[:, 1], way[:, 0]), upright & (depth < 0.05 * wide)
    held = np.histogram2d(around[wall], height[wall], (36, 10), ((-np.pi, np.pi), (0.0, 1.0)))[0] > 0
    inside = (depth > 0.1 * wide) & (height > 0.04) & (height < 0.7)
    if (held.mean(axis=1) >= 0.6).mean() < WALLS or inside.mean() < INSIDE:
        return None
    return solid.subset(inside)
