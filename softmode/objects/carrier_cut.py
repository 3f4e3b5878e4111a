"""Cut a captured thing into what stands on what, and close the pieces with floors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.objects.carriers import (
    LIKELY,
    SURE,
    WIDE,
    Boundary,
    Sections,
    Surface,
    best_axis,
    dilated,
    filled,
    find_boundaries,
    heavy,
    weighted_median,
)
from softmode.objects.hands import HELD, find_arm
from softmode.splats.components import disc_points, link_labels, size_of
from softmode.splats.splats import Splats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PIECES = 4
"""A thing is cut into at most so many pieces."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cut:
    """What lies over a boundary."""

    above: Mask
    """Which splats of the surface stand on it, shape (N,)."""
    beneath: Mask
    """Which lie under it, shape (N,); the rest are frays beside the contact."""
    floor: Array
    """Points a cell apart over the contact, shape (M, 3)."""
    cell: float
    """Edge of a cell."""
    axis: Array
    """Unit vector upwards across it, shape (3,)."""


def cut_at(sections: Sections, boundary: Boundary, gap: float) -> Cut:
    """Cut a surface at a boundary: by a plane through the level splats beside the contact.

    Level splats near the plane go, and so do frays: just above it only what is in the solid that hangs together upwards
    or over the contact stays. On a rough top splats in the contact stay, too.

    Args:
        sections: Sections of the surface.
        boundary: Where.
        gap: Distance up to which what stands there hangs together.
    """
    surface, contact = sections.surface, boundary.contact
    x, normal, pitch = surface.points, surface.normals, surface.pitch
    i, j = sections.cells_of(x)
    height, shift, reach, rough = x[:, 2] - boundary.height, np.zeros(3), 0.5 * sections.layer, False
    span = max((boundary.reach + 1.5) * sections.layer, 0.03 * sections.size)
    within: Any = ndimage.binary_dilation(contact, iterations=2)
    outside = ~within[i, j]
    if boundary.kind == "top":
        flat = np.flatnonzero(outside & (np.abs(height) < span) & (np.abs(normal[:, 2]) > 0.8))
        spread = 0.5 * pitch
        if len(flat) > 10:
            shift = _plane(x[flat], height[flat], surface.areas[flat], span, 0.2 * pitch)
            height = height - x[:, :2] @ shift[:2] - shift[2]
            near = flat[np.abs(height[flat]) < span]
            count, edge = np.histogram(height[near], bins=40, weights=surface.areas[near])
            mode = int(ndimage.gaussian_filter1d(count, 1.5).argmax())
            top = 0.5 * float(edge[mode] + edge[mode + 1])
            height, shift[2] = height - top, shift[2] + top
            spread = weighted_median(np.abs(height[near]), surface.areas[near])
        reach, rough = float(np.clip(4.0 * spread, 0.3 * pitch, span)), spread > 0.5 * pitch
    above = height > 0.0
    lying = (np.abs(height) <= reach) & (np.abs(normal[:, 2]) > 0.75)
    if rough:
        core: Any = ndimage.binary_erosion(contact, iterations=2)
        covered: Any = sections.solid[sections.layer_of(boundary.height + 2.0 * span) :].any(axis=0)
        low = (np.abs(height) < 2.0 * span) & (np.abs(normal[:, 2]) > 0.8) & ~covered[i, j]
        sheet = _sheet(surface, np.flatnonzero(low), outside)
        lying = (lying & ~(core[i, j] & (height > 0.3 * reach))) | sheet
        foot, stands = np.zeros_like(contact), above & ~sheet & (height < 2.0 * span)
        foot[i[stands], j[stands]] = True
        contact = contact & filled(dilated(foot, WIDE))
    above &= ~lying
    kept = np.flatnonzero(above)
    if len(kept) > 50:
        wide = kept[np.linalg.norm(surface.tangents[kept, :, 1], axis=1) > 0.4 * gap]
        linked = np.concatenate([x[kept], disc_points(x[wide], surface.tangents[wide], 0.8 * gap)])
        label = link_labels(linked, 0.8 * gap)[: len(kept)]
        bulk = np.bincount(label, surface.areas[kept])
        above[kept] = (bulk >= 0.02 * bulk.max())[label]
    if boundary.kind == "top":
        above &= _held(sections, boundary)
    cells = np.argwhere(contact)
    plan = (cells + 0.5) * sections.cell + sections.origin[:2]
    floor = np.column_stack([plan, boundary.height + plan @ shift[:2] + shift[2]])
    beneath, place = ~above & (height < reach), floor @ sections.basis
    return Cut(above=above, beneath=beneath, floor=place, cell=sections.cell, axis=sections.basis[2])


