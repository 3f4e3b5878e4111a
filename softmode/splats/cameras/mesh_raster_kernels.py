"""Device code of `mesh_raster`: a map of shadows with soft edges, light, and the layers of a pixel."""

import warp as wp

from softmode.splats.raster.rasterizer_kernels import vec6
from softmode.splats.raster.scan_kernels import (
    NEAR,
    NOTHING,
    SHADOW_LIGHT,
    box_of,
    encode,
    inverse_depth,
    scan,
    sky_color,
)

wp.set_module_options({"enable_backward": False})

SAMPLES = 4
"""Samples of a pixel."""
REACHED = wp.constant(0.375)
"""How far a sample is from the middle of its pixel at most, along an axis [px]."""
LAYER = wp.constant(0.008)
"""Depth between samples of a pixel from which they are of two layers [m]."""
REACH = wp.constant(2)
"""Cells of the map of shadows to each side that soften an edge."""
OFF = wp.constant(3.5)
"""How far off a surface its shadow is looked up [cells], so that it does not shade itself."""
SOLID = wp.constant(0.3)
"""Least opacity of a splat that casts a shadow."""
WIDEST = wp.constant(8.0)
"""Largest half width of a splat in the map of shadows [cells]."""
SPOTS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""Where the samples are from the middle of their pixel; no two share a row or a column."""

PLANK = wp.constant(wp.vec2(0.09, 0.60))
"""Width and length of a plank of a table or floor [m]."""
GRAIN = wp.constant(0.004)
"""Width of the grain of wood [m]."""

# The room in which films are shot: a second light, which casts no shadow, and walls around all.
FILL_DIRECTION = wp.constant(wp.normalize(wp.vec3(0.55, -0.75, -0.45)))
"""Direction in which the second light travels."""
FILL = wp.constant(wp.vec3(0.20, 0.22, 0.26))
"""Its linear radiance."""
ROOM_LOW, ROOM_HIGH = wp.constant(wp.vec3(-1.1, -1.6, -0.75)), wp.constant(wp.vec3(3.0, 1.9, 1.9))
"""Lowest and highest corner of the room [m]."""
WALL, FLOOR = wp.constant(wp.vec3(0.70, 0.76, 0.80)), wp.constant(wp.vec3(0.55, 0.46, 0.38))
"""Colours of its walls and its floor, sRGB."""

layer = wp.types.vector(length=4, dtype=float)


@wp.struct
class Triangles:
    """The triangles of a world."""

    corner: wp.array[wp.vec3]  # (V,) in the frame of the body [m]
    normal: wp.array[wp.vec3]  # (V,)
    body: wp.array[int]  # (V,) body of the world, -1 for none
    face: wp.array[wp.vec3i]  # (F,) those that move last
    color: wp.array[wp.vec4]  # (F,) linear, and a factor on 1 / z that settles who is seen of faces in one plane
    patch: wp.array[int]  # (F,) smooth patch that it is of
    closed: wp.array[wp.bool]  # (F,) whether the face is of a closed mesh, whose inside nobody sees
    body_start: wp.array[int]  # (world_count,)
    wooden: wp.array[wp.bool]  # (F,) whether the face is made of planks


@wp.struct
class Light:
    """What falls on meshes, and the map of what stands in the sun."""

    frame: wp.mat33  # rows: two axes across the light, the light's direction
    corner: wp.vec2  # lowest corner of the map across the light [m]
    cell: float  # edge of a cell [m]
    above: wp.vec3  # linear ambient radiance
    below: wp.vec3
    sun: wp.vec3
    room: wp.bool  # whether there is a room, with its light, in place of the sky
    horizon: wp.vec3  # sRGB
    zenith: wp.vec3
    encoded: wp.array[float]  # (ENCODED + 1,) sRGB of linear light 0..1


@wp.struct
class Views:
    """Where the cameras are."""

    world_to_camera: wp.array[wp.mat44]
    intrinsics: wp.array[wp.vec4]  # fx, fy, cx, cy [px]
    world: wp.array[int]


@wp.kernel
def move_corners(
    triangles: Triangles,
    body_q: wp.array[wp.transform],
    # Out:
    corner_out: wp.array2d[wp.vec3],  # (world_count, V) [m]
    normal_out: wp.array2d[wp.vec3],
):
    """Bring the corners to the world."""
    world, i = wp.tid()
    body = triangles.body[i]
    p = triangles.corner[i]
    n = triangles.normal[i]
    if body >= 0:
        pose = body_q[triangles.body_start[world] + body]
        p = wp.transform_point(pose, p)
        n = wp.transform_vector(pose, n)
    corner_out[world, i] = p
    normal_out[world, i] = n


@wp.kernel
def fill_samples(
    triangles: Triangles,
    corner: wp.array2d[wp.vec3],
    views: Views,
    spots: wp.array[wp.vec2],
    size: wp.vec2i,
    bands: int,
    # Out:
    key_out: wp.array2d[wp.uint64],  # (view_count, height * width * SAMPLES)
):
    """Keep the nearest triangle in every sample; a thread takes every `bands`-th row of a triangle."""
    view, f, band = wp.tid()
    world = views.world[view]
    matrix = views.world_to_camera[view]
    index = triangles.face[f]
    v0 = wp.transform_point(matrix, corner[world, index[0]])
    v1 = wp.transform_point(matrix, corner[world, index[1]])
    v2 = wp.transform_point(matrix, corner[world, index[2]])
    far = wp.max(v0[2], wp.max(v1[2], v2[2]))
    if far <= NEAR:
        return
    n = wp.cross(v1 - v0, v2 - v0)
    det = wp.dot(n, v0)
    if wp.abs(det) < 1.0e-20 or (det > 0.0 and triangles.closed[f]):
        return
    lens = views.intrinsics[view]
    box = box_of(lens, v0, v1, v2)
    if box[0] > float(size[0]) or box[1] > float(size[1]) or box[2] < 0.0 or box[3] < 0.0:
        return
    left = int(wp.max(box[0], 0.0))
    right = int(wp.min(box[2], float(size[0] - 1)))
    top = int(wp.max(box[1], 0.0))
    bottom = int(wp.min(box[3], float(size[1] - 1)))
    sign = wp.sign(det)
    start = top + (band - top % bands + bands) % bands
    scan(
        sign * wp.cross(v1, v2), sign * wp.cross(v2, v0), sign * wp.cross(v0, v1), (triangles.color[f][3] / det) * n,
        lens, wp.vec4i(left, start, right, bottom), bands, size[0], spots, REACHED, view, f, key_out,
    )  # fmt: skip


@wp.kernel
def fill_shadow(
    triangles: Triangles,
    corner: wp.array2d[wp.vec3],
    light: Light,
    first: int,
    # Out:
    depth_out: wp.array3d[float],  # (world_count, cells, cells) nearest depth along the light [m]
):
    """Draw the faces from `first` on as the sun sees them."""
    world, f = wp.tid()
    index = triangles.face[first + f]
    v0 = to_map(light, corner[world, index[0]])
    v1 = to_map(light, corner[world, index[1]])
    v2 = to_map(light, corner[world, index[2]])
    a = v1 - v0
    b = v2 - v0
    area = a[0] * b[1] - a[1] * b[0]
    if wp.abs(area) < 1.0e-12 or (area > 0.0 and triangles.closed[first + f]):
        return
    per_area = 1.0 / area
    last = depth_out.shape[1] - 1
    left = wp.max(0, int(wp.ceil(wp.min(v0[0], wp.min(v1[0], v2[0])))))
    right = wp.min(last, int(wp.floor(wp.max(v0[0], wp.max(v1[0], v2[0])))))
    top = wp.max(0, int(wp.ceil(wp.min(v0[1], wp.min(v1[1], v2[1])))))
    bottom = wp.min(last, int(wp.floor(wp.max(v0[1], wp.max(v1[1], v2[1])))))
    for row in range(top, bottom + 1):
        y = float(row) - v0[1]
        for column in range(left, right + 1):
            x = float(column) - v0[0]
            s = (x * b[1] - y * b[0]) * per_area
            t = (a[0] * y - a[1] * x) * per_area
            if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
                wp.atomic_min(depth_out, world, row, column, v0[2] + s * a[2] + t * b[2])


@wp.func
def to_map(light: Light, p: wp.vec3) -> wp.vec3:
    """Return where a point is in the map, in cells from the centre of the first one, and its depth [m]."""
    q = light.frame * p
    scale = 1.0 / light.cell
    return wp.vec3(scale * (q[0] - light.corner[0]) - 0.5, scale * (q[1] - light.corner[1]) - 0.5, q[2])


@wp.kernel
def fill_splat_shadow(
    mean: wp.array2d[wp.vec3],  # (1|world_count, splat_count) [m]
    covariance: wp.array2d[vec6],  # (1|world_count, splat_count) [m^2]
    opacity: wp.array2d[float],
    light: Light,
    # Out:
    depth_out: wp.array3d[float],
):
    """Draw splats as the sun sees them: ellipses of one and a half standard deviations, flat at the mean."""
    world, i = wp.tid()
    p = mean[world % mean.shape[0], i]
    if opacity[world % opacity.shape[0], i] < SOLID or not (wp.length(p) < 1.0e6):
        return
    center = to_map(light, p)
    c = covariance[world % covariance.shape[0], i]
    sigma = wp.mat33(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5])
    first = wp.vec3(light.frame[0, 0], light.frame[0, 1], light.frame[0, 2])
    second = wp.vec3(light.frame[1, 0], light.frame[1, 1], light.frame[1, 2])
    unit = 2.25 / (light.cell * light.cell)
    xx = wp.dot(first, sigma * first) * unit + 0.25
    xy = wp.dot(first, sigma * second) * unit
    yy = wp.dot(second, sigma * second) * unit + 0.25
    det = wp.max(xx * yy - xy * xy, 1.0e-6)
    x_reach = wp.min(wp.sqrt(xx), WIDEST)
    y_reach = wp.min(wp.sqrt(yy), WIDEST)
    last = depth_out.shape[1] - 1
    for row in range(
        wp.max(0, int(wp.ceil(center[1] - y_reach))), wp.min(last, int(wp.floor(center[1] + y_reach))) + 1
    ):
        y = float(row) - center[1]
        for column in range(
            wp.max(0, int(wp.ceil(center[0] - x_reach))), wp.min(last, int(wp.floor(center[0] + x_reach))) + 1
        ):
            x = float(column) - center[0]
            if yy * x * x - 2.0 * xy * x * y + xx * y * y <= det:
                wp.atomic_min(depth_out, world, row, column, center[2])


@wp.func
def hidden(depth: wp.array3d[float], world: int, column: int, row: int, z: float) -> float:
    """Return 1 where something stands between a cell's light and that depth, else 0."""
    return wp.where(depth[world, row, column] < z, 1.0, 0.0)


