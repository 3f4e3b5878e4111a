"""Device code of `camera`: poses, rays, sky, segmentation and byte images."""

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
    sensor_pose_out: wp.array[wp.transform],  # camera to world with OpenGL axes, as SensorCamera wants it
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
    half_turn = wp.quat(1.0, 0.0, 0.0, 0.0)
    sensor_pose_out[view] = wp.transform(position, rotation * half_turn)


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
def aim_pixels(
    sensor_pose: wp.array[wp.transform],  # (world_count,) camera to world, OpenGL axes
    intrinsics: wp.array[wp.vec4],  # (world_count,) [px]
    # Out:
    pose_out: wp.array3d[wp.transform],  # (world_count, height, width)
):
    """Turn the axis of the camera to each pixel by the shortest arc, q = (a x d, 1 + a.d) / norm with a = -z."""
    world, row, column = wp.tid()
    lens = intrinsics[world]
    x = (float(column) + 0.5 - lens[2]) / lens[0]
    y = (float(row) + 0.5 - lens[3]) / lens[1]
    d = wp.normalize(wp.vec3(x, -y, -1.0))
    turn = wp.normalize(wp.quat(d[1], -d[0], 0.0, 1.0 - d[2]))
    pose = sensor_pose[world]
    pose_out[world, row, column] = wp.transform(
        wp.transform_get_translation(pose), wp.transform_get_rotation(pose) * turn
    )


@wp.func
def unpack_rgb(packed: wp.uint32) -> wp.vec3:
    """Return the colours 0..1 of packed RGBA bytes."""
    red = float(packed & wp.uint32(255))
    green = float((packed >> wp.uint32(8)) & wp.uint32(255))
    blue = float((packed >> wp.uint32(16)) & wp.uint32(255))
    return wp.vec3(red, green, blue) / 255.0


@wp.func
def to_linear(c: wp.vec3) -> wp.vec3:
    """Return linear light of gamma-encoded colour, by the power 2.2."""
    return wp.vec3(wp.pow(c[0], 2.2), wp.pow(c[1], 2.2), wp.pow(c[2], 2.2))


@wp.func
def to_srgb(c: wp.vec3) -> wp.vec3:
    """Return gamma-encoded colour of linear light, by the power 1/2.2."""
    inverse = 1.0 / 2.2
    return wp.vec3(wp.pow(c[0], inverse), wp.pow(c[1], inverse), wp.pow(c[2], inverse))


@wp.kernel
def unpack_meshes(
    # Images in:
    packed: wp.array3d[wp.uint32],  # RGBA, sRGB
    mesh_depth: wp.array3d[float],  # [m], 0 where there is no mesh
    has_meshes: bool,
    depth_per_pixel: bool,  # mesh_depth is along the ray of each pixel; turned into depth along the axis
    # Views:
    view_world: wp.array[int],
    sensor_pose: wp.array[wp.transform],
    intrinsics: wp.array[wp.vec4],
    # Worlds:
    horizon: wp.array[wp.vec3],
    zenith: wp.array[wp.vec3],
    light_gain: wp.array[wp.vec3],
    # Out:
    rgb_out: wp.array3d[wp.vec3],
    depth_out: wp.array3d[float],  # may be mesh_depth; written with depth_per_pixel only
):
    """Unpack the mesh colours and paint the sky behind them."""
    view, row, column = wp.tid()
    world = view_world[view]
    lens = intrinsics[view]
    local = wp.vec3((float(column) + 0.5 - lens[2]) / lens[0], -(float(row) + 0.5 - lens[3]) / lens[1], -1.0)
    mesh = wp.vec3()
    covered = wp.float32(0.0)
    if has_meshes:
        z = mesh_depth[view, row, column]
        if z > 0.0:
            if depth_per_pixel:
                depth_out[view, row, column] = z / wp.length(local)
            c = packed[view, row, column]
            mesh = wp.cw_mul(light_gain[world], unpack_rgb(c))
            covered = float(c >> wp.uint32(24)) / 255.0
            if covered > 0.999:
                rgb_out[view, row, column] = mesh
                return
    ray = wp.transform_vector(sensor_pose[view], local)
    sky = wp.lerp(horizon[world], zenith[world], wp.clamp(2.0 * ray[2] / wp.length(ray), 0.0, 1.0))
    if covered > 0.0:
        # A multisampled edge: the sensor averaged its hits over all samples in linear light.
        sky = to_srgb(to_linear(mesh) + (1.0 - covered) * to_linear(sky))
    rgb_out[view, row, column] = sky


@wp.kernel
def segment(
    # Splats; of size zero without:
    alpha: wp.array3d[float],
    object_id: wp.array3d[int],
    # Meshes:
    shape_index: wp.array3d[wp.uint32],  # (1, 1, 1) without meshes
    shape_segment: wp.array[int],  # (shape_count,)
    # Out:
    segment_out: wp.array3d[int],
):
    """Name what a pixel mostly shows: a splat object where splats cover more than half of it, else the shape."""
    view, row, column = wp.tid()
    found = wp.int32(-1)
    if view < shape_index.shape[0] and row < shape_index.shape[1] and column < shape_index.shape[2]:
        shape = shape_index[view, row, column]
        if shape < wp.uint32(shape_segment.shape[0]):
            found = shape_segment[int(shape)]
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
