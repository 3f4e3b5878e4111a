"""The scenes of the accuracy benchmark as plain data: geometry, material, clamps and their motion, gravity, steps.

A scene says everything that a simulator of any kind needs, so that the finite-element oracle, softmode and other
solvers run the same experiment. SI units; nothing here imports softmode.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
EnergyName = Literal["stable_neo_hookean", "stable_neo_hookean_log"]
Lines = tuple[Array, Array, Array]

TOLERANCE = 1e-9
"""Slack of geometric comparisons [m]."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in reference coordinates (those of the shape before its taper)."""

    lower: Vector
    """Lower corner [m]."""
    upper: Vector
    """Upper corner [m]."""

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which reference points (N, 3) [m] lie inside or on the boundary."""
        x = np.asarray(points, float)
        inside = (x >= np.asarray(self.lower) - TOLERANCE) & (x <= np.asarray(self.upper) + TOLERANCE)
        return np.logical_and.reduce(inside, axis=1)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A union of boxes, optionally tapered: (x, y, z) -> (x, s(x) y, s(x) z), s linear in x."""

    boxes: tuple[Box, ...]
    """The boxes, in reference coordinates."""
    taper: tuple[float, float] = (1.0, 1.0)
    """Scale s of the section at the least and the greatest x."""

    @property
    def reference_bounds(self) -> Array:
        """Lower and upper corner in reference coordinates [m], shape (2, 3)."""
        return np.array([np.min([b.lower for b in self.boxes], axis=0), np.max([b.upper for b in self.boxes], axis=0)])

    @property
    def bounds(self) -> Array:
        """Lower and upper corner of the rest shape [m], shape (2, 3)."""
        bounds = self.reference_bounds
        bounds[:, 1:] *= max(self.taper)
        return bounds

    def scale(self, x: Array) -> Array:
        """Return s(x)."""
        low, high = self.reference_bounds[:, 0]
        return self.taper[0] + (self.taper[1] - self.taper[0]) * (x - low) / (high - low)

    def to_rest(self, reference: ArrayLike) -> Array:
        """Map reference coordinates to the rest shape; both (N, 3) [m]."""
        x = np.array(reference, float)
        x[:, 1:] *= self.scale(x[:, 0])[:, None]
        return x

    def to_reference(self, rest: ArrayLike) -> Array:
        """Map the rest shape to reference coordinates; both (N, 3) [m]."""
        x = np.array(rest, float)
        x[:, 1:] /= self.scale(x[:, 0])[:, None]
        return x

    def contains(self, rest: ArrayLike) -> NDArray[np.bool_]:
        """Return which rest points (N, 3) [m] lie inside or on the surface."""
        x = self.to_reference(rest)
        return np.any([box.contains(x) for box in self.boxes], axis=0)

    def cells(self, size: float, breaks: tuple[Box, ...] = (), grading: float = 0.0) -> tuple[Lines, NDArray[np.bool_]]:
        """Return a tensor grid that respects every box: its lines per axis [m], and which cells are solid.

        Args:
            size: Mean edge of the cells between two faces, at most [m].
            breaks: More boxes whose faces must fall on grid planes (clamp regions, inclusions).
            grading: 0 spaces the lines evenly; towards 1 they gather at the faces, like (1 - cos pi t) / 2.

        Returns:
            Lines of the three axes in reference coordinates, and occupancy (nx, ny, nz).
        """
        bounds = self.reference_bounds
        lines: list[Array] = []
        for axis in range(3):
            marks = {round(edge[axis], 9) for box in (*self.boxes, *breaks) for edge in (box.lower, box.upper)}
            inside = sorted(m for m in marks if bounds[0, axis] <= m <= bounds[1, axis])
            parts = []
            for a, b in itertools.pairwise(inside):
                t = np.linspace(0.0, 1.0, max(int(np.ceil((b - a) / size - 1e-6)), 1) + 1)[:-1]
                parts.append(a + (b - a) * ((1.0 - grading) * t + 0.5 * grading * (1.0 - np.cos(np.pi * t))))
            lines.append(np.append(np.concatenate(parts), inside[-1]))
        centres = np.stack(np.meshgrid(*[0.5 * (l[1:] + l[:-1]) for l in lines], indexing="ij"), axis=-1)
        solid = np.any([box.contains(centres.reshape(-1, 3)) for box in self.boxes], axis=0)
        return (lines[0], lines[1], lines[2]), solid.reshape(centres.shape[:3])

    def surface(self) -> tuple[Array, NDArray[np.int64]]:
        """Return the closed surface: vertices (V, 3) [m] of the rest shape, outward triangles (T, 3)."""
        (xs, ys, zs), solid = self.cells(np.inf)
        padded = np.pad(solid, 1)
        nodes = np.stack(np.meshgrid(xs, ys, zs, indexing="ij"), axis=-1).reshape(-1, 3)
        number = np.arange(len(nodes)).reshape(len(xs), len(ys), len(zs))
        quads = []
        for axis in range(3):
            u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
            for side in (0, 1):
                outer = np.roll(padded, 1 - 2 * side, axis=axis)[1:-1, 1:-1, 1:-1]
                base = np.argwhere(solid & ~outer) + side * np.eye(3, dtype=int)[axis]
                ring = [base, base + u, base + u + v, base + v]
                corners = np.stack([number[tuple(c.T)] for c in ring], axis=1)
                quads.append(corners if side else corners[:, ::-1])
        faces = np.concatenate(quads)
        triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        used, compact = np.unique(triangles, return_inverse=True)
        return self.to_rest(nodes[used]), compact.reshape(-1, 3).astype(np.int64)

    def sample(self, spacing: float) -> tuple[Array, Array]:
        """Return cell centres of a uniform grid and their volumes: points (N, 3) [m] and weights (N,) [m^3]."""
        lines, solid = self.cells(spacing)
        return self.integrate(lines, solid, 1)

    def gauss(self, region: Box, counts: tuple[int, int, int]) -> tuple[Array, Array]:
        """Integrate over the part of a region inside the shape's bounds by a tensor Gauss-Legendre rule.

        Args:
            region: The region; the shape must fill all of it within the bounds.
            counts: Points per axis.

        Returns:
            Rest points (N, 3) [m] and weights (N,) [m^3].
        """
        bounds = self.reference_bounds
        corners = np.clip([region.lower, region.upper], bounds[0], bounds[1])
        lines = (corners[:, 0], corners[:, 1], corners[:, 2])
        return self.integrate(lines, np.ones((1, 1, 1), bool), counts)

    def integrate(
        self, lines: Lines, solid: NDArray[np.bool_], counts: int | tuple[int, int, int]
    ) -> tuple[Array, Array]:
        """Return a Gauss rule on every solid cell of a grid: rest points (N, 3) [m], weights (N,) [m^3]."""
        orders = (counts,) * 3 if isinstance(counts, int) else counts
        axes, widths = [], []
        for line, order in zip(lines, orders, strict=True):
            node, weight = np.polynomial.legendre.leggauss(order)
            half = 0.5 * np.diff(line)
            axes.append(0.5 * (line[1:] + line[:-1])[:, None] + half[:, None] * node)
            widths.append(half[:, None] * weight)
        cell = np.argwhere(solid)
        picked = [axes[d][cell[:, d]] for d in range(3)]
        factor = [widths[d][cell[:, d]] for d in range(3)]
        shape = (len(cell), *orders)
        x = [
            np.broadcast_to(p.reshape(len(cell), *[orders[d] if d == e else 1 for e in range(3)]), shape)
            for d, p in enumerate(picked)
        ]
        w = np.einsum("ci,cj,ck->cijk", *factor).ravel()
        reference = np.stack([a.ravel() for a in x], axis=1)
        return self.to_rest(reference), w * self.scale(reference[:, 0]) ** 2

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        lines, solid = self.cells(np.inf)
        return float(self.integrate(lines, solid, 2)[1].sum())


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A rigid motion that starts abruptly at t = 0: a turn about an axis at a constant rate and a constant velocity."""

    axis: Vector = (1.0, 0.0, 0.0)
    """Axis of the turn, through the origin."""
    rate: float = 0.0
    """Rate of the turn [rad/s]."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity [m/s]."""

    def position(self, rest: ArrayLike, time: float) -> Array:
        """Return where rest points (N, 3) [m] are at a time [s]."""
        return np.asarray(rest, float) @ rotation(self.axis, self.rate * time).T + time * np.asarray(self.velocity)


