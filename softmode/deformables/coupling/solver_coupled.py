"""Two-way coupling with MuJoCo: predict, solve soft coordinates and joint velocities together, correct.

Lagged or staggered exchange of contact forces chatters or gains energy once contact is stiff or fingers are light; the
joint solve has no lag and nothing to tune. With M_eff = M + dt (D + K_d), the inertia that SolverMuJoCo's implicit
integrator shows to an external force (joint damping D and drive damping K_d are implicit there, drive stiffness not):

1. SolverMuJoCo steps without soft contact: joint velocities v*, and the constraint rows that it found;
2. mass matrix and body Jacobians at the start of the step;
3. one Newton solve over [q of all bodies in the world ; r = dt * joint velocity] with
   1/(2 dt^2) (r - dt v*)^T M_eff (r - dt v*), MuJoCo's constraint rows (rigid contacts, joint limits, equalities,
   friction loss; see ``rigid_row_kernels``) and the contact energies of both;
4. the reaction wrenches join ``state.body_f``;
5. SolverMuJoCo steps again, from the same start.

Where no soft body is near a rigid one that moves, the joint dofs stay out of the solve; where none pushes one, the
prediction is the step: on the CPU the second MuJoCo step is taken only if some world needs it, and a world that does
not need it is left as the prediction has it. On CUDA the soft bodies are predicted and their contacts found beside the
first half of step 1, on a stream of their own: neither needs anything of the other.

MuJoCo's integrator damps after the constraints are solved: it answers forces by (M + dt C)^-1 M (M + J^T D J)^-1. The
solve has (M + dt C + J^T D' J)^-1, D' such that both are the same for one row and a force along it (see
``rigid_row_kernels.damp_rows``). What step 3 neglects: that several rows at once, or a force across them, see other
ratios of M + dt C to M; and contacts that MuJoCo will only detect in the next step.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.coupling import coupling_kernels as kernels
from softmode.deformables.coupling.rigid_solver import Halves, dropping_overflows, mujoco_warnings
from softmode.deformables.model.beside import Beside
from softmode.deformables.model.declare import WRENCH
from softmode.deformables.model.neighbours import warn_foreign_deformables
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.model.tables import allocate, host, present
from softmode.deformables.potential import rigid_row_kernels as rows
from softmode.deformables.solver.detect import differentiate_constraints
from softmode.deformables.solver.observables import REDUCED_KINDS, RIGID_KINDS, CoupledObservables
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.deformables.solver.solver_base import ReducedSolver
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.deformables.solver.step_checks import check_step
from softmode.errors import ConfigError


class SolverCoupledReduced(ReducedSolver):
    """Soft bodies and articulated rigid bodies in one step: :class:`SolverReduced` with ``SolverMuJoCo``.

    MuJoCo keeps its own contacts between rigid shapes, and the solve sees them. A step costs two MuJoCo steps and one
    soft solve, one MuJoCo step less where nothing touches (see the module), reads nothing back and may be captured with
    ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model with reduced bodies and at least one joint.
        bodies: The reduced bodies used in the model.
        options: How the soft step is solved.
        rigid: The MuJoCo solver; default ``SolverMuJoCo(model)``, whose room for contacts is MuJoCo's guess from the
            initial state: where the status is "rigid_overflow", pass ``SolverMuJoCo(model, njmax=..., nconmax=...)``.

    Attributes:
        reduced: The :class:`SolverReduced` inside.
        rigid: The ``SolverMuJoCo`` inside.
    """

    Observables = CoupledObservables
    SUPPORTED_OBSERVABLES = REDUCED_KINDS | RIGID_KINDS

    def __init__(
        self,
        model: newton.Model,
        bodies: Sequence[ReducedBody],
        *,
        options: SolverReducedOptions | None = None,
        rigid: SolverMuJoCo | None = None,
    ) -> None:
        """Build both solvers and tie the joint dofs into the reduced one."""
        if model.joint_dof_count == 0:
            hint = "use SolverReduced, or ModelBuilder.add_body, which gives a rigid body a free joint"
            raise ConfigError("model has no joint dofs to couple with", hint=hint)
        with mujoco_warnings():
            self.rigid = rigid or SolverMuJoCo(model)
        if self.rigid.use_mujoco_cpu:
            raise ConfigError(
                "the rigid solver runs MuJoCo in C, which shows its constraints to no kernel",
                hint="build it with use_mujoco_cpu=False",
            )
        dofs = _joint_dofs(model, row_max=self.rigid.mjw_data.efc.type.shape[1])
        self.reduced = SolverReduced(model, bodies, options=options, rigid=dofs)
        super().__init__(model, self.reduced.tables)
        warn_foreign_deformables(model, self.tables.layout)
        device, count = model.device, model.joint_dof_count
        self.predicted_state = model.state()
        self._halves, self._dropping = Halves(self.rigid), dropping_overflows()
        self._joint_S = wp.zeros(count, dtype=WRENCH, device=device)
        self._body_f = wp.zeros(model.body_count, dtype=WRENCH, device=device)
        self._damping = wp.zeros(count, dtype=float, device=device)
        self._any_coupled, self._any_pushed = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
        self._pushed = wp.zeros(self.world_count, dtype=int, device=device)
        self._beside = (Beside(device, first=False), Beside(device, first=False))
        # the detection of contacts between soft bodies has branches, see ``Beside``
        self._apart = device.is_cuda and self.tables.pairs is None
        self._lay_out_joints()
        self._bind()

    def _lay_out_joints(self) -> None:
        """Find the world of every joint coordinate, the body of every dof, and the free and ball joints of a world."""
        model, device, count = self.model, self.model.device, self.model.joint_count
        world, child = np.maximum(host(model.joint_world)[:count], 0), host(model.joint_child)[:count]
        dofs = np.diff(np.append(host(model.joint_qd_start)[:count], model.joint_dof_count))
        coordinates = np.diff(np.append(host(model.joint_q_start)[:count], model.joint_coord_count))
        kind, articulation = host(model.joint_type)[:count], host(model.joint_articulation)[:count]
        # a joint that closes a loop has no dofs in MuJoCo, where it is an equality
        closes = np.tile(host(self.rigid.mj_qd_start) < 0, self.world_count)[:count]
        if ((articulation < 0) & ~closes & (dofs > 0)).any():
            raise ConfigError(
                "some joints belong to no articulation", hint="call add_articulation for every joint tree"
            )
        self._dof_world, self._coordinate_world, self._dof_body, self._dof_articulation = (
            wp.array(np.repeat(owner, size), dtype=int, device=device)
            for owner, size in ((world, dofs), (world, coordinates), (child, dofs), (articulation, dofs))
        )
        turns = np.isin(kind, (newton.JointType.FREE, newton.JointType.BALL))
        chosen = [np.flatnonzero((world == w) & turns) for w in range(self.world_count)]
        self._turned_joint = np.full((self.world_count, max(len(c) for c in chosen)), -1)
        for w, c in enumerate(chosen):
            self._turned_joint[w, : len(c)] = c
        self._turned_free = kind == newton.JointType.FREE

    def _bind(self) -> None:
        """Point to the arrays of the model and of MuJoCo that the kernels read."""
        model, device, table, data = self.model, self.model.device, self.tables.rigid.table, self.rigid.mjw_data
        given = {name: getattr(model, name) for name in ("joint_child", "body_flags", "body_mass", "body_inertia")}
        given |= {
            "dof_start": table.dof_start,
            "dof_articulation": self._dof_articulation,
            "articulation_dof_start": table.articulation_dof_start,
            "joint_start": model.articulation_start,
            "joint_end": model.articulation_end,
            "dof_body": self._dof_body,
            "armature": model.joint_armature,
            "damping": self._damping,
            "jacobian": table.jacobian,
        }
        self._inertia = allocate(kernels.Inertia, "", {}, device, given=given)
        given = {
            "joint": self._turned_joint,
            "free": self._turned_free,
            "qd_start": model.joint_qd_start,
            "q_start": model.joint_q_start,
            "child": model.joint_child,
            "parent_frame": model.joint_X_p,
            "child_frame": model.joint_X_c,
            "body_com": model.body_com,
        }
        self._turned = allocate(rows.TurnedJoints, "", {}, device, given=given)
        rows_of = ("type", "id", "J", "J_rownnz", "J_rowadr", "J_colind", "D", "aref", "frictionloss")
        given = {name: getattr(data.efc, name) for name in rows_of}
        given |= {
            "count": data.nefc,
            "qacc": data.qacc,
            "dof": self.rigid.mjc_dof_to_newton_dof,
            "contact_friction": data.contact.friction,
            "contact_dim": data.contact.dim,
            "contact_address": data.contact.efc_address,
            "impratio_invsqrt": self.rigid.mjw_model.opt.impratio_invsqrt,
        }
        self._mujoco = allocate(rows.MujocoRows, "", {}, device, given=given)
        # what MuJoCo's step leaves behind for the next: activations go on from the start in both steps, the corrector
        # starts its iteration from the prediction, and a world that keeps the prediction keeps its acceleration too
        self._activation = wp.zeros_like(data.act)
        self._warmstart = wp.zeros_like(data.qacc_warmstart)
        self._data_world = wp.array(np.arange(data.nworld), dtype=int, device=device)

    def observables(
        self, kinds: Iterable[str], *, contacts: newton.Contacts | None = None, requires_grad: bool | None = None
    ) -> CoupledObservables:
        """Allocate arrays for what a step shall report; see ``SolverBase.observables``."""
        container: Any = super().observables(kinds, contacts=contacts, requires_grad=requires_grad)
        container.rigid = self.rigid.observables(container.kinds & RIGID_KINDS, requires_grad=requires_grad)
        for kind in container.rigid.kinds:
            setattr(container, kind, getattr(container.rigid, kind))
        return container

    def step(  # pyright: ignore[reportIncompatibleMethodOverride]  # the observables are those of this solver
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: CoupledObservables | None = None,
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
        wp.copy(self._activation, data.act)
        with self._predicting(state_in, control, dt):
            self.rigid.step(state_in, self.predicted_state, control, contacts, dt, observables=of_rigid)
        wp.copy(self._warmstart, data.qacc_warmstart)

        self._couple(state_in, dt)
        self.reduced.minimise(dt)
        self.reduced.finish(state_out, dt)

        self._find_pushed()
        arguments = {"control": control, "contacts": contacts, "dt": dt, "observables": of_rigid}
        self._branch(self._any_pushed, self._correct, state_in=state_in, state_out=state_out, **arguments)
        self._keep_prediction(state_out)
        self.reduced.report(observables)

    @contextmanager
    def _predicting(self, state: newton.State, control: newton.Control | None, dt: float) -> Generator[None]:
        """Predict the soft bodies and detect their contacts; on CUDA beside the first half of MuJoCo's step, within."""
        predicting, evaluating = self._beside
        with predicting if self._apart else nullcontext():
            self.reduced.begin(state, control, dt)
            self.reduced.detect(state, control, dt, prescribed=False)
        if not self._apart:
            yield
            return
        with evaluating:
            self._evaluate_jacobian(state)

        def join() -> None:
            predicting.join()
            evaluating.join()

        with self._halves.both(between=join):
            yield

    def _evaluate_jacobian(self, state: newton.State) -> None:
        """Evaluate how the bodies move with the joint dofs, at the start of the step."""
        newton.eval_jacobian(self.model, state, self.tables.rigid.table.jacobian, joint_S_s=self._joint_S)

    def _branch(self, condition: wp.array, body: Callable[..., None], **arguments: Any) -> None:
        """Do what is needed only if ``condition`` holds; on CUDA always.

        The branch of a CUDA graph must not allocate, and MuJoCo's step does; with many worlds one needs it anyway.
        """
        if self.model.device.is_cuda:
            body(**arguments)
        else:
            wp.capture_if(condition, body, **arguments)

    def _couple(self, state: newton.State, dt: float) -> None:
        """Let the joint dofs take part where a soft body is near a rigid one, and evaluate their inertia there."""
        t, dofs = self.tables, self.tables.rigid
        self._any_coupled.zero_()
        near = (t.instances, t.newton, t.constraints, dofs.dof_count, self.rigid.mjw_data.overflow, self._dropping)
        t.launch(kernels.find_coupled, self.world_count, *near, dofs.table, self._any_coupled)
        self._branch(self._any_coupled, self._linearise, state=state, dt=dt)

    def _linearise(self, state: newton.State, dt: float) -> None:
        """Evaluate the effective inertia, and Jacobians if they are not yet known, at the start of the step."""
        model, t, dofs = self.model, self.tables, self.tables.rigid
        table, worlds = dofs.table, self.world_count
        if not self._apart:
            self._evaluate_jacobian(state)
        drives = (model.joint_target_mode, model.joint_target_kd, model.joint_damping)
        t.launch(kernels.drive_damping, model.joint_dof_count, *drives, self._damping)
        start = (state.body_q, state.joint_qd, self.predicted_state.joint_qd, wp.float64(dt))
        out = (table.inertia, table.predicted, table.r)
        dim = (worlds, dofs.count_max, dofs.count_max)
        t.launch(kernels.effective_inertia, dim, table.count, self._inertia, *start, *out)
        t.launch(rows.gather_rows, (worlds, dofs.row_max), self._mujoco, self._turned, state.joint_q, table)
        differentiate_constraints(t)
        if dofs.row_max:
            t.launch_teams(rows.damp_rows, worlds, self._damping, wp.float64(dt), t.team, table)

    def _find_pushed(self) -> None:
        """Mark the worlds in which a soft body pushes a rigid one."""
        self._pushed.zero_()
        self._any_pushed.zero_()
        inputs = (self.model.body_world, self.body_wrench, self._pushed, self._any_pushed)
        self.tables.launch(kernels.find_pushed, self.model.body_count, *inputs)

    def _correct(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        observables: SolverBase.Observables | None,
    ) -> None:
        """Let MuJoCo take the step with the soft bodies' wrenches."""
        wp.copy(self.rigid.mjw_data.act, self._activation)
        wp.copy(self._body_f, present(state_in.body_f))
        self.tables.launch(kernels.add_wrench, self.model.body_count, self.body_wrench, state_in.body_f)
        with self._halves.second():
            self.rigid.step(state_in, state_out, control, contacts, dt, observables=observables)
        wp.copy(present(state_in.body_f), self._body_f)

    def _keep_prediction(self, state: newton.State) -> None:
        """Take the prediction in the worlds where no soft body pushes a rigid one."""
        before, model, data = self.predicted_state, self.model, self.rigid.mjw_data
        arrays = [
            (self._coordinate_world, before.joint_q, state.joint_q),
            (self._dof_world, before.joint_qd, state.joint_qd),
            (self._data_world, self._warmstart, data.qacc_warmstart),
        ]
        for name in ("body_q", "body_qd", "body_qdd", "body_parent_f"):
            arrays.append((model.body_world, getattr(before, name, None), getattr(state, name, None)))
        forces = [getattr(getattr(x, "mujoco", None), "qfrc_actuator", None) for x in (before, state)]
        arrays.append((self._dof_world, *forces))
        for world, source, target in arrays:
            if source is None or target is None:
                continue
            rows, width = len(world), source.size * wp.types.type_size_in_bytes(source.dtype) // 4 // len(world)
            flat = [wp.array(ptr=x.ptr, shape=rows * width, dtype=float, device=x.device) for x in (source, target)]
            kept = (self._pushed, world, width, *flat, self.reduced.status)
            self.tables.launch(kernels.keep_prediction, (rows, width), *kept)

    def notify_model_changed(self, flags: int) -> None:
        """Pass the change on to both solvers."""
        self.reduced.notify_model_changed(flags)
        with mujoco_warnings():
            self.rigid.notify_model_changed(flags)
        self._bind()

    def reset(
        self, state: newton.State, world_mask: wp.array | None = None, flags: newton.StateFlags | int | None = None
    ) -> None:
        """Reset soft and rigid bodies of the chosen worlds to the model's initial state.

        Args:
            state: State to reset in place.
            world_mask: Boolean mask of shape (world_count + 1,); None for all worlds.
            flags: As for :meth:`softmode.deformables.solver.solver_reduced.SolverReduced.reset`.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        self.reduced.reset(state, world_mask, flags)
        self.rigid.reset(state, world_mask, flags)
        time = self.rigid.mjw_data.time  # which Newton leaves as it is
        if world_mask is None:
            time.zero_()
        else:
            self.tables.launch(kernels.forget_time, len(time), world_mask, time)
        newton.eval_fk(self.model, present(state.joint_q), present(state.joint_qd), state)


def _joint_dofs(model: newton.Model, row_max: int) -> RigidDofs:
    """Take every joint dof of each world into the solve."""
    worlds, starts = max(model.world_count, 1), host(model.joint_dof_world_start)
    if starts[0] or starts[worlds] != model.joint_dof_count:
        if worlds > 1:
            raise ConfigError("joints outside all worlds cannot be coupled", hint="add them to the replicated builder")
        starts = np.array([0, model.joint_dof_count])
    return RigidDofs(model, worlds, np.diff(starts[: worlds + 1]), starts[:worlds], row_max=row_max)
