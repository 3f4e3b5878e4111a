"""Cuts: the bodies that are left of one after a patch has gone through it.

A cut severs the links between neighbouring octants of the quadrature's grid whose segment crosses the patch. What is
still connected is one part, and each part is built as any body is: a part with a slit has kernels that do not act
across the severed links (``visibility``). The quadrature points are those of the body, each in the part that its octant
belongs to; one whose octant the patch crosses is in two parts, by volume. So the parts have the body's mass and, after
:func:`softmode.deformables.carry_over`, its momentum to rounding.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.quadrature.octants import components, touching
from softmode.deformables.quadrature.quadrature_grid import Cells, Quadrature
from softmode.deformables.reduction.build_body import build_part
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.patch import Patch
from softmode.deformables.reduction.region_samples import pieces_near
from softmode.deformables.reduction.sources import Sources, unpack_sources
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CRUMB = 8
"""Parts of fewer quadrature points are dropped."""
NEIGHBOURS = 8
"""Octants among which that of a place is looked for."""
_SLIVER = 0.02
"""Less than this of an octant does not go to the other side."""
_LIP = 0.45
"""How far the lips of a slit reach from an octant towards its neighbour, so that each is nearest to its own."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cut:
    """What is left of a body."""

    bodies: tuple[ReducedBody, ...]
    """The connected parts, the heaviest first; the body itself where the patch misses it."""
    densities: tuple[float, ...]
    """Density of each over that of the body; ones unless the body's density varies."""
    crumbs: float
    """Fraction of the body's mass in parts of fewer than 8 quadrature points, which are dropped."""
    missed: bool
    """Whether the patch missed the body."""
    notes: tuple[str, ...]
    """What happened, in words."""
    faces: tuple[tuple[Array, Array], ...]
    """Points where links are severed, on the new surface of each part [m], and outward normals there; body frames."""
    owners: Callable[[Array], Indices]
    """Returns which body points (N, 3) [m] of the old body frame belong to, -1 for crumbs, shape (N,)."""
    levels: Callable[[Array], tuple[Array, Array]]
    """Returns the signed distance [m] (N,) to the patch, at rest, of points (N, 3) [m] of the old body frame, infinite
    for those that no link near them crosses, and the unit normals (N, 3)."""


def cut_body(
    body: ReducedBody,
    patch: Patch,
    q: ArrayLike | None = None,
    *,
    progress: bool | Callable[[str, float], None] | None = None,
) -> Cut:
    """Cut a body by a patch; motion goes over to the parts by :func:`softmode.deformables.carry_over`.

    It takes as long as the builds of the parts. Parts are told apart as finely as the octants of the quadrature's grid
    are: a part thinner than one, half a cell, is not.

    Args:
        body: A body that keeps its sources, see :func:`softmode.deformables.hold`.
        patch: What cuts: in asset coordinates, as regions are; with ``q`` in the world that ``q`` puts the body in.
        q: Coordinates [m] of the body where it is cut, shape (n, 3); None cuts it at rest.
        progress: As for :func:`build_body`.

    Raises:
        ConfigError: If the body keeps no sources or no grid, q has another shape, or the patch cuts an exact region.
        BasisError: If a part is too small for a body, or held as a whole.
        AssetError: If the sources are damaged.
    """
    given = unpack_sources(body)
    return _Cutter(body, given, patch, q).cut(progress)


