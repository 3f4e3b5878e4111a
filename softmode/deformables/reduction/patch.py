"""Patch: a surface of triangles that cuts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import ConfigError

Array = NDArray[np.float64]

REACH = 1.0e3
"""Half the edge of a patch that stands for a plane [m]."""
_EDGE = 1.0e-9
"""Of its size, how far a triangle reaches beyond its edges, so that neighbours leave no gap."""
_LEVEL = 1.0e-12
"""Of its size, how far behind a triangle a point still counts as in front, so that neighbours agree."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Triangles that cut what crosses them, each with the sides that its corners' order gives it."""

    corners: ArrayLike
    """Corners of the triangles [m], shape (T, 3, 3)."""

    def __post_init__(self) -> None:
        """Check shape and area; store float64."""
        corners = np.array(self.corners, dtype=np.float64)
        if corners.ndim != 3 or corners.shape[1:] != (3, 3) or not len(corners) or not np.isfinite(corners).all():
            raise ConfigError(f"patch: expected finite corners of shape (T > 0, 3, 3), got shape {corners.shape}")
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        if (np.linalg.norm(np.cross(first, second), axis=1) <= 1e-9 * size).any():
            raise ConfigError("patch: a triangle has no area", hint="leave it out")
        object.__setattr__(self, "corners", corners)

    @classmethod
    def plane(cls, point: ArrayLike, normal: ArrayLike) -> Patch:
        """Return a plane, as a square of 2 km.

        Args:
            point: A point of it [m], shape (3,).
            normal: Its normal, of any length but zero, shape (3,).

        Raises:
            ConfigError: If they are not finite, or the normal is zero.
        """
        p, n = np.array(point, dtype=np.float64), np.array(normal, dtype=np.float64)
        length = float(np.linalg.norm(n)) if n.shape == (3,) else 0.0
        if p.shape != (3,) or not (np.isfinite(p).all() and np.isfinite(length) and length > 1e-12):
            raise ConfigError(f"plane: expected a point and a normal, three finite numbers each, got {point}, {normal}")
        n = n / length
        u = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        u *= REACH / np.linalg.norm(u)
        v = np.cross(n, u)
        return cls(corners=[[p - u - v, p + u - v, p + u + v], [p - u - v, p + u + v, p - u + v]])

    @classmethod
    def stroke(cls, eye: ArrayLike, start: ArrayLike, end: ArrayLike) -> Patch:
        """Return what a stroke of a knife sweeps: the part of a plane between two rays from one point.

        Args:
            eye: Where the rays start, such as a camera [m], shape (3,).
            start: A point on the first ray, shape (3,).
            end: A point on the last one, shape (3,).

        Raises:
            ConfigError: If the three lie on a line.
        """
        e, rays = np.array(eye, dtype=np.float64), np.array([start, end], dtype=np.float64)
        rays = rays - e
        size = np.linalg.norm(rays, axis=1)
        if not (np.isfinite(size).all() and (size > 0.0).all()):
            raise ConfigError(f"stroke: expected three points apart, got {eye}, {start}, {end}")
        if np.linalg.norm(np.cross(*(rays / size[:, None]))) < 1e-6:
            raise ConfigError("the stroke has no length", hint="draw it across the object")
        far = e + REACH * rays / size[:, None]
        return cls(corners=[[e, far[0], far[1]]])

    def crossings(self, start: Array, end: Array) -> tuple[Array, Array]:
        """Return where segments cross the patch.

        A point on a triangle's plane counts as in front of it, so that it lies on one side only.

        Args:
            start: Start of each segment [m], shape (N, 3).
            end: Its end, likewise.

        Returns:
            Fraction of the way, of the crossing nearest to the start, NaN for none, (N,); the unit normal there (N, 3).
        """
        at, normals = np.full(len(start), np.inf), np.zeros((len(start), 3))
        for a, b, c in np.asarray(self.corners):
            u, v = b - a, c - a
            n = np.cross(u, v)
            area = float(np.linalg.norm(n))
            n = n / area
            level = n @ a - _LEVEL * np.sqrt(area)
            first, second = start @ n - level, end @ n - level
            rows = np.flatnonzero((first >= 0.0) != (second >= 0.0))
            t = first[rows] / (first[rows] - second[rows])
            p = start[rows] + t[:, None] * (end[rows] - start[rows]) - a
            # Barycentric coordinates in the triangle's plane.
            s, r = np.cross(p, v) @ n / area, np.cross(u, p) @ n / area
            inside = (s >= -_EDGE) & (r >= -_EDGE) & (s + r <= 1.0 + _EDGE) & (t < at[rows])
            at[rows[inside]], normals[rows[inside]] = t[inside], n
        return np.where(np.isfinite(at), at, np.nan), normals
