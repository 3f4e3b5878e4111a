"""What kernels see: lines and paths through an object's material, and kernels where too few are left.

The material is the octants of the quadrature's grid. Two of them touch where they share a face, and also where they
share an edge or a corner alone, as finite elements of the same bricks share the nodes there. So a gap is seen where an
octant, half a cell, lies empty; a narrower one is not. A straight line is a way where it leaves the material for less
than a quarter of an octant. Else the way turns at octants beside inner edges. Kernels still act across the gaps between
parts of an object that touch nowhere, which would drift apart otherwise.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from softmode.deformables.body.detours import WIDTH, Detours
from softmode.deformables.body.rkpm import REACH, BasisRKPM
from softmode.deformables.build.quadrature_grid import Cells
from softmode.deformables.build.visibility import components, touching

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

POWER = 3.0
"""A way that is s times as long as the straight line counts as s to this power times as long (the diffraction method's
parameter): beyond a corner kernels fall off faster."""
GRAZING = 0.25
"""A line may leave the material for this many octants: a convex object's drops what is hardly filled."""
CONDITION_LEAST = 1e5
"""Where the condition number of the moment matrix is larger, kernels are added."""
ROUNDS = 8
"""Most rounds of adding kernels."""
LEAST = 0.15
"""Where no detour is longer than this fraction of a kernel's support, all lines are straight: a convex object along no
axis of the grid has some of 0.11 at most, since its grid drops octants that it hardly fills."""
TURN = 0.49
"""How far from the middle of an octant ways turn, towards an inner edge on its border."""
_LINES_PER_CHUNK = 100_000


