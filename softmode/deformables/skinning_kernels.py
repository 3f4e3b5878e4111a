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


@wp.func
def polar_rotation(f: wp.mat33) -> wp.quat:
    """Return the rotation R of F = R S that is nearest to F, as a quaternion; proper for inverted F too.

    R is the derivative of the nuclear norm l = s1 + s2 + s3 (s3 < 0 where F is inverted), and l is the largest root of
    l^4 - 2 |F|^2 l^2 - 8 det(F) l + |F|^4 - 4 |cof F|^2 (Higham and Noferini 2016, DOI 10.1007/s11075-016-0098-7). So

        R = ((l^2 + |F|^2) F + 2 l cof F - 2 F F^T F) / (l^3 - |F|^2 l - 2 det F)

    (Lin, Chitalu and Komura 2022, DOI 10.1145/3550454.3555507). Started above the largest root, Laguerre's iteration
    falls to it with order three: four steps serve every F. The denominator is 2 (s1 + s2) (s2 + s3) (s1 + s3), zero
    only where no rotation is nearest; there, and for NaN, the identity is returned.

    Newton's iteration for the polar factor (Higham 1986) takes twice the operations and leaves an inverted F
    inverted; the quaternion iteration of Mueller et al. (2016) does not find half a turn from a cold start.
    """
    size = wp.sqrt(wp.ddot(f, f))
    if not (size > 1.0e-18 and size < 1.0e18):
        return wp.quat_identity()
    g = f / size
    x = wp.vec3(g[0, 0], g[0, 1], g[0, 2])
    y = wp.vec3(g[1, 0], g[1, 1], g[1, 2])
    z = wp.vec3(g[2, 0], g[2, 1], g[2, 2])
    cofactor = wp.matrix_from_rows(wp.cross(y, z), wp.cross(z, x), wp.cross(x, y))
    det8 = 8.0 * wp.dot(x, wp.cross(y, z))
    last = 1.0 - 4.0 * wp.ddot(cofactor, cofactor)
    l = float(1.7320508075688772)  # l <= sqrt(3) |F|
    for _ in range(4):
        ll = l * l
        p = ((ll - 2.0) * l - det8) * l + last
        dp = (4.0 * ll - 4.0) * l - det8
        ddp = 12.0 * ll - 4.0
        den = dp + wp.sqrt(wp.max(9.0 * dp * dp - 12.0 * p * ddp, 0.0))
        if p > 0.0 and den > 0.0:
            l -= 4.0 * p / den
    den = (l * l - 1.0) * l - 0.25 * det8
    if not den > 1.0e-6:
        return wp.quat_identity()
    r = (l * l + 1.0) * g + (2.0 * l) * cofactor - 2.0 * (g * (wp.transpose(g) * g))
    return wp.normalize(wp.quat_from_matrix(r / den))


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
    rotation_out: wp.array2d[wp.quat],  # like mean_out, or of size zero: not wanted
):
    """Compute x = X + sum_k b_k q_k, F Sigma F^T and, if wanted, the rotation of F."""
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
    gradient_of_x = wp.matrix_from_rows(r0, r1, r2)
    if rotation_out.shape[0] > 0:
        rotation_out[world, first_splat + i] = polar_rotation(gradient_of_x)
    f = limited_stretch(gradient_of_x, stretch_limit)
    s = f * symmetric_matrix(rest_covariance[i]) * wp.transpose(f)
    mean_out[world, first_splat + i] = wp.vec3(float(x), float(y), float(z))
    covariance_out[world, first_splat + i] = vec6(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])
