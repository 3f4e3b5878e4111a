"""Device code of `camera` and `shadow`: camera poses, sky, shadow map and byte images."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def place_cameras(
    # Cameras:
    pose: wp.array[wp.transform],  # (view_count,) camera (OpenCV) to body or world
    body: wp.array[int],  # (view_count,) carrying body, -1 for none
    # State in:
    body_q: wp.array[wp.transform],
    # Out:
    world_to_camera_out: wp.array[wp.mat44],
    sensor_pose_out: wp.array[wp.transform],  # camera to world with OpenGL axes, as SensorCamera wants it
):
    """Find where every camera is."""
    view = wp.tid()
    x = pose[view]
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
    # Views:
    sensor_pose: wp.array[wp.transform],
    intrinsics: wp.array[wp.vec4],
    # Options:
    horizon: wp.vec3,
    zenith: wp.vec3,
    has_meshes: bool,
    # Out:
    rgb_out: wp.array3d[wp.vec3],
):
    """Unpack the mesh colours and paint the sky behind them."""
    view, row, column = wp.tid()
    mesh = wp.vec3()
    covered = wp.float32(0.0)
    if has_meshes and mesh_depth[view, row, column] > 0.0:
        c = packed[view, row, column]
        red = float(c & wp.uint32(255))
        green = float((c >> wp.uint32(8)) & wp.uint32(255))
        blue = float((c >> wp.uint32(16)) & wp.uint32(255))
        mesh = wp.vec3(red, green, blue) / 255.0
        covered = float(c >> wp.uint32(24)) / 255.0
        if covered > 0.999:
            rgb_out[view, row, column] = mesh
            return
    lens = intrinsics[view]
    x = (float(column) + 0.5 - lens[2]) / lens[0]
    y = (float(row) + 0.5 - lens[3]) / lens[1]
    ray = wp.transform_vector(sensor_pose[view], wp.vec3(x, -y, -1.0))
    sky = wp.lerp(horizon, zenith, wp.clamp(2.0 * ray[2] / wp.length(ray), 0.0, 1.0))
    if covered > 0.0:
        # A multisampled edge: the sensor averaged its hits over all samples in linear light.
        sky = to_srgb(to_linear(mesh) + (1.0 - covered) * to_linear(sky))
    rgb_out[view, row, column] = sky


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


@wp.kernel
def center_map(
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    stride: int,
    # Out:
    center_out: wp.array[wp.vec3],  # (world_count,) [m]
):
    """Average some of the splat centres."""
    world = wp.tid()
    total = wp.vec3()
    number = wp.float32(0.0)
    for i in range(0, mean.shape[1], stride):
        total += mean[world % mean.shape[0], i]
        number += 1.0
    center_out[world] = total / number


@wp.kernel
def fill_map(
    # Splats:
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    opacity: wp.array2d[float],
    # Map:
    center: wp.array[wp.vec3],  # (world_count,) [m]
    frame: wp.mat33,  # rows: two axes across the light, the light's direction
    cell: float,  # [m]
    # Out:
    depth_out: wp.array3d[float],  # (world_count, cells, cells) nearest depth along the light [m]
):
    """Keep the nearest splat per cell; a minimum does not depend on the order of threads."""
    world, i = wp.tid()
    if opacity[world % opacity.shape[0], i] < 0.3:
        return
    p = frame * (mean[world % mean.shape[0], i] - center[world])
    cells = depth_out.shape[1]
    x = int(wp.floor(p[0] / cell)) + cells / 2
    y = int(wp.floor(p[1] / cell)) + cells / 2
    if x >= 0 and y >= 0 and x < cells and y < cells:
        wp.atomic_min(depth_out, world, y, x, p[2])


@wp.kernel
def darken(
    # Map:
    center: wp.array[wp.vec3],  # (world_count,) [m]
    frame: wp.mat33,
    cell: float,  # [m]
    map_depth: wp.array3d[float],  # (world_count, cells, cells) [m]
    # Views:
    view_world: wp.array[int],
    intrinsics: wp.array[wp.vec4],
    sensor_pose: wp.array[wp.transform],  # camera to world, OpenGL axes
    mesh_depth: wp.array3d[float],  # (view_count, height, width) [m]
    # Options:
    strength: float,
    softness: float,
    # Out:
    rgb_out: wp.array3d[wp.vec3],
):
    """Darken the mesh pixels that lie behind the splats as the light sees them."""
    view, row, column = wp.tid()
    z = mesh_depth[view, row, column]
    if z <= 0.0:
        return
    lens = intrinsics[view]
    local = wp.vec3((float(column) + 0.5 - lens[2]) / lens[0], -(float(row) + 0.5 - lens[3]) / lens[1], -1.0)
    world = view_world[view]
    p = frame * (wp.transform_point(sensor_pose[view], z * local) - center[world])
    cells = map_depth.shape[1]
    x = p[0] / cell + 0.5 * float(cells) - 0.5
    y = p[1] / cell + 0.5 * float(cells) - 0.5
    reach = float(cells) + softness
    if x < -softness or y < -softness or x > reach or y > reach:
        return
    covered = wp.float32(0.0)
    total = wp.float32(0.0)
    for j in range(int(wp.ceil(y - softness)), int(wp.floor(y + softness)) + 1):
        for i in range(int(wp.ceil(x - softness)), int(wp.floor(x + softness)) + 1):
            weight = (softness + 0.2 - wp.abs(float(i) - x)) * (softness + 0.2 - wp.abs(float(j) - y))
            total += weight
            if i >= 0 and j >= 0 and i < cells and j < cells:
                if map_depth[world, j, i] < p[2]:
                    covered += weight
    if total > 0.0:
        rgb_out[view, row, column] *= 1.0 - strength * covered / total
