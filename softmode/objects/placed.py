"""`Placed`: a soft object at its place in a world or on a stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import SCALE_MAX, SCALE_MIN, add_reduced_body, rotation_matrix
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.splats.splats import Splats

Vector = tuple[float, float, float]
_PLACE = ("material", "position", "rotation", "velocity", "scale")


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A soft object at its place: x = scale rotation X + position.

    Raises:
        ConfigError: If the place is not finite, the rotation is no rotation, or the scale lies outside 0.25..4.
    """

    object: SoftObject
    """The object; several places may share one."""
    position: Vector = (0.0, 0.0, 0.0)
    """Where its centre of mass is [m]."""
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """How it is turned, shape (3, 3)."""
    scale: float = 1.0
    """Its size over that of the object, 0.25 to 4."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity of its centre of mass [m/s]."""
    name: str = ""
    """Its name on a stage, made valid and unique there; the body's own if empty."""

    def __post_init__(self) -> None:
        """Check the place."""
        if np.shape(self.position) != (3,) or not np.isfinite(self.position).all():
            raise ConfigError(f"position must be three finite numbers, got {self.position!r}", hint="give metres")
        object.__setattr__(self, "rotation", rotation_matrix(self.rotation))
        require_number("scale", self.scale, at_least=SCALE_MIN, at_most=SCALE_MAX, hint="build anew")

    @property
    def body(self) -> ReducedBody:
        """The body of the object."""
        return self.object.body

    @property
    def splats(self) -> Splats | None:
        """The splats of the object in the body frame [m]."""
        return self.object.splats

    @property
    def material(self) -> Material:
        """What the object is made of, `Material()` where it does not say."""
        return self.object.material or Material()

    @property
    def mass(self) -> float:
        """Its mass [kg]."""
        return self.material.density * self.scale**3 * self.body.volume

    def placed_splats(self) -> Splats | None:
        """Return its splats where it is [m]; None if it has none."""
        if self.splats is None:
            return None
        return self.splats.transformed(rotation=self.rotation, translation=self.position, scale=self.scale)

    def add_to(self, builder: newton.ModelBuilder, **options: Any) -> int:
        """Add the body to a world.

        Args:
            builder: Builder of the world.
            options: Further keywords of :func:`softmode.deformables.model.authoring.add_reduced_body`.

        Returns:
            Index of the instance in this builder, for `add_pins`, `attach` and the parameters of one world.
        """
        given: dict[str, Any] = {name: getattr(self, name) for name in _PLACE}
        given["contact_radius"] = self.object.contact_radius
        return add_reduced_body(builder, self.body, **given | options)
