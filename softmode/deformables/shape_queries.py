"""Signed distance and normal of the rigid shapes that a soft body can touch, in the frame of the shape."""

import warp as wp
from newton import GeoType

wp.set_module_options({"enable_backward": False})

PLANE = int(GeoType.PLANE)
_SPHERE = int(GeoType.SPHERE)
_CAPSULE = int(GeoType.CAPSULE)
_CYLINDER = int(GeoType.CYLINDER)
_BOX = int(GeoType.BOX)
_MESH = int(GeoType.MESH)
_CONVEX_MESH = int(GeoType.CONVEX_MESH)

SUPPORTED_SHAPES = (
    GeoType.PLANE,
    GeoType.SPHERE,
    GeoType.CAPSULE,
    GeoType.CYLINDER,
    GeoType.BOX,
    GeoType.MESH,
    GeoType.CONVEX_MESH,
)
"""Shape types a soft body can touch."""


@wp.struct
class SurfaceQuery:
    """Distance of a point to a shape, in the frame of the shape."""

    distance: float  # [m], negative inside
    normal: wp.vec3  # outward, unit


@wp.func
def query_segment(x: wp.vec3, half_height: float, radius: float):
    """Return the distance to a capsule along Z."""
    out = SurfaceQuery()
    core = wp.vec3(0.0, 0.0, wp.clamp(x[2], -half_height, half_height))
    delta = x - core
    length = wp.length(delta)
    out.distance = length - radius
    out.normal = wp.where(length > 1.0e-9, delta / wp.max(length, 1.0e-9), wp.vec3(1.0, 0.0, 0.0))
    return out


@wp.func
def query_box(x: wp.vec3, half: wp.vec3):
    """Return the distance to a box centred at the origin."""
    out = SurfaceQuery()
    inside = wp.vec3(wp.abs(x[0]) - half[0], wp.abs(x[1]) - half[1], wp.abs(x[2]) - half[2])
    outside = wp.vec3(wp.max(inside[0], 0.0), wp.max(inside[1], 0.0), wp.max(inside[2], 0.0))
    length = wp.length(outside)
    if length > 0.0:
        out.distance = length
        out.normal = wp.vec3(
            wp.sign(x[0]) * outside[0] / length,
            wp.sign(x[1]) * outside[1] / length,
            wp.sign(x[2]) * outside[2] / length,
        )
        return out
    axis = int(0)
    if inside[1] > inside[axis]:
        axis = 1
    if inside[2] > inside[axis]:
        axis = 2
    out.distance = inside[axis]
    out.normal = wp.vec3()
    out.normal[axis] = wp.sign(x[axis])
    return out


@wp.func
def query_cylinder(x: wp.vec3, radius: float, half_height: float):
    """Return the distance to a cylinder along Z."""
    out = SurfaceQuery()
    across = wp.vec3(x[0], x[1], 0.0)
    rho = wp.length(across)
    radial = wp.where(rho > 1.0e-9, across / wp.max(rho, 1.0e-9), wp.vec3(1.0, 0.0, 0.0))
    axial = wp.vec3(0.0, 0.0, wp.sign(x[2]))
    dr = rho - radius
    dz = wp.abs(x[2]) - half_height
    if dr > 0.0 and dz > 0.0:
        out.distance = wp.sqrt(dr * dr + dz * dz)
        out.normal = (dr * radial + dz * axial) / out.distance
    elif dr > dz:
        out.distance = dr
        out.normal = radial
    else:
        out.distance = dz
        out.normal = axial
    return out


@wp.func
def query_mesh(x: wp.vec3, mesh: wp.uint64, scale: wp.vec3, reach: float):
    """Return the distance to a closed triangle mesh within ``reach``."""
    out = SurfaceQuery()
    out.distance = 1.0e6
    smallest = wp.min(wp.abs(scale[0]), wp.min(wp.abs(scale[1]), wp.abs(scale[2])))
    query = wp.mesh_query_point_sign_normal(mesh, wp.cw_div(x, scale), reach / smallest)
    if query.result:
        delta = x - wp.cw_mul(wp.mesh_eval_position(mesh, query.face, query.u, query.v), scale)
        length = wp.length(delta)
        out.distance = query.sign * length
        if length > 1.0e-7:
            out.normal = query.sign * delta / length
        else:
            out.normal = wp.normalize(wp.cw_div(wp.mesh_eval_face_normal(mesh, query.face), scale))
    return out


@wp.func
def query_shape(shape_type: int, scale: wp.vec3, mesh: wp.uint64, x: wp.vec3, reach: float):
    """Return the distance of ``x`` (shape frame) to a shape."""
    out = SurfaceQuery()
    out.distance = 1.0e6
    if shape_type == PLANE:
        bounded = scale[0] > 0.0 and scale[1] > 0.0
        if not bounded or (wp.abs(x[0]) <= 0.5 * scale[0] and wp.abs(x[1]) <= 0.5 * scale[1]):
            out.distance = x[2]
            out.normal = wp.vec3(0.0, 0.0, 1.0)
    elif shape_type == _SPHERE:
        out = query_segment(x, 0.0, scale[0])
    elif shape_type == _CAPSULE:
        out = query_segment(x, scale[1], scale[0])
    elif shape_type == _CYLINDER:
        out = query_cylinder(x, scale[0], scale[1])
    elif shape_type == _BOX:
        out = query_box(x, scale)
    elif shape_type == _MESH or shape_type == _CONVEX_MESH:
        out = query_mesh(x, mesh, scale, reach)
    return out
