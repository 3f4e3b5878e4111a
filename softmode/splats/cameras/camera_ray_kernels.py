"""Device code of `camera_meshes` for meshes of more triangles than a picture can show: rays instead of a scan.

A ray costs about the logarithm of the number of triangles, a scan costs all of them. Rays go through the tree that
Newton keeps for every mesh, and only where the ball around a mesh is in the picture.
"""

import warp as wp

from softmode.splats.cameras.camera_mesh_kernels import DARK, Faces, Points, Views, farther, last_row, rotation_of
from softmode.splats.raster.scan_kernels import NEAR, NOTHING, inverse_depth, key_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rays:
    """The shapes whose meshes are met by rays."""

    count: wp.array[int]  # (kinds,)
    slot: wp.array2d[int]  # (kinds, most of a kind)
    first: wp.array2d[int]  # (kinds, most of a kind) where their triangles begin
    center: wp.array2d[wp.vec3]  # (kinds, slots) middle of each shape in its frame [m]
    half: wp.array2d[wp.vec3]  # (kinds, slots) half of its extent [m]
    kind: wp.array[int]  # (world_count,)
    mesh: wp.array[wp.uint64]  # (shape_count,) of the model
    scale: wp.array[wp.vec3]  # (shape_count,)


@wp.func
def covered_span(c: float, z: float, radius: float, focal: float, middle: float, last: int) -> wp.vec2i:
    """Return the first and last pixel along an axis in which a ball can be, its middle at (c, z) before the camera."""
    free = z * z - radius * radius
    if z <= radius or free <= 1.0e-6 * z * z:
        return wp.vec2i(0, last)
    root = radius * wp.sqrt(wp.max(c * c + free, 0.0))
    low = focal * (c * z - root) / free + middle
    high = focal * (c * z + root) / free + middle
    return wp.vec2i(
        int(wp.clamp(wp.floor(low) - 1.0, 0.0, float(last) + 1.0)),
        int(wp.clamp(wp.floor(high) + 1.0, -1.0, float(last))),
    )


@wp.func
def meets_box(off: wp.vec3, ahead: wp.vec3, half: wp.vec3) -> bool:
    """Return whether a line, `off` from the middle of a box, meets it: no axis across both parts them."""
    a = wp.cross(off, ahead)
    slack = 1.001
    return (
        wp.abs(a[0]) <= slack * (half[1] * wp.abs(ahead[2]) + half[2] * wp.abs(ahead[1]))
        and wp.abs(a[1]) <= slack * (half[2] * wp.abs(ahead[0]) + half[0] * wp.abs(ahead[2]))
        and wp.abs(a[2]) <= slack * (half[0] * wp.abs(ahead[1]) + half[1] * wp.abs(ahead[0]))
    )


@wp.kernel
def trace_samples(
    faces: Faces,
    rays: Rays,
    views: Views,
    to_camera: wp.array2d[wp.mat44],
    spots: wp.array[wp.vec2],
    size: wp.vec2i,
    span: int,
    # Out:
    key_out: wp.array2d[wp.uint64],  # (view_count, height * width * samples)
):
    """Keep the nearest triangle in every sample; a thread has `span` pixels of a row."""
    view, row, part = wp.tid()
    world = views.world[view]
    kind = rays.kind[world]
    lens = views.intrinsics[view]
    samples = spots.shape[0]
    for h in range(rays.count[kind]):
        slot = rays.slot[kind, h]
        m = to_camera[view, slot]
        if m[3, 3] > 0.0:
            middle = wp.transform_point(m, rays.center[kind, slot])
            radius = wp.length(rays.half[kind, slot])
            down = covered_span(middle[1], middle[2], radius, lens[1], lens[3], size[1] - 1)
            if row >= down[0] and row <= down[1]:
                across = covered_span(middle[0], middle[2], radius, lens[0], lens[2], size[0] - 1)
                shape = faces.shape[world, slot]
                scale = rays.scale[shape]
                turn = wp.transpose(rotation_of(m))
                eye = last_row(m)
                start = wp.cw_div(eye, scale)
                box = rays.half[kind, slot]
                off = eye - rays.center[kind, slot]
                begin = wp.max(across[0], part * span)
                for column in range(begin, wp.min(across[1], (part + 1) * span - 1) + 1):
                    for sample in range(samples):
                        x = (float(column) + 0.5 + spots[sample][0] - lens[2]) / lens[0]
                        y = (float(row) + 0.5 + spots[sample][1] - lens[3]) / lens[1]
                        ahead = turn * wp.vec3(x, y, 1.0)
                        if meets_box(off, ahead, box):
                            ray = wp.cw_div(ahead, scale)
                            place = (row * size[0] + column) * samples + sample
                            known = key_out[view, place]
                            farthest = float(1.0e3)
                            if slot_known(known):
                                farthest = 1.001 / inverse_depth(known)
                            hit = wp.mesh_query_ray(rays.mesh[shape], start, ray, farthest)
                            if hit.result and hit.t > NEAR and wp.dot(ray, hit.normal) < 0.0:
                                found = key_at(farther(slot) / hit.t, rays.first[kind, h] + hit.face)
                                key_out[view, place] = wp.min(known, found)


@wp.func
def slot_known(key: wp.uint64) -> bool:
    """Return whether a sample has a triangle."""
    return key != wp.uint64(wp.static(NOTHING))


@wp.kernel
def trace_shadows(
    faces: Faces,
    rays: Rays,
    views: Views,
    casts: wp.array2d[wp.bool],
    to_light: wp.array2d[wp.mat44],
    samples: int,
    span: int,
    # Out:
    points: Points,
):
    """Darken the points from which a ray to the light meets a mesh; a thread has `span` pixels of a row."""
    view, row, part = wp.tid()
    world = views.world[view]
    kind = rays.kind[world]
    begin = (row * points.width + part * span) * samples
    for place in range(begin, begin + wp.min(span, points.width - part * span) * samples):
        depth = points.depth[view, place]
        if points.facing[view, place][0] > 0.0 and depth > DARK:
            at = points.place[view, place]
            for h in range(rays.count[kind]):
                slot = rays.slot[kind, h]
                if depth > DARK and casts[view, slot]:
                    m = to_light[world, slot]
                    middle = wp.transform_point(m, rays.center[kind, slot])
                    radius = wp.length(rays.half[kind, slot])
                    x = at[0] - middle[0]
                    y = at[1] - middle[1]
                    if x * x + y * y < radius * radius and depth > middle[2] - radius:
                        shape = faces.shape[world, slot]
                        from_origin = wp.vec3(at[0] - m[0, 3], at[1] - m[1, 3], depth - m[2, 3])
                        here = wp.transpose(rotation_of(m)) * from_origin
                        ahead = -wp.vec3(m[2, 0], m[2, 1], m[2, 2])
                        if meets_box(here - rays.center[kind, slot], ahead, rays.half[kind, slot]):
                            start = wp.cw_div(here, rays.scale[shape])
                            ray = wp.cw_div(ahead, rays.scale[shape])
                            if wp.mesh_query_ray_anyhit(rays.mesh[shape], start, ray, 1.0e8):
                                depth = DARK
            points.depth[view, place] = depth
