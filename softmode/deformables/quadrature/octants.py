"""The octants of an object: which touch, what sees what in straight lines, and where ways around corners turn.

Octants are the eighths of the cells of the quadrature's grid. Two of them touch where they share a face, and also where
they share an edge or a corner alone, as finite elements of the same bricks share the nodes there. So a gap is seen
where an octant, half a cell, lies empty; a narrower one is not.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from softmode.deformables.quadrature.quadrature_grid import Cells

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

GRAZING = 0.25
"""A line may leave the material for this many octants: the grid drops octants that are hardly filled."""
TURN = 0.49
"""How far from the middle of an octant ways turn, towards an inner edge on its border."""
SLACK = 0.02
"""How far behind an inner edge, in octants, a way need not turn there."""
TURNS = 1600
"""Where ways turn at more places, as in a gyroid, those are left out that lie near others."""
THINNED = (0.7, 1.0, 1.4, 2.0, 2.8)
"""How near [octants]: the first of these that leaves few enough, or the last."""
_LINES_PER_CHUNK = 100_000


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Places where ways through the material turn."""

    places: Array
    """Coordinates in the grid, shape (T, 3)."""
    walls: Array
    """Where the empty octant at the inner edge lies: signs along two axes, shape (T, 3); zeros at contacts."""
    positions: Array
    """Positions [m], shape (T, 3)."""

    def slack(self, coordinates: Array) -> Mask:
        """Return from which grid coordinates (M, 3) a way that turns could be shortened there, (M, T).

        From behind the edge, where both of its sides are in sight, it need not turn.
        """
        behind = np.ones((len(coordinates), len(self.places)), dtype=bool)
        for d in range(3):
            away = (coordinates[:, d, None] - self.places[:, d]) * self.walls[:, d]
            behind &= (away < -SLACK) | (self.walls[:, d] == 0.0)
        return behind & (self.walls != 0.0).any(axis=1)


