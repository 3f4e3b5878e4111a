"""Which part of a capture is the object."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from softmode.splats.components import split_components
from softmode.splats.splats import Splats

Part = Literal["thickest", "tallest", "largest", "all"]


def choose_part(splats: Splats, rule: Part) -> Splats:
    """Return the part of a capture that is the object, by the rule of `ObjectConfig.part`; all if nothing connects."""
    if rule == "all":
        return splats
    # The wider of a fraction of the capture and what its own pitch calls for: a small file of one object is sparse. Of
    # points strewn at random on a surface, n exp(-5.7 f^2) have no neighbour within f median sixth distances.
    low, high = splats.bounds(quantile=0.01)
    pitch = 1.5 * np.median(KDTree(splats.means).query(splats.means, k=min(7, splats.count))[0][:, -1])
    parts = split_components(splats, gap=max(0.015 * float(np.linalg.norm(high - low)), float(pitch), 1.0e-9))
    if not parts:
        return splats
    if rule == "largest":
        return parts[0]
    if rule == "tallest":
        return max(parts, key=lambda part: float(np.ptp(part.bounds(quantile=0.005)[:, 2])))
    return max(parts, key=lambda part: float(np.linalg.eigvalsh(np.cov(part.means.astype(np.float64).T))[0]))
