"""Which part of a capture is the object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from softmode.errors import ConfigError
from softmode.objects.carrier_cut import WHOLE, divide
from softmode.objects.rooms import ALIKE, BESIDE, crop_of, scene_crop
from softmode.splats.components import label_components, size_of, surface_discs
from softmode.splats.splats import Splats, joined

Rule = Literal["thickest", "tallest", "largest", "all"]
Part = Rule | tuple[int, ...]

GROUND_SHARE = 0.05
"""Least share of a capture's area that can be ground."""
GROUND_COVER = 0.5
"""Of ground less than this has anything above it: the side of a solid has the other side behind it."""
GROUND_UNDER = 0.5
"""Of all else at least this lies over the ground."""
SURROUNDED = 0.05
"""A part with this share of another's splats, in the middle of it, is the object and the other one a room."""
CANDIDATES = 9
"""At most so many pieces and other parts have a number."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """The object of a capture, and what else there is."""

    part: Splats
    """The object, closed by a floor where it was cut off what carries it."""
    rows: NDArray[np.intp]
    """Its splats in the capture, in its order; what closes it comes after them."""
    number: NDArray[np.intp]
    """Number of the candidate that each splat of the capture belongs to, from 1 on, shape (N,); 0 for the ground and
    floaters. The first is the topmost piece of the object's part, the next carry it, others are parts of their own or
    stand beside it on what carries it."""
    taken: tuple[int, ...]
    """The candidates that are taken."""
    told: dict[str, str | int | float]
    """What was found, for the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """The plane that everything else stands on."""

    splats: NDArray[np.bool_]
    """Which splats are the ground, shape (N,)."""
    normal: NDArray[np.float64]
    """Its normal, towards what stands on it, shape (3,)."""


def choose_part(splats: Splats, rule: Part) -> Choice:
    """Return the part of a capture that is the object, by the rule of `ObjectConfig.part`; all if nothing connects.

    The rules "thickest" and "tallest" first take away the ground on which everything stands. Where there was one, a
    part that stands in the middle of another (a thing in a room) is taken before it. By the rule "thickest" the object
    is then cut off what carries it (`softmode.objects.carriers`). Numbers take the candidates that this rule finds.

    Raises:
        ConfigError: If there is no candidate of a number.
    """
    if rule == "all":
        every = np.arange(splats.count)
        return Choice(part=splats, rows=every, number=np.ones_like(every), taken=(1,), told={})
    ground = None if rule == "largest" else find_ground(splats)
    floor = np.zeros(splats.count, dtype=bool) if ground is None else ground.splats
    scene = np.flatnonzero(~floor)
    gap, label = _linked(splats.subset(scene))
    parts = [scene[label == k] for k in range(int(label.max(initial=-1)) + 1)] or [np.arange(splats.count)]
    things, order = [splats.subset(rows) for rows in parts], list(range(len(parts)))
    first = chosen = 0
    if rule == "tallest":
        chosen = max(order, key=lambda k: float(np.ptp(things[k].bounds(quantile=0.005)[:, 2])))
    elif rule != "largest":
        chosen = first = max(order, key=lambda k: _thickness(things[k]))
        while ground is not None and (inner := [k for k in order if _surrounds(things[chosen], things[k])]):
            chosen = max(inner, key=lambda k: _thickness(things[k]))
    number, others = np.zeros(splats.count, dtype=np.intp), [parts[k] for k in order if k != chosen]
    pieces = WHOLE
    if rule not in ("largest", "tallest"):
        pieces = divide(things[chosen], None if ground is None else ground.normal, gap)
    number[parts[chosen]] = pieces.number
    above = np.flatnonzero((number > 0) & (number <= pieces.top))
    beside = _beside(splats, above, gap) if pieces.top < pieces.count else []
    others = [*beside, *others]
    for rows, mark in zip(others, range(pieces.count + 1, CANDIDATES + 1), strict=False):
        number[rows] = mark
    taken = rule if isinstance(rule, tuple) else tuple(range(1, pieces.top + 1))
    if missing := set(taken) - set(number.tolist()):
        raise ConfigError(
            f"part {' '.join(map(str, sorted(missing)))}: the capture has the candidates 1 to {number.max()}",
            hint="`softmode splat show FILE` draws them with their numbers",
        )
    part, rows = things[chosen], parts[chosen]
    if beside or set(taken) != set(range(1, pieces.count + 1)):
        rows = np.flatnonzero(np.isin(number, taken))
        standing = {pieces.top} if any((number[one] == mark).any() for one in beside for mark in taken) else set()
        floors = pieces.floors({*taken, *standing}, things[chosen])
        if beside and floors:  # each thing has the floor that is nearest to it
            near = KDTree(things[chosen].means)
            mine = np.isin(number[parts[chosen]], taken)
            floors = [floor.subset(mine[near.query(floor.means)[1]]) for floor in floors]
        part = joined([splats.subset(rows), *floors], splats.name)
    told: dict[str, str | int | float] = {"part_splats": len(rows), "floor_splats": part.count - len(rows)}
    told["ground_splats"] = int(floor.sum())
    other = next((rows for rows in others if len(rows) >= SURROUNDED * things[chosen].count), None)
    if other is not None:
        crop = crop_of(splats.subset(other))
        told |= {
            "other_splats": len(other),
            "other_crop": crop,
            "other_part": int(number[other[0]] or pieces.count + 1),
        }
    if rule == "thickest":
        told |= pieces.told
        rest, within = [splats.subset(rows) for rows in others], first != chosen
        if crop := scene_crop(things[chosen], rest, within=within, grounded=ground is not None):
            told["scene_crop"] = crop
    return Choice(part=part, rows=rows, number=number, taken=taken, told=told)


