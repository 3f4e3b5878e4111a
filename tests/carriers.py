"""Captures made by code: shapes on plinths, turntables, stools, steps, stems and rocks, look-alikes, and rooms.

Each splat knows what it shows, so that a test can say whether the object was taken and its carrier was not. Faces have
few large splats and rims many fine ones, as trained captures have; there are frays at the rims and floaters around.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.splats.splats import SH_DC, Splats

Array = NDArray[np.float64]
OBJECT, CARRIER, GROUND, STRAY = range(4)
"""What a splat shows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """A capture made by code."""

    name: str
    """What it shows."""
    splats: Splats
    """The capture, its up within some degrees of z."""
    label: NDArray[np.intp]
    """What each splat shows, shape (N,)."""
    volume: float
    """Volume of the object, cut where it touches its carrier."""
    carried: bool
    """Whether anything carries it."""


@dataclass(kw_only=True, eq=False)
class Solid:
    """A closed surface that is sampled, and a test of what lies in it."""

    mesh: trimesh.Trimesh
    inside: Callable[[Array], NDArray[np.bool_]]
    """Of points in its own frame, shape (N, 3)."""
    flat: bool = False
    """Whether its faces have few large splats."""
    turn: Array
    at: Array
    label: int = OBJECT

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie in it."""
        local = (points - self.at) @ self.turn
        low, high = np.asarray(self.mesh.bounds)
        near = (np.abs(2.0 * local - low - high) < 1.1 * (high - low)).all(axis=1)
        found = np.zeros(len(points), dtype=bool)
        found[near] = self.inside(local[near])
        return found

    @property
    def corners(self) -> Array:
        """Its corners where it stands, shape (N, 3)."""
        return np.asarray(self.mesh.vertices) @ self.turn.T + self.at


def _solid(mesh: Any, inside: Any, at: Any = (0, 0, 0), turn: Any = (0, 0, 0), flat: bool = False) -> Solid:
    frame = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return Solid(mesh=mesh, inside=inside, flat=flat, turn=frame, at=np.asarray(at, dtype=np.float64))


def box(x: float, y: float, z: float, **place: Any) -> Solid:
    """Return a box of edges x, y, z around its place."""
    half = 0.5 * np.array([x, y, z])
    return _solid(trimesh.creation.box((x, y, z)), lambda p: (np.abs(p) < half).all(axis=1), flat=True, **place)


def lathe(profile: list[tuple[float, float]], flat: bool = False, **place: Any) -> Solid:
    """Return what a closed polygon of radii and heights sweeps around z."""
    line = np.asarray(profile, dtype=np.float64)
    ends = line[[0, -1]]
    closed = line if np.allclose(*ends) or (ends[:, 0] < 1e-9).all() else np.vstack([line, line[:1]])
    mesh = trimesh.creation.revolve(closed, sections=64)
    if mesh.volume < 0.0:
        mesh.invert()
    start, end = line, np.roll(line, -1, axis=0)

    def inside(p: Array) -> NDArray[np.bool_]:
        """Count how often a ray outwards crosses the polygon."""
        r, z = np.hypot(p[:, 0], p[:, 1])[:, None], p[:, 2, None]
        rise = end[:, 1] - start[:, 1]
        crosses = (start[:, 1] > z) != (end[:, 1] > z)
        at = start[:, 0] + (z - start[:, 1]) * (end[:, 0] - start[:, 0]) / np.where(rise == 0.0, 1.0, rise)
        return (crosses & (r < at)).sum(axis=1) % 2 == 1

    return _solid(mesh, inside, flat=flat, **place)


def can(radius: float, height: float, *, top: float | None = None, flat: bool = True, **place: Any) -> Solid:
    """Return a cylinder or a cone."""
    h, top = 0.5 * height, radius if top is None else top
    return lathe([(0, -h), (radius, -h), (top, h), (0, h)], flat=flat, **place)


def blob(a: float, b: float, c: float, rough: float = 0.0, seed: int = 0, power: float = 2.0, **place: Any) -> Solid:
    """Return a super-ellipsoid with bumps."""
    rng, half = np.random.default_rng(seed), np.array([a, b, c])
    waves, phase = 3.0 * rng.normal(size=(8, 3)), rng.uniform(0.0, 7.0, 8)

    def radius(d: Array) -> Array:
        base = (np.abs(d / half) ** power).sum(axis=1) ** (-1.0 / power)
        return base * (1.0 + 2.5 * rough * np.sin(d @ waves.T + phase).mean(axis=1))

    mesh = trimesh.creation.icosphere(5)
    mesh.vertices = mesh.vertices * radius(np.asarray(mesh.vertices))[:, None]

    def inside(p: Array) -> NDArray[np.bool_]:
        length = np.linalg.norm(p, axis=1)
        return length < radius(p / np.maximum(length, 1e-9)[:, None])

    return _solid(mesh, inside, **place)


def rod(start: Any, end: Any, radius: float) -> Solid:
    """Return a rod with round ends between two points."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length, arc = float(np.linalg.norm(end - start)), np.linspace(-0.5 * np.pi, 0.0, 8)
    cap = [(radius * np.cos(t), radius * np.sin(t)) for t in arc]
    found = lathe([*cap, *((r, length - z) for r, z in cap[::-1])])
    found.turn = Rotation.align_vectors([(end - start) / length], [[0.0, 0.0, 1.0]])[0].as_matrix()
    found.at = start
    return found


