"""Device code of `shadow`: a depth map along the light, and how much of the light it keeps from a point."""

import warp as wp

wp.set_module_options({"enable_backward": False})


SOLID = wp.constant(0.3)
"""Least opacity of a splat that casts a shadow."""


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


@wp.struct
class SplatMap:
    """The map of a shadow, as what receives it reads it."""

    bounds: wp.array[wp.vec4]  # (world_count,) [m]
    depth: wp.array3d[float]  # (world_count, cells, cells) [m]; of size zero without a shadow
    margin: float
    strength: float
    softness: float


@wp.func
def covered_share(splats: SplatMap, world: int, place: wp.vec2, depth: float) -> float:
    """Return how much of the light the splats keep from a point, 0..1.

    The point has its place across the light and its depth along it [m].
    """
    cells = splats.depth.shape[1]
    if cells == 0:
        return 0.0
    corner = map_place(splats.bounds[world], cells, splats.margin)
    x = (place[0] - corner[0]) / corner[2] - 0.5
    y = (place[1] - corner[1]) / corner[2] - 0.5
    softness = splats.softness
    reach = float(cells) + softness
    if not (x >= -softness and y >= -softness and x <= reach and y <= reach):
        return 0.0
    covered = float(0.0)
    total = float(0.0)
    for j in range(int(wp.ceil(y - softness)), int(wp.floor(y + softness)) + 1):
        for i in range(int(wp.ceil(x - softness)), int(wp.floor(x + softness)) + 1):
            weight = (softness + 0.2 - wp.abs(float(i) - x)) * (softness + 0.2 - wp.abs(float(j) - y))
            total += weight
            if i >= 0 and j >= 0 and i < cells and j < cells:
                if splats.depth[world, j, i] < depth:
                    covered += weight
    if covered <= 0.0:
        return 0.0
    return splats.strength * covered / total
