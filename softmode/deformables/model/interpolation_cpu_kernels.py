"""Device side of interpolation on CPU: eight points or rows at a time, one in each lane.

The functions of a row are in lanes in memory. Their sums for eight rows are transposed as they are added up, in the
order of ``lane_kernels.sum8d``, so that from there on a lane is a row.
"""

from typing import Any

import warp as wp

from softmode.deformables.materials.material_cpu_kernels import mat98d
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d

wp.set_module_options({"enable_backward": False})

mat38d: Any = wp.types.matrix(shape=(3, LANES), dtype=wp.float64)
mat68d: Any = wp.types.matrix(shape=(6, LANES), dtype=wp.float64)

SUMS = """
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    typedef double lanes __attribute__((ext_vector_type(8)));
    struct Sums {
        static lanes of(const lanes* v) {
            lanes four[4], two[2];
            for (int k = 0; k < 4; ++k) {
                const lanes a = v[2 * k], b = v[2 * k + 1];
                four[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11)
                    + __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
            }
            for (int k = 0; k < 2; ++k) {
                const lanes a = four[2 * k], b = four[2 * k + 1];
                two[k] = __builtin_shufflevector(a, b, 0, 1, 4, 5, 8, 9, 12, 13)
                    + __builtin_shufflevector(a, b, 2, 3, 6, 7, 10, 11, 14, 15);
            }
            return __builtin_shufflevector(two[0], two[1], 0, 2, 4, 6, 8, 10, 12, 14)
                + __builtin_shufflevector(two[0], two[1], 1, 3, 5, 7, 9, 11, 13, 15);
        }
        static lanes row(const char* at) {
            floats values;
            __builtin_memcpy(&values, at, sizeof(values));
            return __builtin_convertvector(values, lanes);
        }
    };
"""
"""Native code: the sums over the lanes of eight vectors, one in each lane; eight floats in double precision."""


@wp.func_native(
    snippet=f"""{{{SUMS}
    const size_t by_block = gradient.strides[0], by_point = gradient.strides[1], by_axis = gradient.strides[2];
    const int stride = q.shape[1] / 3;
    const int blocks = (function_count + 7) / 8;
    const lanes* Q = (const lanes*)((const char*)q.data + (size_t)i * q.strides[0]);
    const char* first = (const char*)gradient.data + (size_t)point * by_point;
    lanes G[9];
    for (int c = 0; c < 3; ++c) {{
        lanes sum[3][8] = {{}};
        for (int b = 0; b < blocks; ++b) {{
            lanes x[3];
            for (int axis = 0; axis < 3; ++axis) __builtin_memcpy(x + axis, Q + axis * stride + b, sizeof(lanes));
            const char* at = first + b * by_block + c * by_axis;
            #pragma unroll
            for (int k = 0; k < 8; ++k) {{
                const lanes g = Sums::row(at + (k < count ? k : count - 1) * by_point);
                for (int axis = 0; axis < 3; ++axis) sum[axis][k] += x[axis] * g;
            }}
        }}
        for (int axis = 0; axis < 3; ++axis) G[3 * axis + c] = Sums::of(sum[axis]);
    }}
    if (scale != 1.0)
        for (int k = 0; k < 9; ++k) G[k] = 1.0 / scale * (k % 4 == 0 ? G[k] - (scale - 1.0) : G[k]);
    wp::mat_t<9, 8, wp::float64> out;
    __builtin_memcpy(&out, G, sizeof(out));
    return out;
}}"""
)
def elastic_gradients(
    gradient: wp.array3d[vec8],
    q: wp.array2d[vec8d],
    i: int,
    point: int,
    count: int,
    function_count: int,
    scale: wp.float64,
) -> mat98d:  # pyright: ignore[reportReturnType]
    """Return F / s - I at ``count`` points from ``point`` on; see ``deformation_kernels.elastic_gradient``."""
    ...


@wp.func_native(
    snippet=f"""{{{SUMS}
    const int stride = rows.shape[1];
    const int blocks = (function_count + 7) / 8;
    const lanes* Q = (const lanes*)((const char*)q.data + (size_t)i * q.strides[0]);
    const lanes* from = (const lanes*)((const char*)q_from.data + (size_t)i * q_from.strides[0]);
    const char* first = (const char*)rows.data + (size_t)row * rows.strides[0];
    lanes sum[3][8] = {{}}, out[3];
    for (int b = 0; b < blocks; ++b) {{
        lanes x[3], before;
        for (int axis = 0; axis < 3; ++axis) {{
            __builtin_memcpy(x + axis, Q + axis * stride + b, sizeof(lanes));
            if (!change) continue;
            __builtin_memcpy(&before, from + axis * stride + b, sizeof(lanes));
            x[axis] -= before;
        }}
        #pragma unroll
        for (int k = 0; k < 8; ++k) {{
            const lanes value = Sums::row(first + (k < count ? k : count - 1) * rows.strides[0] + 32 * b);
            for (int axis = 0; axis < 3; ++axis) sum[axis][k] += value * x[axis];
        }}
    }}
    for (int axis = 0; axis < 3; ++axis) out[axis] = Sums::of(sum[axis]);
    wp::mat_t<3, 8, wp::float64> found;
    __builtin_memcpy(&found, out, sizeof(found));
    return found;
}}"""
)
def interpolate_rows(
    rows: wp.array2d[vec8],
    row: int,
    count: int,
    q: wp.array2d[vec8d],
    q_from: wp.array2d[vec8d],
    change: int,
    i: int,
    function_count: int,
) -> mat38d:  # pyright: ignore[reportReturnType]
    """Return sum_k b_k q_k at ``count`` rows from ``row`` on, or with ``change`` sum_k b_k (q_k - q_from_k)."""
    ...


@wp.func_native(
    snippet=f"""{{{SUMS}
    const int blocks = (function_count + 7) / 8;
    const double* both[2] = {{(const double*)q.data + 3 * (size_t)begin, (const double*)qd.data + 3 * (size_t)begin}};
    const char* first = (const char*)rows.data + (size_t)row * rows.strides[0];
    lanes out[6];
    for (int which = 0; which < 2; ++which) {{
        lanes sum[3][8] = {{}};
        for (int b = 0; b < blocks; ++b) {{
            lanes x[3];
            for (int lane = 0; lane < 8; ++lane) {{
                const bool idle = 8 * b + lane >= function_count;
                const double* at = both[which] + 3 * (idle ? 0 : 8 * b + lane);
                for (int axis = 0; axis < 3; ++axis) x[axis][lane] = idle ? 0.0 : at[axis];
            }}
            #pragma unroll
            for (int k = 0; k < 8; ++k) {{
                const lanes value = Sums::row(first + (k < count ? k : count - 1) * rows.strides[0] + 32 * b);
                for (int axis = 0; axis < 3; ++axis) sum[axis][k] += value * x[axis];
            }}
        }}
        for (int axis = 0; axis < 3; ++axis) out[3 * which + axis] = Sums::of(sum[axis]);
    }}
    wp::mat_t<6, 8, wp::float64> found;
    __builtin_memcpy(&found, out, sizeof(found));
    return found;
}}"""
)
def interpolate_state(
    rows: wp.array2d[vec8],
    row: int,
    count: int,
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    begin: int,
    function_count: int,
) -> mat68d:  # pyright: ignore[reportReturnType]
    """Return sum_k b_k q_k and sum_k b_k qd_k at rows, of a body whose functions begin at ``begin`` in the state."""
    ...