@dataclass(frozen=True, kw_only=True)
class Clamp:
    """A region that is held or moved."""

    region: Box
    """Where, in reference coordinates."""
    motion: Motion = dataclasses.field(default_factory=Motion)
    """How it moves."""
    stiffness: float | None = None
    """Springs per volume kappa [N/m^4], the energy kappa/2 int |x - x_target|^2 dV; None: exactly."""


@dataclass(frozen=True, kw_only=True)
class Inclusion:
    """A region of another stiffness."""

    region: Box
    """Where, in reference coordinates."""
    factor: float
    """Young's modulus relative to the scene's."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One experiment."""

    name: str
    """Key of its stored frames."""
    shape: Shape
    """Geometry at rest."""
    energy: EnergyName = "stable_neo_hookean"
    """Energy density."""
    youngs_modulus: float = 5.0e6
    """E [Pa]."""
    poissons_ratio: float = 0.45
    """nu."""
    density: float = 1000.0
    """rho [kg/m^3]."""
    inclusions: tuple[Inclusion, ...] = ()
    """Regions of another stiffness."""
    clamps: tuple[Clamp, ...] = ()
    """Regions held or moved."""
    gravity: Vector = (0.0, 0.0, 0.0)
    """Gravity [m/s^2]."""
    spin: Vector = (0.0, 0.0, 0.0)
    """Initial angular velocity about the origin [rad/s]: v = spin x (stretch X)."""
    stretch: Vector = (1.0, 1.0, 1.0)
    """Initial homogeneous stretch along the axes."""
    dt: float = 0.01
    """Step of implicit Euler [s]."""
    steps: int = 300
    """Number of steps."""
    cell: float = 0.25
    """Mean edge of the oracle's elements [m]."""
    grading: float = 0.95
    """How much its elements gather at the surface and at clamps, see `Shape.cells`."""

    def stiffness_scale(self, rest: ArrayLike) -> Array:
        """Return Young's modulus relative to `youngs_modulus` at rest points (N, 3), shape (N,)."""
        x = self.shape.to_reference(rest)
        scale = np.ones(len(x))
        for part in self.inclusions:
            scale[part.region.contains(x)] = part.factor
        return scale

    def initial_position(self, rest: ArrayLike) -> Array:
        """Return positions (N, 3) [m] at t = 0."""
        return np.asarray(rest, float) * np.asarray(self.stretch)

    def initial_velocity(self, rest: ArrayLike) -> Array:
        """Return velocities (N, 3) [m/s] at t = 0."""
        return np.cross(np.asarray(self.spin), self.initial_position(rest))

    @property
    def edge(self) -> float:
        """Largest edge of the bounding box at rest [m]."""
        return float(np.ptp(self.shape.bounds, axis=0).max())

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box at rest [m]."""
        return float(np.linalg.norm(np.ptp(self.shape.bounds, axis=0)))

    def with_clamp(self, stiffness: float | None) -> Scene:
        """Return the scene, renamed, with all clamps of another stiffness [N/m^4], or exact ones (None)."""
        clamps = tuple(dataclasses.replace(clamp, stiffness=stiffness) for clamp in self.clamps)
        suffix = "" if stiffness is None else f"_soft_{stiffness:.0e}".replace("e+", "e").replace("e0", "e")
        return dataclasses.replace(self, clamps=clamps, name=self.name.split("_soft_")[0] + suffix)


def rotation(axis: ArrayLike, angle: float) -> Array:
    """Return the rotation matrix about an axis by an angle [rad] (Rodrigues)."""
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


INFINITE = 1e3
"""A coordinate beyond every shape [m]."""
BEAM = Shape(boxes=(Box(lower=(-2.5, -0.5, -0.5), upper=(2.5, 0.5, 0.5)),))
"""The beam of the FreeForm and Simplicits papers: 5 x 1 x 1 m, centred at the origin."""
LEFT = Box(lower=(-INFINITE, -INFINITE, -INFINITE), upper=(-2.0, INFINITE, INFINITE))
"""The 0.5 m of the beam that are fixed."""
RIGHT = Box(lower=(2.0, -INFINITE, -INFINITE), upper=(INFINITE, INFINITE, INFINITE))
"""The 0.5 m of the beam that are turned."""
KAPPAS = (1.0e8, 1.0e9, 1.0e10, 1.0e11)
"""Stiffnesses of soft clamps [N/m^4]."""
_DOWN = (0.0, 0.0, -9.81)

BEND = Scene(name="bend", shape=BEAM, clamps=(Clamp(region=LEFT),), gravity=_DOWN)
"""FreeForm's bend: 0.5 m fixed, gravity, h = 0.01 s x 300."""


