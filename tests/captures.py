"""Captures of known solids: level-set functions rendered as shells of splats, with the faults that captures have.

`SHELLS` are clean shells of solids whose volume is known; `render_shell` takes how many splats and how thick they are.
`CAPTURES` are twelve scenes as a scanner gives them: with a ground or a room around the object, with floaters, in
millimetres, sparse or dense. Each knows what the object in it is, so that a test can say whether it came out whole.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.objects.shapes.level_sets import Level, ball, box, cylinder, ellipsoid, torus, union, without
from softmode.splats.splats import SH_DC, Splats, rotations_from_quats

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A solid by its level-set function, a distance near its surface."""

    level: Level
    """Distance of points (N, 3) [m], negative inside."""
    bounds: Array
    """Its bounding box [m], shape (2, 3)."""

    @functools.cached_property
    def moments(self) -> tuple[float, Array]:
        """Volume [m^3] and centre of mass [m], counted on a grid of 200 cells along the longest edge."""
        edge = float(np.ptp(self.bounds, axis=0).max()) / 200.0
        axes = [np.arange(low - 1.5 * edge, high + 1.5 * edge, edge) for low, high in self.bounds.T]
        volume, first = 0.0, np.zeros(3)
        for z in axes[2]:
            x = np.stack(np.meshgrid(axes[0], axes[1], [z], indexing="ij"), axis=-1).reshape(-1, 3)
            share = np.clip(0.5 - self.level(x) / edge, 0.0, 1.0) * edge**3
            volume, first = volume + float(share.sum()), first + share @ x
        return volume, first / volume

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return self.moments[0]

    def normals(self, points: Array) -> Array:
        """Return unit outward normals (N, 3) by central differences."""
        step = 1e-5 * np.concatenate([np.eye(3), -np.eye(3)])
        value = self.level((points[:, None] + step).reshape(-1, 3)).reshape(-1, 2, 3)
        slope = value[:, 0] - value[:, 1]
        return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-30)

    def surface(self, count: int, seed: int) -> tuple[Array, Array, float]:
        """Return points strewn at random on the surface (N, 3), their normals (N, 3), and the area [m^2]."""
        rng = np.random.default_rng(seed)
        band = 2e-4
        low, high = self.bounds[0] - 2.0 * band, self.bounds[1] + 2.0 * band
        found, tries, kept = [], 0, 0
        while kept < count:
            x = rng.uniform(low, high, size=(1_000_000, 3))
            x = x[np.abs(self.level(x)) < band]
            found.append(x)
            tries, kept = tries + 1_000_000, kept + len(x)
        x = np.concatenate(found)
        area = len(x) / tries * float(np.prod(high - low)) / (2.0 * band)
        x = x[:count]
        for _ in range(2):
            x = x - self.level(x)[:, None] * self.normals(x)
        return x, self.normals(x), area


def render_shell(
    solid: Solid,
    count: int,
    *,
    sigma: float = 1e-4,
    jitter: float = 1e-4,
    unseen: Callable[[Array, Array], NDArray[np.bool_]] | None = None,
    seed: int = 0,
) -> Splats:
    """Cover the surface of a solid with splats like a trained capture's.

    Args:
        solid: The solid.
        count: Number of splats, before those that no camera saw are taken away.
        sigma: Their standard deviation across the surface [m], on average.
        jitter: Standard deviation of their centres across the surface [m].
        unseen: Tells of points and normals (N, 3) which no camera saw, shape (N,).
        seed: Seed of everything.
    """
    rng = np.random.default_rng(seed)
    points, normal, area = solid.surface(count, seed)
    if unseen is not None:
        seen = ~unseen(points, normal)
        points, normal = points[seen], normal[seen]
    count_seen, pitch = len(points), np.sqrt(area / count)
    axis = normal + 0.1 * rng.normal(size=normal.shape)
    axis *= rng.choice([-1.0, 1.0], size=(count_seen, 1)) / np.linalg.norm(axis, axis=1, keepdims=True)
    first = np.cross(axis, rng.normal(size=axis.shape))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    wide = pitch * rng.uniform(0.5, 1.2, size=(count_seen, 2))
    thick = sigma * rng.uniform(0.6, 1.4, size=(count_seen, 1))
    light = 0.55 + 0.35 * normal @ np.array([0.37, 0.29, 0.88])
    return Splats(
        means=points + jitter * rng.normal(size=(count_seen, 1)) * normal,
        scales=np.concatenate([wide, thick], axis=1),
        quats=Rotation.from_matrix(np.stack([first, np.cross(axis, first), axis], axis=2)).as_quat(),
        opacities=rng.uniform(0.4, 1.0, count_seen),
        sh=(light[:, None, None] * np.array([0.9, 0.6, 0.4]) - 0.5) / SH_DC,
    )


# -- solids -----------------------------------------------------------------------------------------------------------


def _solid(level: Level, low: Any, high: Any) -> Solid:
    return Solid(level=level, bounds=np.array([low, high], dtype=np.float64))