class _Cutter:
    """A cut that is being made."""

    def __init__(self, body: ReducedBody, given: Sources, patch: Patch, q: ArrayLike | None) -> None:
        """Find what the patch severs, and the parts."""
        self.body, self.given, self.patch = body, given, patch
        self.q = None if q is None else np.asarray(q, dtype=np.float64)
        if self.q is not None and self.q.shape != (body.function_count, 3):
            raise ConfigError(f"q: expected shape ({body.function_count}, 3), got {self.q.shape}")
        cells = given.quadrature.cells
        links = None if cells is None else touching(cells)
        if cells is None or links is None:
            raise ConfigError(f"body {body.name!r} keeps no grid of its quadrature", hint="build it again")
        self.cells, self.count = cells, len(cells.octants)
        self.axes = _axes(cells)
        self.tree = KDTree(cells.octants)
        self.home = np.asarray(self.tree.query(given.quadrature.points)[1])
        self.place = self._placed(cells.octants)
        bridges = _bridges(cells.octants, components(self.count, links))
        every = np.concatenate([links, bridges])
        at, normal = patch.crossings(self.place[every[:, 0]], self.place[every[:, 1]])
        hit = np.isfinite(at)
        label = components(self.count, every[~hit])
        self.part, self.part_count, self.crumbs = self._sorted_parts(label)
        real = np.flatnonzero(hit[: len(links)])
        self.links, at, normal = links[real], at[real], normal[real]
        # Behind the patch first.
        swap = ((self.place[self.links[:, 1]] - self.place[self.links[:, 0]]) * normal).sum(axis=1) < 0.0
        self.links[swap], at[swap] = self.links[swap, ::-1], 1.0 - at[swap]
        self.at, self.hit = at, bool(hit.any())
        way = cells.octants[self.links[:, 1]] - cells.octants[self.links[:, 0]]
        self.crossing = cells.octants[self.links[:, 0]] + at[:, None] * way
        self.normal = self._rest_normals(self.crossing, normal)

    def _placed(self, X: Array) -> Array:
        """Return where asset points (N, 3) are cut [m]."""
        if self.q is None:
            return X
        rest = X - self.body.offset
        return rest + self.body.evaluate(rest)[0] @ self.q

    def _rest_normals(self, X: Array, normal: Array) -> Array:
        """Return the normals of the patch at rest (N, 3) from those where it cuts: F^T n."""
        if self.q is None or not len(X):
            return normal
        F = np.eye(3) + np.einsum("kc,nkd->ncd", self.q, self.body.evaluate(X - self.body.offset)[1])
        found = np.einsum("ncd,nc->nd", F, normal)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def _sorted_parts(self, label: Indices) -> tuple[Indices, int, float]:
        """Return the part of each octant, the heaviest first and -1 for crumbs, their number, the crumbs' fraction."""
        density = self.given.density_scale
        mass = self.given.quadrature.weights * (1.0 if density is None else density)
        count = np.bincount(self.home, minlength=self.count)
        points = np.bincount(label, count)
        weight = np.bincount(label[self.home], mass, minlength=len(points))
        kept = np.flatnonzero(points >= CRUMB)
        kept = kept[np.argsort(-weight[kept], kind="stable")]
        number = np.full(len(points), -1)
        number[kept] = np.arange(len(kept))
        return number[label], len(kept), float(weight[number < 0].sum() / mass.sum())

    def cut(self, progress: bool | Callable[[str, float], None] | None) -> Cut:
        """Build the parts."""
        body, given = self.body, self.given
        if not self.hit:
            face = (np.zeros((0, 3)), np.zeros((0, 3)))
            return self._cut((body,), (1.0,), (face,), (f"the patch misses {body.name!r}: nothing is cut",))
        if not self.part_count:
            raise BasisError(f"body {body.name!r}: all parts are crumbs", hint="build it with more points")
        self._refuse_exact_regions()
        every = np.ones(len(given.quadrature.points)) if given.density_scale is None else given.density_scale
        mean = float(given.quadrature.weights @ every) / given.quadrature.volume
        pieces = [self._part(part) for part in range(self.part_count)]
        regions = [self._regions(quadrature) for quadrature, _, _ in pieces]
        # One thread of BLAS each: their number decides the last bits.
        with threadpool_limits(1, "blas"), ThreadPoolExecutor(min(self.part_count, os.cpu_count() or 1)) as threads:
            waiting = [
                threads.submit(self._built, part, *pieces[part][:2], regions[part], progress)
                for part in range(self.part_count)
            ]
            made = [one.result() for one in waiting]
        bodies = [dataclasses.replace(one, provenance={**body.provenance, **one.provenance}) for one in made]
        densities = tuple(
            float(quadrature.weights @ every[points]) / quadrature.volume / mean for quadrature, points, _ in pieces
        )
        faces = tuple((X - one.offset, normals) for one, (_, _, (X, normals)) in zip(bodies, pieces, strict=True))
        kept = {region.name for some in regions for region in some}
        return self._cut(tuple(bodies), densities, faces, self._notes(bodies, kept))

    def _built(
        self,
        part: int,
        quadrature: Quadrature,
        points: Indices,
        regions: list[Region],
        progress: bool | Callable[[str, float], None] | None,
    ) -> ReducedBody:
        """Build a part."""
        given, whole = self.given, self.part_count == 1

        def own(field: Array | None) -> Array | None:
            return None if field is None else field[points]

        return build_part(
            quadrature,
            self._options(points),
            name=self.body.name if whole else f"{self.body.name} {part + 1}",
            regions=regions,
            fields=(own(given.stiffness_scale), own(given.density_scale), own(given.poissons_ratio)),
            progress=progress,
        )

    def _options(self, points: Indices) -> BuildOptions:
        """Return the options of the part that has some quadrature points, with the added kernels that lie in it."""
        options, every = self.given.options, self.given.quadrature.points
        places = np.array([np.asarray(place) for place, _ in options.add_kernels]).reshape(-1, 3)
        inside = np.isin(KDTree(every).query(places)[1], points)
        own = tuple(pair for pair, there in zip(options.add_kernels, inside, strict=True) if there)
        return dataclasses.replace(options, add_kernels=own)

    def _notes(self, bodies: list[ReducedBody], kept: set[str]) -> tuple[str, ...]:
        """Return what happened, from the parts and the regions that any of them has."""
        name = self.body.name
        if len(bodies) > 1:
            shares = ", ".join(f"{made.volume / self.body.volume:.1%}" for made in bodies)
            notes = [f"{name!r} is cut into {len(bodies)} parts: {shares} of its volume"]
        else:
            notes = [f"{name!r} has a slit" if self._within().any() else f"{name!r} has lost a crumb"]
        if self.crumbs > 0.0:
            notes.append(f"parts of fewer than {CRUMB} points are dropped: {self.crumbs:.2g} of the mass")
        lost = [region.name for region in self.given.regions if region.name not in kept]
        if lost:
            notes.append(f"no part holds enough of the regions {', '.join(lost)}")
        return tuple(notes)

    def _cut(
        self,
        bodies: tuple[ReducedBody, ...],
        densities: tuple[float, ...],
        faces: tuple[tuple[Array, Array], ...],
        notes: tuple[str, ...],
    ) -> Cut:
        """Return the record."""
        return Cut(
            bodies=bodies,
            densities=densities,
            crumbs=self.crumbs,
            missed=not self.hit,
            notes=notes,
            faces=faces,
            owners=lambda X: self._owners(X + self.body.offset),
            levels=lambda X: self._levels(X + self.body.offset),
        )

    def _within(self) -> NDArray[np.bool_]:
        """Return which severed links have both ends in one part."""
        return self.part[self.links[:, 0]] == self.part[self.links[:, 1]]

    def _refuse_exact_regions(self) -> None:
        for region in self.given.regions:
            if region.stiffness is None and len(self.crossing) and (region.distance(self.crossing)[0] <= 0.0).any():
                raise ConfigError(
                    f"the patch cuts the exact region {region.name!r}",
                    hint="cut beside it, or build the body with a soft region (stiffness=...)",
                )

    def _regions(self, quadrature: Quadrature) -> list[Region]:
        """Return the regions that a part holds enough of."""
        found = []
        for region in self.given.regions:
            pieces = pieces_near(quadrature, [region])
            try:
                region.integrate(pieces.points, pieces.weights, pieces.edges, pieces.axes)
            except BasisError:
                continue
            found.append(region)
        return found

    # -- the quadrature of a part -------------------------------------------------------------------------------------

    def _part(self, part: int) -> tuple[Quadrature, Indices, tuple[Array, Array]]:
        """Return the quadrature of a part, the point of the body that each of its points is, and its new surface."""
        given, cells = self.given.quadrature, self.cells
        share = self._shares(part)
        octants = np.flatnonzero(share > 0.0)
        points = np.flatnonzero(share[self.home] > 0.0)
        weights = given.weights[points] * share[self.home[points]]
        index = np.full(self.count, -1)
        index[octants] = np.arange(len(octants))
        mine = self._within() & (self.part[self.links[:, 0]] == part)
        severed = np.concatenate(
            [np.sort(self.links[mine], axis=1), *([] if cells.severed is None else [cells.severed])]
        )
        severed = index[severed]
        severed = severed[(severed >= 0).all(axis=1)]
        own = self._owners(given.surface_points) == part
        faces = [self._face(part, side) for side in (0, 1)]
        pitch = float(given.surface_areas.mean())
        chosen = [_thinned(*face, pitch) for face in faces]
        surface = np.concatenate([given.surface_points[own], *(face[0] for face in chosen)])
        every = np.concatenate([surface, cells.octants[octants]])
        quadrature = Quadrature(
            points=given.points[points],
            weights=weights,
            spacing=given.spacing,
            surface_points=surface,
            surface_normals=np.concatenate([given.surface_normals[own], *(face[1] for face in chosen)]),
            surface_areas=np.concatenate([given.surface_areas[own], *(face[2] for face in chosen)]),
            volume=float(weights.sum()),
            bounds=np.stack([every.min(axis=0), every.max(axis=0)]),
            report={**given.report, "points": len(points), "cut": int(given.report.get("cut", 0)) + 1},
            cells=Cells(
                of_point=cells.of_point[points],
                octants=cells.octants[octants],
                weights=cells.weights[octants] * share[octants],
                of_octant=cells.of_octant[octants],
                place=None if cells.place is None else cells.place[octants],
                borders=cells.borders,
                axes=cells.axes,
                severed=severed if len(severed) else None,
            ),
        )
        face = tuple(np.concatenate([faces[0][k], faces[1][k]]) for k in (0, 1))
        return quadrature, points, (face[0], face[1])

    def _shares(self, part: int) -> Array:
        """Return the fraction of every octant's volume that lies in a part, (Q,).

        The patch cuts an octant whose centre lies less than half its width away; both are measured along the normal.
        """
        share = (self.part == part).astype(np.float64)
        width = np.abs(self.normal @ self.axes.T).sum(axis=1)
        way = self.cells.octants[self.links[:, 1]] - self.cells.octants[self.links[:, 0]]
        deep = np.abs((way * self.normal).sum(axis=1))
        for side, depth in ((0, self.at * deep), (1, (1.0 - self.at) * deep)):
            home, other = self.links[:, side], self.links[:, 1 - side]
            over = np.clip(0.5 - depth / width, 0.0, 0.5)
            crossed = (self.part[home] != self.part[other]) & (self.part[home] >= 0) & (self.part[other] >= 0)
            crossed &= over > _SLIVER
            to = np.zeros(self.count)  # What an octant gives to the part, and what it gives of the part's own.
            gives = crossed & (self.part[other] == part)
            np.maximum.at(to, home[gives], over[gives])
            away = np.zeros(self.count)
            loses = crossed & (self.part[home] == part)
            np.maximum.at(away, home[loses], over[loses])
            share = np.maximum(share, to) - away
        return share

    def _face(self, part: int, side: int) -> tuple[Array, Array, Array]:
        """Return points [m], outward normals and areas [m^2] of the new surface of a part, on one side of the patch."""
        place = self.cells.place
        assert place is not None
        steps = np.abs(place[self.links[:, 1]] - place[self.links[:, 0]])
        rows = np.flatnonzero((self.part[self.links[:, side]] == part) & (steps.sum(axis=1) == 1))
        axes, axis = self.axes, steps[rows].argmax(axis=1)
        edges = np.cross(np.roll(axes, -1, axis=0), np.roll(axes, -2, axis=0))[axis]  # A face, along its normal.
        areas = np.abs((edges * self.normal[rows]).sum(axis=1))
        full = float(np.abs(np.linalg.det(axes)))
        areas = areas * np.clip(self.cells.weights[self.links[rows]].min(axis=1) / full, 0.0, 1.0)
        X = self.crossing[rows]
        slit = self._within()[rows]
        home, other = self.cells.octants[self.links[rows, side]], self.cells.octants[self.links[rows, 1 - side]]
        way = self.at[rows] if side == 0 else 1.0 - self.at[rows]
        X = np.where(slit[:, None], home + np.minimum(way, _LIP)[:, None] * (other - home), X)
        return X, self.normal[rows] * (1.0 if side == 0 else -1.0), areas

    # -- places -------------------------------------------------------------------------------------------------------

    def _owners(self, X: Array) -> Indices:
        """Return the part of asset points (N, 3): that of the nearest octant on the same side of the patch."""
        near = np.asarray(self.tree.query(X, k=min(NEIGHBOURS, self.count))[1])
        x = self._placed(X)
        found = near[:, 0].copy()
        open_ = np.arange(len(X))
        for k in range(near.shape[1]):
            clear = np.isnan(self.patch.crossings(self.place[near[open_, k]], x[open_])[0])
            found[open_[clear]] = near[open_[clear], k]
            open_ = open_[~clear]
            if not len(open_):
                break
        return self.part[found]

    def _levels(self, X: Array) -> tuple[Array, Array]:
        """Return signed distances to the patch at rest, and its normals, near severed links."""
        level, normal = np.full(len(X), np.inf), np.zeros((len(X), 3))
        if len(self.crossing):
            away, nearest = map(np.asarray, KDTree(self.crossing).query(X))
            near = np.flatnonzero(away < 2.0 * self.given.quadrature.spacing)
            normal[near] = self.normal[nearest[near]]
            level[near] = ((X[near] - self.crossing[nearest[near]]) * normal[near]).sum(axis=1)
        return level, normal


