"""Device code of `shadow`: a depth map along the light and the meshes it darkens."""

import warp as wp

from softmode.splats.camera_kernels import to_linear, to_srgb, unpack_rgb

wp.set_module_options({"enable_backward": False})


SOLID = wp.constant(0.3)
"""Least opacity of a splat that casts a shadow."""
SHADOW_LIGHT = wp.constant(0.3)
"""Share of the sunlight that Newton's sensor leaves in the shadow of a mesh."""


@wp.func
def map_place(bounds: wp.vec4, cells: int, margin: float) -> wp.vec3:
    """Return the corner of a world's map across the light, and the size of its cells [m]."""
    x = 0.5 * (bounds[0] + bounds[1])
    y = 0.5 * (bounds[2] + bounds[3])
    width = margin * wp.max(bounds[1] - bounds[0], bounds[3] - bounds[2])
    width = wp.max(width, 1.0e-6)
    return wp.vec3(x - 0.5 * width, y - 0.5 * width, width / float(cells))


@wp.kernel
def bound_map(
    # Splats:
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    opacity: wp.array2d[float],
    frame: wp.mat33,  # rows: two axes across the light, the light's direction
    spanning: wp.array2d[int],  # (1|world_count, M) columns of some of the splats
    # Out:
    bounds_out: wp.array[wp.vec4],  # (world_count,) lowest and highest along both axes [m]
):
    """Find how far some of the splats reach across the light; the margin of the map takes care of the others."""
    world = wp.tid()
    bounds = wp.vec4(1.0e30, -1.0e30, 1.0e30, -1.0e30)
    for k in range(spanning.shape[1]):
        i = spanning[world % spanning.shape[0], k]
        p = frame * mean[world % mean.shape[0], i]
        if opacity[world % opacity.shape[0], i] >= SOLID and wp.length(p) < 1.0e6:
            bounds = wp.vec4(
                wp.min(bounds[0], p[0]), wp.max(bounds[1], p[0]), wp.min(bounds[2], p[1]), wp.max(bounds[3], p[1])
            )
    bounds_out[world] = bounds


@wp.kernel
def fill_map(
    # Splats:
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    opacity: wp.array2d[float],
    # Map:
    bounds: wp.array[wp.vec4],  # (world_count,) [m]
    frame: wp.mat33,
    margin: float,
    # Out:
    depth_out: wp.array3d[float],  # (world_count, cells, cells) nearest depth along the light [m]
):
    """Keep the nearest splat per cell."""
    world, i = wp.tid()
    p = frame * mean[world % mean.shape[0], i]
    if opacity[world % opacity.shape[0], i] < SOLID or not (wp.length(p) < 1.0e6):
        return
    cells = depth_out.shape[1]
    place = map_place(bounds[world], cells, margin)
    x = int(wp.floor((p[0] - place[0]) / place[2]))
    y = int(wp.floor((p[1] - place[1]) / place[2]))
    if x >= 0 and y >= 0 and x < cells and y < cells:
        wp.atomic_min(depth_out, world, y, x, p[2])


@wp.kernel
def darken(
    # Map:
    bounds: wp.array[wp.vec4],  # (world_count,) [m]
    frame: wp.mat33,
    margin: float,
    map_depth: wp.array3d[float],  # (world_count, cells, cells) [m]
    # Views:
    view_world: wp.array[int],
    intrinsics: wp.array[wp.vec4],
    sensor_pose: wp.array[wp.transform],  # camera to world, OpenGL axes
    # Meshes:
    mesh_depth: wp.array3d[float],  # (view_count, height, width) [m]
    packed: wp.array3d[wp.uint32],  # RGBA, sRGB, as lit
    albedo: wp.array3d[wp.uint32],  # RGBA, sRGB
    normal: wp.array3d[wp.vec3],
    ambient_above: wp.vec3,  # linear radiance
    ambient_below: wp.vec3,
    sun: wp.vec3,
    # Options:
    strength: float,
    softness: float,
    # Out:
    rgb_out: wp.array3d[wp.vec3],
):
    """Take the sunlight from mesh pixels that lie behind the splats as the light sees them.

    What would be left of the lit colour in the shadow of a mesh is found from albedo and normal, channel by channel;
    where a mesh keeps the sun off already, that is all of it.
    """
    view, row, column = wp.tid()
    z = mesh_depth[view, row, column]
    if z <= 0.0:
        return
    lens = intrinsics[view]
    local = wp.vec3((float(column) + 0.5 - lens[2]) / lens[0], -(float(row) + 0.5 - lens[3]) / lens[1], -1.0)
    world = view_world[view]
    p = frame * wp.transform_point(sensor_pose[view], z * local)
    cells = map_depth.shape[1]
    place = map_place(bounds[world], cells, margin)
    x = (p[0] - place[0]) / place[2] - 0.5
    y = (p[1] - place[1]) / place[2] - 0.5
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
    if covered <= 0.0:
        return
    up = 0.5 * (normal[view, row, column][2] + 1.0)
    ahead = wp.vec3(frame[2, 0], frame[2, 1], frame[2, 2])
    sunlight = SHADOW_LIGHT * wp.max(-wp.dot(normal[view, row, column], ahead), 0.0) * sun
    light = up * ambient_above + (1.0 - up) * ambient_below + sunlight
    lit = to_linear(unpack_rgb(packed[view, row, column]))
    dark = wp.cw_mul(to_linear(unpack_rgb(albedo[view, row, column])), light)
    taken = strength * covered / total
    left = wp.vec3()
    for channel in range(3):
        share = wp.min(dark[channel] / wp.max(lit[channel], 1.0e-6), 1.0)
        left[channel] = 1.0 - taken * (1.0 - share)
    rgb_out[view, row, column] = wp.cw_mul(rgb_out[view, row, column], to_srgb(left))
