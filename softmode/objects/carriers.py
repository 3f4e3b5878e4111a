"""What carries a captured object: sections across its axis, and the heights at which a carrier may end.

A statue on a plinth touches it, so both are one part of a capture. They are told apart by their shape: a level top that
is free all around, on which what stands can stand alone, with something plainer, coarser, prism-like or legged below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from softmode.deformables.quadrature.shell_views import spread_samples
from softmode.splats.components import surface_discs
from softmode.splats.splats import Splats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LAYERS, CELLS = 128, 160
"""Layers along the axis, and cells along the longest edge, at most."""
SURE, LIKELY, DOUBTED = 0.85, 0.5, 0.08
"""Scores from which on a carrier is cut without a doubt, is cut, and is named though nothing is cut."""
LEAN = 12.0
"""The axis is looked for within so many degrees of the one that is said to point up."""
DISC, WIDE = (np.hypot(*np.mgrid[-r : r + 1, -r : r + 1]) < r + 0.4 for r in (2, 4))
"""Neighbourhoods over which sections and tops are closed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Splats as discs of a surface."""

    points: Array
    """Their centres, shape (N, 3)."""
    normals: Array
    """Their thin axes, of either sign, shape (N, 3)."""
    tangents: Array
    """Their other axes as long as their standard deviations, as columns, the longest first, shape (N, 3, 2)."""
    areas: Array
    """Their opacities times these standard deviations, those of the largest capped, shape (N,)."""
    pitch: float
    """Median distance to the sixth neighbour."""

    @classmethod
    def of(cls, splats: Splats) -> Surface:
        """Return the discs of splats."""
        points, (normals, tangents) = splats.means.astype(np.float64), surface_discs(splats)
        areas = splats.opacities * np.linalg.norm(tangents, axis=1).prod(axis=1)
        few: Any = KDTree(points).query(points[:: max(1, len(points) // 20_000)], k=min(7, len(points)))
        return cls(
            points=points,
            normals=normals,
            tangents=tangents,
            areas=np.minimum(areas, np.quantile(areas, 0.995)),
            pitch=float(np.median(few[0][:, -1])),
        )

    def turned(self, basis: Array) -> Surface:
        """Return it in the coordinates of a basis, whose rows are unit vectors."""
        points, normals = self.points @ basis.T, self.normals @ basis.T
        return replace(self, points=points, normals=normals, tangents=basis @ self.tangents)


@dataclass(frozen=True, kw_only=True, eq=False)
class Boundary:
    """A height at which a carrier may end."""

    kind: Literal["top", "stem"]
    """A level top, or a stem."""
    height: float
    """Height along the axis."""
    score: float
    """How sure it is, 0 to 1."""
    contact: Mask
    """Outline of what stands on it, in cells of the sections."""
    reach: int = 1
    """Layers on either side over which the top spreads."""
    convexity: float = 0.0
    """Area of the outline below a top over that of its hull."""
    plain_above: float = 0.0
    """Share of the area above a top that lies level or upright."""


def ramp(x: float, low: float, high: float) -> float:
    """Return 0 below `low`, 1 above `high`, and what lies between in proportion."""
    return float(np.clip((x - low) / (high - low), 0.0, 1.0))


def weighted_median(values: Array, weights: Array) -> float:
    """Return the value below which half of the weight lies."""
    return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))


def best_axis(surface: Surface, up: Array) -> Array:
    """Return the axis near `up` for which most area is level or upright; `up` itself if that gains under a tenth.

    Level faces alone mislead: a back that leans is one too.
    """
    step = max(1, len(surface.points) // 20_000)
    normals, areas = surface.normals[::step], surface.areas[::step]
    towards = normals * np.sign(normals @ up)[:, None]
    near = towards @ up > np.cos(np.radians(LEAN))
    if near.sum() < 50:
        return up
    few, weight = towards[near], areas[near]
    cone = np.radians(2.5)

    def mode(axis: Array) -> Array:
        for _ in range(6):
            inner = few @ axis > np.cos(np.radians(3.0))
            axis = weight[inner] @ few[inner] if inner.any() else axis
            axis = axis / np.linalg.norm(axis)
        return axis

    seeds = few[np.argsort(-weight)[:: max(1, len(few) // 200)][:200]]
    held = weight @ (few @ seeds.T > np.cos(cone))
    tried = np.stack([up, mode(up), *(mode(seeds[k]) for k in np.argsort(-held)[:20:2])])
    along = np.abs(normals @ tried.T)
    share = areas @ ((along > np.cos(cone)) | (along < np.sin(cone)))
    best = int(share.argmax())
    return tried[best] if share[best] > 1.1 * share[0] else up


def _hull_of(mask: Mask) -> ConvexHull:
    """Return the convex hull of cells, of which there are some, in cells; its `volume` is its area."""
    cells = np.argwhere(mask)
    return ConvexHull(np.concatenate([cells + np.array([a, b]) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]))


def convexity(mask: Mask) -> float:
    """Return the area of cells over that of their hull."""
    return float(mask.sum()) / float(_hull_of(mask).volume)


def _outline(hull: ConvexHull, count: int) -> Array:
    """Return points at equal distances along a hull, shape (2, count)."""
    corners = hull.points[np.append(hull.vertices, hull.vertices[0])]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    return np.stack([np.interp(np.linspace(0.0, along[-1], count, endpoint=False), along, x) for x in corners.T])


def dilated(masks: Mask, disc: Mask, *, beyond: bool = False) -> Mask:
    """Return the cells of layers (..., A, B) within a disc of others, or of what is beyond the layers."""
    (a, b), r = masks.shape[-2:], len(disc) // 2
    wide = np.pad(masks, [(0, 0)] * (masks.ndim - 2) + [(r, r)] * 2, constant_values=beyond)
    found = np.zeros_like(masks)
    for i, j in np.argwhere(disc):
        found |= wide[..., i : i + a, j : j + b]
    return found


def eroded(masks: Mask, disc: Mask) -> Mask:
    """Return the cells of layers (..., A, B) that have a disc of others around them."""
    return ~dilated(~masks, disc, beyond=True)


def closed(masks: Mask, disc: Mask) -> Mask:
    """Return cells of layers (..., A, B) with what is narrower than a disc between them."""
    return eroded(dilated(masks, disc), disc)


def filled(masks: Mask) -> Mask:
    """Return cells of layers (..., A, B) with the holes between them."""
    layers = masks.reshape(-1, *masks.shape[-2:])
    cross = np.zeros((3, 3, 3), dtype=bool)
    cross[1] = ndimage.generate_binary_structure(2, 1)
    labelled: Any = ndimage.label(~layers, cross)
    label, outside = labelled[0], np.zeros(labelled[1] + 1, dtype=bool)
    for edge in (label[:, 0], label[:, -1], label[:, :, 0], label[:, :, -1]):
        outside[edge] = True
    outside[0] = False
    return ~outside[label].reshape(masks.shape)


def heavy(solid: Mask) -> Mask:
    """Return which cells belong to pieces of a twentieth of the volume and more."""
    piece: Any = ndimage.label(solid)
    bulk = np.bincount(piece[0].ravel(), minlength=piece[1] + 1)
    bulk[0] = 0
    return (bulk >= 0.05 * bulk.sum())[piece[0]] & solid


class Sections:
    """Sections of a surface across an axis: in every layer the cells inside its outline.

    A section is the outline of two layers, closed over two cells, filled and opened: it needs no closed shell.

    Args:
        surface: What was captured.
        axis: Unit vector that points up, shape (3,).
    """

    def __init__(self, surface: Surface, axis: Array) -> None:
        """Spread every splat over its disc to one and a half standard deviations, and fill the layers."""
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        side /= np.linalg.norm(side)
        self.basis: Array = np.stack([side, np.cross(axis, side), axis]).astype(np.float64)
        """Rows: two unit vectors across the axis, and the axis."""
        self.surface = surface.turned(self.basis)
        """The surface in this basis."""
        x, pitch = self.surface.points, surface.pitch
        low, high = np.quantile(x, [0.001, 0.999], axis=0)
        z0, z1 = np.quantile(x[:, 2], [0.002, 0.998])
        self.size = float(np.ptp(x, axis=0).max())
        self.cell = max(self.size / CELLS, 0.4 * pitch)
        """Edge of a cell."""
        self.layer = max(float(z1 - z0) / LAYERS, 0.4 * pitch)
        """Thickness of a layer."""
        self.origin = np.array([low[0] - 6.0 * self.cell, low[1] - 6.0 * self.cell, z0])
        """Corner of the first cell of the first layer, in the basis."""
        wide = np.ceil((high[:2] - self.origin[:2]) / self.cell).astype(int) + 6
        count = int(np.ceil((z1 - z0) / self.layer)) + 1
        sample, owner = spread_samples(x, 1.5 * self.surface.tangents, 0.7 * self.cell)
        index = np.floor((sample - self.origin) / [self.cell, self.cell, self.layer]).astype(int).T
        good = np.logical_and.reduce([(0 <= at) & (at < n) for at, n in zip(index, (*wide, count), strict=True)])
        (i, j, k), flat = index[:, good], (np.abs(self.surface.normals[:, 2]) > 0.85)[owner[good]]
        shell = np.zeros((count, *wide), dtype=bool)
        self.level = shell.copy()
        """Where splats lie level, within 32 degrees, shape (layers, cells, cells)."""
        shell[k, i, j] = True
        self.level[k[flat], i[flat], j[flat]] = True
        shell[1:] |= shell[:-1].copy()
        whole = eroded(filled(dilated(shell, DISC)), DISC)
        square = whole[:, 1:] & whole[:, :-1]
        square = square[:, :, 1:] & square[:, :, :-1]
        self.solid = np.zeros_like(shell)
        """The sections, shape (layers, cells, cells)."""
        for i, j in np.ndindex(2, 2):
            self.solid[:, i : i + square.shape[1], j : j + square.shape[2]] |= square
        cells = self.solid.sum(axis=(1, 2))
        self.areas = cells * self.cell**2
        """Areas of the sections, shape (layers,)."""
        middle = [self.solid.sum(axis=2 - k) @ np.arange(wide[k]) for k in (0, 1)]
        self.centres = np.stack(middle, axis=1) / np.maximum(cells, 1)[:, None]
        """Their centres [cells], shape (layers, 2)."""
        self.heights = z0 + self.layer * (np.arange(count) + 0.5)
        """Heights of the layers."""

    def layer_of(self, height: float) -> int:
        """Return the layer at a height."""
        return int(np.clip((height - self.origin[2]) / self.layer, 0, len(self.heights) - 1))

    def cells_of(self, points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the cells across the axis in which points (N, 3) of the basis lie."""
        index = np.floor((points[:, :2] - self.origin[:2]) / self.cell).astype(np.intp)
        i, j = np.clip(index, 0, np.array(self.solid.shape[1:]) - 1).T
        return i, j

    @cached_property
    def plain(self) -> Mask:
        """Which splats lie level or upright, within 18 and 12 degrees, shape (N,)."""
        along = np.abs(self.surface.normals[:, 2])
        return (along < 0.2) | (along > 0.95)

    def look(self, low: float, high: float = np.inf) -> tuple[float, float, float]:
        """Return of the splats between two heights: the plain share of the area, the median area, share of splats."""
        z, areas = self.surface.points[:, 2], self.surface.areas
        there = np.flatnonzero((z > low) & (z < high))
        some = areas[there]
        if not some.any():
            return 0.0, 1e-300, 0.0
        plain = float(some[self.plain[there]].sum() / some.sum())
        return plain, weighted_median(some, some), len(there) / len(z)

    @cached_property
    def turned_share(self) -> float:
        """Share of the height whose sections are discs around one axis, which may lean: a cup, a lamp, a mushroom."""
        rows = np.flatnonzero(self.areas > 0.0)
        if len(rows) < 4:
            return 0.0
        weight = self.areas[rows] ** 0.25
        line = np.stack([np.polyfit(rows, self.centres[rows, k], 1, w=weight) for k in (0, 1)], axis=1)
        grid = np.moveaxis(np.indices(self.solid.shape[1:]), 0, -1)
        found = 0
        for k in rows:
            section, axis = self.solid[k], line[0] * k + line[1]
            disc = ((grid - axis) ** 2).sum(axis=2) <= section.sum() / np.pi
            blur = 1.2 / max(float(np.sqrt(section.sum() / np.pi)), 1.0)
            if blur < 0.4:
                found += (section & disc).sum() > min(0.88, 1.0 - 2.0 * blur) * max((section | disc).sum(), 1)
            else:
                found += np.linalg.norm(self.centres[k] - axis) < 2.5
        return found / len(rows)

    def tops(self) -> list[Boundary]:
        """Return the level tops on which something stands, first the narrow ones, then those of rough surfaces."""
        found: list[Boundary] = []
        for reach in (1, 3):
            apart: list[int] = []
            for k, below, _, cover in sorted(self._levels(reach), key=lambda top: -top[3] * top[2]):
                if all(abs(k - other) > 2 * reach + 1 for other in apart):
                    apart.append(k)
                    if all(abs(k - self.layer_of(other.height)) > 4 for other in found):
                        found += self._scored(k, reach, below, cover)
        return found

    def _levels(self, reach: int) -> list[tuple[int, Mask, int, float]]:
        """Return heights with more below than above: layer, outline below, cells free, and their level share."""
        found, bulk = [], np.cumsum(self.areas[::-1])[::-1]
        for k in range(reach + 2, len(self.solid) - reach - 2):
            under = np.asarray(self.solid[max(0, k - reach - 2) : k - reach + 1].any(axis=0))
            above = self.solid[k + reach : k + reach + 3].sum(axis=0) >= 2
            level = self.level[k - reach : k + reach + 1].any(axis=0) & ~above
            if not above.any() or bulk[k] < 0.03 * bulk[0] or level.sum() < 0.05 * (under & ~above).sum():
                continue
            below = filled(closed(under, WIDE))
            if below.sum() < 1.1 * above.sum():
                continue
            free = below & ~dilated(above, DISC)
            if free.sum() < 20:
                continue
            cover = float((closed(level, DISC) & free).sum() / free.sum())
            found.append((k, below, int(free.sum()), cover))
        return found

    def _scored(self, k: int, reach: int, below: Mask, cover: float) -> list[Boundary]:
        """Return the top at a layer with its score, if anything goes on upwards from it."""
        # What stands on it goes on upwards; frays of the rim do not.
        above = heavy(self.solid[k + reach + 2 :])[:2].any(axis=0)
        near = ndimage.binary_dilation(above, iterations=max(2, round(0.03 * self.size / self.cell)))
        above |= (self.solid[k + reach : k + reach + 3].sum(axis=0) >= 2) & near
        if not above.any():
            return []
        hull, foot = _hull_of(below), _hull_of(above)
        convex = float(below.sum() / hull.volume)
        far = ndimage.distance_transform_edt(~above)
        margin: Any = ndimage.map_coordinates(far, _outline(hull, 240), order=1, mode="nearest")
        around = float((margin > max(2.5, 0.05 * np.sqrt(below.sum()))).mean())
        radius = float(np.sqrt(foot.volume / np.pi))
        bulk = np.where(np.arange(len(self.areas)) > k + reach, self.areas, 0.0)
        centre = bulk @ self.centres / max(float(bulk.sum()), 1e-300)
        rise = max(float(bulk @ (self.heights - self.heights[k])) / max(float(bulk.sum()), 1e-300) / self.cell, 1e-9)
        lean = float(np.linalg.norm(centre - np.argwhere(above).mean(axis=0)))
        plain, coarse, _ = self.look(-np.inf, self.heights[k] - self.layer)
        plain_above, fine, share = self.look(self.heights[k] + self.layer)
        contrast = max(ramp(plain - plain_above, 0.15, 0.4), ramp(coarse / fine, 1.8, 3.5))
        extent = max(float(np.ptp(np.argwhere(above), axis=0).max()) * self.cell, self.heights[-1] - self.heights[k])
        held, most = float(bulk.sum() / self.areas.sum()), extent / self.size
        steady = -float((foot.equations @ [*centre, 1.0]).max()) / rise  # how far inside the edge it stands
        # The discs of its top may stand out beyond its edges: a prism is as wide as its upper half is on the whole.
        lower = self.areas[: max(1, k - reach)]
        prism = float((lower > 0.8 * np.median(lower[len(lower) // 2 :])).mean())
        legs = float((lower < 0.2 * below.sum() * self.cell**2).mean())
        why = {
            "level": ramp(cover, 0.18, 0.42),
            "free": ramp(around + 0.3 * contrast, 0.7, 0.85),
            "convex": ramp(convex, 0.6, 0.8),
            "stands": ramp(radius / rise, 0.17, 0.3) * ramp(steady, 0.0, 0.05),
            "over": ramp(-lean / radius, -1.6, -1.1),
            "plain": ramp(plain, 0.45, 0.6),
            "carrier": ramp(max(contrast, ramp(prism, 0.6, 0.85), ramp(legs, 0.5, 0.7)), 0.1, 0.5),
            "smaller": ramp(-float(above.sum() / below.sum()), -0.95, -0.85),
            "enough": ramp(share, 0.02, 0.06) * ramp(held, 0.01, 0.04) * ramp(most, 0.18, 0.35),
        }
        # A boxy thing on a box may be the hood of a car, and a slight foot that of a handle: a doubt is named.
        unsure = plain_above > 0.9 or above.sum() < 0.03 * below.sum()
        score = min(float(np.prod(list(why.values()))), 0.99 * SURE if unsure else 1.0)
        if score < LIKELY and np.prod([part for name, part in why.items() if name != "free"]) > 0.9:
            score = max(score, 1.5 * DOUBTED * ramp(around + 0.3 * contrast, 0.65, 0.7))  # all else speaks for it
        named = {"convexity": convex, "plain_above": plain_above}
        top = Boundary(kind="top", height=float(self.heights[k]), score=score, contact=above, reach=reach, **named)
        return [top]

    def stem(self) -> list[Boundary]:
        """Return the end of a thin prism in one piece under something much wider, if there is one."""
        widest = np.maximum.accumulate(self.areas[::-1])[::-1]
        thin: Any = ndimage.label((self.areas > 0.0) & (self.areas < 0.15 * widest))
        found: list[Boundary] = []
        for piece in range(1, thin[1] + 1):
            rows = np.flatnonzero(thin[0] == piece)
            rows = rows[1:-1] if len(rows) > 4 else rows
            if len(rows) < 0.08 * len(self.areas):
                continue
            area = float(np.median(self.areas[rows]))
            even = float((np.abs(self.areas[rows] - area) < 0.35 * area).mean())
            drift = np.ptp(np.quantile(self.centres[rows], [0.1, 0.9], axis=0), axis=0).max() * self.cell
            whole = float(np.median([convexity(self.solid[k]) for k in rows]))
            grown = np.append(self.areas[rows[-1] + 1 : -1], np.inf) >= 1.6 * area
            end = min(int(rows[-1]) + 1 + int(grown.argmax()), len(self.areas) - 1)
            why = {
                "even": ramp(even, 0.5, 0.8),
                "straight": ramp(-float(drift) / np.sqrt(area), -1.2, -0.6),
                "one": ramp(whole, 0.6, 0.8),
                "not turned": ramp(-self.turned_share, -0.85, -0.7),
                "enough": ramp(float(self.areas[end:].sum() / self.areas.sum()), 0.1, 0.3),
            }
            # A mushroom stands on a stem of its own: a doubt is named.
            score, height = min(float(np.prod(list(why.values()))), 0.99 * SURE), float(self.heights[end])
            found.append(Boundary(kind="stem", height=height, score=score, contact=self.solid[end]))
        return sorted(found, key=lambda stem: -stem.score)[:1]


def is_step(sections: Sections, lower: Boundary, upper: Boundary) -> tuple[bool, bool]:
    """Return whether what lies between two boundaries belongs to the carrier, and whether there is no doubt about it.

    It does if it is convex, plain, and plainer than what follows: so neither shoulders nor the hood of a car are
    climbed.
    """
    first, last = sections.layer_of(lower.height), sections.layer_of(upper.height)
    between = [convexity(mask) for mask in sections.solid[first + 3 : last - 2] if mask.any()]
    convex = float(np.median(between)) if between else 0.0
    if last - first < 0.25 * len(sections.solid):  # the faces of a low step may be too bare for sections
        convex = max(convex, upper.convexity)
    plain, _, _ = sections.look(lower.height + sections.layer, upper.height + sections.layer)
    plainer = plain - upper.plain_above
    if convex > 0.8 and plain > 0.6 and plainer > 0.15:
        return True, convex > 0.85 and plain > 0.7 and plainer > 0.3
    return False, convex < 0.65 or plain < 0.45 or (plain < 0.8 and plainer < 0.1)


def find_boundaries(sections: Sections) -> tuple[list[Boundary], Boundary | None]:
    """Return the heights at which a carrier may end, upwards, and the one at which it does; None where nothing carries.

    From the lowest carrier it goes upwards over its steps. Heights at which it surely does not end are left out.
    """
    found = [top for top in (*sections.tops(), *sections.stem()) if top.score > DOUBTED]
    found.sort(key=lambda boundary: boundary.height)
    chosen: Boundary | None = None
    passed: list[Boundary] = []
    for boundary in (one for one in found if one.score >= LIKELY):
        climbs, sure = True, False
        if chosen is not None and boundary.kind == "top":
            climbs, sure = is_step(sections, chosen, boundary)
            if sure:
                passed.append(chosen if climbs else boundary)
        chosen = boundary if climbs else chosen
    return [boundary for boundary in found if boundary not in passed], chosen
