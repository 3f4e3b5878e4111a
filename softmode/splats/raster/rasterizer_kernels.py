"""Device code of `rasterizer`: projection, and the tiles that splats cover."""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""Symmetric matrix: xx, xy, xz, yy, yz, zz."""

TILE = wp.constant(8)
"""Edge of the tiles that list splats [px]."""
ALPHA_MIN = wp.constant(1.0 / 255.0)
ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
FAR_KEY = wp.constant(0x7F800000)
IMAGE_MARGIN = wp.constant(0.15)
"""Share of the image beyond each of its edges at which splats are linearised."""


@wp.struct
class Frame:
    """What a blend and its adjoint read: the projected splats of all views, the bits of the tiles, what is behind."""

    order: wp.array[int]  # (>= view_count * splat_count,) splats of each view by depth
    cover: wp.array2d[wp.uint32]  # (tiles of all views, words) bits of depth ranks
    center: wp.array[wp.vec4]  # (view_count * splat_count,), as `project` writes them
    shape: wp.array[wp.vec4]
    color: wp.array[wp.vec4]
    background: wp.array[wp.vec3]  # (1|view_count,)
    mesh_rgb: wp.array3d[wp.vec3]  # (view_count, height, width)
    mesh_depth: wp.array3d[float]  # (view_count, height, width) [m], 0 where there is no mesh
    splat_count: int
    size: wp.vec2i
    tile_count: wp.vec2i


@wp.struct
class ImageLoss:
    """Images as rendered and the loss by them, shape (view_count, height, width); of size zero where not asked for."""

    depth: wp.array3d[float]  # [m]
    alpha: wp.array3d[float]
    loss_rgb: wp.array3d[wp.vec3]
    loss_alpha: wp.array3d[float]
    loss_depth: wp.array3d[float]  # [1/m]


@wp.func
def row_of(world: int, rows: int):
    """Return the row of a table with one row for all worlds or one for each."""
    return wp.where(rows == 1, 0, world)


@wp.func
def asked_of_pixel(frame: Frame, images: ImageLoss, view: int, row: int, column: int, limit: float):
    """Return the loss by light that passes all splats, that by the sum of weighted depths, and the depth that is seen.

    The weights of a depth sum to its total, so depth may be counted from what is seen: exact, and free of the
    difference between a sum and its total times the mean. Losses of size zero are not asked for; `limit` is the depth
    of the mesh, 1e30 without.
    """
    background = frame.background[view % frame.background.shape[0]]
    if frame.mesh_rgb.shape[0] > 0:
        background = frame.mesh_rgb[view, row, column]
    behind = wp.dot(images.loss_rgb[view, row, column], background)
    if images.loss_alpha.shape[0] > 0:
        behind -= images.loss_alpha[view, row, column]
    far = float(0.0)
    seen = float(0.0)
    if images.loss_depth.shape[0] > 0:
        seen = images.depth[view, row, column]
        total = wp.where(limit < 1.0e29, 1.0, images.alpha[view, row, column])
        if total > 0.0:
            far = images.loss_depth[view, row, column] / wp.max(total, 1.0e-6)
        if limit < 1.0e29:
            behind += far * (limit - seen)
    return behind, far, seen


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


@wp.func
def clamp_slope(slope: float, focal: float, center: float, size: float) -> float:
    """Clamp x/z or y/z to a little more than the image, whose edges lie at -center/focal and (size - center)/focal."""
    margin = IMAGE_MARGIN * size
    return wp.clamp(slope, -(center + margin) / focal, (size - center + margin) / focal)


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
    splat_gain: wp.array[wp.vec4],  # (1|view_count,) factor on colour and opacity
    # Options:
    size: wp.vec2i,
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

    The completed square gives the span of a pixel row directly. The antialiased opacity needs ac - b^2, which cancels
    for needles: covariances in float32 carry it to 1e-4 of the opacity for lengths up to 200 times the thickness.
    """
    k = wp.tid()  # of one dimension: Warp divides by a second one in 64 bits, a tenth of this kernel on CUDA
    view = k / mean.shape[1]
    i = k - view * mean.shape[1]
    world = view_world[view]
    key_out[k] = FAR_KEY
    order_out[k] = i
    box_out[k] = wp.vec4us()
    m = world_to_camera[view]
    x = mean[row_of(world, mean.shape[0]), i]
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
    slope = wp.vec2(clamp_slope(px, lens[0], lens[2], width), clamp_slope(py, lens[1], lens[3], height))
    j0 = (lens[0] / z) * (r0 - slope[0] * r2)
    j1 = (lens[1] / z) * (r1 - slope[1] * r2)
    s = covariance[row_of(world, covariance.shape[0]), i]
    sigma = wp.mat33(s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5])
    s0 = sigma * j0
    a = wp.dot(j0, s0)
    b = wp.dot(j1, s0)
    c = wp.dot(j1, sigma * j1)
    gain = splat_gain[row_of(view, splat_gain.shape[0])]
    o = gain[3] * opacity[row_of(world, opacity.shape[0]), i]
    if o > 1.0:  # wp.min would make 1 of NaN
        o = 1.0
    sharp = wp.max(a * c - b * b, 0.0)
    a += dilation
    c += dilation
    det = a * c - b * b
    if not (det > 0.0 and c > 0.0):
        return
    if antialiased:
        o *= wp.sqrt(sharp / det)
    if not (o >= ALPHA_MIN):
        return
    # Opacity-aware extent: alpha falls to 1/255 where d^2/2 = ln(255 o).
    reach = wp.log(255.0 * o)
    u = lens[0] * px + lens[2]
    v = lens[1] * py + lens[3]
    half_x = wp.sqrt(2.0 * reach * a)
    half_y = wp.sqrt(2.0 * reach * c)
    if u + half_x < 0.0 or u - half_x > width or v + half_y < 0.0 or v - half_y > height:
        return
    x0 = int(wp.max(u - half_x, 0.0)) / TILE
    y0 = int(wp.max(v - half_y, 0.0)) / TILE
    x1 = int(wp.min(u + half_x, width - 1.0)) / TILE + 1
    y1 = int(wp.min(v + half_y, height - 1.0)) / TILE + 1
    key_out[k] = wp.cast(z, wp.int32)
    box_out[k] = wp.vec4us(wp.uint16(x0), wp.uint16(x1), wp.uint16(y0), wp.uint16(y1))
    center_out[k] = wp.vec4(u, v, z, reach)
    shape_out[k] = wp.vec4(b / c, c / det, 1.0 / c, o)
    direction = wp.vec3(0.0, 0.0, 1.0)
    if sh.shape[2] > 1:
        eye = -(m[0, 3] * r0 + m[1, 3] * r1 + m[2, 3] * r2)
        turn = rotation[row_of(world, rotation.shape[0]), i]
        direction = wp.quat_rotate_inv(turn, wp.normalize(x - eye))
    rgb = sh_color(sh, row_of(world, sh.shape[0]), i, direction)
    color_out[k] = wp.vec4(gain[0] * rgb[0], gain[1] * rgb[1], gain[2] * rgb[2], 0.0)


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
    thread = wp.tid()
    view = thread / splat_count
    first = view * splat_count
    rank = thread - first
    b = box[first + order[thread]]
    word = rank / 32
    bit = wp.uint32(1) << wp.uint32(rank - 32 * word)
    for y in range(int(b[2]), int(b[3])):
        row = (view * tile_count[1] + y) * tile_count[0]
        for x in range(int(b[0]), int(b[1])):
            wp.atomic_or(cover_out, row + x, word, bit)
