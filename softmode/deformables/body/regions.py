"""Regions: parts of a body that a scene holds, moves or grasps, known when the body is built.

A region is a box or a set of points, grown by a radius. Its distance d(X), zero inside, makes weights that vanish on
the region exactly: a smooth function times g(d), with g = 1 - (1 - d / w)^3 up to w and one beyond, is zero inside and
leaves the region's face with a kink, as the displacement of a clamped body does (Kantorovich and Krylov 1958; Rvachev
and Sheiko 1995, doi:10.1115/1.3005099). No kernel of finite width can do either. w is one radius of the kernels: beyond
it they reproduce linear fields as on a free body. An envelope as wide as the body takes that from them everywhere, and
a spiral strip was three times too stiff with it.

Blends between regions change over the whole gap instead. Within w kernels are as narrow as what they would have to
cancel: two clamps whose blend rose there were three times too stiff when they moved across against each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """A part of a body: all within `radius` of a box, or of any of some points; in asset coordinates."""

    name: str
    """Name, unique within a body."""
    box: ArrayLike | None = None
    """Lower and upper corner [m], shape (2, 3); may be infinite."""
    points: ArrayLike | None = None
    """Instead of a box: points [m], shape (N, 3)."""
    radius: float = 0.0
    """How far the region reaches beyond the box or the points [m]."""
    stiffness: float | None = None
    """None: the region is held or moved exactly. A number kappa / E [1/m^2]: by springs of kappa = stiffness * E per
    volume [Pa/m^2], the energy kappa / 2 int |x - x_target|^2 dV, with the Young's modulus E of each point."""

    def __post_init__(self) -> None:
        """Check shapes and ranges; store what was given as float64 arrays."""
        if (self.box is None) == (self.points is None):
            raise ConfigError(f"region {self.name!r}: expected either a box or points")
        if not (np.isfinite(self.radius) and self.radius >= 0.0):
            raise ConfigError(f"region {self.name!r}: radius: expected a length of zero or more, got {self.radius!r}")
        if self.stiffness is not None and not (np.isfinite(self.stiffness) and self.stiffness > 0.0):
            raise ConfigError(f"region {self.name!r}: stiffness: expected None or a number > 0, got {self.stiffness!r}")
        if self.box is not None:
            box = np.array(self.box, dtype=np.float64)
            if box.shape != (2, 3) or not (box[1] >= box[0]).all():
                raise ConfigError(f"region {self.name!r}: box: expected corners (2, 3), upper >= lower, got {self.box}")
            object.__setattr__(self, "box", box)
        else:
            points = np.array(self.points, dtype=np.float64)
            if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
                raise ConfigError(f"region {self.name!r}: points: expected finite positions of shape (N > 0, 3)")
            object.__setattr__(self, "points", points)

    def moved(self, offset: Array, bounds: Array) -> Region:
        """Return the region less an offset (3,) [m], its box cut to twice the extent of the bounds (2, 3)."""
        points = None if self.points is None else np.asarray(self.points) - offset
        box = None
        if self.box is not None:
            margin = np.ptp(bounds, axis=0).max()
            box = np.clip(np.asarray(self.box) - offset, bounds[0] - margin, bounds[1] + margin)
        return Region(name=self.name, box=box, points=points, radius=self.radius, stiffness=self.stiffness)

    def thickness(self, bounds: Array) -> float:
        """Return its least extent within bounds (2, 3) [m], of points about along their principal axes [m]."""
        if self.points is None:
            grown = np.asarray(self.box) + self.radius * np.array([[-1.0], [1.0]])
            return float(np.ptp(np.clip(grown, *bounds), axis=0).min())
        span = np.asarray(self.points)
        span = span - span.mean(axis=0)
        span = span @ np.linalg.svd(span, full_matrices=len(span) < 3)[2].T
        return float(np.ptp(span, axis=0).min()) + 2.0 * self.radius

    @property
    def cores(self) -> Array:
        """The box, or the points as boxes of no extent, shape (C, 2, 3)."""
        if self.box is not None:
            return np.asarray(self.box)[None]
        return np.repeat(np.asarray(self.points)[:, None], 2, axis=1)

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Return the signed distance [m] (N,), negative inside, and its gradient (N, 3)."""
        if self.box is not None:
            lower, upper = np.asarray(self.box)
            away = points - np.clip(points, lower, upper)
            outside = np.linalg.norm(away, axis=1)
            depth = np.minimum(points - lower, upper - points)
            axis = depth.argmin(axis=1)
            row = np.arange(len(points))
            inside = outside <= 0.0
            found = np.where(inside, -depth[row, axis], outside)
            gradient = away / np.where(inside, 1.0, outside)[:, None]
            sign = np.where(upper[axis] - points[row, axis] < points[row, axis] - lower[axis], 1.0, -1.0)
            gradient[row[inside], axis[inside]] = sign[inside]
        else:
            core = np.asarray(self.points)
            found, nearest = KDTree(core).query(points)
            found = np.asarray(found, dtype=np.float64)
            gradient = (points - core[nearest]) / np.maximum(found, 1e-300)[:, None]
        return found - self.radius, gradient

    def cut(self, points: Array, edges: Array, axes: Array) -> tuple[Array, Array, Array, Array]:
        """Return how the region cuts boxes, as a plane would that is parallel to its face.

        Args:
            points: Centroids of the boxes [m], shape (P, 3).
            edges: Their edges along the axes [m], shape (P, 3); zeros of a point.
            axes: Unit vectors in rows, shape (3, 3).

        Returns:
            Signed distances of the centroids [m] (P,), normals of the face (P, 3), widths of the boxes along these [m]
            (P,), and the share of each box that lies inside (P,).
        """
        distance, normal = self.distance(points)
        width = (np.abs(normal @ axes.T) * edges).sum(axis=1)
        return distance, normal, width, np.clip(0.5 - distance / np.maximum(width, 1e-300), 0.0, 1.0)

    def integrate(self, points: Array, weights: Array, edges: Array, axes: Array) -> tuple[Array, Array]:
        """Return points (N, 3) [m] and volumes (N,) [m^3] that integrate over the region.

        Boxes that the face cuts count by the part inside, at its centroid.

        Args:
            points: Quadrature points [m], shape (P, 3).
            weights: Their volumes [m^3], shape (P,).
            edges: Edges of the boxes that they stand for [m], shape (P, 3); zeros where no face comes near.
            axes: Axes of the boxes, unit vectors in rows, shape (3, 3).

        Raises:
            BasisError: If an exact region holds fewer than four quadrature points, or a soft one none.
        """
        distance, normal, width, share = self.cut(points, edges, axes)
        found = np.flatnonzero(share > 0.02)
        needed = 4 if self.stiffness is None else 1
        if len(found) < needed:
            raise BasisError(
                f"region {self.name!r}: holds {len(found)} quadrature points, at least {needed} are needed",
                hint="Enlarge the region or use more quadrature points; regions are given in asset coordinates.",
            )
        shift = np.where(np.abs(distance) < 0.5 * width, 0.5 * (distance + 0.5 * width), 0.0)
        return points[found] - (shift[:, None] * normal)[found], weights[found] * share[found]

    def corners(self, points: Array, spacing: float) -> Array:
        """Return points (6, 3) on or in the region around those given, half a cell out along every axis."""
        out = []
        for axis in range(3):
            for sign in (-1.0, 1.0):
                corner = points[(sign * points[:, axis]).argmax()].copy()
                corner[axis] += sign * 0.5 * spacing
                out.append(corner)
        found = np.array(out)
        distance, normal = self.distance(found)
        return found - np.maximum(distance, 0.0)[:, None] * normal


@dataclass(frozen=True)
class Envelope:
    """What makes weights vanish on exact regions, and blends between them."""

    regions: tuple[Region, ...]
    """Exact regions, in the frame of the points to come."""
    length: float
    """Distance w at which the envelope is one [m]."""
    wide: bool = False
    """Whether it is g = d / (d + length) instead, that of bodies in files of version 3 and before."""
    gap: bool = True
    """Whether blends change over the whole gap; else with the envelope, those of files of version 4 and before."""

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie in a region, its face included."""
        return np.any([region.distance(points)[0] <= 0.0 for region in self.regions], axis=0)

    def evaluate(self, points: Array) -> tuple[Array, Array, Array, Array]:
        """Evaluate the envelope and the blends.

        Args:
            points: Positions [m], shape (N, 3).

        Returns:
            G = prod_i g_i with g_i = 1 - (1 - min(d_i / w, 1))^3, zero on every region, (N,), its gradient (N, 3);
            T_i = (1 / s_i) / sum_j (1 / s_j), s_i = d_i^2 or g_i, one on region i and zero on the others, (N, R), its
            gradient (N, R, 3).
        """
        count = len(self.regions)
        g, slope = np.empty((len(points), count)), np.empty((len(points), count, 3))
        s, rise = np.empty_like(g), np.empty_like(slope)
        for i, region in enumerate(self.regions):
            distance, normal = region.distance(points)
            distance, normal = np.maximum(distance, 0.0) / self.length, normal * (distance > 0.0)[:, None] / self.length
            if self.wide:
                g[:, i], slope[:, i] = distance / (distance + 1.0), normal / ((distance + 1.0) ** 2)[:, None]
            else:
                rest = 1.0 - np.minimum(distance, 1.0)
                g[:, i], slope[:, i] = 1.0 - rest**3, normal * (3.0 * rest**2)[:, None]
            s[:, i], rise[:, i] = distance**2, normal * (2.0 * distance)[:, None]
        others, others_slope = _without_one(g, slope)
        whole, whole_slope = g[:, 0] * others[:, 0], g[:, 0, None] * others_slope[:, 0]
        whole_slope = whole_slope + slope[:, 0] * others[:, 0, None]
        if self.gap and not self.wide:
            others, others_slope = _without_one(s, rise)
        total = np.maximum(others.sum(axis=1), 1e-300)
        blend = others / total[:, None]
        blend_slope = (others_slope - blend[:, :, None] * others_slope.sum(axis=1)[:, None]) / total[:, None, None]
        return whole, whole_slope, blend, blend_slope


def _without_one(value: Array, slope: Array) -> tuple[Array, Array]:
    """Return products of values (N, R) without factor i, and their gradients, free of divisions by what vanishes."""
    others, others_slope = np.ones_like(value), np.zeros_like(slope)
    for i in range(value.shape[1]):
        for l in range(value.shape[1]):
            if l != i:
                others_slope[:, i] = others_slope[:, i] * value[:, l, None] + others[:, i, None] * slope[:, l]
                others[:, i] *= value[:, l]
    return others, others_slope
