"""Bits and lanes in device code: what Warp lacks for words of bits and for the 32 threads of a CUDA warp."""

import warp as wp


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __ffs(word) - 1;
#else
    return __builtin_ctz(word);
#endif
"""
)
def lowest_bit(word: wp.uint32) -> int:
    """Return the position of the lowest set bit of a word that is not zero."""
    ...
