"""Device code of `skinning`: splats on CPU, sixteen neighbours per thread.

The sums over the basis are vector instructions over neighbouring splats, and a block's basis stays in the innermost
cache while all worlds use it (5,000 splats, 64 functions: 0.13 ms per world, 0.53 ms one by one).
"""

import warp as wp

from softmode.deformables.skinning.skinning_kernels import vec6, write_splat

wp.set_module_options({"enable_backward": False})

BLOCK = 16
"""Neighbouring splats of a thread."""

block_vec = wp.types.vector(length=4 * BLOCK, dtype=float)


@wp.func_native(
    f"""
    wp::vec_t<{4 * BLOCK}, float> block;
    __builtin_memcpy(&block, source.data + (size_t)row * source.shape[1] + column, sizeof(block));
    return block;
"""
)
def load_block(source: wp.array2d[wp.vec4], row: int, column: int) -> block_vec:
    """Return neighbouring elements of a contiguous array."""
    ...


@wp.func_native(
    f"""{{
    #pragma clang fp contract(fast)
    typedef float lanes __attribute__((ext_vector_type({4 * BLOCK})));
    lanes sum, block;
    __builtin_memcpy(&sum, &sum_in, sizeof(lanes));
    __builtin_memcpy(&block, &block_in, sizeof(lanes));
    sum = sum + factor * block;
    wp::vec_t<{4 * BLOCK}, float> out;
    __builtin_memcpy(&out, &sum, sizeof(lanes));
    return out;
}}"""
)
def add_scaled(sum_in: block_vec, block_in: block_vec, factor: float) -> block_vec:
    """Return sum + factor * block, fused."""
    ...


@wp.kernel
def skin_blocks(
    # Object:
    rest_mean: wp.array[wp.vec3],  # (splat_count,) [m]; at least BLOCK splats
    rest_covariance: wp.array[vec6],  # (splat_count,) [m^2]
    basis: wp.array2d[wp.vec4],  # (function_count, splat_count) grad b [1/m], b less its average
    stretch_limit: float,
    # State in:
    offset: wp.array[wp.vec3d],  # (world_count,) [m]
    q_in: wp.array2d[wp.vec4],  # (world_count, function_count) [m]
    # Out:
    first_splat: int,
    mean_out: wp.array2d[wp.vec3],  # (world_count, >= first_splat + splat_count) [m]
    covariance_out: wp.array2d[vec6],  # (world_count, >= first_splat + splat_count) [m^2]
    rotation_out: wp.array2d[wp.quat],  # like mean_out, or of size zero: not wanted
):
    """Compute x = X + sum_k b_k q_k, F Sigma F^T and, if wanted, the rotation of F."""
    block, world = wp.tid()
    # The last block overlaps the one before, and writes some splats a second time.
    first = wp.min(BLOCK * block, rest_mean.shape[0] - BLOCK)
    a0 = block_vec()
    a1 = block_vec()
    a2 = block_vec()
    for k in range(basis.shape[0]):
        b = load_block(basis, k, first)
        q = q_in[world, k]
        a0 = add_scaled(a0, b, q[0])
        a1 = add_scaled(a1, b, q[1])
        a2 = add_scaled(a2, b, q[2])
    for p in range(wp.min(BLOCK, rest_mean.shape[0])):  # not a constant, or Warp would unroll it
        row0 = wp.vec4(a0[4 * p], a0[4 * p + 1], a0[4 * p + 2], a0[4 * p + 3])
        row1 = wp.vec4(a1[4 * p], a1[4 * p + 1], a1[4 * p + 2], a1[4 * p + 3])
        row2 = wp.vec4(a2[4 * p], a2[4 * p + 1], a2[4 * p + 2], a2[4 * p + 3])
        i = first + p
        write_splat(
            row0, row1, row2, rest_mean[i], rest_covariance[i], stretch_limit, offset[world], world, first_splat + i,
            mean_out, covariance_out, rotation_out,
        )  # fmt: skip
