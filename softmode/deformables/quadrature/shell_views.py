"""Which side of a shell is outside: a cloud of surface samples is looked at from all sides."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]

VIEW_COUNT = 256
"""Directions from which the shell is looked at: enough for one or two down a tube ten times as long as wide."""
DISC = 1.5
"""Standard deviations at which a splat ends for a view; discs of one leave a tenth of a random cover open."""
NEIGHBOURS = 12
"""Splats whose centres tell the normal where the splat's own axes do not."""


def splat_normals(mean: Array, scale: Array, axes: Array) -> tuple[Array, Array, NDArray[np.intp], float]:
    """Return unit normals without orientation, and the standard deviations across them on the surface.

    The normal is a splat's thin axis. Of a round splat it is that of the neighbourhood, and so it is of one that stands
    across a flat neighbourhood.

    Args:
        mean: Centres [m], shape (N, 3).
        scale: Standard deviations [m], descending, shape (N, 3).
        axes: Unit axes in that order, as columns, shape (N, 3, 3).

    Returns:
        Normals, shape (N, 3), tangents as long as the standard deviations [m], as columns, shape (N, 3, 2), the nearest
        splats of each, itself among them, shape (N, 12), and how far centres scatter across the surface [m].
    """
    found: Any = KDTree(mean).query(mean, k=min(NEIGHBOURS, len(mean)))
    nearest: NDArray[np.intp] = found[1]
    near = mean[nearest]
    near = near - near.mean(axis=1, keepdims=True)
    spread, frame = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    normal, tangent = axes[:, :, 2].copy(), axes[:, :, :2] * scale[:, None, :2]
    across = np.abs((normal * frame[:, :, 0]).sum(axis=1)) < 0.5
    use = (scale[:, 2] > 0.5 * scale[:, 1] - 1e-300) | (across & (spread[:, 0] < 0.1 * spread[:, 1]))
    normal[use] = frame[use, :, 0]
    tangent[use] = frame[use, :, 1:] * scale[use, 1, None, None]
    return normal, tangent, nearest, float(np.sqrt(max(np.median(spread[:, 0]), 0.0) / near.shape[1]))


def spread_samples(mean: Array, tangent: Array, voxel: float) -> tuple[Array, NDArray[np.intp]]:
    """Cover each splat's disc, as wide as its tangents, with samples a voxel apart; return them and their splat."""
    steps = np.clip(np.ceil(2.0 * np.linalg.norm(tangent, axis=1) / voxel), 1, 9).astype(int)
    position, owner = [], []
    size = 10 * steps[:, 0] + steps[:, 1]
    for a, b in (divmod(int(key), 10) for key in np.unique(size)):
        member = np.flatnonzero(size == 10 * a + b)
        u, v = ((np.arange(k) + 0.5) * (2.0 / k) - 1.0 for k in (a, b))
        u, v = (g.ravel() for g in np.meshgrid(u, v, indexing="ij"))
        keep = (u * u + v * v) <= 1.0 if a > 2 and b > 2 else np.ones(len(u), dtype=bool)
        grid = mean[member, None] + np.einsum("ku,niu->nki", np.stack([u[keep], v[keep]], axis=1), tangent[member])
        position.append(grid.reshape(-1, 3))
        owner.append(np.repeat(member, int(keep.sum())))
    return np.concatenate(position), np.concatenate(owner)


def even_directions(count: int) -> Array:
    """Return unit vectors (count, 3) spread evenly, on a spiral."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)


def orient(
    mean: Array, normal: Array, tangent: Array, nearest: NDArray[np.intp], pixel: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Look at the splats from all sides, each time into a depth buffer of their discs.

    What a splat was seen from counts for its neighbours on the same sheet too, so that a few views through gaps between
    the discs do not turn single splats.

    Args:
        mean: Centres [m], shape (N, 3).
        normal: Their unit normals of either sign, shape (N, 3).
        tangent: Their tangents [m], as columns, shape (N, 3, 2).
        nearest: The nearest splats of each, shape (N, K).
        pixel: Distance within which samples close the surface [m].

    Returns:
        Sign per splat that turns its normal outside, confidence 0..1 per splat, and whether it is seen at all.
    """
    sample, owner = spread_samples(mean, DISC * tangent, pixel)
    vote, most, views = np.zeros(len(mean)), np.zeros(len(mean)), np.zeros(len(mean), dtype=int)
    cell, discs = 1.5 * pixel, np.bincount(owner, minlength=len(mean))
    place = np.ascontiguousarray(((sample - mean.mean(axis=0)) / cell).T, dtype=np.float32)
    half = int(np.sqrt((place**2).sum(axis=0).max())) + 2
    for direction in even_directions(VIEW_COUNT):
        helper = np.eye(3)[np.abs(direction).argmin()]
        right = np.cross(direction, helper)
        right /= np.linalg.norm(right)
        frame = np.stack([right, np.cross(direction, right), -direction]).astype(np.float32)
        column, row, depth = frame @ place
        key = (column + half).astype(np.int32) * (2 * half) + (row + half).astype(np.int32)
        front = np.full(4 * half * half, np.inf, dtype=np.float32)
        np.minimum.at(front, key, depth)
        share = np.bincount(owner[depth <= front[key] + 0.75], minlength=len(mean)) / discs
        views += share > 0.0
        facing = share * (normal @ direction)
        vote += facing
        most += np.abs(facing)
    away = mean[nearest] - mean[:, None]
    alike = np.einsum("nki,ni->nk", normal[nearest], normal)
    flat = np.abs(np.einsum("nki,ni->nk", away, normal)) <= 0.5 * np.linalg.norm(away, axis=2)
    alike = np.where(flat & (np.abs(alike) > 0.6), alike, 0.0)
    for _ in range(2):
        vote, most = (alike * vote[nearest]).sum(axis=1), (np.abs(alike) * most[nearest]).sum(axis=1)
    trust = np.abs(vote) / np.maximum(most, 1e-300)
    # Seen almost as much from behind: an open sheet. A wall opposite a hole keeps most of its votes.
    confidence = np.clip((trust - 0.1) / 0.3, 0.0, 1.0)
    return np.where(vote < 0.0, -1.0, 1.0), confidence, views >= 2


def wall_thickness(sample: Array, normal: Array, least: float, most: float) -> Array:
    """Return how far behind some of the samples the opposite surface is [m], infinite beyond `most`, shape (M,).

    Args:
        sample: Surface samples [m], shape (N, 3).
        normal: Their outward unit normals, shape (N, 3).
        least: Smallest depth at which is looked [m].
        most: Largest depth [m].
    """
    tree = KDTree(sample)
    pick = np.arange(0, len(sample), max(1, len(sample) // 4000))
    found = np.full(len(pick), np.inf)
    for depth in np.geomspace(least, most, 10):
        probe = sample[pick] - depth * normal[pick]
        away, other = tree.query(probe, k=4)
        behind = -np.einsum("nki,ni->nk", sample[other] - sample[pick, None], normal[pick])
        opposite = np.einsum("nki,ni->nk", normal[other], normal[pick]) < -0.5
        hit = opposite & (away < 0.7 * depth) & (behind > 0.5 * least)
        found = np.minimum(found, np.where(hit, behind, np.inf).min(axis=1))
    return found
