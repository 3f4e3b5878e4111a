"""What goes into a stage: a body with what it is made of, how it looks and where it is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import SCALE_MAX, SCALE_MIN, rotation_matrix
from softmode.errors import ConfigError
from softmode.splats.splats import Splats


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedBody:
    """A body at its place, with material and splats: x = scale rotation X + position.

    Raises:
        ConfigError: If the place is not finite, the rotation is no rotation, or the scale lies outside 0.25..4.
    """

    body: ReducedBody
    """The body."""
    material: Material = field(default_factory=Material)
    """What it is made of."""
    splats: Splats | None = None
    """Its splats in the body frame [m], None for a body without a picture."""
    name: str = ""
    """Name of its prim, made valid and unique; the body's own if empty."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where its centre of mass is [m]."""
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """How it is turned, shape (3, 3)."""
    scale: float = 1.0
    """Its size over that of the body, 0.25 to 4."""

    def __post_init__(self) -> None:
        """Check the place."""
        if np.shape(self.position) != (3,) or not np.isfinite(self.position).all():
            raise ConfigError(f"position must be three finite numbers, got {self.position!r}", hint="give metres")
        object.__setattr__(self, "rotation", rotation_matrix(self.rotation))
        if not SCALE_MIN <= self.scale <= SCALE_MAX:
            raise ConfigError(f"scale must lie in [{SCALE_MIN}, {SCALE_MAX}], got {self.scale!r}", hint="build anew")

    @property
    def mass(self) -> float:
        """Its mass [kg]."""
        return self.material.density * self.scale**3 * self.body.volume
