"""Device code of `camera_meshes`: triangles of all worlds into keys of samples, exact shadows, light.

The shadow of a mesh is found without a map of its depths: the points that the camera sees are listed in cells across
the light, and each triangle that faces away from the light darkens the listed points behind it (Johnson et al. 2005,
"The irregular Z-buffer"). Its edge is as sharp as that of a traced ray, at any size of the cells.
"""

import warp as wp

from softmode.splats.cameras.shadow_kernels import SplatMap, covered_share
from softmode.splats.raster.scan_kernels import (
    NEAR,
    NOTHING,
    SHADOW_LIGHT,
    box_of,
    decode,
    encode,
    inverse_depth,
    scan,
    sky_color,
)

wp.set_module_options({"enable_backward": False})

COPLANAR = wp.constant(1.0e-6)
"""By how much a shape counts as farther than the one before it, which settles who is seen where two are equally far."""
OFF = wp.constant(1.0e-4)
"""How far off a surface its shadow is looked up [m], as in Newton's sensor."""
DARK = wp.constant(-1.0e30)
"""Depth along the light of a point in the shadow, before which nothing can be."""
VISIBLE = wp.constant(1)
"""`newton.ShapeFlags.VISIBLE`."""


@wp.struct
class Faces:
    """The triangles of all kinds of worlds, each in the frame of its shape."""

    plane: wp.array[wp.vec4]  # (F,) outward unit normal, and the plane's distance from the origin along it [m]
    corner: wp.array2d[wp.vec3]  # (F, 3) counter-clockwise from outside [m]
    normal: wp.array2d[wp.vec3]  # (F, 3) unit normals for the light
    slot: wp.array[int]  # (F,) which shape of its world
    shape: wp.array2d[int]  # (world_count, slots) shape of the model, -1 for none


@wp.struct
class Views:
    """Where the cameras are."""

    world_to_camera: wp.array[wp.mat44]
    intrinsics: wp.array[wp.vec4]  # fx, fy, cx, cy [px]
    world: wp.array[int]


@wp.struct
class Points:
    """What the samples of the pictures show, one point for each shape in a pixel, in cells across the light."""

    place: wp.array2d[wp.vec2]  # (view_count, samples) across the light [m]
    depth: wp.array2d[float]  # along the light [m], DARK in the shadow
    facing: wp.array2d[wp.vec2]  # cosines to the light and to the zenith; the first is -1 where no point is
    following: wp.array2d[int]  # next sample in the cell, -1 for none
    first: wp.array2d[int]  # (view_count, cells^2) first sample in a cell, -1 for none
    width: int  # of the picture [px]


@wp.struct
class Look:
    """Light that is alike in all worlds."""

    above: wp.vec3  # linear ambient radiance
    below: wp.vec3
    sun: wp.vec3
    encoded: wp.array[float]  # (ENCODED + 1,) sRGB of linear light 0..1


@wp.func
def rotation_of(m: wp.mat44) -> wp.mat33:
    """Return the upper left block."""
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def rows_of(r: wp.mat33, t: wp.vec3, last: wp.vec3) -> wp.mat44:
    """Return a rotation and translation above a row that holds a vector and a one."""
    return wp.mat44(
        r[0, 0], r[0, 1], r[0, 2], t[0],
        r[1, 0], r[1, 1], r[1, 2], t[1],
        r[2, 0], r[2, 1], r[2, 2], t[2],
        last[0], last[1], last[2], 1.0,
    )  # fmt: skip


@wp.func
def last_row(m: wp.mat44) -> wp.vec3:
    """Return the vector that `rows_of` put below."""
    return wp.vec3(m[3, 0], m[3, 1], m[3, 2])


@wp.func
def pose_of(
    shape: int, transform: wp.array[wp.transform], body: wp.array[int], body_q: wp.array[wp.transform]
) -> wp.transform:
    """Return where a shape is in the world."""
    if body[shape] >= 0:
        return body_q[body[shape]] * transform[shape]
    return transform[shape]


@wp.func
def beyond(distance: float, rate: float, radius: float, slope: float) -> bool:
    """Return whether a ball is behind a plane and stays there on its way along the light.

    Its middle is `distance` before the plane and comes nearer by `rate`, both in units of the length of (1, slope).
    """
    return rate <= 0.0 and distance < -radius * wp.sqrt(1.0 + slope * slope)


