"""Device side of the linear system on CPU: the sums of ``assembly_kernels`` in the order that one core likes.

Every sum goes over its terms in the same order as there. What differs is which of them are in registers at a time.
"""

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.model.newton_step_kernels import NewtonArrays, NewtonStep
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    PointConstraints,
    Points,
    Rigid,
    exists,
    first_coupled,
)
from softmode.deformables.system.assembly_kernels import CONDENSED_ROUNDING, inertia_of, left_out
from softmode.deformables.system.factor_kernels import used_blocks

wp.set_module_options({"enable_backward": False})

SLAB_BYTES = 500_000
"""Gradients of a slab of points: half of the second cache of a core."""
TILE = 3
"""Row blocks of the stiffness whose sums are in registers at a time: 24 of the 32 that AVX-512 has. Others have 16."""

_TILE = """
            case ROWS: {
                floats sum[8 * ROWS] = {};
                if (slab > 0) {
                    #pragma unroll
                    for (int a = 0; a < 8 * ROWS; ++a) __builtin_memcpy(sum + a, out + a * width, sizeof(floats));
                }
                for (int p = slab * count / slabs; p < (slab + 1) * count / slabs && used; ++p) {
                    const float* C = hessian + 9 * p;
                    const float* at = right + p * by_point;
                    floats g[3], u[3];
                    for (int k = 0; k < 3; ++k) __builtin_memcpy(g + k, at + 8 * k, sizeof(floats));
                    for (int k = 0; k < 3; ++k) {
                        u[k] = C[3 * k] * g[0];
                        u[k] += C[3 * k + 1] * g[1];
                        u[k] += C[3 * k + 2] * g[2];
                    }
                    at = left + p * by_point;
                    #pragma unroll
                    for (int k = 0; k < 3; ++k)
                        #pragma unroll
                        for (int a = 0; a < 8 * ROWS; ++a) sum[a] += at[(a / 8) * by_block + 8 * k + a % 8] * u[k];
                }
                #pragma unroll
                for (int a = 0; a < 8 * ROWS; ++a) __builtin_memcpy(out + a * width, sum + a, sizeof(floats));
                break;
            }
"""


@wp.func_native(
    snippet="""{
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    const int blocks = basis.row.shape[1];
    const int used_count = (instances.function_count.data[i] + 7) / 8;
    const int count = instances.point_count.data[i];
    const size_t by_block = basis.gradient_across.strides[0] / sizeof(float);
    const size_t by_point = basis.gradient_across.strides[1] / sizeof(float);
    const size_t width = 24 * blocks;
    const float* gradient = (const float*)basis.gradient_across.data + instances.point_start.data[i] * by_point;
    float* stiffness = (float*)((char*)arrays.stiffness.data + (size_t)i * arrays.stiffness.strides[0]);
    for (int slab = 0; slab < slabs; ++slab)
    for (int c = 0, pair = 0; c < 3; ++c)
        for (int d = c; d < 3; ++d, ++pair) {
            const float* hessian = (const float*)points.hessian.data;
            hessian += 9 * (size_t)points.hessian.shape[2] * (6 * i + pair);
            for (int column = 0; column < blocks; ++column) {
                const int end = c == d ? column + 1 : blocks;
                #if defined(__AVX512VL__)
                const int tiles = (end + TILE - 1) / TILE;
                #else
                const int tiles = end;
                #endif
                for (int tile = 0; tile < tiles; ++tile) {
                    const int row = tile * end / tiles;
                    const bool used = row < used_count && column < used_count;
                    const float* left = gradient + row * by_block;
                    const float* right = gradient + column * by_block;
                    float* out = stiffness + 8 * ((size_t)(c * blocks + row) * width + d * blocks + column);
                    switch ((tile + 1) * end / tiles - row) {
CASES
                    }
                }
            }
        }
}""".replace("CASES", "".join(_TILE.replace("ROWS", str(rows + 1)) for rows in range(TILE))).replace("TILE", str(TILE))
)
def sum_stiffness(instances: Instances, basis: Basis, points: Points, arrays: NewtonArrays, slabs: int, i: int) -> None:
    """Assemble sum_p grad b^T C grad b of an instance; see ``assembly_kernels.stiffness_block``.

    Points are taken slab by slab, whose gradients stay in the cache. The sums go on where the slab before has ended,
    so that their bits do not depend on the slabs.
    """


def cache_slabs(block_count: int, point_count: int) -> int:
    """Return into how many slabs the points of a body are cut."""
    return max(round(point_count * block_count * 3 * LANES * 4 / SLAB_BYTES), 1)


