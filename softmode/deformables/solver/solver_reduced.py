"""SolverReduced: the implicit reduced step as a Newton solver, for several bodies and worlds, captured as a graph."""

from collections.abc import Callable, Sequence

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material_kernels import MaterialModel, needs_volume
from softmode.deformables.materials.paths import require_models
from softmode.deformables.model.authoring import (
    NAMESPACE,
    add_pins,
    add_reduced_body,
    drive_regions,
    register_custom_attributes,
)
from softmode.deformables.model.namespaces import SoftControl, soft
from softmode.deformables.model.neighbours import warn_foreign_deformables, warn_still_bodies
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.model.tables import present
from softmode.deformables.solver import finish as last_phase
from softmode.deformables.solver.attachments import warn_untold_pins
from softmode.deformables.solver.detect import detect
from softmode.deformables.solver.minimise import minimise
from softmode.deformables.solver.observables import ReducedObservableKind, ReducedObservables
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.deformables.solver.predict import predict
from softmode.deformables.solver.solver_base import ReducedSolver
from softmode.deformables.solver.step_checks import check_step
from softmode.deformables.solver.step_tables import allocate_tables
from softmode.errors import ConfigError
from softmode.versions import warn_untested

__all__ = [
    "SolverReduced",
    "SolverReducedOptions",
    "add_pins",
    "add_reduced_body",
    "drive_regions",
    "register_custom_attributes",
]


