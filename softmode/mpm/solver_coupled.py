"""SolverCoupledParticles: a robot's solver and the particles that it touches, in one step."""

from __future__ import annotations

from typing import Any

import newton
import warp as wp
from newton.solvers import SolverBase

from softmode.deformables.model.declare import WRENCH
from softmode.deformables.model.tables import present
from softmode.errors import ConfigError
from softmode.mpm.simulation import MpmSimulation


class SolverCoupledParticles(SolverBase):
    """Rigid bodies, and reduced ones where their solver moves them, beside particles that they push and that push them.

    A step is one of the solver, and all steps of the simulation:

    1. the shapes stand where the bodies are at the start, and move on with the velocities that they have there;
    2. the particles take their steps;
    3. what they gave to the shapes joins ``state.body_f`` as a mean wrench, as the push of reduced bodies does;
    4. the solver takes its step: the joint solve of ``SolverCoupledReduced`` sees it, with all constraints.

    Momentum that particles lose in a step, bodies get in the same. Late by a step is the velocity that particles
    meet: bodies do not give way within it. This is stable while what touches a shape (particles at its nodes, and the
    stiffness of what lies behind times dt^2) is lighter than the body is to a push, which is M + dt (D + K_d) as in the
    joint solve. Nothing is read back; a step may be captured with ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        solver: What moves the bodies: ``SolverMuJoCo``, :class:`softmode.deformables.SolverCoupledReduced`.
        particles: The particles, with the shapes of the same model.

    Raises:
        ConfigError: If the particles meet no shapes, or those of another model.
    """

    def __init__(self, solver: SolverBase, particles: MpmSimulation) -> None:
        """Tie both together."""
        if particles.shapes is None or particles.shapes.model is not solver.model:
            raise ConfigError(
                "particles: expected a simulation with the shapes of the solver's model",
                hint="build it with MpmSimulation(..., shapes=GridShapes(model))",
            )
        super().__init__(solver.model)
        self.solver, self.particles = solver, particles
        particles.coupled = True
        self.dt = particles.step_count * particles.options.dt
        """Duration of a step [s]."""
        self._start = [wp.clone(array) for array in particles.first.arrays]
        self._body_f = wp.zeros(solver.model.body_count, dtype=WRENCH, device=solver.model.device)

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        **options: Any,
    ) -> None:
        """Advance everything by ``dt`` [s], that of all steps of the particles.

        ``particles.first`` is where the particles are then; ``MpmSimulation.check`` says which have left the grid.

        Args:
            state_in: Where bodies are, with ``body_q`` of their joints (``newton.eval_fk``).
            state_out: Where they come to.
            control: As for the solver.
            contacts: As for the solver.
            dt: Duration of the step [s].
            options: Passed on to the solver.

        Raises:
            ConfigError: If ``dt`` is another one.
        """
        if abs(dt - self.dt) > 1.0e-6 * self.dt:
            raise ConfigError(
                f"dt: the particles take {self.particles.step_count} steps of {self.particles.options.dt:g} s, "
                f"{self.dt:g} s in all, got {dt:g} s",
                hint="choose step_count and MpmOptions.dt so that their product is the step of the solver",
            )
        particles = self.particles
        assert particles.shapes is not None
        particles.shapes.place(state_in)
        particles.forward()
        particles.first.copy_from(particles.last)
        force = present(state_in.body_f)
        wp.copy(self._body_f, force)
        particles.add_wrenches(state_in)
        self.solver.step(state_in, state_out, control, contacts, dt, **options)
        wp.copy(force, self._body_f)

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """Pass the change on; shapes are read as they are."""
        self.solver.notify_model_changed(flags)

    def reset(
        self, state: newton.State, world_mask: wp.array | None = None, flags: newton.StateFlags | int | None = None
    ) -> None:
        """Reset the solver's bodies and the particles.

        Args:
            state: State to reset in place.
            world_mask: None for all worlds.
            flags: As for the solver.

        Raises:
            ConfigError: If a mask is given: particles of single worlds are not reset.
        """
        if world_mask is not None:
            raise ConfigError("world_mask: particles are reset in all worlds", hint="give None")
        self.solver.reset(state, None, flags)
        for array, value in zip(self.particles.first.arrays, self._start, strict=True):
            wp.copy(array, value)
