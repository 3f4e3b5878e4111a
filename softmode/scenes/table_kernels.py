"""Device side of the table scene: placing objects, observing objects and fingers."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class ObjectBases:
    """What places and centres follow from, one row per body, padded to the largest."""

    body: wp.array[int]  # (instance_count,) row of each soft object
    function_start: wp.array[int]  # (instance_count,)
    function_count: wp.array[int]  # (instance_count,), 0 for an object that is not there
    linear: wp.array3d[wp.float64]  # (body_count, function_max, 4)
    mean: wp.array2d[wp.float64]  # (body_count, function_max)
    stride: int  # soft objects per world


@wp.kernel
def place_objects(
    bases: ObjectBases,
    # Reset:
    world_mask: wp.array[wp.bool],
    position: wp.array[wp.vec3d],  # (instance_count,) [m]
    yaw: wp.array[wp.float64],  # (instance_count,) [rad]
    scale: wp.array[float],  # (instance_count,)
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    q_driven_out: wp.array[wp.vec3d],
):
    """Set q of every object to the placement x = scale R(yaw) X + position, at rest; clamps hold it so."""
    i, k = wp.tid()
    b = bases.body[i]
    if not world_mask[i / bases.stride] or k >= bases.function_count[i]:
        return
    size = wp.float64(scale[i])
    c = size * wp.cos(yaw[i]) - wp.float64(1.0)
    s = size * wp.sin(yaw[i])
    x = bases.linear[b, k, 0]
    y = bases.linear[b, k, 1]
    z = (size - wp.float64(1.0)) * bases.linear[b, k, 2]
    q = wp.vec3d(c * x - s * y, s * x + c * y, z) + bases.linear[b, k, 3] * position[i]
    at = bases.function_start[i] + k
    q_out[at] = q
    q_driven_out[at] = q
    qd_out[at] = wp.vec3d()


@wp.kernel
def park_objects(
    bases: ObjectBases,
    world_mask: wp.array[wp.bool],
    place: wp.vec3,  # [m]
    particle_start: wp.array[int],  # (instance_count,)
    room: int,  # surface samples that there is room for
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
):
    """Clear the coordinates of objects that are not there, and put their particles, which nothing reads, aside."""
    i = wp.tid()
    if not world_mask[i / bases.stride] or bases.function_count[i] > 0:
        return
    for k in range(bases.mean.shape[1]):
        q_out[bases.function_start[i] + k] = wp.vec3d()
        qd_out[bases.function_start[i] + k] = wp.vec3d()
    for s in range(room):
        particle_q_out[particle_start[i] + s] = place
        particle_qd_out[particle_start[i] + s] = wp.vec3()


@wp.kernel
def observe_objects(
    bases: ObjectBases,
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    # Out, (world_count, objects):
    position_out: wp.array2d[wp.vec3],
    velocity_out: wp.array2d[wp.vec3],
):
    """Compute position and velocity of the centre of mass: sum_k mean(b_k) q_k, zero where no object is there."""
    i = wp.tid()
    b = bases.body[i]
    start = bases.function_start[i]
    x = wp.vec3d()
    v = wp.vec3d()
    for k in range(bases.function_count[i]):
        x += bases.mean[b, k] * q[start + k]
        v += bases.mean[b, k] * qd[start + k]
    w = i / bases.stride
    position_out[w, i - w * bases.stride] = wp.vec3(x)
    velocity_out[w, i - w * bases.stride] = wp.vec3(v)


@wp.kernel
def observe_fingers(
    finger_body: wp.array3d[int],  # (world_count, 2, links of a finger), -1 for none
    body_wrench: wp.array[wp.spatial_vector],
    # Out:
    force_out: wp.array2d[wp.vec3],  # (world_count, 2) [N]
):
    """Read the force of the soft object on each finger, the sum over its links."""
    w, f = wp.tid()
    force = wp.spatial_top(body_wrench[finger_body[w, f, 0]])
    for k in range(1, finger_body.shape[2]):
        if finger_body[w, f, k] >= 0:
            force += wp.spatial_top(body_wrench[finger_body[w, f, k]])
    force_out[w, f] = force


@wp.kernel
def place_marker(
    points: wp.array2d[wp.vec3],  # (1 or world_count, splats)
    place: wp.array[wp.transform],
    first: int,
    # Out:
    means: wp.array2d[wp.vec3],
):
    """Move the centres of the marker's splats to its place."""
    w, i = wp.tid()
    means[w, first + i] = wp.transform_point(place[w], points[w % points.shape[0], i])
