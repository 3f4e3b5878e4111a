"""Device code shared by pictures of meshes: triangles into samples of pixels, and light into colours.

A sample of a pixel keeps its nearest triangle as one number, depth above and triangle below, by an atomic minimum, so
that the order of the threads does not matter. Edges are tested in homogeneous form (Olano and Greer 1997, "Triangle
scan conversion using 2D homogeneous coordinates"), which needs no clipping at the near plane.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NOTHING = 0xFFFFFFFFFFFFFFFF
"""A sample without a triangle."""
NEAR = wp.constant(0.001)
"""Nearest visible forward depth of a mesh [m]."""
WIDE = wp.constant(16)
"""Pixels across a triangle from which the ends of its rows are found before its pixels are tested."""
SLACK = wp.constant(1.0e-4)
"""How far outside of an edge a sample still counts [px], so that rounding opens no gap between two triangles."""
SHADOW_LIGHT = wp.constant(0.3)
"""Share of the sunlight that is left in the shadow, as in Newton's sensor."""
ENCODED = 1024
"""Steps of the table of gamma-encoded light."""


@wp.func
def reached(box: wp.vec4, lens: wp.vec4, a: wp.vec3, b: wp.vec3) -> wp.vec4:
    """Return a box of pixels (left, top, right, bottom) that also holds what is visible of an edge's start and cut."""
    if a[2] <= NEAR and b[2] <= NEAR:
        return box
    p = a
    q = a
    if (a[2] > NEAR) != (b[2] > NEAR):
        q = a + ((NEAR - a[2]) / (b[2] - a[2])) * (b - a)
        if a[2] <= NEAR:
            p = q
    x = lens[0] * p[0] / p[2] + lens[2]
    y = lens[1] * p[1] / p[2] + lens[3]
    u = lens[0] * q[0] / q[2] + lens[2]
    v = lens[1] * q[1] / q[2] + lens[3]
    return wp.vec4(
        wp.min(box[0], wp.min(x, u)),
        wp.min(box[1], wp.min(y, v)),
        wp.max(box[2], wp.max(x, u)),
        wp.max(box[3], wp.max(y, v)),
    )


