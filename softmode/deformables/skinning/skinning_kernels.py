"""Device code of `skinning`: points, and splat means with F Sigma F^T, from the reduced coordinates."""

import functools

import warp as wp

from softmode.quiet import quieten_warp

quieten_warp()
wp.set_module_options({"enable_backward": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""Symmetric matrix: xx, xy, xz, yy, yz, zz."""


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(source.data) + (size_t)row * source.shape[1] + column);
    return wp::vec4(v.x, v.y, v.z, v.w);
#else
    return source.data[(size_t)row * source.shape[1] + column];
#endif
"""
)
def load4(source: wp.array2d[wp.vec4], row: int, column: int) -> wp.vec4:
    """Return an element of a contiguous array that the kernel does not write, in one load."""


@wp.func
def symmetric_matrix(c: vec6) -> wp.mat33:
    """Return the full matrix of the six entries xx, xy, xz, yy, yz, zz."""
    return wp.mat33(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5])


@wp.func
def limited_stretch(f: wp.mat33, limit: float) -> wp.mat33:
    """Return F with its singular values cut to at most `limit`.

    Where a basis tears, or a step has failed, single splats would be drawn out into spikes across the picture. Averaged
    functions (`average_basis`) leave few; this is the guard behind them. Compression needs no limit: a flattened splat
    only covers less. The Frobenius norm bounds the largest singular value, so the decomposition is skipped for all but
    strongly stretched splats.
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


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffffu, value, step);
#endif
    return value;
"""
)
def sum_over_lanes(value: wp.float64) -> wp.float64:
    """Return the sum over the threads of a warp, to each of them; on CPU the value itself."""


@wp.kernel
def split_motion(
    # Object:
    mean_basis: wp.array[wp.float64],  # (function_count,) b averaged over the splats
    # State in:
    function_start: wp.array[int],  # (world_count,) first entry of q of the object's instance in each world
    q_in: wp.array[wp.vec3d],  # [m]
    sample_start: wp.array[int],  # (world_count,) first of its entries in dent
    sample_count: int,  # how many; 0 where nothing dents
    dent: wp.array[wp.vec3],  # [m]
    lanes: int,  # threads per world: a warp on CUDA, 1 on CPU
    # Out:
    dented_out: wp.array[int],  # (world_count,) whether it has a dent at all
    offset_out: wp.array[wp.vec3d],  # (world_count,) [m]
    q_out: wp.array2d[wp.vec4],  # (world_count, function_count) [m]; the fourth is not used
):
    """Write the mean displacement sum_k mean(b_k) q_k in float64, q in float32 for what is left of b, and what dents.

    Metres of rigid motion go into the offset; the rest is of the size of the object, and float32 holds it.
    """
    world, lane = wp.tid()
    start = function_start[world]
    offset = wp.vec3d()
    for k in range(lane, mean_basis.shape[0], lanes):
        q = q_in[start + k]
        offset = offset + mean_basis[k] * q
        q_out[world, k] = wp.vec4(float(q[0]), float(q[1]), float(q[2]), 0.0)
    offset = wp.vec3d(sum_over_lanes(offset[0]), sum_over_lanes(offset[1]), sum_over_lanes(offset[2]))
    dents = wp.float64(0.0)
    for s in range(lane, sample_count, lanes):
        if wp.length_sq(dent[sample_start[world] + s]) > 0.0:
            dents += wp.float64(1.0)
    dents = sum_over_lanes(dents)
    if lane == 0:
        offset_out[world] = offset
        dented_out[world] = int(dents)


@wp.struct
class Skin:
    """Splats of one object with the basis that moves them, how they move, and where they go."""

    rest_mean: wp.array[wp.vec3]  # (splat_count,) [m]
    rest_covariance: wp.array[vec6]  # (splat_count,) [m^2]
    basis: wp.array2d[wp.vec4]  # (function_count, splat_count) grad b [1/m], b less its average
    stretch_limit: float
    offset: wp.array[wp.vec3d]  # (world_count,) [m]
    q: wp.array2d[wp.vec4]  # (world_count, function_count) [m]
    first_splat: int
    sample_start: wp.array[int]  # (world_count,) first of the object's entries in dent
    dent: wp.array[wp.vec3]  # of surface samples [m]
    dented: wp.array[int]  # (world_count,) whether any of the object's is not zero
    near: wp.array2d[int]  # (splat_count, k) surface samples whose dents move a splat, and
    share: wp.array2d[float]  # by how much of them
    row: wp.array[int]  # (world_count,) row of each world in the outputs, -1 for none; of size zero: that of the world
    # Out:
    mean: wp.array2d[wp.vec3]  # (rows, >= first_splat + splat_count) [m]
    covariance: wp.array2d[vec6]  # like mean [m^2]
    rotation: wp.array2d[wp.quat]  # like mean, or of size zero: not wanted


