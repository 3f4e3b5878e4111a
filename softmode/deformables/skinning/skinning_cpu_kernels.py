"""Device code of `skinning`: splats on CPU, sixteen neighbours per thread.

The sums over the basis are vector instructions over neighbouring splats, and a block's basis stays in the innermost
cache while all worlds use it (5,000 splats, 64 functions: 0.13 ms per world, 0.53 ms one by one).
"""

import warp as wp

from softmode.deformables.skinning.skinning_kernels import Skin, write_splat

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


@wp.kernel
def skin_blocks(skin: Skin):
    """Compute x = X + sum_k b_k q_k, F Sigma F^T and, if wanted, the rotation of F, of at least BLOCK splats."""
    block, world = wp.tid()
    if skin.row.shape[0] > 0 and skin.row[world] < 0:
        return
    # The last block overlaps the one before, and writes some splats a second time.
    count = skin.rest_mean.shape[0]
    first = wp.min(BLOCK * block, count - BLOCK)
    a0 = block_vec()
    a1 = block_vec()
    a2 = block_vec()
    for k in range(skin.basis.shape[0]):
        b = load_block(skin.basis, k, first)
        q = skin.q[world, k]
        a0 = add_scaled(a0, b, q[0])
        a1 = add_scaled(a1, b, q[1])
        a2 = add_scaled(a2, b, q[2])
    for p in range(wp.min(BLOCK, count)):  # not a constant, or Warp would unroll it
        row0 = wp.vec4(a0[4 * p], a0[4 * p + 1], a0[4 * p + 2], a0[4 * p + 3])
        row1 = wp.vec4(a1[4 * p], a1[4 * p + 1], a1[4 * p + 2], a1[4 * p + 3])
        row2 = wp.vec4(a2[4 * p], a2[4 * p + 1], a2[4 * p + 2], a2[4 * p + 3])
        write_splat(skin, row0, row1, row2, world, first + p)