def _sheet(surface: Surface, level: NDArray[np.intp], outside: Mask) -> Mask:
    """Return which splats belong to an uneven top: level ones that hang together with those outside the contact.

    A bump that touches what stands there is part of it; a foot is not, whose sides are steep.
    """
    label = link_labels(surface.points[level], 1.2 * surface.pitch)
    free = np.bincount(label, surface.areas[level] * outside[level])
    found = np.zeros(len(outside), dtype=bool)
    found[level] = (free >= 0.2 * free.sum())[label]
    return found


def _plane(points: Array, height: Array, areas: Array, span: float, least: float) -> Array:
    """Return slopes and offset (3,) of the plane of heights over points (N, 3), far ones weighted down."""
    middle = points[:, :2].mean(axis=0)
    plan, fit = np.column_stack([points[:, :2] - middle, np.ones(len(points))]), np.zeros(3)
    weight = areas * np.exp(-((height / span) ** 2))
    for _ in range(10):
        off = np.abs(height - plan @ fit)
        root = np.sqrt(weight) / (1.0 + (off / max(1.5 * weighted_median(off, areas), least)) ** 2)
        fit = np.linalg.lstsq(plan * root[:, None], height * root, rcond=None)[0]
    if np.hypot(fit[0], fit[1]) >= 0.1:
        return np.zeros(3)
    return np.array([fit[0], fit[1], -float(fit[:2] @ middle)])


def _held(sections: Sections, boundary: Boundary) -> Mask:
    """Return which splats are high above a boundary, over its contact, or in what hangs together upwards from it."""
    i, j = sections.cells_of(sections.surface.points)
    first = min(sections.layer_of(boundary.height) + boundary.reach + 2, len(sections.solid) - 1)
    solid = sections.solid[first : first + 12]
    held = ndimage.binary_dilation(heavy(solid), np.ones((3, 3, 3)))
    low = ndimage.binary_dilation(boundary.contact, iterations=3)[i, j]
    k = np.floor((sections.surface.points[:, 2] - sections.origin[2]) / sections.layer).astype(int) - first
    return (k > 6) | low | ((k >= 1) & held[np.clip(k, 0, len(held) - 1), i, j])


