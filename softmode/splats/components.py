"""Split a capture into its separate objects: the thing, the ground it stood on, loose parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.splats.splats import Splats

DENSE = 20_000
"""Above so many splats a capture is thinned out before its splats are linked."""


def size_of(splats: Splats) -> float:
    """Return the diagonal of the box around splats, but for the outermost hundredth [m]."""
    return float(np.linalg.norm(np.diff(splats.bounds(quantile=0.01), axis=0)))


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
    label = label_components(splats, gap=gap, min_opacity=min_opacity, min_count=min_count)
    return [splats.subset(label == part) for part in range(label.max(initial=-1) + 1)]


def label_components(
    splats: Splats, *, gap: float | None = None, min_opacity: float = 0.2, min_count: int = 20, faces: bool = False
) -> NDArray[np.intp]:
    """Return the part of each splat (N,), as `split_components` orders them; -1 for what belongs to none.

    Args:
        splats: The capture.
        gap: As there.
        min_opacity: As there.
        min_count: As there.
        faces: Whether wide flat splats hold together what their discs touch: the few large splats of a plain face lie
            farther apart than the fine ones of its rim.
    """
    if gap is None:
        gap = max(0.015 * size_of(splats), 1e-9)
    require_number("gap", gap, above=0.0, hint="Give a distance in the unit of the asset")
    solid = np.flatnonzero(splats.opacities >= min_opacity)
    if len(solid) == 0:
        return np.full(splats.count, -1, dtype=np.intp)
    points = splats.means[solid]
    if faces:
        points = np.concatenate([points, _disc_points(splats.subset(solid), gap, 0.25 * size_of(splats))])
    tree, label = _chains(points, gap)
    distance, nearest = tree.query(splats.means)
    every = np.where(distance <= gap, label[nearest], -1)
    count = np.bincount(every[solid], minlength=label.max() + 1)
    order = np.argsort(-count, kind="stable")
    order = order[count[order] >= min_count]
    place = np.full(len(count) + 1, -1, dtype=np.intp)
    place[order] = np.arange(len(order))
    return place[every]


def link_labels(points: NDArray[Any], gap: float) -> NDArray[np.intp]:
    """Return a number per point (N,) of points (N, 3), the same for those that chains of steps up to `gap` join."""
    tree, label = _chains(points, gap)
    return label[tree.query(points)[1]]


def _chains(points: NDArray[Any], gap: float) -> tuple[KDTree, NDArray[np.intp]]:
    """Return the points that make chains, and the chain of each."""
    if len(points) > DENSE:  # Of a dense capture one splat in each cell of a quarter of the gap makes the chains.
        cell = np.floor(points / (0.25 * gap)).astype(np.int64)
        cell = np.clip(cell - np.median(cell, axis=0).astype(np.int64), -(2**19), 2**19 - 1) + 2**19
        key = (cell[:, 0] << 40) + (cell[:, 1] << 20) + cell[:, 2]
        points = points[np.sort(np.unique(key, return_index=True)[1])]
    tree = KDTree(points)
    pairs = tree.query_pairs(gap, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(len(points), len(points)))
    label: Any = connected_components(graph, directed=False)[1]
    return tree, label.astype(np.intp)


def _disc_points(splats: Splats, gap: float, widest: float) -> NDArray[np.float32]:
    """Return points on the discs of flat splats that are wider than half the gap, and not haze wider than `widest`."""
    thin, wide, long = np.sort(splats.scales, axis=1).T
    flat = (wide > 0.5 * gap) & (thin < 0.3 * wide) & (splats.opacities >= 0.5) & (long < widest)
    return disc_points(splats.means[flat], splats.discs()[1][flat], gap)


def surface_discs(splats: Splats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the discs of splats (`Splats.discs`), those of thick ones turned into the surface around them.

    A sphere or a rod has a thin axis by chance: its disc lies in the plane of its neighbours.
    """
    normals, tangents = splats.discs()
    thin, wide, long = np.sort(splats.scales, axis=1).T
    thick = np.flatnonzero(thin > 0.6 * wide)
    if len(thick) == 0 or splats.count < 16:
        return normals, tangents
    around = splats.means[KDTree(splats.means).query(splats.means[thick], k=16)[1]].astype(np.float64)
    around -= around.mean(axis=1, keepdims=True)
    facing = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    length = np.linalg.norm(tangents[thick], axis=1)
    first = tangents[thick, :, 0] / length[:, :1]
    rod = (wide < 0.6 * long)[thick]
    facing[rod] -= (facing[rod] * first[rod]).sum(axis=1, keepdims=True) * first[rod]
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    first = first - (first * facing).sum(axis=1, keepdims=True) * facing
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    normals[thick] = facing
    tangents[thick] = np.stack([first, np.cross(facing, first)], axis=2) * length[:, None]
    return normals, tangents


def disc_points(means: NDArray[Any], tangents: NDArray[Any], gap: float) -> NDArray[np.float32]:
    """Return points about a gap apart on discs of one and a half tangents (N, 3, 2) around centres (N, 3)."""
    found = [np.zeros((0, 3))]
    rings = np.clip(np.ceil(1.5 * np.linalg.norm(tangents, axis=1).max(axis=1) / gap), 2, 8).astype(int)
    for count in np.unique(rings):
        same = rings == count
        turn = np.linspace(0.0, 2.0 * np.pi, 6 * count, endpoint=False)
        disc = np.stack([np.cos(turn), np.sin(turn)])
        disc = np.concatenate([1.5 * (k + 1) / count * disc for k in range(count)], axis=1)
        found.append((means[same, None] + np.einsum("nij,jk->nki", tangents[same], disc)).reshape(-1, 3))
    return np.concatenate(found).astype(np.float32)