@wp.func
def outside(p: wp.vec3, radius: float, ahead: wp.vec3, lens: wp.vec4, size: wp.vec2i) -> bool:
    """Return whether a ball in the frame of the camera is outside of the picture on all of its way along `ahead`."""
    if beyond(p[2], ahead[2], radius, 0.0):
        return True
    for axis in range(2):
        low = (-1.0 - lens[2 + axis]) / lens[axis]
        high = (float(size[axis]) + 1.0 - lens[2 + axis]) / lens[axis]
        if beyond(p[axis] - low * p[2], ahead[axis] - low * ahead[2], radius, low):
            return True
        if beyond(high * p[2] - p[axis], high * ahead[2] - ahead[axis], radius, high):
            return True
    return False


@wp.kernel
def place_shapes(
    faces: Faces,
    views: Views,
    # Model:
    flags: wp.array[int],
    transform: wp.array[wp.transform],
    body: wp.array[int],
    # State in:
    body_q: wp.array[wp.transform],
    # Boxes:
    kind: wp.array[int],  # (world_count,)
    center: wp.array2d[wp.vec3],  # (kinds, slots) middle of each shape in its frame [m]
    half: wp.array2d[wp.vec3],  # half of its extent [m]
    size: wp.vec2i,  # of the picture [px]
    frame: wp.mat33,  # rows: two axes across the light, the light's direction
    # Out:
    to_camera_out: wp.array2d[wp.mat44],  # (view_count, slots) shape to camera; below, the camera in the shape's frame
    casts_out: wp.array2d[wp.bool],  # (view_count, slots) whether its shadow can be in the picture
):
    """Bring every shape to every camera; one that is hidden or outside of the picture gets no last one."""
    view, slot = wp.tid()
    world = views.world[view]
    shape = faces.shape[world, slot]
    if shape < 0 or (flags[shape] & VISIBLE) == 0:
        to_camera_out[view, slot] = wp.mat44()
        casts_out[view, slot] = False
        return
    pose = pose_of(shape, transform, body, body_q)
    matrix = views.world_to_camera[view]
    turn = rotation_of(matrix)
    r = turn * wp.quat_to_matrix(wp.transform_get_rotation(pose))
    t = turn * wp.transform_get_translation(pose) + wp.vec3(matrix[0, 3], matrix[1, 3], matrix[2, 3])
    middle = r * center[kind[world], slot] + t
    radius = wp.length(half[kind[world], slot])
    lens = views.intrinsics[view]
    casts_out[view, slot] = not outside(
        middle, radius, turn * wp.vec3(frame[2, 0], frame[2, 1], frame[2, 2]), lens, size
    )
    if outside(middle, radius, wp.vec3(), lens, size):
        to_camera_out[view, slot] = wp.mat44()
        return
    to_camera_out[view, slot] = rows_of(r, t, -(wp.transpose(r) * t))


@wp.kernel
def light_shapes(
    faces: Faces,
    frame: wp.mat33,  # rows: two axes across the light, the light's direction
    # Model:
    flags: wp.array[int],
    transform: wp.array[wp.transform],
    body: wp.array[int],
    color: wp.array[wp.vec3],  # sRGB
    # State in:
    body_q: wp.array[wp.transform],
    # Out:
    to_light_out: wp.array2d[wp.mat44],  # (world_count, slots) shape to the light's frame; below, the zenith
    albedo_out: wp.array2d[wp.vec3],  # linear
):
    """Bring every shape to the light, and its colour to linear light."""
    world, slot = wp.tid()
    shape = faces.shape[world, slot]
    if shape < 0 or (flags[shape] & VISIBLE) == 0:
        to_light_out[world, slot] = wp.mat44()
        return
    pose = pose_of(shape, transform, body, body_q)
    r = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    zenith = wp.vec3(r[2, 0], r[2, 1], r[2, 2])
    to_light_out[world, slot] = rows_of(frame * r, frame * wp.transform_get_translation(pose), zenith)
    albedo_out[world, slot] = decode(color[shape])


