"""Kernels that a recording holds."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add(values: wp.array[float], step: float):
    """Add a number to all."""
    k = wp.tid()
    values[k] = values[k] + step


@wp.kernel
def mark(visits: wp.array[int], k: int):
    """Count a visit."""
    visits[k] = visits[k] + 1


@wp.kernel
def count_down(left: wp.array[int]):
    """Take one away."""
    left[0] = left[0] - 1