class SolverReduced(ReducedSolver):
    """Implicit Euler or BDF2 on the reduced coordinates of every soft body of a model.

    Rigid shapes are obstacles that move as their bodies do in ``state_in``; for two-way contact with MuJoCo use
    :class:`softmode.deformables.coupling.solver_coupled.SolverCoupledReduced`.

    A step costs no host read-back and may be captured with ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model that holds bodies added by :func:`add_reduced_body`.
        bodies: The reduced bodies used in the model, in any order.
        options: How the step is solved.
        rigid: Joint dofs that take part in the solve, as a coupling has them; default none.

    Warns:
        UserWarning: If the model has rigid bodies that could move and are not kinematic, or deformables of Newton's.

    Raises:
        ConfigError: If a body of the model is not among ``bodies``, or a shape cannot be touched.
        MaterialError: If a body has a material model that is not known.
    """

    def __init__(
        self,
        model: newton.Model,
        bodies: Sequence[ReducedBody],
        *,
        options: SolverReducedOptions | None = None,
        rigid: RigidDofs | None = None,
    ) -> None:
        """Allocate the tables; see the class."""
        warn_untested()
        if not hasattr(model, NAMESPACE):
            raise ConfigError("model holds no reduced body", hint="call add_reduced_body before finalize")
        joints = rigid or RigidDofs.prescribed(model)
        super().__init__(model, allocate_tables(model, bodies, options or SolverReducedOptions(), joints))
        if rigid is None:
            warn_still_bodies(model)
            warn_foreign_deformables(model, self.tables.layout)
        self._prescribed = True
        self._check_materials()
        warn_untold_pins(model, self.tables.layout)
        self.refresh()

    def _check_materials(self) -> None:
        """Refuse materials that the bodies cannot have."""
        require_materials(self.tables.instances.driven_count.numpy(), self.parameters.material_model.numpy())

    def notify_model_changed(self, flags: int) -> None:
        """Follow changes of the model: call it, with any flags, after a change of density, scale or material model.

        Everything else (Young's modulus, Poisson's ratio, viscosity, damping, friction, contact stiffness, pins,
        gravity, shapes' poses and friction) is read in every step. May be captured, and then checks nothing.
        """
        self.refresh()
        if not self.model.device.is_capturing:
            self._check_materials()

    def step(  # pyright: ignore[reportIncompatibleMethodOverride]  # the observables are those of this solver
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: ReducedObservables | None = None,
    ) -> None:
        """Advance every soft body by ``dt`` [s]; rigid bodies move as prescribed by ``state_in``.

        Args:
            state_in: State at the start of the step.
            state_out: State that is written; it may be ``state_in``.
            control: Where driven regions and pins are to be; None leaves them where the model has them.
            contacts: Not read: the solver finds contacts between soft bodies and shapes itself.
            dt: Step [s].
            observables: What to report besides the state.

        Raises:
            ConfigError: If ``dt`` is not finite and positive, or a state or the control belongs to another model.
        """
        self.validate_observables(observables, contacts)
        check_step(self.model, state_in, state_out, control, dt)
        self.advance(state_in, state_out, self.targets(control), dt)
        self.report(observables)

    def advance(
        self,
        state_in: newton.State,
        state_out: newton.State,
        targets: SoftControl,
        dt: float,
        *,
        couple: Callable[[], None] | None = None,
    ) -> None:
        """Take a step: predict, detect contacts, minimise the incremental potential, write the state.

        Args:
            state_in: State at the start of the step.
            state_out: State that is written.
            targets: Where driven regions and pins are to be.
            dt: Step [s].
            couple: Lets rigid dofs take part once the contacts are known; None where rigid bodies move as prescribed.
        """
        self._prescribed = couple is None
        predict(self.tables, state_in, targets, dt)
        detect(self.tables, state_in, targets, dt, prescribed=self._prescribed)
        if couple is not None:
            couple()
        minimise(self.tables, dt)
        last_phase.finish(self.tables, state_out, dt, prescribed=self._prescribed)

    def targets(self, control: newton.Control | None) -> SoftControl:
        """Return the targets of a control, the model's where there is none."""
        return self.parameters if control is None else soft(control)

    # -- the phases, one by one ---------------------------------------------------------------------------------------

    def begin(self, state: newton.State, control: newton.Control | None, dt: float) -> None:
        """Read the state and predict; see :func:`softmode.deformables.solver.predict.predict`."""
        predict(self.tables, state, self.targets(control), dt)

    def detect(self, state: newton.State, control: newton.Control | None, dt: float, *, prescribed: bool) -> None:
        """Find the contacts of the step; see :func:`softmode.deformables.solver.detect.detect`."""
        self._prescribed = prescribed
        detect(self.tables, state, self.targets(control), dt, prescribed=prescribed)

    def minimise(self, dt: float) -> None:
        """Minimise the incremental potential of every world; see `softmode.deformables.solver.minimise`."""
        minimise(self.tables, dt)

    def finish(self, state: newton.State, dt: float) -> None:
        """Write the state and sum the reactions; see :func:`softmode.deformables.solver.finish.finish`."""
        last_phase.finish(self.tables, state, dt, prescribed=self._prescribed)

    def report(self, observables: ReducedObservables | None) -> None:
        """Write the contact forces of the step into the arrays that ``observables`` asks for."""
        if observables is None:
            return
        if observables.is_requested(ReducedObservableKind.BODY_SOFT_CONTACT_F):
            wp.copy(present(observables.body_soft_contact_f), self.body_wrench, count=self.model.body_count)
        if observables.is_requested(ReducedObservableKind.INSTANCE_CONTACT_F):
            wp.copy(present(observables.instance_contact_f), self.instance_force)

    def reset(
        self, state: newton.State, world_mask: wp.array | None = None, flags: newton.StateFlags | int | None = None
    ) -> None:
        """Put the bodies of the chosen worlds back to the model's initial state and clear what those worlds report.

        A body whose scale has changed since it was added is placed at its new size about its centre of mass.

        Args:
            state: State to reset in place.
            world_mask: Boolean mask of shape (world_count + 1,), the last entry for entities outside worlds; or None
                for all.
            flags: ``newton.StateFlags``; coordinates are reset with PARTICLE_Q, velocities with PARTICLE_QD. None
                resets all.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        flags = newton.StateFlags.ALL if flags is None else flags
        last_phase.reset(self.tables, state, self.checked_mask(world_mask), flags)


def require_materials(driven_counts: ArrayLike, models: ArrayLike) -> None:
    """Refuse a material that a driven region may invert, or whose model is not known.

    Args:
        driven_counts: Prescribed functions of each body.
        models: Numbers of the material models.

    Raises:
        ConfigError: If a body with exact regions has an energy that is infinite at J <= 0.
        MaterialError: If a model is not known to all code that evaluates it.
    """
    require_models(np.unique(models).tolist())
    for count, model in zip(np.ravel(driven_counts), np.ravel(models), strict=True):
        if count > 0 and needs_volume(int(model)):
            name = MaterialModel(model).name
            raise ConfigError(
                f"a body with exact regions has the material {name}, which a driven region may invert in one step",
                hint="use STABLE_NEO_HOOKEAN_LOG, or a soft region",
            )
