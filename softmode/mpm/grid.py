"""Grid: the nodes that particles exchange momentum on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.errors import ConfigError

Array = NDArray[np.float64]

MARGIN = 2
"""Cells at the border of a grid that particles must not enter: a particle reaches nodes two cells away."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A uniform grid of nodes."""

    shape: tuple[int, int, int] = (32, 32, 32)
    """Nodes along x, y, z."""
    spacing: float = 1.0
    """Distance dx between nodes [m]."""
    origin: tuple[float, float, float] = (-16.0, -16.0, -16.0)
    """Position of the first node [m]."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require_number("spacing", self.spacing, above=0.0, unit="m")
        if len(self.shape) != 3 or min(self.shape) < 2 * MARGIN + 2:
            raise ConfigError(f"shape: expected three numbers of at least {2 * MARGIN + 2} nodes, got {self.shape}")
        if len(self.origin) != 3 or not np.isfinite(self.origin).all():
            raise ConfigError(f"origin: expected three finite coordinates [m], got {self.origin}")

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

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Return whether points (N, 3) [m] are where a particle may be, shape (N,)."""
        at = np.floor((points - np.array(self.origin)) / self.spacing)
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
