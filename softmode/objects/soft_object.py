"""`SoftObject`: a body with the splats that show it and what it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.report import Finding, object_findings
from softmode.deformables.materials.material import Material
from softmode.deformables.skinning.skin_splats import average_basis
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.splats.splats import Splats

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftObject:
    """A body, its splats in the body frame, and its material."""

    body: ReducedBody
    """The reduced body."""
    splats: Splats | None = None
    """Splats with centres in the body frame [m]; None for a body without a picture."""
    material: Material | None = None
    """What it is made of; None where neither its file nor its user has said it."""
    contact_radius: float = 0.0
    """How far the surface that touches stands out from the body's [m]."""
    config: ObjectConfig | None = None
    """What it was made from, to make it anew with other options; None if that is not known."""
    notes: tuple[str, ...] = ()
    """What was read from its file in another way than it was meant."""

    @property
    def visible_splats(self) -> Splats:
        """The splats.

        Raises:
            ConfigError: If it has none.
        """
        if self.splats is None:
            raise ConfigError(f"{self.body.name}: has no splats", hint="give it some, such as surface_cover(body)")
        return self.splats

    @property
    def height(self) -> float:
        """Height of the body frame's origin over the table at rest [m].

        Counted from the lowest surface sample, and from the contact radius below it where no region holds the object.
        """
        lifted = 0.0 if self.body.driven_count else self.contact_radius
        return float(-self.body.surface_points[:, 2].min()) + lifted

    def findings(self, *, opening: float | None = None) -> tuple[Finding, ...]:
        """Return what its user should know before it is simulated; see `object_findings`.

        Args:
            opening: How far the gripper that is to take it opens [m]; None where nothing is to.
        """
        splats = None if self.splats is None else self.splats.means
        return object_findings(self.body, splats=splats, size=self.size_asked, opening=opening)

    @property
    def size_asked(self) -> float | None:
        """Longest edge that its file was to be given [m]; None for what has its own size."""
        made = self.config
        return None if made is None or made.body is not None or made.extents is not None else made.size

    @property
    def basis(self) -> Array:
        """Functions averaged over each splat, for `SkinSplats`, shape (N, n)."""
        return self._averages[0]

    @property
    def grad_basis(self) -> Array:
        """Their gradients, averaged likewise [1/m], shape (N, n, 3)."""
        return self._averages[1]

    @cached_property
    def _averages(self) -> tuple[Array, Array]:
        splats = self.visible_splats
        return average_basis(lambda x: self.body.evaluate(x)[0], splats.means, splats.covariances())
