"""Device code of what the edges of a box press beside its faces: a cell counts the length of edge that lies in it.

A half-space stands for a shape in a contact, with a dent of the scale that the functions of a body leave out. An edge
presses a strip much narrower than that. On a half plane such a strip gives by the logarithm of its width: its force per
length is E / (1 - nu^2) times its depth and a number that hardly grows with it, here as (depth / dent)^0.15. Of this
spring and the one of the face that counts which presses more: faces meet samples that lie under them by chance, edges
all around. With the inward normal m of the cell, c_i = n_i . m of the faces of the box and a_i the distances of the
sample to them, the edge between faces i and j lies

    delta = -(c_i a_i + c_j a_j)                     deep below the cell, and
    xi = |c_j a_i - c_i a_j| / |(c_i, c_j)|          beside the sample.

Of each edge a cell of area A has the length A / r (1 - xi / r), r the reach: over all cells the edge's own. It counts
by the cube of the cosine of its slope below the cell, one for along its length, two for the force, as finite elements
say of corners.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

REACH = wp.constant(0.85)
"""Distance to a box over the side of a cell up to which an edge may lie in the cell."""
RIDGE, NARROW = wp.constant(wp.float64(0.388)), wp.constant(wp.float64(0.15))
"""Force per length of an edge of 90 degrees over E / (1 - nu^2) and depth, as deep as the dent under that pressure; the
power of the depth with which it grows: 0.26 where it is 1 % of the edge of the default cube, 0.34 at 5 %."""

STEEP = wp.constant(wp.float64(0.3))
"""Slope of the flatter of two faces over that of the steeper one, up to which their edge is the rim of a flat punch and
presses nothing of its own."""
FLANK, FRONT = wp.constant(wp.float64(0.3)), wp.constant(wp.float64(0.55))
"""Cosines between the normals of what is nearest and of the cell: up to the first that is a flank beside the cell whose
edge counts nothing, since the plane of the cell goes on where the cell ends; from the second on it counts."""


@wp.func
def beside_edge(half: wp.vec3d, x: wp.vec3d, gap: float, side: float):
    """Return whether a sample with a gap [m] has an edge of a box near it.

    Not beyond a corner, where no cell reaches an edge, nor if the gap is of a way through the box: the contact then has
    another normal.
    """
    near = int(0)
    outside = int(0)
    deepest = wp.float64(-1.0e30)
    out = wp.vec3d()
    for k in range(3):
        away = wp.abs(x[k]) - half[k]
        if away > wp.float64(-2.0 * REACH * side):
            near += 1
        if away > wp.float64(0.0):
            outside += 1
            out[k] = away
        deepest = wp.max(deepest, away)
    distance = float(wp.where(outside > 0, wp.length(out), deepest))
    rounding = 2.0e-6 * wp.max(1.0, float(wp.max(half)))  # of distances in float32
    return near > 1 and outside < 3 and wp.abs(distance - gap) < rounding


@wp.func
def ridge_in_cell(half: wp.vec3d, x: wp.vec3d, inward: wp.vec3d, side: wp.float64, front: wp.float64):
    """Return the length of edges in a cell [m], as if they were steep on both sides, and how deep they are in [m].

    Args:
        half: Half extents of the box [m].
        x: The sample in its frame [m].
        inward: Normal of the cell there, into the body.
        side: Of the cell [m].
        front: Cosine between the normals of the contact and of the cell.
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
            part = wp.sqrt(both) * both * (sharp - STEEP) / (one - STEEP) * near * end * side * side / reach
            length += part
            over = facing[k] * wp.max(away[k], zero)
            moment -= part * (facing[i] * away[i] + facing[j] * away[j] + over)
    depth = moment / wp.max(length, wp.float64(1.0e-30))
    return length * wp.clamp((front - FLANK) / (FRONT - FLANK), zero, one), depth
