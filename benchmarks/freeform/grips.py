"""Springs that hold and pull objects: the boundary conditions of Table 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POISSONS_RATIO, DENSITY, GRAVITY = 0.45, 1000.0, 9.81
SPRINGS = 30.0
"""Springs per volume of a held part, times E / cell^2."""
PULL = 0.15
"""How far each part is pulled, over the longest edge."""
DT, STEPS = 0.01, 30
CONDITIONS = ("fix", "farthest", "boundary")


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Springs of one condition."""

    points: Array
    """Rest points [m], (G, 3)."""
    stiffness: Array
    """Of each [N/m], (G,)."""
    pull: Array
    """Displacement of its target at the end of the motion [m], (G, 3)."""
    gravity: float
    """Gravity against the object's axis [m/s^2]."""
    part: NDArray[np.intp]
    """Held part of every point, (G,)."""

    def targets(self, step: int, steps: int) -> Array:
        """Return where the targets are at the end of a step [m], (G, 3): from rest to rest, smoothly."""
        t = step / steps
        return self.points + t * t * (3.0 - 2.0 * t) * self.pull