@wp.func
def shaded(light: Light, depth: wp.array3d[float], world: int, p: wp.vec3) -> float:
    """Return how much of the sun a point lacks, 0..1, smooth over the cells around it."""
    q = to_map(light, p)
    column = int(wp.floor(q[0]))
    row = int(wp.floor(q[1]))
    far = REACH + 1
    last = depth.shape[1] - 1 - far
    if column < REACH or row < REACH or column > last or row > last:
        return 0.0
    corners = (
        hidden(depth, world, column - REACH, row - REACH, q[2])
        + hidden(depth, world, column + far, row - REACH, q[2])
        + hidden(depth, world, column - REACH, row + far, q[2])
        + hidden(depth, world, column + far, row + far, q[2])
        + hidden(depth, world, column, row, q[2])
    )
    if corners == 0.0 or corners == 5.0:
        return corners / 5.0
    covered = float(0.0)
    total = float(0.0)
    for j in range(row - REACH, row + far + 1):
        for i in range(column - REACH, column + far + 1):
            weight = (float(far) - wp.abs(float(i) - q[0])) * (float(far) - wp.abs(float(j) - q[1]))
            if weight > 0.0:
                total += weight
                covered += weight * hidden(depth, world, i, j, q[2])
    return covered / total


@wp.func
def planks(x: float, y: float, footprint: float) -> float:
    """Return how bright wood is at a point [m], about 1; what is finer than a pixel's footprint [m] is left out."""
    row = wp.floor(x / PLANK[0])
    shift = wp.randf(wp.rand_init(7, int(row) + 4096))
    column = wp.floor(y / PLANK[1] + shift)
    own = wp.randf(wp.rand_init(int(row) + 4096, int(column) + 4096))
    across = wp.abs(x / PLANK[0] - row - 0.5) * PLANK[0]
    along = wp.abs(y / PLANK[1] + shift - column - 0.5) * PLANK[1]
    seam = wp.max(across - 0.5 * PLANK[0], along - 0.5 * PLANK[1])
    width = wp.max(0.0008, 0.5 * footprint)
    dark = wp.clamp(1.0 + (seam + width) / width, 0.0, 1.0) * 0.0008 / width
    bend = 0.8 * wp.sin(9.0 * y + 40.0 * own) + 0.5 * wp.sin(23.0 * y + 60.0 * own)
    grain = float(0.0)
    if footprint < 0.75 * GRAIN:
        place = wp.vec2(x / GRAIN + bend + 50.0 * own, y / (14.0 * GRAIN) + 90.0 * own)
        grain = 0.14 * wp.clamp(1.5 - 2.0 * footprint / GRAIN, 0.0, 1.0) * wp.noise(wp.uint32(5), place)
    grain += 0.03 * wp.sin(0.35 * (x / GRAIN + bend) + 50.0 * own)
    return (0.92 + 0.16 * own + grain) * (1.0 - 0.55 * dark)