def cup(wall: float = 0.004) -> Solid:
    """Return a beaker of 80 mm, 60 mm across, with a bottom as thick as its wall."""
    level = without(cylinder(0.03, 0.0, 0.08), cylinder(0.03 - wall, wall, 0.2))
    return _solid(level, (-0.03, -0.03, 0.0), (0.03, 0.03, 0.08))


def bowl(wall: float = 0.005) -> Solid:
    """Return a hemispherical bowl of 80 mm."""
    level = without(without(ball(0.04), ball(0.04 - wall)), lambda x: 0.0 - x[:, 2])
    return _solid(level, (-0.04, -0.04, -0.04), (0.04, 0.04, 0.0))


def hollow_ball(wall: float = 0.006) -> Solid:
    """Return a closed ball of 80 mm with a void inside."""
    return _solid(without(ball(0.04), ball(0.04 - wall)), [-0.04] * 3, [0.04] * 3)


def mug() -> Solid:
    """Return a mug with a 3 mm wall and a handle of 7 mm."""
    cavity = cylinder(0.024, 0.004, 0.2)
    handle = torus(0.019, 0.0035, (0.027, 0.0, 0.034), axis=1)
    level = without(union(cylinder(0.027, 0.0, 0.068), handle), cavity)
    return _solid(level, (-0.027, -0.027, 0.0), (0.0495, 0.027, 0.068))


def guitar() -> Solid:
    """Return a guitar, 80 mm long, with a neck of 4 x 2.5 mm."""
    body = union(
        ellipsoid((0.018, 0.014, 0.012), (-0.022, 0.0, 0.0)),
        ellipsoid((0.012, 0.0105, 0.012), (-0.006, 0.0, 0.0)),
    )
    level = union(
        lambda x: np.maximum(body(x), np.abs(x[:, 2]) - 0.0035),
        box((0.04, 0.004, 0.0025), (0.014, 0.0, 0.0)),
        box((0.012, 0.008, 0.0025), (0.034, 0.0, 0.0)),
    )
    return _solid(level, (-0.04, -0.014, -0.0035), (0.04, 0.014, 0.0035))


def basket() -> Solid:
    """Return a block with an arched handle of 4 mm above it."""
    arch = without(torus(0.034, 0.002, (0.0, 0.0, 0.042), axis=1), box((0.2, 0.2, 0.084), (0.0, 0.0, -0.001)))
    level = union(box((0.076, 0.04, 0.042), (0.0, 0.0, 0.021), 0.003), arch)
    return _solid(level, (-0.038, -0.02, 0.0), (0.038, 0.02, 0.078))


def toy() -> Solid:
    """Return a sitting figure of 80 mm: belly, head, two arms, one ear, a nose."""
    level = union(
        ellipsoid((0.024, 0.026, 0.026), (0.0, 0.0, 0.0255)),
        ball(0.019, (0.002, 0.0, 0.0610)),
        ellipsoid((0.008, 0.018, 0.008), (0.006, 0.028, 0.034)),
        ellipsoid((0.018, 0.008, 0.008), (0.018, -0.022, 0.034)),
        ball(0.006, (0.0, 0.014, 0.074)),
        ball(0.005, (0.022, 0.0, 0.061)),
    )
    level = without(level, lambda x: x[:, 2])
    return _solid(level, (-0.024, -0.03, 0.0), (0.036, 0.046, 0.08))


SHELLS: dict[str, Callable[[], Solid]] = {
    "sphere": lambda: _solid(ball(0.04), [-0.04] * 3, [0.04] * 3),
    "torus": lambda: _solid(torus(0.03, 0.01), (-0.04, -0.04, -0.01), (0.04, 0.04, 0.01)),
    "slab": lambda: _solid(box((0.08, 0.08, 0.01)), (-0.04, -0.04, -0.005), (0.04, 0.04, 0.005)),
    "cup": cup,
    "bowl": bowl,
    "plate": lambda: _solid(box((0.08, 0.08, 0.002)), (-0.04, -0.04, -0.001), (0.04, 0.04, 0.001)),
    "ring": lambda: _solid(torus(0.0375, 0.0025), (-0.04, -0.04, -0.0025), (0.04, 0.04, 0.0025)),
    "tube": lambda: _solid(
        without(cylinder(0.015, -0.04, 0.04), cylinder(0.011, -0.2, 0.2)), (-0.015, -0.015, -0.04), (0.015, 0.015, 0.04)
    ),
}
"""Solids with a longest edge of 80 mm, whose clean shells show what the fill is worth."""


# -- captures ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Capture:
    """One scene with an object in it."""

    solid: Callable[[], Solid]
    """The object, with its longest edge near 80 mm."""
    scene: Callable[[], Splats]
    """What the scanner gives."""
    options: dict[str, Any] = field(default_factory=dict)
    """Fields of `ObjectConfig` that the file calls for, such as the axis that is up."""
    same_volume: float = 0.1
    """Relative error of the volume within which the object is whole."""


