"""The shapes of the presets: soft objects of real sizes as level-set functions, with what paints them.

Each stands on its lowest point, z up, in metres. Nothing is read from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import KDTree

from softmode.objects.shapes.level_sets import (
    Array,
    Level,
    ball,
    blended,
    box,
    capsule,
    carved,
    cylinder,
    ellipsoid,
    follow,
    torus,
    union,
)
from softmode.splats.plush import plush_bounds, plush_colors, plush_signed_distance

Paint = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class PaintedSolid:
    """A solid with the colours of its surface."""

    level: Level
    """Its level-set function."""
    low: Sequence[float] | Array
    """Lower corner of a box that holds it [m]."""
    high: Sequence[float] | Array
    """Upper corner."""
    cell: float
    """Edge of the grid's cells that resolve it [m]."""
    paint: Paint
    """Colours 0..1 (N, 3) at points (N, 3)."""


# -- colours and curves -----------------------------------------------------------------------------------------------


def _rgb(code: str) -> Array:
    """Return a colour of six hexadecimal digits."""
    return np.array([int(code[k : k + 2], 16) / 255.0 for k in (0, 2, 4)])


WHITE, CREAM, BLACK = _rgb("f7f3ea"), _rgb("f3e3bd"), _rgb("23211f")


def _over(color: Array, top: Array, weight: Array) -> Array:
    """Return colours under a coat whose weight is 0..1, shape (N, 3)."""
    return color + np.clip(weight, 0.0, 1.0)[:, None] * (top - color)


def _within(distance: Array, soft: float) -> Array:
    """Return 1 where a distance is negative and 0 where it is positive, with an edge of a width."""
    return np.clip(0.5 - distance / soft, 0.0, 1.0)


