"""Assembly, Cholesky factorisation and solve of one small system by a block of CUDA threads, in shared memory.

The algorithms of ``assembly_kernels`` and ``factor``, for a kernel in which a block takes a world through everything:
there every number that another thread has written is a round trip to L2, and the threads of one world are too few to
hide it. The system stays in shared memory from its assembly to its solution; loops keep several loads in flight.

Only the upper triangle is kept: row block b, eight rows, from its diagonal block to the last right-hand column, W - 8 b
numbers a row. Diagonal blocks hold U with inverse pivots once they are factored. The sizes are constants of the code,
so that indices cost no division; each size is compiled when it is first used. Compiled for a CPU the same code runs
with one thread, for tests.
"""

from functools import cache
from typing import Any

import warp as wp

from softmode.deformables.model.struct_kernels import Basis, Instances, PointConstraints, Points, Rigid
from softmode.deformables.solver.iteration_kernels import NewtonArrays

STATIC_BYTES = 44 * 1024
"""Shared memory that a kernel may have without asking: 48 kB, less the scratch of sums over a team."""


def shared_floats(size: int, width: int) -> int:
    """Return how many numbers a system takes of N = ``size`` unknowns and W = ``width`` columns, multiples of eight."""
    blocks = size // 8
    return 8 * blocks * width - 32 * blocks * (blocks - 1)


def dynamic_floats(size: int, width: int) -> int:
    """Return how many of those numbers a kernel has to ask for when it is launched: all or none."""
    needed = shared_bytes(size, width)
    return 0 if needed <= STATIC_BYTES else needed // 4


def shared_bytes(size: int, width: int) -> int:
    """Return how much shared memory a block needs for such a system and its right-hand side."""
    return 4 * (shared_floats(size, width) + size)


