"""Device code of `rasterizer_adjoint`: the adjoint of blending, from the images to the projected splats."""

import functools

import warp as wp

from softmode.splats.rasterizer_kernels import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False})


@functools.cache
def blend_adjoint_kernel(strip: int, has_mesh: bool, has_alpha: bool, has_depth: bool) -> wp.Kernel:
    """Return the adjoint of `rasterizer_kernels.blend_kernel`, whose threads own the same strips of pixels.

    A thread first walks its list front to back as the blend does, for the light that is left and where each pixel
    ends; then back to front. With s_i = <dL/drgb, c_i> + the like for depth, and R_i what is seen behind splat i,

        dL/dalpha_i = T_i (s_i - R_i),    R_(i-1) = alpha_i s_i + (1 - alpha_i) R_i,    T_i = T_(i+1) / (1 - alpha_i).

    R needs no division and no difference of large sums; 1 - alpha is at least 0.01. A splat's sums over a strip stay
    in registers.
    """
    strip_vec = wp.types.vector(length=strip, dtype=wp.float32)
    strip_int = wp.types.vector(length=strip, dtype=wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def _blend_adjoint(
        # Bins:
        splat: wp.array[int],  # (capacity,) sorted by tile, then depth
        tile_range: wp.array[wp.vec2i],  # (tile_count over all views,)
        # Projected splats:
        center: wp.array[wp.vec4],
        shape: wp.array[wp.vec4],
        color: wp.array[wp.vec3],
        # Images in:
        background: wp.array[wp.vec3],  # (1|view_count,)
        mesh_rgb: wp.array3d[wp.vec3],  # (view_count, height, width)
        mesh_depth: wp.array3d[float],  # (view_count, height, width) [m], 0 where there is no mesh
        depth: wp.array3d[float],  # as rendered
        alpha_image: wp.array3d[float],  # as rendered
        # Loss by the images, (view_count, height, width):
        loss_rgb: wp.array3d[wp.vec3],
        loss_alpha: wp.array3d[float],
        loss_depth: wp.array3d[float],
        # Sizes:
        size: wp.vec2i,
        tile_count: wp.vec2i,
        tile: int,
        # Loss by the projected splats, added to:
        center_out: wp.array[wp.vec4],  # by u, v, forward depth; the last entry is not used
        shape_out: wp.array[wp.vec4],
        color_out: wp.array[wp.vec3],
    ):
        """Accumulate the loss by center, shape and colour of each (view, splat)."""
        thread = wp.tid()
        strips_per_row = tile / strip
        strips_per_tile = strips_per_row * tile
        tile_index = thread / strips_per_tile
        local = thread - tile_index * strips_per_tile
        per_view = tile_count[0] * tile_count[1]
        view = tile_index / per_view
        in_view = tile_index - view * per_view
        row = (in_view / tile_count[0]) * tile + local / strips_per_row
        first = (in_view % tile_count[0]) * tile + (local % strips_per_row) * strip
        if row >= size[1] or first >= size[0]:
            return
        count = wp.min(strip, size[0] - first)
        py = float(row) + 0.5
        left = float(first) + 0.5

        # Front to back: light left, and the end of each pixel's list.
        light = strip_vec()
        stop = strip_int()
        limit = strip_vec()
        pairs = tile_range[tile_index]
        for p in range(strip):
            light[p] = 1.0
            stop[p] = pairs[1]
            limit[p] = 1.0e30
        if wp.static(has_mesh):
            for p in range(count):
                there = mesh_depth[view, row, first + p]
                if there > 0.0:
                    limit[p] = there
        live = wp.int32(count)
        last = wp.int32(pairs[0])
        for slot in range(pairs[0], pairs[1]):
            k = splat[slot]
            g = center[k]
            e = shape[k]
            dy = py - g[1]
            across = 0.5 * e[2] * dy * dy
            if across > g[3]:
                continue
            middle = g[0] + e[0] * dy - left
            begin = wp.int32(0)
            end = wp.int32(count)
            if wp.static(strip > 1):
                half = wp.sqrt(2.0 * (g[3] - across) / e[1]) + 0.001
                begin = wp.max(int(wp.ceil(wp.max(middle - half, -1.0))), 0)
                end = wp.min(int(wp.floor(wp.min(middle + half, float(strip)))) + 1, count)
            for p in range(begin, end):
                if stop[p] > slot:
                    if wp.static(has_mesh):
                        if g[2] > limit[p]:
                            stop[p] = slot
                            live -= 1
                            continue
                    dx = float(p) - middle
                    alpha = wp.min(ALPHA_MAX, e[3] * wp.exp(-0.5 * e[1] * dx * dx - across))
                    if alpha >= ALPHA_MIN:
                        after = light[p] * (1.0 - alpha)
                        if after < TRANSMITTANCE_MIN:
                            stop[p] = slot
                            live -= 1
                        else:
                            light[p] = after
                            last = slot + 1
            if live == 0:
                break

        # What each pixel asks for, and what is seen behind all splats.
        red = strip_vec()
        green = strip_vec()
        blue = strip_vec()
        far = strip_vec()
        seen = strip_vec()
        behind = strip_vec()
        for p in range(count):
            loss = loss_rgb[view, row, first + p]
            red[p] = loss[0]
            green[p] = loss[1]
            blue[p] = loss[2]
            if wp.static(has_mesh):
                behind[p] = wp.dot(loss, mesh_rgb[view, row, first + p])
            else:
                behind[p] = wp.dot(loss, background[view % background.shape[0]])
            if wp.static(has_alpha):
                behind[p] = behind[p] - loss_alpha[view, row, first + p]
            if wp.static(has_depth):
                # The weights of a depth sum to its total, so depth may be counted from what is seen: exact, and free
                # of the difference between a sum and its total times the mean.
                seen[p] = depth[view, row, first + p]
                total = alpha_image[view, row, first + p]
                if wp.static(has_mesh):
                    if limit[p] < 1.0e29:
                        total = 1.0
                if total > 0.0:
                    far[p] = loss_depth[view, row, first + p] / wp.max(total, 1.0e-6)
                if wp.static(has_mesh):
                    if limit[p] < 1.0e29:
                        behind[p] = behind[p] + far[p] * (limit[p] - seen[p])

        # Back to front.
        for back in range(last - pairs[0]):
            slot = last - 1 - back
            k = splat[slot]
            g = center[k]
            e = shape[k]
            dy = py - g[1]
            across = 0.5 * e[2] * dy * dy
            if across > g[3]:
                continue
            middle = g[0] + e[0] * dy - left
            begin = wp.int32(0)
            end = wp.int32(count)
            if wp.static(strip > 1):
                half = wp.sqrt(2.0 * (g[3] - across) / e[1]) + 0.001
                begin = wp.max(int(wp.ceil(wp.max(middle - half, -1.0))), 0)
                end = wp.min(int(wp.floor(wp.min(middle + half, float(strip)))) + 1, count)
            if begin >= end:
                continue
            c = color[k]
            touched = bool(False)
            sum_r = float(0.0)
            sum_g = float(0.0)
            sum_b = float(0.0)
            sum_z = float(0.0)
            power = float(0.0)
            power_x = float(0.0)
            power_xx = float(0.0)
            for p in range(begin, end):
                if stop[p] > slot:
                    dx = float(p) - middle
                    raw = e[3] * wp.exp(-0.5 * e[1] * dx * dx - across)
                    alpha = wp.min(ALPHA_MAX, raw)
                    if alpha >= ALPHA_MIN:
                        touched = True
                        through = 1.0 - alpha
                        t = light[p] / through
                        light[p] = t
                        value = red[p] * c[0] + green[p] * c[1] + blue[p] * c[2]
                        weight = alpha * t
                        if wp.static(has_depth):
                            value += far[p] * (g[2] - seen[p])
                            sum_z += weight * far[p]
                        difference = value - behind[p]
                        behind[p] = behind[p] + alpha * difference
                        sum_r += weight * red[p]
                        sum_g += weight * green[p]
                        sum_b += weight * blue[p]
                        if raw < ALPHA_MAX:
                            # By the logarithm of alpha.
                            log_alpha = weight * difference
                            power += log_alpha
                            power_x += log_alpha * dx
                            power_xx += log_alpha * dx * dx
            if touched:
                # log alpha = log o - e1/2 (dx)^2 - e2/2 dy^2 with dx = x - u - slope dy, dy = y - v
                by_x = -e[1] * power_x
                by_y = -e[2] * dy * power - e[0] * by_x
                wp.atomic_add(center_out, k, wp.vec4(-by_x, -by_y, sum_z, 0.0))
                wp.atomic_add(
                    shape_out,
                    k,
                    wp.vec4(-by_x * dy, -0.5 * power_xx, -0.5 * dy * dy * power, power / e[3]),
                )
                wp.atomic_add(color_out, k, wp.vec3(sum_r, sum_g, sum_b))

    return _blend_adjoint


@wp.kernel
def background_adjoint(
    alpha: wp.array3d[float],  # (view_count, height, width) as rendered
    loss_rgb: wp.array3d[wp.vec3],  # (view_count, height, width)
    lanes: int,
    # Out, added to:
    background_out: wp.array[wp.vec3d],  # (1|view_count,)
):
    """Sum (1 - alpha) dL/drgb; each lane strides over the rows of pixels."""
    view, lane = wp.tid()
    total = wp.vec3d()
    for y in range(lane, alpha.shape[1], lanes):
        for x in range(alpha.shape[2]):
            loss = (1.0 - alpha[view, y, x]) * loss_rgb[view, y, x]
            total += wp.vec3d(wp.float64(loss[0]), wp.float64(loss[1]), wp.float64(loss[2]))
    wp.atomic_add(background_out, view % background_out.shape[0], total)
