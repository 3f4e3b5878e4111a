"""The elastic stiffness of large bodies on CUDA, a tile of 64 x 64 functions by a block of threads.

K_cd = G^T C_cd G with the gradients G of the functions, three rows for each point, is a matrix product for each of the
six pairs of components. A block takes eight points at a time into shared memory, those of its columns multiplied by the
point's C_cd, while the next eight are on their way; a thread has 8 x 4 sums in registers. ``assembly_kernels`` has the
same sums in the same order, an 8 x 8 block for each thread, which reads everything through the cache.

Compiled for a CPU the same code runs with one thread, for tests.
"""

import warp as wp

from softmode.deformables.model.newton_step_kernels import NewtonArrays, NewtonStep
from softmode.deformables.model.struct_kernels import Basis, Instances, Points, exists
from softmode.deformables.system.panel_kernels import BEGIN, END

wp.set_module_options({"enable_backward": False})

TILE = 64
"""Functions across a tile."""
TILE_TEAM = 128
"""Threads of its block."""
TILE_BLOCKS = 1600
"""Blocks that keep a device busy, three times what fits at a time: sums over points are split into about so many."""

_TILE = """
    constexpr int POINTS = 8;
    constexpr int ROWS = 3 * POINTS;
    constexpr int THREADS = SOFTMODE_THREADS(128);
    SOFTMODE_SHARED float left[2][24 * 64];
    SOFTMODE_SHARED float right[2][24 * 64];
    const int stride = 8 * basis.row.shape[1];
    const int across = (stride + 63) / 64;
    // the squares of the component pairs 01, 02, 12, then the upper triangles of 00, 11, 22
    int c, d, high, wide;
    if (task < 3 * across * across) {
        const int pair = task / (across * across);
        c = pair == 2 ? 1 : 0;
        d = pair == 0 ? 1 : 2;
        high = task / across % across;
        wide = task % across;
    } else {
        const int triangle = across * (across + 1) / 2;
        c = (task - 3 * across * across) / triangle;
        d = c;
        wide = (task - 3 * across * across) % triangle;
        high = 0;
        while (wide >= across - high) {
            wide -= across - high;
            ++high;
        }
        wide += high;
    }
    const int pair = c * (5 - c) / 2 + d;
    const int top = 64 * high;
    const int start = 64 * wide;
    const int n = instances.function_count.data[i];
    const int chunks = arrays.stiffness.shape[1];
    const int count = instances.point_count.data[i];
    const int begin = chunk * count / chunks;
    const int end = top < n && start < n ? (chunk + 1) * count / chunks : begin;
    const size_t by_block = basis.gradient_across.strides[0];
    const size_t by_point = basis.gradient_across.strides[1];
    const size_t by_axis = basis.gradient_across.strides[2];
    const char* G = (const char*)basis.gradient_across.data + (size_t)instances.point_start.data[i] * by_point;
    const float* H = (const float*)points.hessian.data + ((size_t)i * 6 + pair) * points.hessian.shape[2] * 9;

    Quad held[THREADS][6];
    float C[THREADS][9];
    const auto load = [&](int v, int first) {
        const int t = member + v;
        const int p = first + t / 16;
        const int at = 4 * (t % 16);
        #pragma unroll
        for (int a = 0; a < 6; ++a) held[v][a] = Quad{0.0f, 0.0f, 0.0f, 0.0f};
        #pragma unroll
        for (int a = 0; a < 9; ++a) C[v][a] = 0.0f;
        if (p >= end) return;
        const char* given = G + (size_t)p * by_point + (at % 8) * sizeof(float);
        #pragma unroll
        for (int a = 0; a < 3; ++a) {
            if (top + at < stride) held[v][a] = *(const Quad*)(given + (top + at) / 8 * by_block + a * by_axis);
            if (start + at < stride) held[v][3 + a] = *(const Quad*)(given + (start + at) / 8 * by_block + a * by_axis);
        }
        #pragma unroll
        for (int a = 0; a < 9; ++a) C[v][a] = H[(size_t)p * 9 + a];
    };
    const auto store = [&](int v, int buffer) {
        const int t = member + v;
        const int at = 4 * (t % 16);
        #pragma unroll
        for (int a = 0; a < 3; ++a) {
            const int row = 3 * (t / 16) + a;
            *(Quad*)&left[buffer][row * 64 + at] = held[v][a];
            const float* m = &C[v][3 * a];
            const Quad x = held[v][3], y = held[v][4], z = held[v][5];
            *(Quad*)&right[buffer][row * 64 + at] = Quad{
                m[0] * x.x + m[1] * y.x + m[2] * z.x, m[0] * x.y + m[1] * y.y + m[2] * z.y,
                m[0] * x.z + m[1] * y.z + m[2] * z.z, m[0] * x.w + m[1] * y.w + m[2] * z.w
            };
        }
    };
    float sum[THREADS][8][4];
    bool mine[THREADS];
    #pragma unroll
    for (int v = 0; v < THREADS; ++v) {
        const int t = member + v;
        const int row = top + 32 * (t / 64) + 8 * (t % 32 / 8);
        const int column = start + 32 * (t / 32 % 2) + 4 * (t % 8);
        mine[v] = row < stride && column < stride && (c != d || column + 3 >= row);
        #pragma unroll
        for (int a = 0; a < 8; ++a) {
            #pragma unroll
            for (int b = 0; b < 4; ++b) sum[v][a][b] = 0.0f;
        }
        load(v, begin);
        store(v, 0);
    }
    SOFTMODE_BARRIER;
    int buffer = 0;
    #pragma unroll 1
    for (int first = begin; first < end; first += POINTS) {
        const bool more = first + POINTS < end;
        #pragma unroll
        for (int v = 0; v < THREADS; ++v) {
            if (more) load(v, first + POINTS);
            if (mine[v]) {
                const int t = member + v;
                const float* l = &left[buffer][32 * (t / 64) + 8 * (t % 32 / 8)];
                const float* r = &right[buffer][32 * (t / 32 % 2) + 4 * (t % 8)];
                #pragma unroll 8
                for (int s = 0; s < ROWS; ++s) {
                    const Quad x = *(const Quad*)&l[s * 64];
                    const Quad y = *(const Quad*)&l[s * 64 + 4];
                    const Quad z = *(const Quad*)&r[s * 64];
                    const float u[8] = {x.x, x.y, x.z, x.w, y.x, y.y, y.z, y.w};
                    #pragma unroll
                    for (int a = 0; a < 8; ++a) {
                        sum[v][a][0] += u[a] * z.x; sum[v][a][1] += u[a] * z.y;
                        sum[v][a][2] += u[a] * z.z; sum[v][a][3] += u[a] * z.w;
                    }
                }
            }
            if (more) store(v, 1 - buffer);
        }
        SOFTMODE_BARRIER;
        buffer = 1 - buffer;
    }
    const int N = 3 * stride;
    float* out = (float*)arrays.stiffness.data + ((size_t)i * chunks + chunk) * N * N;
    #pragma unroll
    for (int v = 0; v < THREADS; ++v) {
        if (!mine[v]) continue;
        const int t = member + v;
        const int row = c * stride + top + 32 * (t / 64) + 8 * (t % 32 / 8);
        const int column = d * stride + start + 32 * (t / 32 % 2) + 4 * (t % 8);
        #pragma unroll
        for (int a = 0; a < 8; ++a) {
            *(Quad*)&out[(size_t)(row + a) * N + column] = Quad{sum[v][a][0], sum[v][a][1], sum[v][a][2], sum[v][a][3]};
        }
    }
"""


