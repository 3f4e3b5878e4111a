"""Device code of `rasterizer`: the blend on CPU, one thread per tile of eight by eight pixels.

A tile's pixels are four pairs of rows of sixteen lanes, which stay in the innermost cache while the splats pass by. All
that lanes do is written as vector expressions of the compiler that Warp carries: the exponential of the standard
library is a call per pixel, and with it nothing runs in lanes (measured: 4.4 ms instead of 0.7 ms a frame).
"""

import functools
import math

import warp as wp

from softmode.splats.raster.lane_ops import lowest_bit
from softmode.splats.raster.rasterizer_kernels import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Frame

wp.set_module_options({"enable_backward": False})

TILE_THREADS = 1
"""Threads of a tile."""
LANES = 2 * TILE
"""Pixels of a pair of rows."""
PAIRS = TILE // 2
"""Pairs of rows of a tile."""
PATIENCE = 16
"""Splats between two looks at whether all pixels of the tile are opaque."""

vec16 = wp.types.vector(length=LANES, dtype=float)
vec5 = wp.types.vector(length=5, dtype=float)
tile_mat = wp.types.matrix(shape=(PAIRS, LANES), dtype=float)

LOG2_E = wp.constant(1.0 / math.log(2.0))
LOG2_255 = wp.constant(-math.log2(ALPHA_MIN))

# The numbers of the vector expressions.
ALPHA_MAX_TEXT, TRANSMITTANCE_MIN_TEXT = f"{ALPHA_MAX}f", f"{TRANSMITTANCE_MIN}f"
COLUMN = f"const lanes column = {{{', '.join(str(lane % TILE) for lane in range(LANES))}}};"
ROW = f"const lanes row = {{{', '.join(str(lane // TILE) for lane in range(LANES))}}};"


def in_lanes(arguments: str, expression: str) -> str:
    """Return a snippet that loads vector arguments into registers and returns the lanes computed from them."""
    names = arguments.split()
    loads = "".join(f"    lanes {name}; __builtin_memcpy(&{name}, &{name}_in, sizeof(lanes));\n" for name in names)
    return f"""{{
    #pragma clang fp contract(fast)
    typedef float lanes __attribute__((ext_vector_type({LANES})));
    typedef int words __attribute__((ext_vector_type({LANES})));
{loads}
    lanes result;
    {expression}
    wp::vec_t<{LANES}, float> out;
    __builtin_memcpy(&out, &result, sizeof(lanes));
    return out;
}}"""


@wp.func_native(
    in_lanes(
        "light",
        f"""
    {COLUMN}
    {ROW}
    lanes dy = row - v;
    lanes dx = (column - u) - tilt * dy;
    lanes power = peak - (a * dx) * dx - (b * dy) * dy;
    // 2^power = 2^n 2^f with |f| <= 1/2: adding 1.5 * 2^23 leaves n in the low bits, which go to the exponent. The
    // minimax polynomial of 2^f is within 3e-8. Lanes too dark to be drawn may overflow; none of them is kept.
    lanes shifted = power + 12582912.0f;
    lanes f = power - (shifted - 12582912.0f);
    lanes p = 1.5403530e-4f;
    p = p * f + 1.3333558e-3f;
    p = p * f + 9.6181291e-3f;
    p = p * f + 5.5504109e-2f;
    p = p * f + 2.4022651e-1f;
    p = p * f + 6.9314718e-1f;
    p = p * f + 1.0f;
    lanes alpha = (lanes)((words)p + ((words)shifted << 23));
    alpha = __builtin_elementwise_min(alpha, (lanes){ALPHA_MAX_TEXT});
    result = ((power >= -{LOG2_255:.8g}f) & (light > 0.0f)) ? alpha : (lanes)0.0f;
""",
    )
)
def splat_alpha(light_in: vec16, u: float, v: float, tilt: float, a: float, b: float, peak: float) -> vec16:
    """Return min(0.99, 2^(peak - a dx^2 - b dy^2)), zero below 1/255 and where the pixel is finished."""


