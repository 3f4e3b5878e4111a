"""Device code of `rasterizer_adjoint`: from projected splats to splats and cameras, and from images to backgrounds."""

import warp as wp

from softmode.splats.raster.rasterizer_kernels import clamp_slope, row_of, vec6

wp.set_module_options({"enable_backward": False})

vec10 = wp.types.vector(length=10, dtype=wp.float32)
"""Loss by a view's twist (v, w) and intrinsics (fx, fy, cx, cy)."""
vec10d = wp.types.vector(length=10, dtype=wp.float64)


@wp.func
def sh_term(
    sh: wp.array3d[wp.vec3],
    w: int,
    i: int,
    k: int,
    loss: wp.vec3,
    value: float,
    slope: wp.vec3,
    sh_out: wp.array3d[wp.vec3],
) -> wp.vec3:
    """Add the loss by coefficient k, whose harmonic has this value and slope; return the loss by the direction."""
    wp.atomic_add(sh_out, w, i, k, value * loss)
    return wp.dot(sh[w, i, k], loss) * slope


@wp.func
def sh_adjoint(
    sh: wp.array3d[wp.vec3], w: int, i: int, d: wp.vec3, loss: wp.vec3, sh_out: wp.array3d[wp.vec3]
) -> wp.vec3:
    """Add the loss by the coefficients of one splat, and return the loss by the direction d."""
    out = wp.vec3()
    wp.atomic_add(sh_out, w, i, 0, 0.28209479177387814 * loss)
    count = sh.shape[2]
    if count > 1:
        x = d[0]
        y = d[1]
        z = d[2]
        c = 0.4886025119029199
        out += sh_term(sh, w, i, 1, loss, -c * y, wp.vec3(0.0, -c, 0.0), sh_out)
        out += sh_term(sh, w, i, 2, loss, c * z, wp.vec3(0.0, 0.0, c), sh_out)
        out += sh_term(sh, w, i, 3, loss, -c * x, wp.vec3(-c, 0.0, 0.0), sh_out)
        if count > 4:
            xx = x * x
            yy = y * y
            zz = z * z
            c = 1.0925484305920792
            out += sh_term(sh, w, i, 4, loss, c * x * y, c * wp.vec3(y, x, 0.0), sh_out)
            out += sh_term(sh, w, i, 5, loss, -c * y * z, -c * wp.vec3(0.0, z, y), sh_out)
            out += sh_term(sh, w, i, 7, loss, -c * x * z, -c * wp.vec3(z, 0.0, x), sh_out)
            c = 0.31539156525252005
            slope = 2.0 * c * wp.vec3(-x, -y, 2.0 * z)
            out += sh_term(sh, w, i, 6, loss, c * (2.0 * zz - xx - yy), slope, sh_out)
            c = 0.5462742152960396
            out += sh_term(sh, w, i, 8, loss, c * (xx - yy), 2.0 * c * wp.vec3(x, -y, 0.0), sh_out)
            if count > 9:
                c = -0.5900435899266435
                slope = 3.0 * c * wp.vec3(2.0 * x * y, xx - yy, 0.0)
                out += sh_term(sh, w, i, 9, loss, c * y * (3.0 * xx - yy), slope, sh_out)
                slope = 3.0 * c * wp.vec3(xx - yy, -2.0 * x * y, 0.0)
                out += sh_term(sh, w, i, 15, loss, c * x * (xx - 3.0 * yy), slope, sh_out)
                c = 2.890611442640554
                out += sh_term(sh, w, i, 10, loss, c * x * y * z, c * wp.vec3(y * z, x * z, x * y), sh_out)
                c = -0.4570457994644658
                slope = c * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
                out += sh_term(sh, w, i, 11, loss, c * y * (4.0 * zz - xx - yy), slope, sh_out)
                slope = c * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
                out += sh_term(sh, w, i, 13, loss, c * x * (4.0 * zz - xx - yy), slope, sh_out)
                c = 0.3731763325901154
                slope = 3.0 * c * wp.vec3(-2.0 * x * z, -2.0 * y * z, 2.0 * zz - xx - yy)
                out += sh_term(sh, w, i, 12, loss, c * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), slope, sh_out)
                c = 1.445305721320277
                slope = c * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
                out += sh_term(sh, w, i, 14, loss, c * z * (xx - yy), slope, sh_out)
    return out


