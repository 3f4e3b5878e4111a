"""Device code of `rasterizer`: projection, covering and blending."""

import functools

import warp as wp

from softmode.splats.lane_ops import lowest_bit

wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""Symmetric matrix: xx, xy, xz, yy, yz, zz."""

ALPHA_MIN = wp.constant(1.0 / 255.0)
ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
FAR_KEY = wp.constant(0x7F800000)
FRUSTUM_MARGIN = wp.constant(1.3)


@wp.func
def sh_color(sh: wp.array3d[wp.vec3], w: int, i: int, d: wp.vec3) -> wp.vec3:
    """Evaluate the colour in unit direction d, up to degree 3, in the sign convention of the splat formats."""
    c = 0.28209479177387814 * sh[w, i, 0]
    count = sh.shape[2]
    if count > 1:
        x = d[0]
        y = d[1]
        z = d[2]
        c += 0.4886025119029199 * (-y * sh[w, i, 1] + z * sh[w, i, 2] - x * sh[w, i, 3])
        if count > 4:
            xx = x * x
            yy = y * y
            zz = z * z
            c += 1.0925484305920792 * (x * y * sh[w, i, 4] - y * z * sh[w, i, 5] - x * z * sh[w, i, 7])
            c += 0.31539156525252005 * (2.0 * zz - xx - yy) * sh[w, i, 6]
            c += 0.5462742152960396 * (xx - yy) * sh[w, i, 8]
            if count > 9:
                c += -0.5900435899266435 * y * (3.0 * xx - yy) * sh[w, i, 9]
                c += 2.890611442640554 * x * y * z * sh[w, i, 10]
                c += -0.4570457994644658 * y * (4.0 * zz - xx - yy) * sh[w, i, 11]
                c += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh[w, i, 12]
                c += -0.4570457994644658 * x * (4.0 * zz - xx - yy) * sh[w, i, 13]
                c += 1.445305721320277 * z * (xx - yy) * sh[w, i, 14]
                c += -0.5900435899266435 * x * (xx - 3.0 * yy) * sh[w, i, 15]
    return wp.max(c + wp.vec3(0.5, 0.5, 0.5), wp.vec3(0.0, 0.0, 0.0))


@wp.kernel
def project(
    # Splats:
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    covariance: wp.array2d[vec6],  # (1|world_count, splat_count) [m^2]
    opacity: wp.array2d[float],  # (1|world_count, splat_count)
    sh: wp.array3d[wp.vec3],  # (1|world_count, splat_count, K)
    rotation: wp.array2d[wp.quat],  # (1|world_count, splat_count), not read if K = 1
    # Views:
    world_to_camera: wp.array[wp.mat44],  # (view_count,)
    intrinsics: wp.array[wp.vec4],  # (view_count,) [px]
    view_world: wp.array[int],  # (view_count,)
    # Options:
    size: wp.vec2i,
    tile: wp.vec2i,
    near: float,
    dilation: float,
    antialiased: bool,
    # Out:
    center_out: wp.array[wp.vec4],  # u, v [px], forward depth [m], largest d^2/2 that is drawn
    shape_out: wp.array[wp.vec4],  # slope b/c, c/det [1/px^2], 1/c [1/px^2], opacity
    color_out: wp.array[wp.vec4],  # r, g, b, 0
    box_out: wp.array[wp.vec4us],  # tiles: x0, x1, y0, y1, half open
    key_out: wp.array[int],  # bits of the depth
    order_out: wp.array[int],  # this splat, to be sorted by the keys
):
    """Project splats: d^2 = (c/det) (dx - (b/c) dy)^2 + dy^2/c with the image covariance [[a, b], [b, c]].

    The completed square is well conditioned for needles, and gives the span of a pixel row directly.
    """
    view, i = wp.tid()
    k = view * mean.shape[1] + i
    world = view_world[view]
    key_out[k] = FAR_KEY
    order_out[k] = i
    box_out[k] = wp.vec4us()
    m = world_to_camera[view]
    x = mean[world % mean.shape[0], i]
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    z = wp.dot(r2, x) + m[2, 3]
    if not (z > near and z < 1.0e30):
        return
    px = (wp.dot(r0, x) + m[0, 3]) / z
    py = (wp.dot(r1, x) + m[1, 3]) / z
    lens = intrinsics[view]
    width = float(size[0])
    height = float(size[1])
    # The Jacobian is taken at a point clamped to a little more than the view, or splats at its rim would blow up.
    limit_x = FRUSTUM_MARGIN * 0.5 * width / lens[0]
    limit_y = FRUSTUM_MARGIN * 0.5 * height / lens[1]
    j0 = (lens[0] / z) * (r0 - wp.clamp(px, -limit_x, limit_x) * r2)
    j1 = (lens[1] / z) * (r1 - wp.clamp(py, -limit_y, limit_y) * r2)
    s = covariance[world % covariance.shape[0], i]
    sigma = wp.mat33(s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5])
    s0 = sigma * j0
    a = wp.dot(j0, s0)
    b = wp.dot(j1, s0)
    c = wp.dot(j1, sigma * j1)
    o = opacity[world % opacity.shape[0], i]
    sharp = wp.max(a * c - b * b, 0.0)
    a += dilation
    c += dilation
    det = a * c - b * b
    if not (det > 0.0 and c > 0.0):
        return
    if antialiased:
        o *= wp.sqrt(sharp / det)
    if o < ALPHA_MIN:
        return
    # Opacity-aware extent: alpha falls to 1/255 where d^2/2 = ln(255 o).
    reach = wp.log(255.0 * o)
    u = lens[0] * px + lens[2]
    v = lens[1] * py + lens[3]
    half_x = wp.sqrt(2.0 * reach * a)
    half_y = wp.sqrt(2.0 * reach * c)
    if u + half_x < 0.0 or u - half_x > width or v + half_y < 0.0 or v - half_y > height:
        return
    x0 = int(wp.max(u - half_x, 0.0)) / tile[0]
    y0 = int(wp.max(v - half_y, 0.0)) / tile[1]
    x1 = int(wp.min(u + half_x, width - 1.0)) / tile[0] + 1
    y1 = int(wp.min(v + half_y, height - 1.0)) / tile[1] + 1
    key_out[k] = wp.cast(z, wp.int32)
    box_out[k] = wp.vec4us(wp.uint16(x0), wp.uint16(x1), wp.uint16(y0), wp.uint16(y1))
    center_out[k] = wp.vec4(u, v, z, reach)
    shape_out[k] = wp.vec4(b / c, c / det, 1.0 / c, o)
    direction = wp.vec3(0.0, 0.0, 1.0)
    if sh.shape[2] > 1:
        eye = -(m[0, 3] * r0 + m[1, 3] * r1 + m[2, 3] * r2)
        turn = rotation[world % rotation.shape[0], i]
        direction = wp.quat_rotate_inv(turn, wp.normalize(x - eye))
    rgb = sh_color(sh, world % sh.shape[0], i, direction)
    color_out[k] = wp.vec4(rgb[0], rgb[1], rgb[2], 0.0)


@wp.kernel
def cover_tiles(
    order: wp.array[int],  # (>= view_count * splat_count,) splats of each view by depth
    box: wp.array[wp.vec4us],  # (view_count * splat_count,)
    splat_count: int,
    tile_count: wp.vec2i,
    # Out:
    cover_out: wp.array2d[wp.uint32],  # (tiles of all views, words), zeroed
):
    """Set the bit of every depth rank in every tile that the splat touches."""
    view, rank = wp.tid()
    first = view * splat_count
    b = box[first + order[first + rank]]
    word = rank / 32
    bit = wp.uint32(1) << wp.uint32(rank - 32 * word)
    for y in range(int(b[2]), int(b[3])):
        row = (view * tile_count[1] + y) * tile_count[0]
        for x in range(int(b[0]), int(b[1])):
            wp.atomic_or(cover_out, row + x, word, bit)


@functools.cache
def blend_kernel(strip: int, has_mesh: bool, object_ids: bool, median_depth: bool) -> wp.Kernel:
    """Return the blend kernel whose threads own `strip` neighbouring pixels of a row.

    A strip of one is the usual choice on a GPU. On a CPU, where threads run one after another, a strip of a tile's
    width visits only the pixels that a splat covers, and shares a splat's data among them. The arithmetic per pixel
    is the same.
    """
    strip_vec = wp.types.vector(length=strip, dtype=wp.float32)
    strip_int = wp.types.vector(length=strip, dtype=wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def _blend(
        # Bins:
        order: wp.array[int],  # (>= view_count * splat_count,) splats of each view by depth
        cover: wp.array2d[wp.uint32],  # (tile_count over all views, words) bits of depth ranks
        # Projected splats:
        center: wp.array[wp.vec4],
        shape: wp.array[wp.vec4],
        color: wp.array[wp.vec4],
        object_index: wp.array[int],  # (splat_count,)
        # Images in:
        background: wp.array[wp.vec3],  # (1|view_count,)
        mesh_rgb: wp.array3d[wp.vec3],  # (view_count, height, width)
        mesh_depth: wp.array3d[float],  # (view_count, height, width) [m], 0 where there is no mesh
        # Sizes:
        size: wp.vec2i,
        tile_count: wp.vec2i,
        tile: wp.vec2i,
        # Out:
        rgb_out: wp.array3d[wp.vec3],
        depth_out: wp.array3d[float],
        alpha_out: wp.array3d[float],
        object_out: wp.array3d[int],
        median_out: wp.array3d[float],
    ):
        """Blend front to back: C = sum_i c_i alpha_i T_i + T c_behind."""
        thread = wp.tid()
        strips_per_row = tile[0] / strip
        strips_per_tile = strips_per_row * tile[1]
        tile_index = thread / strips_per_tile
        local = thread - tile_index * strips_per_tile
        per_view = tile_count[0] * tile_count[1]
        view = tile_index / per_view
        in_view = tile_index - view * per_view
        row = (in_view / tile_count[0]) * tile[1] + local / strips_per_row
        first = (in_view % tile_count[0]) * tile[0] + (local % strips_per_row) * strip
        if row >= size[1] or first >= size[0]:
            return
        count = wp.min(strip, size[0] - first)
        py = float(row) + 0.5
        left = float(first) + 0.5

        light = strip_vec()  # transmittance; negative once the pixel is finished: -(light + 1)
        red = strip_vec()
        green = strip_vec()
        blue = strip_vec()
        depth = strip_vec()
        best = strip_vec()
        winner = strip_int()
        median = strip_vec()
        limit = strip_vec()
        for p in range(strip):
            light[p] = 1.0
            winner[p] = -1
            limit[p] = 1.0e30
        if wp.static(has_mesh):
            for p in range(count):
                behind = mesh_depth[view, row, first + p]
                if behind > 0.0:
                    limit[p] = behind
        live = wp.int32(count)

        splat_count = object_index.shape[0]
        first_splat = view * splat_count
        word = wp.int32(0)
        bits = wp.uint32(0)
        while live > 0:
            while bits == wp.uint32(0) and word < cover.shape[1]:
                bits = cover[tile_index, word]
                word += 1
            if bits == wp.uint32(0):
                break
            k = first_splat + order[first_splat + 32 * (word - 1) + lowest_bit(bits)]
            bits = bits & (bits - wp.uint32(1))
            g = center[k]
            e = shape[k]
            dy = py - g[1]
            across = 0.5 * e[2] * dy * dy
            if across > g[3]:
                continue
            middle = g[0] + e[0] * dy - left
            begin = wp.int32(0)
            end = wp.int32(count)
            if wp.static(strip > 1):
                half = wp.sqrt(2.0 * (g[3] - across) / e[1]) + 0.001
                begin = wp.max(int(wp.ceil(wp.max(middle - half, -1.0))), 0)
                end = wp.min(int(wp.floor(wp.min(middle + half, float(strip)))) + 1, count)
            for p in range(begin, end):
                t = light[p]
                if t > 0.0:
                    if wp.static(has_mesh):
                        if g[2] > limit[p]:
                            light[p] = -(t + 1.0)
                            live -= 1
                            continue
                    dx = float(p) - middle
                    alpha = wp.min(ALPHA_MAX, e[3] * wp.exp(-0.5 * e[1] * dx * dx - across))
                    if alpha >= ALPHA_MIN:
                        after = t * (1.0 - alpha)
                        if after < TRANSMITTANCE_MIN:
                            light[p] = -(t + 1.0)
                            live -= 1
                        else:
                            weight = alpha * t
                            c = color[k]
                            red[p] += weight * c[0]
                            green[p] += weight * c[1]
                            blue[p] += weight * c[2]
                            depth[p] += weight * g[2]
                            light[p] = after
                            if wp.static(median_depth):
                                if t > 0.5 and after <= 0.5:
                                    median[p] = g[2]
                            if wp.static(object_ids):
                                if weight > best[p]:
                                    best[p] = weight
                                    winner[p] = object_index[k - first_splat]

        for p in range(count):
            t = light[p]
            if t < 0.0:
                t = -t - 1.0
            behind_rgb = wp.vec3()
            total = 1.0 - t
            far = depth[p]
            if wp.static(has_mesh):
                behind_rgb = mesh_rgb[view, row, first + p]
                if limit[p] < 1.0e29:
                    far += t * limit[p]
                    total = 1.0
            else:
                behind_rgb = background[view % background.shape[0]]
            rgb_out[view, row, first + p] = wp.vec3(red[p], green[p], blue[p]) + t * behind_rgb
            alpha_out[view, row, first + p] = 1.0 - t
            depth_out[view, row, first + p] = wp.where(total > 0.0, far / wp.max(total, 1.0e-6), 0.0)
            if wp.static(object_ids):
                object_out[view, row, first + p] = winner[p]
            if wp.static(median_depth):
                middle_depth = median[p]
                if wp.static(has_mesh):
                    if t > 0.5 and limit[p] < 1.0e29:
                        middle_depth = limit[p]
                median_out[view, row, first + p] = middle_depth

    return _blend
