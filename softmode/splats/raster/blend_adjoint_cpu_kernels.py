"""Device code of `rasterizer_adjoint`: the adjoint of the blend on CPU, one thread per tile, in vector registers.

The tile's pixels lie in pairs of rows as in `blend_cpu_kernels`, whose exponential and decisions these kernels share. A
splat's sums over its tile stay in registers; memory sees them once, always in the same order.
"""

import functools

import warp as wp

from softmode.splats.raster.blend_cpu_kernels import (
    ALPHA_MAX_TEXT,
    COLUMN,
    LANES,
    PATIENCE,
    ROW,
    add_weighted,
    has_light,
    in_lanes,
    light_after,
    light_before,
    seen_from_tile,
    splat_alpha,
    tile_mat,
    tile_place,
    vec16,
)
from softmode.splats.raster.blend_cpu_kernels import TILE_THREADS as TILE_THREADS
from softmode.splats.raster.lane_ops import highest_bit, lowest_bit
from softmode.splats.raster.rasterizer_kernels import TILE, Frame, ImageLoss, asked_of_pixel

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(1.0e30)


@wp.func_native(in_lanes("stop after", "result = after < 0.0f ? __builtin_elementwise_min(stop, (lanes)rank) : stop;"))
def end_where_finished(stop_in: vec16, after_in: vec16, rank: float) -> vec16:
    """Return the rank at which each pixel ended."""


@wp.func_native(in_lanes("light stop", "result = stop > rank ? light : (lanes)-1.0f;"))
def light_if_open(light_in: vec16, stop_in: vec16, rank: float) -> vec16:
    """Return the transmittance, -1 where the pixel ends before the splat."""


@wp.func_native(in_lanes("light alpha", "result = light / (1.0f - alpha);"))
def light_in_front(light_in: vec16, alpha_in: vec16) -> vec16:
    """Return the transmittance in front of the splat from that behind it."""


@wp.func_native(in_lanes("red green blue behind", "result = red * r + green * g + (blue * b - behind);"))
def color_difference(
    red_in: vec16, green_in: vec16, blue_in: vec16, behind_in: vec16, r: float, g: float, b: float
) -> vec16:
    """Return what the loss asks of the splat's colour, less that of what is seen behind it."""


@wp.func_native(in_lanes("total far seen", "result = total + far * (depth - seen);"))
def add_depth(total_in: vec16, far_in: vec16, seen_in: vec16, depth: float) -> vec16:
    """Add what the loss asks of the splat's depth, counted from the depth that is seen."""


@wp.func_native(
    in_lanes("weight alpha difference", f"result = alpha < {ALPHA_MAX_TEXT} ? weight * difference : (lanes)0.0f;")
)
def by_log_alpha(weight_in: vec16, alpha_in: vec16, difference_in: vec16) -> vec16:
    """Return the loss by the logarithm of alpha, zero where alpha is cut."""


@wp.func_native(in_lanes("x y", "result = x * y;"))
def product(x_in: vec16, y_in: vec16) -> vec16:
    """Return x y."""


@wp.func_native(in_lanes("total x y", "result = total + x * y;"))
def add_product(total_in: vec16, x_in: vec16, y_in: vec16) -> vec16:
    """Return total + x y, fused."""


@wp.func_native(in_lanes("", f"{ROW} result = row - v;"))
def offset_y(v: float) -> vec16:
    """Return dy = y - v."""


@wp.func_native(in_lanes("dy", f"{COLUMN} result = (column - u) - tilt * dy;"))
def offset_x(dy_in: vec16, u: float, tilt: float) -> vec16:
    """Return dx = x - u - tilt dy."""


@wp.func_native(
    f"""
    typedef float lanes16 __attribute__((ext_vector_type({LANES})));
    typedef float lanes8 __attribute__((ext_vector_type({LANES // 2})));
    typedef float lanes4 __attribute__((ext_vector_type({LANES // 4})));
    lanes16 x;
    __builtin_memcpy(&x, &x_in, sizeof(x));
    const lanes8 y = x.lo + x.hi;
    const lanes4 z = y.lo + y.hi;
    return (z.x + z.z) + (z.y + z.w);
"""
)
def lane_total(x_in: vec16) -> float:
    """Return the sum over the lanes."""


@wp.func_native(in_lanes("x y", "result = __builtin_elementwise_max(x, y);"))
def larger(x_in: vec16, y_in: vec16) -> vec16:
    """Return the larger of x and y."""


@wp.func_native(
    f"""
    typedef float lanes16 __attribute__((ext_vector_type({LANES})));
    lanes16 x;
    __builtin_memcpy(&x, &x_in, sizeof(x));
    return __builtin_reduce_max(x);
"""
)
def lane_max(x_in: vec16) -> float:
    """Return the largest lane."""


