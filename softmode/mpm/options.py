"""MpmOptions: how particles are stepped."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from softmode.checks import require_choice, require_number
from softmode.errors import ConfigError
from softmode.mpm.grid import Grid

Control = Literal["material", "additive"]
RestVolume = Literal["density", "grid"]
Precision = Literal["float32", "float64"]

COURANT_LIMIT = 0.9
"""Largest part of a cell that sound may cross in a step."""


@dataclass(frozen=True, kw_only=True)
class MpmOptions:
    """How particles are stepped."""

    grid: Grid = field(default_factory=Grid)
    """The grid."""
    dt: float = 1.0 / 120.0
    """Duration of a step [s]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Acceleration [m/s^2]."""
    damping: float = 0.0
    """zeta [1/s]: a step takes 1 - zeta dt of every particle's velocity."""
    smoothing: float = 0.0
    """gamma, 0 <= gamma < 1: part of F that a step leaves behind. With gamma > 0, F is not the gradient of the motion
    any more; the body flows like a viscous one."""
    control: Control = "material"
    """What a control A does to F: "material" is F (I + A), which turns with the body; "additive" is F + A, as in the
    paper."""
    rest_volume: RestVolume = "density"
    """Volume that a particle's stress acts in: "density" is m / rho; "grid" is m dx^3 / sum_i w_i m_i, as in the paper,
    which is too large at the surface: a bar three cells thick rings 29 % too high with it."""
    precision: Precision = "float32"
    """Of particles and grid. Stresses are always float64."""
    memory_limit: float = 2.0e9
    """Bytes that states of a run may take. Beyond it only every sqrt(T)-th step is kept, and the others are computed
    again for the gradient, to the same bits on a CPU."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require_number("dt", self.dt, above=0.0, unit="s")
        require_number("damping", self.damping, at_least=0.0, at_most=1.0 / self.dt, unit="1/s")
        require_number("smoothing", self.smoothing, at_least=0.0, below=1.0)
        require_number("memory_limit", self.memory_limit, above=0.0, unit="bytes")
        require_choice("control", self.control, get_args(Control))
        require_choice("rest_volume", self.rest_volume, get_args(RestVolume))
        require_choice("precision", self.precision, get_args(Precision))
        if len(self.gravity) != 3 or not np.isfinite(self.gravity).all():
            raise ConfigError(f"gravity: expected three finite numbers [m/s^2], got {self.gravity}")
