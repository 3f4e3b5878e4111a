"""Device side of the coupling: which worlds are coupled, effective inertia of the joints, reactions onto the bodies."""

import newton
import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.status import WORLD_RIGID_NOT_FINITE, WORLD_RIGID_OVERFLOW
from softmode.deformables.model.struct_kernels import Instances, NewtonState, PointConstraints, Rigid, first_coupled

wp.set_module_options({"enable_backward": False})

_DAMPED_MODES = tuple(
    int(mode)
    for mode in (
        newton.JointTargetMode.POSITION,
        newton.JointTargetMode.VELOCITY,
        newton.JointTargetMode.POSITION_VELOCITY,
    )
)


IMMOVABLE = wp.constant(wp.float64(1.0e9))
"""Inertia [kg or kg m^2] of a dof that MuJoCo moves as prescribed."""


@wp.kernel
def find_coupled(
    instances: Instances,
    state: NewtonState,
    constraints: PointConstraints,
    dof_count: wp.array[int],
    overflow: wp.array[int],  # (world_count,), bits of mujoco_warp.OverflowType of the prediction
    dropping: int,  # those with which contacts or constraint rows are dropped
    # Out:
    rigid: Rigid,
    any_out: wp.array[int],  # (1,)
):
    """Let the joint dofs take part where a soft body is near a rigid one that moves; flag what MuJoCo dropped."""
    w = wp.tid()
    if (overflow[w] & dropping) != 0:
        state.status[w] = state.status[w] | WORLD_RIGID_OVERFLOW
    coupled = int(0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        for e in range(first_coupled(instances, i), constraints.count[i]):
            body = constraints.body[i, e]
            if body >= 0:
                if rigid.body_articulation[body] >= 0:
                    coupled = 1
    rigid.count[w] = coupled * dof_count[w]
    if coupled == 0:
        rigid.row_count[w] = 0
        for j in range(rigid.direction.shape[1]):
            rigid.direction[w, j] = wp.float64(0.0)
    else:
        wp.atomic_max(any_out, 0, 1)


@wp.kernel
def find_pushed(
    body_world: wp.array[int],
    wrench: wp.array[wp.spatial_vector],
    # Out, set before to 0:
    pushed_out: wp.array[int],  # (world_count,)
    any_out: wp.array[int],  # (1,)
):
    """Mark the worlds in which a soft body pushes a rigid one."""
    b = wp.tid()
    f = wrench[b]
    if wp.dot(f, f) != 0.0:
        wp.atomic_max(pushed_out, wp.max(body_world[b], 0), 1)
        wp.atomic_max(any_out, 0, 1)


@wp.kernel
def keep_prediction(
    pushed: wp.array[int],  # (world_count,)
    world: wp.array[int],  # of each element
    width: int,
    predicted: wp.array[float],
    # In and out:
    corrected: wp.array[float],
    status: wp.array[int],  # (world_count,)
):
    """Put the prediction back in the worlds that no soft body pushes, ``width`` numbers per element; flag a NaN."""
    e, c = wp.tid()
    w = wp.max(world[e], 0)
    if pushed[w] == 0:
        corrected[width * e + c] = predicted[width * e + c]
    if not wp.isfinite(corrected[width * e + c]):
        wp.atomic_or(status, w, WORLD_RIGID_NOT_FINITE)


@wp.kernel
def forget_time(mask: wp.array[wp.bool], time_out: wp.array[float]):
    """Let the clock of the masked worlds begin anew, (world_count,) [s]."""
    if mask[wp.tid()]:
        time_out[wp.tid()] = 0.0


@struct
class Inertia:
    """What the mass matrix of the articulations is made of."""

    dof_start: wp.array[int]  # (world_count,), first joint dof of a world
    dof_articulation: wp.array[int]  # (joint_dof_count,), -1 for a joint that closes a loop
    articulation_dof_start: wp.array[int]
    joint_start: wp.array[int]  # (articulation_count,)
    joint_end: wp.array[int]
    joint_child: wp.array[int]
    dof_body: wp.array[int]  # (joint_dof_count,), the body that a dof moves
    body_flags: wp.array[int]
    body_mass: wp.array[float]  # [kg]
    body_inertia: wp.array[wp.mat33]  # about the centre of mass, in the body's frame [kg m^2]
    armature: wp.array[float]  # (joint_dof_count,)
    damping: wp.array[float]  # (joint_dof_count,), D + K_d
    jacobian: wp.array3d[float]  # (articulation_count, 6 link_max, dof_max), twists of centres of mass, world frame


@wp.func
def mass_entry(inertia: Inertia, body_q: wp.array[wp.transform], a: int, j: int, l: int):
    """Return entry (j, l) of the mass matrix of an articulation, sum over its links of v_j m v_l + w_j I w_l."""
    J = inertia.jacobian
    total = float(0.0)
    for joint in range(inertia.joint_start[a], inertia.joint_end[a]):
        row = 6 * (joint - inertia.joint_start[a])
        body = inertia.joint_child[joint]
        v = wp.vec3(J[a, row, j], J[a, row + 1, j], J[a, row + 2, j])
        turn = wp.vec3(J[a, row + 3, j], J[a, row + 4, j], J[a, row + 5, j])
        v_other = wp.vec3(J[a, row, l], J[a, row + 1, l], J[a, row + 2, l])
        turn_other = wp.vec3(J[a, row + 3, l], J[a, row + 4, l], J[a, row + 5, l])
        frame = wp.transform_get_rotation(body_q[body])
        turn = wp.quat_rotate_inv(frame, turn)
        turn_other = wp.quat_rotate_inv(frame, turn_other)
        total += inertia.body_mass[body] * wp.dot(v, v_other)
        total += wp.dot(turn, inertia.body_inertia[body] * turn_other)
    return total


@wp.kernel
def effective_inertia(
    count: wp.array[int],  # (world_count,)
    inertia: Inertia,
    body_q: wp.array[wp.transform],
    joint_qd_start: wp.array[float],
    joint_qd_predicted: wp.array[float],
    dt: wp.float64,
    # Out:
    inertia_out: wp.array3d[wp.float64],  # (world_count, rigid_max, rigid_max), M_eff / dt^2
    predicted_out: wp.array2d[wp.float64],  # (world_count, rigid_max), dt v*
    r_out: wp.array2d[wp.float64],
):
    """Lay the mass matrices of the articulations of a world on the diagonal, with implicit damping."""
    w, j, l = wp.tid()
    if j >= count[w] or l > j:
        return
    dof = inertia.dof_start[w] + j
    other = inertia.dof_start[w] + l
    a = inertia.dof_articulation[dof]
    value = wp.float64(0.0)
    if a >= 0 and inertia.dof_articulation[other] == a:
        first = inertia.articulation_dof_start[a]
        value = wp.float64(mass_entry(inertia, body_q, a, dof - first, other - first))
    if l == j:
        value += wp.float64(inertia.armature[dof]) + dt * wp.float64(inertia.damping[dof])
        if a < 0 or inertia.body_flags[inertia.dof_body[dof]] & wp.static(int(newton.BodyFlags.KINEMATIC)) != 0:
            value += IMMOVABLE
        predicted_out[w, j] = dt * wp.float64(joint_qd_predicted[dof])
        # Newton starts from the motion that goes on, as it does for q: in a grasp the contact-free prediction would
        # press the fingers far into the object
        r_out[w, j] = dt * wp.float64(joint_qd_start[dof])
    inertia_out[w, j, l] = value / (dt * dt)
    inertia_out[w, l, j] = value / (dt * dt)


@wp.kernel
def add_wrench(
    wrench: wp.array[wp.spatial_vector],
    # In and out:
    body_f: wp.array[wp.spatial_vector],
):
    """Add the contact reactions to the external body forces."""
    b = wp.tid()
    body_f[b] = body_f[b] + wrench[b]


@wp.kernel
def drive_damping(
    mode: wp.array[int],
    drive: wp.array[float],
    passive: wp.array[float],
    # Out:
    damping_out: wp.array[float],
):
    """Add the velocity gain of an active drive to the passive damping of a dof."""
    d = wp.tid()
    value = passive[d]
    if (
        mode[d] == wp.static(_DAMPED_MODES[0])
        or mode[d] == wp.static(_DAMPED_MODES[1])
        or mode[d] == wp.static(_DAMPED_MODES[2])
    ):
        value += drive[d]
    damping_out[d] = value
