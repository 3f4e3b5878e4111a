"""Two-way coupling with MuJoCo: predict, solve soft coordinates and joint velocities together, correct.

Lagged or staggered exchange of contact forces chatters or gains energy once contact is stiff or fingers are light; the
joint solve has no lag and nothing to tune. With M_eff = M + dt (D + K_d), the inertia that SolverMuJoCo's implicit
integrator shows to an external force (joint damping D and drive damping K_d are implicit there, drive stiffness not):

1. SolverMuJoCo steps without soft contact: joint velocities v*;
2. mass matrix and body Jacobians at the start of the step;
3. one Newton solve over [q of all bodies in the world ; r = dt * joint velocity] with
   1/(2 dt^2) (r - dt v*)^T M_eff (r - dt v*) and the contact energies of both;
4. the reaction wrenches join ``state.body_f``;
5. SolverMuJoCo steps again, from the same start.
"""

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo

from softmode.deformables import coupling_kernels as kernels
from softmode.deformables.authoring import register_custom_attributes
from softmode.deformables.body import ReducedBody
from softmode.deformables.rigid_dofs import RigidDofs
from softmode.deformables.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.errors import ConfigError


class SolverCoupledReduced(SolverBase):
    """Soft bodies and articulated rigid bodies in one step: :class:`SolverReduced` with ``SolverMuJoCo``.

    MuJoCo keeps its own contacts between rigid shapes. A step costs two MuJoCo steps and one soft solve, reads nothing
    back and may be captured with ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model with reduced bodies and at least one joint.
        bodies: The reduced bodies used in the model.
        options: How the soft step is solved.
        rigid: The MuJoCo solver; default ``SolverMuJoCo(model)``.
    """

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
        self.reduced.attach_rigid(self._rigid_dofs())
        self.predicted_state = model.state()
        device = model.device
        articulations, dofs = model.articulation_count, model.max_dofs_per_articulation
        self.mass_matrix = wp.zeros((articulations, dofs, dofs), dtype=float, device=device)
        self.joint_S = wp.zeros(model.joint_dof_count, dtype=vector, device=device)
        self.body_I = wp.zeros(model.body_count, dtype=wp.spatial_matrix, device=device)
        self.body_f = wp.zeros(model.body_count, dtype=vector, device=device)
        self.damping = wp.zeros(model.joint_dof_count, dtype=float, device=device)
        counts: Any = self.reduced.rigid.articulation_dof_count.numpy()
        owner = np.repeat(np.arange(articulations), counts)
        if len(owner) != model.joint_dof_count:
            raise ConfigError(
                "some joints belong to no articulation", hint="call add_articulation for every joint tree"
            )
        self.dof_articulation = wp.array(owner, dtype=int, device=device)

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
        return RigidDofs(model, worlds, np.diff(starts[: worlds + 1]), starts[:worlds])

    @property
    def body_wrench(self) -> wp.array:
        """Soft contact wrench on every rigid body about its centre of mass [N, N m], shape (body_count,)."""
        return self.reduced.body_wrench

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
        """Advance soft and rigid bodies by ``dt`` [s]."""
        self.validate_observables(observables, contacts)
        self.rigid.step(state_in, self.predicted_state, control, contacts, dt)
        self._linearise(state_in, dt)

        self.reduced.begin(state_in, control, dt)
        self.reduced.detect(state_in, control, dt, prescribed=False)
        self.reduced.minimise(dt)
        self.reduced.finish(state_out, dt)

        body_f: Any = state_in.body_f
        wp.copy(self.body_f, body_f)
        count = self.model.body_count
        wp.launch(kernels.add_wrench, dim=count, inputs=[self.body_wrench, state_in.body_f], device=self.model.device)
        self.rigid.step(state_in, state_out, control, contacts, dt, observables=observables)
        wp.copy(body_f, self.body_f)

    def _linearise(self, state: newton.State, dt: float) -> None:
        """Evaluate Jacobians and the effective inertia at the start of the step."""
        model, dofs = self.model, self.reduced.rigid
        newton.eval_jacobian(model, state, dofs.jacobian, joint_S_s=self.joint_S)
        newton.eval_mass_matrix(
            model, state, self.mass_matrix, J=dofs.jacobian, body_I_s=self.body_I, joint_S_s=self.joint_S
        )
        wp.launch(
            kernels.drive_damping,
            dim=model.joint_dof_count,
            inputs=[model.joint_target_mode, model.joint_target_kd, model.joint_damping],
            outputs=[self.damping],
            device=model.device,
        )
        wp.launch(
            kernels.effective_inertia,
            dim=(self.reduced.world_count, dofs.count_max),
            inputs=[
                dofs.count,
                dofs.dof_start,
                self.dof_articulation,
                dofs.articulation_dof_start,
                self.damping,
                self.mass_matrix,
                state.joint_qd,
                self.predicted_state.joint_qd,
                wp.float64(dt),
            ],
            outputs=[dofs.inertia, dofs.predicted, dofs.r],
            device=model.device,
        )

    def notify_model_changed(self, flags: int) -> None:
        """Pass the change on to both solvers."""
        self.reduced.notify_model_changed(flags)
        self.rigid.notify_model_changed(flags)

    def reset(self, state: newton.State, world_mask: wp.array | None = None, flags: Any = None) -> None:
        """Reset soft and rigid bodies of the chosen worlds to the model's initial state."""
        self.rigid.reset(state, world_mask, flags)
        coordinates: Any = state.joint_q
        velocities: Any = state.joint_qd
        newton.eval_fk(self.model, coordinates, velocities, state)
        self.reduced.reset(state, world_mask, flags)