@wp.func
def write_splat(skin: Skin, row0: wp.vec4, row1: wp.vec4, row2: wp.vec4, world: int, i: int):
    """Write x, F Sigma F^T and, if wanted, the rotation of F from the rows (grad u_d, u_d) of the displacement."""
    gradient = wp.mat33(
        1.0 + row0[0], row0[1], row0[2], row1[0], 1.0 + row1[1], row1[2], row2[0], row2[1], 1.0 + row2[2]
    )  # fmt: skip
    column = skin.first_splat + i
    row = world
    if skin.row.shape[0] > 0:
        row = skin.row[world]
    if row < 0:
        return
    if skin.rotation.shape[0] > 0:
        skin.rotation[row, column] = polar_rotation(gradient)
    f = limited_stretch(gradient, skin.stretch_limit)
    s = f * symmetric_matrix(skin.rest_covariance[i]) * wp.transpose(f)
    x = skin.offset[world] + wp.vec3d(skin.rest_mean[i])
    x = x + wp.vec3d(wp.float64(row0[3]), wp.float64(row1[3]), wp.float64(row2[3]))
    if skin.dented[world] != 0:
        moved = wp.vec3()
        for k in range(skin.near.shape[1]):
            moved += skin.share[i, k] * skin.dent[skin.sample_start[world] + skin.near[i, k]]
        x = x + wp.vec3d(moved)
    skin.mean[row, column] = wp.vec3(x)
    skin.covariance[row, column] = vec6(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])


@wp.func
def add_rows(x: wp.vec4, y: wp.vec4, z: wp.vec4, q: wp.vec4, b: wp.vec4):
    """Return the three rows with a function's part of the displacement added."""
    return x + q[0] * b, y + q[1] * b, z + q[2] * b


@functools.cache
def skin_kernel(worlds: int) -> wp.Kernel:
    """Return the skinning kernel whose threads move one splat in `worlds` worlds, 1 or 4.

    What limits a GPU is reading the basis, which all worlds share: 4,096 worlds of 5,000 splats with 64 functions took
    21.6 ms with one world per thread and take 1.5 ms with four.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def _skin(skin: Skin):
        """Compute x = X + sum_k b_k q_k, F Sigma F^T and, if wanted, the rotation of F."""
        group, i = wp.tid()
        world_count = skin.offset.shape[0]
        w0 = worlds * group
        # The last group may be incomplete: it repeats its last world.
        w1 = wp.min(w0 + 1, world_count - 1)
        w2 = wp.min(w0 + 2, world_count - 1)
        w3 = wp.min(w0 + 3, world_count - 1)
        a0 = wp.vec4()
        a1 = wp.vec4()
        a2 = wp.vec4()
        b0 = wp.vec4()
        b1 = wp.vec4()
        b2 = wp.vec4()
        c0 = wp.vec4()
        c1 = wp.vec4()
        c2 = wp.vec4()
        d0 = wp.vec4()
        d1 = wp.vec4()
        d2 = wp.vec4()
        for k in range(skin.basis.shape[0]):
            b = load4(skin.basis, k, i)
            a0, a1, a2 = add_rows(a0, a1, a2, load4(skin.q, w0, k), b)
            if wp.static(worlds > 1):
                b0, b1, b2 = add_rows(b0, b1, b2, load4(skin.q, w1, k), b)
                c0, c1, c2 = add_rows(c0, c1, c2, load4(skin.q, w2, k), b)
                d0, d1, d2 = add_rows(d0, d1, d2, load4(skin.q, w3, k), b)
        write_splat(skin, a0, a1, a2, w0, i)
        if wp.static(worlds > 1):
            if w0 + 1 < world_count:
                write_splat(skin, b0, b1, b2, w1, i)
            if w0 + 2 < world_count:
                write_splat(skin, c0, c1, c2, w2, i)
            if w0 + 3 < world_count:
                write_splat(skin, d0, d1, d2, w3, i)

    return _skin
