"""Two-way coupling with MuJoCo: predict, solve soft coordinates and joint velocities together, correct.

Lagged or staggered exchange of contact forces chatters or gains energy once contact is stiff or fingers are light; the
joint solve has no lag and nothing to tune. With M_eff = M + dt (D + K_d), the inertia that SolverMuJoCo's implicit
integrator shows to an external force (joint damping D and drive damping K_d are implicit there, drive stiffness is not):

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

from softmode.deformables.body import ReducedBody
from softmode.deformables.solver_reduced import (
    RigidDofs,
    SolverReduced,
    SolverReducedOptions,
    register_custom_attributes,
)
from softmode.errors import ConfigError

wp.set_module_options({"enable_backward": False})

_DAMPED_MODES = tuple(
    int(mode)
    for mode in (
        newton.JointTargetMode.POSITION,
        newton.JointTargetMode.VELOCITY,
        newton.JointTargetMode.POSITION_VELOCITY,
    )
)


@wp.kernel
def _effective_inertia(
    # Worlds:
    count: wp.array[int],
    dof_start: wp.array[int],
    # Joint dofs:
    dof_articulation: wp.array[int],  # (joint_dof_count,)
    articulation_dof_start: wp.array[int],
    damping: wp.array[float],  # (joint_dof_count,), D + K_d
    mass_matrix: wp.array3d[float],  # (articulation_count, dof_max, dof_max)
    joint_qd_start: wp.array[float],
    joint_qd_predicted: wp.array[float],
    dt: wp.float64,
    # Out:
    inertia_out: wp.array3d[wp.float64],  # (world_count, rigid_max, rigid_max), M_eff / dt^2
    predicted_out: wp.array2d[wp.float64],  # (world_count, rigid_max), dt v*
    r_out: wp.array2d[wp.float64],
):
    """Lay the mass matrices of the articulations of a world on the diagonal, with implicit damping."""
    w, j = wp.tid()
    if j >= count[w]:
        return
    dof = dof_start[w] + j
    a = dof_articulation[dof]
    first = articulation_dof_start[a]
    for l in range(count[w]):
        other = dof_start[w] + l
        value = wp.float64(0.0)
        if dof_articulation[other] == a:
            value = wp.float64(mass_matrix[a, dof - first, other - first])
        if l == j:
            value += dt * wp.float64(damping[dof])
        inertia_out[w, j, l] = value / (dt * dt)
    predicted_out[w, j] = dt * wp.float64(joint_qd_predicted[dof])
    # Newton starts from the motion that goes on, as it does for q: in a grasp the contact-free prediction would press
    # the fingers far into the object
    r_out[w, j] = dt * wp.float64(joint_qd_start[dof])


@wp.kernel
def _add_wrench(
    wrench: wp.array[wp.spatial_vector],
    # In and out:
    body_f: wp.array[wp.spatial_vector],
):
    """Add the contact reactions to the external body forces."""
    b = wp.tid()
    body_f[b] = body_f[b] + wrench[b]


@wp.kernel
def _drive_damping(
    mode: wp.array[int],
    drive: wp.array[float],
    passive: wp.array[float],
    # Out:
    damping_out: wp.array[float],
):
    """Add the velocity gain of an active drive to the passive damping of a dof."""
    d = wp.tid()
    value = passive[d]
    if mode[d] == wp.static(_DAMPED_MODES[0]) or mode[d] == wp.static(_DAMPED_MODES[1]) or mode[d] == wp.static(_DAMPED_MODES[2]):
        value += drive[d]
    damping_out[d] = value


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

    register_custom_attributes = staticmethod(register_custom_attributes)

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
        if model.joint_dof_count == 0:
            raise ConfigError("model has no joint dofs to couple with", hint="use SolverReduced")
        self.reduced = SolverReduced(model, bodies, options=options)
        self.rigid = rigid or SolverMuJoCo(model)
        self.reduced.attach_rigid(self._rigid_dofs())
        self.predicted_state = model.state()
        device = model.device
        articulations, dofs = model.articulation_count, model.max_dofs_per_articulation
        self.mass_matrix = wp.zeros((articulations, dofs, dofs), dtype=float, device=device)
        self.joint_S = wp.zeros(model.joint_dof_count, dtype=wp.spatial_vector, device=device)
        self.body_I = wp.zeros(model.body_count, dtype=wp.spatial_matrix, device=device)
        self.body_f = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=device)
        self.damping = wp.zeros(model.joint_dof_count, dtype=float, device=device)
        owner = np.repeat(np.arange(articulations), self.reduced.rigid.articulation_dof_count.numpy())
        if len(owner) != model.joint_dof_count:
            raise ConfigError("some joints belong to no articulation", hint="call add_articulation for every joint tree")
        self.dof_articulation = wp.array(owner, dtype=int, device=device)

    def _rigid_dofs(self) -> RigidDofs:
        """Take every joint dof of each world into the solve."""
        model, worlds = self.model, self.reduced.world_count
        starts = model.joint_dof_world_start.numpy()
        if starts[0] or starts[worlds] != model.joint_dof_count:
            if worlds > 1:
                raise ConfigError("joints outside all worlds cannot be coupled", hint="add them to the replicated builder")
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

        self.reduced.begin(state_in, dt)
        self.reduced.detect(state_in, control, dt, prescribed=False)
        self.reduced.minimise(dt)
        self.reduced.finish(state_out, dt)

        wp.copy(self.body_f, state_in.body_f)
        count = self.model.body_count
        wp.launch(_add_wrench, dim=count, inputs=[self.body_wrench, state_in.body_f], device=self.model.device)
        self.rigid.step(state_in, state_out, control, contacts, dt, observables=observables)
        wp.copy(state_in.body_f, self.body_f)

    def _linearise(self, state: newton.State, dt: float) -> None:
        """Evaluate Jacobians and the effective inertia at the start of the step."""
        model, dofs = self.model, self.reduced.rigid
        newton.eval_jacobian(model, state, dofs.jacobian, joint_S_s=self.joint_S)
        newton.eval_mass_matrix(
            model, state, self.mass_matrix, J=dofs.jacobian, body_I_s=self.body_I, joint_S_s=self.joint_S
        )
        wp.launch(
            _drive_damping,
            dim=model.joint_dof_count,
            inputs=[model.joint_target_mode, model.joint_target_kd, model.joint_damping],
            outputs=[self.damping],
            device=model.device,
        )
        wp.launch(
            _effective_inertia,
            dim=(self.reduced.world_count, dofs.count_max),
            inputs=[dofs.count, dofs.dof_start, self.dof_articulation, dofs.articulation_dof_start, self.damping]
            + [self.mass_matrix, state.joint_qd, self.predicted_state.joint_qd, wp.float64(dt)],
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
        newton.eval_fk(self.model, state.joint_q, state.joint_qd, state)
        self.reduced.reset(state, world_mask, flags)