@dataclass(frozen=True, kw_only=True)
class Octants:
    """The octants of an object and which of them touch."""

    points: Array
    """Their centroids [m], shape (N, 3)."""
    place: NDArray[np.int64]
    """Their places in the grid of octants, at least 1, shape (N, 3)."""
    borders: tuple[Array, Array, Array]
    """Borders of the octants along each axis of the grid, one more than places, from place 0 on [m]."""
    axes: Array
    """Axes of the grid, unit vectors in rows, shape (3, 3)."""
    links: Indices
    """Pairs that touch, the lower one first, shape (E, 2)."""

    @cached_property
    def part(self) -> Indices:
        """Part of the object that each octant belongs to, shape (N,); kernels act across the gaps between parts."""
        return components(len(self.points), self.links)

    @cached_property
    def convex(self) -> bool:
        """Whether no empty octant beside the object has its middle within the convex hull of the object's octants."""
        flat = self.grid < 0
        beside = np.zeros_like(flat)
        for axis, way in itertools.product(range(3), (1, -1)):
            beside |= np.roll(~flat, way, axis)
        try:
            hull = ConvexHull(self.points).equations
        except QhullError:
            return False
        middle = self.positions(np.argwhere(flat & beside).astype(np.float64) + 0.5)
        return not (middle @ hull[:, :3].T + hull[:, 3] < -1e-9).all(axis=1).any()

    @cached_property
    def steps(self) -> Array:
        """Edges of an octant [m], shape (3,)."""
        return np.array([np.median(np.diff(line)) for line in self.borders])

    @property
    def frame(self) -> Array:
        """What takes positions to coordinates in which octants are one apart, shape (3, 3) [1/m]."""
        return self.axes / self.steps[:, None]

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates of positions (M, 3) [m] in the grid: an octant begins at its place."""
        along = x @ self.axes.T
        found = [np.interp(along[:, d], line, np.arange(len(line))) for d, line in enumerate(self.borders)]
        return np.stack(found, axis=1)

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
        along = [np.interp(coordinates[:, d], np.arange(len(line)), line) for d, line in enumerate(self.borders)]
        return np.stack(along, axis=1) @ self.axes

    def homes(self, x: Array) -> Indices:
        """Return the octant that each of some points of the material (M, 3) [m] lies in."""
        return np.asarray(KDTree(self.points @ self.frame.T).query(x @ self.frame.T)[1])

    def sees(self, a: Array, b: Array) -> Mask:
        """Return between which of the pairs of grid coordinates (M, 3) a straight line runs through the material."""
        found = self._filled(np.minimum(a, b).astype(int), np.maximum(a, b).astype(int))
        left = np.flatnonzero(~found)
        for i in range(0, len(left), _LINES_PER_CHUNK):
            some = left[i : i + _LINES_PER_CHUNK]
            found[some] = self._clear(a[some], b[some])
        return found

    @cached_property
    def turns(self) -> Turns:
        """Where ways turn: inner edges, and contacts of edges and corners."""
        grid, at = self.grid, self.place
        stride = np.array([grid.shape[1] * grid.shape[2], grid.shape[2], 1])
        flat, home = grid.ravel(), at @ stride
        a, b = self.links.T
        contact = np.abs(at[a] - at[b]).sum(axis=1) > 1
        middle = 0.5 * (at[a[contact]] + at[b[contact]]) + 0.5
        found = [np.concatenate([middle, np.zeros_like(middle)], axis=1)]
        for a, b in itertools.combinations(range(3), 2):
            for up, right in itertools.product((1, -1), repeat=2):
                wall = np.zeros(3)
                wall[[a, b]] = up, right
                there = [flat[home + wall.astype(int) @ (stride * axes)] >= 0 for axes in np.eye(3, dtype=int)[[a, b]]]
                bent = np.flatnonzero(there[0] & there[1] & (flat[home + wall.astype(int) @ stride] < 0))
                found.append(np.concatenate([at[bent] + 0.5 + TURN * wall, np.tile(wall, (len(bent), 1))], axis=1))
        places = _thinned(np.unique(np.concatenate(found).astype(np.float64), axis=0))
        return Turns(places=places[:, :3], walls=places[:, 3:], positions=self.positions(places[:, :3]))

    @cached_property
    def _sums(self) -> NDArray[np.int64]:
        """Octants missing below and left of each place."""
        bad = (self.grid < 0).astype(np.int64)
        return np.pad(bad.cumsum(0).cumsum(1).cumsum(2), ((1, 0), (1, 0), (1, 0)))

    def _filled(self, low: Indices, high: Indices) -> Mask:
        """Return which boxes of places, ends included, hold all octants."""
        ends, total = (low, high + 1), np.zeros(len(low), dtype=np.int64)
        for corner in itertools.product((0, 1), repeat=3):
            x, y, z = (ends[end][:, d] for d, end in enumerate(corner))
            total += (-1) ** (3 - sum(corner)) * self._sums[x, y, z]
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
            pick = np.arange(len(lines)), ahead.argmin(axis=1)
            until = np.minimum(ahead[pick], 1.0)
            outside += np.where(missing[at], (until - since) * length, 0.0)
            over, last = outside > GRAZING, until >= 1.0
            clear[lines[last & ~over]] = True
            at += towards[pick]
            ahead[pick] += per[pick]
            since = until
            if (done := over | last).any():
                left = np.flatnonzero(~done)
                lines, at, towards = lines[left], at[left], towards[left]
                outside, since, length = outside[left], since[left], length[left]
                ahead, per = ahead[left], per[left]
        return clear


def touching(cells: Cells) -> Indices | None:
    """Return the pairs of octants of a grid that touch, the lower one first (E, 2); None if their places are not known.

    Two touch where they share a face; where they share an edge or a corner, unless others between link them.
    """
    if cells.place is None:
        return None
    place = cells.place - cells.place.min(axis=0) + 1
    shape = place.max(axis=0) + 2
    stride = np.array([shape[1] * shape[2], shape[2], 1])
    at = np.full(shape.prod(), -1)
    at[place @ stride] = np.arange(len(place))
    pairs = []
    for towards in itertools.product((-1, 0, 1), repeat=3):
        if towards <= (0, 0, 0):
            continue
        steps = np.array(towards) * stride
        other = at[place @ stride + steps.sum()]
        touch = other >= 0
        if np.count_nonzero(towards) > 1:
            for step in steps[steps != 0]:
                touch &= at[place @ stride + step] < 0
        pairs.append(np.stack([np.flatnonzero(touch), other[touch]], axis=1))
    pair = np.sort(np.concatenate(pairs), axis=1)
    if cells.severed is None:
        return pair
    key = np.array([len(place), 1])
    return pair[~np.isin(pair @ key, cells.severed @ key)]


def octants_of(cells: Cells, offset: Array) -> Octants | None:
    """Return the octants of a grid less an offset (3,) [m], cell by cell; None if their places in it are not known.

    Cuts are not seen.
    """
    if cells.place is None or cells.borders is None:
        return None
    order = np.argsort(cells.of_octant, kind="stable")
    whole = replace(
        cells, octants=cells.octants[order], place=cells.place[order], of_octant=cells.of_octant[order], severed=None
    )
    links = touching(whole)
    assert links is not None and whole.place is not None  # Their places are known.
    first = whole.place.min(axis=0)
    axes, lines = np.eye(3) if cells.axes is None else cells.axes, []
    for d, (line, low) in enumerate(zip(cells.borders, first, strict=True)):
        known = line[np.isfinite(line)][low:] - axes[d] @ offset
        lines.append(np.concatenate([[2.0 * known[0] - known[1]], known, [2.0 * known[-1] - known[-2]]]))
    return Octants(
        points=whole.octants - offset,
        place=whole.place - first + 1,
        borders=(lines[0], lines[1], lines[2]),
        axes=axes,
        links=links,
    )


def components(count: int, pairs: Indices) -> Indices:
    """Return the connected component of each of some nodes, from pairs of them (E, 2)."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.intp)


def _thinned(places: Array) -> Array:
    """Return so many of some places (T, 3 or more) that each lies near one of them."""
    found = places
    for radius in THINNED:
        if len(found) <= TURNS:
            break
        left, kept = np.ones(len(places), dtype=bool), []
        near = KDTree(places[:, :3]).query_ball_point(places[:, :3], radius)
        for i in range(len(places)):
            if left[i]:
                kept.append(i)
                left[near[i]] = False
        found = places[kept]
    return found
