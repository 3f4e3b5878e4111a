"""Device side of the deformation gradient: F - I at a point from the reduced coordinates."""

import warp as wp

from softmode.deformables.model.lane_kernels import sum8d, vec8, vec8d
from softmode.deformables.model.struct_kernels import blocks_of

wp.set_module_options({"enable_backward": False})


@wp.func
def displacement_gradient(gradient: wp.array3d[vec8], q: wp.array2d[vec8d], i: int, point: int, function_count: int):
    """Return G = F - I = sum_k q_k (grad b_k)^T, with gradients of shape (block_count, point_count, 3)."""
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
    gradient: wp.array3d[vec8], q: wp.array2d[vec8d], i: int, point: int, function_count: int, scale: wp.float64
):
    """Return F / s - I, the displacement gradient by the rest shape s X of a body of scale s."""
    G = displacement_gradient(gradient, q, i, point, function_count)
    if scale != wp.float64(1.0):
        excess = scale - wp.float64(1.0)
        G = wp.float64(1.0) / scale * (G - wp.diag(wp.vec3d(excess, excess, excess)))
    return G
