"""Cholesky factorisation and solve of large systems by the whole device: a launch or two per panel of 64 rows.

The algorithm and the conventions of ``factor_kernels``, for systems that one team of threads would take a second for.
Right-looking: the rows of a panel are factored and solved (``factor_panel``), then what they take of all rows below is
subtracted, tile by tile (``subtract_panel``). An entry is reduced by the same products in the same order as there.

A block of threads of ``factor_panel`` has the diagonal square of the panel and 64 columns behind it in shared memory
and factors the square anew: that costs less than to wait for a launch that did. A tile of ``subtract_panel`` is a
product of 64 x 64 x 64 from shared memory, 8 x 4 numbers in the registers of a thread.

Compiled for a CPU the same code runs with one thread, for tests.
"""

import warp as wp

from softmode.deformables.model.newton_step_kernels import Systems

wp.set_module_options({"enable_backward": False})

PANEL = 64
"""Rows of a panel, columns and rows of a tile."""
PANEL_TEAM = 128
"""Threads of a block that factors a panel or subtracts a tile."""
SOLVE_TEAM = 64
"""Threads of a block that solves with a panel, and rows that it subtracts from."""

BEGIN = """
#if defined(__CUDA_ARCH__)
#define SOFTMODE_SHARED __shared__ __align__(16)
#define SOFTMODE_BARRIER __syncthreads()
#define SOFTMODE_THREADS(count) 1
#define SOFTMODE_RSQRT(value) rsqrtf(value)
#else
#define SOFTMODE_SHARED alignas(16) static
#define SOFTMODE_BARRIER
#define SOFTMODE_THREADS(count) count
#define SOFTMODE_RSQRT(value) (1.0f / wp::sqrt(value))
#endif
    struct alignas(16) Quad { float x, y, z, w; };
"""
END = """
#undef SOFTMODE_SHARED
#undef SOFTMODE_BARRIER
#undef SOFTMODE_THREADS
#undef SOFTMODE_RSQRT
"""
_SYSTEM = """
    constexpr int K = 64;
    const int N = systems.matrix.shape[1];
    const int W = 8 * systems.matrix.shape[2];
    float* M = (float*)systems.matrix.data + (size_t)i * N * W;
    // parts of a system: which blocks are not zero, and how many rows exist
    const int parts = systems.pattern.shape[1];
    const int part = N / parts;
    const int* pattern = (const int*)systems.pattern.data + (size_t)i * parts * parts;
    int used = N;
    if (parts > 1) {
        used = 0;
        for (int p = 0; p < parts; ++p) used += pattern[p * parts + p] != 0 ? part : 0;
    }
    const auto related = [&](int row, int column) {
        if (parts == 1 || column >= N) return true;
        const int p = row / part;
        const int q = column / part;
        return p == q || pattern[p * parts + q] != 0;
    };
    const int rows = used - first < K ? used - first : K;
    if (rows <= 0) return;
"""
_FACTOR = """
    SOFTMODE_SHARED float A[64 * 128];  // the diagonal square, then the columns of this block
    constexpr int P = 128;
    const int start = first + rows + 64 * group;
    if (group > 0 && start >= W) return;
    // all loads of a thread before its stores, so that they are under way together
    for (int base = member; base < rows * (P / 4); base += 16 * team) {
        Quad held[16];
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            const int row = (base + k * team) / (P / 4);
            const int at = 4 * ((base + k * team) % (P / 4));
            const int column = at < K ? first + at : start + at - K;
            const bool there = row < rows && (at < K ? at < rows && at >= (row & ~7) : column < W);
            held[k] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
            if (there && related(first + row, column)) held[k] = *(const Quad*)&M[(size_t)(first + row) * W + column];
        }
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            const int t = base + k * team;
            if (t < rows * (P / 4)) *(Quad*)&A[4 * t] = held[k];
        }
    }
    SOFTMODE_BARRIER;
    int bad = 0;
    #pragma unroll 1
    for (int here = 0; here < rows; here += 8) {
        for (int l = member; l < P; l += team) {
            if (l < here) continue;
            float r[8];
            #pragma unroll
            for (int a = 0; a < 8; ++a) r[a] = A[(here + a) * P + l];
            #pragma unroll 8
            for (int s = 0; s < here; ++s) {
                const Quad u = *(const Quad*)&A[s * P + here];
                const Quad v = *(const Quad*)&A[s * P + here + 4];
                const float x = A[s * P + l];
                r[0] -= u.x * x; r[1] -= u.y * x; r[2] -= u.z * x; r[3] -= u.w * x;
                r[4] -= v.x * x; r[5] -= v.y * x; r[6] -= v.z * x; r[7] -= v.w * x;
            }
            #pragma unroll
            for (int a = 0; a < 8; ++a) A[(here + a) * P + l] = r[a];
        }
        SOFTMODE_BARRIER;
        // as ``factor_system``: every thread factors its own copy of the diagonal block
        float U[8][8];
        const float* bounds = (const float*)systems.bounds.data + 2 * ((size_t)i * (N / 8) + (first + here) / 8);
        #pragma unroll
        for (int a = 0; a < 8; ++a) {
            float row[8];
            #pragma unroll
            for (int b = 0; b < 8; ++b) row[b] = b >= a ? A[(here + a) * P + here + b] : 0.0f;
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
        for (int l = member; l < P; l += team) {
            if (l < here + 8) continue;
            float x[8];
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                float value = A[(here + a) * P + l];
                #pragma unroll
                for (int s = 0; s < a; ++s) value -= U[s][a] * x[s];
                x[a] = U[a][a] * value;
                A[(here + a) * P + l] = x[a];
            }
        }
        SOFTMODE_BARRIER;
        // nobody reads the diagonal block again
        if (member == 0 && group == 0) {
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                #pragma unroll
                for (int b = 0; b < 8; ++b) A[(here + a) * P + here + b] = b >= a ? U[a][b] : 0.0f;
            }
        }
    }
    SOFTMODE_BARRIER;
    for (int t = member; t < rows * 16; t += team) {
        const int row = t / 16;
        const int column = start + 4 * (t % 16);
        if (column < W && related(first + row, column)) {
            *(Quad*)&M[(size_t)(first + row) * W + column] = *(const Quad*)&A[row * P + K + column - start];
        }
    }
    if (group != 0) return;
    // other blocks may still read the diagonal square: ``subtract_panel`` puts it into the matrix
    float* C = (float*)corner.data + (size_t)i * K * K;
    for (int t = member; t < rows * 16; t += team) {
        const int row = t / 16;
        const int at = 4 * (t % 16);
        *(Quad*)&C[row * K + at] = *(const Quad*)&A[row * P + at];
    }
    for (int t = member; t < rows * 8; t += team) {
        const int row = t / 8;
        float* diagonal = (float*)systems.diagonal.data + 8 * ((size_t)i * N + first + row);
        diagonal[t % 8] = A[row * P + (row & ~7) + t % 8];
    }
    if (member == 0 && (first == 0 || bad != 0)) systems.indefinite.data[i] = bad;
"""
_SUBTRACT = """
    SOFTMODE_SHARED float left[64 * 64];
    SOFTMODE_SHARED float right[64 * 64];
    if (tile == 0) {
        const float* C = (const float*)corner.data + (size_t)i * K * K;
        for (int t = member; t < rows * 16; t += team) {
            const int row = t / 16;
            const int at = 4 * (t % 16);
            if (at >= (row & ~7) + 8 && at < rows && related(first + row, first + at)) {
                *(Quad*)&M[(size_t)(first + row) * W + first + at] = *(const Quad*)&C[row * K + at];
            }
        }
    }
    if (rows < K) return;
    // tiles of the upper triangle, row by row
    int high = 0;
    int wide = tile;
    const int across = (W - first - 1) / 64;
    while (wide >= across - high) {
        wide -= across - high;
        ++high;
    }
    const int top = first + K + 64 * high;
    const int start = first + K + 64 * (high + wide);
    if (top >= used) return;
    float sum[SOFTMODE_THREADS(128)][8][4];
    bool mine[SOFTMODE_THREADS(128)];
    #pragma unroll
    for (int v = 0; v < SOFTMODE_THREADS(128); ++v) {
        const int t = member + v;
        const int row = top + 32 * (t / 64) + 8 * (t % 32 / 8);
        const int column = start + 32 * (t / 32 % 2) + 4 * (t % 8);
        mine[v] = row < used && column < W && column + 3 >= row && related(row, column);
        if (mine[v]) {
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                const Quad value = *(const Quad*)&M[(size_t)(row + a) * W + column];
                sum[v][a][0] = value.x; sum[v][a][1] = value.y; sum[v][a][2] = value.z; sum[v][a][3] = value.w;
            }
        }
    }
    for (int base = member; base < K * 16; base += 4 * team) {
        Quad u[4];
        Quad v[4];
        #pragma unroll
        for (int k = 0; k < 4; ++k) {
            const int row = first + (base + k * team) / 16;
            const int at = 4 * ((base + k * team) % 16);
            const float* given = &M[(size_t)row * W];
            u[k] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
            v[k] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
            if (top + at < used && related(row, top + at)) u[k] = *(const Quad*)&given[top + at];
            if (start + at < W && related(row, start + at)) v[k] = *(const Quad*)&given[start + at];
        }
        #pragma unroll
        for (int k = 0; k < 4; ++k) {
            *(Quad*)&left[4 * (base + k * team)] = u[k];
            *(Quad*)&right[4 * (base + k * team)] = v[k];
        }
    }
    SOFTMODE_BARRIER;
    #pragma unroll
    for (int v = 0; v < SOFTMODE_THREADS(128); ++v) {
        if (!mine[v]) continue;
        const int t = member + v;
        const int down = 32 * (t / 64) + 8 * (t % 32 / 8);
        const int aside = 32 * (t / 32 % 2) + 4 * (t % 8);
        #pragma unroll 8
        for (int s = 0; s < K; ++s) {
            const Quad x = *(const Quad*)&left[s * 64 + down];
            const Quad y = *(const Quad*)&left[s * 64 + down + 4];
            const Quad z = *(const Quad*)&right[s * 64 + aside];
            const float u[8] = {x.x, x.y, x.z, x.w, y.x, y.y, y.z, y.w};
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                sum[v][a][0] -= u[a] * z.x; sum[v][a][1] -= u[a] * z.y;
                sum[v][a][2] -= u[a] * z.z; sum[v][a][3] -= u[a] * z.w;
            }
        }
        #pragma unroll
        for (int a = 0; a < 8; ++a) {
            *(Quad*)&M[(size_t)(top + down + a) * W + start + aside]
                = Quad{sum[v][a][0], sum[v][a][1], sum[v][a][2], sum[v][a][3]};
        }
    }
"""
_SUBSTITUTE = """
    SOFTMODE_SHARED float A[64 * 65];
    SOFTMODE_SHARED float x[64];
    float* right = (float*)systems.right.data + (size_t)i * N;
    const float* diagonal = (const float*)systems.diagonal.data + 8 * ((size_t)i * N + first);
    for (int base = member; base < rows * 16; base += 16 * team) {
        Quad held[16];
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            const int row = (base + k * team) / 16;
            const int at = 4 * ((base + k * team) % 16);
            const int block = row & ~7;
            held[k] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
            if (row >= rows || at < block || at >= rows) continue;
            if (at < block + 8) {
                held[k] = *(const Quad*)&diagonal[8 * row + at - block];
            } else if (related(first + row, first + at)) {
                held[k] = *(const Quad*)&M[(size_t)(first + row) * W + first + at];
            }
        }
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            const int row = (base + k * team) / 16;
            if (row >= rows) continue;
            float* out = &A[row * 65 + 4 * ((base + k * team) % 16)];
            out[0] = held[k].x; out[1] = held[k].y; out[2] = held[k].z; out[3] = held[k].w;
        }
    }
    for (int t = member; t < 64; t += team) x[t] = t < rows ? right[first + t] : 0.0f;
    SOFTMODE_BARRIER;
    #pragma unroll 1
    for (int here = rows - 8; here >= 0; here -= 8) {
        float y[8];
        #pragma unroll
        for (int a = 7; a >= 0; --a) {
            float value = x[here + a];
            #pragma unroll
            for (int b = 7; b > a; --b) value -= A[(here + a) * 65 + here + b] * y[b];  // what comes last, last
            y[a] = value * A[(here + a) * 65 + here + a];
        }
        SOFTMODE_BARRIER;
        for (int row = member; row < here + 8; row += team) {
            float value = x[row];
            if (row >= here) {
                #pragma unroll
                for (int a = 0; a < 8; ++a) value = row == here + a ? y[a] : value;
            } else {
                #pragma unroll
                for (int b = 0; b < 8; ++b) value -= A[row * 65 + here + b] * y[b];
            }
            x[row] = value;
        }
        SOFTMODE_BARRIER;
    }
    if (group == 0) {
        float* out = (float*)systems.solution.data + (size_t)i * N + first;
        for (int t = member; t < rows; t += team) out[t] = x[t];
    }
    for (int t = member; t < 64; t += team) {
        const int row = 64 * group + t;
        if (row >= first) break;
        const float* given = &M[(size_t)row * W + first];
        Quad held[16];
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            held[k] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
            if (4 * k < rows && related(row, first + 4 * k)) held[k] = *(const Quad*)&given[4 * k];
        }
        float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        #pragma unroll
        for (int k = 0; k < 16; ++k) {
            const Quad u = held[k];
            const float* v = &x[4 * k];
            sum[0] += u.x * v[0]; sum[1] += u.y * v[1]; sum[2] += u.z * v[2]; sum[3] += u.w * v[3];
        }
        right[row] -= (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }
"""


