"""Device side of the deformation gradient: F - I at a point from the reduced coordinates."""

import warp as wp

from softmode.deformables.model.lane_kernels import by_eights, sum8d, sum_of_lanes, vec8, vec8d
from softmode.deformables.model.struct_kernels import blocks_of

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    snippet="""
    const int stride = 8 * (q.shape[1] / 3);
    const double* x = (const double*)((const char*)q.data + (size_t)i * q.strides[0]);
    const double* y = x + stride;
    const double* z = y + stride;
    const char* start = (const char*)gradient.data + (size_t)point * gradient.strides[1];
    struct alignas(16) Four { float v[4]; };
    struct alignas(16) Two { double v[2]; };
    double g[9] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    #pragma unroll 2
    for (int k = 4 * lane; k < function_count; k += 4 * lanes) {
        const char* at = start + (size_t)(k / 8) * gradient.strides[0] + (k % 8) * sizeof(float);
        const Four a = *(const Four*)at;
        const Four b = *(const Four*)(at + gradient.strides[2]);
        const Four c = *(const Four*)(at + 2 * gradient.strides[2]);
        #pragma unroll
        for (int half = 0; half < 4; half += 2) {
            const Two u = *(const Two*)(x + k + half);
            const Two v = *(const Two*)(y + k + half);
            const Two w = *(const Two*)(z + k + half);
            #pragma unroll
            for (int l = 0; l < 2; ++l) {
                const double p = a.v[half + l], r = b.v[half + l], s = c.v[half + l];
                g[0] += u.v[l] * p; g[1] += u.v[l] * r; g[2] += u.v[l] * s;
                g[3] += v.v[l] * p; g[4] += v.v[l] * r; g[5] += v.v[l] * s;
                g[6] += w.v[l] * p; g[7] += w.v[l] * r; g[8] += w.v[l] * s;
            }
        }
    }
"""
    + sum_of_lanes("g", 9)
    + """    return wp::mat_t<3, 3, double>(g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]);
"""
)
def displacement_gradient_by_fours(
    gradient: wp.array3d[vec8], q: wp.array2d[vec8d], i: int, point: int, function_count: int, lane: int, lanes: int
) -> wp.mat33d:  # pyright: ignore[reportReturnType]
    """Return the same as ``displacement_gradient``, with few registers, of functions four at a time.

    The threads of a warp, which know their ``lane``, may share it if all 32 call this with ``lanes`` 32; else it is 1.
    """
    ...


@wp.func
def displacement_gradient(
    gradient: wp.array3d[vec8],
    q: wp.array2d[vec8d],
    i: int,
    point: int,
    function_count: int,
    lane: int = 0,
    lanes: int = 1,
):
    """Return G = F - I = sum_k q_k (grad b_k)^T, with gradients of shape (block_count, point_count, 3)."""
    if by_eights() == 0:
        return displacement_gradient_by_fours(gradient, q, i, point, function_count, lane, lanes)
    stride = q.shape[1] / 3
    G = wp.mat33d()
    for b in range(blocks_of(function_count)):
        gx = vec8d(gradient[b, point, 0])
        gy = vec8d(gradient[b, point, 1])
        gz = vec8d(gradient[b, point, 2])
        for axis in range(3):
            x = q[i, axis * stride + b]
            G[axis, 0] += sum8d(wp.cw_mul(x, gx))
            G[axis, 1] += sum8d(wp.cw_mul(x, gy))
            G[axis, 2] += sum8d(wp.cw_mul(x, gz))
    return G


@wp.func
def elastic_gradient(
    gradient: wp.array3d[vec8],
    q: wp.array2d[vec8d],
    i: int,
    point: int,
    function_count: int,
    scale: wp.float64,
    lane: int = 0,
    lanes: int = 1,
):
    """Return F / s - I, the displacement gradient by the rest shape s X of a body of scale s."""
    G = displacement_gradient(gradient, q, i, point, function_count, lane, lanes)
    if scale != wp.float64(1.0):
        excess = scale - wp.float64(1.0)
        G = wp.float64(1.0) / scale * (G - wp.diag(wp.vec3d(excess, excess, excess)))
    return G