def ring(big: float, small: float, **place: Any) -> Solid:
    """Return a torus around z."""
    arc = np.linspace(0.0, 2.0 * np.pi, 25)
    return lathe([(big + small * np.cos(t), small * np.sin(t)) for t in arc], **place)


# -- objects: their lowest point is a little under z = 0 --------------------------------------------------------------


def bust() -> list[Solid]:
    """Return a head and shoulders."""
    foot = can(0.13, 0.16, flat=False, top=0.1, at=(0, 0, 0.06))
    head, chest = blob(0.19, 0.22, 0.27, 0.05, 1, at=(0, 0, 0.72)), blob(0.4, 0.2, 0.22, 0.04, 2, at=(0, 0, 0.3))
    return [head, rod((0, 0, 0.2), (0, 0, 0.6), 0.1), chest, foot]


def bear() -> list[Solid]:
    """Return a sitting bear."""
    found = [blob(0.26, 0.22, 0.3, at=(0, 0, 0.32)), blob(0.2, 0.19, 0.19, at=(0, 0.03, 0.74))]
    for s in (1, -1):
        found += [blob(0.07, 0.05, 0.07, at=(s * 0.15, 0.03, 0.92))]
        found += [rod((s * 0.18, 0.02, 0.45), (s * 0.36, 0.16, 0.3), 0.07)]
        found += [rod((s * 0.14, 0.05, 0.07), (s * 0.2, 0.34, 0.075), 0.085)]
    return found


def figure() -> list[Solid]:
    """Return a standing figure."""
    found = [rod((0.1, 0, 0.05), (0.08, 0.02, 0.48), 0.075), rod((-0.12, 0.05, 0.05), (-0.07, 0, 0.48), 0.075)]
    found += [blob(0.2, 0.13, 0.28, 0.05, 3, at=(0, 0, 0.68)), blob(0.1, 0.11, 0.13, at=(0, 0, 1.06))]
    found += [rod((0, 0, 0.9), (0, 0, 1.0), 0.05), blob(0.19, 0.15, 0.1, 0.1, 4, at=(0, 0, 0.5))]
    found += [rod((0.17, 0, 0.85), (0.36, 0.05, 0.62), 0.05), rod((-0.17, 0, 0.85), (-0.3, 0.2, 1.0), 0.05)]
    return [*found, blob(0.07, 0.12, 0.05, at=(0.1, 0.04, 0.03)), blob(0.07, 0.12, 0.05, at=(-0.12, 0.09, 0.03))]


def vase() -> list[Solid]:
    """Return a vase."""
    outer = [(0.14, -0.01), (0.17, 0.03), (0.3, 0.3), (0.28, 0.5), (0.14, 0.72), (0.12, 0.8), (0.18, 0.9)]
    return [lathe([(0, -0.01), *outer, (0, 0.9)])]