@functools.cache
def blend_adjoint_kernel(has_mesh: bool, has_depth: bool) -> wp.Kernel:
    """Return the adjoint of `blend_cpu_kernels.blend_kernel`; `blend_adjoint_cuda_kernels` has the equations."""

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
        tile = wp.tid()
        view, left, top, columns, rows, pairs = tile_place(frame, tile)

        light = tile_mat(-1.0)  # transmittance; its negative once the pixel is finished
        stop = tile_mat(NEVER)  # rank at which the pixel ends; exact below 2^24
        limit = tile_mat(1.0e30)
        red = tile_mat()
        green = tile_mat()
        blue = tile_mat()
        far = tile_mat()
        seen = tile_mat()
        behind = tile_mat()
        for y in range(rows):
            for x in range(columns):
                pair = y / 2
                lane = TILE * (y % 2) + x
                light[pair, lane] = 1.0
                loss = images.loss_rgb[view, top + y, left + x]
                red[pair, lane] = loss[0]
                green[pair, lane] = loss[1]
                blue[pair, lane] = loss[2]
                if wp.static(has_mesh):
                    there = frame.mesh_depth[view, top + y, left + x]
                    if there > 0.0:
                        limit[pair, lane] = there
                asked, share, middle = asked_of_pixel(frame, images, view, top + y, left + x, limit[pair, lane])
                behind[pair, lane] = asked
                far[pair, lane] = share
                seen[pair, lane] = middle

        # Front to back: light left, and the rank at which each pixel ends.
        first = view * frame.splat_count
        running = bool(True)
        patience = int(PATIENCE)
        words = int(0)
        while running and words < frame.cover.shape[1]:
            bits = frame.cover[tile, words]
            while bits != wp.uint32(0):
                rank = 32 * words + lowest_bit(bits)
                bits = bits & (bits - wp.uint32(1))
                i = frame.order[first + rank]
                g = frame.center[first + i]
                e = frame.shape[first + i]
                s = seen_from_tile(g, e, left, top)
                for pair in range(pairs):
                    before = light[pair]
                    if wp.static(has_mesh):
                        before = light_before(before, limit[pair], g[2])
                    alpha = splat_alpha(before, s[0], s[1] - float(2 * pair), e[0], s[2], s[3], s[4])
                    after = light_after(before, alpha)
                    light[pair] = after
                    stop[pair] = end_where_finished(stop[pair], after, float(rank))
                patience -= 1
                if patience == 0:
                    patience = PATIENCE
                    running = has_light(light, pairs)
                    if not running:
                        break
            words += 1

        # Back to front.
        alphas = tile_mat()
        for pair in range(pairs):
            light[pair] = wp.abs(light[pair])
        for back in range(words):
            word = words - 1 - back
            bits = frame.cover[tile, word]
            while bits != wp.uint32(0):
                high = highest_bit(bits)
                bits = bits ^ (wp.uint32(1) << wp.uint32(high))
                rank = 32 * word + high
                k = first + frame.order[first + rank]
                g = frame.center[k]
                e = frame.shape[k]
                c = frame.color[k]
                s = seen_from_tile(g, e, left, top)
                sum_r = vec16()
                sum_g = vec16()
                sum_b = vec16()
                sum_z = vec16()
                power = vec16()
                power_x = vec16()
                power_y = vec16()
                power_xx = vec16()
                power_xy = vec16()
                power_yy = vec16()
                densest = vec16()
                for pair in range(pairs):
                    open = light_if_open(light[pair], stop[pair], float(rank))
                    alpha = splat_alpha(open, s[0], s[1] - float(2 * pair), e[0], s[2], s[3], s[4])
                    alphas[pair] = alpha
                    densest = larger(densest, alpha)
                if lane_max(densest) == 0.0:
                    continue
                for pair in range(pairs):
                    behind_splat = light[pair]
                    alpha = alphas[pair]
                    in_front = light_in_front(behind_splat, alpha)
                    light[pair] = in_front
                    weight = product(alpha, in_front)
                    difference = color_difference(red[pair], green[pair], blue[pair], behind[pair], c[0], c[1], c[2])
                    if wp.static(has_depth):
                        difference = add_depth(difference, far[pair], seen[pair], g[2])
                        sum_z = add_product(sum_z, weight, far[pair])
                    behind[pair] = add_product(behind[pair], alpha, difference)
                    sum_r = add_product(sum_r, weight, red[pair])
                    sum_g = add_product(sum_g, weight, green[pair])
                    sum_b = add_product(sum_b, weight, blue[pair])
                    log_alpha = by_log_alpha(weight, alpha, difference)
                    dy = offset_y(s[1] - float(2 * pair))
                    dx = offset_x(dy, s[0], e[0])
                    along_x = product(log_alpha, dx)
                    along_y = product(log_alpha, dy)
                    power = add_weighted(power, log_alpha, 1.0)
                    power_x = add_weighted(power_x, along_x, 1.0)
                    power_y = add_weighted(power_y, along_y, 1.0)
                    power_xx = add_product(power_xx, along_x, dx)
                    power_xy = add_product(power_xy, along_x, dy)
                    power_yy = add_product(power_yy, along_y, dy)
                # log alpha = log o - e1/2 (dx)^2 - e2/2 dy^2 with dx = x - u - slope dy, dy = y - v
                by_u = e[1] * lane_total(power_x)
                by_v = e[2] * lane_total(power_y) - e[0] * by_u
                center_out[k] += wp.vec4(by_u, by_v, lane_total(sum_z), 0.0)
                shape_out[k] += wp.vec4(
                    e[1] * lane_total(power_xy),
                    -0.5 * lane_total(power_xx),
                    -0.5 * lane_total(power_yy),
                    lane_total(power) / e[3],
                )
                color_out[k] += wp.vec3(lane_total(sum_r), lane_total(sum_g), lane_total(sum_b))

    return _blend_adjoint
