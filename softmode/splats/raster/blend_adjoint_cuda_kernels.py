"""Device code of `rasterizer_adjoint`: the adjoint of the blend on CUDA, one pixel per lane."""

import functools

import warp as wp

from softmode.splats.raster.blend_cuda_kernels import COLUMNS, ROWS, TILE_THREADS
from softmode.splats.raster.lane_ops import ballot, highest_bit, lane_max, lane_sum, lowest_bit
from softmode.splats.raster.rasterizer_kernels import (
    ALPHA_MAX,
    ALPHA_MIN,
    TILE,
    TRANSMITTANCE_MIN,
    Frame,
    ImageLoss,
    asked_of_pixel,
)

wp.set_module_options({"enable_backward": False})


@functools.cache
def blend_adjoint_kernel(has_mesh: bool, has_depth: bool, lanes: int = 32) -> wp.Kernel:
    """Return the adjoint of the blend, whose warps own COLUMNS x ROWS pixels, one per lane.

    A warp first walks its list front to back as the blend does, for the light that is left and where each pixel ends;
    then back to front. With s_i = <dL/drgb, c_i> + the like for depth, and R_i what is seen behind splat i,

        dL/dalpha_i = T_i (s_i - R_i),    R_(i-1) = alpha_i s_i + (1 - alpha_i) R_i,    T_i = T_(i+1) / (1 - alpha_i).

    R needs no division and no difference of large sums; 1 - alpha is at least 0.01. The lanes go through the list
    together and sum over the warp's pixels before one of them adds to memory. With `lanes` 1, where threads run on
    their own, the kernel runs on a CPU too.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def _blend_adjoint(
        frame: Frame,
        images: ImageLoss,
        # Loss by the projected splats, added to:
        center_out: wp.array[wp.vec4],  # by u, v, forward depth; the last entry is not used
        shape_out: wp.array[wp.vec4],
        color_out: wp.array[wp.vec3],
    ):
        """Accumulate the loss by center, shape and colour of each (view, splat)."""
        thread = wp.tid()
        tile_index = thread / TILE_THREADS
        local = thread - tile_index * TILE_THREADS
        view = tile_index / (frame.tile_count[0] * frame.tile_count[1])
        in_view = tile_index - view * frame.tile_count[0] * frame.tile_count[1]
        # Lanes of a warp are COLUMNS x ROWS pixels, as in the blend.
        part = local / (COLUMNS * ROWS)
        lane = local - part * COLUMNS * ROWS
        column = (in_view % frame.tile_count[0]) * TILE + lane % COLUMNS
        row = (in_view / frame.tile_count[0]) * TILE + part * ROWS + lane / COLUMNS
        inside = column < frame.size[0] and row < frame.size[1]
        px = float(column) + 0.5
        py = float(row) + 0.5
        first = view * frame.splat_count

        # Front to back: light left, and the rank at which the pixel ends.
        light = float(1.0)
        limit = float(1.0e30)
        if wp.static(has_mesh):
            if inside:
                there = frame.mesh_depth[view, row, column]
                if there > 0.0:
                    limit = there
        live = inside
        last = int(-1)
        word = int(0)
        bits = wp.uint32(0)
        while live:
            while bits == wp.uint32(0) and word < frame.cover.shape[1]:
                bits = frame.cover[tile_index, word]
                word += 1
            if bits == wp.uint32(0):
                break
            rank = 32 * (word - 1) + lowest_bit(bits)
            bits = bits & (bits - wp.uint32(1))
            k = first + frame.order[first + rank]
            g = frame.center[k]
            e = frame.shape[k]
            if wp.static(has_mesh):
                if g[2] > limit:
                    break
            dy = py - g[1]
            dx = px - g[0] - e[0] * dy
            alpha = wp.min(ALPHA_MAX, e[3] * wp.exp(-0.5 * (e[1] * dx * dx + e[2] * dy * dy)))
            if alpha >= ALPHA_MIN:
                after = light * (1.0 - alpha)
                if after < TRANSMITTANCE_MIN:
                    live = False
                else:
                    light = after
                    last = rank

        # What the pixel asks for, and what is seen behind all splats.
        loss = wp.vec3()
        far = float(0.0)
        seen = float(0.0)
        behind = float(0.0)
        if inside:
            loss = images.loss_rgb[view, row, column]
            behind, far, seen = asked_of_pixel(frame, images, view, row, column, limit)

        # Back to front.
        end = last
        if wp.static(lanes > 1):
            end = lane_max(last)
        word = wp.max(end, 0) / 32
        bits = wp.uint32(0)
        if end >= 0:
            bits = frame.cover[tile_index, word] & (~wp.uint32(0) >> wp.uint32(31 - end + 32 * word))
        while bits != wp.uint32(0):
            high = highest_bit(bits)
            rank = 32 * word + high
            bits = bits ^ (wp.uint32(1) << wp.uint32(high))
            while bits == wp.uint32(0) and word > 0:
                word -= 1
                bits = frame.cover[tile_index, word]
            k = first + frame.order[first + rank]
            g = frame.center[k]
            e = frame.shape[k]
            dy = py - g[1]
            dx = px - g[0] - e[0] * dy
            raw = e[3] * wp.exp(-0.5 * (e[1] * dx * dx + e[2] * dy * dy))
            alpha = wp.min(ALPHA_MAX, raw)
            touched = rank <= last and alpha >= ALPHA_MIN
            if wp.static(lanes > 1):
                if ballot(touched) == wp.uint32(0):
                    continue
            weight = float(0.0)
            log_alpha = float(0.0)
            if touched:
                light = light / (1.0 - alpha)
                weight = alpha * light
                c = frame.color[k]
                difference = loss[0] * c[0] + loss[1] * c[1] + loss[2] * c[2] - behind
                if wp.static(has_depth):
                    difference += far * (g[2] - seen)
                behind += alpha * difference
                if raw < ALPHA_MAX:
                    log_alpha = weight * difference
            # log alpha = log o - e1/2 (dx)^2 - e2/2 dy^2 with dx = x - u - slope dy, dy = y - v
            by_u = e[1] * dx * log_alpha
            by_v = e[2] * dy * log_alpha - e[0] * by_u
            by_center = wp.vec4(by_u, by_v, weight * far, 0.0)
            by_shape = wp.vec4(by_u * dy, -0.5 * dx * dx * log_alpha, -0.5 * dy * dy * log_alpha, log_alpha / e[3])
            by_color = weight * loss
            if wp.static(lanes > 1):
                for entry in range(3):
                    by_center[entry] = lane_sum(by_center[entry])
                    by_color[entry] = lane_sum(by_color[entry])
                for entry in range(4):
                    by_shape[entry] = lane_sum(by_shape[entry])
                touched = lane == 0
            if touched:
                wp.atomic_add(center_out, k, by_center)
                wp.atomic_add(shape_out, k, by_shape)
                wp.atomic_add(color_out, k, by_color)

    return _blend_adjoint