def teapot() -> list[Solid]:
    """Return a teapot."""
    handle, spout = ring(0.13, 0.035, at=(0.33, 0, 0.24), turn=(90, 0, 0)), rod((-0.2, 0, 0.2), (-0.5, 0, 0.38), 0.05)
    foot = can(0.17, 0.08, flat=False, at=(0, 0, 0.03))
    return [blob(0.3, 0.3, 0.24, at=(0, 0, 0.22)), handle, spout, blob(0.06, 0.06, 0.06, at=(0, 0, 0.49)), foot]


def dog() -> list[Solid]:
    """Return a dog on four legs."""
    found = [rod((x, y, 0.05), (0.9 * x, y, 0.42), 0.055) for x in (0.28, -0.28) for y in (0.1, -0.1)]
    found += [blob(0.4, 0.15, 0.16, 0.06, 5, at=(0, 0, 0.48)), blob(0.15, 0.1, 0.12, at=(0.45, 0, 0.72))]
    found += [rod((0.3, 0, 0.52), (0.42, 0, 0.68), 0.08), rod((-0.36, 0, 0.52), (-0.55, 0, 0.75), 0.03)]
    return [*found, blob(0.09, 0.05, 0.05, at=(0.6, 0, 0.69))]


def duck() -> list[Solid]:
    """Return a duck."""
    body, head = blob(0.4, 0.26, 0.22, 0.03, 6, at=(0, 0, 0.2)), blob(0.16, 0.15, 0.16, at=(0.28, 0, 0.5))
    bill, tail = blob(0.11, 0.06, 0.03, at=(0.46, 0, 0.48)), blob(0.12, 0.08, 0.06, at=(-0.42, 0, 0.3), turn=(0, 35, 0))
    return [body, head, bill, tail]


def bird() -> list[Solid]:
    """Return a bird on two legs."""
    found = [blob(0.3, 0.17, 0.17, 0.04, 7, at=(0, 0, 0.4), turn=(0, -25, 0)), blob(0.11, 0.1, 0.1, at=(0.24, 0, 0.64))]
    found += [rod((0.32, 0, 0.63), (0.44, 0, 0.6), 0.025), blob(0.2, 0.06, 0.03, at=(-0.35, 0, 0.22), turn=(0, -35, 0))]
    for s in (1, -1):
        found += [rod((0.05, s * 0.07, 0), (0.02, s * 0.07, 0.3), 0.04), blob(0.1, 0.06, 0.03, at=(0.07, s * 0.07, 0))]
    return found


def sitter() -> list[Solid]:
    """Return a figure that sits on a rock of its own."""
    found = [blob(0.42, 0.36, 0.38, 0.1, 8, at=(0, 0, 0.18)), blob(0.19, 0.15, 0.28, 0.05, 9, at=(0, -0.05, 0.74))]
    found += [blob(0.1, 0.11, 0.13, at=(0, 0, 1.1))]
    for s in (1, -1):
        found += [rod((s * 0.1, 0, 0.56), (s * 0.14, 0.34, 0.5), 0.08)]
        found += [rod((s * 0.14, 0.34, 0.5), (s * 0.15, 0.4, 0.08), 0.06)]
        found += [rod((s * 0.18, -0.05, 0.9), (s * 0.28, 0.2, 0.6), 0.05)]
    return found


def hoop() -> list[Solid]:
    """Return an upright ring on a foot."""
    return [ring(0.33, 0.12, at=(0, 0, 0.44), turn=(90, 0, 0)), blob(0.2, 0.14, 0.06, at=(0, 0, 0.02))]


def robot() -> list[Solid]:
    """Return a robot of boxes."""
    found = [box(0.16, 0.22, 0.34, at=(s * 0.12, 0, 0.16)) for s in (1, -1)]
    found += [box(0.46, 0.28, 0.38, at=(0, 0, 0.51)), box(0.24, 0.22, 0.22, at=(0, 0, 0.8))]
    found += [box(0.1, 0.14, 0.36, at=(s * 0.28, 0, 0.5)) for s in (1, -1)]
    return [*found, rod((0, 0, 0.9), (0, 0, 1.02), 0.02), blob(0.05, 0.05, 0.05, at=(0, 0, 1.04))]


def car() -> list[Solid]:
    """Return a car."""
    wheels = [can(0.11, 0.08, flat=False, at=(x, y, 0.1), turn=(90, 0, 0)) for x in (0.3, -0.3) for y in (0.21, -0.21)]
    hood, cabin = (
        blob(0.52, 0.22, 0.13, power=6.0, at=(0, 0, 0.2)),
        blob(0.28, 0.19, 0.13, power=4.0, at=(-0.05, 0, 0.38)),
    )
    return [*wheels, hood, cabin]


