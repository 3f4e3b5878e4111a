"""SolverReduced as an entry of Newton's coupled solvers.

The joint solve of ``coupling`` is the main path to robots. This module lets others' couplers, first of all
``newton.solvers.experimental.coupled.SolverCoupledProxy``, drive the solver. It alone imports Newton's experimental
coupling namespace, which may change from one release to the next, and is kept apart from ``coupling`` for that.

In a proxy coupling another solver, the *source*, owns rigid bodies; this one, the *destination*, sees copies of them
with the source's effective inertia, the proxies. Each pass the source steps with the contact forces of the pass
before; then the proxies, taken back by the impulse of those forces, are free rigid bodies whose six velocities each
are unknowns of the same Newton solve as the soft coordinates; the contact wrenches found go back to the source. One
pass lags by a step and gains energy where contact is stiff or bodies are light; three passes hold.
"""

from collections.abc import Sequence

import newton
import numpy as np
import warp as wp
from newton.solvers.experimental.coupled import CouplingInterface  # pyright: ignore[reportMissingImports]

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.coupling import proxy_kernels as kernels
from softmode.deformables.model.authoring import MATERIAL_FIELDS
from softmode.deformables.model.declare import WRENCH
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.model.tables import body_world, starts_of
from softmode.deformables.solver.detect import differentiate_constraints
from softmode.deformables.solver.observables import ReducedObservables
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.deformables.solver.reduced_solver import ReducedSolver
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.deformables.solver.step_checks import check_step
from softmode.errors import ConfigError

LIVE_FIELDS = ("material_model", *MATERIAL_FIELDS, "contact_stiffness", "scale")
"""Attributes of ``model.softmode`` that may change at run time and that a view copies."""