@dataclass(frozen=True, kw_only=True, eq=False)
class Pieces:
    """A captured thing, cut where one piece of it may stand on another."""

    number: NDArray[np.intp]
    """Piece of each splat, from the top on from 1, shape (N,), or () for all; 0 for frays."""
    cuts: tuple[Cut, ...]
    """The cuts between the pieces, from the top on."""
    boundaries: tuple[Boundary, ...]
    """What is there."""
    top: int
    """The pieces from the first to this one are the object, the others carry it."""
    arm: float = 0.0
    """How sure it is that a hand holds it, 0 to 1."""
    end: str = ""
    """Where the arm ends."""

    @property
    def count(self) -> int:
        """Number of pieces."""
        return len(self.cuts) + 1

    def floors(self, taken: set[int], thing: Splats) -> list[Splats]:
        """Return discs that close pieces where others were taken off them, coloured like the nearest splats."""
        found = []
        for k, cut in enumerate(self.cuts, start=1):
            if (k in taken) == (k + 1 in taken):
                continue
            turn = Rotation.align_vectors([cut.axis], [[0.0, 0.0, 1.0]])[0].as_quat()
            count, near = len(cut.floor), thing.subset(np.isin(self.number, list(taken)))
            found.append(
                Splats(
                    means=cut.floor,
                    quats=np.tile(turn, (count, 1)),
                    scales=np.tile([cut.cell, cut.cell, 0.1 * cut.cell], (count, 1)),
                    opacities=np.full(count, 0.95),
                    sh=near.sh[KDTree(near.means).query(cut.floor)[1], :1],
                    offset=thing.offset,
                )
            )
        return found

    @property
    def told(self) -> dict[str, str | int | float]:
        """What a report says of a hand that holds it, of the carrier, and of what may be one or may be none."""
        told = self._carrier_told if self.cuts else {}
        if self.arm < HELD:
            return told
        every = " ".join(map(str, range(1, self.count + 1)))
        held = {
            "doubt": f"a hand seems to hold it: an arm reaches out of it and ends open at {self.end}",
            "doubt_remedy": f"capture it as it stands, or crop the hand away (softmode view --prepare); --part {every}"
            " takes all of it",
        }
        if "doubt" in told:
            held = {name: f"{what}; {told[name]}" for name, what in held.items()}
        return told | held | {"arm": self.arm}

    @property
    def _carrier_told(self) -> dict[str, str | int | float]:
        options = [" ".join(map(str, range(1, last + 1))) for last in range(1, self.count + 1)]
        heights = [float(cut.floor[:, 2].mean()) for cut in self.cuts]
        scores = [boundary.score for boundary in self.boundaries]
        places = [f"z = {height:.4g} (score {score:.2f})" for height, score in zip(heights, scores, strict=True)]
        takes = [*(f"what is above {height:.4g}" for height in heights), "all of it"]
        doubts = {k: score for k, score in enumerate(scores) if k != self.top - 1}
        told: dict[str, str | int | float] = {}
        if self.top == self.count:
            most = max(doubts, key=lambda k: doubts[k])
            doubt = f"it was kept whole, but may be carried by what is below {places[most]}"
        else:
            k = self.top - 1
            told |= {
                "carrier": self.boundaries[k].kind,
                "carrier_splats": int((self.number > self.top).sum()),
                "carrier_height": heights[k],
                "carrier_score": scores[k],
                "carrier_part": options[-1],
            }
            if scores[k] > SURE and max(doubts.values(), default=0.0) < LIKELY:
                return told
            others = ", ".join(places[other] for other in doubts)
            doubt = f"it was cut off what carries it at {places[k]}"
            doubt += f"; it may end elsewhere: {others}" if others else ", which is not sure"
            doubts[self.count - 1] = 1.0 - scores[k]
        named = [f"--part {options[k]} takes {takes[k]}" for k in sorted(doubts, key=lambda k: -doubts[k])]
        return told | {"doubt": doubt, "doubt_remedy": "look at it (softmode splat show); " + ", ".join(named)}


WHOLE = Pieces(number=np.array(1), cuts=(), boundaries=(), top=1)
"""A thing that nothing carries, all of it one piece."""


def divide(thing: Splats, normal: Array | None, gap: float) -> Pieces:
    """Cut a thing where one piece of it may stand on another; `WHOLE` where nothing does.

    Args:
        thing: One part of a capture, z up.
        normal: Normal of the ground that it stands on, shape (3,), None if there is none.
        gap: Distance up to which splats hang together.
    """
    solid = np.flatnonzero((thing.opacities >= 0.2) & (thing.scales.max(axis=1) < 0.25 * size_of(thing)))
    if len(solid) < 500:
        return WHOLE
    surface = Surface.of(thing.subset(solid))
    arm, end = find_arm(surface)
    held: dict[str, Any] = {"arm": arm, "end": " ".join(f"{x:.3g}" for x in end + thing.offset)}
    axis = best_axis(surface, np.array([0.0, 0.0, 1.0])) if normal is None else normal
    sections = Sections(surface, axis)
    found, chosen = find_boundaries(sections)
    if not found:
        return replace(WHOLE, **held)
    ranked = sorted(found, key=lambda boundary: -boundary.score - 2.0 * (boundary is chosen))[: PIECES - 1]
    ranked.sort(key=lambda boundary: -boundary.height)
    cuts = [cut_at(sections, boundary, gap) for boundary in ranked]
    number = np.where(cuts[-1].beneath, len(cuts) + 1, 0)
    for k in range(len(cuts), 0, -1):
        number[cuts[k - 1].above] = k
    away, nearest = KDTree(surface.points).query(thing.means)
    every = np.where(away < 0.5 * gap, number[nearest], 0)
    every[solid] = number
    top = next((k for k, boundary in enumerate(ranked, start=1) if boundary is chosen), len(cuts) + 1)
    return Pieces(number=every, cuts=tuple(cuts), boundaries=tuple(ranked), top=top, **held)
