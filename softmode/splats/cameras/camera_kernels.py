"""Device code of `camera`: poses, segmentation and byte images."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def place_cameras(
    # Cameras:
    pose: wp.array[wp.transform],  # (view_count,) camera (OpenCV) to body or world
    offset: wp.array[wp.transform],  # (view_count,) drawn pose in the camera's frame
    body: wp.array[int],  # (view_count,) carrying body, -1 for none
    # State in:
    body_q: wp.array[wp.transform],
    # Out:
    world_to_camera_out: wp.array[wp.mat44],
):
    """Find where every camera is."""
    view = wp.tid()
    x = pose[view] * offset[view]
    if body[view] >= 0:
        x = body_q[body[view]] * x
    position = wp.transform_get_translation(x)
    rotation = wp.transform_get_rotation(x)
    r = wp.quat_to_matrix(wp.quat_inverse(rotation))
    t = -(r * position)
    world_to_camera_out[view] = wp.mat44(
        r[0, 0], r[0, 1], r[0, 2], t[0],
        r[1, 0], r[1, 1], r[1, 2], t[1],
        r[2, 0], r[2, 1], r[2, 2], t[2],
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


@wp.kernel
def look_at(
    position: wp.array[wp.vec3],  # (1|world_count,) [m]
    target: wp.array[wp.vec3],  # (1|world_count,) [m]
    up: wp.vec3,
    # Out:
    pose_out: wp.array[wp.transform],  # (world_count,) camera (OpenCV) to the frame of the points
):
    """Aim cameras; one that looks along `up` keeps its pose."""
    world = wp.tid()
    p = position[world % position.shape[0]]
    ahead = target[world % target.shape[0]] - p
    right = wp.cross(ahead, up)
    if not (wp.length(right) > 1.0e-6 * wp.length(ahead)):
        return
    z = wp.normalize(ahead)
    x = wp.normalize(right)
    pose_out[world] = wp.transform(p, wp.quat_from_matrix(wp.matrix_from_cols(x, wp.cross(z, x), z)))


@wp.kernel
def segment(
    # Splats; of size zero without:
    alpha: wp.array3d[float],
    object_id: wp.array3d[int],
    mesh: wp.array3d[int],  # id of the shape behind them, -1 for the sky
    # Out:
    segment_out: wp.array3d[int],
):
    """Name what a pixel mostly shows: a splat object where splats cover more than half of it, else the shape."""
    view, row, column = wp.tid()
    found = mesh[view, row, column]
    if alpha.shape[0] > 0:
        if alpha[view, row, column] > 0.5:
            found = object_id[view, row, column]
    segment_out[view, row, column] = found


@wp.kernel
def pack_bytes(
    rgb: wp.array3d[wp.vec3],
    # Out:
    bytes_out: wp.array4d[wp.uint8],  # (view_count, height, width, 3)
):
    """Round colours 0..1 to bytes."""
    view, row, column = wp.tid()
    c = rgb[view, row, column]
    for channel in range(3):
        bytes_out[view, row, column, channel] = wp.uint8(wp.clamp(c[channel], 0.0, 1.0) * 255.0 + 0.5)