def _noise(x: Array, wavelength: float, seed: int = 0) -> Array:
    """Return smooth noise of variance one, shape (N,)."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(24, x.shape[1]))
    waves *= 2.0 * np.pi / (wavelength * np.linalg.norm(waves, axis=1, keepdims=True))
    return np.sqrt(2.0 / 24) * np.cos(x @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 24)).sum(axis=1)


def _path(*pieces: tuple[float, float], step: float = 5e-4) -> Array:
    """Return a level curve through the origin along x, of pieces given by length [m] and turn [deg]."""
    turn = np.concatenate([np.full(round(long / step), np.radians(by) / round(long / step)) for long, by in pieces])
    heading = np.cumsum(turn) - 0.5 * turn
    ways = step * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(turn))])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(ways, axis=0)])


def _near(points: Array, radius: float) -> Level:
    """Return the balls around points that lie close together, such as those of a curve."""
    tree = KDTree(points)
    return lambda x: tree.query(x)[0] - radius


def _strokes(lines: list[list[tuple[float, float]]], scale: float) -> Callable[[Array], Array]:
    """Return the distance of points (N, 2) from polylines [m]."""
    ends = [(scale * np.array(a), scale * np.array(b)) for line in lines for a, b in pairwise(line)]
    parts = [capsule(a, b, 0.0) for a, b in ends]
    return union(*parts)


# -- shapes -----------------------------------------------------------------------------------------------------------


def bear() -> PaintedSolid:
    """Return the plush of `make_plush`, 10 cm high."""
    height = 0.10
    low, high = plush_bounds(height)
    return PaintedSolid(
        level=lambda x: plush_signed_distance(x, height),
        low=low,
        high=high,
        cell=1.2e-3,
        paint=lambda x: plush_colors(x, height) * (1.0 + 0.04 * _noise(x, 3e-3))[:, None],
    )


def sponge() -> PaintedSolid:
    """Return a kitchen sponge with a waist, pores and a scouring layer beneath."""
    half, rough = np.array([0.055, 0.036, 0.019]), 0.008
    rng = np.random.default_rng(2)
    place = half * rng.uniform(-1.0, 1.0, (330, 3))
    side = rng.choice(3, size=330, p=[0.2, 0.25, 0.55])
    place[np.arange(330), side] = half[side] * np.where(side == 2, 1.0, rng.choice([-1.0, 1.0], 330))
    place = place[place[:, 2] > rough - half[2] + 0.004]
    pores = [_near(place[k::3], radius) for k, radius in enumerate((0.0013, 0.0019, 0.0026))]
    cut = cylinder(0.06, -1.0, 1.0)
    waist = [lambda x, y=y: cut(x - [0.0, y, 0.0]) for y in (-0.092, 0.092)]
    solid = carved(0.004, box(2.0 * half, rounding=0.006), *waist)
    level = carved(0.001, solid, *pores)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("f6cf3f"), (len(x), 1)) * (1.0 + 0.03 * _noise(x, 5e-3))[:, None]
        color = _over(color, _rgb("b98213"), 0.8 * _within(union(*pores)(x) - 0.0002, 0.0008))
        green = np.tile(_rgb("3f7d4a"), (len(x), 1)) * (1.0 + 0.13 * _noise(x, 2.5e-3, 1))[:, None]
        return _over(color, green, _within(x[:, 2] - (rough - half[2]), 0.0006))

    return PaintedSolid(level=level, low=-half, high=half, cell=9e-4, paint=paint)


def toy_ball() -> PaintedSolid:
    """Return a small basketball of foam, with seams."""
    radius = 0.0325

    def seam(x: Array) -> Array:
        u = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
        return radius * np.min([np.abs(u[:, 1]), np.abs(u[:, 2]), np.abs(np.abs(u[:, 0]) - 0.72)], axis=0)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("d9722b"), (len(x), 1)) * (1.0 + 0.05 * _noise(x, 2e-3))[:, None]
        return _over(color, BLACK, _within(seam(x) - 0.0010, 0.0006))

    return PaintedSolid(
        level=lambda x: np.linalg.norm(x, axis=1) - radius + 0.0007 * np.exp(-((seam(x) / 0.0011) ** 2)),
        low=[-radius] * 3,
        high=[radius] * 3,
        cell=1e-3,
        paint=paint,
    )


def rope() -> PaintedSolid:
    """Return a rope of three strands, its ends bound."""
    curve = _path((0.05, 35.0), (0.12, -75.0), (0.05, 40.0))
    length, offset, strand, pitch = 0.22, 0.0050, 0.0050, 0.045
    local = follow(curve)
    bound, band = 0.010, 0.0102

    def cords(x: Array) -> tuple[Array, Array]:
        s, u, w = local(x)
        turn = 2.0 * np.pi * s / pitch + 2.0 * np.pi / 3.0 * np.arange(3)[:, None]
        return s, np.hypot(u - offset * np.cos(turn), w - offset * np.sin(turn)) - strand

    def level(x: Array) -> Array:
        s, each = cords(x)
        _, u, w = local(x)
        h = np.sort(each, axis=0)
        twisted = h[0] - 0.25 * np.maximum(0.0015 - (h[1] - h[0]), 0.0) ** 2 / 0.0015
        ends = np.maximum(np.hypot(u, w) - band, np.minimum(s, length - s) - bound)
        return np.maximum(np.minimum(twisted, ends), np.maximum(-s, s - length))

    def paint(x: Array) -> Array:
        s, each = cords(x)
        _, u, w = local(x)
        h = np.sort(each, axis=0)
        fibre = np.sin(2.0 * np.pi * (s / 0.0028 + 1.2 * np.arctan2(w, u) / np.pi))
        color = np.tile(_rgb("d8b98a"), (len(x), 1)) * (1.0 + 0.07 * fibre + 0.05 * _noise(x, 3e-3))[:, None]
        color = _over(color, _rgb("6d4c2a"), 0.75 * _within(h[1] - h[0] - 0.0008, 0.0012))
        binding = np.tile(_rgb("b3392f"), (len(x), 1)) * (1.0 + 0.08 * np.sin(2.0 * np.pi * s / 0.002))[:, None]
        color = _over(color, binding, _within(np.minimum(s, length - s) - bound, 0.0006))
        return _over(color, CREAM, _within(np.minimum(s, length - s) - 0.0003, 0.0003))

    low, high = curve.min(axis=0) - 0.012, curve.max(axis=0) + 0.012
    return PaintedSolid(level=level, low=low, high=high, cell=8e-4, paint=paint)


def cable() -> PaintedSolid:
    """Return a mains cable in a loop, a plug with two pins at one end and a connector at the other."""
    curve = _path((0.035, 0.0), (0.16, 205.0), (0.02, 0.0), (0.045, -85.0), (0.02, 0.0))
    down = np.clip((np.linspace(0.0, 0.28, len(curve)) - 0.012) / 0.03, 0.0, 1.0)
    curve[:, 2] = 0.011 - 0.007 * down**2 * (3.0 - 2.0 * down)
    wire = _near(curve, 0.004)
    end, way = curve[-1], curve[-1] - curve[-2]
    way = way / np.linalg.norm(way)
    plug = blended(
        0.004,
        box((0.034, 0.027, 0.022), (-0.014, 0.0, 0.011), 0.006),
        capsule((0.0, 0.0, 0.011), (0.022, 0.0, 0.0105), 0.0085, 0.0045),
    )
    pins = union(*(capsule((-0.031, y, 0.011), (-0.046, y, 0.011), 0.0026) for y in (-0.0075, 0.0075)))
    connector = blended(
        0.003, capsule(end - 0.004 * way, end + 0.02 * way, 0.0075), capsule(end - 0.018 * way, end, 0.0045, 0.007)
    )
    connector = carved(0.001, connector, lambda x: 0.022 - (x - end) @ way, lambda x: x[:, 2])

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("e8762c"), (len(x), 1))
        ridge = 1.0 + 0.25 * np.sin(2.0 * np.pi * x[:, 0] / 0.0035) * ((x[:, 0] > 0.004) & (x[:, 0] < 0.02))
        ends = np.tile(_rgb("33373d"), (len(x), 1)) * ridge[:, None]
        color = _over(color, ends, _within(np.minimum(plug(x), connector(x)) - 0.0004, 0.0005))
        color = _over(
            color,
            _rgb("5d6570"),
            _within(np.abs(np.hypot(x[:, 0] + 0.014, x[:, 1]) - 0.007) - 0.0012, 0.0006) * (x[:, 2] > 0.02),
        )
        return _over(color, _rgb("d9b65c"), _within(pins(x) - 0.0004, 0.0005) * _within(x[:, 0] + 0.0315, 0.0005))

    low, high = curve.min(axis=0) - 0.026, curve.max(axis=0) + 0.026
    return PaintedSolid(
        level=blended(0.0015, wire, plug, connector, pins),
        low=[min(low[0], -0.05), low[1], 0.0],
        high=[*high[:2], 0.024],
        cell=8e-4,
        paint=paint,
    )


def mug() -> PaintedSolid:
    """Return a mug with a handle and a wall of 5 mm."""
    radius, height, wall = 0.037, 0.088, 0.005

    def rounded(radius: float, low: float, high: float, by: float) -> Level:
        core = cylinder(radius - by, low + by, high - by)
        return lambda x: core(x) - by

    handle = torus(0.022, 0.0055, (0.0, 0.0, 0.0), axis=1)
    solid = blended(
        0.006, rounded(radius, 0.0, height, 0.004), lambda x: handle((x - [0.041, 0.0, 0.046]) * [1.0, 1.0, 0.85])
    )
    inside = rounded(radius - wall, 0.006, 0.3, 0.006)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("2f7f86"), (len(x), 1))
        row = np.floor(x[:, 2] / 0.0145)
        step = 2.0 * np.pi / 16.0
        turn = np.arctan2(x[:, 1], x[:, 0]) + 0.5 * step * (row % 2)
        across = radius * (np.remainder(turn, step) - 0.5 * step)
        dot = np.hypot(across, x[:, 2] - 0.0145 * (row + 0.5)) - 0.0036
        body = np.hypot(x[:, 0], x[:, 1]) - radius
        color = _over(color, WHITE, _within(dot, 0.0006) * (np.abs(body) < 0.0007) * (row < 5) * (row > 0))
        color = _over(color, WHITE, _within(inside(x) - 0.001, 0.0008))
        return _over(color, _rgb("d9a441"), _within(height - 0.0035 - x[:, 2], 0.0008))

    return PaintedSolid(
        level=carved(0.002, solid, inside),
        low=(-radius, -radius, 0.0),
        high=(0.072, radius, height),
        cell=1.1e-3,
        paint=paint,
    )


def banana() -> PaintedSolid:
    """Return a banana lying on its side."""
    length = 0.175
    local = follow(_path((0.03, 12.0), (0.115, 62.0), (0.03, 4.0)))
    profile = PchipInterpolator(
        [-0.1, 0.0, 0.012, 0.026, 0.05, 0.09, 0.13, 0.158, 0.17, 0.3],
        np.array([5.0, 5.0, 4.2, 6.0, 14.5, 16.8, 15.0, 8.0, 4.2, 3.6]) * 1e-3,
    )

    def frame(x: Array) -> tuple[Array, Array, Array]:
        s, u, w = local(x)
        return s, np.hypot(u, w), np.arctan2(w, u)

    def flank(x: Array) -> Array:
        s, out, turn = frame(x)
        return 0.92 * (out - profile(np.clip(s, -0.1, 0.3)) * (1.0 + 0.035 * np.cos(5.0 * turn)))

    level = carved(0.003, flank, lambda x: frame(x)[0], lambda x: length - frame(x)[0])

    def paint(x: Array) -> Array:
        s, _, turn = frame(x)
        peel = np.column_stack([s / 3.0, 0.014 * np.cos(turn), 0.014 * np.sin(turn)])
        color = np.tile(_rgb("f5cf36"), (len(x), 1)) * (1.0 + 0.03 * _noise(x, 0.03))[:, None]
        color = _over(color, _rgb("a9b23c"), 0.85 * np.maximum(1.0 - np.abs(s - 0.016) / 0.03, 0.0))
        color = _over(color, _rgb("b4b545"), 0.5 * np.clip((s - 0.145) / 0.02, 0.0, 1.0))
        color = _over(color, _rgb("c79a22"), 0.55 * np.clip(8.0 * (np.cos(5.0 * turn) - 0.9), 0.0, 1.0))
        spots = _within(1.75 - _noise(peel, 0.005, 3), 0.5) * np.clip((s - 0.03) / 0.02, 0.0, 1.0)
        color = _over(color, _rgb("6e4a1c"), 0.85 * spots)
        color = _over(color, _rgb("5b4022"), _within(s - 0.0035, 0.003))
        return _over(color, _rgb("2b211a"), _within(0.166 - s, 0.004))

    return PaintedSolid(level=level, low=(-0.02, -0.03, -0.019), high=(0.17, 0.13, 0.019), cell=1.1e-3, paint=paint)


def bread() -> PaintedSolid:
    """Return a loaf of tin bread, cut at one end."""
    half = 0.055
    loaf = blended(
        0.008,
        box((1.0, 0.066, 0.056), (0.0, 0.0, 0.028), 0.008),
        ellipsoid((3.0, 0.0395, 0.024), (0.0, 0.0, 0.054)),
    )
    slashes = [capsule((x - 0.007, -0.026, 0.079), (x + 0.007, 0.026, 0.079), 0.0045) for x in (-0.034, -0.006, 0.022)]
    solid = carved(0.014, loaf, lambda x: x[:, 0] + half, lambda x: x[:, 2])
    solid = carved(0.0012, solid, lambda x: half - x[:, 0])
    level = carved(0.004, solid, *slashes)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("c98a45"), (len(x), 1)) * (1.0 + 0.04 * _noise(x, 0.025))[:, None]
        color = _over(color, _rgb("8a4f20"), np.clip((x[:, 2] - 0.045) / 0.03, 0.0, 1.0))
        color = _over(color, _rgb("e6bd7d"), _within(union(*slashes)(x) - 0.0012, 0.002))
        crumb = np.tile(_rgb("f4e2b8"), (len(x), 1)) * (1.0 + 0.02 * _noise(x, 0.004))[:, None]
        crumb = _over(crumb, _rgb("cfa86a"), 0.9 * _within(1.25 - _noise(x, 0.0045, 5), 0.5))
        cut = _within(loaf(x) + 0.0035, 0.0015) * (x[:, 0] > half - 0.0015)
        return _over(color, crumb, cut)

    return PaintedSolid(level=level, low=(-half, -0.045, 0.0), high=(half, 0.045, 0.082), cell=1.1e-3, paint=paint)


def doughnut() -> PaintedSolid:
    """Return a doughnut with icing and sprinkles."""
    major, minor = 0.0255, 0.0145
    rng = np.random.default_rng(4)
    around, over = rng.uniform(0.0, 2.0 * np.pi, 90), rng.uniform(0.15, 0.85, 90) * np.pi
    out, way = major + (minor + 0.001) * np.cos(over), rng.uniform(0.0, np.pi, 90)
    place = np.column_stack([out * np.cos(around), out * np.sin(around), (minor + 0.001) * np.sin(over)])
    half = 0.0016 * np.column_stack([np.cos(way), np.sin(way), np.zeros(90)])
    grains = np.concatenate([place + t * half for t in (-1.0, -0.5, 0.0, 0.5, 1.0)])
    sprinkles, nearest = _near(grains, 0.0009), KDTree(grains)
    tints = np.array([_rgb(code) for code in ("f7f3ea", "f2c12e", "4aa3c7", "7bbf5a", "7a3fa0")])

    def icing(x: Array) -> Array:
        turn = np.arctan2(x[:, 1], x[:, 0])
        return 0.0015 + 0.0022 * np.sin(5.0 * turn + 0.4) + 0.0014 * np.sin(11.0 * turn) - x[:, 2]

    ring = torus(major, minor)

    def level(x: Array) -> Array:
        return np.minimum(ring(x) - 0.001 * _within(icing(x), 0.0025), sprinkles(x))

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("cf8f47"), (len(x), 1)) * (1.0 + 0.04 * _noise(x, 0.005))[:, None]
        color = _over(color, _rgb("ecca91"), _within(np.abs(x[:, 2] + 0.0035) - 0.0016, 0.003))
        color = _over(color, _rgb("ef8fb0"), _within(icing(x), 0.0008))
        return _over(color, tints[nearest.query(x)[1] % 90 % 5], _within(sprinkles(x) - 0.0003, 0.0005))

    span = major + minor + 0.0025
    return PaintedSolid(
        level=level, low=[-span, -span, -minor], high=[span, span, minor + 0.003], cell=8e-4, paint=paint
    )


def cushion() -> PaintedSolid:
    """Return a small cushion with piping and a button."""
    edge, thick = 0.0355, 0.0175
    line = np.linspace(-edge, edge, 160)
    bow = edge * (1.0 - 0.07 * (1.0 - (line / edge) ** 2))
    rim = np.concatenate([np.column_stack(p) for p in ((line, bow), (line, -bow), (bow, line), (-bow, line))])
    piping = _near(np.column_stack([rim, np.zeros(len(rim))]), 0.0024)
    button = union(*(ellipsoid((0.0065, 0.0065, 0.0028), (0.0, 0.0, s * 0.0112)) for s in (-1.0, 1.0)))

    def filling(x: Array) -> Array:
        a = np.abs(x[:, :2])
        border = edge * (1.0 - 0.07 * (1.0 - np.minimum(a / edge, 1.0) ** 2))
        free = np.clip(1.0 - (a / border[:, ::-1]) ** 2, 1e-4, 1.0).prod(axis=1)
        high = thick * free**0.42 * (1.0 - 0.42 * np.exp(-(x[:, :2] ** 2).sum(axis=1) / 0.011**2))
        out = (a - border[:, ::-1]).max(axis=1)
        return np.maximum(0.8 * (np.abs(x[:, 2]) - high), out)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("f1e6d0"), (len(x), 1)) * (1.0 + 0.02 * _noise(x, 0.002))[:, None]
        for axis, tint in ((0, "3c6e9f"), (1, "c2543f")):
            stripe = np.abs(np.remainder(x[:, axis] + 0.006, 0.012) - 0.006)
            color = _over(color, _rgb(tint), 0.55 * _within(stripe - 0.0026, 0.0006))
            color = _over(color, _rgb(tint), 0.8 * _within(np.abs(stripe - 0.0043) - 0.0003, 0.0004))
        color = _over(color, _rgb("2f5277"), _within(piping(x) - 0.0003, 0.0005))
        return _over(color, _rgb("c2543f"), _within(button(x) - 0.0003, 0.0005))

    span = edge + 0.004
    return PaintedSolid(
        level=blended(0.0012, filling, piping, button),
        low=(-span, -span, -0.019),
        high=(span, span, 0.019),
        cell=9e-4,
        paint=paint,
    )


def glove() -> PaintedSolid:
    """Return a child's knitted glove, lying flat, its cuff open."""
    fingers = [
        capsule((0.012, y, 0.0), (0.03 + long, 1.42 * y, 0.0), 0.0083, 0.0072)
        for y, long in ((-0.0225, 0.038), (-0.0075, 0.047), (0.0075, 0.044), (0.0225, 0.031))
    ]
    thumb = capsule((-0.022, -0.016, 0.0), (0.014, -0.052, 0.0), 0.0105, 0.0083)
    palm = box((0.058, 0.062, 0.020), (-0.004, 0.0, 0.0), 0.0098)
    tube = ellipsoid((3.0, 0.027, 0.0125), (-0.05, 0.0, 0.0))
    cuff = carved(0.003, tube, lambda x: x[:, 0] + 0.068, lambda x: -0.028 - x[:, 0])
    opening = carved(0.004, ellipsoid((3.0, 0.0215, 0.0068), (0.0, 0.0, 0.0)), lambda x: -0.040 - x[:, 0])
    solid = carved(0.0015, blended(0.006, palm, thumb, cuff, union(*fingers)), opening)
    turns = np.arange(0.0, 2.0 * np.pi, np.pi / 3.0)
    arms = [[(0.0, 0.0), (np.cos(a), np.sin(a))] for a in turns]
    tips = [[(0.53 * np.cos(a + b), 0.53 * np.sin(a + b)) for b in (-0.55, 0.55)] for a in turns]
    flake = _strokes([*arms, *tips], 0.012)

    def level(x: Array) -> Array:
        return solid(x) - 0.0004 * np.cos(2.0 * np.pi * x[:, 1] / 0.0045) * (x[:, 0] < -0.035)

    def paint(x: Array) -> Array:
        stitch = x[:, 0] + np.abs(np.remainder(x[:, 1], 0.004) - 0.002)
        knit = np.sin(2.0 * np.pi * x[:, 1] / 0.004) * np.sin(2.0 * np.pi * stitch / 0.005)
        wool = (1.0 + 0.10 * knit)[:, None]
        color = np.tile(_rgb("b23a48"), (len(x), 1)) * wool
        for row, tint in ((-0.031, CREAM), (-0.024, CREAM), (-0.0275, _rgb("2d4a63"))):
            color = _over(color, tint * wool, _within(np.abs(x[:, 0] - row) - 0.0016, 0.0006))
        ribs = np.tile(_rgb("2d4a63"), (len(x), 1)) * (1.0 + 0.18 * np.cos(2.0 * np.pi * x[:, 1] / 0.0045))[:, None]
        color = _over(color, ribs, _within(x[:, 0] + 0.035, 0.0006))
        return _over(color, CREAM * wool, _within(flake(x[:, :2]) - 0.0009, 0.0006) * (x[:, 2] > 0.0))

    return PaintedSolid(level=level, low=(-0.07, -0.064, -0.0135), high=(0.087, 0.044, 0.0135), cell=9e-4, paint=paint)