@wp.func
def stiffness_of(step: NewtonStep, i: int):
    """Assemble the stiffness of an instance, where it is to be refreshed."""
    w = step.instances.world[i]
    if step.state.active[w] != 0 and step.state.refresh[w] != 0 and exists(step.instances, i):
        sum_stiffness(step.instances, step.basis, step.points, step.arrays, step.options.stiffness_slabs, i)


@wp.func_native(
    snippet="""{
    typedef float floats __attribute__((ext_vector_type(8)));
    const int blocks = basis.row.shape[1], room = constraints.coupling.shape[2];
    const size_t columns = 8 * arrays.systems.matrix.shape[2], unknowns = arrays.systems.matrix.shape[1];
    const int rigid_count = rigid.count.data[world], acting_count = constraints.acting_count.data[i];
    const size_t constraint_max = constraints.row.shape[1];
    const size_t own = (size_t)i * constraint_max;
    const int* acting = (const int*)constraints.acting.data + own;
    const int* rows = (const int*)constraints.row.data + own;
    const int* begin = (const int*)constraints.dof_begin.data + own;
    const int* end = (const int*)constraints.dof_end.data + own;
    const float* coupling = (const float*)constraints.coupling.data + 3 * own * room;
    const double* gradient = (const double*)arrays.gradient.data + (size_t)i * 24 * blocks;
    float* out = (float*)arrays.systems.matrix.data;
    out += ((size_t)instances.system.data[i] * unknowns + 8 * instances.system_block.data[i]) * columns + unknowns;
    for (int axis = 0; axis < 3; ++axis)
        for (int b = 0; b < blocks; ++b) {
            float* const at = out + 8 * (size_t)(axis * blocks + b) * columns;
            for (int a = 0; a < 8; ++a) {
                for (int j = rigid_count; j < rigid_max; ++j) at[a * columns + j] = 0.0f;
                at[a * columns + rigid_max] = (float)-gradient[8 * (axis * blocks + b) + a];
            }
        }
    for (int b = 0; b < blocks; ++b) {
        const int driven = instances.driven_count.data[i] - 8 * b;
        for (int group = 0; group < rigid_count; group += 3) {
            const int many = rigid_count - group < 3 ? rigid_count - group : 3;
            floats sum[9] = {};  // three dofs with three axes each
            for (int k = first; k < acting_count; ++k) {
                const int e = acting[k];
                const int low = begin[e] > group ? begin[e] - group : 0;
                const int high = end[e] - group < many ? end[e] - group : many;
                if (low >= high) continue;
                const float* const C = coupling + 3 * ((size_t)e * room + group);
                floats row;
                __builtin_memcpy(&row, (const float*)basis.row.data + ((size_t)rows[e] * blocks + b) * 8, 32);
                #pragma unroll
                for (int j = 0; j < 3; ++j)
                    if (j >= low && j < high)
                        for (int axis = 0; axis < 3; ++axis) sum[3 * j + axis] -= C[3 * j + axis] * row;
            }
            #pragma unroll
            for (int j = 0; j < 3; ++j)
                for (int axis = 0; axis < 3 && j < many; ++axis) {
                    float* const at = out + 8 * (size_t)(axis * blocks + b) * columns + group + j;
                    for (int a = 0; a < 8; ++a) at[a * columns] = a < driven ? 0.0f : sum[3 * j + axis][a];
                }
        }
    }
}"""
)
def sum_columns(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    rigid: Rigid,
    arrays: NewtonArrays,
    rigid_max: int,
    first: int,
    world: int,
    i: int,
) -> None:
    """Fill the columns right of K of an instance; see ``assembly_kernels.column_block``."""