SHAPES = (bust, bear, figure, vase, teapot, dog, duck, bird, sitter, hoop, robot, car)


# -- look-alikes: nothing carries them ---------------------------------------------------------------------------------


def cup() -> list[Solid]:
    """Return a goblet on its foot."""
    stem = [(0.2, 0), (0.2, 0.03), (0.04, 0.06), (0.035, 0.3), (0.06, 0.36)]
    return [lathe([(0, 0), *stem, (0.24, 0.5), (0.27, 0.8), (0.24, 0.8), (0.2, 0.52), (0, 0.42)])]


def mushroom() -> list[Solid]:
    """Return a mushroom."""
    cap = [(0.3, 0.4), (0.36, 0.46), (0.32, 0.6), (0.2, 0.72)]
    return [lathe([(0, 0), (0.09, 0), (0.075, 0.2), (0.07, 0.5), (0, 0.5)]), lathe([(0, 0.44), *cap, (0, 0.76)])]


def lamp() -> list[Solid]:
    """Return a lamp."""
    shade = lathe([(0, 0.58), (0.3, 0.58), (0.18, 0.92), (0, 0.92)])
    return [can(0.22, 0.05, at=(0, 0, 0.025)), can(0.022, 0.6, flat=False, at=(0, 0, 0.34)), shade]


def flat_car() -> list[Solid]:
    """Return a car of boxes on wheels."""
    wheels = [
        can(0.09, 0.06, flat=False, at=(x, y, 0.085), turn=(90, 0, 0)) for x in (0.32, -0.3) for y in (0.23, -0.23)
    ]
    return [*wheels, box(1.1, 0.48, 0.16, at=(0, 0, 0.17)), box(0.5, 0.42, 0.2, at=(-0.08, 0, 0.34))]


def skirted_car() -> list[Solid]:
    """Return a car with closed skirts down to the ground."""
    return [box(1.1, 0.5, 0.28, at=(0, 0, 0.14)), box(0.55, 0.44, 0.2, at=(-0.08, 0, 0.37))]


def basket() -> list[Solid]:
    """Return a block with an arched handle."""
    return [box(0.76, 0.4, 0.42, at=(0, 0, 0.21)), ring(0.32, 0.02, at=(0, 0, 0.42), turn=(90, 0, 0))]


def house() -> list[Solid]:
    """Return a house with a chimney."""
    roof = lathe([(0, 0.5), (0.55, 0.5), (0, 0.85)])
    return [box(0.8, 0.7, 0.5, at=(0, 0, 0.25)), roof, box(0.1, 0.1, 0.3, at=(0.25, 0.1, 0.75))]


def dome() -> list[Solid]:
    """Return a bell with a knob."""
    bell = [(0.4, 0), (0.38, 0.1), (0.3, 0.35), (0.15, 0.48)]
    return [lathe([(0, 0), *bell, (0, 0.5)]), blob(0.08, 0.08, 0.08, at=(0, 0, 0.55))]


def chair() -> list[Solid]:
    """Return a chair."""
    legs = [box(0.06, 0.06, 0.45, at=(x, y, 0.225)) for x in (0.2, -0.2) for y in (0.2, -0.2)]
    return [*legs, box(0.5, 0.5, 0.06, at=(0, 0, 0.46)), box(0.06, 0.5, 0.5, at=(-0.22, 0, 0.72))]


LOOKALIKES = (cup, mushroom, lamp, flat_car, skirted_car, basket, house, dome, chair)


# -- carriers: their top is at z = 0 -----------------------------------------------------------------------------------


def _feet(width: float, height: float, thick: float, count: int) -> list[Solid]:
    angles = 0.4 + 2.0 * np.pi * np.arange(count) / count
    spread = [(np.cos(a), np.sin(a)) for a in angles]
    legs = [
        rod((0.35 * width * x, 0.35 * width * y, -0.05), (0.42 * width * x, 0.42 * width * y, -height), 0.035)
        for x, y in spread
    ]
    return [can(0.5 * width, thick, at=(0, 0, -0.5 * thick)), *legs]