def _axes(cells: Cells) -> Array:
    """Return the edges of an octant along the axes of the grid [m], shape (3, 3)."""
    links = touching(dataclasses.replace(cells, severed=None))
    assert links is not None and cells.place is not None
    way = cells.octants[links[:, 1]] - cells.octants[links[:, 0]]
    steps = cells.place[links[:, 1]] - cells.place[links[:, 0]]
    found = np.zeros((3, 3))
    for axis in range(3):
        along = np.flatnonzero((np.abs(steps).sum(axis=1) == 1) & (steps[:, axis] != 0))
        found[axis] = np.median(way[along] * steps[along, axis, None], axis=0)
    return found


def _thinned(X: Array, normal: Array, areas: Array, pitch: float) -> tuple[Array, Array, Array]:
    """Return so many of some samples that each has about the area `pitch` [m^2], the area of all among them."""
    if not len(X):
        return X, normal, areas
    chosen = sample_farthest(X, max(round(float(areas.sum()) / pitch), 1), first=0)
    home = np.asarray(KDTree(X[chosen]).query(X)[1])
    return X[chosen], normal[chosen], np.bincount(home, areas, minlength=len(chosen)).astype(np.float64)


def _bridges(X: Array, part: Indices) -> Indices:
    """Return links (E, 2) that join the unconnected parts of an object, each with the nearest point of another."""
    found = []
    part = part.copy()
    while (size := np.bincount(part)).astype(bool).sum() > 1:
        smallest = np.where(size > 0, size, len(part) + 1).argmin()
        mine, others = np.flatnonzero(part == smallest), np.flatnonzero(part != smallest)
        apart, nearest = map(np.asarray, KDTree(X[others]).query(X[mine]))
        best = int(apart.argmin())
        link = (mine[best], others[nearest[best]])
        found.append(link)
        part[mine] = part[link[1]]
    return np.array(found, dtype=np.intp).reshape(-1, 2)