def _linked(scene: Splats) -> tuple[float, NDArray[np.intp]]:
    """Return the gap that parts the things of a scene, and the part of each of its splats (N,), -1 for none."""
    # The wider of a fraction of the capture and what its own pitch calls for: a small file of one object is sparse. Of
    # points strewn at random on a surface, n exp(-5.7 f^2) have no neighbour within f median sixth distances.
    few = scene.means[:: max(1, scene.count // 20_000)]
    pitch = 1.5 * np.median(KDTree(scene.means).query(few, k=min(7, scene.count))[0][:, -1])
    gap = max(0.015 * size_of(scene), float(pitch), 1.0e-9)
    return gap, label_components(scene, gap=gap, faces=True)


def _beside(splats: Splats, above: NDArray[np.intp], gap: float) -> list[NDArray[np.intp]]:
    """Return of the rows (M,) that stand on a carrier those of things of weight beside the thickest one."""
    label = label_components(splats.subset(above), gap=gap, faces=True)
    found = [above[label == k] for k in range(int(label.max(initial=-1)) + 1)]
    things = [splats.subset(rows) for rows in found]
    heavy = [k for k, thing in enumerate(things) if thing.count >= BESIDE * things[0].count]
    heavy = [k for k in heavy if size_of(things[k]) >= ALIKE * size_of(things[0])]
    heavy.sort(key=lambda k: -_thickness(things[k]))
    return [found[k] for k in heavy[1:]]


def _surrounds(part: Splats, inner: Splats) -> bool:
    """Return whether a part of some weight stands in the middle of another."""
    (low, high), (start, end) = part.bounds(quantile=0.01), inner.bounds(quantile=0.01)
    return inner.count >= SURROUNDED * part.count and bool(((start > low) & (end < high))[:2].all())


def _thickness(part: Splats) -> float:
    """Return the least variance of the centres in any direction."""
    return float(np.linalg.eigvalsh(np.cov(part.means.astype(np.float64).T))[0])


def find_ground(splats: Splats) -> Ground | None:
    """Return the ground that everything else stands on, None if there is no such plane.

    The ground is the plane with the largest area of splats that lie flat in it, provided that nine tenths of all else
    lie on one side of it, rise well above it, and cover less than half of it. Of two planes that are taken for one, a
    ground and a turntable on it, it is that of the fullest peak of heights.
    """
    solid = np.flatnonzero(splats.opacities >= 0.2)
    if len(solid) < 200:
        return None
    firm = splats.subset(solid)
    x, size, (normal, tangents) = firm.means.astype(np.float64), size_of(firm), surface_discs(firm)
    area = np.linalg.norm(tangents, axis=1).prod(axis=1)
    area = np.minimum(area, np.quantile(area, 0.99))
    few = np.random.default_rng(0).permutation(len(solid))[:3000]
    tried = few[:300]
    near = np.abs(x[few] @ normal[tried].T - (x[tried] * normal[tried]).sum(axis=1)) < 0.01 * size
    near &= np.abs(normal[few] @ normal[tried].T) > 0.8
    best = tried[(area[few] @ near).argmax()]
    axis, middle, reach, left = normal[best], x[best], 0.01 * size, 3
    while True:
        height = (x - middle) @ axis
        flat = (np.abs(height) < reach) & (np.abs(normal @ axis) > 0.8)
        if flat.sum() < 100:
            return None
        if not left:
            break
        near, left = x[_fullest(height, flat, area)], left - 1
        middle = near.mean(axis=0)
        axis = np.linalg.svd((near - middle)[:: max(1, len(near) // 5000)], full_matrices=False)[2][2]
        reach = float(np.clip(5.0 * np.median(np.abs((near - middle) @ axis)), 0.002 * size, 0.01 * size))
    rest = np.abs(height) > 2.0 * reach
    if area[flat].sum() < GROUND_SHARE * area.sum() or rest.sum() < 0.02 * len(x):
        return None
    side_up = float(np.sign(np.median(height[rest])))
    above = height[rest] * side_up
    if (above > 0.0).mean() < 0.9 or np.quantile(above, 0.9) < 5.0 * reach:
        return None
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    plan = (x - middle) @ np.stack([side, np.cross(axis, side)], axis=1)
    # What stands on it stands over it: else it is a strip of a round side.
    hull = ConvexHull(plan[flat])
    within = (plan[rest] @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1) < 0.0
    if within.mean() < GROUND_UNDER:
        return None
    # Cells that hold ten splats of the plane on average; holes between them do not count.
    cell = max(float(np.sqrt(10.0 * np.ptp(plan[flat], axis=0).prod() / flat.sum())), 0.01 * size)
    edges = [np.arange(along.min(), along.max() + cell, cell) for along in plan.T]
    held, over = (np.histogram2d(plan[some, 0], plan[some, 1], edges)[0] for some in (flat, rest))
    floor = held >= 2
    if (over[floor] >= 0.25 * held[floor]).mean() >= GROUND_COVER:
        return None
    found = (np.abs((splats.means.astype(np.float64) - middle) @ axis) < reach) & (splats.opacities < 0.2)
    found[solid[flat]] = True
    return Ground(splats=found, normal=side_up * axis)


def _fullest(height: NDArray[np.float64], flat: NDArray[np.bool_], area: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of flat splats lie around the fullest peak of heights; all of them if there is no other one."""
    some = np.flatnonzero(flat)
    if not np.ptp(height[some]) > 0.0:
        return flat
    bins = int(np.clip(len(some) // 50, 2, 60))
    count, edge = np.histogram(height[some], bins=bins, weights=area[some])
    smooth = ndimage.gaussian_filter1d(count, 1.5)
    first = int(smooth.argmax())
    off = np.abs(height[some] - 0.5 * (edge[first] + edge[first + 1]))
    spread = max(float(np.median(off[off < 0.25 * np.ptp(height[some])])), float(edge[1] - edge[0]))
    far = np.abs(np.arange(bins) - first) * (edge[1] - edge[0]) > 4.0 * spread
    second = int(np.where(far, smooth, 0.0).argmax())
    valley = smooth[min(first, second) : max(first, second) + 1].min()
    if smooth[second] < 0.1 * smooth[first] or valley > 0.5 * smooth[second] or (off < 4.0 * spread).sum() < 100:
        return flat
    found = np.zeros_like(flat)
    found[some[off < 4.0 * spread]] = True
    return found
