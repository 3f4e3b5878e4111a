"""Device code of `skinning_adjoint`: from the loss by deformed splats to the loss by the reduced coordinates."""

import warp as wp

from softmode.deformables.skinning_kernels import polar_rotation, symmetric_matrix, vec6

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


@wp.kernel
def gradient_adjoint(
    # Object:
    rest_covariance: wp.array[vec6],  # (splat_count,) [m^2]
    basis: wp.array2d[wp.vec4],  # (splat_count, function_count) grad b [1/m], b
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
    r0 = wp.vec3(1.0, 0.0, 0.0)
    r1 = wp.vec3(0.0, 1.0, 0.0)
    r2 = wp.vec3(0.0, 0.0, 1.0)
    for k in range(basis.shape[1]):
        b = basis[i, k]
        q = q_in[start + k]
        gradient = wp.vec3(b[0], b[1], b[2])
        r0 += float(q[0]) * gradient
        r1 += float(q[1]) * gradient
        r2 += float(q[2]) * gradient
    f = wp.matrix_from_rows(r0, r1, r2)
    g = covariance_loss[world, first_splat + i]
    # An off-diagonal entry is stored once and stands for two.
    loss = symmetric_matrix(vec6(g[0], 0.5 * g[1], 0.5 * g[2], g[3], 0.5 * g[4], g[5]))
    loss = stretched_adjoint(f, stretch_limit, symmetric_matrix(rest_covariance[i]), loss)
    if rotation_loss.shape[0] > 0:
        loss += polar_rotation_adjoint(f, rotation_loss[world, first_splat + i])
    gradient_out[world, i] = loss


@wp.kernel
def sum_chunks(
    # Object:
    basis: wp.array2d[wp.vec4],  # (splat_count, function_count)
    # Loss by:
    first_splat: int,
    mean_loss: wp.array2d[wp.vec3],  # (world_count, >= first_splat + splat_count) [1/m]
    gradient_loss: wp.array2d[wp.mat33],  # (world_count, splat_count)
    # Out:
    chunk_out: wp.array3d[wp.vec3d],  # (world_count, chunk_count, function_count)
):
    """Sum b_k dL/dx + dL/dF grad b_k over a chunk of splats in their order."""
    world, chunk, k = wp.tid()
    size = (basis.shape[0] + chunk_out.shape[1] - 1) / chunk_out.shape[1]
    total = wp.vec3d()
    for i in range(chunk * size, wp.min((chunk + 1) * size, basis.shape[0])):
        b = basis[i, k]
        part = b[3] * mean_loss[world, first_splat + i] + gradient_loss[world, i] * wp.vec3(b[0], b[1], b[2])
        total += wp.vec3d(wp.float64(part[0]), wp.float64(part[1]), wp.float64(part[2]))
    chunk_out[world, chunk, k] = total


@wp.kernel
def add_chunks(
    chunk: wp.array3d[wp.vec3d],  # (world_count, chunk_count, function_count)
    function_start: wp.array[int],  # (world_count,)
    # Out, added to:
    q_out: wp.array[wp.vec3d],
):
    """Sum the chunks in their order and add to the loss by q."""
    world, k = wp.tid()
    total = wp.vec3d()
    for c in range(chunk.shape[1]):
        total += chunk[world, c, k]
    wp.atomic_add(q_out, function_start[world] + k, total)