def _column(width: float, height: float) -> list[Solid]:
    foot = [(0.5 * width, -height), (0.5 * width, -0.9 * height), (0.35 * width, -0.8 * height)]
    head = [(0.33 * width, -0.2 * height), (0.47 * width, -0.1 * height), (0.47 * width, 0)]
    return [lathe([(0, -height), *foot, *head, (0, 0)], flat=True)]


def _steps(width: float, height: float) -> list[Solid]:
    upper = box(width, width, 0.3 * height, at=(0, 0, -0.15 * height))
    return [upper, box(1.3 * width, 1.3 * width, 0.7 * height, at=(0, 0, -0.65 * height))]


SMOOTH: dict[str, Callable[[float, float], list[Solid]]] = {
    "box": lambda w, h: [box(w, 0.8 * w, h, at=(0, 0, -0.5 * h))],
    "cylinder": lambda w, h: [can(0.5 * w, h, at=(0, 0, -0.5 * h))],
    "steps": _steps,
    "turntable": lambda w, h: [can(0.7 * w, 0.06, at=(0, 0, -0.03))],
    "stool": lambda w, h: _feet(w, 1.2 * h, 0.07, 3),
    "column": _column,
}
"""Carriers by width and height."""


def rock(width: float, height: float) -> list[Solid]:
    """Return a block with a rough top."""
    place = {"at": (0, 0, 0.01 - 0.5 * height)}
    return [blob(0.5 * width, 0.42 * width, 0.5 * height, 0.05, int(100 * width), power=7.0, **place)]


# -- captures ----------------------------------------------------------------------------------------------------------


def carried(seed: int, *, rough: bool = False, count: int | None = None) -> Made:
    """Return a shape on a carrier; which, its size, turn, tilt, splats and ground by chance."""
    rng = np.random.default_rng(seed)
    shape, kind = SHAPES[seed % len(SHAPES)], "rock" if rough else str(rng.choice(list(SMOOTH)))
    turn, share, height = rng.uniform(0.0, 360.0), rng.uniform(0.5, 0.9), rng.uniform(0.15, 1.0)
    prims = shape()
    points = np.concatenate([prim.corners for prim in prims])
    foot = points[points[:, 2] < 0.08]
    reach = float(np.ptp(foot[:, :2], axis=0).max())
    width = 1.1 * max(reach / share, 0.75 * float(np.ptp(points[:, :2], axis=0).max()))
    frame = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    middle = frame @ (*foot[:, :2].mean(axis=0), 0.0)
    for prim in prims:
        prim.turn, prim.at = frame @ prim.turn, frame @ prim.at - middle
    below = (rock if rough else SMOOTH[kind])(width, height)
    for prim in below:
        prim.label = CARRIER
    return render(
        [*prims, *below],
        f"{shape.__name__} on {kind}",
        rng,
        tilt=float(rng.uniform(0.0, 8.0)),
        ground=rng.random() < 0.3,
        wide=float(rng.choice([3.2, 10.0])),
        open_below=rng.random() < 0.5,
        count=count or int(rng.integers(20, 45)) * 1000,
    )


def bare(seed: int, *, count: int | None = None) -> Made:
    """Return a shape or a look-alike that nothing carries."""
    rng = np.random.default_rng(seed)
    shapes = (*LOOKALIKES, *SHAPES)
    shape = shapes[seed % len(shapes)]
    options: dict[str, Any] = {"tilt": float(rng.uniform(0.0, 6.0)), "ground": rng.random() < 0.4}
    options |= {"wide": float(rng.choice([3.2, 10.0])), "open_below": rng.random() < 0.5}
    return render(shape(), shape.__name__, rng, count=count or int(rng.integers(20, 45)) * 1000, **options)