@wp.func
def box_of(lens: wp.vec4, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> wp.vec4:
    """Return the box of what is visible of a triangle in the frame of the camera [px]."""
    if wp.min(v0[2], wp.min(v1[2], v2[2])) > NEAR:  # most triangles
        d0 = 1.0 / v0[2]
        d1 = 1.0 / v1[2]
        d2 = 1.0 / v2[2]
        x0 = v0[0] * d0
        x1 = v1[0] * d1
        x2 = v2[0] * d2
        y0 = v0[1] * d0
        y1 = v1[1] * d1
        y2 = v2[1] * d2
        return wp.vec4(
            lens[0] * wp.min(x0, wp.min(x1, x2)) + lens[2],
            lens[1] * wp.min(y0, wp.min(y1, y2)) + lens[3],
            lens[0] * wp.max(x0, wp.max(x1, x2)) + lens[2],
            lens[1] * wp.max(y0, wp.max(y1, y2)) + lens[3],
        )
    box = wp.vec4(1.0e30, 1.0e30, -1.0e30, -1.0e30)
    box = reached(box, lens, v0, v1)
    box = reached(box, lens, v1, v2)
    return reached(box, lens, v2, v0)


@wp.func
def key_at(near: float, id: int) -> wp.uint64:
    """Return the key of a triangle at 1 / z = near [1/m]; less is nearer."""
    return (wp.uint64(~wp.cast(near, wp.uint32)) << wp.uint64(32)) | wp.uint64(id)


@wp.func
def scan(
    e0: wp.vec3,
    e1: wp.vec3,
    e2: wp.vec3,
    plane: wp.vec3,
    lens: wp.vec4,
    window: wp.vec4i,
    step: int,
    width: int,
    spots: wp.array[wp.vec2],
    reach: float,
    view: int,
    id: int,
    # Out:
    key_out: wp.array2d[wp.uint64],
):
    """Keep a triangle in the samples where it is the nearest.

    Of the ray d = (x, y, 1) of a sample, edge i is e_i . d, positive inside, and the plane is 1 / z = plane . d. The
    window of pixels (left, top, right, bottom) is gone through in every `step`-th row. Samples lie at `spots` from the
    middle of their pixel, at most `reach` along an axis.
    """
    dx = wp.vec4(e0[0], e1[0], e2[0], plane[0]) / lens[0]
    dy = wp.vec4(e0[1], e1[1], e2[1], plane[1]) / lens[1]
    origin = wp.vec4(e0[2], e1[2], e2[2], plane[2]) - lens[2] * dx - lens[3] * dy
    extent = wp.vec3(wp.abs(dx[0]) + wp.abs(dy[0]), wp.abs(dx[1]) + wp.abs(dy[1]), wp.abs(dx[2]) + wp.abs(dy[2]))
    slack = SLACK * extent
    # Where the middle of a pixel is so far inside, all of its samples are.
    inside = (reach + SLACK) * extent
    samples = spots.shape[0]
    for row in range(window[1], window[3] + 1, step):
        begin = window[0]
        end = window[2]
        if end - begin > WIDE:
            for edge in range(3):
                across = (-inside[edge] - origin[edge] - (float(row) + 0.5) * dy[edge]) / dx[edge] - 0.5
                if dx[edge] > 0.0:
                    begin = int(wp.clamp(wp.floor(across), float(begin), float(window[2])))
                if dx[edge] < 0.0:
                    end = int(wp.clamp(wp.ceil(across), float(window[0]), float(end)))
        place = (row * width + begin) * samples
        for column in range(begin, end + 1):
            at = origin + (float(column) + 0.5) * dx + (float(row) + 0.5) * dy
            if at[0] >= -inside[0] and at[1] >= -inside[1] and at[2] >= -inside[2]:
                full = at[0] >= inside[0] and at[1] >= inside[1] and at[2] >= inside[2]
                for sample in range(samples):
                    spot = spots[sample]
                    hit = full
                    if not full:
                        e = at + spot[0] * dx + spot[1] * dy
                        hit = e[0] >= -slack[0] and e[1] >= -slack[1] and e[2] >= -slack[2]
                    near = at[3] + spot[0] * dx[3] + spot[1] * dy[3]
                    if hit and near > 0.0 and near < 1.0 / NEAR:
                        wp.atomic_min(key_out, view, place + sample, key_at(near, id))
            place += samples


@wp.func
def inverse_depth(key: wp.uint64) -> float:
    """Return 1 / z of a sample that has a triangle [1/m]."""
    return wp.cast(~wp.uint32(key >> wp.uint64(32)), wp.float32)


@wp.func
def encode(encoded: wp.array[float], radiance: wp.vec3) -> wp.vec3:
    """Return the sRGB of linear light, by a table of it over 0..1."""
    color = wp.vec3()
    for channel in range(3):
        x = wp.clamp(radiance[channel], 0.0, 1.0) * float(wp.static(ENCODED))
        i = wp.min(int(x), wp.static(ENCODED - 1))
        color[channel] = wp.lerp(encoded[i], encoded[i + 1], x - float(i))
    return color


@wp.func
def linear_channel(c: float) -> float:
    """Return linear light of a channel of sRGB, by IEC 61966-2-1."""
    if c <= 0.04045:
        return c / 12.92
    return wp.pow((c + 0.055) / 1.055, 2.4)


@wp.func
def decode(color: wp.vec3) -> wp.vec3:
    """Return linear light of sRGB."""
    return wp.vec3(linear_channel(color[0]), linear_channel(color[1]), linear_channel(color[2]))


@wp.func
def sky_color(horizon: wp.vec3, zenith: wp.vec3, ray: wp.vec3) -> wp.vec3:
    """Return the colour of the sky along a ray."""
    return wp.lerp(horizon, zenith, wp.clamp(2.0 * ray[2] / wp.length(ray), 0.0, 1.0))
