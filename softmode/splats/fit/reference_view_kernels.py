"""Device code of `reference_views`: rays through a textured mesh."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def texel(pixels: wp.array[wp.vec3ub], first: int, width: int, height: int, column: int, row: int) -> wp.vec3:
    """Return the colour 0..1 of a texel, repeated at the rims."""
    i = column % width
    j = row % height
    if i < 0:
        i += width
    if j < 0:
        j += height
    p = pixels[first + j * width + i]
    return wp.vec3(float(p[0]), float(p[1]), float(p[2])) / 255.0


@wp.func
def bilinear(pixels: wp.array[wp.vec3ub], place: wp.vec3i, uv: wp.vec2) -> wp.vec3:
    """Return the colour between the centres of the four nearest texels; v points up."""
    x = (uv[0] - wp.floor(uv[0])) * float(place[1]) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(place[2]) - 0.5
    left = wp.floor(x)
    top = wp.floor(y)
    fx = x - left
    fy = y - top
    i = int(left)
    j = int(top)
    upper = (1.0 - fx) * texel(pixels, place[0], place[1], place[2], i, j)
    upper += fx * texel(pixels, place[0], place[1], place[2], i + 1, j)
    lower = (1.0 - fx) * texel(pixels, place[0], place[1], place[2], i, j + 1)
    lower += fx * texel(pixels, place[0], place[1], place[2], i + 1, j + 1)
    return (1.0 - fy) * upper + fy * lower


@wp.kernel
def trace_mesh(
    # Mesh:
    mesh: wp.uint64,
    color: wp.array[wp.vec3],  # (3 * face_count,) at the corners
    uv: wp.array[wp.vec2],  # (3 * face_count,)
    texture: wp.array[int],  # (face_count,) -1 for none
    place: wp.array[wp.vec3i],  # (texture_count,) first texel, width, height
    pixels: wp.array[wp.vec3ub],
    # Views:
    world_to_camera: wp.array[wp.mat44],  # (view_count,)
    intrinsics: wp.array[wp.vec4],  # (view_count,) [px]
    samples: int,  # per pixel along each axis
    # Out:
    rgb_out: wp.array3d[wp.vec3],  # (view_count, height, width) mean over the samples, black where there is no mesh
    alpha_out: wp.array3d[float],  # (view_count, height, width) share of samples on the mesh
):
    """Average the surface colour over a regular grid of rays through each pixel."""
    view, row, column = wp.tid()
    m = world_to_camera[view]
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    eye = -(m[0, 3] * r0 + m[1, 3] * r1 + m[2, 3] * r2)
    lens = intrinsics[view]
    step = 1.0 / float(samples)
    total = wp.vec3()
    hits = int(0)
    for j in range(samples):
        y = (float(row) + (float(j) + 0.5) * step - lens[3]) / lens[1]
        for i in range(samples):
            x = (float(column) + (float(i) + 0.5) * step - lens[2]) / lens[0]
            hit = wp.mesh_query_ray(mesh, eye, wp.normalize(x * r0 + y * r1 + r2), 1.0e6)
            if hit.result:
                f = hit.face
                a = hit.u
                b = hit.v
                c = 1.0 - a - b
                seen = a * color[3 * f] + b * color[3 * f + 1] + c * color[3 * f + 2]
                if texture[f] >= 0:
                    at = a * uv[3 * f] + b * uv[3 * f + 1] + c * uv[3 * f + 2]
                    seen = wp.cw_mul(seen, bilinear(pixels, place[texture[f]], at))
                total += seen
                hits += 1
    share = step * step
    rgb_out[view, row, column] = share * total
    alpha_out[view, row, column] = share * float(hits)