def merged(*parts: Splats) -> Splats:
    """Return one set of splats."""
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Splats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


def sheet(width: float, depth: float, pitch: float, *, seed: int = 0) -> Splats:
    """Return a single layer of splats in the plane z = 0, seen from one side."""
    rng = np.random.default_rng(seed)
    count = int(width * depth / pitch**2)
    means = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * (width, depth), 3e-4 * rng.normal(size=count)])
    return Splats(
        means=means,
        quats=Rotation.from_rotvec(0.05 * rng.normal(size=(count, 3))).as_quat(),
        scales=pitch * rng.uniform([0.5, 0.5, 0.05], [1.2, 1.2, 0.2], size=(count, 3)),
        opacities=rng.uniform(0.4, 1.0, count),
        sh=np.full((count, 1, 3), 0.2 / SH_DC),
    )


def _standing(points: Array, normals: Array) -> NDArray[np.bool_]:
    """Return whether a point belongs to the face on which the object stands."""
    return (points[:, 2] < 5e-4) & (normals[:, 2] < -0.9)


def _on_ground() -> Splats:
    return merged(render_shell(toy(), 20_000, unseen=_standing), sheet(0.36, 0.30, 2.5e-3, seed=1))


def _in_room() -> Splats:
    wide, deep, high = 0.6, 0.5, 0.3
    wall = [sheet(wide, high, 4e-3, seed=2 + k).transformed(rotation=_TIP_Y) for k in range(2)]
    side = [sheet(deep, high, 4e-3, seed=4 + k).transformed(rotation=_TURN_Z @ _TIP_Y) for k in range(2)]
    walls = [
        part.transformed(translation=(0.0, s * 0.5 * deep, 0.5 * high)) for part, s in zip(wall, (-1, 1), strict=True)
    ]
    walls += [
        part.transformed(translation=(s * 0.5 * wide, 0.0, 0.5 * high)) for part, s in zip(side, (-1, 1), strict=True)
    ]
    return merged(render_shell(toy(), 20_000, unseen=_standing), sheet(wide, deep, 4e-3, seed=1), *walls)


def _with_floaters() -> Splats:
    rng = np.random.default_rng(3)
    count = 1500
    stray = Splats(
        means=rng.uniform(-0.1, 0.18, (count, 3)),
        quats=Rotation.random(count, random_state=3).as_quat(),
        scales=rng.lognormal(np.log(2e-3), 0.8, (count, 3)),
        opacities=rng.beta(0.5, 2.0, count),
        sh=np.zeros((count, 1, 3)),
    )
    return merged(render_shell(toy(), 20_000), stray)


def _with_loose_parts() -> Splats:
    hat = _solid(ball(0.008, (0.0, 0.0, 0.094)), (-0.008, -0.008, 0.086), (0.008, 0.008, 0.102))
    tag = _solid(box((0.010, 0.002, 0.014), (0.0, -0.045, 0.02)), (-0.005, -0.046, 0.013), (0.005, -0.044, 0.027))
    return merged(render_shell(toy(), 20_000), render_shell(hat, 1200, seed=1), render_shell(tag, 700, seed=2))


def _two_objects() -> Splats:
    other = render_shell(guitar(), 12_000, seed=1).transformed(translation=(0.0, 0.15, 0.0035))
    return merged(render_shell(toy(), 20_000), other)


def _mirrored() -> Splats:
    """Return a toy in a left-handed frame with y up: x and y are exchanged in place of a turn."""
    splats = render_shell(toy(), 20_000)
    frames = rotations_from_quats(splats.quats).astype(np.float64)
    swap = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    frames = swap @ frames
    frames[:, :, 2] *= -1.0  # an axis of an ellipsoid has no sign
    return replace(splats, means=splats.means @ swap.T, quats=Rotation.from_matrix(frames).as_quat())


_TIP_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_TURN_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

CAPTURES: dict[str, Capture] = {
    "thin neck": Capture(solid=guitar, scene=lambda: render_shell(guitar(), 30_000)),
    "handle": Capture(solid=basket, scene=lambda: render_shell(basket(), 20_000)),
    "mug": Capture(solid=mug, scene=lambda: render_shell(mug(), 30_000)),
    "loose parts": Capture(solid=toy, scene=_with_loose_parts),
    "ground beneath": Capture(solid=toy, scene=_on_ground),
    "room around": Capture(solid=toy, scene=_in_room),
    "millimetres": Capture(solid=cup, scene=lambda: render_shell(cup(), 20_000).transformed(scale=1000.0)),
    "y up, mirrored": Capture(solid=toy, scene=_mirrored, options={"up": "+y"}),
    "sparse": Capture(solid=toy, scene=lambda: render_shell(toy(), 1_000)),
    "dense": Capture(solid=toy, scene=lambda: render_shell(toy(), 500_000)),
    "floaters": Capture(solid=toy, scene=_with_floaters),
    "two objects": Capture(solid=toy, scene=_two_objects),
}
"""Twelve captures; all but "two objects" show one thing that is the object."""
