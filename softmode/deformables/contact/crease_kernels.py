"""Device code of cells that an edge or a corner of a box presses: the mean over the cell of what its faces press.

A half-space stands for a shape in a contact. Where two faces of a box look at a cell, each at a part of it, none does.
Along the outward normal N' of the cell, deformed, its gap at a place y with face k, of normal n_k through p_k, is

    g_k = n_k . (y - p_k) / c_k,   c_k = -n_k . N',

and with the box max_k g_k. Means over a grid of places, of v = max(-g, 0) and of where it is touched, give

    force per stiffness     sum v n_k / c_k,   its direction n, its centre of pressure,
    stiffness per area      sum (n . n_k / c_k)^2 where touched: a face that leans against a cell presses more than its
                            gap along its own normal says.

One contact has that force and that stiffness at the start of the step: it is written as the penalty of a penetration p
with an onset e, both p / e and p^2 / (2 e) given. A narrow patch is no softer than it is wide, whatever the functions
leave out: see ``narrow_dent``.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import FACING, LATE, CellShape
from softmode.deformables.contact.shape_query_kernels import query_box
from softmode.deformables.model.declare import struct

wp.set_module_options({"enable_backward": False})

PLACES = wp.constant(8)
"""Places of a cell along each side,"""
NUMBER = wp.constant(wp.float64(8.0))
"""as a number."""
SLENDER = wp.constant(wp.float64(0.5))
"""By how many times ln(w / b) a patch of the width b dents more than b under the pressure E / (1 - nu^2), w the dent of
a wide patch: a strip on a half plane gives by the logarithm."""
AROUND = wp.constant(wp.float64(3.0))
"""Side of what is looked at of a patch to know how wide it is, in cells."""
REACH = wp.constant(0.75)
"""Distance to a box over the side of a cell up to which an edge may lie in the cell."""


@struct
class Crease:
    """What a box presses of a cell."""

    found: int  # whether two faces of it look at the cell or what is around
    normal: wp.vec3d  # against which it presses, in the frame of the box
    centre: wp.vec3d  # centre of pressure from the sample, at rest [m]
    penetration: wp.float64  # p [m]
    onset: wp.float64  # e [m]
    firmness: wp.float64  # stiffness over that of a face
    width: wp.float64  # of the patch, as a wedge of the slope of the faces has it, at scale 1 [m]


@wp.func
def near_edge(x: wp.vec3, half: wp.vec3, outward: wp.vec3, side: float):
    """Return whether two faces of a box look at a surface at x that is outside of them, or a side of a cell inside."""
    count = int(0)
    for k in range(3):
        if wp.abs(x[k]) > half[k] - side and -wp.sign(x[k]) * outward[k] > float(FACING) * wp.length(outward):
            count += 1
    return count > 1


@wp.func
def narrow_dent(length: float, width: wp.float64):
    """Return the dent at scale 1 under E / (1 - nu^2) of a patch of a width [m]; ``length`` [m]: that of a wide one."""
    wide = wp.float64(length)
    slender = wp.log(wp.max(wide / width, wp.float64(1.0)))
    return float(wp.min(wide, width * (wp.float64(1.0) + SLENDER * slender)))


@wp.func
def face_over(away: wp.vec3d, side: wp.vec3d, facing: wp.vec3d, u: wp.vec3d, v: wp.vec3d, a: wp.float64, b: wp.float64):
    """Return the gap of a place with a box along the normal of its cell [m] and the face it has it with, -1 beside."""
    height = wp.float64(-1.0e30)
    top = int(-1)
    for k in range(3):
        d = away[k] + side[k] * (a * u[k] + b * v[k])
        if facing[k] > FACING:
            if d / facing[k] > height:
                height = d / facing[k]
                top = k
        elif d > wp.float64(0.0):
            return wp.float64(1.0e30), int(-1)
    return height, top


@wp.func
def crease_at(half: wp.vec3, x: wp.vec3d, F: wp.mat33d, shape: CellShape, area: float, gap: float, grown: float):
    """Return what a box presses of a cell; none where one face does, or the gap is not that of the nearest point.

    Args:
        half: Half extents of the box [m].
        x: The sample in the frame of the box [m].
        F: Deformation gradient of the body there, into that frame.
        shape: The cell.
        area: Its area at rest, at scale 1 [m^2].
        gap: Gap of the sample [m].
        grown: By how much the box is grown [m].
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    part = wp.sqrt(wp.float64(area)) / NUMBER
    across = wp.vec3d()
    across[wp.argmin(wp.abs(shape.normal))] = one
    first = part * wp.normalize(wp.cross(shape.normal, across))
    second = wp.cross(shape.normal, first)
    u = F * first
    v = F * second
    outward = wp.normalize(wp.cross(u, v))
    side = wp.vec3d()
    away = wp.vec3d()
    facing = wp.vec3d()
    best = int(-1)
    for k in range(3):
        side[k] = wp.where(x[k] < zero, -one, one)
        away[k] = wp.abs(x[k]) - wp.float64(half[k] + grown)
        facing[k] = -side[k] * outward[k]
        if facing[k] > FACING and (best < 0 or away[k] * facing[best] > away[best] * facing[k]):
            best = k
    crease = Crease()
    for k in range(3):
        if best >= 0 and k != best and facing[k] > FACING:
            turn = wp.vec2d(u[k], v[k]) * side[k] / facing[k] - wp.vec2d(u[best], v[best]) * side[best] / facing[best]
            if away[best] / facing[best] - away[k] / facing[k] < wp.length(turn) * NUMBER:
                crease.found = 1
    if crease.found == 0 or wp.abs(query_box(wp.vec3(x), half).distance - grown - gap) > 1.0e-6:
        return Crease()
    pressed = zero
    sloping = zero
    least = wp.float64(1.0e30)
    deepest = least
    touched = wp.vec3d()
    pull = wp.vec3d()
    centre = wp.vec3d()
    for place in range(PLACES * PLACES):
        a = wp.float64(place % PLACES) + (one - NUMBER) / two
        b = wp.float64(place / PLACES) + (one - NUMBER) / two
        far, _top = face_over(away, side, facing, u, v, AROUND * a, AROUND * b)
        deepest = wp.min(deepest, far)
        height, top = face_over(away, side, facing, u, v, a, b)
        if top < 0:
            continue
        if height < least:
            least = height
            crease.centre = a * first + b * second
        slope = wp.length(wp.vec2d(u[top], v[top])) / facing[top]
        eps = wp.sqrt(shape.least * shape.least + slope * slope)
        p = eps / two - LATE * shape.least - height
        share = wp.min(wp.max(p, zero) / eps, one)
        depth = wp.where(p < eps, p * share / two, p - eps / two)
        pressed += depth
        sloping += depth * slope
        touched[top] += share
        pull[top] += depth * side[top] / facing[top]
        centre += depth * (a * first + b * second)
    if pressed == zero:
        crease.normal = -outward
        crease.penetration = -least
        crease.onset = part * NUMBER / two + shape.least
        crease.firmness = one
        crease.width = shape.width
        return crease
    crease.centre = centre / pressed
    crease.normal = wp.normalize(pull)
    stiff = zero
    for k in range(3):
        if touched[k] > zero:
            stiff += touched[k] * crease.normal[k] * crease.normal[k] / (facing[k] * facing[k])
    share = (touched[0] + touched[1] + touched[2]) / (NUMBER * NUMBER)
    crease.firmness = stiff / (share * NUMBER * NUMBER)
    crease.penetration = two * wp.length(pull) / (NUMBER * NUMBER * crease.firmness * share)
    crease.onset = crease.penetration / share
    crease.width = two * wp.max(crease.penetration, -deepest) * pressed * part / wp.max(sloping, wp.float64(1.0e-12))
    return crease
