"""Device code of what the edges of a box press beside its faces: a cell counts the length of edge that lies in it.

A half-space stands for a shape in a contact, with a dent of the scale that the functions of a body leave out. An edge
presses a strip much narrower than that. On a half plane such a strip gives by the logarithm of its width: its force per
length is nearly a constant times E / (1 - nu^2) and its depth. This is a spring besides the one of the faces. With the
inward normal m of the cell, c_i = n_i . m of the faces of the box and a_i the distances of the sample to them, the edge
between faces i and j lies

    delta = -(c_i a_i + c_j a_j)                     deep below the cell, and
    xi = |c_j a_i - c_i a_j| / |(c_i, c_j)|          beside the sample.

Of each edge a cell of area A has the length A / r (1 - xi / r), r the reach: over all cells the edge's own.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

REACH = wp.constant(0.7)
"""Distance to a box over the side of a cell up to which an edge may lie in the cell."""
RIDGE = wp.constant(wp.float64(0.22))
"""Force per length of an edge of 90 degrees over E / (1 - nu^2) and depth, less what its faces press."""

STEEP = wp.constant(wp.float64(0.3))
"""Slope of the flatter of two faces over that of the steeper one, up to which their edge is the rim of a flat punch and
presses nothing of its own."""
FLANK, FRONT = wp.constant(wp.float64(0.3)), wp.constant(wp.float64(0.55))
"""Cosines between the normals of the nearest face and of the cell: up to the first the face is a flank beside the cell,
whose edge counts nothing, since the plane of the cell goes on where the cell ends; from the second on it counts."""


@wp.func
def face_beside_edge(half: wp.vec3d, x: wp.vec3d, gap: float, side: float):
    """Return the axis of the face of a box that is nearest to a sample with an edge near it, else -1.

    None where the sample is outside of two faces, which no cell reaches with their edge, or the gap is of a way
    through the box: the contact then has another normal.
    """
    axis = int(0)
    count = int(0)
    outside = int(0)
    for k in range(3):
        away = wp.abs(x[k]) - half[k]
        if away > wp.float64(-2.0 * REACH * side):
            count += 1
        if away > wp.float64(0.0):
            outside += 1
        if away > wp.abs(x[axis]) - half[axis]:
            axis = k
    nearest = float(wp.abs(x[axis]) - half[axis])
    rounding = 2.0e-6 * wp.max(1.0, float(wp.max(half)))  # of distances in float32
    return wp.where(count > 1 and outside < 2 and wp.abs(nearest - gap) < rounding, axis, -1)


@wp.func
def ridge_in_cell(half: wp.vec3d, x: wp.vec3d, inward: wp.vec3d, side: wp.float64, axis: int):
    """Return the length of edges in a cell [m], as if they were steep on both sides, and how deep they are in [m].

    Args:
        half: Half extents of the box [m].
        x: The sample in its frame [m].
        inward: Normal of the cell there, into the body.
        side: Of the cell [m].
        axis: That of the nearest face.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    away = wp.vec3d()
    facing = wp.vec3d()
    for k in range(3):
        away[k] = wp.abs(x[k]) - half[k]
        facing[k] = wp.max(wp.where(x[k] < zero, -inward[k], inward[k]), zero)
    length = zero
    moment = zero
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        most = wp.max(facing[i], facing[j])
        sharp = wp.min(facing[i], facing[j]) / wp.max(most, wp.float64(1.0e-12))
        if sharp > STEEP:
            both = facing[i] * facing[i] + facing[j] * facing[j]
            reach = wp.float64(REACH) * side / most
            beside = wp.abs(facing[j] * away[i] - facing[i] * away[j]) / wp.sqrt(both)
            near = wp.max(one - beside / reach, zero)
            end = wp.clamp(one / two - away[k] / (two * reach), zero, one)
            part = both * (sharp - STEEP) / (one - STEEP) * near * end * side * side / reach
            length += part
            over = facing[k] * wp.max(away[k], zero)
            moment -= part * (facing[i] * away[i] + facing[j] * away[j] + over)
    depth = moment / wp.max(length, wp.float64(1.0e-30))
    return length * wp.clamp((facing[axis] - FLANK) / (FRONT - FLANK), zero, one), depth
