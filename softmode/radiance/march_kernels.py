"""Device code of `march`: rays through radiance fields, at rest or bent back by an inverse map, and layers by depth."""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.tools.inverse_map_kernels import OUTSIDE, RestGrid, node_of, place_of

wp.set_module_options({"enable_backward": False})

OPAQUE = wp.constant(0.01)
LAYERS = wp.constant(8)


@struct
class Field:
    """A radiance field on the device."""

    density: wp.array3d[float]  # [1/m]
    sh: wp.array4d[wp.vec3]  # (nx, ny, nz, K)
    clear: wp.array3d[int]  # nodes from here to the nearest that is not empty, 0 at that
    size: wp.vec3i
    to_index: wp.mat33  # from a rest point less the origin to nodes
    origin: wp.vec3  # [m]
    to_color: wp.mat33  # from directions at rest to the frame of the colours
    voxel: float  # distance of nodes [m]
    step: float  # of a ray at rest [m]


@wp.func
def shade(sh: wp.array4d[wp.vec3], i: int, j: int, k: int, d: wp.vec3) -> wp.vec3:
    """Return sum_k Y_k(d) c_k of a node, degree 0 to 2."""
    c = 0.28209479177387814 * sh[i, j, k, 0]
    if sh.shape[3] > 1:
        c += 0.4886025119029199 * (d[2] * sh[i, j, k, 2] - d[1] * sh[i, j, k, 1] - d[0] * sh[i, j, k, 3])
    if sh.shape[3] > 4:
        c += (1.0925484305920792 * d[0] * d[1]) * sh[i, j, k, 4]
        c -= (1.0925484305920792 * d[1] * d[2]) * sh[i, j, k, 5]
        c += (0.31539156525252005 * (3.0 * d[2] * d[2] - 1.0)) * sh[i, j, k, 6]
        c -= (1.0925484305920792 * d[0] * d[2]) * sh[i, j, k, 7]
        c += (0.5462742152960396 * (d[0] * d[0] - d[1] * d[1])) * sh[i, j, k, 8]
    return c


@wp.func
def density_at(field: Field, u: wp.vec3) -> float:
    """Return the trilinear density at a place among the nodes [1/m]."""
    i = int(u[0])
    j = int(u[1])
    k = int(u[2])
    x = u[0] - float(i)
    y = u[1] - float(j)
    z = u[2] - float(k)
    a = field.density[i, j, k] * (1.0 - z) + field.density[i, j, k + 1] * z
    b = field.density[i, j + 1, k] * (1.0 - z) + field.density[i, j + 1, k + 1] * z
    c = field.density[i + 1, j, k] * (1.0 - z) + field.density[i + 1, j, k + 1] * z
    d = field.density[i + 1, j + 1, k] * (1.0 - z) + field.density[i + 1, j + 1, k + 1] * z
    return (a * (1.0 - y) + b * y) * (1.0 - x) + (c * (1.0 - y) + d * y) * x


@wp.func
def color_at(field: Field, u: wp.vec3, d: wp.vec3) -> wp.vec3:
    """Return the trilinear colour at a place among the nodes, seen along a direction in the frame of the colours."""
    i = int(u[0])
    j = int(u[1])
    k = int(u[2])
    f = wp.vec3(u[0] - float(i), u[1] - float(j), u[2] - float(k))
    total = wp.vec3(0.5, 0.5, 0.5)
    for a in range(2):
        wa = wp.where(a == 1, f[0], 1.0 - f[0])
        for b in range(2):
            wb = wp.where(b == 1, wa * f[1], wa * (1.0 - f[1]))
            total += (wb * (1.0 - f[2])) * shade(field.sh, i + a, j + b, k, d)
            total += (wb * f[2]) * shade(field.sh, i + a, j + b, k + 1, d)
    return wp.vec3(wp.clamp(total[0], 0.0, 1.0), wp.clamp(total[1], 0.0, 1.0), wp.clamp(total[2], 0.0, 1.0))


