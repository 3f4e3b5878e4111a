"""Device side of the coupling: effective inertia of the joints, reactions onto the bodies."""

import newton
import warp as wp

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
def effective_inertia(
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
