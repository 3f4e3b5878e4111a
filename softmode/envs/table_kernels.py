"""Device side of the table scene: placing objects, observing objects and fingers."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def place_objects(
    # Instances:
    function_start: wp.array[int],
    world: wp.array[int],
    # Asset:
    linear_coordinates: wp.array2d[wp.float64],  # (function_count, 4)
    # Reset:
    world_mask: wp.array[wp.bool],
    position: wp.array[wp.vec3d],  # (world_count,) [m]
    yaw: wp.array[wp.float64],  # (world_count,) [rad]
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
):
    """Set q to the rigid placement x = R(yaw) X + position, at rest."""
    i, k = wp.tid()
    w = world[i]
    if not world_mask[w]:
        return
    c = wp.cos(yaw[w]) - wp.float64(1.0)
    s = wp.sin(yaw[w])
    x = linear_coordinates[k, 0]
    y = linear_coordinates[k, 1]
    q_out[function_start[i] + k] = wp.vec3d(c * x - s * y, s * x + c * y, wp.float64(0.0)) + (
        linear_coordinates[k, 3] * position[w]
    )
    qd_out[function_start[i] + k] = wp.vec3d()


@wp.kernel
def observe_objects(
    # Instances:
    function_start: wp.array[int],
    mean_basis: wp.array[wp.float64],
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    # Out:
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
):
    """Compute position and velocity of the centre of mass: sum_k mean(b_k) q_k."""
    i = wp.tid()
    x = wp.vec3d()
    v = wp.vec3d()
    for k in range(mean_basis.shape[0]):
        x += mean_basis[k] * q[function_start[i] + k]
        v += mean_basis[k] * qd[function_start[i] + k]
    position_out[i] = wp.vec3(x)
    velocity_out[i] = wp.vec3(v)


@wp.kernel
def observe_fingers(
    finger_body: wp.array2d[int],  # (world_count, 2)
    body_wrench: wp.array[wp.spatial_vector],
    # Out:
    force_out: wp.array2d[wp.vec3],  # (world_count, 2) [N]
):
    """Read the force of the soft object on each finger."""
    w, f = wp.tid()
    force_out[w, f] = wp.spatial_top(body_wrench[finger_body[w, f]])
