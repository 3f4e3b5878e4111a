"""Two-way coupling with MuJoCo: predict, solve soft coordinates and joint velocities together, correct.

Lagged or staggered exchange of contact forces chatters or gains energy once contact is stiff or fingers are light; the
joint solve has no lag and nothing to tune. With M_eff = M + dt (D + K_d), the inertia that SolverMuJoCo's implicit
integrator shows to an external force (joint damping D and drive damping K_d are implicit there, drive stiffness not):

1. SolverMuJoCo steps without soft contact: joint velocities v*, and the constraint rows that it found;
2. mass matrix and body Jacobians at the start of the step;
3. one Newton solve over [q of all bodies in the world ; r = dt * joint velocity] with
   1/(2 dt^2) (r - dt v*)^T M_eff (r - dt v*), MuJoCo's constraint rows (rigid contacts, joint limits, equalities,
   friction loss; see ``constraint_kernels``) and the contact energies of both;
4. the reaction wrenches join ``state.body_f``;
5. SolverMuJoCo steps again, from the same start.

Where no soft body is near a rigid one that moves, the joint dofs stay out of the solve; where none pushes one, the
prediction is the step: on the CPU the second MuJoCo step is taken only if some world needs it, and a world that does
not need it is left as the prediction has it.

What step 3 neglects of MuJoCo's answer to the forces: the implicit integrator damps after the constraints are solved,
(M + dt C)^-1 M (M + J^T D J)^-1 instead of (M + dt C + J^T D J)^-1, which differ by the cross term dt J^T D J M^-1 C on
dofs that are both damped and constrained; and contacts that MuJoCo will only detect in the next step.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.coupling import coupling_kernels as kernels
from softmode.deformables.model.authoring import register_custom_attributes
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.solver import rigid_row_kernels as constraints
from softmode.deformables.solver.attachments import Attachment
from softmode.deformables.solver.observables import (
    REDUCED_KINDS,
    RIGID_KINDS,
    CoupledObservables,
    ReducedObservableKind,
)
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.deformables.solver.step_checks import check_step
from softmode.errors import ConfigError


class SolverCoupledReduced(SolverBase):
    """Soft bodies and articulated rigid bodies in one step: :class:`SolverReduced` with ``SolverMuJoCo``.

    MuJoCo keeps its own contacts between rigid shapes, and the solve sees them. A step costs two MuJoCo steps and one
    soft solve, one MuJoCo step less where nothing touches (see the module), reads nothing back and may be captured with
    ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model with reduced bodies and at least one joint.
        bodies: The reduced bodies used in the model.
        options: How the soft step is solved.
        rigid: The MuJoCo solver; default ``SolverMuJoCo(model)``, whose room for contacts is MuJoCo's guess from the
            initial state: if it prints "nefc overflow", pass ``SolverMuJoCo(model, njmax=..., nconmax=...)``.

    Attributes:
        reduced: The :class:`SolverReduced` inside.
        rigid: The ``SolverMuJoCo`` inside.
    """

    ObservableKind = ReducedObservableKind
    Observables = CoupledObservables
    SUPPORTED_OBSERVABLES = REDUCED_KINDS | RIGID_KINDS

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """Declare the attributes of reduced bodies on a builder."""
        register_custom_attributes(builder)

    def __init__(
        self,
        model: newton.Model,
        bodies: Sequence[ReducedBody],
        *,
        options: SolverReducedOptions | None = None,
        rigid: SolverMuJoCo | None = None,
    ) -> None:
        """Build both solvers and tie the joint dofs into the reduced one."""
        super().__init__(model)
        self.model: Any = model
        vector: Any = wp.spatial_vector
        if model.joint_dof_count == 0:
            raise ConfigError("model has no joint dofs to couple with", hint="use SolverReduced")
        self.reduced = SolverReduced(model, bodies, options=options)
        self.rigid = rigid or SolverMuJoCo(model)
        if self.rigid.use_mujoco_cpu:
            raise ConfigError(
                "the rigid solver runs MuJoCo in C, which shows its constraints to no kernel",
                hint="build it with use_mujoco_cpu=False",
            )
        self.reduced.attach_rigid(self._rigid_dofs())
        self.predicted_state = model.state()
        device, worlds = model.device, self.reduced.world_count
        self.joint_S = wp.zeros(model.joint_dof_count, dtype=vector, device=device)
        self.body_f = wp.zeros(model.body_count, dtype=vector, device=device)
        self.damping = wp.zeros(model.joint_dof_count, dtype=float, device=device)
        self.any_coupled = wp.zeros(1, dtype=int, device=device)
        self.pushed, self.any_pushed = (wp.zeros(n, dtype=int, device=device) for n in (worlds, 1))
        self._lay_out_joints()
        self._bind()

    def _rigid_dofs(self) -> RigidDofs:
        """Take every joint dof of each world into the solve."""
        model, worlds = self.model, self.reduced.world_count
        starts = model.joint_dof_world_start.numpy()
        if starts[0] or starts[worlds] != model.joint_dof_count:
            if worlds > 1:
                raise ConfigError(
                    "joints outside all worlds cannot be coupled", hint="add them to the replicated builder"
                )
            starts = np.array([0, model.joint_dof_count])
        rows = self.rigid.mjw_data.efc.type.shape[1]
        return RigidDofs(model, worlds, np.diff(starts[: worlds + 1]), starts[:worlds], row_max=rows)

    def _lay_out_joints(self) -> None:
        """Find the world of every joint coordinate, the body of every dof, and the free and ball joints of a world."""
        model, device = self.model, self.model.device
        count, worlds = model.joint_count, self.reduced.world_count
        world = np.maximum(model.joint_world.numpy()[:count], 0)
        dofs: Any = np.diff(np.append(model.joint_qd_start.numpy()[:count], model.joint_dof_count))
        coordinates: Any = np.diff(np.append(model.joint_q_start.numpy()[:count], model.joint_coord_count))
        self.dof_world, self.coordinate_world, self.dof_body = (
            wp.array(np.repeat(owner, size), dtype=int, device=device)
            for owner, size in ((world, dofs), (world, coordinates), (model.joint_child.numpy()[:count], dofs))
        )
        kind = model.joint_type.numpy()[:count]
        chosen = [
            np.flatnonzero((world == w) & np.isin(kind, (newton.JointType.FREE, newton.JointType.BALL)))
            for w in range(worlds)
        ]
        joint = np.full((worlds, max(len(c) for c in chosen)), -1)
        for w, c in enumerate(chosen):
            joint[w, : len(c)] = c
        # a joint that closes a loop has no dofs in MuJoCo, where it is an equality
        closes = np.tile(self.rigid.mj_qd_start.numpy() < 0, worlds)[:count]
        articulation = model.joint_articulation.numpy()[:count]
        if ((articulation < 0) & ~closes & (dofs > 0)).any():
            raise ConfigError(
                "some joints belong to no articulation", hint="call add_articulation for every joint tree"
            )
        self.dof_articulation = wp.array(np.repeat(articulation, dofs), dtype=int, device=device)
        self.turned = constraints.TurnedJoints()
        self.turned.joint = wp.array(joint, dtype=int, device=device)
        self.turned.free = wp.array(kind == newton.JointType.FREE, dtype=int, device=device)

    def _bind(self) -> None:
        """Point to the arrays of the model and of MuJoCo that the kernels read."""
        model, dofs = self.model, self.reduced.rigid
        self.inertia: Any = kernels.Inertia()
        for name, source in (
            ("dof_start", dofs.dof_start),
            ("dof_articulation", self.dof_articulation),
            ("articulation_dof_start", dofs.articulation_dof_start),
            ("joint_start", model.articulation_start),
            ("joint_end", model.articulation_end),
            ("joint_child", model.joint_child),
            ("dof_body", self.dof_body),
            ("body_flags", model.body_flags),
            ("body_mass", model.body_mass),
            ("body_inertia", model.body_inertia),
            ("armature", model.joint_armature),
            ("damping", self.damping),
            ("jacobian", dofs.jacobian),
        ):
            setattr(self.inertia, name, source)
        model, turned, data, mujoco = self.model, self.turned, self.rigid.mjw_data, constraints.MujocoRows()
        turned.qd_start, turned.q_start, turned.child = model.joint_qd_start, model.joint_q_start, model.joint_child
        turned.parent_frame, turned.child_frame, turned.body_com = model.joint_X_p, model.joint_X_c, model.body_com
        mujoco.count, mujoco.qacc, mujoco.dof = data.nefc, data.qacc, self.rigid.mjc_dof_to_newton_dof
        for name in ("type", "id", "J", "J_rownnz", "J_rowadr", "J_colind", "D", "aref", "frictionloss"):
            setattr(mujoco, name, getattr(data.efc, name))
        mujoco.contact_friction, mujoco.contact_dim = data.contact.friction, data.contact.dim
        mujoco.contact_address = data.contact.efc_address
        mujoco.impratio_invsqrt = self.rigid.mjw_model.opt.impratio_invsqrt
        self.mujoco = mujoco
        # what MuJoCo's step leaves behind for the next: activations go on from the start in both steps, the corrector
        # starts its iteration from the prediction, and a world that keeps the prediction keeps its acceleration too
        self.activation = wp.zeros_like(data.act)
        self.warmstart = wp.zeros_like(data.qacc_warmstart)
        self.data_world = wp.array(np.arange(data.nworld), dtype=int, device=model.device)

    @property
    def body_wrench(self) -> wp.array:
        """Soft contact wrench on every rigid body about its centre of mass [N, N m], shape (body_count,)."""
        return self.reduced.body_wrench

    @property
    def status(self) -> wp.array:
        """Status bits per world, as :attr:`SolverReduced.status`; MuJoCo's own overflows are not among them."""
        return self.reduced.status

    @property
    def iteration(self) -> wp.array:
        """Newton iterations of the last step per world."""
        return self.reduced.iteration

    def release(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Let go of an attachment in the masked worlds; see :meth:`SolverReduced.release`."""
        self.reduced.release(attachment, world_mask)

    def hold(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Take a released attachment up again; see :meth:`SolverReduced.hold`."""
        self.reduced.hold(attachment, world_mask)

    def observables(
        self, kinds: Iterable[str], *, contacts: newton.Contacts | None = None, requires_grad: bool | None = None
    ) -> CoupledObservables:
        """Allocate arrays for what a step shall report; see ``SolverBase.observables``."""
        container: Any = super().observables(kinds, contacts=contacts, requires_grad=requires_grad)
        container.rigid = self.rigid.observables(container.kinds & RIGID_KINDS, requires_grad=requires_grad)
        for kind in container.rigid.kinds:
            setattr(container, kind, getattr(container.rigid, kind))
        return container

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Advance soft and rigid bodies by ``dt`` [s].

        Without ``control`` drives, driven regions and pins aim where the model has them.

        Raises:
            ConfigError: If ``dt`` is not finite and positive, or a state or the control belongs to another model.
        """
        self.validate_observables(observables, contacts)
        check_step(self.model, state_in, state_out, control, dt)
        of_rigid = None if observables is None else observables.rigid
        data = self.rigid.mjw_data
        wp.copy(self.activation, data.act)
        self.rigid.step(state_in, self.predicted_state, control, contacts, dt, observables=of_rigid)
        wp.copy(self.warmstart, data.qacc_warmstart)

        self.reduced.begin(state_in, control, dt)
        self.reduced.detect(state_in, control, dt, prescribed=False)
        self._find_coupled()
        self._branch(self.any_coupled, self._linearise, state=state_in, dt=dt)
        self.reduced.minimise(dt)
        self.reduced.finish(state_out, dt)

        self._find_pushed()
        arguments = {"control": control, "contacts": contacts, "dt": dt, "observables": of_rigid}
        self._branch(self.any_pushed, self._correct, state_in=state_in, state_out=state_out, **arguments)
        self._keep_prediction(state_out)
        self.reduced.report(observables)

    def _branch(self, condition: wp.array, body: Callable[..., None], **arguments: Any) -> None:
        """Do what is needed only if ``condition`` holds; on CUDA always.

        The branch of a CUDA graph must not allocate, and MuJoCo's step does; with many worlds one needs it anyway.
        """
        if self.model.device.is_cuda:
            body(**arguments)
        else:
            wp.capture_if(condition, body, **arguments)

    def _find_coupled(self) -> None:
        """Let the joint dofs take part where a soft body is near a rigid one."""
        reduced, dofs = self.reduced, self.reduced.rigid
        self.any_coupled.zero_()
        tables = [reduced.instances, reduced.progress, reduced.entries, dofs.dof_count]
        self._launch(kernels.find_coupled, reduced.world_count, tables, [dofs.table, self.any_coupled])

    def _find_pushed(self) -> None:
        """Mark the worlds in which a soft body pushes a rigid one."""
        self.pushed.zero_()
        self.any_pushed.zero_()
        inputs = [self.model.body_world, self.body_wrench]
        self._launch(kernels.find_pushed, self.model.body_count, inputs, [self.pushed, self.any_pushed])

    def _correct(self, state_in: Any, state_out: Any, control: Any, contacts: Any, dt: float, observables: Any) -> None:
        """Let MuJoCo take the step with the soft bodies' wrenches."""
        wp.copy(self.rigid.mjw_data.act, self.activation)
        wp.copy(self.body_f, state_in.body_f)
        self._launch(kernels.add_wrench, self.model.body_count, [self.body_wrench, state_in.body_f])
        with self._from_forces_on():
            self.rigid.step(state_in, state_out, control, contacts, dt, observables=observables)
        wp.copy(state_in.body_f, self.body_f)

    @contextmanager
    def _from_forces_on(self) -> Generator[None]:
        """Let MuJoCo step from its forces on: positions, inertia and constraint rows are those of the prediction.

        MuJoCo's own split of a step; the whole one where that is another step.
        """
        import mujoco_warp

        rigid: Any = self.rigid
        model, known = rigid.mjw_model, mujoco_warp.IntegratorType
        sleeps = bool(model.opt.enableflags & mujoco_warp.EnableBit.SLEEP)
        in_halves = model.opt.integrator in (known.EULER, known.IMPLICIT, known.IMPLICITFAST)
        whole = sleeps or not in_halves or rigid._use_speculative_contacts
        if not whole:
            rigid._mujoco_warp_step = lambda: mujoco_warp.step2(model, rigid.mjw_data)
        try:
            yield
        finally:
            if not whole:
                del rigid._mujoco_warp_step

    def _keep_prediction(self, state: Any) -> None:
        """Take the prediction in the worlds where no soft body pushes a rigid one."""
        before, model, data = self.predicted_state, self.model, self.rigid.mjw_data
        arrays = [
            (self.coordinate_world, before.joint_q, state.joint_q),
            (self.dof_world, before.joint_qd, state.joint_qd),
            (self.data_world, self.warmstart, data.qacc_warmstart),
        ]
        for name in ("body_q", "body_qd", "body_qdd", "body_parent_f"):
            arrays.append((model.body_world, getattr(before, name, None), getattr(state, name, None)))
        forces = [getattr(getattr(x, "mujoco", None), "qfrc_actuator", None) for x in (before, state)]
        arrays.append((self.dof_world, *forces))
        for world, source, target in arrays:
            if source is None or target is None:
                continue
            rows, width = len(world), source.size * wp.types.type_size_in_bytes(source.dtype) // 4 // len(world)
            flat = [wp.array(ptr=x.ptr, shape=rows * width, dtype=float, device=x.device) for x in (source, target)]
            self._launch(kernels.keep_prediction, (rows, width), [self.pushed, world, width, flat[0]], [flat[1]])

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch on the model's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=list(outputs), device=self.model.device)

    def _linearise(self, state: newton.State, dt: float) -> None:
        """Evaluate Jacobians and the effective inertia at the start of the step."""
        model, dofs = self.model, self.reduced.rigid
        newton.eval_jacobian(model, state, dofs.jacobian, joint_S_s=self.joint_S)
        drives = [model.joint_target_mode, model.joint_target_kd, model.joint_damping]
        self._launch(kernels.drive_damping, model.joint_dof_count, drives, [self.damping])
        self._launch(
            kernels.effective_inertia,
            (self.reduced.world_count, dofs.count_max, dofs.count_max),
            [dofs.count, self.inertia, state.body_q, state.joint_qd, self.predicted_state.joint_qd, wp.float64(dt)],
            [dofs.inertia, dofs.predicted, dofs.r],
        )
        rows = [self.mujoco, self.turned, state.joint_q]
        self._launch(constraints.gather_rows, (self.reduced.world_count, dofs.row_max), rows, [dofs.table])
        self.reduced.bound_pivots()
        self.reduced.differentiate_entries()

    def notify_model_changed(self, flags: int) -> None:
        """Pass the change on to both solvers."""
        self.reduced.notify_model_changed(flags)
        self.rigid.notify_model_changed(flags)
        self._bind()

    def reset(self, state: newton.State, world_mask: wp.array | None = None, flags: Any = None) -> None:
        """Reset soft and rigid bodies of the chosen worlds to the model's initial state; see `SolverReduced.reset`."""
        self.reduced.reset(state, world_mask, flags)
        self.rigid.reset(state, world_mask, flags)
        coordinates: Any = state.joint_q
        velocities: Any = state.joint_qd
        newton.eval_fk(self.model, coordinates, velocities, state)