class SolverReducedProxy(ReducedSolver, CouplingInterface):
    """A :class:`SolverReduced` whose rigid bodies are free and take part in the solve, for Newton's couplers.

    Use it as ``SolverCoupledProxy.Entry("soft", lambda view: SolverReducedProxy(view, bodies), in_place=True,
    particles=range(model.particle_count))``. Newton's couplers neither distribute nor collect states of custom
    frequencies (they say so in a warning), so the entry's own state carries ``softmode.q`` on: read it from
    ``coupled.entry_state("soft")``. For the same reason ``in_place`` is needed, and what is written into the parent
    state's ``softmode`` is not read; particles, poses and velocities are exchanged.

    Pins and driven regions are read from ``coupled.solver("soft").parameters`` (``pin_stiffness``, ``pin_target``,
    ``q_driven``), not from the model or the control. Newton copies the controls of custom frequencies in a way that
    cannot be captured on CPU: give the coupler a control without them, ``del control.softmode``.

    Proxy joints are not simulated: a proxy is a free body with the effective inertia that the source reports.

    Args:
        model: Finalised model or the view of one that a coupler passes.
        bodies: The reduced bodies used in the model.
        options: How the step is solved.

    Raises:
        ConfigError: If rigid bodies are not ordered by world.
    """

    def __init__(
        self, model: newton.Model, bodies: Sequence[ReducedBody], *, options: SolverReducedOptions | None = None
    ) -> None:
        """Tie the rigid bodies into the solve; see the class."""
        self.reduced = SolverReduced(model, bodies, options=options, rigid=_free_bodies(model))
        super().__init__(model, self.reduced.tables)
        self.impulse = wp.zeros(model.body_count, dtype=WRENCH, device=model.device)
        """Contact impulse on every rigid body since the coupler's last pass began [N s, N m s]."""
        self.start: dict[str, wp.array] | None = None
        """The soft state at the start of the step, where passes may be repeated."""
        self.coupled = False
        """Whether a coupler has taken the solver in."""

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
        """Advance soft bodies and free rigid bodies by ``dt`` [s]; only contact and ``state_in.body_f`` act on these.

        Raises:
            ConfigError: If a coupler steps the entry out of place, ``dt`` is not finite and positive, or a state
                belongs to another model.
        """
        self.validate_observables(observables, contacts)
        check_step(self.model, state_in, state_out, None, dt)
        if self.coupled and state_in is not state_out:
            raise ConfigError(
                "a coupler loses the soft coordinates between two states of an entry", hint="pass Entry(in_place=True)"
            )
        model, count, t = self.model, self.model.body_count, self.tables
        if count:
            inertia = (model.body_inv_mass, model.body_mass, model.body_inertia, model.body_inv_inertia)
            motion = (state_in.body_q, state_in.body_qd, state_in.body_f, wp.float64(dt))
            t.launch(kernels.predict_bodies, count, model.body_world, *inertia, *motion, t.rigid.table)
        self.reduced.advance(state_in, state_out, self.parameters, dt, couple=lambda: differentiate_constraints(t))
        if count:
            moved = (t.rigid.table, self.body_wrench, float(dt), state_in.body_q)
            out = (state_out.body_q, state_out.body_qd, self.impulse)
            t.launch(kernels.move_bodies, count, model.body_world, model.body_com, *moved, *out)
        self.reduced.report(observables)

    def reset(
        self, state: newton.State, world_mask: wp.array | None = None, flags: newton.StateFlags | int | None = None
    ) -> None:
        """Reset the soft bodies; see :meth:`softmode.deformables.solver.solver_reduced.SolverReduced.reset`."""
        self.reduced.reset(state, world_mask, flags)

    def notify_model_changed(self, flags: int) -> None:
        """Follow changes of the model; a coupler's view holds copies of the parameters, which are taken anew.

        Call it, through the coupler and with any flags, after every change of ``model.softmode``.
        """
        parent = getattr(self.model, "parent", None)
        if parent is not None:
            given = soft(parent)
            for name in filter(lambda name: hasattr(given, name), LIVE_FIELDS):
                own, source = getattr(self.parameters, name), getattr(given, name)
                if own.ptr != source.ptr:
                    wp.copy(own, source)
        self.reduced.notify_model_changed(flags)

    # -- what a coupler asks for --------------------------------------------------------------------------------------

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Prepare to start passes again from the state at the start of the step."""
        self.coupled = True
        if enabled:
            state = vars(soft(self.model.state()))
            self.start = {name: value for name, value in state.items() if isinstance(value, wp.array)}

    def coupling_notify_input_state_update(
        self, state: newton.State, flags: int, *, iteration_restart: bool = False, dt: float = 0.0
    ) -> None:
        """Keep the soft state when a step begins, and put it back when a further pass does."""
        if self.start is None or dt == 0.0 or not int(flags) & int(newton.StateFlags.PARTICLE_Q):
            return
        data = soft(state)
        for name, kept in self.start.items():
            current = getattr(data, name)
            wp.copy(current, kept) if iteration_restart else wp.copy(kept, current)

    def coupling_eval_gravity_acceleration(
        self, out_body_acceleration: wp.array | None, out_particle_acceleration: wp.array | None
    ) -> None:
        """Report that the solver applies no gravity to rigid bodies, and gravity to particles."""
        super().coupling_eval_gravity_acceleration(None, out_particle_acceleration)
        if out_body_acceleration is not None:
            out_body_acceleration.zero_()

    def coupling_rewind_proxy_body(
        self,
        body_local_to_proxy_global: wp.array,
        state: newton.State,
        coupling_forces: wp.array,
        body_gravity_acceleration: wp.array,
        dt: float,
    ) -> None:
        """Take the forces of the last pass back off the proxies."""
        super().coupling_rewind_proxy_body(
            body_local_to_proxy_global, state, coupling_forces, body_gravity_acceleration, dt
        )
        self.impulse.zero_()

    def coupling_prepare_proxy_contacts(
        self, state: newton.State, contacts: newton.Contacts | None, *, contacts_freshly_detected: bool = False
    ) -> newton.Contacts | None:
        """Leave the contacts alone: the solver finds its own."""
        return contacts

    def coupling_harvest_proxy_wrenches(
        self,
        body_local_to_proxy_global: wp.array,
        out_body_f: wp.array,
        *,
        body_qd_before: wp.array,
        state: newton.State,
        state_out: newton.State,
        contacts: newton.Contacts | None,
        dt: float,
    ) -> None:
        """Return the contact wrenches on the proxies, means over the substeps."""
        count = self.model.body_count
        if count:
            inputs = (body_local_to_proxy_global, self.impulse, float(dt), out_body_f)
            self.tables.launch(kernels.harvest_wrenches, count, *inputs)

    def coupling_eval_effective_mass(
        self, endpoint_kind: wp.array, endpoint_index: wp.array, endpoint_local_pos: wp.array, out: wp.array
    ) -> None:
        """Evaluate the mass that a surface sample, or a body, shows to a force: 3 / tr(J M^-1 J^T) [kg]."""
        super().coupling_eval_effective_mass(endpoint_kind, endpoint_index, endpoint_local_pos, out)
        particle = int(CouplingInterface.EndpointKind.PARTICLE)
        inputs = (self.tables.instances, self.tables.basis, particle, endpoint_kind, endpoint_index, out)
        self.tables.launch(kernels.sample_masses, out.shape[0], *inputs)

    def coupling_supports_inertial_property_refresh(self) -> bool:
        """Say that masses and inertia are read in every step."""
        return True


def _free_bodies(model: newton.Model) -> RigidDofs:
    """Give every rigid body six dofs, its velocity and angular velocity about its centre of mass."""
    count, world, worlds = model.body_count, body_world(model), max(model.world_count, 1)
    if (np.diff(world) < 0).any():
        raise ConfigError("rigid bodies are not ordered by world", hint="add bodies to one world before the next")
    counts = 6 * np.bincount(world, minlength=worlds)
    # each body is a tree of its own, with one link that its six dofs move as they are
    alone = {
        "body_articulation": np.arange(count),
        "body_link": np.zeros(count, int),
        "articulation_dof_start": 6 * np.arange(count),
        "articulation_dof_count": np.full(count, 6),
        "jacobian": np.tile(np.eye(6), (count, 1, 1)),
    }
    return RigidDofs(model, worlds, counts, starts_of(counts), given=alone if count else None)
