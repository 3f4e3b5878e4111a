"""Assembly, Cholesky factorisation and solve of one small system by a block of CUDA threads, in shared memory.

The algorithms of ``assembly_kernels`` and ``factor``, for a kernel in which a block takes a world through everything:
there every number that another thread has written is a round trip to L2, and the threads of one world are too few to
hide it. The system stays in shared memory from its assembly to its solution; loops keep several loads in flight.

Only the upper triangle is kept: row block b, eight rows, from its diagonal block to the last right-hand column, W - 8 b
numbers a row. Diagonal blocks hold U with inverse pivots once they are factored. The sizes are constants of the code,
so that indices cost no division; each size is compiled when it is first used. Compiled for a CPU the same code runs
with one thread, for tests.

Code that runs once in an iteration is fetched from L2 each time, since all of it is several times larger than the
instruction cache. Loops are unrolled where they are long, and kept (``unroll 1``) where that would only add code.
"""

from functools import cache
from typing import Any

import warp as wp

from softmode.deformables.model.newton_step_kernels import NewtonArrays
from softmode.deformables.model.struct_kernels import Basis, Instances, PointConstraints, Points, Rigid
from softmode.deformables.system.assembly_kernels import CONDENSED_ROUNDING

STATIC_BYTES = 36 * 1024
"""Shared memory that a kernel may have without asking: 48 kB, less the scratch of sums over a team and of forces."""


CONTACTS = 16
"""Contacts that are in shared memory at a time."""


def shared_floats(size: int, width: int) -> int:
    """Return how many numbers a system takes of N = ``size`` unknowns and W = ``width`` columns, multiples of eight."""
    blocks = size // 8
    return 8 * blocks * width - 32 * blocks * (blocks - 1)


def dynamic_floats(size: int, width: int) -> int:
    """Return how many of those numbers a kernel has to ask for when it is launched: all or none."""
    needed = shared_bytes(size, width)
    return 0 if needed <= STATIC_BYTES else needed // 4


def shared_bytes(size: int, width: int) -> int:
    """Return how much shared memory a block needs for such a system, its right-hand side and the rigid unknowns."""
    columns = width - size
    system = 4 * (shared_floats(size, width) + size) + 8 * _rigid_doubles(columns)
    return system + CONTACTS * _contact_bytes(size, columns)


