"""Device code of `rasterizer`: the blend on CUDA, one warp for eight by four pixels."""

import functools
import math

import warp as wp

from softmode.splats.raster.lane_ops import (
    BLOCK_WARPS,
    ballot,
    bit_count,
    exp2,
    keep,
    lane_scan,
    last_lane,
    load4,
    lowest_bit,
    queue_address,
    queue_get,
    queue_put,
    stage_address,
    stage_get,
    stage_put,
    sync_lanes,
)
from softmode.splats.raster.rasterizer_kernels import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Frame

wp.set_module_options({"enable_backward": False})

COLUMNS = TILE
ROWS = 4
"""Pixels of a warp."""
PARTS = TILE // ROWS
"""Warps of a tile."""
TILE_THREADS = 32 * PARTS
"""Threads of a tile."""
BLOCK_DIM = 32 * BLOCK_WARPS
"""Block size of the launch."""
LOG2_E = wp.constant(1.0 / math.log(2.0))
LOG2_ALPHA_MIN = wp.constant(math.log2(ALPHA_MIN))
FINISHED = wp.constant(1.0e30)


@wp.func
def least_power(center: wp.vec4, shape: wp.vec4, low: wp.vec2, high: wp.vec2) -> float:
    """Return the least d^2/2 of a splat over a rectangle of pixel centres, exactly.

    Where the centre lies outside, the minimum of the convex form is on one of the two edges that face it.
    """
    x0 = low[0] - center[0]
    x1 = high[0] - center[0]
    y0 = low[1] - center[1]
    y1 = high[1] - center[1]
    slope = shape[0]
    a = shape[1]
    b = shape[2]
    dx = wp.clamp(0.0, x0, x1)
    dy = wp.clamp(0.0, y0, y1)
    along = wp.clamp(a * slope * dx / (a * slope * slope + b), y0, y1)
    off = dx - slope * along
    at_side = a * off * off + b * along * along
    off = wp.clamp(slope * dy, x0, x1) - slope * dy
    at_top = a * off * off + b * dy * dy
    return 0.5 * wp.min(at_side, at_top)


