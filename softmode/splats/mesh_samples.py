"""Flat splats on the surface of a mesh: a Poisson-disk sample with one splat per point."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.splats import SH_DC, Splats, quats_from_rotations

CANDIDATES_PER_SAMPLE = 4
"""Random points of which each kept one is chosen."""
TANGENTIAL_SCALE = 0.6
"""Standard deviation of a new splat along the surface over the spacing sqrt(area / count)."""
NORMAL_SCALE = 0.05
"""Standard deviation across the surface over the spacing."""
OPACITY = 0.95
"""Opacity of a new splat."""


def sample_mesh(mesh: ColoredMesh, count: int, *, seed: int = 0) -> Splats:
    """Cover the surface with flat splats, as evenly as Poisson-disk sampling does.

    Points are drawn uniformly by area and thinned by weighted sample elimination (Yuksel 2015, "Sample Elimination for
    Generating Poisson Disk Sample Sets", DOI 10.1111/cgf.12538); the two sides of a thin sheet do not compete. A splat
    takes the mean colour of the drawn points nearest to it, so that a fine texture is averaged, not aliased.

    Args:
        mesh: The surface.
        count: Number of splats, >= 1.
        seed: Seed of the points.

    Returns:
        Splats of spherical-harmonic degree 0, their third axis normal to the surface.

    Raises:
        ConfigError: If the count is not positive.
    """
    require_number("count", count, at_least=1, hint="give a number of splats like 10000")
    rng = np.random.default_rng(seed)
    drawn = CANDIDATES_PER_SAMPLE * count
    cumulative = np.cumsum(mesh.areas())
    along = (np.arange(drawn) + rng.random(drawn)) / drawn * cumulative[-1]
    faces = np.searchsorted(cumulative, along, side="right").clip(0, len(cumulative) - 1)
    root, share = np.sqrt(rng.random(drawn)), rng.random(drawn)
    weights = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
    points = np.einsum("nk,nki->ni", weights, mesh.corners[faces])
    normals = mesh.normals()[faces]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = mesh.colors_at(faces, weights)

    kept = eliminate_samples(points, normals, cumulative[-1], count)
    spacing = float(np.sqrt(cumulative[-1] / count))
    nearest = _nearest(points, normals, kept, spacing)
    nearest[kept] = np.arange(count)  # even where two surfaces coincide
    total = np.zeros((count, 4))
    np.add.at(total, nearest, np.concatenate([colors, np.ones((drawn, 1))], axis=1))
    colors = total[:, :3] / total[:, 3:]

    return Splats(
        means=points[kept],
        quats=quats_from_rotations(frames_of(normals[kept])),
        scales=np.tile(spacing * np.array([TANGENTIAL_SCALE, TANGENTIAL_SCALE, NORMAL_SCALE]), (count, 1)),
        opacities=np.full(count, OPACITY),
        sh=((colors - 0.5) / SH_DC)[:, None],
        name=mesh.name,
    )


def frames_of(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return orthogonal frames (N, 3, 3) whose last column is a unit normal, each of shape (N, 3)."""
    first = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(normals, first), normals], axis=2), dtype=np.float64)


def eliminate_samples(
    points: NDArray[np.float64], normals: NDArray[np.float64], area: float, count: int
) -> NDArray[np.int64]:
    """Return the indices of the `count` points that are left when the most crowded one is removed again and again.

    A point's crowding is the sum of (1 - d / (2 r))^8 over its neighbours at distances d < 2 r, unless their normals
    are more than 120 degrees apart; r = sqrt(area / (2 sqrt(3) count)) is the largest possible radius of that many
    disks (Yuksel 2015, section 3).

    Args:
        points: Positions [m], shape (N, 3).
        normals: Unit normals, shape (N, 3).
        area: Area of the surface [m^2].
        count: Number of points to keep, at most N.
    """
    reach = 2.0 * float(np.sqrt(area / (2.0 * np.sqrt(3.0) * count)))
    pairs = KDTree(points).query_pairs(reach, output_type="ndarray")
    pairs = pairs[np.einsum("ni,ni->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) > -0.5]
    crowding = (1.0 - np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) / reach) ** 8
    total = len(points)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.argsort(both[:, 0], kind="stable")
    neighbor = both[order, 1].tolist()
    share = np.concatenate([crowding, crowding])[order].tolist()
    start = np.searchsorted(both[order, 0], np.arange(total + 1)).tolist()
    weight = np.bincount(both[:, 0], np.concatenate([crowding, crowding]), minlength=total).tolist()
    heap = [(-w, i) for i, w in enumerate(weight)]
    heapq.heapify(heap)
    alive = [True] * total
    left = total
    while left > count:
        negative, i = heapq.heappop(heap)
        if not alive[i] or -negative != weight[i]:
            continue  # an entry from before a neighbour was removed
        alive[i] = False
        left -= 1
        for k in range(start[i], start[i + 1]):
            j = neighbor[k]
            if alive[j]:
                weight[j] -= share[k]
                heapq.heappush(heap, (-weight[j], j))
    return np.flatnonzero(alive)


def _nearest(
    points: NDArray[np.float64], normals: NDArray[np.float64], kept: NDArray[np.int64], spacing: float
) -> NDArray[np.int64]:
    """Return for every point the nearest kept one, by a distance in which opposite sides of a sheet are far apart."""
    lifted = np.concatenate([points, spacing * normals], axis=1)
    return np.asarray(KDTree(lifted[kept]).query(lifted)[1], dtype=np.int64)