def tile_count(stride: int) -> int:
    """Return how many tiles the upper triangle takes of a body with so many functions, padding included."""
    across = -(-stride // TILE)
    return 3 * across * across + 3 * across * (across + 1) // 2


def chunk_count(instance_count: int, stride: int) -> int:
    """Return into how many parts the sums over points are split."""
    return max(min(round(TILE_BLOCKS / (instance_count * tile_count(stride))), 16), 1)


@wp.func_native(snippet=BEGIN + _TILE + END)
def stiffness_tile(
    instances: Instances,
    basis: Basis,
    points: Points,
    arrays: NewtonArrays,
    i: int,
    chunk: int,
    task: int,
    member: int,
    team: int,
) -> None:
    """Assemble a tile of sum_p grad b^T C grad b over one chunk of the points; ``team`` is the block, on CPU one."""
    ...


@wp.kernel(launch_bounds=(TILE_TEAM, 4))
def assemble_tiles(step: NewtonStep, team: int):
    """Assemble the elastic stiffness of the bodies whose Hessian is new."""
    i, chunk, task, member = wp.tid()
    w = step.instances.world[i]
    if step.state.active[w] == 0 or step.state.refresh[w] == 0 or not exists(step.instances, i):
        return
    stiffness_tile(step.instances, step.basis, step.points, step.arrays, i, chunk, task, member, team)
