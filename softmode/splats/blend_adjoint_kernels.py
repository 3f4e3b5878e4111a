"""Device code of `rasterizer_adjoint`: the adjoint of blending, from the images to the projected splats."""

import functools

import warp as wp

from softmode.splats.lane_ops import ballot, highest_bit, lane_max, lane_sum, lowest_bit
from softmode.splats.rasterizer_kernels import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False})


@functools.cache
def blend_adjoint_kernel(strip: int, lanes: int, has_mesh: bool, has_alpha: bool, has_depth: bool) -> wp.Kernel:
    """Return the adjoint of the blend, whose threads own `strip` neighbouring pixels of a row.

    A thread first walks its list front to back as the blend does, for the light that is left and where each pixel
    ends; then back to front. With s_i = <dL/drgb, c_i> + the like for depth, and R_i what is seen behind splat i,

        dL/dalpha_i = T_i (s_i - R_i),    R_(i-1) = alpha_i s_i + (1 - alpha_i) R_i,    T_i = T_(i+1) / (1 - alpha_i).

    R needs no division and no difference of large sums; 1 - alpha is at least 0.01. On a CPU a splat's sums over a
    strip stay in registers; on CUDA (strip 1, `lanes` 32) a warp walks its tile's list together and sums over its
    pixels before one lane adds to memory.
    """
    strip_vec = wp.types.vector(length=strip, dtype=wp.float32)
    strip_int = wp.types.vector(length=strip, dtype=wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def _blend_adjoint(
        # Bins:
        order: wp.array[int],  # (>= view_count * splat_count,) splats of each view by depth
        cover: wp.array2d[wp.uint32],  # (tile_count over all views, words) bits of depth ranks
        # Projected splats:
        center: wp.array[wp.vec4],
        shape: wp.array[wp.vec4],
        color: wp.array[wp.vec4],
        # Images in:
        background: wp.array[wp.vec3],  # (1|view_count,)
        mesh_rgb: wp.array3d[wp.vec3],  # (view_count, height, width)
        mesh_depth: wp.array3d[float],  # (view_count, height, width) [m], 0 where there is no mesh
        depth: wp.array3d[float],  # as rendered
        coverage: wp.array3d[float],  # alpha as rendered
        # Loss by the images, (view_count, height, width):
        loss_rgb: wp.array3d[wp.vec3],
        loss_alpha: wp.array3d[float],
        loss_depth: wp.array3d[float],
        # Sizes:
        splat_count: int,
        size: wp.vec2i,
        tile_count: wp.vec2i,
        tile: wp.vec2i,
        # Loss by the projected splats, added to:
        center_out: wp.array[wp.vec4],  # by u, v, forward depth; the last entry is not used
        shape_out: wp.array[wp.vec4],
        color_out: wp.array[wp.vec3],
    ):
        """Accumulate the loss by center, shape and colour of each (view, splat)."""
        thread = wp.tid()
        strips_per_row = tile[0] / strip
        strips_per_tile = strips_per_row * tile[1]
        tile_index = thread / strips_per_tile
        local = thread - tile_index * strips_per_tile
        per_view = tile_count[0] * tile_count[1]
        view = tile_index / per_view
        in_view = tile_index - view * per_view
        row = (in_view / tile_count[0]) * tile[1] + local / strips_per_row
        first = (in_view % tile_count[0]) * tile[0] + (local % strips_per_row) * strip
        count = wp.clamp(size[0] - first, 0, strip)
        if row >= size[1]:
            count = wp.int32(0)  # The lane stays: those of a warp go through the list together.
        py = float(row) + 0.5
        left = float(first) + 0.5
        first_splat = view * splat_count

        # Front to back: light left, and the rank at which each pixel ends.
        light = strip_vec()
        stop = strip_int()
        limit = strip_vec()
        for p in range(strip):
            light[p] = 1.0
            stop[p] = splat_count
            limit[p] = 1.0e30
        if wp.static(has_mesh):
            for p in range(count):
                there = mesh_depth[view, row, first + p]
                if there > 0.0:
                    limit[p] = there
        live = wp.int32(count)
        last = wp.int32(-1)
        word = wp.int32(0)
        bits = wp.uint32(0)
        while live > 0:
            while bits == wp.uint32(0) and word < cover.shape[1]:
                bits = cover[tile_index, word]
                word += 1
            if bits == wp.uint32(0):
                break
            rank = 32 * (word - 1) + lowest_bit(bits)
            bits = bits & (bits - wp.uint32(1))
            k = first_splat + order[first_splat + rank]
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
                if stop[p] > rank:
                    if wp.static(has_mesh):
                        if g[2] > limit[p]:
                            stop[p] = rank
                            live -= 1
                            continue
                    dx = float(p) - middle
                    alpha = wp.min(ALPHA_MAX, e[3] * wp.exp(-0.5 * e[1] * dx * dx - across))
                    if alpha >= ALPHA_MIN:
                        after = light[p] * (1.0 - alpha)
                        if after < TRANSMITTANCE_MIN:
                            stop[p] = rank
                            live -= 1
                        else:
                            light[p] = after
                            last = rank

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
                total = coverage[view, row, first + p]
                if wp.static(has_mesh):
                    if limit[p] < 1.0e29:
                        total = 1.0
                if total > 0.0:
                    far[p] = loss_depth[view, row, first + p] / wp.max(total, 1.0e-6)
                if wp.static(has_mesh):
                    if limit[p] < 1.0e29:
                        behind[p] = behind[p] + far[p] * (limit[p] - seen[p])

        # Back to front.
        if wp.static(lanes > 1):
            last = lane_max(last)
        word = wp.max(last, 0) / 32
        bits = wp.uint32(0)
        if last >= 0:
            bits = cover[tile_index, word] & ((~wp.uint32(0)) >> wp.uint32(31 - last + 32 * word))
        while bits != wp.uint32(0):
            high = highest_bit(bits)
            rank = 32 * word + high
            bits = bits ^ (wp.uint32(1) << wp.uint32(high))
            while bits == wp.uint32(0) and word > 0:
                word -= 1
                bits = cover[tile_index, word]
            k = first_splat + order[first_splat + rank]
            g = center[k]
            e = shape[k]
            dy = py - g[1]
            across = 0.5 * e[2] * dy * dy
            middle = g[0] + e[0] * dy - left
            begin = wp.int32(0)
            end = wp.int32(count)
            if across > g[3]:
                end = wp.int32(0)
            if wp.static(strip > 1):
                half = wp.sqrt(2.0 * wp.max(g[3] - across, 0.0) / e[1]) + 0.001
                begin = wp.max(int(wp.ceil(wp.max(middle - half, -1.0))), 0)
                end = wp.min(int(wp.floor(wp.min(middle + half, float(strip)))) + 1, end)
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
                if stop[p] > rank:
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
            if wp.static(lanes > 1):
                if ballot(touched) == wp.uint32(0):
                    continue
            # log alpha = log o - e1/2 (dx)^2 - e2/2 dy^2 with dx = x - u - slope dy, dy = y - v
            by_x = -e[1] * power_x
            by_y = -e[2] * dy * power - e[0] * by_x
            by_center = wp.vec4(-by_x, -by_y, sum_z, 0.0)
            by_shape = wp.vec4(-by_x * dy, -0.5 * power_xx, -0.5 * dy * dy * power, power / e[3])
            by_color = wp.vec3(sum_r, sum_g, sum_b)
            if wp.static(lanes > 1):
                for entry in range(3):
                    by_center[entry] = lane_sum(by_center[entry])
                    by_color[entry] = lane_sum(by_color[entry])
                for entry in range(4):
                    by_shape[entry] = lane_sum(by_shape[entry])
                touched = thread % lanes == 0
            if touched:
                wp.atomic_add(center_out, k, by_center)
                wp.atomic_add(shape_out, k, by_shape)
                wp.atomic_add(color_out, k, by_color)

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
