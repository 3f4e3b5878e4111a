"""Device code of `skinning_adjoint`: from the loss by deformed splats to the loss by the reduced coordinates."""

import warp as wp

from softmode.deformables.skinning.skinning_kernels import polar_rotation, symmetric_matrix, vec6

wp.set_module_options({"enable_backward": False})


@wp.func
def stretched_adjoint(f: wp.mat33, limit: float, sigma: wp.mat33, loss: wp.mat33) -> wp.mat33:
    """Return the loss by F from the symmetric one by C Sigma C^T, where C = `limited_stretch(F)` = U min(S, limit) V^T.

    With P = U^T dF V the differential is dC = U (a o sym P + b o skew P) V^T, a_ij = (g_i - g_j) / (s_i - s_j) and
    b_ij = (g_i + g_j) / (s_i + s_j) of g = min(s, limit), and its own transpose: nothing flows along a stretch at the
    limit. In float64, because Warp's decomposition of a float32 matrix leaves residuals of up to 1e-3.
    """
    if wp.ddot(f, f) <= limit * limit:
        return 2.0 * loss * (f * sigma)
    u = wp.mat33d()
    s = wp.vec3d()
    v = wp.mat33d()
    wp.svd3(wp.mat33d(f), u, s, v)
    top = wp.float64(limit)
    g = wp.vec3d(wp.min(s[0], top), wp.min(s[1], top), wp.min(s[2], top))
    cut = wp.mat33(u * wp.diag(g) * wp.transpose(v))
    p = wp.transpose(u) * wp.mat33d(2.0 * loss * (cut * sigma)) * v
    out = wp.mat33d()
    for i in range(3):
        for j in range(3):
            # Both below the limit: one and one.
            a = wp.float64(1.0)
            b = wp.float64(1.0)
            if s[i] > top or s[j] > top:
                a = wp.float64(0.0)
                if wp.min(s[i], s[j]) < top:
                    a = (g[i] - g[j]) / (s[i] - s[j])
                b = (g[i] + g[j]) / wp.max(s[i] + s[j], wp.float64(1.0e-6))
            out[i, j] = wp.float64(0.5) * ((a + b) * p[i, j] + (a - b) * p[j, i])
    return wp.mat33(u * out * wp.transpose(v))


@wp.func
def polar_rotation_adjoint(f: wp.mat33, loss: wp.vec3) -> wp.mat33:
    """Return the loss by F from that by a rotation vector of R in F = R S.

    (tr(S) 1 - S) R^T phi is the axial vector of R^T dF - dF^T R; zero where no rotation is nearest.
    """
    r = wp.quat_to_matrix(polar_rotation(f))
    s = wp.transpose(r) * f
    s = 0.5 * (s + wp.transpose(s))
    k = wp.trace(s) * wp.identity(n=3, dtype=float) - s
    size = wp.sqrt(wp.ddot(f, f))
    if not wp.determinant(k) > 5.0e-7 * size * size * size:
        return wp.mat33()
    return r * wp.skew(wp.inverse(k) * (wp.transpose(r) * loss))


@wp.func
def function_loss(b: wp.vec4, by_mean: wp.vec3, by_gradient: wp.mat33) -> wp.vec3:
    """Return b dL/dx + (dL/dF) grad b."""
    return b[3] * by_mean + by_gradient * wp.vec3(b[0], b[1], b[2])


