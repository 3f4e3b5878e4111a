"""Device side of interpolation on CPU: eight points or rows at a time, one in each lane.

The functions of a row are in lanes in memory. Their sums for eight rows are transposed as they are added up, in the
order of ``lane_kernels.sum8d``, so that from there on a lane is a row. ``test_cpu_kernels.py`` compares all with
``deformation_kernels`` and ``struct_kernels``, which take one row.
"""

from typing import Any

import warp as wp

from softmode.deformables.materials.material_cpu_kernels import mat98d
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d

wp.set_module_options({"enable_backward": False})

mat38d: Any = wp.types.matrix(shape=(3, LANES), dtype=wp.float64)
mat68d: Any = wp.types.matrix(shape=(6, LANES), dtype=wp.float64)

SUMS = """
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
        static lanes block(const char* q, int stride, int axis, int b, int count) {
            lanes x = 0.0;
            if (stride) __builtin_memcpy(&x, q + sizeof(x) * ((size_t)axis * stride + b), sizeof(x));
            for (int k = 0; k < 8 && !stride; ++k)
                if (8 * b + k < count) x[k] = ((const double*)q)[3 * (8 * b + k) + axis];
            return x;
        }
        static void neighbours(const void* data, size_t first, size_t apart, int count, const char** where) {
            for (int k = 0; k < 8; ++k) where[k] = (const char*)data + first + apart * (k < count ? k : count - 1);
        }
        __attribute__((always_inline)) static void rows(const char* const* where, size_t by_block, const char* q,
                                                        const char* from, int stride, int count, lanes* out) {
            #pragma clang fp contract(fast)
            lanes sum[3][8] = {};
            for (int b = 0; b < (count + 7) / 8; ++b) {
                lanes x[3];
                for (int axis = 0; axis < 3; ++axis) {
                    x[axis] = block(q, stride, axis, b, count);
                    if (from) x[axis] -= block(from, stride, axis, b, count);
                }
                #pragma unroll
                for (int k = 0; k < 8; ++k) {
                    floats values;
                    __builtin_memcpy(&values, where[k] + b * by_block, sizeof(values));
                    for (int axis = 0; axis < 3; ++axis)
                        sum[axis][k] += __builtin_convertvector(values, lanes) * x[axis];
                }
            }
            for (int axis = 0; axis < 3; ++axis) out[axis] = of(sum[axis]);
        }
    };
"""
"""Native code. ``of``: the sums over the lanes of eight vectors, one in each lane. ``rows``: sum_k b_k q_k of eight
rows, one in each lane, or sum_k b_k (q_k - from_k). It takes where the rows are, how many bytes apart the blocks of
their functions are, the coordinates, and how many blocks apart their axes; 0 where each function has a vector."""


@wp.func_native(
    snippet=f"""{{{SUMS}
    const char *q_own = (const char*)q.data + (size_t)i * q.strides[0], *where[8];
    lanes G[9], column[3];
    for (int c = 0; c < 3; ++c) {{
        const size_t first = (size_t)point * gradient.strides[1] + c * gradient.strides[2];
        Sums::neighbours(gradient.data, first, gradient.strides[1], count, where);
        Sums::rows(where, gradient.strides[0], q_own, nullptr, q.shape[1] / 3, function_count, column);
        for (int axis = 0; axis < 3; ++axis) G[3 * axis + c] = column[axis];
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
    const char *q_own = (const char*)q.data + (size_t)i * q.strides[0], *where[8];
    const char* before = change ? (const char*)q_from.data + (size_t)i * q_from.strides[0] : nullptr;
    Sums::neighbours(rows.data, (size_t)row * rows.strides[0], rows.strides[0], count, where);
    lanes found[3];
    Sums::rows(where, sizeof(floats), q_own, before, rows.shape[1], function_count, found);
    wp::mat_t<3, 8, wp::float64> out;
    __builtin_memcpy(&out, found, sizeof(out));
    return out;
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
    const char *q_own = (const char*)(q.data + begin), *qd_own = (const char*)(qd.data + begin), *where[8];
    Sums::neighbours(rows.data, (size_t)row * rows.strides[0], rows.strides[0], count, where);
    lanes found[6];
    Sums::rows(where, sizeof(floats), q_own, nullptr, 0, function_count, found);
    Sums::rows(where, sizeof(floats), qd_own, nullptr, 0, function_count, found + 3);
    wp::mat_t<6, 8, wp::float64> out;
    __builtin_memcpy(&out, found, sizeof(out));
    return out;
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
