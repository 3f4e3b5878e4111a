"""Device side of the cubic B-spline: weights of the 4 x 4 x 4 grid nodes around a particle, in either precision."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def cell_of(x: Any, origin: Any, dx: Any, first: wp.vec3i):
    """Return the lower corner of a point's cell, counted from the node ``first``, and the fraction within it, 0..1.

    A grid that moves by whole cells changes ``first`` and not ``origin``, so that fractions keep their bits.
    """
    at = (x - origin) / dx
    i = int(wp.floor(at[0]))
    j = int(wp.floor(at[1]))
    k = int(wp.floor(at[2]))
    inside = type(x)(at[0] - type(dx)(i), at[1] - type(dx)(j), at[2] - type(dx)(k))
    return i - first[0], j - first[1], k - first[2], inside


@wp.func
def spline(f: Any):
    """Return the weights of the nodes -1, 0, 1, 2 at fraction f of a cell."""
    g = type(f)(1.0) - f
    c = type(f)(2.0) / type(f)(3.0)  # A literal 2 / 3 would be one of float32.
    half = type(f)(0.5)
    sixth = type(f)(1.0) / type(f)(6.0)
    return wp.vector(g * g * g * sixth, half * f * f * f - f * f + c, half * g * g * g - g * g + c, f * f * f * sixth)


@wp.func
def spline_slope(f: Any):
    """Return the derivatives of :func:`spline` with respect to f."""
    g = type(f)(1.0) - f
    half = type(f)(0.5)
    two = type(f)(2.0)
    three_halves = type(f)(1.5)
    return wp.vector(-half * g * g, three_halves * f * f - two * f, two * g - three_halves * g * g, half * f * f)


@wp.func
def spline_at(x: Any):
    """Return the weight of a node that lies x cells away along each axis."""
    w = type(x[0])(1.0)
    for axis in range(3):
        r = wp.abs(x[axis])
        rest = wp.max(type(r)(2.0) - r, type(r)(0.0))
        if r < type(r)(1.0):
            w *= type(r)(0.5) * r * r * r - r * r + type(r)(2.0) / type(r)(3.0)
        else:
            w *= rest * rest * rest / type(r)(6.0)
    return w
