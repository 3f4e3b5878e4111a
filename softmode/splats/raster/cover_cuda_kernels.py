"""Device code of `rasterizer`: the bits of the tiles that splats cover, gathered in shared memory on CUDA.

Bits set in global memory one by one go through the atomic units of its cache, which take 0.76 ms for 4,096 views of 64
px and 5,000 splats on an H200. A block that owns a few words of every tile sets them in shared memory and writes them
at once, zeros included.
"""

import functools

import warp as wp

from softmode.splats.raster.lane_ops import sync_block

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 256
SHARED_WORDS = 8192
"""Words of shared memory that a block may take."""


def words_per_block(tile_count: int) -> int:
    """Return how many words of every tile a block owns, 8 to 1, or 0 where the picture has too many tiles for it."""
    words = BLOCK_DIM // 32
    while words * tile_count > SHARED_WORDS:
        words //= 2
    return words


@functools.cache
def cover_kernel(tiles: int, words: int) -> wp.Kernel:
    """Return the kernel for pictures of that many tiles, launched with BLOCK_DIM threads per block of words."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned bits[{tiles * words}];
    return reinterpret_cast<uint64_t>(bits);
#else
    return 0;
#endif
"""

    @wp.func_native(snippet=snippet)
    def shared_bits() -> wp.uint64:
        """Return the block's shared memory."""
        ...

    @wp.kernel(enable_backward=False, module="unique")
    def _cover(
        order: wp.array[int],  # (>= view_count * splat_count,) splats of each view by depth
        box: wp.array[wp.vec4us],  # (view_count * splat_count,)
        splat_count: int,
        tiles_per_row: int,
        # Out:
        cover_out: wp.array2d[wp.uint32],  # (tiles of all views, words)
    ):
        """Set the bit of every depth rank in every tile that the splat touches."""
        global_thread = wp.tid()
        block = global_thread / BLOCK_DIM
        thread = global_thread - block * BLOCK_DIM
        blocks_per_view = (cover_out.shape[1] + words - 1) / words
        view = block / blocks_per_view
        first_word = (block - view * blocks_per_view) * words
        bits = wp.array(ptr=shared_bits(), shape=(tiles * words,), dtype=wp.uint32)
        for i in range(thread, tiles * words, BLOCK_DIM):
            bits[i] = wp.uint32(0)
        sync_block()
        rank = 32 * first_word + thread
        if thread < 32 * words and rank < splat_count:
            b = box[view * splat_count + order[view * splat_count + rank]]
            bit = wp.uint32(1) << wp.uint32(thread % 32)
            for y in range(int(b[2]), int(b[3])):
                for x in range(int(b[0]), int(b[1])):
                    wp.atomic_or(bits, (y * tiles_per_row + x) * words + thread / 32, bit)
        sync_block()
        for i in range(thread, tiles * words, BLOCK_DIM):
            word = first_word + i % words
            if word < cover_out.shape[1]:
                cover_out[view * tiles + i / words, word] = bits[i]

    return _cover
