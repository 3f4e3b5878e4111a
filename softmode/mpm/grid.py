"""Grid: the nodes that particles exchange momentum on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.errors import ConfigError

Array = NDArray[np.float64]

MARGIN = 2
"""Cells at the border of a grid that particles must not enter: a particle reaches nodes two cells away."""
SLACK = 8
"""Nodes that a grid which grows gets along an axis beside those that it needs, so that it does not grow again soon."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A uniform grid of nodes."""

    shape: tuple[int, int, int] = (32, 32, 32)
    """Nodes along x, y, z."""
    spacing: float = 1.0
    """Distance dx between nodes [m]."""
    origin: tuple[float, float, float] = (-16.0, -16.0, -16.0)
    """Position of node (0, 0, 0) [m]."""
    first: tuple[int, int, int] = (0, 0, 0)
    """The node that the arrays begin with. A grid that moves by whole cells changes it and not the origin: particles
    then see the same numbers, to the bit."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require_number("spacing", self.spacing, above=0.0, unit="m")
        if len(self.shape) != 3 or min(self.shape) < 2 * MARGIN + 2:
            raise ConfigError(f"shape: expected three numbers of at least {2 * MARGIN + 2} nodes, got {self.shape}")
        if len(self.origin) != 3 or not np.isfinite(self.origin).all():
            raise ConfigError(f"origin: expected three finite coordinates [m], got {self.origin}")
        if len(self.first) != 3 or not all(isinstance(n, int) for n in self.first):
            raise ConfigError(f"first: expected three whole numbers, got {self.first}")

    @classmethod
    def around(cls, *points: ArrayLike, spacing: float, room: float = 4.0) -> Grid:
        """Return a grid that holds points.

        Args:
            points: Positions [m], each of shape (N, 3).
            spacing: Distance between nodes [m].
            room: Cells that are free on every side, beside the two that particles must not enter.

        Raises:
            ConfigError: If the spacing is not positive.
        """
        require_number("spacing", spacing, above=0.0, unit="m")
        all_points = np.concatenate([np.asarray(p, dtype=np.float64).reshape(-1, 3) for p in points])
        low, high = all_points.min(axis=0), all_points.max(axis=0)
        cells = np.ceil((high - low) / spacing + 2.0 * (room + MARGIN)).astype(int)
        first = 0.5 * (low + high) - 0.5 * cells * spacing
        return cls(
            shape=(int(cells[0]) + 1, int(cells[1]) + 1, int(cells[2]) + 1),
            spacing=spacing,
            origin=(float(first[0]), float(first[1]), float(first[2])),
        )

    @property
    def low(self) -> Array:
        """Position of the first node of the arrays [m], shape (3,)."""
        return np.array(self.origin) + self.spacing * np.array(self.first)

    @property
    def middle(self) -> Array:
        """The middle of the grid [m], shape (3,)."""
        return self.low + 0.5 * (np.array(self.shape) - 1) * self.spacing

    def reaching(self, *points: ArrayLike, room: int) -> Grid:
        """Return this grid if points have room on it, else one with the same nodes that lies around them.

        It moves by whole cells. Axes along which it has too few nodes get as many as are needed and ``SLACK`` more.

        Args:
            points: Positions [m], each of shape (N, 3).
            room: Cells that are free on every side, beside those that particles must not enter.
        """
        all_points = np.concatenate([np.asarray(p, dtype=np.float64).reshape(-1, 3) for p in points])
        cell = np.floor((all_points - np.array(self.origin)) / self.spacing)
        low, high = cell.min(axis=0) - (room + MARGIN - 1), cell.max(axis=0) + (room + MARGIN)
        first, shape = np.array(self.first), np.array(self.shape)
        if (low >= first).all() and (high < first + shape).all():
            return self
        needed = (high - low).astype(int) + 1
        size = np.where(needed <= shape, shape, needed + SLACK)
        start = np.floor(0.5 * (low + high + 1 - size)).astype(int)
        return replace(
            self,
            shape=(int(size[0]), int(size[1]), int(size[2])),
            first=(int(start[0]), int(start[1]), int(start[2])),
        )

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Return whether points (N, 3) [m] are where a particle may be, shape (N,)."""
        at = np.floor((points - np.array(self.origin)) / self.spacing) - np.array(self.first)
        return np.asarray(((at >= 1) & (at < np.array(self.shape) - MARGIN)).all(axis=1))

    def require(self, points: Array, what: str) -> None:
        """Raise unless a particle may be at all points.

        Raises:
            ConfigError: If one lies outside.
        """
        bad = np.flatnonzero(~self.holds(points))
        if len(bad):
            raise ConfigError(
                f"{what}: {len(bad)} of {len(points)} points lie outside of the grid, the first at {points[bad[0]]} m",
                hint="move or shrink it, or give a larger grid, such as Grid.around(points, spacing=...)",
            )
