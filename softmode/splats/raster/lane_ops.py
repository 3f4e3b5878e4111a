"""Bits and lanes in device code: what Warp lacks for words of bits and for the 32 threads of a CUDA warp.

The functions on lanes are for CUDA only: every lane of a warp must call them together. `load4` and the shared memory
of a warp exist because Warp moves a vec4 as four numbers, where a GPU has instructions that move it at once.
"""

import warp as wp

# pyright: reportReturnType=false
# Functions of native code have no body.

BLOCK_WARPS = 4
"""Warps of a block in kernels that use `queue_address` and `stage_address`."""
QUEUE = 1120
"""Entries of a warp's queue: 1024 ranks, 31 left over, and room to read beyond them."""
STAGE = 96
"""Entries of a warp's stage: three for each of 32 splats."""


def by_device(cuda: str, host: str = "") -> str:
    """Return native code that is one thing on CUDA and another on CPU."""
    return f"""
#if defined(__CUDA_ARCH__)
    {cuda}
#else
    {host}
#endif
"""


@wp.func_native(by_device("return __ffs(word) - 1;", "return __builtin_ctz(word);"))
def lowest_bit(word: wp.uint32) -> int:
    """Return the position of the lowest set bit of a word that is not zero."""


@wp.func_native(by_device("return 31 - __clz(word);", "return 31 - __builtin_clz(word);"))
def highest_bit(word: wp.uint32) -> int:
    """Return the position of the highest set bit of a word that is not zero."""


@wp.func_native(by_device("return __popc(word);", "return __builtin_popcount(word);"))
def bit_count(word: wp.uint32) -> int:
    """Return the number of set bits."""


@wp.func_native(by_device("return __ballot_sync(0xffffffffu, flag);", "return flag;"))
def ballot(flag: bool) -> wp.uint32:
    """Return the word whose bit i is the flag of lane i."""


@wp.func_native(
    by_device(
        """
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, value, step);
        if (lane >= step) value += other;
    }
    return value;
""",
        "return value;",
    )
)
def lane_scan(value: int, lane: int) -> int:
    """Return the sum of the values of the lanes up to and including this one."""


@wp.func_native(by_device("return __shfl_sync(0xffffffffu, value, 31);", "return value;"))
def last_lane(value: int) -> int:
    """Return the value of lane 31."""


@wp.func_native(
    by_device(
        """
    for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffffu, value, step);
    return value;
""",
        "return value;",
    )
)
def lane_sum(value: float) -> float:
    """Return the sum of the values of all lanes."""


@wp.func_native(
    by_device(
        """
    for (int step = 16; step > 0; step /= 2) value = max(value, __shfl_xor_sync(0xffffffffu, value, step));
    return value;
""",
        "return value;",
    )
)
def lane_max(value: int) -> int:
    """Return the largest value of all lanes."""


@wp.func_native(by_device("__syncwarp();"))
def sync_lanes() -> None:
    """Make what the lanes wrote to memory visible to each other."""


@wp.func_native(by_device("__syncthreads();"))
def sync_block() -> None:
    """Wait for the other threads of the block."""


@wp.func_native(
    by_device(
        """
    float result;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
""",
        "return exp2f(x);",
    )
)
def exp2(x: float) -> float:
    """Return 2^x, to two units in the last place."""


@wp.func_native(
    by_device(
        """
    const float4 v = __ldg(reinterpret_cast<const float4*>(source.data + i));
    return wp::vec4(v.x, v.y, v.z, v.w);
""",
        "return source.data[i];",
    )
)
def load4(source: wp.array[wp.vec4], i: int) -> wp.vec4:
    """Return element i of an array that the kernel does not write, in one load."""


@wp.func_native(
    by_device(
        f"""
    __shared__ unsigned short queue[{BLOCK_WARPS} * {QUEUE}];
    return reinterpret_cast<uint64_t>(queue + (threadIdx.x >> 5) * {QUEUE});
""",
        "return 0;",
    )
)
def queue_address() -> wp.uint64:
    """Return this warp's QUEUE uint16 of shared memory."""


@wp.func_native(by_device("reinterpret_cast<unsigned short*>(address)[i] = (unsigned short)value;"))
def queue_put(address: wp.uint64, i: int, value: int) -> None:
    """Write an entry of the warp's queue."""


@wp.func_native(by_device("return reinterpret_cast<unsigned short*>(address)[i];", "return 0;"))
def queue_get(address: wp.uint64, i: int) -> int:
    """Read an entry of the warp's queue."""


@wp.func_native(
    by_device(
        f"""
    __shared__ float4 stage[{BLOCK_WARPS} * {STAGE}];
    return reinterpret_cast<uint64_t>(stage + (threadIdx.x >> 5) * {STAGE});
""",
        "return 0;",
    )
)
def stage_address() -> wp.uint64:
    """Return this warp's STAGE vec4 of shared memory."""


@wp.func_native(
    by_device("reinterpret_cast<float4*>(address)[i] = make_float4(value[0], value[1], value[2], value[3]);")
)
def stage_put(address: wp.uint64, i: int, value: wp.vec4) -> None:
    """Write an entry of the warp's stage."""


@wp.func_native(
    by_device(
        """
    const float4 v = reinterpret_cast<const float4*>(address)[i];
    return wp::vec4(v.x, v.y, v.z, v.w);
""",
        "return wp::vec4();",
    )
)
def stage_get(address: wp.uint64, i: int) -> wp.vec4:
    """Read an entry of the warp's stage."""


@wp.func_native(
    by_device(
        """
    float result;
    asm volatile("mov.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
""",
        "return x;",
    )
)
def keep(x: float) -> float:
    """Return x from a register: the compiler would otherwise compute it anew in every turn of a loop."""