@dataclass(frozen=True, kw_only=True)
class Octants:
    """The octants of an object and which of them touch."""

    points: Array
    """Their centroids [m], shape (N, 3)."""
    place: NDArray[np.int64]
    """Their places in the grid of octants, at least 1, shape (N, 3)."""
    borders: tuple[Array, Array, Array]
    """Borders of the octants along each axis, one more than places, from place 0 on [m]."""
    links: Indices
    """Pairs that touch, the lower one first, shape (E, 2)."""
    severed: Indices
    """Pairs of neighbours that a cut divides, likewise, shape (C, 2)."""

    @cached_property
    def part(self) -> Indices:
        """Part of the object that each octant belongs to, shape (N,); kernels act across the gaps between parts."""
        return components(len(self.points), self.links)

    @cached_property
    def steps(self) -> Array:
        """Edges of an octant [m], shape (3,)."""
        return np.array([np.median(np.diff(line)) for line in self.borders])

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates of positions (M, 3) [m] in the grid: an octant begins at its place."""
        return np.stack([np.interp(x[:, d], line, np.arange(len(line))) for d, line in enumerate(self.borders)], axis=1)

    @cached_property
    def grid(self) -> Indices:
        """Octant at each place, -1 where there is none."""
        found = np.full(self.place.max(axis=0) + 2, -1)
        found[tuple(self.place.T)] = np.arange(len(self.place))
        return found

    @cached_property
    def own(self) -> Array:
        """Coordinates of the octants, shape (N, 3)."""
        return np.clip(self.coordinates(self.points), self.place + 1e-3, self.place + 1.0 - 1e-3)

    def positions(self, coordinates: Array) -> Array:
        """Return the positions [m] of grid coordinates (M, 3)."""
        found: Array = np.stack(
            [np.interp(coordinates[:, d], np.arange(len(line)), line) for d, line in enumerate(self.borders)], axis=1
        )
        return found

    def homes(self, x: Array) -> Indices:
        """Return the octant that each of some points of the material (M, 3) [m] lies in."""
        return np.asarray(KDTree(self.points / self.steps).query(x / self.steps)[1])

    def sees(self, a: Array, b: Array) -> Mask:
        """Return between which of the pairs of grid coordinates (M, 3) a straight line runs through the material."""
        found = self._filled(np.minimum(a, b).astype(int), np.maximum(a, b).astype(int))
        left = np.flatnonzero(~found)
        for i in range(0, len(left), _LINES_PER_CHUNK):
            some = left[i : i + _LINES_PER_CHUNK]
            found[some] = self._clear(a[some], b[some])
        return found

    @cached_property
    def turns(self) -> Array:
        """Grid coordinates where ways turn: inner edges, contacts of edges and corners, ends of cuts, shape (T, 3)."""
        grid, at = self.grid, self.place
        shape = np.array(grid.shape)
        stride = np.array([shape[1] * shape[2], shape[2], 1])
        flat, home = grid.ravel(), at @ stride
        a, b = self.links.T
        contact = np.abs(at[a] - at[b]).sum(axis=1) > 1
        found = [0.5 * (at[a[contact]] + at[b[contact]]) + 0.5]
        cut = np.sort(self.severed, axis=1) @ np.array([len(at), 1])

        def open_(i: Indices, j: Indices) -> Mask:
            return (i >= 0) & (j >= 0) & ~np.isin(np.minimum(i, j) * len(at) + np.maximum(i, j), cut)

        every = np.arange(len(at))
        for a, b in itertools.combinations(range(3), 2):
            for up, right in itertools.product((1, -1), repeat=2):
                one, two = flat[home + up * stride[a]], flat[home + right * stride[b]]
                far = flat[home + up * stride[a] + right * stride[b]]
                links = np.stack([open_(every, one), open_(every, two), open_(one, far), open_(two, far)])
                bent = np.flatnonzero(((far < 0) & links[:2].all(axis=0)) | ((far >= 0) & (links.sum(axis=0) == 3)))
                corner = at[bent] + 0.5
                corner[:, a] += up * TURN
                corner[:, b] += right * TURN
                found.append(corner)
        turns: Array = np.unique(np.concatenate(found).astype(np.float64), axis=0)
        return turns

    @cached_property
    def _sums(self) -> NDArray[np.int64]:
        """Octants missing, or beside a cut, below and left of each place."""
        bad = (self.grid < 0).astype(np.int64)
        bad[tuple(self.place[self.severed.ravel()].T)] = 1
        return np.pad(bad.cumsum(0).cumsum(1).cumsum(2), ((1, 0), (1, 0), (1, 0)))

    def _filled(self, low: Indices, high: Indices) -> Mask:
        """Return which boxes of places, ends included, hold all octants."""
        total = np.zeros(len(low), dtype=np.int64)
        for corner in itertools.product((0, 1), repeat=3):
            pick = [np.where(corner[d], high[:, d] + 1, low[:, d]) for d in range(3)]
            total += (-1) ** (3 - sum(corner)) * self._sums[tuple(pick)]
        return total == 0

    def _clear(self, a: Array, b: Array) -> Mask:
        """Return which lines leave the material for a quarter of an octant at most: octant by octant along each."""
        stride = np.array([self.grid.shape[1] * self.grid.shape[2], self.grid.shape[2], 1])
        way = b - a
        length = np.sqrt(np.einsum("nd,nd->n", way, way))
        with np.errstate(divide="ignore", invalid="ignore"):
            per = 1.0 / np.abs(way)
            ahead = np.where(way > 0.0, np.ceil(a) - a, a - np.floor(a)) * per
        ahead[way == 0.0] = np.inf
        at, towards = a.astype(int) @ stride, np.where(way > 0.0, stride, -stride)
        lines = np.arange(len(a))
        missing, outside, since = self.grid.ravel() < 0, np.zeros(len(a)), np.zeros(len(a))
        clear = np.zeros(len(a), dtype=bool)
        while len(lines):
            axis = ahead.argmin(axis=1)
            pick = np.arange(len(lines)), axis
            until = np.minimum(ahead[pick], 1.0)
            outside += np.where(missing[at], (until - since) * length, 0.0)
            over, last = outside > GRAZING, until >= 1.0
            clear[lines[last & ~over]] = True
            at += towards[pick]
            ahead[pick] += per[pick]
            since = until
            if (done := over | last).any():
                left = np.flatnonzero(~done)
                lines, at, outside, since, length = (part[left] for part in (lines, at, outside, since, length))
                ahead, per, towards = ahead[left], per[left], towards[left]
        return clear


def octants_of(cells: Cells, offset: Array) -> Octants | None:
    """Return the octants of a grid less an offset (3,) [m]; None if their places in it are not known."""
    pair = touching(cells)
    if pair is None or cells.place is None or cells.borders is None:
        return None
    first = cells.place.min(axis=0)
    borders = [
        line[np.isfinite(line)][low:] - offset[d]
        for d, (line, low) in enumerate(zip(cells.borders, first, strict=True))
    ]
    before = [np.concatenate([[2.0 * line[0] - line[1]], line, [2.0 * line[-1] - line[-2]]]) for line in borders]
    return Octants(
        points=cells.octants - offset,
        place=cells.place - first + 1,
        borders=(before[0], before[1], before[2]),
        links=pair,
        severed=np.zeros((0, 2), dtype=np.intp) if cells.severed is None else cells.severed,
    )


def follow_material(kernels: BasisRKPM, octants: Octants, points: Array, spacing: float) -> BasisRKPM:
    """Return kernels whose distances run through the material, and more of them where too few are left.

    Args:
        kernels: Kernels whose distances are straight lines.
        octants: The object's octants.
        points: What must be covered: quadrature points [m], shape (P, 3).
        spacing: Their spacing [m].

    Warns:
        RuntimeWarning: If parts of the object are too thin for that; then kernels act across gaps.
    """
    divided = replace(kernels, detours=find_detours(octants, kernels.centres, kernels.support))
    if divided.detours is None:
        return kernels
    for _ in range(ROUNDS):
        distance, nearest = divided.nearest(points)
        ratio = distance / divided.support[nearest]
        bare = np.flatnonzero((ratio > REACH) | ~(divided.conditions(points) < CONDITION_LEAST))
        if not len(bare):
            return divided
        added = []
        while len(bare):
            worst = bare[ratio[bare].argmax()]
            added.append(worst)
            away = np.linalg.norm(points[bare] - points[worst], axis=1)
            bare = bare[away > REACH * divided.support[nearest[worst]]]
        centres = np.concatenate([divided.centres, points[added]])
        radii = np.concatenate([divided.radii, np.maximum(distance[added], 1.5 * spacing)])
        divided = replace(divided, centres=centres, radii=radii, detours=None)
        divided = replace(divided, detours=find_detours(octants, centres, divided.support))
    if divided.covered(points).all():
        return divided
    warnings.warn(
        "the object's parts are too thin beside its gaps for its quadrature: kernels act across the gaps; build it with"
        " more points",
        RuntimeWarning,
        stacklevel=2,
    )
    return kernels


def find_detours(octants: Octants, centres: Array, support: Array) -> Detours | None:
    """Return how much longer than straight lines kernels' ways are; None if all of them are straight.

    Args:
        octants: The object's octants.
        centres: Kernel centres, points of the material [m], shape (K, 3).
        support: Support radii [m], shape (K,).
    """
    count, margin = len(octants.points), WIDTH * float(octants.steps.max())
    homes = octants.homes(centres)
    own = np.clip(octants.coordinates(centres), octants.place[homes] + 1e-3, octants.place[homes] + 0.999)
    straight = _distances(octants.points, centres)
    reach = support + margin
    octant, kernel = np.nonzero((straight < reach) & (octants.part[:, None] == octants.part[homes]))
    clear = octants.sees(octants.own[octant], own[kernel])
    hidden_octant, hidden_kernel = octant[~clear], kernel[~clear]
    if not len(hidden_octant):
        return None
    turns = octants.turns
    at, limit = octants.positions(turns), float(reach.max())
    by_turn = _ways_to(octants, turns, at, own, centres, limit)
    seen, which = np.unique(hidden_octant, return_inverse=True)
    last = _seen(octants, octants.own[seen], octants.points[seen], turns, at, limit)
    length = np.full(len(which), np.inf)
    order = np.argsort(hidden_kernel, kind="stable")
    for some in np.split(order, np.flatnonzero(np.diff(hidden_kernel[order])) + 1):
        near = np.flatnonzero(np.isfinite(by_turn[hidden_kernel[some[0]]]))
        ways = last[np.ix_(which[some], near)] + by_turn[hidden_kernel[some[0]], near]
        length[some] = ways.min(axis=1, initial=np.inf)
    direct = straight[hidden_octant, hidden_kernel]
    ratio = np.maximum(length, direct) / np.maximum(direct, 1e-300)
    limit = reach[hidden_kernel] - direct
    added = np.minimum(direct * (np.minimum(ratio, 1e3) ** POWER - 1.0), limit)
    real = added > 1e-3 * reach[hidden_kernel]
    if not (added > LEAST * reach[hidden_kernel])[direct < support[hidden_kernel]].any():
        return None
    key = hidden_kernel[real] * count + hidden_octant[real]
    order = np.argsort(key)
    return Detours(
        points=octants.points,
        steps=octants.steps,
        pairs=key[order].astype(np.int64),
        lengths=added[real][order].astype(np.float32),
    )


def _ways_to(octants: Octants, turns: Array, at: Array, own: Array, centres: Array, limit: float) -> Array:
    """Return the lengths of ways from kernels to places where ways turn [m], (K, T); infinite beyond a limit."""
    count, size = len(turns), len(turns) + len(own)
    between = _seen(octants, turns, at, turns, at, limit)
    first = _seen(octants, own, centres, turns, at, limit)
    (a, b), (kernel, turn) = np.nonzero(np.isfinite(between) & (between > 0.0)), np.nonzero(np.isfinite(first))
    entries = np.concatenate([between[a, b], np.maximum(first[kernel, turn], 1e-12)])
    places = np.concatenate([a, count + kernel]), np.concatenate([b, turn])
    graph = coo_matrix((entries, places), shape=(size, size)).tocsr()
    return np.asarray(dijkstra(graph, indices=np.arange(count, size), limit=limit))[:, :count]


def _seen(octants: Octants, a: Array, x: Array, b: Array, y: Array, limit: float) -> Array:
    """Return the distances [m] between places that see each other within a limit, else infinity, (M, T).

    Args:
        octants: The object's octants.
        a: Grid coordinates, shape (M, 3).
        x: Their positions [m], shape (M, 3).
        b: Grid coordinates, shape (T, 3).
        y: Their positions [m], shape (T, 3).
        limit: Largest distance [m].
    """
    away = _distances(x, y)
    i, j = np.nonzero(away < limit)
    clear = octants.sees(a[i], b[j])
    found = np.full(away.shape, np.inf)
    found[i[clear], j[clear]] = away[i[clear], j[clear]]
    return found


def _distances(a: Array, b: Array) -> Array:
    middle = b.mean(axis=0)
    a, b = a - middle, b - middle
    return np.sqrt(np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T), 0.0))