def _twist(name: str, degrees: float, pull: float = 0.0) -> Scene:
    """Return a twist by an angle over 5 s, h = 0.05 s x 100, with an axial pull [m/s]; no gravity."""
    turned = Motion(rate=np.deg2rad(degrees) / 5.0, velocity=(pull, 0.0, 0.0))
    clamps = (Clamp(region=LEFT), Clamp(region=RIGHT, motion=turned))
    return Scene(name=name, shape=BEAM, clamps=clamps, dt=0.05, steps=100)


TWIST_360 = _twist("twist_360", 360.0)
"""FreeForm's twist, up to 360 degrees."""
TWIST_720 = dataclasses.replace(_twist("twist_720", 720.0), steps=60)
"""FreeForm's twist as printed, up to 432 degrees. Held at a constant length the twisted beam comes under axial
compression and buckles (on a coarse mesh at 576 degrees); only symmetry and rounding decide where to."""
TWIST_720_PULL = _twist("twist_720_pull", 720.0, 0.5)
"""720 degrees with an axial pull of 0.5 m/s, which keeps the beam straight."""

TWIST_540_FLAT = Scene(
    name="twist_540_flat",
    shape=Shape(boxes=(Box(lower=(-2.0, -0.4, -0.25), upper=(2.0, 0.4, 0.25)),)),
    clamps=(
        Clamp(region=Box(lower=(-INFINITE,) * 3, upper=(-1.6, INFINITE, INFINITE))),
        Clamp(
            region=Box(lower=(1.6, -INFINITE, -INFINITE), upper=(INFINITE,) * 3),
            motion=Motion(rate=np.deg2rad(540.0) / 5.0, velocity=(0.4, 0.0, 0.0)),
        ),
    ),
    dt=0.1,
    steps=50,
    cell=0.2,
)
"""A flatter beam, 4 x 0.8 x 0.5 m, turned by 540 degrees with a pull: nothing in the method was chosen by it."""