@wp.func
def box_range(low: wp.vec3, high: wp.vec3, eye: wp.vec3, d: wp.vec3, far: float) -> wp.vec2:
    """Return where a ray is in a box, from and to; from > to where it misses."""
    t = wp.vec2(0.0, far)
    for axis in range(3):
        if wp.abs(d[axis]) > 1.0e-9:
            a = (low[axis] - eye[axis]) / d[axis]
            b = (high[axis] - eye[axis]) / d[axis]
            t = wp.vec2(wp.max(t[0], wp.min(a, b)), wp.min(t[1], wp.max(a, b)))
        elif eye[axis] < low[axis] or eye[axis] > high[axis]:
            t = wp.vec2(1.0, 0.0)
    return t


@wp.struct
class Ray:
    """What a ray has gathered."""

    color: wp.vec3  # times coverage
    light: float  # that is left
    depth: float  # distance times coverage [m]
    samples: int


@wp.func
def gather(ray: Ray, field: Field, u: wp.vec3, d: wp.vec3, length: float, t: float) -> Ray:
    """Add a step of a length at rest [m] through the field."""
    ray.samples += 1
    sigma = density_at(field, u)
    alpha = 1.0 - wp.exp(-sigma * length)
    if alpha > 1.0e-4:
        share = ray.light * alpha
        ray.color += share * color_at(field, u, d)
        ray.depth += share * t
        ray.light -= share
        if ray.light < OPAQUE:
            full = 1.0 / (1.0 - ray.light)
            ray.color *= full
            ray.depth *= full
            ray.light = 0.0
    return ray


@wp.func
def inside_field(field: Field, u: wp.vec3) -> bool:
    """Return whether a place is among the nodes."""
    return (
        u[0] >= 0.0 and u[1] >= 0.0 and u[2] >= 0.0
        and u[0] < float(field.size[0] - 1) and u[1] < float(field.size[1] - 1) and u[2] < float(field.size[2] - 1)
    )  # fmt: skip


@wp.func
def clear_of(field: Field, u: wp.vec3) -> int:
    """Return the number of nodes from a place to the nearest that is not empty."""
    return field.clear[int(u[0] + 0.5), int(u[1] + 0.5), int(u[2] + 0.5)]


@wp.func
def march_rest(field: Field, eye: wp.vec3, d: wp.vec3, far: float) -> Ray:
    """March through a field at rest."""
    ray = Ray()
    ray.light = 1.0
    e = field.to_index * (eye - field.origin)
    s = field.to_index * d
    top = wp.vec3(float(field.size[0] - 1), float(field.size[1] - 1), float(field.size[2] - 1))
    t = box_range(wp.vec3(), top, e, s, far)
    at = t[0] + 0.5 * field.step
    seen = field.to_color * d
    while at < t[1] and ray.light > 0.0:
        u = e + at * s
        free = int(0)
        if inside_field(field, u):
            free = clear_of(field, u)
            if free < 2:
                ray = gather(ray, field, u, seen, field.step, at)
        at += wp.max(field.step, float(free - 1) * field.voxel)
    return ray