def fish() -> PaintedSolid:
    """Return a clownfish of rubber that stands on its belly."""
    body = ellipsoid((0.046, 0.019, 0.029), (0.006, 0.0, 0.0))
    stem = capsule((-0.02, 0.0, 0.001), (-0.048, 0.0, 0.002), 0.014, 0.008)
    tail = blended(0.006, *(ellipsoid((0.017, 0.0042, 0.011), (-0.060, 0.0, 0.002 + s * 0.0115)) for s in (-1.0, 1.0)))
    fins = [
        ellipsoid((0.026, 0.0042, 0.013), (0.004, 0.0, 0.026)),
        ellipsoid((0.012, 0.0042, 0.013), (-0.026, 0.0, -0.014)),
    ]
    side = np.array([[0.78, 0.55, 0.3], [-0.62, 0.70, 0.35], [-0.02, -0.46, 0.89]])
    hand = ellipsoid((0.013, 0.009, 0.0036))
    hands = [lambda x, s=s: hand((x * [1.0, s, 1.0] - [0.006, 0.021, -0.006]) @ side) for s in (-1.0, 1.0)]
    eyes = union(*(ball(0.0062, (0.034, s * 0.0115, 0.008)) for s in (-1.0, 1.0)))
    lips = torus(0.0042, 0.0022, (0.0505, 0.0, -0.002), axis=0)
    level = blended(0.0015, blended(0.007, blended(0.012, body, stem), tail, *fins, *hands), blended(0.002, lips), eyes)
    level = carved(0.003, level, lambda x: x[:, 2] + 0.0245)

    def paint(x: Array) -> Array:
        color = np.tile(_rgb("f07f1f"), (len(x), 1))
        color = _over(color, _rgb("ffb14a"), np.clip((-x[:, 2] - 0.004) / 0.02, 0.0, 0.7))
        row = np.floor(x[:, 2] / 0.0042)
        ring = np.hypot(np.remainder(x[:, 0] + 0.003 * (row % 2), 0.006) - 0.003, 0.8 * (x[:, 2] - 0.0042 * row))
        color = _over(color, _rgb("d3620f"), 0.45 * _within(np.abs(ring - 0.0031) - 0.0003, 0.0006))
        for middle, bulge, wide in ((0.020, 8.0, 0.0042), (-0.008, -6.0, 0.0052), (-0.044, 0.0, 0.0036)):
            band = np.abs(x[:, 0] - middle + bulge * x[:, 2] ** 2) - wide
            color = _over(color, BLACK, _within(band - 0.0016, 0.0007))
            color = _over(color, WHITE, _within(band, 0.0007))
        color = _over(color, BLACK, _within(0.0345 - x[:, 2], 0.001) + _within(x[:, 0] + 0.0715, 0.001))
        color = _over(color, _rgb("d9521f"), _within(lips(x) - 0.0005, 0.0006))
        look = np.abs(x - [0.034, 0.0, 0.008])
        color = _over(color, WHITE, _within(eyes(x) - 0.0004, 0.0005))
        pupil = np.hypot(x[:, 0] - 0.0355, x[:, 2] - 0.0085) - 0.0031
        color = _over(color, BLACK, _within(pupil, 0.0006) * (look[:, 1] > 0.0135))
        shine = np.hypot(x[:, 0] - 0.0366, x[:, 2] - 0.0099) - 0.0009
        return _over(color, WHITE, _within(shine, 0.0005) * (look[:, 1] > 0.0135))

    return PaintedSolid(level=level, low=(-0.08, -0.034, -0.027), high=(0.057, 0.034, 0.041), cell=9e-4, paint=paint)


