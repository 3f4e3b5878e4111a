"""Energies of soft bodies: kinetic, elastic, gravitational, evaluated where the solver evaluates them."""

import newton
import warp as wp

from softmode.deformables.model.namespaces import soft
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.deformables.tools import energy_kernels as kernels


class SoftEnergies:
    """Energies of every soft body of a model, in float64; ``update`` reads nothing back and may be captured.

    The elastic energy is that of the material at the cubature points, without what a step dissipates; contacts, pins
    and other springs store energy of their own that is in none of the three. Without contact, pins and damping their
    sum is conserved up to the dissipation of the integrator.

    Args:
        solver: A :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, or a solver that couples one.

    Attributes:
        kinetic: m/2 sum_k |dq_k/dt|^2 [J], shape (instance_count,); instances follow each other world by world.
        elastic: s^3 sum_p V_p Psi(F_p / s) [J], s the body's scale, likewise.
        gravitational: -m g.c [J], c the centre of mass, likewise; zero for a body at the origin.

    Raises:
        ConfigError: If the solver has no soft bodies.
    """

    def __init__(self, solver: ReducedSolver) -> None:
        """Allocate the energies."""
        self._tables = tables = require_reduced(solver).tables
        self.kinetic, self.elastic, self.gravitational = (
            wp.zeros(tables.layout.instance_count, dtype=wp.float64, device=tables.model.device) for _ in range(3)
        )

    def update(self, state: newton.State) -> None:
        """Evaluate the energies of a state of the solver's model."""
        t, data, count = self._tables, soft(state), len(self.kinetic)
        bodies, out = (t.instances, t.basis), (self.kinetic, self.gravitational)
        t.launch(kernels.sum_kinetic_and_gravitational, count, *bodies, t.model.gravity, data.q, data.qd, *out)
        t.launch(kernels.sum_elastic, count, *bodies, data.q, self.elastic)
