"""Device code of what the edges of a box press beside its faces: a cell counts the length of edge that lies in it.

A half-space stands for a shape in a contact, with a dent of the scale that the functions of a body leave out. An edge
presses a strip much narrower than that. On a half plane such a strip gives by the logarithm of its width: its force per
length is E / (1 - nu^2) times its depth and a number that hardly grows with it, here as (depth / dent)^0.2. Of this
spring and the one of the face that counts which presses more: faces meet samples that lie under them by chance, edges
all around. With the inward normal m of the cell, c_i = n_i . m of the faces of the box and a_i the distances of the
sample to them, the edge between faces i and j lies

    delta(s) = -(c_i a_i + c_j a_j) + c_k s          deep below the cell, s along it beyond the sample, and
    xi = |c_j a_i - c_i a_j| / |(c_i, c_j)|          beside the sample.

Of each edge a cell of area A has the part from s = -r to r that is there and in, and of that the share A / (2 r^2)
(1 - xi / r), r the reach: over all cells the edge's own. It lies as deep as its middle. It counts by the cube of the
cosine of its slope below the cell, one for along its length, two for the force, as finite elements say of corners.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import touching
from softmode.deformables.model.declare import struct

wp.set_module_options({"enable_backward": False})

REACH = wp.constant(0.85)
"""Reach r of a level cell over its side."""
FAR = wp.constant(1.5)
"""Distance to a box over the side of a cell up to which an edge may lie in the cell: beside the sample, and as
steep as at a corner."""
WETTED = wp.constant(wp.float64(0.125))
"""Least share of r of an edge that goes in steeply that is counted."""
RIDGE, NARROW = wp.constant(wp.float64(0.413)), wp.constant(wp.float64(0.2))
"""Force per length of an edge of 90 degrees over E / (1 - nu^2) and depth, as deep as the dent under that pressure; the
power of the depth with which it grows: 0.26 where it is 1 % of the edge of the default cube, 0.36 at 5 %."""

STEEP = wp.constant(wp.float64(0.3))
"""Slope of the flatter of two faces over that of the steeper one, up to which their edge is the rim of a flat punch and
presses nothing of its own."""
FLANK, FRONT = wp.constant(wp.float64(0.3)), wp.constant(wp.float64(0.55))
"""Cosines between the normals of what is nearest and of the cell: up to the first that is a flank beside the cell whose
edge counts nothing, since the plane of the cell goes on where the cell ends; from the second on it counts."""


@struct
class Box:
    """A box and the cell of a sample that touches it; vectors in the frame of the box."""

    half: wp.vec3d  # extents [m]
    x: wp.vec3d  # the sample
    F: wp.mat33d  # its deformation gradient
    inset: wp.vec3d  # middle of the square that stands for it at a rim, from the sample at rest [m]
    normal: wp.vec3d  # outward normal of the cell at rest, which F turns and the frame does not
    front: wp.vec3d  # normal of what is nearest
    area: wp.float64  # of the cell [m^2]
    reach: wp.float64  # its r [m]
    dent: wp.float64  # dent under the pressure E / (1 - nu^2) [m]
    unit: wp.float64  # force per length of an edge as deep, over depth and the stiffness of the penalty [1/m]
    give: wp.float64  # dent besides the penalty, over what that gives


@wp.func
def reach_of(side: float, dent: float):
    """Return the reach r of a level cell of a side [m]: not so little that an edge is stiffer than a face.

    A face gives by ``dent`` [m] under the pressure E / (1 - nu^2) at the most.
    """
    return wp.max(REACH * side, float(RIDGE) * dent)


@wp.func
def beside_edge(half: wp.vec3d, x: wp.vec3d, gap: wp.float64, reach: wp.float64):
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
        if away > wp.float64(-2.0) * reach:
            near += 1
        if away > wp.float64(0.0):
            outside += 1
            out[k] = away
        deepest = wp.max(deepest, away)
    distance = wp.where(outside > 0, wp.length(out), deepest)
    rounding = wp.float64(2.0e-6) * wp.max(wp.float64(1.0), wp.max(half))  # of distances in float32
    return near > 1 and outside < 3 and wp.abs(distance - gap) < rounding


@wp.func
def ridge_in_cell(
    half: wp.vec3d, x: wp.vec3d, inward: wp.vec3d, area: wp.float64, reach: wp.float64, front: wp.float64
):
    """Return the length of edges in a cell [m], as if they were steep on both sides, and how deep they are in [m].

    Args:
        half: Half extents of the box [m].
        x: The sample in its frame [m].
        inward: Normal of the cell there, into the body.
        area: Of the cell [m^2].
        reach: Its r [m].
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
            far = reach / most
            beside = wp.abs(facing[j] * away[i] - facing[i] * away[j]) / wp.sqrt(both)
            near = wp.max(one - beside / far, zero)
            end = wp.min(far, -away[k])  # of the edge in the cell, from the place beside the sample on
            deep = facing[k] * end - facing[i] * away[i] - facing[j] * away[j]
            wet = wp.max(far + end, zero)
            if facing[k] * wet > wp.max(deep, zero):
                wet = wp.min(wp.max(deep / facing[k], WETTED * far), wet)
            part = wp.sqrt(both) * both * (sharp - STEEP) / (one - STEEP) * near * area * wet / (two * far * far)
            length += part
            moment += part * (deep - facing[k] * wet / two)
    depth = moment / wp.max(length, wp.float64(1.0e-30))
    return length * wp.clamp((front - FLANK) / (FRONT - FLANK), zero, one), depth


@wp.func
def inward_of(box: Box):
    """Return the normal of the cell into the body."""
    return -wp.normalize(wp.transpose(wp.inverse(box.F)) * box.normal)


@wp.func
def ridge_at(box: Box, face: wp.float64, onset: wp.float64, least: wp.float64):
    """Return stiffness of the edges in a cell over that of its penalty, how much deeper they are in, and the normal.

    Args:
        box: The box and the cell.
        face: How deep the face is in [m].
        onset: Range of the onset [m].
        least: That of a level cell [m].
    """
    zero = wp.float64(0.0)
    inward = inward_of(box)
    length, depth = ridge_in_cell(box.half, box.x, inward, box.area, box.reach, wp.dot(box.front, inward))
    edge = wp.float64(0.5) * onset + depth
    ridge = zero
    normal = box.front
    if length > zero and edge > wp.max(face, zero):
        ridge = box.unit * wp.pow(wp.max(edge, least) / box.dent, NARROW) * touching(edge / least) * length
        push = wp.max(face + least, wp.float64(0.1) * least) / (wp.float64(1.0) + box.give)  # where it is far, too
        normal = wp.normalize(push * box.front + ridge * (edge - wp.max(face, -least)) * inward)
    return ridge, edge - face, normal
