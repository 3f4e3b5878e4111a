"""What kernels act on: paths through the graph of an object's material, and kernels where too few are left.

The points of the graph are the octants of the quadrature's grid. Kernels still act across the gaps between parts of
an object that touch nowhere, which would drift apart otherwise.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.rkpm import REACH, BasisRKPM
from softmode.deformables.body.visibility import Visibility
from softmode.deformables.quadrature.octants import Octants, components, touching
from softmode.deformables.quadrature.quadrature_grid import Cells
from softmode.deformables.reduction.kernel_detours import find_detours, more_detours

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

NARROWER = (0.6, 0.7, 0.8, 0.9, 1.0)
"""Supports that are tried for a kernel, as a fraction of what it has."""
CONDITION_LEAST = 1e5
"""Where the condition number of the moment matrix is larger, kernels are added."""
ROUNDS = 8
"""Most rounds of adding kernels."""
_ENTRIES_PER_CHUNK = 8_000_000


@dataclass(frozen=True, kw_only=True)
class Material:
    """The graph of an object's points, in lumps that no gap divides."""

    points: Array
    """Positions [m], lump by lump, shape (N, 3)."""
    first: Indices
    """First point of each lump, ascending from 0, shape (L,)."""
    links: Indices
    """Pairs of lumps that touch, shape (E, 2)."""
    part: Indices
    """Part of the object that each lump belongs to, shape (L,); kernels act across the gaps between parts."""
    step: float
    """Largest distance between points that touch [m]."""
    cut: bool = False
    """Whether some points are neighbours that a cut divides."""

    def distances(self, centres: Array) -> tuple[Array, Array]:
        """Return the squared distances of points [m^2] (N, K), and of lumps (L, K), to centres (K, 3)."""
        origin = centres.mean(axis=0)
        a, b = self.points - origin, centres - origin
        square = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T)
        return square, np.minimum.reduceat(square, self.first)

    def homes(self, centres: Array) -> Indices:
        """Return the lump that each of some places (K, 3) [m] lies in."""
        return np.asarray(np.searchsorted(self.first, KDTree(self.points).query(centres)[1], "right") - 1)

    def apart(self, near: Mask, homes: Indices) -> Mask:
        """Return which lumps within the supports of kernels are not connected there with the kernels' centres.

        Args:
            near: Which lumps each support reaches, shape (L, K).
            homes: Lump of each centre, shape (K,).
        """
        lump, kernel = np.nonzero(near)
        node = np.full(near.shape, -1)
        node[lump, kernel] = np.arange(len(lump))
        link, at = np.nonzero(near[self.links[:, 0]] & near[self.links[:, 1]])
        label = components(len(lump), node[self.links[link], at[:, None]])
        own = label[node[homes, np.arange(len(homes))]]
        found = np.zeros_like(near)
        found[lump, kernel] = (label != own[kernel]) & (self.part[lump] == self.part[homes][kernel])
        return found


def material_of(cells: Cells, offset: Array) -> Material | None:
    """Return the graph of the octants of a grid less an offset (3,) [m]; None if their places in it are not known."""
    pair = touching(cells)
    if pair is None:
        return None
    order = np.argsort(cells.of_octant, kind="stable")
    points = cells.octants[order] - offset
    # The octants of a full cell are one lump, which makes the graph eight times smaller; not of one that is cut.
    size = np.bincount(cells.of_octant)
    if cells.severed is not None:
        size[cells.of_octant[cells.severed]] = 0
    cell = cells.of_octant[order]
    begins = (size[cell] < 8) | np.append(True, cell[1:] != cell[:-1])
    lump = np.empty(len(order), dtype=np.intp)
    lump[order] = np.cumsum(begins) - 1
    links = np.unique(np.sort(lump[pair], axis=1), axis=0)
    links = links[links[:, 0] < links[:, 1]]
    step = float(np.linalg.norm(cells.octants[pair[:, 0]] - cells.octants[pair[:, 1]], axis=1).max(initial=0.0))
    return Material(
        points=points,
        first=np.flatnonzero(begins),
        links=links,
        part=components(int(lump.max()) + 1, links),
        step=step,
        cut=cells.severed is not None,
    )


def lips_of(cells: Cells | None) -> Array:
    """Return the octants on both sides of the slits in a grid [m], shape (N, 3)."""
    if cells is None or cells.severed is None:
        return np.zeros((0, 3))
    return cells.octants[np.unique(cells.severed)]