@wp.kernel
def mark_live(
    field: Field,
    grid: RestGrid,
    reach: int,  # nodes of the field that a cell of the grid spans
    span: float,  # largest distance of rest points in a cell [m]
    # Out:
    live_out: wp.array2d[int],  # (world_count, node_max)
):
    """Tell which cells of the grid may hold something of the field."""
    world, n = wp.tid()
    size = grid.size[world]
    if n >= size[0] * size[1] * size[2]:
        return
    live_out[world, n] = 0
    p = place_of(size, n)
    if p[0] > size[0] - 2 or p[1] > size[1] - 2 or p[2] > size[2] - 2:
        return
    first = grid.rest[world, n]
    near = int(0)
    for c in range(8):
        m = node_of(size, p[0] + c // 4, p[1] + c // 2 % 2, p[2] + c % 2)
        if grid.flag[world, m] == OUTSIDE:
            return
        rest = grid.rest[world, m]
        if wp.length(rest - first) > span:
            return
        u = field.to_index * (rest - field.origin)
        v = wp.vec3(
            wp.clamp(u[0], 0.0, float(field.size[0] - 1)),
            wp.clamp(u[1], 0.0, float(field.size[1] - 1)),
            wp.clamp(u[2], 0.0, float(field.size[2] - 1)),
        )
        if clear_of(field, v) + int(wp.length(u - v)) <= reach:
            near = int(1)
    live_out[world, n] = near


@wp.func
def rest_at(grid: RestGrid, world: int, n: int, f: wp.vec3) -> wp.vec3:
    """Return the trilinear rest point in a cell of the grid [m]."""
    size = grid.size[world]
    sx = size[1] * size[2]
    sy = size[2]
    x = f[0]
    y = f[1]
    z = f[2]
    a = grid.rest[world, n] * (1.0 - z) + grid.rest[world, n + 1] * z
    b = grid.rest[world, n + sy] * (1.0 - z) + grid.rest[world, n + sy + 1] * z
    c = grid.rest[world, n + sx] * (1.0 - z) + grid.rest[world, n + sx + 1] * z
    d = grid.rest[world, n + sx + sy] * (1.0 - z) + grid.rest[world, n + sx + sy + 1] * z
    return (a * (1.0 - y) + b * y) * (1.0 - x) + (c * (1.0 - y) + d * y) * x


@wp.func
def march_moved(
    field: Field, grid: RestGrid, live: wp.array2d[int], world: int, eye: wp.vec3, d: wp.vec3, far: float
) -> Ray:
    """March through a deformed field: the ray is bent back by the grid of rest points.

    Steps have the same length at rest, so that a body that is stretched or scaled keeps its opacity.
    """
    ray = Ray()
    ray.light = 1.0
    size = grid.size[world]
    if size[0] == 0:
        return ray
    edge = grid.edge[world]
    e = (eye - grid.low[world]) / edge
    s = d / edge
    top = wp.vec3(float(size[0]) - 1.001, float(size[1]) - 1.001, float(size[2]) - 1.001)
    t = box_range(wp.vec3(0.001, 0.001, 0.001), top, e, s, far)
    at = t[0]
    step = float(field.step)
    seen = field.to_color * d
    last = wp.vec3()
    follows = bool(False)  # whether the step before was a step too
    while at < t[1] and ray.light > 0.0:
        u = e + at * s
        i = int(u[0])
        j = int(u[1])
        k = int(u[2])
        n = node_of(size, i, j, k)
        if live[world, n] == 0:
            # to where the ray leaves the cell
            ahead = float(1.0e9)
            for axis in range(3):
                if wp.abs(s[axis]) > 1.0e-9:
                    cell = wp.floor(u[axis])
                    ahead = wp.min(ahead, (wp.where(s[axis] > 0.0, cell + 1.0, cell) - u[axis]) / s[axis])
            at += wp.max(ahead, 0.0) + 1.0e-4 * edge
            follows = False
        else:
            rest = rest_at(grid, world, n, wp.vec3(u[0] - float(i), u[1] - float(j), u[2] - float(k)))
            if follows:
                length = wp.length(rest - last)
                step = wp.clamp(step * field.step / wp.max(length, 1.0e-3 * field.step), 0.125 * step, 2.0 * step)
            v = field.to_index * (rest - field.origin)
            free = int(0)
            if inside_field(field, v):
                free = clear_of(field, v)
                if free < 2:
                    if grid.turn.shape[0] > 0:
                        seen = field.to_color * wp.quat_rotate_inv(grid.turn[world, n], d)
                    ray = gather(ray, field, v, seen, wp.where(follows, length, field.step), at)
            last = rest
            follows = free < 4
            # Half of what is clear at rest stays so if the body is not pressed to less than half.
            at += step * wp.max(1.0, 0.5 * float(free - 1) * field.voxel / field.step)
            if not follows:
                step = float(field.step)
    return ray


@wp.kernel
def march_views(
    field: Field,
    grid: RestGrid,
    live: wp.array2d[int],
    moved: bool,
    # Views:
    world_to_camera: wp.array[wp.mat44],  # (view_count,)
    intrinsics: wp.array[wp.vec4],  # (view_count,) [px]
    view_world: wp.array[int],
    mesh_depth: wp.array3d[float],  # [m], 0 where there is no mesh; of size zero: none
    samples: int,  # per pixel along each axis
    # Out:
    layer_out: wp.array3d[wp.vec4],  # (view_count, height, width) colour times coverage, coverage
    depth_out: wp.array3d[float],  # forward depth times coverage [m]
    count_out: wp.array3d[int],  # samples in the field
):
    """Average the rays of a pixel."""
    view, row, column = wp.tid()
    m = world_to_camera[view]
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    eye = -(m[0, 3] * r0 + m[1, 3] * r1 + m[2, 3] * r2)
    lens = intrinsics[view]
    far = float(1.0e9)
    if mesh_depth.shape[0] > 0:
        if mesh_depth[view, row, column] > 0.0:
            far = mesh_depth[view, row, column]
    layer = wp.vec4()
    depth = float(0.0)
    count = int(0)
    share = 1.0 / float(samples)
    for b in range(samples):
        y = (float(row) + (float(b) + 0.5) * share - lens[3]) / lens[1]
        for a in range(samples):
            x = (float(column) + (float(a) + 0.5) * share - lens[2]) / lens[0]
            d = x * r0 + y * r1 + r2
            long = wp.length(d)
            ray = Ray()
            if moved:
                ray = march_moved(field, grid, live, view_world[view], eye, d / long, far * long)
            else:
                ray = march_rest(field, eye, d / long, far * long)
            layer += wp.vec4(ray.color[0], ray.color[1], ray.color[2], 1.0 - ray.light)
            depth += ray.depth / long
            count += ray.samples
    layer_out[view, row, column] = share * share * layer
    depth_out[view, row, column] = share * share * depth
    count_out[view, row, column] = count


@wp.kernel
def join_layers(
    layer: wp.array4d[wp.vec4],  # (field_count, view_count, height, width)
    layer_depth: wp.array4d[float],
    mesh_rgb: wp.array3d[wp.vec3],
    mesh_depth: wp.array3d[float],
    splats: bool,  # rgb, depth and alpha hold splats over the meshes
    # In and out:
    rgb: wp.array3d[wp.vec3],
    depth: wp.array3d[float],
    alpha: wp.array3d[float],  # of size zero without splats
):
    """Put the fields and the splats of a pixel over the meshes in the order of their depth."""
    view, row, column = wp.tid()
    behind = mesh_rgb[view, row, column]
    wall = mesh_depth[view, row, column]
    count = layer.shape[0]
    covered = float(0.0)
    for f in range(count):
        covered += layer[f, view, row, column][3]
    if covered == 0.0:
        return
    splat = wp.vec4()
    splat_depth = float(0.0)
    if splats:
        a = alpha[view, row, column]
        own = rgb[view, row, column] - (1.0 - a) * behind
        splat = wp.vec4(own[0], own[1], own[2], a)
        splat_depth = depth[view, row, column]
        if wall > 0.0:
            splat_depth = (splat_depth - (1.0 - a) * wall) / wp.max(a, 1.0e-6)
    total = wp.vec3()
    light = float(1.0)
    far = float(0.0)
    before = float(-1.0)
    # The nearest that is left, again and again; there are few.
    for _ in range(count + 1):
        best = float(1.0e30)
        chosen = int(-2)
        if splat[3] > 0.0 and splat_depth > before:
            best = splat_depth
            chosen = -1
        for f in range(count):
            a = layer[f, view, row, column][3]
            if a > 0.0:
                z = layer_depth[f, view, row, column] / a
                if z > before and z < best:
                    best = z
                    chosen = f
        if chosen == -2:
            break
        c = splat
        if chosen >= 0:
            c = layer[chosen, view, row, column]
        total += light * wp.vec3(c[0], c[1], c[2])
        far += light * c[3] * best
        light *= 1.0 - c[3]
        before = best
    rgb[view, row, column] = total + light * behind
    if wall > 0.0:
        depth[view, row, column] = far + light * wall
    else:
        depth[view, row, column] = far / wp.max(1.0 - light, 1.0e-6)
    if splats:
        alpha[view, row, column] = 1.0 - light
