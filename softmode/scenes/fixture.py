"""Rigid shapes that stay where they are: walls, pegs, tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import newton
import numpy as np
import warp as wp

from softmode.errors import ConfigError

_SIZES = {
    "box": ("hx", "hy", "hz"),
    "sphere": ("radius",),
    "capsule": ("radius", "half_height"),
    "cylinder": ("radius", "half_height"),
}
"""What the lengths of each kind are called in `newton.ModelBuilder.add_shape_box` and its like."""


@dataclass(frozen=True, kw_only=True)
class Fixture:
    """A rigid shape that stays where it is: a wall of a bin, a peg."""

    label: str
    """Name of the shape."""
    shape: Literal["box", "sphere", "capsule", "cylinder"] = "box"
    """Its kind; capsules and cylinders stand along z."""
    size: tuple[float, ...]
    """Half extents of a box, radius of a sphere, radius and half height of the others [m]."""
    position: tuple[float, float, float]
    """Its centre [m]; the table's top is z = 0."""
    yaw: float = 0.0
    """Rotation about the vertical [rad]."""
    color: tuple[float, float, float] = (0.62, 0.62, 0.60)
    """Its colour, sRGB."""
    friction: float = 0.8
    """Coulomb coefficient."""

    def __post_init__(self) -> None:
        """Check kind and size."""
        if self.shape not in _SIZES:
            raise ConfigError(f"fixture {self.label!r} is a {self.shape!r}", hint=f"use one of {', '.join(_SIZES)}")
        count = len(_SIZES[self.shape])
        if len(self.size) != count or not all(0.0 < x < np.inf for x in self.size):
            hint = f"give {count} positive lengths [m] for a {self.shape}"
            raise ConfigError(f"fixture {self.label!r} has size {self.size}", hint=hint)
        if not np.isfinite(self.position).all():
            raise ConfigError(f"fixture {self.label!r} stands at {self.position}", hint="give finite coordinates [m]")


def add_fixture(builder: newton.ModelBuilder, fixture: Fixture) -> None:
    """Add a rigid shape that belongs to the world."""
    half = 0.5 * fixture.yaw
    place = wp.transform(fixture.position, wp.quat(0.0, 0.0, float(np.sin(half)), float(np.cos(half))))
    shape = newton.ModelBuilder.ShapeConfig(mu=fixture.friction, has_shape_collision=True)
    add = getattr(builder, f"add_shape_{fixture.shape}")
    size = dict(zip(_SIZES[fixture.shape], fixture.size, strict=True))
    add(-1, xform=place, cfg=shape, color=fixture.color, label=fixture.label, **size)