def room(seed: int, *, count: int = 60_000) -> Made:
    """Return a floor with three or four walls and furniture, none of which stands alone in its middle."""
    rng = np.random.default_rng(seed)
    wide, deep = rng.uniform(3.0, 6.0), rng.uniform(3.0, 5.0)
    sides = [((0, -0.5 * deep), (wide, 0.1)), ((0, 0.5 * deep), (wide, 0.1)), ((-0.5 * wide, 0), (0.1, deep))]
    sides += [((0.5 * wide, 0), (0.1, deep))] if rng.random() < 0.5 else []
    prims = [box(wide, deep, 0.1, at=(0, 0, -0.05))]
    prims += [box(*size, 2.5, at=(*at, 1.25)) for at, size in sides]
    for _ in range(int(rng.integers(3, 7))):
        x, y = rng.uniform(-0.4, 0.4) * wide, rng.uniform(-0.4, 0.4) * deep
        a, b, c = rng.uniform([0.4, 0.4, 0.4], [1.4, 0.9, 1.4])
        prims.append(
            box(a, b, c, at=(x, y, 0.5 * c))
            if rng.random() < 0.7
            else blob(0.4 * a, 0.4 * b, 0.4 * c, at=(x, y, 0.4 * c))
        )
    return render(prims, "room", rng, count=count, wide=3.2, indoors=True)


