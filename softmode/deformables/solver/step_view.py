"""What a solver lets others read: the last step, without its work space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.contact.pair_kernels import Pairs
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.struct_kernels import Basis, Instances, Motion, PointConstraints, Points, Samples
from softmode.deformables.solver.step_tables import StepTables
from softmode.errors import ConfigError


@dataclass(frozen=True)
class StepView:
    """The bodies of a solver and its last step, for sensors, pictures and rewards; nothing here is to be written.

    Args:
        tables: The solver's tables.
    """

    tables: StepTables

    @property
    def layout(self) -> Layout:
        """Counts, and which body is where."""
        return self.tables.layout

    @property
    def instances(self) -> Instances:
        """Where every instance finds its data, its mass, size and parameters."""
        return self.tables.instances

    @property
    def basis(self) -> Basis:
        """The bases of all bodies."""
        return self.tables.basis

    @property
    def motion(self) -> Motion:
        """Where the bodies were at the start of the step."""
        return self.tables.motion

    @property
    def points(self) -> Points:
        """Energies and volume ratios at the cubature points."""
        return self.tables.points

    @property
    def samples(self) -> Samples:
        """Surface samples at the start of the step, and the shapes near them."""
        return self.tables.samples

    @property
    def constraints(self) -> PointConstraints:
        """Pins and contacts: per instance first its pins, then contacts with shapes, then those with soft bodies."""
        return self.tables.constraints

    @property
    def pairs(self) -> Pairs | None:
        """Surfaces of soft bodies and what touches them, None where soft bodies never touch."""
        return None if self.tables.pairs is None else self.tables.pairs.table

    @property
    def instance_start(self) -> wp.array:
        """First instance of each world, and the end, int (world_count + 1,)."""
        return self.tables.newton.instance_start

    @property
    def rigid_tolerance(self) -> wp.array:
        """Least tolerance of the bodies of each world [m], (world_count,)."""
        return self.tables.scaled.rigid_tolerance

    @property
    def constraint_max(self) -> int:
        """Point constraints that an instance has room for."""
        return self.tables.constraints.row.shape[1]

    def settled(self) -> NDArray[np.float64]:
        """Return how far the last step moved each body (rms) over its size, shape (instance_count,): 0 at rest.

        Judge rest by it and not by time: what is viscous creeps for long. Reads from the device.
        """
        moved = self.tables.arrays.q.numpy() - self.motion.q_start.numpy()
        return np.sqrt((moved**2).reshape(len(moved), -1).sum(axis=1)) / self.instances.size.numpy()

    def last_step(self) -> tuple[Instances, Basis, Motion, PointConstraints, wp.array]:
        """Return what kernels that sum over point constraints take."""
        return self.instances, self.basis, self.motion, self.constraints, self.instance_start

    def instance(self, world: int, body: int) -> int:
        """Return the index of a soft body of a world among all instances.

        Raises:
            ConfigError: If the world has no such body.
        """
        start = self.layout.instance_start
        if not (0 <= world < len(start) - 1 and 0 <= body < start[world + 1] - start[world]):
            raise ConfigError(f"world {world} has no soft body {body}", hint="count within one world")
        return int(start[world]) + body

    def bodies_per_world(self) -> int:
        """Return how many soft bodies every world has at least."""
        return int(np.diff(self.layout.instance_start).min())
