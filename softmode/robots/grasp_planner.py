"""Grasps of any shape from above: opposite places of its surface that a parallel gripper reaches and friction holds.

Candidates are antipodal pairs of surface samples: the line between them lies in both friction cones (V.-D. Nguyen,
Constructing force-closure grasps, 1988, doi:10.1177/027836498800700301), and in that of a level closing axis, because
the gripper points down. Every candidate closes the pads on all that lies between them; what they touch judges it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.errors import ConfigError, GraspError
from softmode.robots.jaws import ParallelJaw

Array = NDArray[np.float64]

MARGIN = 0.003
"""Room that fingers and palm keep from the object and the ground while they go down [m]."""
DEPTH = 0.004
"""How deep the pads press in when they hold: samples within it are touched [m]."""
CANDIDATES = 800
"""Pairs that are judged, the best of each cell of place and direction."""
YIELD = 0.01
"""How far an object yields that halves a score [m]."""
ROOM = 0.02
"""By how much the fingers go down wider than the object if they can [m]; without room a score is halved."""
_CELL = (0.012, np.pi / 18.0)
"""Size of such a cell [m, rad]."""
_APART = (0.012, np.pi / 9.0)
"""Grasps that are nearer to each other than this count as one [m, rad]."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """Where a gripper that points down takes an object."""

    position: tuple[float, float, float]
    """The middle between the pads [m]."""
    yaw: float
    """Turn about the vertical [rad]: the fingers close along (-sin yaw, cos yaw)."""
    width: float
    """What lies between the pads [m]."""
    opening: float
    """Gap between the pads while they go down [m]."""
    contacts: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Middles of what the two pads touch [m]."""
    area: float
    """Smaller one of the areas that they touch [m^2]."""
    angle: float
    """Angle between the closing axis and the surface's normals or the line between the contacts, the largest [rad]."""
    score: float
    """Quality, 0 to 1."""


def plan_grasps(
    points: ArrayLike,
    normals: ArrayLike,
    areas: ArrayLike,
    jaw: ParallelJaw,
    *,
    friction: float = 0.8,
    force: float = 6.0,
    weight: float = 0.0,
    centre: ArrayLike | None = None,
    modes: ArrayLike | None = None,
    ground: float = 0.0,
    lowest: float = -np.inf,
    obstacles: ArrayLike | None = None,
    yaw: float = 0.0,
    count: int = 5,
) -> tuple[Grasp, ...]:
    """Return the best grasps of an object, the best first; equal input gives equal grasps.

    The score is a product: how far normals and contacts are inside the friction cone; the touched area; the torque of
    the weight about the closing axis over what friction in that area withstands, a centre of mass above the axis being
    worse than one below it; how far the object yields to squeeze and weight; and a little for a small turn of the hand.

    Args:
        points: Surface samples where they are, z up [m], shape (N, 3).
        normals: Outward unit normals there, shape (N, 3).
        areas: Areas that they stand for [m^2], shape (N,).
        jaw: The gripper.
        friction: Coulomb coefficient between pads and object.
        force: Force of each finger when it holds [N].
        weight: Weight of the object [N].
        centre: Centre of mass [m], shape (3,); the middle of the surface if omitted.
        modes: Elastic modes at the samples, of energy 1/2 q^2 [m/N^(1/2)], shape (N, 3, M): forces f that balance move
            their own points by sum_m (f . modes_m)^2 / |f|. Without them the object counts as rigid.
        ground: Height of what the object stands on [m].
        lowest: Least height of the middle between the pads [m], as the robot's workspace has it.
        obstacles: More points that fingers and palm must not meet [m], shape (M, 3).
        yaw: Present turn of the gripper [rad].
        count: How many grasps, at most; they differ by 12 mm or 20 degrees.

    Raises:
        GraspError: If none fits; the message says what stands against it.
        ConfigError: If the arrays do not fit each other.
    """
    x, n, area = (np.asarray(given, np.float64) for given in (points, normals, areas))
    if x.ndim != 2 or x.shape[1] != 3 or n.shape != x.shape or area.shape != x.shape[:1] or not np.isfinite(x).all():
        raise ConfigError(
            f"points, normals and areas have shapes {x.shape}, {n.shape}, {area.shape}",
            hint="give finite arrays of shapes (N, 3), (N, 3), (N,)",
        )
    require_number("friction", friction, above=0.0)
    require_number("count", count, at_least=1)
    middle = np.average(x, axis=0, weights=area) if centre is None else np.asarray(centre, np.float64)
    solid = x if obstacles is None else np.concatenate([x, np.asarray(obstacles, np.float64).reshape(-1, 3)])
    mid, angle = _pairs(x, n, jaw, friction, middle)
    found = _Candidates(x, n, area, solid, jaw, mid, angle, max(ground + jaw.tip + MARGIN, lowest))
    elastic = None if modes is None else np.asarray(modes, np.float64)
    return found.best(friction, force, weight, middle, elastic, yaw, count)