@wp.kernel
def bound_casters(
    views: Views,
    casts: wp.array2d[wp.bool],  # (view_count, slots)
    to_light: wp.array2d[wp.mat44],
    kind: wp.array[int],  # (world_count,)
    center: wp.array2d[wp.vec3],  # (kinds, slots) middle of each shape in its frame [m]
    half: wp.array2d[wp.vec3],  # half of its extent [m], 0 along z for a sheet
    cells: int,
    # Out:
    grid_out: wp.array[wp.vec3],  # (view_count,) lowest corner across the light [m], cells per metre, 0 for no shadow
):
    """Find where across the light shapes are that cast shadows; a sheet that faces the light does not."""
    view = wp.tid()
    world = views.world[view]
    low = wp.vec2(1.0e30, 1.0e30)
    high = wp.vec2(-1.0e30, -1.0e30)
    for slot in range(to_light.shape[1]):
        m = to_light[world, slot]
        h = half[kind[world], slot]
        if casts[view, slot] and h[0] + h[1] > 0.0 and not (h[2] == 0.0 and m[2, 2] <= 0.0):
            p = wp.transform_point(m, center[kind[world], slot])
            for axis in range(2):
                extent = wp.abs(m[axis, 0]) * h[0] + wp.abs(m[axis, 1]) * h[1] + wp.abs(m[axis, 2]) * h[2]
                low[axis] = wp.min(low[axis], p[axis] - extent)
                high[axis] = wp.max(high[axis], p[axis] + extent)
    width = wp.max(high[0] - low[0], high[1] - low[1])
    rate = float(0.0)
    if width > 0.0:
        rate = float(cells) / (1.001 * width)
        low = low - wp.vec2(0.0005 * width, 0.0005 * width)
    grid_out[view] = wp.vec3(low[0], low[1], rate)


@wp.func
def window_in(tile: int, edge: int, width: int, height: int) -> wp.vec4i:
    """Return the left, top, right and bottom pixel of a square tile of an image."""
    across = (width + edge - 1) / edge
    left = (tile % across) * edge
    top = (tile / across) * edge
    return wp.vec4i(left, top, wp.min(left + edge, width) - 1, wp.min(top + edge, height) - 1)


@wp.kernel
def fill_samples(
    faces: Faces,
    span: wp.array[wp.vec2i],  # (world_count,) first triangle and number of triangles
    views: Views,
    to_camera: wp.array2d[wp.mat44],
    spots: wp.array[wp.vec2],
    reach: float,
    edge: int,  # of a tile [px]
    size: wp.vec2i,
    # Out:
    key_out: wp.array2d[wp.uint64],  # (view_count, height * width * samples)
):
    """Keep the nearest triangle in every sample; a thread has one triangle in one tile of the picture."""
    view, i, tile = wp.tid()
    own = span[views.world[view]]
    if i >= own[1]:
        return
    f = own[0] + i
    slot = faces.slot[f]
    m = to_camera[view, slot]
    p = faces.plane[f]
    n = wp.vec3(p[0], p[1], p[2])
    height = wp.dot(n, last_row(m)) - p[3]
    if height <= 0.0 or m[3, 3] == 0.0:
        return
    v0 = wp.transform_point(m, faces.corner[f, 0])
    v1 = wp.transform_point(m, faces.corner[f, 1])
    v2 = wp.transform_point(m, faces.corner[f, 2])
    if wp.max(v0[2], wp.max(v1[2], v2[2])) <= NEAR:
        return
    lens = views.intrinsics[view]
    box = box_of(lens, v0, v1, v2)
    window = window_in(tile, edge, size[0], size[1])
    margin = reach + 0.001
    left = wp.max(int(wp.ceil(wp.max(box[0] - 0.5 - margin, -1.0))), window[0])
    right = wp.min(int(wp.floor(wp.min(box[2] - 0.5 + margin, float(size[0])))), window[2])
    top = wp.max(int(wp.ceil(wp.max(box[1] - 0.5 - margin, -1.0))), window[1])
    bottom = wp.min(int(wp.floor(wp.min(box[3] - 0.5 + margin, float(size[1])))), window[3])
    if left > right or top > bottom:
        return
    plane = (-farther(slot) / height) * (rotation_of(m) * n)
    scan(
        wp.cross(v2, v1), wp.cross(v0, v2), wp.cross(v1, v0), plane,
        lens, wp.vec4i(left, top, right, bottom), 1, size[0], spots, reach, view, f, key_out,
    )  # fmt: skip


@wp.func
def cell_of(grid: wp.vec3, cells: int, x: float, y: float) -> wp.vec2i:
    """Return the cell of a place across the light."""
    last = float(cells - 1)
    return wp.vec2i(
        int(wp.clamp(wp.floor((x - grid[0]) * grid[2]), 0.0, last)),
        int(wp.clamp(wp.floor((y - grid[1]) * grid[2]), 0.0, last)),
    )


@wp.func
def farther(slot: int) -> float:
    """Return the factor on 1 / z by which a shape counts as farther than it is."""
    return 1.0 - COPLANAR * float(slot)


@wp.func
def slot_of(faces: Faces, key: wp.uint64) -> int:
    """Return the shape that a sample shows, -1 for none."""
    if key == wp.uint64(wp.static(NOTHING)):
        return -1
    return faces.slot[int(wp.uint32(key))]