def divide_at_gaps(
    kernels: BasisRKPM, material: Material, points: Array, spacing: float, octants: Octants | None = None
) -> BasisRKPM:
    """Return kernels that reach around gaps and corners, or do not act across gaps, and more where too few are left.

    With octants kernels see distances through the material where it has inner corners. Else, and at cuts, which that
    does not see, a kernel acts on what is connected to its centre within its support. Beside the end of a gap that
    would hold both sides together as far as it reaches, so there a kernel is made narrower, until the sides are not
    connected within.

    Args:
        kernels: Kernels that act on all they reach.
        material: The graph of the object's points.
        points: What must be covered: quadrature points [m], shape (P, 3).
        spacing: Their spacing [m].
        octants: What distances run through; None: they are straight lines.

    Warns:
        RuntimeWarning: If parts of the object are too thin for that; then kernels act across gaps.
    """
    detours = None if octants is None else find_detours(octants, kernels.centres, kernels.support)
    found = _narrowing(material, kernels) if detours is None or material.cut else None
    if found is None and detours is None:
        return kernels
    divided, hidden = replace(kernels, detours=detours), None
    if found is not None:
        factor, hidden = found
        divided = replace(divided, radii=kernels.radii * factor, visibility=_visibility(material, hidden))
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
        first = divided.kernel_count
        divided = replace(
            divided,
            centres=np.concatenate([divided.centres, points[added]]),
            radii=np.concatenate([divided.radii, np.maximum(distance[added], 1.5 * spacing)]),
            visibility=None,
            detours=None,
        )
        if detours is not None and octants is not None:
            detours = more_detours(octants, detours, divided.centres, divided.support, first)
        if hidden is not None:  # Those before see what they saw.
            hidden += hidden_points(material, divided.centres, divided.support, first)
        divided = replace(
            divided, detours=detours, visibility=None if hidden is None else _visibility(material, hidden)
        )
    if detours is not None:
        return divided if divided.covered(points).all() else divide_at_gaps(kernels, material, points, spacing)
    warnings.warn(
        "the object's parts are too thin beside its gaps for its quadrature: kernels act across the gaps; build it with"
        " more points",
        RuntimeWarning,
        stacklevel=2,
    )
    return kernels


def _visibility(material: Material, hidden: list[Indices]) -> Visibility | None:
    """Return what kernels do not act on, from pairs of a kernel and a point as one number; None without any."""
    return Visibility(points=material.points, hidden=np.sort(np.concatenate(hidden))) if hidden else None


def hidden_points(material: Material, centres: Array, support: Array, first: int = 0) -> list[Indices]:
    """Return the points that kernels from the first on reach and do not act on: kernel * N + point, chunk by chunk.

    Args:
        material: The graph of the object's points.
        centres: Kernel centres, points of the material [m], shape (K, 3).
        support: Support radii [m], shape (K,).
        first: The first of these kernels.
    """
    found = []
    for mine in _chunks(material, len(centres), first):
        points, lumps = material.distances(centres[mine])
        reach = (support[mine] + material.step) ** 2  # The nearest point to a place in the support lies within this.
        found += _pairs(material, points < reach, material.apart(lumps < reach, material.homes(centres[mine])), mine)
    return found


def _pairs(material: Material, near: Mask, apart: Mask, mine: slice) -> list[Indices]:
    """Return the near points (N, k) in lumps that are apart (L, k), of a chunk of kernels; none or one array."""
    if not apart.any():
        return []
    count = len(material.points)
    size = np.diff(np.append(material.first, count))
    point, kernel = np.nonzero(np.repeat(apart, size, axis=0) & near)
    return [(kernel + mine.start) * count + point]


def _narrowing(material: Material, kernels: BasisRKPM) -> tuple[Array, list[Indices]] | None:
    """Return the largest fraction of the support that connects no two sides of a gap; None if there is no gap.

    Sides that are not connected within a support may be within a larger one.

    Returns:
        The fractions (K,), and what the kernels do not act on with these supports, as `hidden_points` does.
    """
    factor, gaps, hidden = np.full(kernels.kernel_count, NARROWER[0]), False, []
    for mine in _chunks(material, kernels.kernel_count):
        homes, (points, lumps) = material.homes(kernels.centres[mine]), material.distances(kernels.centres[mine])
        good, before = np.ones(len(homes), dtype=bool), np.zeros(lumps.shape, dtype=bool)
        unseen = np.zeros(lumps.shape, dtype=bool)
        for fraction in NARROWER:
            near = lumps < (fraction * kernels.support[mine] + material.step) ** 2
            apart = material.apart(near, homes)
            good &= ~(before & near & ~apart).any(axis=0)
            factor[mine][good] = fraction
            unseen[:, good] = apart[:, good]
            before |= apart
        gaps |= bool(before.any())
        hidden += _pairs(material, points < (factor[mine] * kernels.support[mine] + material.step) ** 2, unseen, mine)
    return (factor, hidden) if gaps else None


def _chunks(material: Material, kernel_count: int, first: int = 0) -> list[slice]:
    step = max(1, _ENTRIES_PER_CHUNK // len(material.points))
    return [slice(i, min(i + step, kernel_count)) for i in range(first, kernel_count, step)]