@wp.func
def room_color(eye: wp.vec3, ray: wp.vec3, pixel: float) -> wp.vec3:
    """Return the colour of floor, wall or ceiling along a ray from within the room; corners are darker."""
    first = float(1.0e30)
    side = int(0)
    for axis in range(3):
        if ray[axis] != 0.0:
            edge = wp.where(ray[axis] > 0.0, ROOM_HIGH[axis], ROOM_LOW[axis])
            t = (edge - eye[axis]) / ray[axis]
            if t > 0.0 and t < first:
                first = t
                side = axis
    p = eye + first * ray
    footprint = pixel * first
    nearest = float(1.0e30)  # other wall
    for axis in range(3):
        if axis != side:
            nearest = wp.min(nearest, wp.min(p[axis] - ROOM_LOW[axis], ROOM_HIGH[axis] - p[axis]))
    corner = 1.0 - 0.28 * wp.exp(-nearest / 0.35)
    if side == 2 and ray[2] < 0.0:
        from_middle = wp.length(wp.vec2(p[0] - 0.35, p[1]))
        flat = footprint * wp.length(ray) / -ray[2]
        return FLOOR * (corner * planks(p[1], p[0], flat) * (0.72 + 0.28 * wp.clamp(from_middle, 0.0, 1.0)))
    height = p[2] - ROOM_LOW[2]
    board = wp.clamp((0.10 - height) / (footprint + 0.002) + 0.5, 0.0, 1.0)
    tone = 0.84 + 0.16 * wp.clamp(height / 2.2, 0.0, 1.0)
    if side == 0:
        tone *= 0.94
    wall = WALL * (corner * tone)
    return board * 0.93 * corner * wp.vec3(1.0, 1.0, 1.0) + (1.0 - board) * wall