@wp.func_native(
    in_lanes("light alpha", f"result = light - alpha * light < {TRANSMITTANCE_MIN_TEXT} ? (lanes)0.0f : alpha * light;")
)
def splat_weight(light_in: vec16, alpha_in: vec16) -> vec16:
    """Return alpha T, zero where the splat would take more than the last of the light."""


@wp.func_native(
    in_lanes(
        "light alpha",
        f"""
    lanes after = light - alpha * light;
    result = ((after < {TRANSMITTANCE_MIN_TEXT}) & (light > 0.0f)) ? -light : after;
""",
    )
)
def light_after(light_in: vec16, alpha_in: vec16) -> vec16:
    """Return the transmittance behind the splat, or minus that before it where the pixel is now finished."""


@wp.func_native(in_lanes("light limit", "result = depth > limit ? -__builtin_elementwise_abs(light) : light;"))
def light_before(light_in: vec16, limit_in: vec16, depth: float) -> vec16:
    """Return the transmittance, made negative where a mesh is in front of the splat."""


@wp.func_native(in_lanes("total weight", "result = total + weight * value;"))
def add_weighted(total_in: vec16, weight_in: vec16, value: float) -> vec16:
    """Return total + weight * value, fused."""


@wp.func_native(in_lanes("x y old", "result = x > y ? (lanes)value : old;"))
def replace_where_greater(x_in: vec16, y_in: vec16, value: float, old_in: vec16) -> vec16:
    """Return value where x > y, else old."""


@wp.func_native(in_lanes("light after old", "result = ((light > 0.5f) & (after <= 0.5f)) ? (lanes)depth : old;"))
def depth_at_half(light_in: vec16, after_in: vec16, depth: float, old_in: vec16) -> vec16:
    """Return the splat's depth where the transmittance falls through one half, else old."""


@wp.func
def tile_place(frame: Frame, tile: int):
    """Return a tile's view, the column and row where it begins, and how many columns, rows and pairs of rows it has."""
    view = tile / (frame.tile_count[0] * frame.tile_count[1])
    in_view = tile - view * frame.tile_count[0] * frame.tile_count[1]
    left = (in_view % frame.tile_count[0]) * TILE
    top = (in_view / frame.tile_count[0]) * TILE
    rows = wp.min(TILE, frame.size[1] - top)
    # The pairs are no constant, or Warp would unroll the loops over them and compile for 5 s.
    return view, left, top, wp.min(TILE, frame.size[0] - left), rows, (rows + 1) / 2


@wp.func
def is_covered(frame: Frame, tile: int) -> bool:
    """Return whether a splat may be seen in a tile."""
    for word in range(frame.cover.shape[1]):
        if frame.cover[tile, word] != wp.uint32(0):
            return True
    return False


@wp.func
def seen_from_tile(center: wp.vec4, shape: wp.vec4, left: int, top: int) -> vec5:
    """Return u, v from the tile's first pixel centre and the a, b, peak of `splat_alpha`.

    ln(255 o), the reach, is at hand: no logarithm.
    """
    return vec5(
        center[0] - float(left) - 0.5,
        center[1] - float(top) - 0.5,
        0.5 * LOG2_E * shape[1],
        0.5 * LOG2_E * shape[2],
        LOG2_E * center[3] - LOG2_255,
    )


@wp.func
def has_light(light: tile_mat, pairs: int) -> bool:
    """Return whether a pixel of the tile is still open."""
    brightest = light[0]
    for pair in range(1, pairs):
        brightest = wp.max(brightest, light[pair])
    return not (wp.max(brightest) < 0.0)