@wp.kernel
def project_adjoint(
    # Splats, as in `project`:
    mean: wp.array2d[wp.vec3],
    covariance: wp.array2d[vec6],
    opacity: wp.array2d[float],
    sh: wp.array3d[wp.vec3],
    rotation: wp.array2d[wp.quat],
    # Views:
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    view_world: wp.array[int],
    splat_gain: wp.array[wp.vec4],
    # Options:
    size: wp.vec2i,
    dilation: float,
    antialiased: bool,
    with_camera: bool,
    # Projected splats and the loss by them, (view_count * splat_count,):
    color: wp.array[wp.vec4],
    center_loss: wp.array[wp.vec4],
    shape_loss: wp.array[wp.vec4],
    color_loss: wp.array[wp.vec3],
    # Out, added to; shapes of the splats' own arrays:
    mean_out: wp.array2d[wp.vec3],
    covariance_out: wp.array2d[vec6],
    opacity_out: wp.array2d[float],
    sh_out: wp.array3d[wp.vec3],
    rotation_out: wp.array2d[wp.vec3],
    # Out, written:
    camera_out: wp.array2d[vec10],  # (view_count, splat_count), or (1, 1) without the camera
):
    """Carry the loss by center, shape and colour of a projected splat to the splat and to its view."""
    view, i = wp.tid()
    k = view * mean.shape[1] + i
    if with_camera:
        camera_out[view, i] = vec10()
    by_center = center_loss[k]
    by_shape = shape_loss[k]
    by_color = color_loss[k]
    if by_center == wp.vec4() and by_shape == wp.vec4() and by_color == wp.vec3():
        return
    world = view_world[view]
    m = world_to_camera[view]
    x = mean[row_of(world, mean.shape[0]), i]
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    z = wp.dot(r2, x) + m[2, 3]
    px = (wp.dot(r0, x) + m[0, 3]) / z
    py = (wp.dot(r1, x) + m[1, 3]) / z
    lens = intrinsics[view]
    tx = clamp_slope(px, lens[0], lens[2], float(size[0]))
    ty = clamp_slope(py, lens[1], lens[3], float(size[1]))
    d0 = r0 - tx * r2
    d1 = r1 - ty * r2
    j0 = (lens[0] / z) * d0
    j1 = (lens[1] / z) * d1
    s = covariance[row_of(world, covariance.shape[0]), i]
    sigma = wp.mat33(s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5])
    s0 = sigma * j0
    s1 = sigma * j1
    a0 = wp.dot(j0, s0)
    b = wp.dot(j1, s0)
    c0 = wp.dot(j1, s1)
    a = a0 + dilation
    c = c0 + dilation
    det = a * c - b * b

    # Shape to image covariance: slope = b/c, e1 = 1/(a - b^2/c), e2 = 1/c.
    slope = b / c
    e1 = c / det
    e2 = 1.0 / c
    schur = -e1 * e1 * by_shape[1]
    by_a = schur
    by_b = -2.0 * slope * schur + e2 * by_shape[0]
    by_c = slope * slope * schur - slope * e2 * by_shape[0] - e2 * e2 * by_shape[2]
    by_o = by_shape[3]
    gain = splat_gain[row_of(view, splat_gain.shape[0])]
    gained = gain[3] * opacity[row_of(world, opacity.shape[0]), i]
    if antialiased:
        # o = min(gain opacity, 1) sqrt(sharp / det)
        sharp = wp.max(a0 * c0 - b * b, 0.0)
        share = wp.sqrt(sharp / det)
        if sharp > 0.0:
            half = 0.5 * by_o * wp.min(gained, 1.0) * share
            by_a += half * (c0 / sharp - c / det)
            by_b += -2.0 * half * b * (1.0 / sharp - 1.0 / det)
            by_c += half * (a0 / sharp - a / det)
        by_o *= share
    if gained <= 1.0:
        wp.atomic_add(opacity_out, row_of(world, opacity_out.shape[0]), i, gain[3] * by_o)

    # Image covariance to covariance and Jacobian: a = j0 S j0, b = j0 S j1, c = j1 S j1. Off-diagonal entries are
    # stored once and stand for two.
    by_sigma = vec6(
        by_a * j0[0] * j0[0] + by_b * j0[0] * j1[0] + by_c * j1[0] * j1[0],
        2.0 * by_a * j0[0] * j0[1] + by_b * (j0[0] * j1[1] + j0[1] * j1[0]) + 2.0 * by_c * j1[0] * j1[1],
        2.0 * by_a * j0[0] * j0[2] + by_b * (j0[0] * j1[2] + j0[2] * j1[0]) + 2.0 * by_c * j1[0] * j1[2],
        by_a * j0[1] * j0[1] + by_b * j0[1] * j1[1] + by_c * j1[1] * j1[1],
        2.0 * by_a * j0[1] * j0[2] + by_b * (j0[1] * j1[2] + j0[2] * j1[1]) + 2.0 * by_c * j1[1] * j1[2],
        by_a * j0[2] * j0[2] + by_b * j0[2] * j1[2] + by_c * j1[2] * j1[2],
    )
    wp.atomic_add(covariance_out, row_of(world, covariance_out.shape[0]), i, by_sigma)
    by_j0 = 2.0 * by_a * s0 + by_b * s1
    by_j1 = by_b * s0 + 2.0 * by_c * s1

    # Jacobian and centre to the point in the camera's frame; where the Jacobian is clamped, tx does not move with it.
    by_z = by_center[2] - (wp.dot(by_j0, j0) + wp.dot(by_j1, j1)) / z
    by_tx = -(lens[0] / z) * wp.dot(by_j0, r2)
    by_ty = -(lens[1] / z) * wp.dot(by_j1, r2)
    by_px = lens[0] * by_center[0]
    by_py = lens[1] * by_center[1]
    by_fx = px * by_center[0] + wp.dot(by_j0, d0) / z
    by_fy = py * by_center[1] + wp.dot(by_j1, d1) / z
    by_cx = by_center[0]
    by_cy = by_center[1]
    if tx == px:
        by_px += by_tx
    else:
        by_fx -= by_tx * tx / lens[0]
        by_cx -= by_tx / lens[0]
    if ty == py:
        by_py += by_ty
    else:
        by_fy -= by_ty * ty / lens[1]
        by_cy -= by_ty / lens[1]
    by_z -= (by_px * px + by_py * py) / z
    by_point = wp.vec3(by_px / z, by_py / z, by_z)
    by_mean = by_point[0] * r0 + by_point[1] * r1 + by_point[2] * r2

    # Colour, which is cut at zero, and the direction it is seen from.
    shown = color[k]
    for channel in range(3):
        by_color[channel] = wp.where(shown[channel] > 0.0, gain[channel] * by_color[channel], 0.0)
    direction = wp.vec3(0.0, 0.0, 1.0)
    sight = wp.vec3()
    distance = float(1.0)
    turn = wp.quat()
    if sh.shape[2] > 1:
        eye = -(m[0, 3] * r0 + m[1, 3] * r1 + m[2, 3] * r2)
        turn = rotation[row_of(world, rotation.shape[0]), i]
        distance = wp.length(x - eye)
        sight = (x - eye) / distance
        direction = wp.quat_rotate_inv(turn, sight)
    by_direction = sh_adjoint(sh, row_of(world, sh.shape[0]), i, direction, by_color, sh_out)
    by_offset = wp.vec3()
    if sh.shape[2] > 1:
        by_sight = wp.quat_rotate(turn, by_direction)
        by_offset = (by_sight - wp.dot(by_sight, sight) * sight) / distance
        by_mean += by_offset
        wp.atomic_add(rotation_out, row_of(world, rotation_out.shape[0]), i, wp.cross(by_sight, sight))
    wp.atomic_add(mean_out, row_of(world, mean_out.shape[0]), i, by_mean)

    if with_camera:
        # exp of the twist (v, w) acts from the left: points of the camera's frame move by v + w x p, the rows of the
        # Jacobian turn, and the eye moves by -R^T v.
        point = wp.vec3(px * z, py * z, z)
        v = by_point + wp.vec3(wp.dot(r0, by_offset), wp.dot(r1, by_offset), wp.dot(r2, by_offset))
        turned0 = wp.vec3(wp.dot(r0, by_j0), wp.dot(r1, by_j0), wp.dot(r2, by_j0))
        turned1 = wp.vec3(wp.dot(r0, by_j1), wp.dot(r1, by_j1), wp.dot(r2, by_j1))
        w = wp.cross(point, by_point)
        w += wp.cross(turned0, (lens[0] / z) * wp.vec3(1.0, 0.0, -tx))
        w += wp.cross(turned1, (lens[1] / z) * wp.vec3(0.0, 1.0, -ty))
        camera_out[view, i] = vec10(
            v[0], v[1], v[2], w[0], w[1], w[2], by_fx, by_fy, by_cx, by_cy
        )  # fmt: skip


