"""Which part of a capture is the object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.splats.components import split_components
from softmode.splats.splats import Splats, rotations_from_quats

Part = Literal["thickest", "tallest", "largest", "all"]

GROUND_SHARE = 0.05
"""Least share of a capture's area that can be ground."""
GROUND_COVER = 0.5
"""Of ground less than this has anything above it: the side of a solid has the other side behind it."""
SURROUNDED = 0.05
"""A part with this share of another's splats, in the middle of it, is the object and the other one a room."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The object of a capture, and what else there is."""

    part: Splats
    """The object."""
    ground_count: int = 0
    """Number of splats of the ground beneath it."""
    other: Splats | None = None
    """The part with most splats of the others, if it has a twentieth of the object's."""


def choose_part(splats: Splats, rule: Part) -> Choice:
    """Return the part of a capture that is the object, by the rule of `ObjectConfig.part`; all if nothing connects.

    The rules "thickest" and "tallest" first take away the ground on which everything stands. Where there was one, a
    part that stands in the middle of another (a thing in a room) is taken before it.
    """
    if rule == "all":
        return Choice(part=splats)
    ground = np.zeros(splats.count, dtype=bool) if rule == "largest" else find_ground(splats)
    scene = splats.subset(~ground) if ground.any() else splats
    # The wider of a fraction of the capture and what its own pitch calls for: a small file of one object is sparse. Of
    # points strewn at random on a surface, n exp(-5.7 f^2) have no neighbour within f median sixth distances.
    low, high = scene.bounds(quantile=0.01)
    few = scene.means[:: max(1, scene.count // 20_000)]
    pitch = 1.5 * np.median(KDTree(scene.means).query(few, k=min(7, scene.count))[0][:, -1])
    parts = split_components(scene, gap=max(0.015 * float(np.linalg.norm(high - low)), float(pitch), 1.0e-9))
    if not parts:
        return Choice(part=splats)
    if rule == "largest":
        chosen = parts[0]
    elif rule == "tallest":
        chosen = max(parts, key=lambda part: float(np.ptp(part.bounds(quantile=0.005)[:, 2])))
    else:
        chosen = max(parts, key=_thickness)
        while ground.any() and (inner := [part for part in parts if _surrounds(chosen, part)]):
            chosen = max(inner, key=_thickness)
    other = next((part for part in parts if part is not chosen and part.count >= SURROUNDED * chosen.count), None)
    return Choice(part=chosen, ground_count=int(ground.sum()), other=other)


def _surrounds(part: Splats, inner: Splats) -> bool:
    """Return whether a part of some weight stands in the middle of another."""
    (low, high), (start, end) = part.bounds(quantile=0.01), inner.bounds(quantile=0.01)
    return inner.count >= SURROUNDED * part.count and bool(((start > low) & (end < high))[:2].all())


def _thickness(part: Splats) -> float:
    """Return the least variance of the centres in any direction."""
    return float(np.linalg.eigvalsh(np.cov(part.means.astype(np.float64).T))[0])


def find_ground(splats: Splats) -> NDArray[np.bool_]:
    """Return which splats are the ground that everything else stands on, shape (N,); none if there is no such plane.

    The ground is the plane with the largest area of splats that lie flat in it, provided that nine tenths of all else
    lie on one side of it, rise well above it, and cover less than half of it.
    """
    nothing = np.zeros(splats.count, dtype=bool)
    solid = np.flatnonzero(splats.opacities >= 0.2)
    if len(solid) < 200:
        return nothing
    x = splats.means[solid].astype(np.float64)
    scale = np.sort(splats.scales[solid].astype(np.float64), axis=1)
    thin = splats.scales[solid].argmin(axis=1)
    normal = rotations_from_quats(splats.quats[solid])[np.arange(len(solid)), :, thin].astype(np.float64)
    area = scale[:, 1] * scale[:, 2]
    area = np.minimum(area, np.quantile(area, 0.99))
    low, high = np.quantile(x, [0.01, 0.99], axis=0)
    size = float(np.linalg.norm(high - low))
    few = np.random.default_rng(0).permutation(len(solid))[:3000]
    tried = few[:300]
    near = np.abs(x[few] @ normal[tried].T - (x[tried] * normal[tried]).sum(axis=1)) < 0.01 * size
    near &= np.abs(normal[few] @ normal[tried].T) > 0.8
    best = tried[(area[few] @ near).argmax()]
    axis, middle, reach = normal[best], x[best], 0.01 * size
    flat = np.zeros(len(x), dtype=bool)
    for _ in range(3):
        height = (x - middle) @ axis
        flat = (np.abs(height) < reach) & (np.abs(normal @ axis) > 0.8)
        if flat.sum() < 100:
            return nothing
        middle = x[flat].mean(axis=0)
        axis = np.linalg.svd((x[flat] - middle)[:: max(1, int(flat.sum()) // 5000)], full_matrices=False)[2][2]
        off = np.abs((x[flat] - middle) @ axis)
        reach = float(np.clip(5.0 * np.median(off), 0.002 * size, 0.01 * size))
    height = (x - middle) @ axis
    flat = (np.abs(height) < reach) & (np.abs(normal @ axis) > 0.8)
    rest = np.abs(height) > 2.0 * reach
    if flat.sum() < 100 or area[flat].sum() < GROUND_SHARE * area.sum() or rest.sum() < 0.02 * len(x):
        return nothing
    above = height[rest] * np.sign(np.median(height[rest]))
    if (above > 0.0).mean() < 0.9 or np.quantile(above, 0.9) < 5.0 * reach:
        return nothing
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    plan = (x - middle) @ np.stack([side, np.cross(axis, side)], axis=1)
    # Cells that hold ten splats of the plane on average; holes between them do not count.
    cell = max(float(np.sqrt(10.0 * np.ptp(plan[flat], axis=0).prod() / flat.sum())), 0.01 * size)
    index = np.floor((plan - plan.min(axis=0)) / cell).astype(np.int64)
    key = index[:, 0] * (index[:, 1].max() + 1) + index[:, 1]
    held, over = np.bincount(key[flat], minlength=key.max() + 1), np.bincount(key[rest], minlength=key.max() + 1)
    floor = held >= 2
    if (over[floor] >= 0.25 * held[floor]).mean() >= GROUND_COVER:
        return nothing
    every = np.abs((splats.means.astype(np.float64) - middle) @ axis) < reach
    faint = splats.opacities < 0.2
    nothing[solid[flat]] = True
    nothing[every & faint] = True
    return nothing