SPIN = Scene(name="spin", shape=BEAM, spin=(0.5, 1.0, 2.0), stretch=(1.15, 0.95, 0.95), steps=200)
"""The free beam, stretched and spinning about an oblique axis: tumbles and rings; h = 0.01 s x 200."""

TAPER = Scene(
    name="taper",
    shape=Shape(boxes=BEAM.boxes, taper=(1.0, 0.5)),
    energy="stable_neo_hookean_log",
    youngs_modulus=1.0e6,
    poissons_ratio=0.4,
    inclusions=(
        Inclusion(region=Box(lower=(-0.5, -INFINITE, -INFINITE), upper=(1.0,) + (INFINITE,) * 2), factor=10.0),
    ),
    clamps=(Clamp(region=LEFT),),
    gravity=_DOWN,
    steps=150,
)
"""A beam that tapers from 1 to 0.5 m, whose middle 1.5 m are ten times as stiff; bends under gravity."""

_FOOT = Box(lower=(1.5, 0.0, 0.0), upper=(2.0, 0.5, 0.5))
_HEAD = Box(lower=(0.0, 1.5, 0.0), upper=(0.5, 2.0, 0.5))
L_SHAPE = Scene(
    name="l_shape",
    shape=Shape(
        boxes=(Box(lower=(0.0, 0.0, 0.0), upper=(2.0, 0.5, 0.5)), Box(lower=(0.0, 0.5, 0.0), upper=(0.5, 2.0, 0.5)))
    ),
    energy="stable_neo_hookean_log",
    youngs_modulus=1.0e6,
    poissons_ratio=0.4,
    clamps=(
        Clamp(region=_FOOT, motion=Motion(velocity=(0.5, 0.0, -0.3))),
        Clamp(region=_HEAD, motion=Motion(velocity=(0.0, 0.5, 0.3))),
    ),
    steps=100,
    cell=0.125,
)
"""An L of legs 2 m long and 0.5 m thick, pulled apart at the ends of both legs, out of its plane too."""

SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        BEND,
        dataclasses.replace(BEND, name="bend_log", energy="stable_neo_hookean_log"),
        *(BEND.with_clamp(kappa) for kappa in KAPPAS),
        TWIST_360,
        TWIST_360.with_clamp(1.0e9),
        TWIST_720_PULL,
        TWIST_720,
        TWIST_540_FLAT,
        SPIN,
        TAPER,
        L_SHAPE,
    )
}
"""Every scene whose frames are stored."""