@wp.func_native(
    snippet="""{
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    typedef double lanes __attribute__((ext_vector_type(8)));
    const int blocks = basis.row.shape[1];
    const int count = instances.point_count.data[i], acting_count = constraints.acting_count.data[i];
    const size_t by_block = basis.gradient_across.strides[0] / sizeof(float);
    const size_t by_point = basis.gradient_across.strides[1] / sizeof(float);
    const float* gradient = (const float*)basis.gradient_across.data + instances.point_start.data[i] * by_point;
    const double* stress = (const double*)points.stress.data + 9 * (size_t)i * points.stress.shape[1];
    const size_t own = (size_t)i * constraints.row.shape[1];
    const int* acting = (const int*)constraints.acting.data + own;
    const int* rows = (const int*)constraints.row.data + own;
    const double* force = (const double*)constraints.force.data + 3 * own;
    lanes* out = (lanes*)((char*)arrays.gradient_chunk.data + (size_t)i * arrays.gradient_chunk.strides[0]);
    const int used = (instances.function_count.data[i] + 7) / 8;
    for (int first = 0; first < used; first += 3) {
        // where fewer than three blocks are left the last one is summed again
        const int at[3] = {first, first + 1 < used ? first + 1 : used - 1, first + 2 < used ? first + 2 : used - 1};
        lanes sum[3][3] = {};
        floats values;
        for (int p = 0; p < count; ++p) {
            const double* P = stress + 9 * p;
            #pragma unroll
            for (int k = 0; k < 3; ++k)
                #pragma unroll
                for (int b = 0; b < 3; ++b) {
                    __builtin_memcpy(&values, gradient + at[b] * by_block + p * by_point + 8 * k, sizeof(values));
                    const lanes wide = __builtin_convertvector(values, lanes);
                    for (int axis = 0; axis < 3; ++axis) sum[axis][b] += P[3 * axis + k] * wide;
                }
        }
        for (int k = 0; k < acting_count; ++k) {
            const int e = acting[k];
            for (int b = 0; b < 3; ++b) {
                const float* row = (const float*)basis.row.data + 8 * ((size_t)rows[e] * blocks + at[b]);
                __builtin_memcpy(&values, row, sizeof(values));
                const lanes wide = __builtin_convertvector(values, lanes);
                for (int axis = 0; axis < 3; ++axis) sum[axis][b] -= force[3 * e + axis] * wide;
            }
        }
        for (int axis = 0; axis < 3; ++axis)
            for (int b = 0; b < 3; ++b) __builtin_memcpy(out + axis * blocks + at[b], &sum[axis][b], sizeof(lanes));
    }
}"""
)
def sum_forces_of_functions(
    instances: Instances, basis: Basis, points: Points, constraints: PointConstraints, arrays: NewtonArrays, i: int
) -> None:
    """Sum V P grad b_k over the points of an instance, less b_k f; see ``evaluate_kernels.sum_force_block``."""


@wp.func
def forces_of(step: NewtonStep, active: wp.array[int], i: int):
    """Sum the forces on the functions of an instance."""
    if active[step.instances.world[i]] != 0:
        sum_forces_of_functions(step.instances, step.basis, step.points, step.constraints, step.arrays, i)


@wp.func
def columns_of(step: NewtonStep, i: int):
    """Fill the columns right of K of an instance."""
    w = step.instances.world[i]
    if step.state.active[w] == 0 or left_out(step.instances, step.arrays.systems.pattern, i):
        return
    first = first_coupled(step.instances, i)
    rigid_max = step.options.rigid_max
    sum_columns(step.instances, step.basis, step.constraints, step.rigid, step.arrays, rigid_max, first, w, i)


_MATRIX_TILE = """
            case ROWS: {
                floats sum[8 * ROWS] = {};
                for (int k = pins; k < acting_count; ++k) {
                    const int e = acting[k];
                    const float* const at = functions + 8 * (size_t)rows[e] * blocks;
                    floats u;
                    __builtin_memcpy(&u, at + 8 * column, sizeof(u));
                    u = hessian[9 * e + 3 * c + d] * u;
                    #pragma unroll
                    for (int a = 0; a < 8 * ROWS; ++a) sum[a] += at[8 * row + a] * u;
                }
                #pragma unroll
                for (int a = 0; a < 8 * ROWS; ++a) {
                    floats value, more;
                    __builtin_memcpy(&value, from + a * width, sizeof(value));
                    if (pinned && c == d) {
                        __builtin_memcpy(&more, pin + a * blocks, sizeof(more));
                        value += more;
                    }
                    if (driven > 0)
                        for (int lane = 0; lane < 8; ++lane)
                            if (8 * row + a < driven || 8 * column + lane < driven) value[lane] = sum[a][lane] = 0.0f;
                    if (c == d && row + a / 8 == column) value[a % 8] += inertia;
                    value += sum[a];
                    __builtin_memcpy(out + a * columns, &value, sizeof(value));
                }
                break;
            }
"""


