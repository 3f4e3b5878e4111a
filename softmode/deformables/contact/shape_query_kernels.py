"""Signed distance and normal of the rigid shapes that a soft body can touch, in the frame of the shape.

A bounded plane and a heightfield are the tops of solids that go down without end: nothing gets lost below them.
"""

import warp as wp
from newton import GeoType

from softmode.deformables.model.declare import struct

wp.set_module_options({"enable_backward": False})

PLANE = int(GeoType.PLANE)
HEIGHTFIELD = int(GeoType.HFIELD)
SPHERE = int(GeoType.SPHERE)
CAPSULE = int(GeoType.CAPSULE)
_ELLIPSOID = int(GeoType.ELLIPSOID)
CYLINDER = int(GeoType.CYLINDER)
BOX = int(GeoType.BOX)
_MESH = int(GeoType.MESH)
_CONE = int(GeoType.CONE)
_CONVEX_MESH = int(GeoType.CONVEX_MESH)
SMOOTH = sum(1 << kind for kind in (PLANE, HEIGHTFIELD, SPHERE, CAPSULE, _ELLIPSOID))
"""Bits of the kinds of shapes without edges."""

SUPPORTED_SHAPES = (PLANE, HEIGHTFIELD, SPHERE, CAPSULE, _ELLIPSOID, CYLINDER, BOX, _MESH, _CONE, _CONVEX_MESH)
"""Shape types a soft body can touch."""


@struct
class SurfaceQuery:
    """Distance of a point to a shape, in the frame of the shape."""

    distance: float  # [m], negative inside
    normal: wp.vec3  # outward, unit


@struct
class Heightfields:
    """The heightfields of the model as Newton stores them: rows along Y, columns along X, split along (1, 1)."""

    index: wp.array[int]  # (shape_count,), -1 where the shape is none
    grid: wp.array[wp.vec3i]  # first elevation, rows, columns
    extent: wp.array[wp.vec4]  # half extents along X and Y, lowest and highest z [m]
    elevation: wp.array[float]  # 0..1 between lowest and highest


@wp.func
def surface(distance: float, normal: wp.vec3):
    """Return a distance with its normal."""
    out = SurfaceQuery()
    out.distance = distance
    out.normal = normal
    return out


@wp.func
def direction(delta: wp.vec3, length: float, fallback: wp.vec3):
    """Return a vector over its length, or another one where it has none."""
    return wp.where(length > 1.0e-9, delta / wp.max(length, 1.0e-9), fallback)


@wp.func
def query_segment(x: wp.vec3, half_height: float, radius: float):
    """Return the distance to a capsule along Z."""
    delta = x - wp.vec3(0.0, 0.0, wp.clamp(x[2], -half_height, half_height))
    length = wp.length(delta)
    return surface(length - radius, direction(delta, length, wp.vec3(1.0, 0.0, 0.0)))


@wp.func
def query_extents(excess: wp.vec3, side: wp.vec3):
    """Return the distance to a box of which a point exceeds the half extents by ``excess`` on the given sides."""
    outside = wp.max(excess, wp.vec3())
    length = wp.length(outside)
    if length > 0.0:
        return surface(length, wp.cw_mul(side, outside) / length)
    axis = int(0)
    if excess[1] > excess[axis]:
        axis = 1
    if excess[2] > excess[axis]:
        axis = 2
    normal = wp.vec3()
    normal[axis] = side[axis]
    return surface(excess[axis], normal)


@wp.func
def signs(x: wp.vec3):
    """Return +1 or -1 per component."""
    return wp.vec3(wp.sign(x[0]), wp.sign(x[1]), wp.sign(x[2]))


@wp.func
def query_box(x: wp.vec3, half: wp.vec3):
    """Return the distance to a box centred at the origin."""
    return query_extents(wp.abs(x) - half, signs(x))


@wp.func
def query_plane(x: wp.vec3, size: wp.vec3):
    """Return the distance to the plane z = 0, or to what is below its rectangle where it has a size."""
    if size[0] > 0.0 and size[1] > 0.0:
        excess = wp.vec3(wp.abs(x[0]) - 0.5 * size[0], wp.abs(x[1]) - 0.5 * size[1], x[2])
        return query_extents(excess, wp.vec3(wp.sign(x[0]), wp.sign(x[1]), 1.0))
    return surface(x[2], wp.vec3(0.0, 0.0, 1.0))