@functools.cache
def blend_kernel(has_mesh: bool, object_ids: bool, median_depth: bool) -> wp.Kernel:
    """Return the blend kernel whose warps own COLUMNS x ROWS pixels, one per lane.

    A warp gathers the ranks of its tile's bits, 1024 at a time, into a queue. Each lane then fetches one splat and
    tests its ellipse against the warp's own pixels; those that touch are staged in shared memory, from where all lanes
    read them. Warps do not wait for each other, and stop when all of their pixels are opaque.
    """

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=(BLOCK_DIM, 10))
    def _blend(
        frame: Frame,
        object_index: wp.array[int],  # (splat_count,)
        # Out:
        rgb_out: wp.array3d[wp.vec3],
        depth_out: wp.array3d[float],
        alpha_out: wp.array3d[float],
        object_out: wp.array3d[int],
        median_out: wp.array3d[float],
    ):
        """Blend front to back: C = sum_i c_i alpha_i T_i + T c_behind."""
        thread = wp.tid()
        lane = thread % 32
        part = thread / 32
        tile_index = part / PARTS
        view = tile_index / (frame.tile_count[0] * frame.tile_count[1])
        in_view = tile_index - view * frame.tile_count[0] * frame.tile_count[1]
        left = (in_view % frame.tile_count[0]) * TILE
        top = (in_view / frame.tile_count[0]) * TILE + (part - tile_index * PARTS) * ROWS
        column = left + lane % COLUMNS
        row = top + lane / COLUMNS
        inside = column < frame.size[0] and row < frame.size[1]
        low = wp.vec2(float(left) + 0.5, float(top) + 0.5)
        high = wp.vec2(float(left + COLUMNS) - 0.5, float(top + ROWS) - 0.5)
        px = keep(float(column) + 0.5)
        py = keep(float(row) + 0.5)
        queue = queue_address()
        stage = stage_address()

        light = float(1.0)
        red = float(0.0)
        green = float(0.0)
        blue = float(0.0)
        depth = float(0.0)
        best = float(0.0)
        winner = int(-1)
        median = float(0.0)
        limit = float(1.0e30)
        cut = float(LOG2_ALPHA_MIN)  # exponent below which a splat is left out; FINISHED leaves out all
        if not inside:
            cut = FINISHED
        if wp.static(has_mesh):
            if inside:
                behind = frame.mesh_depth[view, row, column]
                if behind > 0.0:
                    limit = behind

        first = view * frame.splat_count
        words = frame.cover.shape[1]
        running = bool(True)
        pending = int(0)  # ranks in the queue
        chunk = int(0)  # first of the 32 words that the lanes read together
        while running and chunk < words:
            bits = wp.uint32(0)
            if chunk + lane < words:
                bits = frame.cover[tile_index, chunk + lane]
            found = bit_count(bits)
            through = lane_scan(found, lane)
            slot = pending + through - found
            while bits != wp.uint32(0):
                queue_put(queue, slot, 32 * (chunk + lane) + lowest_bit(bits))
                slot += 1
                bits = bits & (bits - wp.uint32(1))
            pending += last_lane(through)
            sync_lanes()
            # The queue keeps ranks modulo 2^16, so it is emptied at the end of every 2^16.
            base = first + ((32 * chunk) & ~0xFFFF)
            last = chunk + 32 >= words or (chunk & 2047) == 2016
            begin = int(0)
            while running and (begin + 32 <= pending or (last and begin < pending)):
                hit = bool(False)
                k = int(0)
                c = wp.vec4()
                s = wp.vec4()
                if begin + lane < pending:
                    k = frame.order[base + queue_get(queue, begin + lane)]
                    c = load4(frame.center, first + k)
                    s = load4(frame.shape, first + k)
                    hit = least_power(c, s, low, high) <= c[3] + 1.0e-3
                hits = ballot(hit)
                if hit:
                    at = 3 * bit_count(hits & ((wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)))
                    half = 0.5 * LOG2_E
                    stage_put(stage, at, wp.vec4(c[0], c[1], s[0], c[2]))
                    stage_put(stage, at + 1, wp.vec4(half * s[1], half * s[2], wp.log2(s[3]), wp.cast(k, wp.float32)))
                    stage_put(stage, at + 2, load4(frame.color, first + k))
                sync_lanes()
                count = 3 * bit_count(hits)
                at = int(0)
                while at < count:
                    g = stage_get(stage, at)
                    e = stage_get(stage, at + 1)
                    rgb = stage_get(stage, at + 2)
                    at += 3
                    if wp.static(has_mesh):
                        cut = wp.where(g[3] > limit, FINISHED, cut)
                    # No branches: all lanes work on all staged splats, and most of them count.
                    dy = py - g[1]
                    dx = px - g[0] - g[2] * dy
                    power = e[2] - e[0] * dx * dx - e[1] * dy * dy
                    alpha = wp.where(power >= cut, wp.min(ALPHA_MAX, exp2(power)), 0.0)
                    weight = alpha * light
                    stop = light - weight < TRANSMITTANCE_MIN
                    cut = wp.where(stop, FINISHED, cut)
                    weight = wp.where(stop, 0.0, weight)
                    red += weight * rgb[0]
                    green += weight * rgb[1]
                    blue += weight * rgb[2]
                    depth += weight * g[3]
                    if wp.static(object_ids):
                        if weight > best:
                            best = weight
                            winner = object_index[wp.cast(e[3], wp.int32)]
                    if wp.static(median_depth):
                        if light > 0.5 and light - weight <= 0.5:
                            median = g[3]
                    light = light - weight
                sync_lanes()
                running = ballot(cut != FINISHED) != wp.uint32(0)
                begin += 32
            pending = wp.max(pending - begin, 0)
            rest = queue_get(queue, begin + lane)
            sync_lanes()
            # No lane writes beyond the rest: the others go on to put the next ranks there.
            if lane < pending:
                queue_put(queue, lane, rest)
            chunk += 32

        if inside:
            behind_rgb = wp.vec3()
            seen = 1.0 - light
            if wp.static(has_mesh):
                behind_rgb = frame.mesh_rgb[view, row, column]
                if limit < 1.0e29:
                    depth += light * limit
                    seen = 1.0
                    if wp.static(median_depth):
                        if light > 0.5:
                            median = limit
            else:
                behind_rgb = frame.background[view % frame.background.shape[0]]
            rgb_out[view, row, column] = wp.vec3(red, green, blue) + light * behind_rgb
            alpha_out[view, row, column] = 1.0 - light
            depth_out[view, row, column] = wp.where(seen > 0.0, depth / wp.max(seen, 1.0e-6), 0.0)
            if wp.static(object_ids):
                object_out[view, row, column] = winner
            if wp.static(median_depth):
                median_out[view, row, column] = median

    return _blend