@wp.func
def behind_all(light: Light, eye: wp.vec3, ray: wp.vec3, pixel: float) -> wp.vec3:
    """Return the colour of room or sky along a ray."""
    if light.room:
        return room_color(eye, ray, pixel)
    return sky_color(light.horizon, light.zenith, ray)


@wp.func
def shade(
    triangles: Triangles,
    corner: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    light: Light,
    shadow: wp.array3d[float],
    world: int,
    f: int,
    eye: wp.vec3,
    ray: wp.vec3,
    pixel: float,
) -> wp.vec3:
    """Return the colour of a triangle where a ray meets it, or at the nearest of its points."""
    index = triangles.face[f]
    p0 = corner[world, index[0]]
    a = corner[world, index[1]] - p0
    b = corner[world, index[2]] - p0
    across = wp.cross(ray, b)
    det = wp.dot(a, across)
    s = float(0.0)
    t = float(0.0)
    if det != 0.0:
        from_corner = eye - p0
        s = wp.clamp(wp.dot(from_corner, across) / det, 0.0, 1.0)
        t = wp.clamp(wp.dot(ray, wp.cross(from_corner, a)) / det, 0.0, 1.0 - s)
    n = wp.normalize(
        (1.0 - s - t) * normal[world, index[0]] + s * normal[world, index[1]] + t * normal[world, index[2]]
    )
    if wp.dot(wp.cross(a, b), ray) > 0.0:  # seen from behind
        n = -n
    up = 0.5 * (n[2] + 1.0)
    received = up * light.above + (1.0 - up) * light.below
    toward = -wp.dot(n, wp.vec3(light.frame[2, 0], light.frame[2, 1], light.frame[2, 2]))
    if toward > 0.0:
        p = p0 + s * a + t * b + OFF * light.cell * n
        left = 1.0 - (1.0 - SHADOW_LIGHT) * shaded(light, shadow, world, p)
        received += toward * left * light.sun
    if light.room:
        received += wp.max(-wp.dot(n, FILL_DIRECTION), 0.0) * FILL
    color = triangles.color[f]
    if triangles.wooden[f]:
        p = p0 + s * a + t * b
        sight = p - eye
        received *= planks(p[0], p[1], pixel * wp.dot(sight, sight) / wp.max(wp.abs(wp.dot(sight, n)), 1.0e-6))
    return encode(light.encoded, wp.cw_mul(wp.vec3(color[0], color[1], color[2]), received))


