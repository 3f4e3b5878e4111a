"""Device code of the part of a cell that a face of a box lies on: it is pressed as much as lies under the face, there.

A cell is a square of the side a, along the edges of the face. Of a face with half extents h_j the part

    l_j = min(x_j + a/2, h_j) - max(x_j - a/2, -h_j),   share l_1 l_2 / a^2,   its middle (min + max) / 2 - x_j

lies under it, x the sample. So the parts of all cells are the face, wherever samples lie: a finger that is hardly wider
than a cell presses with its own area about its own middle. A sample beyond the rim of the face has a part under it too.
Cells that lean against the face are left to its edges, see ``ridge_kernels``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LEVEL, LEANING = wp.constant(wp.float64(0.15)), wp.constant(wp.float64(0.3))
"""Slopes of a cell against a face, up to which it is cut at the rim, and from which on edges press beside the face."""
LEAST = wp.constant(wp.float64(1.0e-2))
"""Share of a cell up to which nothing of it is under a face."""


@wp.func
def near_rim(half: wp.vec3d, x: wp.vec3d, side: wp.float64):
    """Return whether a sample at x is so near to two faces of a box that its cell may lie on a rim."""
    near = int(0)
    for k in range(3):
        if wp.abs(x[k]) > half[k] - side:
            near += 1
    return near > 1


@wp.func
def face_on_cell(half: wp.vec3d, x: wp.vec3d, inward: wp.vec3d, side: wp.float64):
    """Return the axis of the face of a box that a cell faces, its share under that, and where the middle of that is.

    The middle is from the sample [m]. The axis is -1 where the cell leans, lies within the face, or beside it.

    Args:
        half: Half extents of the box [m].
        x: The sample in its frame [m].
        inward: Normal of the cell there, into the body.
        side: Of the cell [m].
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    reach = wp.float64(0.5) * side
    axis = int(0)
    most = zero
    for k in range(3):
        facing = wp.where(x[k] < zero, -inward[k], inward[k])
        if facing > most:
            most = facing
            axis = k
    middle = wp.vec3d()
    share = one
    under = one
    lean = zero
    cut = bool(False)
    for j in range(3):
        if j != axis:
            low = wp.max(x[j] - reach, -half[j])
            high = wp.min(x[j] + reach, half[j])
            share *= wp.max(high - low, zero) / side
            middle[j] = wp.float64(0.5) * (low + high) - x[j]
            lean = wp.max(lean, wp.abs(inward[j]))
            if wp.abs(x[j]) > half[j]:
                under = zero
            if wp.abs(x[j]) > half[j] - reach:
                cut = bool(True)
    level = wp.clamp((LEANING - lean / wp.max(most, wp.float64(1.0e-12))) / (LEANING - LEVEL), zero, one)
    share *= level
    total = share + (one - level) * under
    if not cut or level <= zero or total <= LEAST:
        return int(-1), one, wp.vec3d()
    return axis, total, share / total * middle