def _contact_bytes(size: int, columns: int) -> int:
    """Return what a contact takes: a force (doubles), a row of the basis, a Hessian, motions of its shape, indices."""
    return 8 * 3 + 4 * (size // 3 + 9 + 2 * 3 * columns + 2)


def _rigid_doubles(columns: int) -> int:
    """Return how many numbers the rigid unknowns take: their matrix, least pivots, ratios, scales, right-hand side."""
    return columns * columns + 4 * columns


_BEGIN = """
#if defined(__CUDA_ARCH__)
#define SOFTMODE_SHARED __shared__ __align__(16)
#define SOFTMODE_BARRIER __syncthreads()
#define SOFTMODE_WARP __syncwarp()
#define SOFTMODE_RSQRT(x) rsqrtf(x)  // to 2 units in the last place, in a tenth of the instructions
#define SOFTMODE_RSQRT_DOUBLE(x) rsqrt(x)
#else
#define SOFTMODE_SHARED alignas(16) static
#define SOFTMODE_BARRIER
#define SOFTMODE_WARP
#define SOFTMODE_RSQRT(x) (1.0f / wp::sqrt(x))
#define SOFTMODE_RSQRT_DOUBLE(x) (1.0 / wp::sqrt(x))
#endif
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
// 16 bytes into shared memory; a thread goes on, and waits for all of its own at once
#define SOFTMODE_FETCH(to, from) asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" \
    :: "r"((unsigned)__cvta_generic_to_shared(to)), "l"(from) : "memory")
#define SOFTMODE_FETCHED asm volatile("cp.async.wait_all;" ::: "memory")
#else
#define SOFTMODE_FETCH(to, from) *(Quad*)(to) = *(const Quad*)(from)
#define SOFTMODE_FETCHED
#endif
    struct alignas(16) Quad { float x, y, z, w; };
"""
_END = """
#undef SOFTMODE_SHARED
#undef SOFTMODE_BARRIER
#undef SOFTMODE_WARP
#undef SOFTMODE_RSQRT
#undef SOFTMODE_RSQRT_DOUBLE
#undef SOFTMODE_FETCH
#undef SOFTMODE_FETCHED
"""
_STATIC = """
    SOFTMODE_SHARED float room[BYTES / 4];
"""
_DYNAMIC = """
#if defined(__CUDA_ARCH__)
    extern __shared__ char dynamic_smem_base[];  // of Warp's tiles: the kernel has one of this size and no other
    float* room = (float*)dynamic_smem_base;
#else
    alignas(16) static float room[BYTES / 4];
#endif
"""
_SYSTEM = """
    float* A = room;
    float* right = room + FLOATS;
    constexpr int N = SIZE;
    constexpr int W = WIDTH;
    constexpr int R = W - N;
    double* S = (double*)(right + N);  // (R, R): the rigid unknowns' matrix, then its factor with inverse pivots
    double* least = S + R * R;
    double* ratio = least + R;
    double* scale = ratio + R;
    double* move = scale + R;
    // of some contacts: force, row of the basis, Hessian, motion of the shape, Hessian times motion
    double* near_force = move + R;
    float* near_values = (float*)(near_force + 3 * TILE);
    float* near_hessian = near_values + 8 * (N / 24) * TILE;
    float* near_jacobian = near_hessian + 9 * TILE;
    float* near_coupling = near_jacobian + 3 * R * TILE;
    int* near_index = (int*)(near_coupling + 3 * R * TILE);
    int* near_row = near_index + TILE;
    // column 0 of row r, were it there
    const auto row_of = [](int r) {
        const int b = r / 8;
        return 8 * b * W - 32 * b * (b - 1) + (r - 8 * b) * (W - 8 * b) - 8 * b;
    };
    constexpr int blocks = N / 24;
    const int tail = rigid.count.data[world];
    const int acting_count = constraints.acting_count.data[i];
    const int* acting = (const int*)constraints.acting.data + (size_t)i * constraints.acting.shape[1];
    const int* rows = (const int*)constraints.row.data + (size_t)i * constraints.row.shape[1];
    const int* begins = (const int*)constraints.dof_begin.data + (size_t)i * constraints.dof_begin.shape[1];
    const int* ends = (const int*)constraints.dof_end.data + (size_t)i * constraints.dof_end.shape[1];
    const int capacity = constraints.hessian.shape[1];
    const float* H = (const float*)constraints.hessian.data + (size_t)i * capacity * 9;
    const int dofs = constraints.jacobian.shape[2];  // room for rigid unknowns
    const float* J = (const float*)constraints.jacobian.data + (size_t)i * capacity * dofs * 3;
    const float* HJ = (const float*)constraints.coupling.data + (size_t)i * capacity * dofs * 3;
    const double* F = (const double*)constraints.force.data + (size_t)i * capacity * 3;
    const float* values = (const float*)basis.row.data;
    {
        const int chunks = arrays.stiffness.shape[1];
        const float* K = (const float*)arrays.stiffness.data + (size_t)i * chunks * N * N;
        constexpr int quads = N / 4;
        #pragma unroll 4
        for (int t = member; t < N * quads; t += team) {
            const int row = t / quads;
            const int first = 4 * (t - row * quads);
            if (first >= (row & ~7)) SOFTMODE_FETCH(&A[row_of(row) + first], &K[row * N + first]);
        }
        for (int t = member; t < TILE && t < acting_count; t += team) {
            near_index[t] = acting[t];
            near_row[t] = rows[acting[t]];
        }
        // right of K: -g in column rigid_max; the contacts' -sum_e b_k H_e J_e comes on top
        const double* g = (const double*)arrays.gradient.data + (size_t)i * N;
        for (int t = member; t < N * R; t += team) {
            const int j = t / N;
            const int row = t - j * N;
            A[row_of(row) + N + j] = j == rigid_max ? (float)-g[row] : 0.0f;
        }
        // the rigid unknowns: inertia and rows; forces in ``move``
        const double* M = (const double*)rigid.inertia.data + (size_t)world * dofs * dofs;
        const double* r = (const double*)rigid.r.data + (size_t)world * dofs;
        const double* predicted = (const double*)rigid.predicted.data + (size_t)world * dofs;
        const int row_count = rigid.row_count.data[world];
        const size_t first_row = (size_t)world * rigid.row_force.shape[1];
        const float* row_jacobian = (const float*)rigid.row_jacobian.data + first_row * dofs;
        const double* row_coupling = (const double*)rigid.row_coupling.data + first_row * dofs;
        const double* row_force = (const double*)rigid.row_force.data + first_row;
        for (int t = member; t < tail * (tail + 1); t += team) {
            const int j = t / (tail + 1);
            const int l = t - j * (tail + 1);
            if (l > j && l < tail) continue;
            double value = 0.0;
            if (l == tail) {
                #pragma unroll 4
                for (int k = 0; k < tail; ++k) value += M[j * dofs + k] * (r[k] - predicted[k]);
                #pragma unroll 4
                for (int k = 0; k < row_count; ++k) value += (double)row_jacobian[k * dofs + j] * row_force[k];
                move[j] = value;
            } else {
                value = M[j * dofs + l];
                #pragma unroll 4
                for (int k = 0; k < row_count; ++k) {
                    value += (double)row_jacobian[k * dofs + j] * row_coupling[k * dofs + l];
                }
                S[j * R + l] = value;
            }
        }
        SOFTMODE_FETCHED;
        if (chunks > 1) {
            #pragma unroll 2
            for (int t = member; t < N * quads; t += team) {
                const int row = t / quads;
                const int first = 4 * (t - row * quads);
                if (first >= (row & ~7)) {
                    Quad value = *(const Quad*)&A[row_of(row) + first];
                    #pragma unroll 4
                    for (int chunk = 1; chunk < chunks; ++chunk) {
                        const Quad more = *(const Quad*)&K[(size_t)chunk * N * N + row * N + first];
                        value.x += more.x; value.y += more.y; value.z += more.z; value.w += more.w;
                    }
                    *(Quad*)&A[row_of(row) + first] = value;
                }
            }
        }
        SOFTMODE_BARRIER;
        // contacts, some at a time: fetched once by all threads, then read from shared memory by every sum. A load that
        // waits for another takes twice as long, so which contacts come next is known before
        for (int start = 0; start == 0 || start < acting_count; start += TILE) {
            const int held = acting_count - start < TILE ? acting_count - start : TILE;
            for (int t = member; t < held * 2 * blocks; t += team) {
                const int s = t / (2 * blocks);
                const int k = 4 * (t - s * 2 * blocks);
                const float* given = values + (size_t)near_row[s] * 8 * blocks;
                SOFTMODE_FETCH(&near_values[s * 8 * blocks + k], &given[k]);
            }
            #pragma unroll 4
            for (int t = member; t < held * tail * 3; t += team) {
                const int s = t / (3 * tail);
                const int at = t - s * 3 * tail;
                const int j = at / 3;
                const int e = near_index[s];
                // loaded together, whether needed or not: one wait instead of two
                const float motion = J[e * dofs * 3 + at];
                const float coupling = HJ[e * dofs * 3 + at];
                const bool moves = j >= begins[e] && j < ends[e];
                near_jacobian[s * 3 * R + at] = moves ? motion : 0.0f;
                near_coupling[s * 3 * R + at] = moves ? coupling : 0.0f;
            }
            #pragma unroll 2
            for (int t = member; t < held * 9; t += team) {
                const int s = t / 9;
                near_hessian[t] = H[9 * near_index[s] + t - 9 * s];
            }
            for (int t = member; t < held * 3; t += team) {
                const int s = t / 3;
                near_force[t] = F[3 * near_index[s] + t - 3 * s];
            }
            SOFTMODE_FETCHED;
            SOFTMODE_BARRIER;
            // by the last threads, which have the least to do
            const int next = acting_count - start - TILE < TILE ? acting_count - start - TILE : TILE;
            for (int t = team - 1 - member; t < next; t += team) {
                near_index[t] = acting[start + TILE + t];
                near_row[t] = rows[acting[start + TILE + t]];
            }
            for (int t = member; t < 3 * blocks * tail; t += team) {
                const int j = t / (3 * blocks);
                const int first = 8 * (t - j * 3 * blocks);
                const int c = first / (8 * blocks);
                const int k = first - c * 8 * blocks;
                float sum[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) sum[a] = 0.0f;
                #pragma unroll 4
                for (int s = 0; s < held; ++s) {
                    const float h = near_coupling[(s * R + j) * 3 + c];
                    const Quad u = *(const Quad*)&near_values[s * 8 * blocks + k];
                    const Quad v = *(const Quad*)&near_values[s * 8 * blocks + k + 4];
                    sum[0] -= h * u.x; sum[1] -= h * u.y; sum[2] -= h * u.z; sum[3] -= h * u.w;
                    sum[4] -= h * v.x; sum[5] -= h * v.y; sum[6] -= h * v.z; sum[7] -= h * v.w;
                }
                #pragma unroll
                for (int a = 0; a < 8; ++a) A[row_of(first + a) + N + j] += sum[a];
            }
            // half blocks, 4 x 8: of the components (c, d), rows 4 k of the functions, columns 8 m. Of components
            // c < d all of them; of c = d those that reach the diagonal
            constexpr int whole = 2 * blocks * blocks;
            constexpr int upper = blocks * (blocks + 1);
            for (int t = member; t < 3 * (whole + upper); t += team) {
                int c, d, k, m;
                if (t < 3 * whole) {
                    const int pair = t / whole;
                    c = pair == 2 ? 1 : 0;
                    d = pair == 0 ? 1 : 2;
                    k = (t - pair * whole) / blocks;
                    m = t % blocks;
                } else {
                    c = (t - 3 * whole) / upper;
                    d = c;
                    int rest = t - 3 * whole - c * upper;
                    k = 0;
                    while (rest >= blocks - k / 2) {
                        rest -= blocks - k / 2;
                        ++k;
                    }
                    m = k / 2 + rest;
                }
                float sum[4][8];
                #pragma unroll
                for (int a = 0; a < 4; ++a) {
                    #pragma unroll
                    for (int b = 0; b < 8; ++b) sum[a][b] = 0.0f;
                }
                #pragma unroll 2
                for (int s = 0; s < held; ++s) {
                    const float* row = near_values + s * 8 * blocks;
                    const float h = near_hessian[9 * s + 3 * c + d];
                    const Quad u = *(const Quad*)&row[4 * k];
                    const Quad v = *(const Quad*)&row[8 * m];
                    const Quad w = *(const Quad*)&row[8 * m + 4];
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
            for (int t = member; t < tail * (tail + 1); t += team) {
                const int j = t / (tail + 1);
                const int l = t - j * (tail + 1);
                if (l > j && l < tail) continue;
                double value = l == tail ? move[j] : S[j * R + l];
                #pragma unroll 4
                for (int s = 0; s < held; ++s) {
                    const float* u = &near_jacobian[(s * R + j) * 3];
                    if (l == tail) {
                        const double* f = &near_force[3 * s];
                        value += u[0] * f[0] + u[1] * f[1] + u[2] * f[2];
                    } else {
                        const float* v = &near_coupling[(s * R + l) * 3];
                        value += (double)(u[0] * v[0] + u[1] * v[1] + u[2] * v[2]);
                    }
                }
                if (l == tail) move[j] = value;
                else S[j * R + l] = value;
            }
            SOFTMODE_BARRIER;
        }
        int bad = 0;
        #pragma unroll 1
        for (int first = 0; first < N; first += 8) {
            float* here = A + row_of(first);
            const int stride = W - first;
            for (int l = first + member; l < W; l += team) {
                float r[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) r[a] = here[a * stride + l] + (l - first == a ? inertia : 0.0f);
                #pragma unroll 1
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
                const float inverse = SOFTMODE_RSQRT(row[a] > floor ? row[a] : floor);
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
        // the rigid unknowns, less the body: R - Y^T Y and -g_r - Y^T y
        const double* lowest = (const double*)rigid.pivot_floor.data + (size_t)world * dofs;
        for (int t = member; t < tail * (tail + 1); t += team) {
            const int j = t / (tail + 1);
            const int l = t - j * (tail + 1);
            if (l > j && l < tail) continue;
            double value = 0.0;
            int other = N + l;
            if (l == tail) {
                other = N + rigid_max;
                value = -move[j];
                ((double*)rigid.gradient.data)[(size_t)world * dofs + j] = move[j];
            } else {
                value = S[j * R + l];
                if (l == j) least[j] = lowest[j] > CONDENSED * value ? lowest[j] : CONDENSED * value;
            }
            double part[4] = {0.0, 0.0, 0.0, 0.0};
            #pragma unroll 1
            for (int first = 0; first < N; first += 8) {
                const float* here = A + row_of(first);
                #pragma unroll
                for (int a = 0; a < 8; ++a) {
                    part[a % 4] += (double)here[a * (W - first) + N + j] * (double)here[a * (W - first) + other];
                }
            }
            value -= (part[0] + part[1]) + (part[2] + part[3]);
            if (l == tail) move[j] = value;
            else S[j * R + l] = value;
        }
        SOFTMODE_BARRIER;
        // as ``assembly_kernels.factor_rigid``, by one warp: its threads wait for no others. What is left of the matrix
        // and of the right-hand side is updated column by column, since a sum of its own for every entry waits longer
        if (member < 32) {
            const int lanes = team < 32 ? team : 32;
            for (int b = member; b < tail; b += lanes) {
                scale[b] = 1.0 / (S[b * R + b] > least[b] ? S[b * R + b] : least[b]);
            }
            SOFTMODE_WARP;
            #pragma unroll 1
            for (int a = 0; a < tail; ++a) {
                for (int b = a + 1 + member; b < tail; b += lanes) {
                    ratio[b] = S[b * R + a] * S[b * R + a] * scale[b];
                }
                SOFTMODE_WARP;
                double pivot = S[a * R + a] > least[a] ? S[a * R + a] : least[a];
                #pragma unroll 4
                for (int b = a + 1; b < tail; ++b) pivot = pivot > ratio[b] ? pivot : ratio[b];
                const double inverse = SOFTMODE_RSQRT_DOUBLE(pivot);
                const double moved = inverse * move[a];
                SOFTMODE_WARP;
                for (int b = a + 1 + member; b < tail; b += lanes) {
                    S[b * R + a] *= inverse;
                    move[b] -= S[b * R + a] * moved;
                }
                if (member == 0) {
                    S[a * R + a] = inverse;
                    move[a] = moved;
                }
                SOFTMODE_WARP;
                for (int b = a + 1 + member; b < tail; b += lanes) {
                    #pragma unroll 4
                    for (int c = a + 1; c <= b; ++c) S[b * R + c] -= S[b * R + a] * S[c * R + a];
                }
                SOFTMODE_WARP;
            }
            double* out = (double*)rigid.direction.data + (size_t)world * dofs;
            #pragma unroll 1
            for (int a = tail - 1; a >= 0; --a) {
                const double moved = S[a * R + a] * move[a];
                SOFTMODE_WARP;
                for (int b = member; b < a; b += lanes) move[b] -= S[a * R + b] * moved;
                if (member == 0) {
                    move[a] = moved;
                    out[a] = moved;
                }
                SOFTMODE_WARP;
            }
        }
        SOFTMODE_BARRIER;
        for (int row = member; row < N; row += team) {
            float value = A[row_of(row) + N + rigid_max];
            #pragma unroll 1
            for (int j = 0; j < tail; ++j) value -= A[row_of(row) + N + j] * (float)move[j];
            right[row] = value;
        }
        SOFTMODE_BARRIER;
        float* out = (float*)arrays.direction.data + (size_t)i * N;
        #pragma unroll 1
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
def shared_direction_of(size: int, width: int) -> Any:
    """Return the device function for systems of N = ``size`` unknowns and W = ``width`` columns."""
    room = _DYNAMIC if dynamic_floats(size, width) else _STATIC
    snippet = _BEGIN + room + _SYSTEM + _END
    given = {
        "FLOATS": shared_floats(size, width),
        "BYTES": shared_bytes(size, width),
        "SIZE": size,
        "WIDTH": width,
        "TILE": CONTACTS,
        "CONDENSED": float(CONDENSED_ROUNDING),
    }
    for name, value in given.items():
        snippet = snippet.replace(name, str(value))

    @wp.func_native(snippet=snippet)
    def shared_direction(
        inertia: float,
        rigid_max: int,
        basis: Basis,
        constraints: PointConstraints,
        rigid: Rigid,
        arrays: NewtonArrays,
        i: int,
        world: int,
        member: int,
        team: int,
    ) -> None:
        """Compute Newton's direction of body ``i`` and of the rigid unknowns. One body per world, no pins."""
        ...

    return shared_direction


@wp.func_native(
    snippet="""
    const int blocks = basis.row.shape[1];
    const int n = 8 * blocks;
    const size_t by_block = basis.gradient_across.strides[0];
    const size_t by_point = basis.gradient_across.strides[1];
    const size_t by_axis = basis.gradient_across.strides[2];
    const int point_count = instances.point_count.data[i];
    const int acting_count = constraints.acting_count.data[i];
    const int* acting = (const int*)constraints.acting.data + (size_t)i * constraints.acting.shape[1];
    const double* P = (const double*)points.stress.data + (size_t)i * points.stress.shape[1] * 9;
    const double* F = (const double*)constraints.force.data + (size_t)i * constraints.force.shape[1] * 3;
    const int* rows = (const int*)constraints.row.data + (size_t)i * constraints.row.shape[1];
    const float* values = (const float*)basis.row.data;
    // a warp per part, a thread per function; what all of a part's threads read is fetched into shared memory
    constexpr int held = 16;
#if defined(__CUDA_ARCH__)
    __shared__ double fetched[(WP_TILE_BLOCK_DIM + 31) / 32 * 9 * held];
    __shared__ int fetched_row[(WP_TILE_BLOCK_DIM + 31) / 32 * held];
#define SOFTMODE_WARP __syncwarp()
#else
    double fetched[9 * held];
    int fetched_row[held];
#define SOFTMODE_WARP
#endif
    const int parts = team < 32 ? 1 : team / 32;
    const int lanes = team / parts;
    const int part = member / lanes;
    const int lane = member - part * lanes;
    double* here = fetched + part * 9 * held;
    int* here_row = fetched_row + part * held;
    const char* start = (const char*)basis.gradient_across.data;
    start += (size_t)instances.point_start.data[i] * by_point;
    double* out = (double*)arrays.gradient_chunk.data + ((size_t)i * arrays.gradient_chunk.shape[1] + part) * 3 * n;
    for (int base = 0; base < n; base += lanes) {
        const int k = base + lane < n ? base + lane : n - 1;
        const char* G = start + (k / 8) * by_block + (k % 8) * sizeof(float);
        double x = 0.0, y = 0.0, z = 0.0;
        const int last = (part + 1) * point_count / parts;
        for (int first = part * point_count / parts; first < last; first += held) {
            const int count = last - first < held ? last - first : held;
            for (int t = lane; t < 9 * count; t += lanes) here[t] = P[9 * first + t];
            SOFTMODE_WARP;
            #pragma unroll 8
            for (int p = 0; p < count; ++p) {
                const char* at = G + (size_t)(first + p) * by_point;
                const double* stress = here + 9 * p;
                const double a = *(const float*)at;
                const double b = *(const float*)(at + by_axis);
                const double c = *(const float*)(at + 2 * by_axis);
                x += stress[0] * a; x += stress[1] * b; x += stress[2] * c;
                y += stress[3] * a; y += stress[4] * b; y += stress[5] * c;
                z += stress[6] * a; z += stress[7] * b; z += stress[8] * c;
            }
            SOFTMODE_WARP;
        }
        const int end = (part + 1) * acting_count / parts;
        for (int first = part * acting_count / parts; first < end; first += held) {
            const int count = end - first < held ? end - first : held;
            for (int t = lane; t < 3 * count; t += lanes) {
                const int e = acting[first + t / 3];
                here[t] = F[3 * e + t % 3];
                here_row[t / 3] = rows[e];
            }
            SOFTMODE_WARP;
            #pragma unroll 8
            for (int s = 0; s < count; ++s) {
                const double b = values[(size_t)here_row[s] * n + k];
                x -= here[3 * s] * b;
                y -= here[3 * s + 1] * b;
                z -= here[3 * s + 2] * b;
            }
            SOFTMODE_WARP;
        }
        if (base + lane < n) {
            out[k] = x;
            out[n + k] = y;
            out[2 * n + k] = z;
        }
    }
#undef SOFTMODE_WARP
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
    """Sum V P grad b_k over the points, less b_k f over the constraints, each chunk by a part of the team."""
    ...
