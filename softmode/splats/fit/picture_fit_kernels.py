"""Device code of `picture_fit`: parameters to splats, the loss, and a step of selective Adam."""

import warp as wp

from softmode.splats.raster.rasterizer_kernels import vec6

wp.set_module_options({"enable_backward": False})

vec13 = wp.types.vector(length=13, dtype=wp.float32)
"""One splat's parameters: centre, rotation vector, log-scales, logit of the opacity, colour coefficient."""

BETA_1 = wp.constant(0.9)
BETA_2 = wp.constant(0.999)
EPSILON = wp.constant(1.0e-15)
LOGIT_MAX = wp.constant(6.0)


@wp.kernel
def compose_splats(
    # Parameters, (splat_count,):
    center: wp.array[wp.vec3],
    quat: wp.array[wp.quat],
    log_scale: wp.array[wp.vec3],
    logit: wp.array[float],
    color: wp.array[wp.vec3],
    # Out, as `SplatArrays` of one world:
    mean_out: wp.array2d[wp.vec3],
    covariance_out: wp.array2d[vec6],
    opacity_out: wp.array2d[float],
    sh_out: wp.array3d[wp.vec3],
):
    """Covariance R diag(exp(2 l)) R^T and opacity 1 / (1 + exp(-x))."""
    i = wp.tid()
    l = log_scale[i]
    m = wp.quat_to_matrix(quat[i]) * wp.diag(wp.vec3(wp.exp(l[0]), wp.exp(l[1]), wp.exp(l[2])))
    s = m * wp.transpose(m)
    mean_out[0, i] = center[i]
    covariance_out[0, i] = vec6(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])
    opacity_out[0, i] = 1.0 / (1.0 + wp.exp(-logit[i]))
    sh_out[0, i, 0] = color[i]


@wp.func
def parameter_gradient(
    quat: wp.quat,
    log_scale: wp.vec3,
    logit: float,
    by_mean: wp.vec3,
    by_covariance: vec6,  # entries off the diagonal are stored once and stand for two
    by_opacity: float,
    by_sh: wp.vec3,
) -> vec13:
    """Adjoint of `compose_splats`; the rotation's part is by w at w = 0 in R' = exp([w]) R.

    With S = M M^T, M = R diag(s) and the symmetric G = dL/dS: dL/dM = 2 G M.
    """
    r = wp.quat_to_matrix(quat)
    g = by_covariance
    sym = wp.mat33(
        g[0], 0.5 * g[1], 0.5 * g[2],
        0.5 * g[1], g[3], 0.5 * g[4],
        0.5 * g[2], 0.5 * g[4], g[5],
    )  # fmt: skip
    turn = wp.vec3()
    stretch = wp.vec3()
    for k in range(3):
        axis = wp.vec3(r[0, k], r[1, k], r[2, k])
        s = wp.exp(log_scale[k])
        by_axis = 2.0 * s * s * (sym * axis)
        stretch[k] = wp.dot(axis, by_axis)
        turn += wp.cross(axis, by_axis)
    o = 1.0 / (1.0 + wp.exp(-logit))
    return vec13(
        by_mean[0], by_mean[1], by_mean[2], turn[0], turn[1], turn[2], stretch[0], stretch[1], stretch[2],
        by_opacity * o * (1.0 - o), by_sh[0], by_sh[1], by_sh[2],
    )  # fmt: skip


@wp.kernel
def image_loss(
    rgb: wp.array3d[wp.vec3],  # (B, height, width) as rendered before the background
    reference_rgb: wp.array3d[wp.vec3],  # (V, height, width) colour times coverage
    reference_alpha: wp.array3d[float],  # (V, height, width)
    chosen: wp.array[int],  # (B,) reference of each view
    background: wp.array[wp.vec3],  # (B,)
    scale: float,
    # Out:
    loss_rgb_out: wp.array3d[wp.vec3],  # gradient by rgb
    loss_out: wp.array[wp.float64],  # (1,) added to
):
    """Squared difference to the reference before the same background."""
    view, row, column = wp.tid()
    v = chosen[view]
    target = reference_rgb[v, row, column] + (1.0 - reference_alpha[v, row, column]) * background[view]
    d = rgb[view, row, column] - target
    loss_rgb_out[view, row, column] = 2.0 * scale * d
    wp.atomic_add(loss_out, 0, wp.float64(scale * wp.dot(d, d)))


@wp.kernel
def adam_step(
    # Gradients, as `SplatArrays` of one world:
    by_mean: wp.array2d[wp.vec3],
    by_covariance: wp.array2d[vec6],
    by_opacity: wp.array2d[float],
    by_sh: wp.array3d[wp.vec3],
    # Options:
    rate: vec13,
    log_scale_min: wp.vec3,
    log_scale_max: wp.vec3,
    # Parameters and moments, (splat_count,):
    center: wp.array[wp.vec3],
    quat: wp.array[wp.quat],
    log_scale: wp.array[wp.vec3],
    logit: wp.array[float],
    color: wp.array[wp.vec3],
    first: wp.array[vec13],
    second: wp.array[vec13],
    count: wp.array[int],  # steps taken
):
    """Adam (Kingma and Ba 2015) for the splats that the views of this step show; the others stay as they are."""
    i = wp.tid()
    g = parameter_gradient(
        quat[i], log_scale[i], logit[i], by_mean[0, i], by_covariance[0, i], by_opacity[0, i], by_sh[0, i, 0]
    )
    size = wp.dot(g, g)
    if not (size > 0.0 and size < 1.0e30):
        return
    n = count[i] + 1
    count[i] = n
    m = BETA_1 * first[i] + (1.0 - BETA_1) * g
    v = BETA_2 * second[i] + (1.0 - BETA_2) * wp.cw_mul(g, g)
    first[i] = m
    second[i] = v
    unbias_1 = 1.0 / (1.0 - wp.pow(BETA_1, float(n)))
    unbias_2 = 1.0 / (1.0 - wp.pow(BETA_2, float(n)))
    d = vec13()
    for k in range(13):
        d[k] = -rate[k] * unbias_1 * m[k] / (wp.sqrt(unbias_2 * v[k]) + EPSILON)
    center[i] = center[i] + wp.vec3(d[0], d[1], d[2])
    turn = wp.vec3(d[3], d[4], d[5])
    angle = wp.length(turn)
    if angle > 0.0:
        quat[i] = wp.normalize(wp.quat_from_axis_angle(turn / angle, angle) * quat[i])
    l = log_scale[i] + wp.vec3(d[6], d[7], d[8])
    log_scale[i] = wp.min(wp.max(l, log_scale_min), log_scale_max)
    logit[i] = wp.clamp(logit[i] + d[9], -LOGIT_MAX, LOGIT_MAX)
    color[i] = color[i] + wp.vec3(d[10], d[11], d[12])
