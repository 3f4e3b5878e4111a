"""What every solver of soft bodies has in common: what others read of it, masks, attachments and parameters."""

from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import register_custom_attributes
from softmode.deformables.model.namespaces import SoftModel, soft
from softmode.deformables.solver import attachment_kernels
from softmode.deformables.solver import finish as last_phase
from softmode.deformables.solver.attachments import Attachment
from softmode.deformables.solver.observables import REDUCED_KINDS, ReducedObservableKind, ReducedObservables
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.deformables.solver.step_tables import StepTables
from softmode.deformables.solver.step_view import StepView
from softmode.errors import ConfigError


class ReducedSolver(SolverBase):
    """A solver that steps soft bodies, alone or with others; sensors, grips and parameters take any of them.

    Args:
        model: Finalised model.
        tables: Tables of its steps.
    """

    ObservableKind = ReducedObservableKind
    Observables = ReducedObservables
    SUPPORTED_OBSERVABLES = REDUCED_KINDS

    model: newton.Model

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """Declare the attributes of reduced bodies on a builder."""
        register_custom_attributes(builder)

    def __init__(self, model: newton.Model, tables: StepTables) -> None:
        """Keep the tables."""
        super().__init__(model)
        self.tables = tables
        """What the phases of a step read and write; others read :attr:`view`."""

    # -- what others read ---------------------------------------------------------------------------------------------

    @property
    def view(self) -> StepView:
        """The bodies and their last step, for reading."""
        return StepView(self.tables)

    @property
    def options(self) -> SolverReducedOptions:
        """How a step is solved."""
        return self.tables.options

    @property
    def notes(self) -> tuple[str, ...]:
        """What keeps Newton's iteration from its fast path on a GPU, a sentence each; none on a CPU."""
        return self.tables.notes

    @property
    def bodies(self) -> tuple[ReducedBody, ...]:
        """The distinct bodies."""
        return self.tables.layout.bodies

    @property
    def instance_count(self) -> int:
        """Number of soft bodies, over all worlds."""
        return self.tables.layout.instance_count

    @property
    def world_count(self) -> int:
        """Number of worlds."""
        return self.tables.layout.world_count

    @property
    def parameters(self) -> SoftModel:
        """Parameters of the bodies, initial state and targets: ``model.softmode``."""
        return self.tables.parameters

    @property
    def status(self) -> wp.array:
        """Status bits per world (see ``status``), gathered over steps until cleared with ``status.zero_()``."""
        return self.tables.newton.status

    @property
    def iteration(self) -> wp.array:
        """Newton iterations of the last step per world."""
        return self.tables.newton.iteration

    @property
    def body_wrench(self) -> wp.array:
        """Soft contact wrench on every rigid body about its centre of mass [N, N m], shape (body_count,)."""
        return self.tables.body_wrench

    @property
    def instance_force(self) -> wp.array:
        """Contact force on every soft body [N], vec3d (instance_count,)."""
        return self.tables.instance_force

    @property
    def reaction(self) -> wp.array:
        """Generalised forces that held the driven functions at the last iterate but one [N], in blocks.

        Their error is Newton's tolerance times the stiffness, so tighten it where forces of 1 % matter.
        """
        return self.tables.arrays.reaction

    # -- what others change -------------------------------------------------------------------------------------------

    def refresh(self, world_mask: wp.array | None = None) -> None:
        """Compute what follows from the model's densities and scales in the masked worlds.

        Args:
            world_mask: Boolean mask of shape (world_count + 1,) as for ``reset``; None for all worlds.
        """
        self.tables.scaled.derive(self.checked_mask(world_mask))

    def write_pins(self, instance: int, first: int, rows: np.ndarray, points: np.ndarray, count: int) -> None:
        """Give pins of a body other rest points, release them, and say how many pins the body has from now on.

        Args:
            instance: Index of the instance.
            first: Its first pin that is written.
            rows: Functions at the rest points, shape (written_count, function_count).
            points: Rest points at scale 1 [m], shape (written_count, 3).
            count: Pins that count; those behind them are idle.
        """
        t, pins = self.tables, self.tables.instances
        begin = int(pins.pin_start.numpy()[instance]) + first
        row = t.layout.first_pin_row + begin
        width = t.basis.row.shape[1]
        padded = np.zeros((len(rows), 8 * width), np.float32)
        padded[:, : rows.shape[1]] = rows
        t.basis.row[row : row + len(rows)].assign(padded.reshape(len(rows), width, 8))
        t.basis.row_point[row : row + len(rows)].assign(points)
        t.parameters.pin_stiffness[begin : begin + len(rows)].assign(np.zeros(len(rows)))
        pins.pin_count[instance : instance + 1].assign(np.array([count], np.int32))

    def update_particles(self, state: newton.State) -> None:
        """Move the surface particles of ``state`` to where its reduced coordinates put them."""
        last_phase.move_particles(self.tables, state)

    def release(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Let go of an attachment in the masked worlds; may be captured, then give a mask.

        Args:
            attachment: What :func:`softmode.deformables.solver.attachments.attach` returned.
            world_mask: Boolean mask of shape (world_count + 1,) as for ``reset``; None for all worlds.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        self._hold(attachment, world_mask, -1.0)

    def hold(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Take a released attachment up again; arguments as for :meth:`release`."""
        self._hold(attachment, world_mask, 1.0)

    def _hold(self, attachment: Attachment, world_mask: wp.array | None, sign: float) -> None:
        t, mask = self.tables, self.checked_mask(world_mask)
        worlds = (t.newton.instance_start, t.parameters.instance_world, mask)
        where = (attachment.instance, attachment.first, sign, t.parameters.pin_stiffness)
        t.launch(attachment_kernels.hold_pins, (self.world_count, attachment.count), t.instances, *worlds, *where)

    def move(self, attachment: Attachment, control: newton.Control, pose: wp.array) -> None:
        """Move what holds an attachment: its targets are those of the model, moved rigidly in each world.

        Reads nothing back; in a captured graph the poses are those that the array holds when it is replayed. A reset
        leaves the targets where they are: move them back too.

        Args:
            attachment: What :func:`softmode.deformables.solver.attachments.attach` returned.
            control: Control of the steps, whose ``softmode.pin_target`` is written.
            pose: Motion from where the targets were when the body was attached, in the frame of the link or the world,
                ``wp.transform`` of shape (world_count,), on the solver's device: x = R x_0 + t.

        Raises:
            ConfigError: If the poses have another shape or type or lie on another device, or the control shares its
                targets with the model.
        """
        t, given, start = self.tables, pose, self.parameters.pin_target
        form = (wp.transform, (self.world_count,), self.model.device)
        if not isinstance(given, wp.array) or (given.dtype, given.shape, given.device) != form:
            raise ConfigError(f"pose must be a wp.array of wp.transform, shape {form[1]}, on {form[2]}")
        target = soft(control).pin_target
        if target.ptr == start.ptr:
            raise ConfigError("control shares its arrays with the model", hint="make it with model.control()")
        where = (t.newton.instance_start, attachment.instance, attachment.first, given, start, target)
        t.launch(attachment_kernels.move_pins, (self.world_count, attachment.count), t.instances, *where)

    def checked_mask(self, world_mask: wp.array | None) -> wp.array:
        """Return the mask, all worlds if there is none; refuse what a kernel would misread.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        every = self.tables.every_world
        if world_mask is None:
            return every
        mask: Any = world_mask
        if not isinstance(mask, wp.array) or mask.dtype != every.dtype or mask.shape != every.shape:
            given = f"{mask.dtype.__name__} {mask.shape}" if isinstance(mask, wp.array) else type(mask).__name__
            raise ConfigError(
                f"world_mask must be a wp.array of wp.bool, shape (world_count + 1,) = {every.shape}, got {given}",
                hint="give the entities outside all worlds the last entry",
            )
        return mask


def require_reduced(solver: object) -> ReducedSolver:
    """Return a solver of soft bodies.

    Raises:
        ConfigError: If it is none.
    """
    if not isinstance(solver, ReducedSolver):
        raise ConfigError(f"solver is a {type(solver).__name__}", hint="pass a SolverReduced or a SolverCoupledReduced")
    return solver
