"""Device code of `skinning`: points, and splat means with F Sigma F^T, from the reduced coordinates."""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""Symmetric matrix: xx, xy, xz, yy, yz, zz."""


@wp.func
def symmetric_matrix(c: vec6) -> wp.mat33:
    """Return the full matrix of the six entries xx, xy, xz, yy, yz, zz."""
    return wp.mat33(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5])


@wp.func
def limited_stretch(f: wp.mat33, limit: float) -> wp.mat33:
    """Return F with its singular values cut to at most `limit`.

    Where a coarse basis shears or tears, single splats would be drawn out into spikes across the picture. Compression
    needs no limit: a flattened splat only covers less. The Frobenius norm bounds the largest singular value, so the
    decomposition is skipped for all but strongly stretched splats.
    """
    if wp.ddot(f, f) <= limit * limit:
        return f
    u = wp.mat33()
    s = wp.vec3()
    v = wp.mat33()
    wp.svd3(f, u, s, v)
    s = wp.vec3(wp.min(s[0], limit), wp.min(s[1], limit), wp.min(s[2], limit))
    return u * wp.diag(s) * wp.transpose(v)


@wp.kernel
def skin_splats(
    # Object:
    rest_mean: wp.array[wp.vec3],  # (splat_count,) [m]
    rest_covariance: wp.array[vec6],  # (splat_count,) [m^2]
    basis: wp.array2d[wp.vec4],  # (splat_count, function_count) grad b [1/m], b
    stretch_limit: float,
    # State in:
    function_start: wp.array[int],  # (world_count,) first entry of q of the object's instance in each world
    q_in: wp.array[wp.vec3d],  # [m]
    # Out:
    first_splat: int,
    mean_out: wp.array2d[wp.vec3],  # (world_count, >= first_splat + splat_count) [m]
    covariance_out: wp.array2d[vec6],  # (world_count, >= first_splat + splat_count) [m^2]
):
    """Compute x = X + sum_k b_k q_k and F Sigma F^T."""
    world, i = wp.tid()
    start = function_start[world]
    rest = rest_mean[i]
    x = wp.float64(rest[0])
    y = wp.float64(rest[1])
    z = wp.float64(rest[2])
    r0 = wp.vec3(1.0, 0.0, 0.0)
    r1 = wp.vec3(0.0, 1.0, 0.0)
    r2 = wp.vec3(0.0, 0.0, 1.0)
    for k in range(basis.shape[1]):
        b = basis[i, k]
        q = q_in[start + k]
        value = wp.float64(b[3])
        x += value * q[0]
        y += value * q[1]
        z += value * q[2]
        gradient = wp.vec3(b[0], b[1], b[2])
        r0 += float(q[0]) * gradient
        r1 += float(q[1]) * gradient
        r2 += float(q[2]) * gradient
    f = limited_stretch(wp.matrix_from_rows(r0, r1, r2), stretch_limit)
    s = f * symmetric_matrix(rest_covariance[i]) * wp.transpose(f)
    mean_out[world, first_splat + i] = wp.vec3(float(x), float(y), float(z))
    covariance_out[world, first_splat + i] = vec6(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])


@wp.kernel
def mean_rotation(
    # Object:
    mean_gradient: wp.array[wp.vec3],  # (function_count,) grad b averaged over the splats [1/m]
    # State in:
    function_start: wp.array[int],  # (world_count,)
    q_in: wp.array[wp.vec3d],  # [m]
    # Out:
    object_index: int,
    rotation_out: wp.array2d[wp.quat],  # (world_count, object_count)
):
    """Extract the rotation of the object's mean deformation gradient by Higham's polar iteration."""
    world = wp.tid()
    start = function_start[world]
    f = wp.identity(n=3, dtype=float)
    for k in range(mean_gradient.shape[0]):
        q = q_in[start + k]
        f += wp.outer(wp.vec3(float(q[0]), float(q[1]), float(q[2])), mean_gradient[k])
    for _ in range(12):
        if wp.determinant(f) > 1.0e-6:
            f = 0.5 * (f + wp.transpose(wp.inverse(f)))
    rotation_out[world, object_index] = wp.normalize(wp.quat_from_matrix(f))