@wp.func_native(
    snippet="""{
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    const int blocks = basis.row.shape[1], width = 3 * blocks;
    const int driven = instances.driven_count.data[i], first = instances.system_block.data[i];
    const int pins = instances.pin_count.data[i], acting_count = constraints.acting_count.data[i];
    const bool pinned = pins > 0;
    const size_t columns = arrays.systems.matrix.shape[2], own = (size_t)i * constraints.row.shape[1];
    const int* const acting = (const int*)constraints.acting.data + own;
    const int* const rows = (const int*)constraints.row.data + own;
    const float* const hessian = (const float*)constraints.hessian.data + 9 * own;
    const float* const functions = (const float*)basis.row.data;
    const floats* stiffness = (const floats*)((const char*)arrays.stiffness.data + i * arrays.stiffness.strides[0]);
    const floats* pin_matrix = (const floats*)arrays.pins.data + (pinned ? (size_t)i * 8 * blocks * blocks : 0);
    floats* matrix = (floats*)arrays.systems.matrix.data;
    matrix += ((size_t)instances.system.data[i] * arrays.systems.matrix.shape[1] + 8 * first) * columns + first;
    for (int c = 0; c < 3; ++c)
        for (int d = c; d < 3; ++d)
            for (int column = 0; column < blocks; ++column) {
                const int end = c == d ? column + 1 : blocks;
                #if defined(__AVX512VL__)
                const int tiles = (end + TILE - 1) / TILE;
                #else
                const int tiles = end;
                #endif
                for (int tile = 0; tile < tiles; ++tile) {
                    const int row = tile * end / tiles;
                    const floats* const from = stiffness + 8 * (c * blocks + row) * width + d * blocks + column;
                    const floats* const pin = pin_matrix + 8 * row * blocks + column;
                    floats* const out = matrix + 8 * (c * blocks + row) * columns + d * blocks + column;
                    switch ((tile + 1) * end / tiles - row) {
CASES
                    }
                }
            }
}""".replace("CASES", "".join(_MATRIX_TILE.replace("ROWS", str(rows + 1)) for rows in range(TILE))).replace(
        "TILE", str(TILE)
    )
)
def sum_matrix(
    instances: Instances, basis: Basis, constraints: PointConstraints, arrays: NewtonArrays, inertia: float, i: int
) -> None:
    """Add inertia, pins and contacts to the stiffness of an instance, in one part as it is on CPU.

    See ``assembly_kernels.matrix_row`` and ``contact_block``.
    """


@wp.func
def matrix_of(step: NewtonStep, i: int):
    """Add inertia, pins and contacts to the stiffness of an instance; driven unknowns stay put."""
    if step.state.active[step.instances.world[i]] == 0 or left_out(step.instances, step.arrays.systems.pattern, i):
        return
    inertia = inertia_of(step.instances, step.motion, step.options.dt, i)
    sum_matrix(step.instances, step.basis, step.constraints, step.arrays, inertia, i)


@wp.func_native(
    snippet="""{
    const int n = rigid.count.data[world], room = rigid.inertia.shape[1];
    double* matrix = (double*)rigid.matrix.data + (size_t)world * room * room;
    double* gradient = (double*)rigid.gradient.data + (size_t)world * room;
    const double* inertia = (const double*)rigid.inertia.data + (size_t)world * room * room;
    const double* r = (const double*)rigid.r.data + (size_t)world * room;
    const double* predicted = (const double*)rigid.predicted.data + (size_t)world * room;
    for (int j = 0; j < n; ++j) {
        double g = 0.0;
        for (int l = 0; l < n; ++l) g += inertia[j * room + l] * (r[l] - predicted[l]);
        gradient[j] = g;
        for (int l = 0; l <= j; ++l) matrix[j * room + l] = inertia[j * room + l];
    }
    const size_t width = constraints.jacobian.shape[2];
    for (int i = begin; i < end; ++i) {
        const size_t own = (size_t)i * constraints.row.shape[1];
        const int* acting = (const int*)constraints.acting.data + own;
        const int pins = instances.link_pin_count.data[i] > 0 ? 0 : instances.pin_count.data[i];
        for (int k = pins; k < constraints.acting_count.data[i]; ++k) {
            const size_t e = own + acting[k];
            const float* J = (const float*)constraints.jacobian.data + 3 * e * width;
            const float* C = (const float*)constraints.coupling.data + 3 * e * width;
            const double* f = (const double*)constraints.force.data + 3 * e;
            const int first = constraints.dof_begin.data[e], last = constraints.dof_end.data[e];
            for (int j = first; j < last && j < n; ++j) {
                const float *a = J + 3 * j, *c = C + 3 * first;
                for (int l = first; l <= j; ++l, c += 3)
                    matrix[j * room + l] += (double)(a[0] * c[0] + a[1] * c[1] + a[2] * c[2]);
                gradient[j] += a[0] * f[0] + a[1] * f[1] + a[2] * f[2];
            }
        }
    }
    for (int k = 0; k < rigid.row_count.data[world]; ++k) {
        const size_t row = (size_t)world * rigid.row_jacobian.shape[1] + k;
        const float* J = (const float*)rigid.row_jacobian.data + row * room;
        const double* C = (const double*)rigid.row_coupling.data + row * room;
        const double f = ((const double*)rigid.row_force.data)[row];
        for (int j = 0; j < n; ++j) {
            for (int l = 0; l <= j; ++l) matrix[j * room + l] += (double)J[j] * C[l];
            gradient[j] += (double)J[j] * f;
        }
    }
    for (int j = 0; j < n; ++j)
        for (int l = 0; l < j; ++l) matrix[l * room + j] = matrix[j * room + l];
}"""
)
def sum_rigid(
    instances: Instances, constraints: PointConstraints, rigid: Rigid, begin: int, end: int, world: int
) -> None:
    """Compute gradient and Hessian of the rigid dofs of a world; see ``assembly_kernels.rigid_entry``."""