@wp.func
def query_cylinder(x: wp.vec3, radius: float, half_height: float):
    """Return the distance to a cylinder along Z."""
    across = wp.vec3(x[0], x[1], 0.0)
    rho = wp.length(across)
    radial = direction(across, rho, wp.vec3(1.0, 0.0, 0.0))
    axial = wp.vec3(0.0, 0.0, wp.sign(x[2]))
    dr = rho - radius
    dz = wp.abs(x[2]) - half_height
    if dr > 0.0 and dz > 0.0:
        distance = wp.sqrt(dr * dr + dz * dz)
        return surface(distance, (dr * radial + dz * axial) / distance)
    if dr > dz:
        return surface(dr, radial)
    return surface(dz, axial)


@wp.func
def query_cone(x: wp.vec3, radius: float, half_height: float):
    """Return the distance to a cone along Z, its apex at +half_height."""
    across = wp.vec3(x[0], x[1], 0.0)
    rho = wp.length(across)
    radial = direction(across, rho, wp.vec3(1.0, 0.0, 0.0))
    axis = wp.vec3(0.0, 0.0, 1.0)
    slant = wp.sqrt(radius * radius + 4.0 * half_height * half_height)
    # in the half plane (rho, z): outward normal of the flank, and distance from the rim along it towards the apex
    flank = (2.0 * half_height * radial + radius * axis) / slant
    up = (2.0 * half_height * axis - radius * radial) / slant
    from_rim = x + half_height * axis - radius * radial
    above = wp.dot(from_rim, flank)
    along = wp.dot(from_rim, up)
    below = -half_height - x[2]
    if above <= 0.0 and below <= 0.0:  # inside
        return surface(wp.max(above, below), wp.where(above > below, flank, -axis))
    # nearest of the base disc and the flank
    delta = wp.vec3(0.0, 0.0, -below)
    if rho > radius:
        delta = from_rim
    fallback = -axis
    other = above * flank
    if along < 0.0:
        other = from_rim
    elif along > slant:
        other = x - half_height * axis
    if wp.length_sq(other) < wp.length_sq(delta):
        delta = other
        fallback = flank
    distance = wp.length(delta)
    return surface(distance, direction(delta, distance, fallback))


@wp.func
def query_ellipsoid(x: wp.vec3, axes: wp.vec3):
    """Return the distance to an ellipsoid with half axes along X, Y, Z.

    The closest point y has y_i = r_i x_i / (s + r_i), r_i = (e_i / e_min)^2, with s the root of
    sum (r_i z_i / (s + r_i))^2 = 1, z = x / e (Eberly, Distance from a Point to an Ellipse, an Ellipsoid, or a
    Hyperellipsoid, 2013). Newton's method on the reciprocal root of that sum converges from the left of s in a few
    steps.
    """
    one = wp.float64(1.0)
    e = wp.vec3d(axes)
    least = wp.min(e[0], wp.min(e[1], e[2]))
    r = wp.vec3d()
    z = wp.vec3d()
    start = wp.float64(-1.0e300)
    for i in range(3):
        r[i] = (e[i] / least) * (e[i] / least)
        # off the planes of symmetry, where two points are closest, by less than the input's rounding
        z[i] = wp.max(wp.abs(wp.float64(x[i])) / e[i], wp.float64(1.0e-9))
        start = wp.max(start, r[i] * z[i] - r[i])
    s = start
    for _ in range(32):
        total = wp.float64(0.0)
        slope = wp.float64(0.0)
        for i in range(3):
            t = r[i] * z[i] / (s + r[i])
            total += t * t
            slope += t * t / (s + r[i])
        root = wp.sqrt(total)
        step = (root - one) * total / slope
        s += step
        if wp.abs(step) <= wp.float64(1.0e-13) * (s + one):
            break
    delta = wp.vec3d()
    normal = wp.vec3d()
    for i in range(3):
        side = wp.where(x[i] < 0.0, -one, one)
        share = z[i] / (s + r[i])  # y_i / (r_i e_i)
        delta[i] = side * share * s * e[i]  # x - y
        normal[i] = side * share * e[i]  # y_i / r_i, along y_i / e_i^2
    normal = wp.normalize(normal)
    return surface(float(wp.dot(delta, normal)), wp.vec3(normal))


