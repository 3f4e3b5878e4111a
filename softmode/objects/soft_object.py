"""`SoftObject`: a body with the splats that show it and what it is made of."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import FORMAT_VERSION, ReducedBody
from softmode.deformables.contact.dents import DentWeights, dent_weights
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.cache import cached
from softmode.deformables.reduction.report import Finding, object_findings
from softmode.deformables.skinning.averages import average_basis
from softmode.errors import ConfigError, GraspError
from softmode.files import read_archive, write_archive
from softmode.objects.config import ObjectConfig
from softmode.objects.rest_grasps import rest_grasps
from softmode.radiance.grid import RadianceGrid
from softmode.robots.jaws import ParallelJaw
from softmode.splats.splats import Splats
from softmode.stages import stage

Array = NDArray[np.float64]

KEPT_FROM = 20_000
"""Splats from which on averages are kept in the cache: 80 MB for 100,000 of 48 functions, which take 12 s."""


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
    radiance: RadianceGrid | None = None
    """The radiance field that it was made from, in the body frame."""
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
        return float(-self.body.surface.points[:, 2].min()) + lifted

    def findings(self, *, jaw: ParallelJaw | None = None) -> tuple[Finding, ...]:
        """Return what its user should know before it is simulated; see `object_findings`.

        Args:
            jaw: The gripper that is to take it from where it stands, see `plan_grasps`; None where none is to.
        """
        splats = None if self.splats is None else self.splats.means
        found = tuple(Finding(severity="note", name="file", what=note, remedy="") for note in self.notes)
        found += object_findings(self.body, splats=splats, size=self.size_asked)
        if jaw is None:
            return found
        friction = math.sqrt((self.material or Material()).friction * jaw.friction)
        try:
            rest_grasps(self.body, jaw, friction=max(friction, 1e-3))
        except GraspError as error:
            return (*found, Finding(severity="warning", name="gripper", what=error.message, remedy=error.hint))
        return found

    @property
    def marched(self) -> RadianceGrid | None:
        """Its field if cameras are to march through it (`ObjectConfig.march`), else None."""
        return self.radiance if self.config is not None and self.config.march else None

    @property
    def field_pose(self) -> Array | None:
        """What takes places in the frame of the field's file into the body frame, a scale times a rotation, and a move.

        Shape (4, 4); None if it is not made of a field. So a camera of the pictures that the field was trained on sees
        the body.
        """
        told = self.body.provenance.get("field_pose")
        return None if told is None else np.array(json.loads(str(told)))

    @property
    def size_asked(self) -> float | None:
        """Longest edge that its file was to be given [m]; None for what has its own size."""
        return None if self.config is None else self.config.longest_edge

    @property
    def basis(self) -> Array:
        """Functions averaged over each splat, for `SkinSplats`, shape (N, n)."""
        return self._averages[0]

    @property
    def grad_basis(self) -> Array:
        """Their gradients, averaged likewise [1/m], shape (N, n, 3)."""
        return self._averages[1]

    @cached_property
    def radius(self) -> float:
        """Distance of the farthest surface sample from the origin of the body frame [m]."""
        return float(np.linalg.norm(self.body.surface.points, axis=1).max())

    @cached_property
    def dents(self) -> DentWeights:
        """How the splats follow the dents of the surface samples."""
        return dent_weights(self.body, self.visible_splats.means)

    @cached_property
    def _averages(self) -> tuple[Array, Array]:
        return self._averaged(lambda share: None)

    def average(self, progress: Callable[[float], None]) -> None:
        """Average the functions over the splats now, and not where `basis` is first read.

        Args:
            progress: Told which share of the splats is done, 0 to 1.
        """
        self.__dict__["_averages"] = self._averaged(progress)

    def _averaged(self, progress: Callable[[float], None]) -> tuple[Array, Array]:
        body, splats = self.body, self.visible_splats
        means, covariances = splats.means, splats.covariances()

        def make() -> tuple[Array, Array]:
            with stage(f"averaging functions over {splats.count} splats"):
                return average_basis(body, means, covariances, progress=progress)

        def read(path: Path) -> tuple[Array, Array]:
            found = read_archive(path, "softmode.averages", 1)[1]
            return found["value"].astype(np.float64), found["gradient"].astype(np.float64)

        def write(made: tuple[Array, Array], path: Path) -> None:
            arrays = {name: part.astype(np.float32) for name, part in zip(("value", "gradient"), made, strict=True)}
            write_archive(path, {"format": "softmode.averages", "version": 1}, arrays)

        if splats.count < KEPT_FROM:
            return make()
        return cached("averages", (FORMAT_VERSION, body.fingerprint, means, covariances), make, read, write)