@wp.func_native(snippet=BEGIN + _SYSTEM + _FACTOR + END)
def panel_factored(
    systems: Systems, corner: wp.array3d[float], first: int, i: int, group: int, member: int, team: int
) -> None:
    """Factor the diagonal square of the panel from row ``first`` on and solve 64 of the columns behind it."""
    ...


@wp.func_native(snippet=BEGIN + _SYSTEM + _SUBTRACT + END)
def panel_subtracted(
    systems: Systems, corner: wp.array3d[float], first: int, i: int, tile: int, member: int, team: int
) -> None:
    """Subtract from a tile what the panel takes of it; the first tile also puts the panel's square into the matrix."""
    ...


@wp.func_native(snippet=BEGIN + _SYSTEM + _SUBSTITUTE + END)
def panel_substituted(systems: Systems, first: int, i: int, group: int, member: int, team: int) -> None:
    """Solve the rows of a panel and subtract what they take of 64 right-hand sides above."""
    ...


@wp.kernel
def factor_panel(active: wp.array[int], first: int, team: int, corner: wp.array3d[float], systems: Systems):
    """Factor the rows from ``first`` on: their square goes to ``corner``, (system_count, 64, 64), the rest in place."""
    i, group, member = wp.tid()
    if active[systems.world[i]] != 0:
        panel_factored(systems, corner, first, i, group, member, team)