@functools.cache
def blend_kernel(has_mesh: bool, object_ids: bool, median_depth: bool) -> wp.Kernel:
    """Return the blend kernel whose threads own a tile of TILE x TILE pixels."""

    @wp.kernel(enable_backward=False, module="unique")
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
        tile = wp.tid()
        view, left, top, columns, rows, pairs = tile_place(frame, tile)
        behind_rgb = frame.background[view % frame.background.shape[0]]
        if not is_covered(frame, tile):  # most tiles of a large picture
            for y in range(top, top + rows):
                for x in range(left, left + columns):
                    behind = float(0.0)
                    if wp.static(has_mesh):
                        behind_rgb = frame.mesh_rgb[view, y, x]
                        behind = frame.mesh_depth[view, y, x]
                    rgb_out[view, y, x] = behind_rgb
                    depth_out[view, y, x] = behind
                    alpha_out[view, y, x] = 0.0
                    if wp.static(object_ids):
                        object_out[view, y, x] = -1
                    if wp.static(median_depth):
                        median_out[view, y, x] = behind
            return

        light = tile_mat(1.0)  # transmittance; its negative once the pixel is finished
        if rows < TILE or columns < TILE:
            light = tile_mat(-1.0)
            for y in range(rows):
                for x in range(columns):
                    light[y / 2, TILE * (y % 2) + x] = 1.0
        red = tile_mat()
        green = tile_mat()
        blue = tile_mat()
        depth = tile_mat()
        best = tile_mat()
        winner = tile_mat(-1.0)
        median = tile_mat()
        limit = tile_mat(1.0e30)
        if wp.static(has_mesh):
            for y in range(rows):
                for x in range(columns):
                    behind = frame.mesh_depth[view, top + y, left + x]
                    if behind > 0.0:
                        limit[y / 2, TILE * (y % 2) + x] = behind

        first = view * frame.splat_count
        running = bool(True)
        patience = int(PATIENCE)
        for word in range(frame.cover.shape[1]):
            if not running:
                break
            bits = frame.cover[tile, word]
            while bits != wp.uint32(0):
                i = frame.order[first + 32 * word + lowest_bit(bits)]
                bits = bits & (bits - wp.uint32(1))
                g = frame.center[first + i]
                e = frame.shape[first + i]
                c = frame.color[first + i]
                s = seen_from_tile(g, e, left, top)
                # All rows: to look for those that the splat touches costs more than it saves (0.9 ms, not 0.65).
                for pair in range(pairs):
                    before = light[pair]
                    if wp.static(has_mesh):
                        before = light_before(before, limit[pair], g[2])
                    alpha = splat_alpha(before, s[0], s[1] - float(2 * pair), e[0], s[2], s[3], s[4])
                    weight = splat_weight(before, alpha)
                    after = light_after(before, alpha)
                    light[pair] = after
                    red[pair] = add_weighted(red[pair], weight, c[0])
                    green[pair] = add_weighted(green[pair], weight, c[1])
                    blue[pair] = add_weighted(blue[pair], weight, c[2])
                    depth[pair] = add_weighted(depth[pair], weight, g[2])
                    if wp.static(object_ids):
                        winner[pair] = replace_where_greater(weight, best[pair], float(object_index[i]), winner[pair])
                        best[pair] = wp.max(best[pair], weight)
                    if wp.static(median_depth):
                        median[pair] = depth_at_half(before, after, g[2], median[pair])
                patience -= 1
                if patience == 0:
                    patience = PATIENCE
                    running = has_light(light, pairs)
                    if not running:
                        break

        for y in range(rows):
            for x in range(columns):
                pair = y / 2
                lane = TILE * (y % 2) + x
                t = wp.abs(light[pair, lane])
                seen = 1.0 - t
                far = depth[pair, lane]
                middle = median[pair, lane]
                if wp.static(has_mesh):
                    behind_rgb = frame.mesh_rgb[view, top + y, left + x]
                    if limit[pair, lane] < 1.0e29:
                        far += t * limit[pair, lane]
                        seen = 1.0
                        if t > 0.5:
                            middle = limit[pair, lane]
                rgb = wp.vec3(red[pair, lane], green[pair, lane], blue[pair, lane])
                rgb_out[view, top + y, left + x] = rgb + t * behind_rgb
                alpha_out[view, top + y, left + x] = 1.0 - t
                depth_out[view, top + y, left + x] = wp.where(seen > 0.0, far / wp.max(seen, 1.0e-6), 0.0)
                if wp.static(object_ids):
                    object_out[view, top + y, left + x] = int(winner[pair, lane])
                if wp.static(median_depth):
                    median_out[view, top + y, left + x] = middle

    return _blend
