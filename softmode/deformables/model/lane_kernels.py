"""The 8-wide vectors that the solver's arrays are made of, and how threads share one system on CUDA.

Every function axis is padded to a multiple of eight, `LANES`, and stored in blocks of eight: on CPU a block is one SIMD
register, on CUDA it is what one thread works on. Write sums of products as separate updates (``a = a + x * y``): the
compiler fuses each into one instruction, while ``a += x * y + u * v`` leaves multiplications and additions apart
(measured on the stiffness assembly, one core: 81 instead of 23 Gflop/s).

A *team* is the group of threads that works on one system: one thread on CPU, one warp on CUDA, where ``barrier``
separates the phases of a kernel. A team is the last launch dimension and the block size, so that it fills a block.
"""

from typing import Any

import numpy as np
import warp as wp

from softmode.lanes import LANES

vec8 = wp.types.vector(length=LANES, dtype=float)
vec8d = wp.types.vector(length=LANES, dtype=wp.float64)
mat88 = wp.types.matrix(shape=(LANES, LANES), dtype=float)

WARP = wp.constant(32)
"""Threads of a warp on CUDA."""
TEAM = 32
"""Threads that share one system on CUDA."""


def pad(count: int) -> int:
    """Return ``count`` rounded up to a multiple of :data:`LANES`."""
    return -(-count // LANES) * LANES


def team_size(device: wp.Device) -> int:
    """Return how many threads share one system on a device."""
    return TEAM if wp.get_device(device).is_cuda else 1


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""
)
def barrier() -> None:
    """Wait for the other threads of the block; nothing on CPU, where a team is one thread."""


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    asm volatile(".pragma \\"nounroll\\";");
#endif
"""
)
def rolled() -> None:
    """Keep a loop as it is written: on CUDA the compiler does not unroll a loop with this in its body."""


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(value));
#endif
    return value;
"""
)
def here(value: int) -> int:  # pyright: ignore[reportReturnType]
    """Return the value, such that the CUDA compiler takes it for another one.

    It computes an address that does not change in a loop before the loop, and keeps it. Where a kernel goes through
    hundreds of arrays in a loop, there are not enough registers for that, and all of them end in memory.
    """
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__) || defined(SOFTMODE_ONE_BY_ONE)
    return 0;
#else
    return 1;
#endif
"""
)
def by_eights() -> int:  # pyright: ignore[reportReturnType]
    """Return 1 on CPU, where a thread takes eight numbers at a time, 0 on CUDA, where threads take one each.

    The compiler knows, so that code for the other device is left out. A test defines ``SOFTMODE_ONE_BY_ONE`` to run the
    code for CUDA.
    """
    ...


@wp.func_native(snippet="return ((const double*)((const char*)values.data + (size_t)i * values.strides[0]))[k];")
def number_of(values: wp.array2d[vec8d], i: int, k: int) -> wp.float64:  # pyright: ignore[reportReturnType]
    """Return number ``k`` of row ``i`` of an array of blocks."""
    ...


@wp.func_native(snippet="return ((const float*)((const char*)values.data + (size_t)i * values.strides[0]))[k];")
def single_of(values: wp.array2d[vec8], i: int, k: int) -> float:  # pyright: ignore[reportReturnType]
    """Return number ``k`` of row ``i`` of an array of blocks in single precision."""
    ...


@wp.func_native(snippet="return ((const double*)((const char*)values.data + (size_t)row * values.strides[1]))[k];")
def chunk_number(values: wp.array3d[vec8d], row: int, k: int) -> wp.float64:  # pyright: ignore[reportReturnType]
    """Return number ``k`` of a row of an array of parts of blocks, in which rows of all parts are counted."""
    ...


@wp.func_native(snippet="((double*)((char*)values.data + (size_t)i * values.strides[0]))[k] = value;")
def set_number(values: wp.array2d[vec8d], i: int, k: int, value: wp.float64) -> None:
    """Set number ``k`` of row ``i`` of an array of blocks."""
    ...


@wp.func
def column_of(values: wp.array2d[vec8d], i: int, k: int):
    """Return the three coordinates of function ``k`` in row ``i``."""
    n = LANES * (values.shape[1] / 3)
    return wp.vec3d(number_of(values, i, k), number_of(values, i, n + k), number_of(values, i, 2 * n + k))


@wp.func
def copy_blocks(values: wp.array2d[vec8d], values_out: wp.array2d[vec8d], i: int, member: int, team: int):
    """Copy row ``i``, each thread some of it."""
    if by_eights() != 0:
        for e in range(member, values.shape[1], team):
            values_out[i, e] = values[i, e]
    else:
        for k in range(member, LANES * values.shape[1], team):
            rolled()
            set_number(values_out, i, k, number_of(values, i, k))


@wp.func
def sum8(v: vec8):
    """Return the sum of the lanes, pairwise."""
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))


@wp.func
def sum8d(v: vec8d):
    """Return the sum of the lanes, pairwise."""
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))


@wp.func
def free_part(block: Any, driven: int):
    """Return a block with zeros in its first ``driven`` lanes, which may be none or more than all."""
    if driven <= 0:
        return block
    out = block
    zero = type(block)()
    for lane in range(LANES):
        if lane < driven:
            out[lane] = zero[lane]
    return out


_TEAM_SUM = """
#if defined(__CUDA_ARCH__)
    __shared__ double partial[COUNT * ((WP_TILE_BLOCK_DIM + 31) / 32)];
    double* x = (double*)&value;
    #pragma unroll 1
    for (int offset = 16; offset > 0; offset >>= 1) {
        #pragma unroll
        for (int c = 0; c < COUNT; ++c) x[c] += __shfl_xor_sync(0xffffffff, x[c], offset);
    }
    if (threadIdx.x % 32 == 0) {
        #pragma unroll
        for (int c = 0; c < COUNT; ++c) partial[COUNT * (threadIdx.x / 32) + c] = x[c];
    }
    __syncthreads();
    #pragma unroll
    for (int c = 0; c < COUNT; ++c) x[c] = partial[c];
    #pragma unroll 1
    for (int k = 1; k < blockDim.x / 32; ++k) {
        #pragma unroll
        for (int c = 0; c < COUNT; ++c) x[c] += partial[COUNT * k + c];
    }
    __syncthreads();