@wp.kernel
def gradient_adjoint(
    # Object:
    rest_covariance: wp.array[vec6],  # (splat_count,) [m^2]
    basis: wp.array2d[wp.vec4],  # (function_count, splat_count) grad b [1/m], and b less its mean
    stretch_limit: float,
    # State in:
    function_start: wp.array[int],  # (world_count,)
    q_in: wp.array[wp.vec3d],  # [m]
    first_splat: int,
    # Loss by:
    covariance_loss: wp.array2d[vec6],  # (world_count, >= first_splat + splat_count) [1/m^2]
    rotation_loss: wp.array2d[wp.vec3],  # like covariance_loss, or of size zero: none
    # Out:
    gradient_out: wp.array2d[wp.mat33],  # (world_count, splat_count)
):
    """Write the loss by F of every splat: 2 G F Sigma for F Sigma F^T, G symmetric, and that of its rotation."""
    world, i = wp.tid()
    start = function_start[world]
    f = wp.identity(n=3, dtype=float)
    for k in range(basis.shape[0]):
        b = basis[k, i]
        f += wp.outer(wp.vec3(q_in[start + k]), wp.vec3(b[0], b[1], b[2]))
    g = covariance_loss[world, first_splat + i]
    # An off-diagonal entry is stored once and stands for two.
    loss = symmetric_matrix(vec6(g[0], 0.5 * g[1], 0.5 * g[2], g[3], 0.5 * g[4], g[5]))
    loss = stretched_adjoint(f, stretch_limit, symmetric_matrix(rest_covariance[i]), loss)
    if rotation_loss.shape[0] > 0:
        loss += polar_rotation_adjoint(f, rotation_loss[world, first_splat + i])
    gradient_out[world, i] = loss


@wp.kernel
def sum_splats(
    # Object:
    basis: wp.array2d[wp.vec4],  # (function_count, splat_count) grad b [1/m], b less its mean
    mean_basis: wp.array[wp.float64],  # (function_count,)
    # Loss by:
    first_splat: int,
    mean_loss: wp.array2d[wp.vec3],  # (world_count, >= first_splat + splat_count) [1/m]
    gradient_loss: wp.array2d[wp.mat33],  # (world_count, splat_count)
    # Out:
    lane_out: wp.array3d[wp.vec3d],  # (world_count, lane_count, function_count)
):
    """Sum b_k dL/dx + (dL/dF) grad b_k over every lane_count-th splat, for four functions at a time."""
    world, group, lane = wp.tid()
    count = basis.shape[0]
    k0 = 4 * group
    k1 = wp.min(k0 + 1, count - 1)
    k2 = wp.min(k0 + 2, count - 1)
    k3 = wp.min(k0 + 3, count - 1)
    moved = wp.vec3d()
    sum0 = wp.vec3d()
    sum1 = wp.vec3d()
    sum2 = wp.vec3d()
    sum3 = wp.vec3d()
    for i in range(lane, basis.shape[1], lane_out.shape[1]):
        by_mean = mean_loss[world, first_splat + i]
        by_gradient = gradient_loss[world, i]
        moved += wp.vec3d(by_mean)
        sum0 += wp.vec3d(function_loss(basis[k0, i], by_mean, by_gradient))
        sum1 += wp.vec3d(function_loss(basis[k1, i], by_mean, by_gradient))
        sum2 += wp.vec3d(function_loss(basis[k2, i], by_mean, by_gradient))
        sum3 += wp.vec3d(function_loss(basis[k3, i], by_mean, by_gradient))
    # Beyond the last function the last one is written again, with the same number.
    lane_out[world, lane, k0] = sum0 + mean_basis[k0] * moved
    lane_out[world, lane, k1] = sum1 + mean_basis[k1] * moved
    lane_out[world, lane, k2] = sum2 + mean_basis[k2] * moved
    lane_out[world, lane, k3] = sum3 + mean_basis[k3] * moved


@wp.kernel
def add_lanes(
    lane: wp.array3d[wp.vec3d],  # (world_count, lane_count, function_count)
    function_start: wp.array[int],  # (world_count,)
    # Out, added to:
    q_out: wp.array[wp.vec3d],
):
    """Sum the lanes in their order and add to the loss by q."""
    world, k = wp.tid()
    total = wp.vec3d()
    for i in range(lane.shape[1]):
        total += lane[world, i, k]
    wp.atomic_add(q_out, function_start[world] + k, total)