def render(
    prims: list[Solid],
    name: str,
    rng: np.random.Generator,
    *,
    count: int,
    tilt: float = 0.0,
    ground: bool = False,
    wide: float = 3.2,
    open_below: bool = False,
    indoors: bool = False,
) -> Made:
    """Cover solids with splats as a trained capture has them.

    Args:
        prims: What is seen.
        name: Name of the capture.
        rng: What chance is taken from.
        count: About how many splats.
        tilt: By how much it leans [degrees].
        ground: Whether it stands on a ground.
        wide: How much wider than others the splats in the middle of flat faces are; from five on most of it is bare.
        open_below: Whether its lowest face was not seen.
        indoors: Whether it was seen from inside the box around it.
    """
    base = min(prim.corners[:, 2].min() for prim in prims)
    pitch = float(np.sqrt(sum(prim.mesh.area for prim in prims) / (1.4 * count)))
    carries = any(prim.label == CARRIER for prim in prims)
    few, share = (0.08, 0.75) if wide < 5.0 else (0.012, 0.95)
    rows: list[tuple[Array, Array, Array, int]] = []
    for prim in prims:
        found: Any = trimesh.sample.sample_surface(
            prim.mesh, int(1.3 * prim.mesh.area / pitch**2), seed=int(rng.integers(2**31))
        )
        x, face = found
        x, n = x @ prim.turn.T + prim.at, prim.mesh.face_normals[face] @ prim.turn.T
        hidden = np.zeros(len(x), dtype=bool)
        for other in prims:
            hidden |= other.holds(x + 0.1 * pitch * n) if other is not prim else False
        if open_below or ground:
            hidden |= (x[:, 2] < base + 0.3 * pitch) & (n[:, 2] < -0.9)
        if indoors:
            low, high = (
                np.array([f(p.corners[:, k]) for p in prims for k in range(3)]).reshape(-1, 3) for f in (np.min, np.max)
            )
            low, high = low.min(axis=0) + 0.05, high.max(axis=0) - 0.05
            hidden |= (((x < low) & (n < -0.5)) | ((x > high) & (n > 0.5)))[:, :2].any(axis=1)
            hidden |= (x[:, 2] < low[2]) & (n[:, 2] < 0.5)
        # What would reach through a thin carrier is not there.
        hidden |= carries & (prim.label == OBJECT) & (x[:, 2] < -0.03)
        size = np.ones(len(x))
        if prim.flat:
            middle = rng.random(len(x)) < share
            hidden |= middle & (rng.random(len(x)) > few)
            size[middle] = wide
        keep = ~hidden
        x, n, size = x[keep], n[keep], size[keep]
        if prim.label == CARRIER and prim.flat:
            rim = np.flatnonzero((np.abs(x[:, 2]) < 2.0 * pitch) & (np.abs(n[:, 2]) < 0.3))
            if len(rim):
                rim = rng.choice(rim, 3 * len(rim))
                fine = x[rim] + rng.normal(0.0, 0.5 * pitch, (len(rim), 3)) * (1.0, 1.0, 0.3)
                x, n, size = np.r_[x, fine], np.r_[n, n[rim]], np.r_[size, np.full(len(rim), 0.5)]
        rows.append((x, n, size, prim.label))
    x, n, size = (np.concatenate([row[k] for row in rows]) for k in range(3))
    label = np.concatenate([np.full(len(row[0]), row[3]) for row in rows])
    m = len(x)
    n = n + rng.normal(0.0, 0.12, n.shape) / size[:, None]
    flat = pitch * size[:, None] * np.exp(rng.normal(0.0, 0.25, (m, 2))) * (0.9, 0.65)
    scales = np.column_stack([flat, 0.12 * pitch * np.exp(rng.normal(0.0, 0.3, m))])
    x = x + n * rng.normal(0.0, 0.12 * pitch, (m, 1))
    sets = [(x, n, scales, np.clip(rng.beta(8.0, 1.5, m), 0.05, 0.99), label)]
    low, high = x.min(axis=0), x.max(axis=0)
    rim = x[(label == CARRIER) & (np.abs(x[:, 2]) < 1.5 * pitch)]
    if len(rim):  # Frays: the outermost splats of the rim again, shifted, faint and turned.
        away = np.linalg.norm(rim[:, :2], axis=1)
        rim = rim[away > np.quantile(away, 0.8)]
        rim = rim[rng.integers(0, len(rim), max(150, count // 50))]
        sizes = pitch * rng.uniform(0.3, 1.5, rim.shape)
        sets += [_strewn(rng, rim + rng.normal(0.0, 1.5 * pitch, rim.shape), sizes, (0.1, 0.9), STRAY)]
    if ground:
        edge = 1.2 * float(np.ptp(x[:, :2], axis=0).max())
        plan = rng.uniform(-edge, edge, (int(edge**2 / pitch**2), 2))
        points = np.column_stack([plan, np.full(len(plan), base)])
        points = points[~np.any([prim.holds(points + np.array([0.0, 0.0, 0.5 * pitch])) for prim in prims], axis=0)]
        m = len(points)
        sizes = pitch * np.column_stack([rng.uniform(1.0, 2.5, (m, 2)), np.full(m, 0.15)])
        normals = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.05, (m, 3))
        points[:, 2] += rng.normal(0.0, 0.2 * pitch, m)
        sets += [(points, normals, sizes, rng.uniform(0.6, 0.99, m), np.full(m, GROUND))]
    stray = rng.uniform(low - 0.3, high + 0.3, (120, 3))
    sets += [_strewn(rng, stray, pitch * rng.uniform(0.5, 3.0, (120, 3)), (0.05, 0.6), STRAY)]
    x, n, scales, opacities, label = (np.concatenate([part[k] for part in sets]) for k in range(5))
    trial = rng.uniform(x[label == OBJECT].min(axis=0), x[label == OBJECT].max(axis=0), (300_000, 3))
    within = np.any([prim.holds(trial) for prim in prims if prim.label == OBJECT], axis=0)
    for prim in prims:
        within &= (prim.label == OBJECT) | ~prim.holds(trial)
    within &= (not carries) | (trial[:, 2] > -0.03)
    volume = float(within.mean() * np.ptp(x[label == OBJECT], axis=0).prod())
    lean = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(1.0 + count), np.sin(1.0 + count), 0.0]))
    tint = np.where(label[:, None] == OBJECT, (0.75, 0.5, 0.35) + 0.15 * np.sin(9.0 * x + 4.0 * x[:, [1, 2, 0]]), 0.6)
    splats = Splats(
        means=lean.apply(x),
        scales=scales,
        quats=(lean * _frames(rng, n)).as_quat(),
        opacities=opacities,
        sh=((np.clip(tint + rng.normal(0.0, 0.03, x.shape), 0.0, 1.0) - 0.5) / SH_DC)[:, None],
        name=name,
    )
    return Made(name=name, splats=splats, label=label, volume=volume, carried=carries)


def _strewn(rng: np.random.Generator, points: Array, sizes: Array, faint: tuple[float, float], label: int) -> Any:
    """Return splats turned at random."""
    m = len(points)
    return points, rng.normal(size=(m, 3)), sizes, rng.uniform(*faint, m), np.full(m, label)


def _frames(rng: np.random.Generator, normals: Array) -> Rotation:
    """Return rotations whose third axes are normals (N, 3), turned around them at random."""
    third = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.cross(third, rng.normal(size=third.shape))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([first, np.cross(third, first), third], axis=2))


SETS: dict[str, Callable[[int], Made]] = {
    "smooth": carried,
    "rough": partial(carried, rough=True),
    "bare": bare,
    "room": room,
}
"""Captures by seed."""