#endif
    return value;
"""
"""Sum of COUNT numbers of each thread: over a warp, then over the warps of the team, with one pair of barriers."""


@wp.func_native(snippet=_TEAM_SUM.replace("COUNT", "1"))
def team_sum(value: wp.float64) -> wp.float64:  # pyright: ignore[reportReturnType]
    """Return the sum of the threads' values, in a fixed order, to every thread; every thread must call it."""
    ...


@wp.func_native(snippet=_TEAM_SUM.replace("COUNT", "3"))
def team_sum3(value: wp.vec3d) -> wp.vec3d:  # pyright: ignore[reportReturnType]
    """Return the sum of the threads' vectors likewise."""
    ...


@wp.func_native(snippet=_TEAM_SUM.replace("COUNT", "9"))
def team_sum33(value: wp.mat33d) -> wp.mat33d:  # pyright: ignore[reportReturnType]
    """Return the sum of the threads' matrices likewise."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    #pragma unroll 1
    for (int offset = 16; offset > 0; offset >>= 1) {
        value.c[0] += __shfl_xor_sync(0xffffffff, value.c[0], offset);
        value.c[1] += __shfl_xor_sync(0xffffffff, value.c[1], offset);
    }
#endif
    return value;
"""
)
def warp_sum2(value: wp.vec2d) -> wp.vec2d:  # pyright: ignore[reportReturnType]
    """Return the sum of the vectors of a warp's threads to each of them; every thread of the warp must call it."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ int counts[32];
    const unsigned mask = __ballot_sync(0xffffffff, flag != 0);
    const int lane = threadIdx.x % 32;
    if (lane == 0) counts[threadIdx.x / 32] = __popc(mask);
    __syncthreads();
    int before = __popc(mask & ((1u << lane) - 1u));
    int total = 0;
    #pragma unroll 1
    for (int k = 0; k < blockDim.x / 32; ++k) {
        if (k < threadIdx.x / 32) before += counts[k];
        total += counts[k];
    }
    __syncthreads();
    return before | (total << 16);
#else
    return flag << 16;
#endif
"""
)
def team_rank(flag: int) -> int:  # pyright: ignore[reportReturnType]
    """Return how many threads before this one have the flag 1, plus 2^16 times how many of all; every thread calls."""
    ...


def sum_of_lanes(name: str, count: int) -> str:
    """Return native code that sums ``count`` numbers ``name[k]`` over a warp on CUDA, if ``lanes`` is more than one."""
    return f"""    #if defined(__CUDA_ARCH__)
    if (lanes > 1)
        #pragma unroll
        for (int k = 0; k < {count}; ++k)
            for (int offset = 16; offset > 0; offset >>= 1) {name}[k] += __shfl_xor_sync(0xffffffff, {name}[k], offset);
    #endif
"""


def to_blocks(q: np.ndarray, block_count: int) -> np.ndarray:
    """Return coordinates (..., n, 3) in the layout of the kernels, (..., 3 block_count, 8), padded with zeros."""
    n = q.shape[-2]
    widths = [(0, 0)] * (q.ndim - 2) + [(0, 0), (0, LANES * block_count - n)]
    return np.pad(np.swapaxes(q, -1, -2), widths).reshape(*q.shape[:-2], 3 * block_count, LANES)


def from_blocks(blocks: np.ndarray, function_count: int) -> np.ndarray:
    """Return coordinates (..., n, 3) from the layout of the kernels (..., 3 block_count, 8)."""
    rows = blocks.reshape(*blocks.shape[:-2], 3, -1)
    return np.swapaxes(rows[..., :function_count], -1, -2)
