"""Device code of the part of a cell that a face of a box lies on: it is pressed as much as lies under the face, there.

A cell is a square of the side a, along the edges of the face, about its sample x, but moved to end where the body has
an edge. Of a face with half extents h_j the part

    l_j = min(x_j + a/2, h_j) - max(x_j - a/2, -h_j),   share l_1 l_2 / a^2,   its middle (min + max) / 2 - x_j

lies under it. So the parts of all cells are the face, wherever samples lie: a finger that is hardly wider than a cell
presses with its own area about its own middle. A sample beyond the rim of the face has a part under it too. Hardly
anything of a cell is nothing: what sinks into a box by its dents slides over the joint to the next one. Cells that lean
against the face are left to its edges, see ``ridge_kernels``.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import touching
from softmode.deformables.contact.ridge_kernels import Box, inward_of

wp.set_module_options({"enable_backward": False})

LEVEL, LEANING = wp.constant(wp.float64(0.15)), wp.constant(wp.float64(0.3))
"""Slopes of a cell against a face, up to which it is cut at the rim, and from which on edges press beside the face."""
LEAST = wp.constant(wp.float64(5.0e-2))
"""Share of a cell up to which nothing of it is under a face; twice that counts in full."""


@wp.func
def near_rim(box: Box):
    """Return whether a sample is so near to two faces of a box that its cell may lie on a rim."""
    near = int(0)
    for k in range(3):
        if wp.abs(box.x[k]) > box.half[k] - wp.sqrt(box.area):
            near += 1
    return near > 1


@wp.func
def part_under_face(box: Box):
    """Return the axis of the face of a box that a cell lies on, the part of the cell under it, and where that is.

    Its middle, from that of the square at rest [m]. The axis is -1 where the cell leans, is under the face as a whole
    or not at all.
    """
    half = box.half
    x = box.x + box.F * box.inset
    side = wp.sqrt(box.area)
    inward = inward_of(box)
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
    share *= level * touching(share / LEAST - one)
    total = share + (one - level) * under
    if not cut or level <= zero or total <= wp.float64(0.0):
        return int(-1), one, wp.vec3d()
    rest = share / total * (wp.inverse(box.F) * middle)
    return axis, total, rest - wp.dot(rest, box.normal) * box.normal