@wp.func
def closest_on_triangle(x: wp.vec3, p: wp.vec3, q: wp.vec3, r: wp.vec3):
    """Return x minus the closest point of a triangle (Ericson, Real-Time Collision Detection, 2005, section 5.1.5).

    In float64: in float32 the closest point of a triangle of 0.3 m by 2 mm is 0.1 mm off, and the normal with it.
    """
    zero = wp.float64(0.0)
    a = wp.vec3d(p - x)
    b = wp.vec3d(q - x)
    c = wp.vec3d(r - x)
    ab = b - a
    ac = c - a
    d1 = -wp.dot(ab, a)
    d2 = -wp.dot(ac, a)
    d3 = -wp.dot(ab, b)
    d4 = -wp.dot(ac, b)
    d5 = -wp.dot(ab, c)
    d6 = -wp.dot(ac, c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    out = wp.vec3d()
    if d1 <= zero and d2 <= zero:
        out = a
    elif d3 >= zero and d4 <= d3:
        out = b
    elif d6 >= zero and d5 <= d6:
        out = c
    elif vc <= zero and d1 >= zero and d3 <= zero:
        out = a + d1 / (d1 - d3) * ab
    elif vb <= zero and d2 >= zero and d6 <= zero:
        out = a + d2 / (d2 - d6) * ac
    elif va <= zero and d4 >= d3 and d5 >= d6:
        out = b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
    else:
        out = a + (vb / (va + vb + vc)) * ab + (vc / (va + vb + vc)) * ac
    return wp.vec3(-out)


@wp.func
def field_point(fields: Heightfields, f: int, row: int, column: int):
    """Return a point of the grid of a heightfield."""
    grid = fields.grid[f]
    extent = fields.extent[f]
    height = fields.elevation[grid[0] + row * grid[2] + column]
    return wp.vec3(
        extent[0] * (2.0 * float(column) / float(grid[2] - 1) - 1.0),
        extent[1] * (2.0 * float(row) / float(grid[1] - 1) - 1.0),
        extent[2] + height * (extent[3] - extent[2]),
    )


@wp.func
def query_heightfield(x: wp.vec3, fields: Heightfields, f: int, reach: float):
    """Return the distance to the solid below the triangles of a heightfield, exact within ``reach``.

    Cells are searched in rings around the point until they are farther away than the nearest triangle.
    """
    out = surface(1.0e6, wp.vec3())
    grid = fields.grid[f]
    extent = fields.extent[f]
    side = wp.vec3(wp.sign(x[0]), wp.sign(x[1]), 1.0)
    excess = wp.vec3(wp.abs(x[0]) - extent[0], wp.abs(x[1]) - extent[1], x[2] - wp.max(extent[2], extent[3]))
    if wp.max(excess[0], wp.max(excess[1], excess[2])) > reach:
        return out
    # the cell below, and the height of its triangle there
    wide = 2.0 * extent[0] / float(grid[2] - 1)
    long = 2.0 * extent[1] / float(grid[1] - 1)
    u = wp.clamp((x[0] + extent[0]) / wide, 0.0, float(grid[2] - 1))
    v = wp.clamp((x[1] + extent[1]) / long, 0.0, float(grid[1] - 1))
    column = wp.min(int(u), grid[2] - 2)
    row = wp.min(int(v), grid[1] - 2)
    u -= float(column)
    v -= float(row)
    a = field_point(fields, f, row, column)
    c = field_point(fields, f, row + 1, column + 1)
    b = field_point(fields, f, row, column + 1)
    normal = wp.normalize(wp.cross(b - a, c - a))
    height = a[2] + u * (b[2] - a[2]) + v * (c[2] - b[2])
    if u < v:
        b = field_point(fields, f, row + 1, column)
        normal = wp.normalize(wp.cross(c - a, b - a))
        height = a[2] + v * (b[2] - a[2]) + u * (c[2] - b[2])
    beside = wp.max(excess[0], excess[1])
    below = x[2] - height
    if beside > 0.0 and below <= 0.0:  # before a wall
        return query_extents(wp.vec3(excess[0], excess[1], 0.0), side)
    best = wp.vec3(0.0, 0.0, below)
    nearest = reach * reach
    found = int(0)
    if beside <= 0.0 and (below < 0.0 or below < reach):
        nearest = below * below
        found = 1
    wall = int(0)
    if below < 0.0 and beside * beside < nearest:
        nearest = beside * beside
        wall = 1
    ring = int(0)
    last = wp.max(grid[1], grid[2])
    while ring < last:
        away = float(ring - 1) * wp.min(wide, long)  # to the cells of the ring at least
        if away > 0.0 and away * away > nearest:
            break
        for r in range(wp.max(row - ring, 0), wp.min(row + ring, grid[1] - 2) + 1):
            stride = wp.where(r == row - ring or r == row + ring, 1, wp.max(2 * ring, 1))
            for k in range(column - ring, column + ring + 1, stride):
                if k >= 0 and k <= grid[2] - 2:
                    corner = field_point(fields, f, r, k)
                    across = field_point(fields, f, r + 1, k + 1)
                    for half in range(2):  # two triangles on the diagonal
                        third = field_point(fields, f, r + half, k + 1 - half)
                        delta = closest_on_triangle(x, corner, third, across)
                        if wp.length_sq(delta) < nearest:
                            nearest = wp.length_sq(delta)
                            best = delta
                            found = 1
                            wall = 0
        ring += 1
    if wall == 1:
        return query_extents(wp.vec3(excess[0], excess[1], -1.0e6), side)
    if found == 1:
        sign = wp.where(below < 0.0, -1.0, 1.0)
        out.distance = sign * wp.length(best)
        # so near the surface that the direction is lost to rounding, the normal of the triangle below
        out.normal = normal
        if wp.length(best) > 1.0e-6 * (extent[0] + extent[1]):
            out.normal = sign * wp.normalize(best)
    return out


@wp.func
def query_mesh(x: wp.vec3, mesh: wp.uint64, scale: wp.vec3, reach: float):
    """Return the distance to a closed triangle mesh within ``reach``.

    The sign is the parity of a ray's crossings. That of the pseudo-normal takes faces closer together than 1e-3 of the
    mean edge for one, and so half of the points near a 0.2 mm thin plate for inside out; winding numbers are right
    too, where parts overlap as well, but take ten times as long.
    """
    out = surface(1.0e6, wp.vec3())
    smallest = wp.min(wp.abs(scale[0]), wp.min(wp.abs(scale[1]), wp.abs(scale[2])))
    query = wp.mesh_query_point_sign_parity(mesh, wp.cw_div(x, scale), reach / smallest, 1, 0.1)
    if query.result:
        p = wp.cw_mul(wp.mesh_get_point(mesh, 3 * query.face), scale)
        q = wp.cw_mul(wp.mesh_get_point(mesh, 3 * query.face + 1), scale)
        r = wp.cw_mul(wp.mesh_get_point(mesh, 3 * query.face + 2), scale)
        delta = closest_on_triangle(x, p, q, r)
        length = wp.length(delta)
        out.distance = query.sign * length
        if length > 1.0e-7:
            out.normal = query.sign * delta / length
        else:
            out.normal = wp.normalize(wp.cw_div(wp.mesh_eval_face_normal(mesh, query.face), scale))
    return out


@wp.func
def query_shape(shape_type: int, scale: wp.vec3, mesh: wp.uint64, x: wp.vec3, reach: float):
    """Return the distance of ``x`` (shape frame) to a shape but a heightfield; to a mesh where within ``reach``."""
    out = surface(1.0e6, wp.vec3())
    if shape_type == PLANE:
        out = query_plane(x, scale)
    elif shape_type == SPHERE:
        out = query_segment(x, 0.0, scale[0])
    elif shape_type == CAPSULE:
        out = query_segment(x, scale[1], scale[0])
    elif shape_type == CYLINDER:
        out = query_cylinder(x, scale[0], scale[1])
    elif shape_type == _CONE:
        out = query_cone(x, scale[0], scale[1])
    elif shape_type == _ELLIPSOID:
        out = query_ellipsoid(x, scale)
    elif shape_type == BOX:
        out = query_box(x, scale)
    elif shape_type == _MESH or shape_type == _CONVEX_MESH:
        out = query_mesh(x, mesh, scale, reach)
    return out
