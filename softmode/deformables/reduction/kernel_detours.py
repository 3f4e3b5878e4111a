"""How much farther than the straight line the way from a kernel to a place is, through an object's octants.

A straight line is a way where it leaves the material for less than a quarter of an octant. Else the way turns beside
inner edges of the grid: it is the shortest one over the places where ways turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from softmode.deformables.body.detours import WIDTH, Detours
from softmode.deformables.quadrature.octants import Octants

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

POWER = 3.0
"""A way that is s times as long as the straight line counts as s to this power times as long (the diffraction method's
parameter): beyond a corner kernels fall off faster."""
LEAST = 0.15
"""Where no detour is longer than this fraction of a kernel's support, all lines are straight: an object that is all but
convex, as a ball of splats, has some of 0.11, since its grid drops octants that are hardly filled."""


def find_detours(octants: Octants, centres: Array, support: Array) -> Detours | None:
    """Return how much longer than straight lines kernels' ways are; None if no way is much longer.

    Args:
        octants: The object's octants.
        centres: Kernel centres, points of the material [m], shape (K, 3).
        support: Support radii [m], shape (K,).
    """
    if octants.convex:
        return None
    kernel, octant, direct, added = _longer(octants, centres, support)
    if not (added > LEAST * support[kernel])[direct < support[kernel]].any():
        return None
    return _table(octants, kernel, octant, added)


def more_detours(octants: Octants, found: Detours, centres: Array, support: Array, first: int) -> Detours:
    """Return detours with those of further kernels, from the first of these on; arguments as of `find_detours`."""
    kernel, octant, _, added = _longer(octants, centres[first:], support[first:])
    more = _table(octants, kernel + first, octant, added)
    return replace(
        found,
        pairs=np.concatenate([found.pairs, more.pairs]),
        lengths=np.concatenate([found.lengths, more.lengths]),
    )


def _table(octants: Octants, kernel: Indices, octant: Indices, added: Array) -> Detours:
    """Return detours from kernel, octant and length of every pair."""
    pairs = (kernel * len(octants.points) + octant).astype(np.int64)
    return Detours(points=octants.points, frame=octants.frame, pairs=pairs, lengths=added.astype(np.float32))


def _longer(octants: Octants, centres: Array, support: Array) -> tuple[Indices, Indices, Array, Array]:
    """Return kernel, octant, distance [m] and what is added to it [m] of every pair whose way is not straight, (D,)."""
    homes = octants.homes(centres)
    own = np.clip(octants.coordinates(centres), octants.place[homes] + 1e-3, octants.place[homes] + 0.999)
    straight = _distances(centres, octants.points)
    reach = support + WIDTH * float(octants.steps.max())
    kernel, octant = np.nonzero((straight < reach[:, None]) & (octants.part[homes][:, None] == octants.part))
    hidden = ~octants.sees(own[kernel], octants.own[octant])
    kernel, octant = kernel[hidden], octant[hidden]
    direct, most = straight[kernel, octant], reach[kernel]
    # A longer way would count as longer than the reach.
    length = _shortest(octants, own, centres, kernel, octant, np.cbrt(most * direct**2))
    ratio = np.maximum(length, direct) / np.maximum(direct, 1e-300)
    added = np.minimum(direct * (np.minimum(ratio, 1e3) ** POWER - 1.0), most - direct)
    real = added > 1e-3 * most
    return kernel[real], octant[real], direct[real], added[real]


def _shortest(octants: Octants, own: Array, centres: Array, kernel: Indices, octant: Indices, limit: Array) -> Array:
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
    if not (len(turns.places) and len(octant)):
        return length
    to_turns = _ways_to_turns(octants, own, centres, float(limit.max()))
    some, which = np.unique(octant, return_inverse=True)
    away = _distances(octants.points[some], turns.positions)
    away[turns.slack(octants.own[some])] = np.inf
    groups = []
    for pairs in np.split(np.arange(len(kernel)), np.flatnonzero(np.diff(kernel)) + 1):
        near = np.flatnonzero(to_turns[kernel[pairs[0]]] < limit[pairs].max())
        groups.append((pairs, np.ix_(which[pairs], near), to_turns[kernel[pairs[0]], near]))
    wanted = np.zeros(away.shape, dtype=bool)
    for pairs, at, way in groups:
        wanted[at] |= away[at] + way < limit[pairs, None]
    i, j = np.nonzero(wanted)
    seen = octants.sees(octants.own[some[i]], turns.places[j])
    away[~wanted] = np.inf
    away[i[~seen], j[~seen]] = np.inf
    for pairs, at, way in groups:
        length[pairs] = (away[at] + way).min(axis=1, initial=np.inf)
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