@wp.func
def seen_before(faces: Faces, key: wp.array2d[wp.uint64], view: int, place: int, sample: int, slot: int) -> int:
    """Return the first sample of a pixel that shows a shape."""
    for other in range(sample):
        if slot_of(faces, key[view, place + other]) == slot:
            return other
    return sample


@wp.kernel
def list_points(
    faces: Faces,
    views: Views,
    to_camera: wp.array2d[wp.mat44],
    to_light: wp.array2d[wp.mat44],
    grid: wp.array[wp.vec3],
    cells: int,
    spots: wp.array[wp.vec2],
    size: wp.vec2i,
    span: int,
    key: wp.array2d[wp.uint64],
    # Out:
    points: Points,
):
    """Find the point and the normal of every shape in a pixel, and list those in the sun; `span` pixels a thread."""
    view, row, part = wp.tid()
    world = views.world[view]
    lens = views.intrinsics[view]
    own = grid[view]
    samples = spots.shape[0]
    for column in range(part * span, wp.min((part + 1) * span, size[0])):
        place = (row * size[0] + column) * samples
        for sample in range(samples):
            k = key[view, place + sample]
            slot = slot_of(faces, k)
            points.facing[view, place + sample] = wp.vec2(-1.0, 0.0)
            if slot >= 0 and seen_before(faces, key, view, place, sample, slot) == sample:
                f = int(wp.uint32(k))
                x = (float(column) + 0.5 + spots[sample][0] - lens[2]) / lens[0]
                y = (float(row) + 0.5 + spots[sample][1] - lens[3]) / lens[1]
                m = to_camera[view, slot]
                ray = wp.transpose(rotation_of(m)) * wp.vec3(x, y, 1.0)
                p = faces.plane[f]
                n = wp.vec3(p[0], p[1], p[2])
                eye = last_row(m)
                q = eye + ((p[3] - wp.dot(n, eye)) / wp.dot(n, ray)) * ray
                corner = faces.corner[f, 0]
                a = faces.corner[f, 1] - corner
                b = faces.corner[f, 2] - corner
                area = wp.dot(wp.cross(a, b), n)
                s = wp.clamp(wp.dot(wp.cross(q - corner, b), n) / area, 0.0, 1.0)
                t = wp.clamp(wp.dot(wp.cross(a, q - corner), n) / area, 0.0, 1.0 - s)
                n = wp.normalize((1.0 - s - t) * faces.normal[f, 0] + s * faces.normal[f, 1] + t * faces.normal[f, 2])
                light = to_light[world, slot]
                toward = -(light[2, 0] * n[0] + light[2, 1] * n[1] + light[2, 2] * n[2])
                at = wp.transform_point(light, q + OFF * n)
                points.facing[view, place + sample] = wp.vec2(toward, wp.dot(last_row(light), n))
                points.place[view, place + sample] = wp.vec2(at[0], at[1])
                points.depth[view, place + sample] = at[2]
                u = (at[0] - own[0]) * own[2]
                v = (at[1] - own[1]) * own[2]
                if toward > 0.0 and own[2] > 0.0 and u >= 0.0 and v >= 0.0 and u < float(cells) and v < float(cells):
                    cell = cell_of(own, cells, at[0], at[1])
                    points.following[view, place + sample] = wp.atomic_exch(
                        points.first, view, cell[1] * cells + cell[0], place + sample
                    )