_BEGIN = """
#if defined(__CUDA_ARCH__)
#define SOFTMODE_SHARED __shared__ __align__(16)
#define SOFTMODE_BARRIER __syncthreads()
#else
#define SOFTMODE_SHARED alignas(16) static
#define SOFTMODE_BARRIER
#endif
    struct alignas(16) Quad { float x, y, z, w; };
"""
_END = """
#undef SOFTMODE_SHARED
#undef SOFTMODE_BARRIER
"""
_STATIC = """
    SOFTMODE_SHARED float room[FLOATS + SIZE];
"""
_DYNAMIC = """
#if defined(__CUDA_ARCH__)
    extern __shared__ char dynamic_smem_base[];  // of Warp's tiles: the kernel has one of this size and no other
    float* room = (float*)dynamic_smem_base;
#else
    alignas(16) static float room[FLOATS + SIZE];
#endif
"""
_SYSTEM = """
    // mode 0: assemble A, load B, factor, write U^-T B back; mode 1: solve with the factor that is there
    float* A = room;
    float* right = room + FLOATS;
    constexpr int N = SIZE;
    constexpr int W = WIDTH;
    // column 0 of row r, were it there
    const auto row_of = [](int r) {
        const int b = r / 8;
        return 8 * b * W - 32 * b * (b - 1) + (r - 8 * b) * (W - 8 * b) - 8 * b;
    };
    float* g = (float*)arrays.systems.scalars.data + (size_t)i * N * W;
    if (mode == 0) {
        const int chunks = arrays.stiffness.shape[1];
        const float* K = (const float*)arrays.stiffness.data + (size_t)i * chunks * N * N;
        constexpr int quads = N / 4;
        #pragma unroll 4
        for (int t = member; t < N * quads; t += team) {
            const int row = t / quads;
            const int first = 4 * (t - row * quads);
            if (first >= (row & ~7)) {
                Quad value = *(const Quad*)&K[row * N + first];
                for (int chunk = 1; chunk < chunks; ++chunk) {
                    const Quad more = *(const Quad*)&K[(size_t)chunk * N * N + row * N + first];
                    value.x += more.x; value.y += more.y; value.z += more.z; value.w += more.w;
                }
                const int at = row - first;
                if (at == 0) value.x += inertia;
                if (at == 1) value.y += inertia;
                if (at == 2) value.z += inertia;
                if (at == 3) value.w += inertia;
                *(Quad*)&A[row_of(row) + first] = value;
            }
        }
        #pragma unroll 4
        for (int t = member; t < N * (W - N); t += team) {
            const int row = t / (W - N);
            const int at = N + t - row * (W - N);
            A[row_of(row) + at] = g[row * W + at];
        }
        SOFTMODE_BARRIER;
        constexpr int blocks = N / 24;
        const int acting_count = constraints.acting_count.data[i];
        const int* acting = (const int*)constraints.acting.data + (size_t)i * constraints.acting.shape[1];
        const int* rows = (const int*)constraints.row.data + (size_t)i * constraints.row.shape[1];
        const int capacity = constraints.hessian.shape[1];
        const float* H = (const float*)constraints.hessian.data + (size_t)i * capacity * 9;
        const float* values = (const float*)basis.row.data;
        // half blocks, 4 x 8: of the components (c, d), rows 4 k of the functions, columns 8 m
        for (int t = member; t < 9 * 2 * blocks * blocks; t += team) {
            const int c = t / (6 * blocks * blocks);
            const int d = (t / (2 * blocks * blocks)) % 3;
            const int k = (t / blocks) % (2 * blocks);
            const int m = t % blocks;
            if (c > d || (c == d && m < k / 2) || acting_count == 0) continue;
            float sum[4][8];
            #pragma unroll
            for (int a = 0; a < 4; ++a) {
                #pragma unroll
                for (int b = 0; b < 8; ++b) sum[a][b] = 0.0f;
            }
            #pragma unroll 4
            for (int s = 0; s < acting_count; ++s) {
                const int e = acting[s];
                const float* r = values + (size_t)rows[e] * 8 * blocks;
                const float h = H[9 * e + 3 * c + d];
                const Quad u = *(const Quad*)&r[4 * k];
                const Quad v = *(const Quad*)&r[8 * m];
                const Quad w = *(const Quad*)&r[8 * m + 4];
                const float left[4] = {u.x * h, u.y * h, u.z * h, u.w * h};
                #pragma unroll
                for (int a = 0; a < 4; ++a) {
                    sum[a][0] += left[a] * v.x; sum[a][1] += left[a] * v.y;
                    sum[a][2] += left[a] * v.z; sum[a][3] += left[a] * v.w;
                    sum[a][4] += left[a] * w.x; sum[a][5] += left[a] * w.y;
                    sum[a][6] += left[a] * w.z; sum[a][7] += left[a] * w.w;
                }
            }
            #pragma unroll
            for (int a = 0; a < 4; ++a) {
                #pragma unroll
                for (int b = 0; b < 8; ++b) {
                    A[row_of(c * 8 * blocks + 4 * k + a) + d * 8 * blocks + 8 * m + b] += sum[a][b];
                }
            }
        }
        SOFTMODE_BARRIER;
        int bad = 0;
        for (int first = 0; first < N; first += 8) {
            float* here = A + row_of(first);
            const int stride = W - first;
            for (int l = first + member; l < W; l += team) {
                float r[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) r[a] = here[a * stride + l];
                for (int above = 0; above < first; above += 8) {
                    const float* rows_above = A + row_of(above);
                    #pragma unroll
                    for (int s = 0; s < 8; ++s) {
                        const float* row = rows_above + s * (W - above);
                        const Quad u = *(const Quad*)&row[first];
                        const Quad v = *(const Quad*)&row[first + 4];
                        const float x = row[l];
                        r[0] -= u.x * x; r[1] -= u.y * x; r[2] -= u.z * x; r[3] -= u.w * x;
                        r[4] -= v.x * x; r[5] -= v.y * x; r[6] -= v.z * x; r[7] -= v.w * x;
                    }
                }
                #pragma unroll
                for (int a = 0; a < 8; ++a) here[a * stride + l] = r[a];
            }
            SOFTMODE_BARRIER;
            // every thread factors its own copy of the diagonal block (inverse pivots): cheaper than waiting for one
            float U[8][8];
            const float* bounds = (const float*)arrays.systems.bounds.data + 2 * ((size_t)i * (N / 8) + first / 8);
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                float row[8];
                #pragma unroll
                for (int b = 0; b < 8; ++b) row[b] = b >= a ? here[a * stride + first + b] : 0.0f;
                const float size = row[a] < 0.0f ? -row[a] : row[a];
                float floor = 1.0e-6f * size > 1.0e-30f ? 1.0e-6f * size : 1.0e-30f;
                const float least = bounds[1] > 0.0f ? -bounds[1] : floor;
                floor = bounds[0] > floor ? bounds[0] : floor;
                #pragma unroll
                for (int s = 0; s < a; ++s) {
                    #pragma unroll
                    for (int b = a; b < 8; ++b) row[b] -= U[s][a] * U[s][b];
                }
                if (!(row[a] >= least)) bad = 1;
                const float inverse = 1.0f / wp::sqrt(row[a] > floor ? row[a] : floor);
                #pragma unroll
                for (int b = a; b < 8; ++b) U[a][b] = inverse * row[b];
                U[a][a] = inverse;
            }
            for (int l = first + 8 + member; l < W; l += team) {
                float x[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) {
                    float value = here[a * stride + l];
                    #pragma unroll
                    for (int s = 0; s < a; ++s) value -= U[s][a] * x[s];
                    x[a] = U[a][a] * value;
                    here[a * stride + l] = x[a];
                    if (l >= N) g[(first + a) * W + l] = x[a];
                }
            }
            SOFTMODE_BARRIER;
            // nobody reads the diagonal block again before the solution
            if (member == 0) {
                #pragma unroll
                for (int a = 0; a < 8; ++a) {
                    #pragma unroll
                    for (int b = a; b < 8; ++b) here[a * stride + first + b] = U[a][b];
                }
            }
        }
        SOFTMODE_BARRIER;
        if (member == 0) arrays.systems.indefinite.data[i] = bad;
    } else {
        const int tail_count = rigid.count.data[world];
        const double* t = (const double*)rigid.direction.data + (size_t)world * rigid.direction.shape[1];
        for (int row = member; row < N; row += team) {
            float value = A[row_of(row) + N + rigid_max];
            for (int j = 0; j < tail_count; ++j) value -= A[row_of(row) + N + j] * (float)t[j];
            right[row] = value;
        }
        SOFTMODE_BARRIER;
        float* out = (float*)arrays.direction.data + (size_t)i * N;
        for (int first = N - 8; first >= 0; first -= 8) {
            const float* here = A + row_of(first);
            float x[8];
            #pragma unroll
            for (int a = 7; a >= 0; --a) {
                float value = right[first + a];
                #pragma unroll
                for (int b = a + 1; b < 8; ++b) value -= here[a * (W - first) + first + b] * x[b];
                x[a] = value * here[a * (W - first) + first + a];
            }
            if (member == 0) {
                #pragma unroll
                for (int a = 0; a < 8; ++a) out[first + a] = x[a];
            }
            for (int row = member; row < first; row += team) {
                float value = right[row];
                #pragma unroll
                for (int b = 0; b < 8; ++b) value -= A[row_of(row) + first + b] * x[b];
                right[row] = value;
            }
            SOFTMODE_BARRIER;
        }
    }
"""