@wp.func
def patch_of(triangles: Triangles, key: wp.uint64) -> int:
    """Return the patch that a sample shows, -1 for none."""
    if key == wp.uint64(wp.static(NOTHING)):
        return -1
    return triangles.patch[int(wp.uint32(key))]


@wp.kernel
def shade_pixels(
    triangles: Triangles,
    corner: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    views: Views,
    light: Light,
    shadow: wp.array3d[float],
    key: wp.array2d[wp.uint64],  # left without triangles, for the next frame
    # What is behind and between the meshes, of size zero without:
    plate_rgb: wp.array3d[wp.vec3],
    plate_alpha: wp.array3d[float],
    plate_depth: wp.array3d[float],  # [m], 0 where nothing is
    span: int,
    # Out:
    rgb_out: wp.array3d[wp.vec3],  # far layer
    depth_out: wp.array3d[float],  # of the far layer [m], 0 for the sky
    near_out: wp.array3d[layer],  # colour times coverage, and coverage, of what stands before it
    near_depth_out: wp.array3d[float],
):
    """Light every smooth patch of a pixel once, and part its samples where an edge stands before something farther.

    A thread takes `span` pixels of a row.
    """
    view, row, part = wp.tid()
    matrix = views.world_to_camera[view]
    lens = views.intrinsics[view]
    world = views.world[view]
    turn = wp.transpose(wp.mat33(
        matrix[0, 0], matrix[0, 1], matrix[0, 2],
        matrix[1, 0], matrix[1, 1], matrix[1, 2],
        matrix[2, 0], matrix[2, 1], matrix[2, 2],
    ))  # fmt: skip
    eye = -(turn * wp.vec3(matrix[0, 3], matrix[1, 3], matrix[2, 3]))
    width = rgb_out.shape[2]
    pixel = 1.0 / lens[0]
    has_plate = plate_rgb.shape[0] > 0
    for column in range(part * span, wp.min((part + 1) * span, width)):
        x = (float(column) + 0.5 - lens[2]) / lens[0]
        ray = turn * wp.vec3(x, (float(row) + 0.5 - lens[3]) / lens[1], 1.0)
        place = (row * width + column) * wp.static(SAMPLES)
        k = key[view, place]
        patch = patch_of(triangles, k)
        alike = (
            patch == patch_of(triangles, key[view, place + 1])
            and patch == patch_of(triangles, key[view, place + 2])
            and patch == patch_of(triangles, key[view, place + 3])
        )
        if alike and not has_plate:  # most pixels
            color = wp.vec3()
            z = float(0.0)
            if patch < 0:
                color = behind_all(light, eye, ray, pixel)
            else:
                color = shade(triangles, corner, normal, light, shadow, world, int(wp.uint32(k)), eye, ray, pixel)
                z = 1.0 / inverse_depth(k)
            rgb_out[view, row, column] = color
            depth_out[view, row, column] = z
            near_out[view, row, column] = layer()
        else:
            behind = float(0.0)
            if has_plate:
                behind = plate_depth[view, row, column]
            # Depths of the samples, 0 for what is no mesh, and the nearest of all.
            depths = wp.vec4()
            patches = wp.vec4i(-1, -1, -1, -1)
            nearest = float(1.0e30)
            for sample in range(wp.static(SAMPLES)):
                k = key[view, place + sample]
                depths[sample] = behind
                patch = patch_of(triangles, k)
                if patch >= 0 and (behind <= 0.0 or (1.0 / inverse_depth(k)) < behind):
                    depths[sample] = 1.0 / inverse_depth(k)
                    patches[sample] = patch
                if depths[sample] > 0.0:
                    nearest = wp.min(nearest, depths[sample])
            limit = nearest + LAYER + 0.01 * nearest
            near = layer()
            far = layer()
            far_depth = float(1.0e30)
            for sample in range(wp.static(SAMPLES)):
                same = float(0.0)
                for other in range(wp.static(SAMPLES)):
                    if patches[other] == patches[sample]:
                        same += 1.0
                        if other < sample:  # it was counted there
                            same -= 8.0
                if same > 0.0:
                    if patches[sample] >= 0:
                        face = int(wp.uint32(key[view, place + sample]))
                        color = shade(triangles, corner, normal, light, shadow, world, face, eye, ray, pixel)
                    else:
                        color = behind_all(light, eye, ray, pixel)
                        if has_plate:
                            color = plate_rgb[view, row, column] + (1.0 - plate_alpha[view, row, column]) * color
                    weighted = same * layer(color[0], color[1], color[2], 1.0)
                    if depths[sample] > 0.0 and depths[sample] < limit:
                        near += weighted
                    else:
                        far += weighted
                        if depths[sample] > 0.0:
                            far_depth = wp.min(far_depth, depths[sample])
            if far[3] == 0.0:  # one layer is the far one
                far = near
                far_depth = nearest
                near = layer()
            rgb_out[view, row, column] = wp.vec3(far[0], far[1], far[2]) / far[3]
            depth_out[view, row, column] = wp.where(far_depth < 1.0e29, far_depth, 0.0)
            near_out[view, row, column] = near / float(wp.static(SAMPLES))
            near_depth_out[view, row, column] = nearest
        for sample in range(wp.static(SAMPLES)):
            key[view, place + sample] = wp.uint64(wp.static(NOTHING))