_ARC = [(0.75 * np.cos(a), np.sin(a)) for a in np.radians(np.linspace(45.0, 315.0, 24))]
_BUMP = np.radians(np.linspace(90.0, -90.0, 10))
LETTERS: dict[str, list[list[tuple[float, float]]]] = {
    "A": [[(-0.75, -1.0), (0.0, 1.0), (0.75, -1.0)], [(-0.45, -0.25), (0.45, -0.25)]],
    "B": [
        [(-0.6, -1.0), (-0.6, 1.0)],
        [(-0.6, 1.0), *((0.1 + 0.42 * np.cos(a), 0.54 + 0.46 * np.sin(a)) for a in _BUMP), (-0.6, 0.08)],
        [(-0.6, 0.08), *((0.1 + 0.54 * np.cos(a), -0.46 + 0.54 * np.sin(a)) for a in _BUMP), (-0.6, -1.0)],
    ],
    "C": [_ARC],
}
"""Strokes of letters in the square -1..1."""


def letter_block(letter: str, tint: str) -> PaintedSolid:
    """Return a cube of foam with a letter sunk into each side.

    Args:
        letter: One of `LETTERS`.
        tint: Colour of letters and edges, six hexadecimal digits.
    """
    half, deep = 0.024, 0.0014
    stroke = _strokes(LETTERS[letter], 0.0115)

    def face(x: Array) -> tuple[Array, Array]:
        """Return how far out of the cube's middle points are (N,), and where on the nearest side, shape (N, 2)."""
        axis = np.abs(x).argmax(axis=1)
        sign = np.sign(np.take_along_axis(x, axis[:, None], axis=1))[:, 0]
        right = np.select([axis == 0, axis == 1], [sign * x[:, 1], -sign * x[:, 0]], x[:, 0])
        up = np.where(axis == 2, sign * x[:, 1], x[:, 2])
        return np.abs(x).max(axis=1), np.column_stack([right, up])

    def letters(x: Array) -> Array:
        out, at = face(x)
        return np.maximum(stroke(at) - 0.0030, half - deep - out)

    def paint(x: Array) -> Array:
        at = face(x)[1]
        color = np.tile(CREAM, (len(x), 1)) * (1.0 + 0.02 * _noise(x, 0.003))[:, None]
        frame = np.abs(np.abs(at).max(axis=1) - 0.0195)
        color = _over(color, _rgb(tint), _within(frame - 0.0011, 0.0005))
        color = _over(color, _rgb(tint), _within(0.0222 - np.abs(at).max(axis=1), 0.0005))
        return _over(color, _rgb(tint), _within(stroke(at) - 0.0032, 0.0005))

    return PaintedSolid(
        level=carved(0.0006, box([2.0 * half] * 3, rounding=0.004), letters),
        low=[-half] * 3,
        high=[half] * 3,
        cell=8e-4,
        paint=paint,
    )