@wp.func
def rigid_of(step: NewtonStep, w: int):
    """Compute gradient and Hessian of the rigid dofs of a world."""
    if step.state.active[w] == 0 or step.rigid.count[w] == 0:
        return
    begin = step.state.instance_start[w]
    end = step.state.instance_start[w + 1]
    sum_rigid(step.instances, step.constraints, step.rigid, begin, end, w)


@wp.func_native(
    snippet="""{
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    typedef double lanes __attribute__((ext_vector_type(8)));
    const size_t unknowns = arrays.systems.matrix.shape[1], columns = 8 * arrays.systems.matrix.shape[2];
    const int n = rigid.count.data[world], rigid_max = rigid.inertia.shape[1];
    const float* right = (const float*)arrays.systems.matrix.data + (size_t)system * unknowns * columns + unknowns;
    double* matrix = (double*)rigid.matrix.data + (size_t)world * rigid_max * rigid_max;
    double* direction = (double*)rigid.direction.data + (size_t)world * rigid_max;
    for (int first = 0; first < n; first += 4)
        for (int block = 0; 8 * block <= rigid_max; ++block) {
            if (8 * block >= n && rigid_max >= 8 * block + 8) continue;
            lanes sum[4] = {};
            for (int row = 0; row < rows; ++row) {
                const float* at = right + row * columns;
                floats entry;
                __builtin_memcpy(&entry, at + 8 * block, sizeof(entry));
                const lanes wide = __builtin_convertvector(entry, lanes);
                for (int k = 0; k < 4; ++k) sum[k] += (double)at[first + k] * wide;
            }
            for (int k = 0; k < 4 && first + k < n; ++k)
                for (int lane = 0; lane < 8; ++lane) {
                    const int j = first + k, l = 8 * block + lane;
                    if (l <= j) matrix[j * rigid_max + l] -= sum[k][lane];
                    if (l == rigid_max) direction[j] -= sum[k][lane];
                }
        }
}"""
)
def subtract_products(rigid: Rigid, arrays: NewtonArrays, world: int, system: int, rows: int) -> None:
    """Subtract Y^T Y of a system from the lower triangle of a world's rigid matrix, Y^T y from its right-hand side."""


@wp.func
def condense_world(step: NewtonStep, w: int):
    """Subtract the bodies from the rigid system of a world; see ``assembly_kernels.condensed_entry``."""
    if step.state.active[w] == 0:
        return
    for j in range(step.rigid.count[w]):
        step.rigid.pivot_min[w, j] = wp.max(
            step.rigid.pivot_floor[w, j], CONDENSED_ROUNDING * step.rigid.matrix[w, j, j]
        )
        step.rigid.direction[w, j] = -step.rigid.gradient[w, j]
    blocks = step.arrays.systems.matrix.shape[1] / LANES
    for s in range(step.arrays.system_start[w], step.arrays.system_start[w + 1]):
        rows = LANES * used_blocks(step.arrays.systems.pattern, s, blocks)
        subtract_products(step.rigid, step.arrays, w, s, rows)


assemble_stiffness = kernel_over(stiffness_of, "assemble_stiffness", "i")
sum_forces = kernel_over(forces_of, "sum_forces", "i")
assemble_matrix = kernel_over(matrix_of, "assemble_matrix", "i")
assemble_rigid = kernel_over(rigid_of, "assemble_rigid", "w")
assemble_columns = kernel_over(columns_of, "assemble_columns", "i")
condense = kernel_over(condense_world, "condense", "w")