@wp.kernel
def subtract_panel(active: wp.array[int], first: int, team: int, corner: wp.array3d[float], systems: Systems):
    """Subtract U^T U of the rows from ``first`` on from everything below them, right-hand columns included."""
    i, tile, member = wp.tid()
    if active[systems.world[i]] != 0:
        panel_subtracted(systems, corner, first, i, tile, member, team)


@wp.kernel
def substitute_panel(active: wp.array[int], first: int, team: int, systems: Systems):
    """Solve U x = right for the rows from ``first`` on and take x out of the rows above."""
    i, group, member = wp.tid()
    if active[systems.world[i]] != 0:
        panel_substituted(systems, first, i, group, member, team)


@wp.kernel
def begin_substitution(
    active: wp.array[int],
    column: int,
    tail: wp.array2d[wp.float64],  # (world_count, ...): unknowns already known
    tail_count: int,
    systems: Systems,
):
    """Compute y - Y t, as ``factor_kernels.solve_system`` does."""
    i, row = wp.tid()
    world = systems.world[i]
    if active[world] == 0:
        return
    size = systems.matrix.shape[1]
    value = systems.scalars[i, row, size + column]
    for j in range(tail_count):
        value -= systems.scalars[i, row, size + j] * float(tail[world, j])
    systems.right[i, row] = value