@wp.kernel
def cast_shadows(
    faces: Faces,
    span: wp.array[wp.vec2i],  # (world_count,) first triangle and number of triangles
    views: Views,
    casts: wp.array2d[wp.bool],
    to_light: wp.array2d[wp.mat44],
    grid: wp.array[wp.vec3],
    cells: int,
    edge: int,  # of a tile [cells]
    key: wp.array2d[wp.uint64],
    # Out:
    points: Points,
):
    """Darken the listed points behind a triangle that faces away from the light; not those on the triangle itself."""
    view, i, tile = wp.tid()
    world = views.world[view]
    own = span[world]
    if i >= own[1]:
        return
    f = own[0] + i
    slot = faces.slot[f]
    if not casts[view, slot]:
        return
    m = to_light[world, slot]
    n = faces.plane[f]
    if m[2, 0] * n[0] + m[2, 1] * n[1] + m[2, 2] * n[2] <= 1.0e-6:
        return
    v0 = wp.transform_point(m, faces.corner[f, 0])
    v1 = wp.transform_point(m, faces.corner[f, 1])
    v2 = wp.transform_point(m, faces.corner[f, 2])
    a = v1 - v0
    b = v2 - v0
    area = a[0] * b[1] - a[1] * b[0]
    if area == 0.0:
        return
    low = cell_of(grid[view], cells, wp.min(v0[0], wp.min(v1[0], v2[0])), wp.min(v0[1], wp.min(v1[1], v2[1])))
    high = cell_of(grid[view], cells, wp.max(v0[0], wp.max(v1[0], v2[0])), wp.max(v0[1], wp.max(v1[1], v2[1])))
    window = window_in(tile, edge, cells, cells)
    nearest = wp.min(v0[2], wp.min(v1[2], v2[2]))
    per_area = 1.0 / area
    for row in range(wp.max(low[1], window[1]), wp.min(high[1], window[3]) + 1):
        for column in range(wp.max(low[0], window[0]), wp.min(high[0], window[2]) + 1):
            j = points.first[view, row * cells + column]
            while j >= 0:
                depth = points.depth[view, j]
                if depth > nearest:
                    x = points.place[view, j][0] - v0[0]
                    y = points.place[view, j][1] - v0[1]
                    s = (x * b[1] - y * b[0]) * per_area
                    t = (a[0] * y - a[1] * x) * per_area
                    if s >= -1.0e-5 and t >= -1.0e-5 and s + t <= 1.0 + 1.0e-5:
                        if v0[2] + s * a[2] + t * b[2] < depth and int(wp.uint32(key[view, j])) != f:
                            points.depth[view, j] = DARK
                j = points.following[view, j]


@wp.kernel
def shade_pixels(
    faces: Faces,
    views: Views,
    points: Points,
    albedo: wp.array2d[wp.vec3],  # (world_count, slots) linear
    look: Look,
    splats: SplatMap,
    # Worlds:
    horizon: wp.array[wp.vec3],
    zenith: wp.array[wp.vec3],
    light_gain: wp.array[wp.vec3],
    shape_segment: wp.array[int],  # (shape_count,), of size zero without segmentation
    samples: int,
    span: int,
    key: wp.array2d[wp.uint64],  # left without triangles, for the next frame
    # Out:
    rgb_out: wp.array3d[wp.vec3],
    depth_out: wp.array3d[float],
    segment_out: wp.array3d[int],
):
    """Light every shape in a pixel once, average over its samples, and paint the sky; `span` pixels a thread."""
    view, row, part = wp.tid()
    world = views.world[view]
    lens = views.intrinsics[view]
    width = rgb_out.shape[2]
    turn = wp.transpose(rotation_of(views.world_to_camera[view]))
    for column in range(part * span, wp.min((part + 1) * span, width)):
        place = (row * width + column) * samples
        radiance = wp.vec3()
        covered = float(0.0)
        nearest = float(0.0)
        nearest_slot = int(-1)
        for sample in range(samples):
            k = key[view, place + sample]
            slot = slot_of(faces, k)
            if slot >= 0:
                covered += 1.0
                near = inverse_depth(k) / farther(slot)
                if near > nearest:
                    nearest = near
                    nearest_slot = slot
                lit = place + seen_before(faces, key, view, place, sample, slot)
                facing = points.facing[view, lit]
                up = 0.5 * (facing[1] + 1.0)
                light = up * look.above + (1.0 - up) * look.below
                if facing[0] > 0.0:
                    depth = points.depth[view, lit]
                    left = float(SHADOW_LIGHT)
                    if depth > DARK:
                        left = 1.0 - (1.0 - SHADOW_LIGHT) * covered_share(splats, world, points.place[view, lit], depth)
                    light += (facing[0] * left) * look.sun
                radiance += wp.cw_mul(albedo[world, slot], light)
        color = wp.vec3()
        if covered > 0.0:
            color = wp.cw_mul(light_gain[world], encode(look.encoded, radiance / float(samples)))
        if covered < float(samples):
            x = (float(column) + 0.5 - lens[2]) / lens[0]
            sky = sky_color(
                horizon[world], zenith[world], turn * wp.vec3(x, (float(row) + 0.5 - lens[3]) / lens[1], 1.0)
            )
            if covered > 0.0:
                sky = encode(look.encoded, decode(color) + (1.0 - covered / float(samples)) * decode(sky))
            color = sky
        rgb_out[view, row, column] = color
        depth_out[view, row, column] = wp.where(nearest > 0.0, 1.0 / nearest, 0.0)
        if shape_segment.shape[0] > 0:
            segment_out[view, row, column] = -1
            if nearest_slot >= 0:
                segment_out[view, row, column] = shape_segment[faces.shape[world, nearest_slot]]
        for sample in range(samples):
            key[view, place + sample] = wp.uint64(wp.static(NOTHING))