def _pairs(x: Array, n: Array, jaw: ParallelJaw, friction: float, centre: Array) -> tuple[Array, Array]:
    """Return middles (K, 3) and directions of closing (K,) of antipodal pairs, one per cell of place and direction."""
    i, j = np.triu_indices(len(x), 1)
    way = x[j] - x[i]
    long, flat = np.linalg.norm(way, axis=1), np.hypot(way[:, 0], way[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        level = flat / long
        facing = np.minimum(-np.einsum("kd,kd->k", n[i], way), np.einsum("kd,kd->k", n[j], way)) / long
    inside = np.minimum(facing, level) >= 1.0 / np.hypot(1.0, friction)
    if not inside.any():
        raise GraspError(
            "no two places of the object face each other sideways",
            hint=f"another --up or pose may help, or more friction than {friction:.2g}",
        )
    fits = inside & (flat <= jaw.opening - 2.0 * MARGIN)
    if not fits.any():
        raise GraspError(
            f"the object is {1e3 * flat[inside].min():.0f} mm wide where it is narrowest, the gripper takes "
            f"{1e3 * (jaw.opening - 2.0 * MARGIN):.0f} mm",
            hint=f"make it smaller: --size times {(jaw.opening - 2.0 * MARGIN) / flat[inside].min():.2f}",
        )
    i, j, way = i[fits], j[fits], way[fits]
    mid, angle = 0.5 * (x[i] + x[j]), np.remainder(np.arctan2(way[:, 1], way[:, 0]), np.pi)
    worth = np.minimum(facing, level)[fits] / (1.0 + np.linalg.norm(mid - centre, axis=1) / 0.04)
    cell = np.column_stack([np.floor(mid / _CELL[0]), np.floor(angle / _CELL[1])]).astype(np.int64)
    order = np.argsort(-worth, kind="stable")
    chosen = order[np.unique(cell[order], axis=0, return_index=True)[1]]
    chosen = chosen[np.argsort(-worth[chosen], kind="stable")][:CANDIDATES]
    return mid[chosen], angle[chosen]


class _Candidates:
    """Grasps at given places, each closed on what lies between its pads; arrays have one row per grasp."""

    def __init__(
        self, x: Array, n: Array, area: Array, solid: Array, jaw: ParallelJaw, mid: Array, angle: Array, least: float
    ) -> None:
        """Close the pads and look at what they touch."""
        self.jaw, self.angle = jaw, angle
        self.across = np.column_stack([np.cos(angle), np.sin(angle)])
        self.along = np.column_stack([self.across[:, 1], -self.across[:, 0]])
        c, a = self._offsets(solid, mid, self.across), self._offsets(solid, mid, self.along)
        # As low as the pair, but not in the ground, and not so low that the palm presses on what is under it.
        palm = (np.abs(a) <= jaw.palm[0] + MARGIN) & (np.abs(c) <= jaw.palm[1] + MARGIN)
        top = np.where(palm, solid[:, 2], -np.inf).max(axis=1) + MARGIN
        self.height = np.maximum(np.maximum(mid[:, 2], least), top - jaw.reach + jaw.tip)
        own = slice(len(x))
        level = x[:, 2] - self.height[:, None]
        half_length = 0.5 * jaw.pad_length
        held = (np.abs(a[:, own]) <= 0.5 * jaw.pad_width) & (np.abs(level) <= half_length)
        some = held.any(axis=1)
        high = np.where(some, np.where(held, c[:, own], -np.inf).max(axis=1), 0.0)
        low = np.where(some, np.where(held, c[:, own], np.inf).min(axis=1), 0.0)
        self.width = high - low
        self.touching = self.width > 0.0
        shift = 0.5 * (high + low)
        self.position = np.column_stack([mid[:, :2] + shift[:, None] * self.across, self.height])
        c = c - shift[:, None]
        half = 0.5 * self.width
        facing = n[:, :2] @ self.across.T  # (N, K)
        places, areas, normals, shares = [], [], [], []
        depth = np.minimum(DEPTH, 0.25 * self.width)
        for side in (1.0, -1.0):
            pressed = held & (side * c[:, own] >= (half - depth)[:, None])
            weight = np.where(pressed, np.maximum(side * facing.T, 0.0) * area, 0.0)
            total = weight.sum(axis=1)
            share = weight / np.maximum(total, 1e-300)[:, None]
            shares.append(share)
            places.append(np.column_stack([(share * q).sum(axis=1) for q in (a[:, own], c[:, own], level)]))
            # An edge between two faces has their resultant.
            mean = share @ n
            across = np.einsum("kd,kd->k", mean[:, :2], self.across)
            normals.append(side * across / np.maximum(np.linalg.norm(mean, axis=1), 1e-300))
            areas.append(total)
        self.contacts, self.area = np.stack(places, axis=1), np.minimum(*areas)
        self.shares = shares
        apart = self.contacts[:, 0] - self.contacts[:, 1]
        opposite = apart[:, 1] / np.maximum(np.linalg.norm(apart, axis=1), 1e-300)
        self.cosine = np.minimum(np.minimum(*normals), opposite)
        self.opening = self._free(solid, a, c, len(x))

    @staticmethod
    def _offsets(x: Array, mid: Array, axis: Array) -> Array:
        """Return coordinates (K, N) of points along an axis of each candidate."""
        return axis @ x[:, :2].T - np.einsum("kd,kd->k", axis, mid[:, :2])[:, None]

    def _free(self, solid: Array, a: Array, c: Array, own: int) -> Array:
        """Return the opening with which the fingers go down beside everything [m], 0 where there is none.

        The first `own` points are those of the object, which may lie between the fingers; the others may not.
        """
        jaw, found = self.jaw, np.zeros(len(c))
        lane = np.abs(a) <= 0.5 * jaw.finger_width + MARGIN
        lane &= solid[:, 2] >= (self.height - jaw.tip - MARGIN)[:, None]
        distance = np.where(lane, np.abs(c), np.inf)
        for room in (ROOM, 0.012, 0.008, 0.028, 0.036, np.inf):
            opening = np.minimum(self.width + room, jaw.opening)
            face = (0.5 * opening)[:, None]
            blocked = distance < face + jaw.thickness + MARGIN
            blocked[:, :own] &= distance[:, :own] > face - 0.5 * MARGIN
            free = ~blocked.any(axis=1) & (opening >= self.width + 2.0 * MARGIN)
            found = np.where((found == 0.0) & free, opening, found)
        return found

    def _yielding(self, modes: Array, force: float, weight: float) -> Array:
        """Return how far the contacts give way to the squeeze, and sink under the weight that they carry [m]."""
        size = len(modes)
        first, second = (share @ modes.reshape(size, -1) for share in self.shares)
        shape = (-1, 3, modes.shape[2])
        squeeze = np.einsum("kd,kdm->km", self.across, (first - second).reshape(shape)[:, :2])
        lift = 0.5 * (first + second).reshape(shape)[:, 2]
        return force * (squeeze**2).sum(axis=1) + weight * (lift**2).sum(axis=1)

    def best(
        self,
        friction: float,
        force: float,
        weight: float,
        centre: Array,
        modes: Array | None,
        yaw: float,
        count: int,
    ) -> tuple[Grasp, ...]:
        """Return the best candidates that are apart from each other."""
        jaw, cone = self.jaw, 1.0 / np.hypot(1.0, friction)
        narrow = self.touching & (self.width <= jaw.opening - 2.0 * MARGIN)
        held = narrow & (self.cosine > cone)
        fits = held & (self.opening > 0.0)
        if not fits.any():
            what, hint = self._trouble(narrow, held)
            raise GraspError(what, hint=hint)
        offset = centre - self.position
        lever = np.hypot(np.einsum("kd,kd->k", self.along, offset[:, :2]), np.maximum(offset[:, 2], 0.0))
        # Of an evenly pressed disc of the touched area, on both sides.
        torque = 4.0 / 3.0 * friction * force * np.sqrt(np.maximum(self.area, 1e-12) / np.pi)
        turn = np.remainder(self.angle - 0.5 * np.pi - yaw + 0.5 * np.pi, np.pi) - 0.5 * np.pi
        inside = np.clip((self.cosine - cone) / (1.0 - cone), 0.0, 1.0)
        pad = jaw.pad_width * jaw.pad_length
        score = inside * self.area / (self.area + 0.15 * pad)
        score /= 1.0 + (weight * lever / (0.25 * torque)) ** 2 + (lever / 0.04) ** 2
        if modes is not None:
            score /= 1.0 + self._yielding(modes, force, weight) / YIELD
        score *= 0.5 + 0.5 * np.minimum((self.opening - self.width) / ROOM, 1.0)
        score *= 1.0 - 0.1 * np.abs(turn) / np.pi
        order = np.argsort(-np.where(fits, score, -1.0), kind="stable")
        chosen: list[int] = []
        for k in order[: int(fits.sum())].tolist():
            way = np.linalg.norm(self.position[chosen] - self.position[k], axis=1)
            spin = np.abs(np.remainder(self.angle[chosen] - self.angle[k] + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
            if not ((way < _APART[0]) & (spin < _APART[1])).any():
                chosen.append(k)
            if len(chosen) == count:
                break
        return tuple(self._grasp(k, float(yaw + turn[k]), float(score[k])) for k in chosen)

    def _grasp(self, k: int, yaw: float, score: float) -> Grasp:
        """Return a candidate."""
        frame = np.column_stack([np.append(self.along[k], 0.0), np.append(self.across[k], 0.0), [0.0, 0.0, 1.0]])
        position = self.position[k]
        first, second = (tuple((position + frame @ place).tolist()) for place in self.contacts[k])
        return Grasp(
            position=tuple(position.tolist()),
            yaw=yaw,
            width=float(self.width[k]),
            opening=float(self.opening[k]),
            contacts=(first, second),
            area=float(self.area[k]),
            angle=float(np.arccos(np.clip(self.cosine[k], -1.0, 1.0))),
            score=score,
        )

    def _trouble(self, narrow: NDArray[np.bool_], held: NDArray[np.bool_]) -> tuple[str, str]:
        """Return why no candidate fits, and a remedy."""
        takes = self.jaw.opening - 2.0 * MARGIN
        if not self.touching.any():
            low = 1e3 * (self.jaw.tip - 0.5 * self.jaw.pad_length + MARGIN)
            return (
                f"the object is too flat: its sides lie below {low:.0f} mm, where the pads begin, or behind the palm",
                "make it larger with --size, or stand it up with --up",
            )
        if not narrow.any():
            least = float(self.width[self.touching].min())
            return (
                f"the object is {1e3 * least:.0f} mm wide between the pads, the gripper takes {1e3 * takes:.0f} mm",
                f"make it smaller: --size times {takes / least:.2f}",
            )
        if not held.any():
            return "the pads meet no two sides that friction holds", "another --up or more friction may help"
        return "the fingers find no room beside what they would grasp", "make it smaller with --size, or another --up"