@wp.kernel
def camera_adjoint(
    camera: wp.array2d[vec10],  # (view_count, splat_count)
    lanes: int,
    # Out, added to:
    twist_out: wp.array[wp.spatial_vectord],  # (view_count,)
    intrinsics_out: wp.array[wp.vec4d],  # (view_count,)
):
    """Sum over the splats of a view, in float64; each lane strides over them."""
    view, lane = wp.tid()
    total = vec10d()
    for i in range(lane, camera.shape[1], lanes):
        part = camera[view, i]
        for entry in range(10):
            total[entry] += wp.float64(part[entry])
    wp.atomic_add(twist_out, view, wp.spatial_vectord(total[0], total[1], total[2], total[3], total[4], total[5]))
    wp.atomic_add(intrinsics_out, view, wp.vec4d(total[6], total[7], total[8], total[9]))


@wp.kernel
def background_adjoint(
    alpha: wp.array3d[float],  # (view_count, height, width) as rendered
    loss_rgb: wp.array3d[wp.vec3],  # (view_count, height, width)
    lanes: int,
    # Out, added to:
    background_out: wp.array[wp.vec3d],  # (1|view_count,)
):
    """Sum (1 - alpha) dL/drgb; each lane strides over the rows of pixels."""
    view, lane = wp.tid()
    total = wp.vec3d()
    for y in range(lane, alpha.shape[1], lanes):
        for x in range(alpha.shape[2]):
            loss = (1.0 - alpha[view, y, x]) * loss_rgb[view, y, x]
            total += wp.vec3d(wp.float64(loss[0]), wp.float64(loss[1]), wp.float64(loss[2]))
    wp.atomic_add(background_out, view % background_out.shape[0], total)