@wp.kernel
def draw_rings(
    center: wp.array[wp.vec3],  # (world_count,) [m]
    radius: wp.array[float],  # (world_count,) [m]
    color: wp.vec3,  # sRGB
    width: float,  # of the line [px]
    views: Views,
    depth: wp.array3d[float],  # of the far layer [m]
    # Out:
    rgb_out: wp.array3d[wp.vec3],
):
    """Draw a thin ring that faces the camera around a place of each world; it is faint behind meshes."""
    view, row = wp.tid()
    world = views.world[view]
    lens = views.intrinsics[view]
    q = wp.transform_point(views.world_to_camera[view], center[world])
    if q[2] <= NEAR:
        return
    x = lens[0] * q[0] / q[2] + lens[2] - 0.5
    y = lens[1] * q[1] / q[2] + lens[3] - 0.5 - float(row)
    r = lens[0] * radius[world] / q[2]
    reach = (r + width) * (r + width) - y * y
    if reach <= 0.0:
        return
    half = wp.sqrt(reach)
    for column in range(
        int(wp.max(0.0, wp.ceil(x - half))), int(wp.min(float(rgb_out.shape[2] - 1), wp.floor(x + half))) + 1
    ):
        off = wp.abs(wp.length(wp.vec2(float(column) - x, y)) - r)
        strength = wp.clamp(0.5 * width + 0.5 - off, 0.0, 1.0)
        z = depth[view, row, column]
        if z > 0.0 and z < q[2]:
            strength *= 0.3
        rgb_out[view, row, column] = wp.lerp(rgb_out[view, row, column], color, strength)


@wp.kernel
def join_layers(
    rgb: wp.array3d[wp.vec3],  # splats before the far layer
    alpha: wp.array3d[float],
    depth: wp.array3d[float],  # of splats and far layer, expected [m]
    far_rgb: wp.array3d[wp.vec3],
    far_depth: wp.array3d[float],
    near: wp.array3d[layer],
    near_depth: wp.array3d[float],
    span: int,
    # Out:
    bytes_out: wp.array4d[wp.uint8],  # (view_count, height, width, 3)
):
    """Put the near layer before the splats, or behind them where they are nearer, and round to bytes."""
    view, row, part = wp.tid()
    for column in range(part * span, wp.min((part + 1) * span, rgb.shape[2])):
        color = rgb[view, row, column]
        front = near[view, row, column]
        if front[3] > 0.0:
            edge = wp.vec3(front[0], front[1], front[2])
            covered = alpha[view, row, column]
            between = depth[view, row, column] - (1.0 - covered) * far_depth[view, row, column]
            if between < covered * near_depth[view, row, column]:
                color += (1.0 - covered) * (edge - front[3] * far_rgb[view, row, column])
            else:
                color = edge + (1.0 - front[3]) * color
        for channel in range(3):
            bytes_out[view, row, column, channel] = wp.uint8(wp.clamp(color[channel], 0.0, 1.0) * 255.0 + 0.5)
