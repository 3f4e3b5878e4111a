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
SLACK = 0.02
"""How far behind an inner edge, in octants, a way need not turn there."""
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
    """Borders of the octants along each axis, one more than places, from place 0 on [m]."""
    links: Indices
    """Pairs that touch, the lower one first, shape (E, 2)."""

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
        places = np.unique(np.concatenate(found), axis=0)
        return Turns(places=places[:, :3], walls=places[:, 3:], positions=self.positions(places[:, :3]))

    @cached_property
    def _sums(self) -> NDArray[np.int64]:
        """Octants missing below and left of each place."""
        bad = (self.grid < 0).astype(np.int64)
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
    straight = _distances(centres, octants.points)
    reach = support + margin
    kernel, octant = np.nonzero((straight < reach[:, None]) & (octants.part[homes][:, None] == octants.part))
    hidden = ~octants.sees(own[kernel], octants.own[octant])
    kernel, octant = kernel[hidden], octant[hidden]
    if not len(kernel):
        return None
    direct, most = straight[kernel, octant], reach[kernel]
    # A longer way would count as longer than the reach.
    length = _shortest(octants, own, centres, kernel, octant, np.cbrt(most * direct**2))
    ratio = np.maximum(length, direct) / np.maximum(direct, 1e-300)
    added = np.minimum(direct * (np.minimum(ratio, 1e3) ** POWER - 1.0), most - direct)
    if not (added > LEAST * most)[direct < support[kernel]].any():
        return None
    real = added > 1e-3 * most
    return Detours(
        points=octants.points,
        steps=octants.steps,
        pairs=(kernel * count + octant)[real].astype(np.int64),
        lengths=added[real].astype(np.float32),
    )


def _shortest(
    octants: Octants, own: Array, centres: Array, kernel: Indices, octant: Indices, limit: Array
) -> Array:
    """Return the lengths of the shortest ways between kernels and octants that do not see each other [m], (H,).

    Args:
        octants: The object's octants.
        own: Grid coordinates of the kernels, shape (K, 3).
        centres: Their positions [m], shape (K, 3).
        kernel: Kernel of each pair, ascending, shape (H,).
        octant: Octant of each pair, shape (H,).
        limit: Longer ways need not be found [m], shape (H,).
    """
    turns, length = octants.turns, np.full(len(octant), np.inf)
    if not len(turns.places):
        return length
    to_turns = _ways_to_turns(octants, own, centres, float(limit.max()))
    some, which = np.unique(octant, return_inverse=True)
    away = _distances(octants.points[some], turns.positions)
    away[turns.slack(octants.own[some])] = np.inf
    groups = np.split(np.arange(len(octant)), np.flatnonzero(np.diff(kernel)) + 1)
    wanted = np.zeros(away.shape, dtype=bool)
    ways = []
    for pairs in groups:
        near = np.flatnonzero(to_turns[kernel[pairs[0]]] < limit[pairs].max())
        at = np.ix_(which[pairs], near)
        way = away[at] + to_turns[kernel[pairs[0]], near]
        wanted[at] |= way < limit[pairs][:, None]
        ways.append((at, way))
    i, j = np.nonzero(wanted)
    hidden = ~octants.sees(octants.own[some[i]], turns.places[j])
    wanted[i[hidden], j[hidden]] = False
    for pairs, (at, way) in zip(groups, ways, strict=True):
        length[pairs] = np.where(wanted[at], way, np.inf).min(axis=1, initial=np.inf)
    return length


def _ways_to_turns(octants: Octants, own: Array, centres: Array, limit: float) -> Array:
    """Return the lengths of ways from kernels to places where ways turn [m], (K, T); infinite beyond a limit."""
    turns = octants.turns
    count, size = len(turns.places), len(turns.places) + len(own)
    slack = turns.slack(turns.places)
    between = _distances(turns.positions, turns.positions)
    a, b = np.nonzero(np.triu((between < limit) & ~slack & ~slack.T, 1))
    clear = octants.sees(turns.places[a], turns.places[b])
    a, b = a[clear], b[clear]
    first = _distances(centres, turns.positions)
    kernel, turn = np.nonzero((first < limit) & ~turns.slack(own))
    clear = octants.sees(own[kernel], turns.places[turn])
    kernel, turn = kernel[clear], turn[clear]
    entries = np.concatenate([between[a, b], between[a, b], first[kernel, turn]])
    places = np.concatenate([a, b, count + kernel]), np.concatenate([b, a, turn])
    graph = coo_matrix((np.maximum(entries, 1e-12), places), shape=(size, size)).tocsr()
    return np.asarray(dijkstra(graph, indices=np.arange(count, size), limit=limit))[:, :count]


def _distances(a: Array, b: Array) -> Array:
    middle = b.mean(axis=0)
    a, b = a - middle, b - middle
    return np.sqrt(np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T), 0.0))