@cache
def shared_system_of(size: int, width: int) -> Any:
    """Return the device function for systems of N = ``size`` unknowns and W = ``width`` columns."""
    room = _DYNAMIC if dynamic_floats(size, width) else _STATIC
    snippet = _BEGIN + room + _SYSTEM + _END
    for name, value in {"FLOATS": shared_floats(size, width), "SIZE": size, "WIDTH": width}.items():
        snippet = snippet.replace(name, str(value))

    @wp.func_native(snippet=snippet)
    def shared_system(
        mode: int,
        inertia: float,
        rigid_max: int,
        basis: Basis,
        constraints: PointConstraints,
        rigid: Rigid,
        arrays: NewtonArrays,  # the matrices hold from column N on B, and after mode 0 U^-T B
        i: int,
        world: int,
        member: int,
        team: int,
    ) -> None:
        """Assemble and factor system ``i`` (mode 0), later solve it (mode 1). One body per world, no pins."""
        ...

    return shared_system


@wp.func_native(
    snippet="""
    const int blocks = basis.row.shape[1];
    const int n = 8 * blocks;
    const size_t by_block = basis.gradient_across.strides[0];
    const size_t by_point = basis.gradient_across.strides[1];
    const size_t by_axis = basis.gradient_across.strides[2];
    const int first_point = instances.point_start.data[i];
    const int point_count = instances.point_count.data[i];
    const int acting_count = constraints.acting_count.data[i];
    const int* acting = (const int*)constraints.acting.data + (size_t)i * constraints.acting.shape[1];
    const double* P = (const double*)points.stress.data + (size_t)i * points.stress.shape[1] * 9;
    const double* F = (const double*)constraints.force.data + (size_t)i * constraints.force.shape[1] * 3;
    const int* rows = (const int*)constraints.row.data + (size_t)i * constraints.row.shape[1];
    const float* values = (const float*)basis.row.data;
    double* out = (double*)arrays.gradient_chunk.data + (size_t)i * arrays.gradient_chunk.shape[1] * 3 * n;
    for (int t = member; t < 3 * n; t += team) {
        const int axis = t / n;
        const int k = t - axis * n;
        const char* G = (const char*)basis.gradient_across.data + (k / 8) * by_block + (size_t)first_point * by_point;
        G += (k % 8) * sizeof(float);
        double value = 0.0;
        #pragma unroll 8
        for (int p = 0; p < point_count; ++p) {
            const char* at = G + (size_t)p * by_point;
            value += P[9 * p + 3 * axis] * (double)*(const float*)at;
            value += P[9 * p + 3 * axis + 1] * (double)*(const float*)(at + by_axis);
            value += P[9 * p + 3 * axis + 2] * (double)*(const float*)(at + 2 * by_axis);
        }
        #pragma unroll 8
        for (int s = 0; s < acting_count; ++s) {
            const int e = acting[s];
            value -= F[3 * e + axis] * (double)values[(size_t)rows[e] * n + k];
        }
        out[t] = value;
    }
"""
)
def sum_forces_of(
    instances: Instances,
    basis: Basis,
    points: Points,
    constraints: PointConstraints,
    arrays: NewtonArrays,
    i: int,
    member: int,
    team: int,
) -> None:
    """Sum V P grad b_k over the points, less b_k f over the constraints, a thread per unknown."""
    ...
