"""Device code of `rasterizer`: the splats of each view sorted by depth on CUDA, one block per view.

A least-significant-digit radix sort in shared memory and registers (Merrill and Grimshaw 2011,
DOI 10.1142/S0129626411000187). With one block per view nothing goes through global memory between the passes: 4,096
views of 5,000 splats take 0.70 ms on an H200, where `wp.utils.segmented_sort_pairs` takes 2.0 ms.
"""

import functools

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 512
CAPACITY = 14 * BLOCK_DIM
"""Largest number of splats: what fits in the shared memory of a block beside its counters."""


@functools.cache
def sort_kernel(items: int) -> wp.Kernel:
    """Return the kernel, launched with (view_count, BLOCK_DIM) threads, for up to items * BLOCK_DIM splats per view.

    Each thread holds `items` of the keys in registers, so their number is a constant of the kernel. The items of a warp
    are neighbours, 32 apart for a thread: equal keys keep their order.
    """
    snippet = f"""
#if defined(__CUDA_ARCH__)
    constexpr int ITEMS = {items}, WARPS = {BLOCK_DIM // 32}, DIGITS = 256;
    __shared__ unsigned exchange[ITEMS * {BLOCK_DIM}];
    __shared__ unsigned counter[WARPS * DIGITS];
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
    const int base = warp * ITEMS * 32 + lane;
    unsigned key[ITEMS], value[ITEMS], place[ITEMS];
    #pragma unroll
    for (int j = 0; j < ITEMS; ++j) {{
        const int i = base + 32 * j;
        key[j] = i < count ? (unsigned)depth_key.data[(size_t)first + i] : 0xffffffffu;
        value[j] = i;
    }}
    unsigned* mine = counter + warp * DIGITS;
    for (int shift = 0; shift < 32; shift += 8) {{
        for (int i = thread; i < WARPS * DIGITS; i += {BLOCK_DIM}) counter[i] = 0;
        __syncthreads();
        // Rank among the equal digits of the warp so far.
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) {{
            const unsigned digit = (key[j] >> shift) & 255u;
            const unsigned peers = __match_any_sync(0xffffffffu, digit);
            const unsigned before = __popc(peers & ((1u << lane) - 1u));
            const unsigned old = mine[digit];
            __syncwarp();
            if (before == 0) mine[digit] = old + __popc(peers);
            __syncwarp();
            place[j] = old + before;
        }}
        __syncthreads();
        // First place of each (digit, warp): digits in order, and within one the warps.
        unsigned total = 0, sum = 0;
        if (thread < DIGITS) {{
            #pragma unroll
            for (int w = 0; w < WARPS; ++w) {{
                const unsigned here = counter[w * DIGITS + thread];
                counter[w * DIGITS + thread] = total;
                total += here;
            }}
            sum = total;
            for (int step = 1; step < 32; step *= 2) {{
                const unsigned other = __shfl_up_sync(0xffffffffu, sum, step);
                if (lane >= step) sum += other;
            }}
            if (lane == 31) exchange[warp] = sum;
        }}
        __syncthreads();
        if (thread < DIGITS) {{
            unsigned start = sum - total;
            for (int w = 0; w < warp; ++w) start += exchange[w];
            #pragma unroll
            for (int w = 0; w < WARPS; ++w) counter[w * DIGITS + thread] += start;
        }}
        __syncthreads();
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) place[j] += mine[(key[j] >> shift) & 255u];
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) exchange[place[j]] = key[j];
        __syncthreads();
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) key[j] = exchange[base + 32 * j];
        __syncthreads();
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) exchange[place[j]] = value[j];
        __syncthreads();
        #pragma unroll
        for (int j = 0; j < ITEMS; ++j) value[j] = exchange[base + 32 * j];
        __syncthreads();
    }}
    #pragma unroll
    for (int j = 0; j < ITEMS; ++j) {{
        const int i = base + 32 * j;
        if (i < count) order_out.data[(size_t)first + i] = value[j];
    }}
#endif
"""

    @wp.func_native(snippet=snippet)
    def sort_view(depth_key: wp.array[int], first: int, count: int, order_out: wp.array[int]) -> None:
        """Write the indices 0..count - 1 of the keys from `first` on in ascending order of the keys."""

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=(BLOCK_DIM, 2))
    def _sort(
        depth_key: wp.array[int],  # (>= view_count * splat_count,) bits of the depth
        splat_count: int,
        # Out:
        order_out: wp.array[int],  # (>= view_count * splat_count,) splats of each view by depth
    ):
        """Sort the splats of one view."""
        view, _thread = wp.tid()
        sort_view(depth_key, view * splat_count, splat_count, order_out)

    return _sort
