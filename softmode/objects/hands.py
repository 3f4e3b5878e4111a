"""Whether a hand holds what a capture shows: an arm reaches out of it, and is open where the capture ends.

Colours say nothing of sleeves and gloves, and a hand on a toy is as good a shape as any. But no capture shows the end
of an arm: it is a tube, slim beside the rest, with nothing across it and nothing beyond.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.quadrature.shell_views import even_directions, spread_samples
from softmode.objects.carriers import Surface, ramp

Array = NDArray[np.float64]

WAYS = 60
"""Directions in which ends are looked for."""
HELD = 0.3
"""Score from which on a hand is named."""
LOOK, APART, CELL = 0.25, 0.12, 0.015
"""What is looked at behind an end, how far ends are apart, and edge of the cells, over the size of the whole."""


def find_arm(surface: Surface) -> tuple[float, Array]:
    """Return how sure it is that an arm leaves a thing, 0 to 1, and where it ends, shape (3,).

    Args:
        surface: The thing, z up.
    """
    size = float(np.ptp(np.quantile(surface.points, [0.002, 0.998], axis=0), axis=0).max())
    sample, owner = spread_samples(surface.points, 1.5 * surface.tangents, 1.5 * CELL * size)
    # One sample in each cell: bare faces and crowded rims count alike.
    cell = np.floor((sample - sample.min(axis=0)) / (CELL * size)).astype(np.int64)
    first = np.unique(cell @ (1, 2**20, 2**40), return_index=True)[1]
    points, normals = sample[first], surface.normals[owner[first]]
    few = min(20, len(points))  # floaters lie beyond
    ends, best = np.zeros((0, 3)), (0.0, np.zeros(3))
    for end in points[np.argpartition(points @ even_directions(WAYS).T, -few, axis=0)[-few]]:
        if (np.linalg.norm(ends - end, axis=1) > APART * size).all():
            ends = np.append(ends, [end], axis=0)
            near = np.flatnonzero(((points - end) ** 2).sum(axis=1) < (LOOK * size) ** 2)
            best = max(best, (_open_tube(points, normals, near, end, size), end), key=lambda found: found[0])
    return best


def _open_tube(points: Array, normals: Array, near: NDArray[np.intp], end: Array, size: float) -> float:
    """Return how much what is near an end of a thing, rows (M,) of its points (N, 3), is like an arm cut off."""
    if len(near) < 60:
        return 0.0
    value, frame = np.linalg.eigh(normals[near].T @ normals[near] / len(near))
    axis = frame[:, 0] * np.copysign(1.0, (end - points[near].mean(axis=0)) @ frame[:, 0])
    along, across = points @ axis, points @ frame[:, 1:]
    tube = across[near]
    middle = 0.5 * (tube.min(axis=0) + tube.max(axis=0))
    away = np.linalg.norm(across - middle, axis=1)
    radius, top = float(np.median(away[near])), float(along[near].max())
    length = float(np.quantile(top - along[near], 0.95))
    shell = near[np.abs(away[near] - radius) < 0.4 * radius]
    turn = np.arctan2(*(across[shell] - middle).T)
    ring = np.histogram(turn, 16, (-np.pi, np.pi))[0]
    across_end = np.count_nonzero((away < 0.5 * radius) & (along > top - 0.6 * length))
    beyond = along < top - length
    rest = across[beyond]
    if len(rest) < 50:
        return 0.0
    out = rest - middle
    sideways = np.abs(normals[beyond] @ frame[:, 1] * out[:, 1] - normals[beyond] @ frame[:, 2] * out[:, 0])
    turned = float((sideways < 0.35 * np.linalg.norm(out, axis=1)).mean())
    wide: Any = np.ptp(np.quantile(rest, [0.02, 0.98], axis=0), axis=0).max()
    why = {
        "tube": ramp(-float(value[0]), -0.12, -0.05),
        "around": ramp(float((ring > 0).mean()), 0.65, 0.85),
        "open": ramp(-across_end * (CELL * size) ** 2 / (np.pi * (0.5 * radius) ** 2), -0.3, -0.1),
        "slim": ramp(radius / size, 0.03, 0.05) * ramp(-radius / size, -0.2, -0.16),
        "long": ramp(length / radius, 1.4, 2.0),
        "beside": ramp(float(wide) / (2.0 * radius), 1.3, 1.8),
        # The neck of a bottle, whose belly is turned about it.
        "not turned": ramp(-turned, -0.85, -0.7),
        # What points down may be a leg or a plinth, whose underside was not seen.
        "up": ramp(float(axis[2]), -0.8, -0.65),
    }
    return float(np.prod(list(why.values())))
