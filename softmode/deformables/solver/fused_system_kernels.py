"""Assembly, Cholesky factorisation and solve of one small system by a block of CUDA threads, in shared memory.

The algorithms of ``assembly_kernels`` and ``factor``, for a kernel in which a block takes a world through everything:
there every number that another thread has written is a round trip to L2, and the threads of one world are too few to
hide it. The system stays in shared memory from its assembly to its solution; loops keep several loads in flight.
"""

import warp as wp

from softmode.deformables.model.struct_kernels import Basis, Instances, PointConstraints, Points, Rigid
from softmode.deformables.solver.iteration_kernels import NewtonArrays

SHARED_SIZE = 72
"""Most unknowns of a system in shared memory, and"""
SHARED_WIDTH = 88
"""most columns, the right-hand ones included: static shared memory ends at 48 kB."""


def _sized(snippet: str) -> str:
    """Return CUDA source with the sizes of the shared system in the places of their names."""
    return snippet.replace("SHARED_SIZE", str(SHARED_SIZE)).replace("SHARED_WIDTH", str(SHARED_WIDTH))


@wp.func_native(
    snippet=_sized("""
#if defined(__CUDA_ARCH__)
    // mode 0: assemble A, load B, factor, write U^-T B back; mode 1: solve with the factor that is there
    __shared__ __align__(16) float A[SHARED_SIZE * SHARED_WIDTH];
    __shared__ __align__(16) float D[SHARED_SIZE * 8];
    __shared__ float right[SHARED_SIZE];
    const int stride = SHARED_WIDTH;
    const int N = arrays.systems.scalars.shape[1];
    const int W = arrays.systems.scalars.shape[2];
    float* g = (float*)arrays.systems.scalars.data + (size_t)i * N * W;
    if (mode == 0) {
        const int chunks = arrays.stiffness.shape[1];
        const float* K = (const float*)arrays.stiffness.data + (size_t)i * chunks * N * N;
        const int quads = N / 4;
        #pragma unroll 4
        for (int t = member; t < N * quads; t += team) {
            const int row = t / quads;
            const int first = 4 * (t - row * quads);
            if (first >= (row & ~7)) {
                float4 value = *(const float4*)&K[row * N + first];
                for (int chunk = 1; chunk < chunks; ++chunk) {
                    const float4 more = *(const float4*)&K[(size_t)chunk * N * N + row * N + first];
                    value.x += more.x; value.y += more.y; value.z += more.z; value.w += more.w;
                }
                const int at = row - first;
                if (at == 0) value.x += inertia;
                if (at == 1) value.y += inertia;
                if (at == 2) value.z += inertia;
                if (at == 3) value.w += inertia;
                *(float4*)&A[row * stride + first] = value;
            }
        }
        #pragma unroll 4
        for (int t = member; t < N * (W - N); t += team) {
            const int row = t / (W - N);
            const int at = N + t - row * (W - N);
            A[row * stride + at] = g[row * W + at];
        }
        __syncthreads();
        const int blocks = N / 24;
        const int acting_count = constraints.acting_count.data[i];
        const int* acting = (const int*)constraints.acting.data + (size_t)i * constraints.acting.shape[1];
        const int* rows = (const int*)constraints.row.data + (size_t)i * constraints.row.shape[1];
        const int room = constraints.hessian.shape[1];
        const float* H = (const float*)constraints.hessian.data + (size_t)i * room * 9;
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
                const float4 u = *(const float4*)&r[4 * k];
                const float4 v = *(const float4*)&r[8 * m];
                const float4 w = *(const float4*)&r[8 * m + 4];
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
                    A[(c * 8 * blocks + 4 * k + a) * stride + d * 8 * blocks + 8 * m + b] += sum[a][b];
                }
            }
        }
        __syncthreads();
        int bad = 0;
        for (int first = 0; first < N; first += 8) {
            for (int l = first + member; l < W; l += team) {
                float r[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) r[a] = A[(first + a) * stride + l];
                #pragma unroll 8
                for (int s = 0; s < first; ++s) {
                    const float4 u = *(const float4*)&A[s * stride + first];
                    const float4 v = *(const float4*)&A[s * stride + first + 4];
                    const float x = A[s * stride + l];
                    r[0] -= u.x * x; r[1] -= u.y * x; r[2] -= u.z * x; r[3] -= u.w * x;
                    r[4] -= v.x * x; r[5] -= v.y * x; r[6] -= v.z * x; r[7] -= v.w * x;
                }
                #pragma unroll
                for (int a = 0; a < 8; ++a) A[(first + a) * stride + l] = r[a];
            }
            __syncthreads();
            // every thread factors its own copy of the diagonal block (inverse pivots): cheaper than waiting for one
            float U[8][8];
            #pragma unroll
            for (int a = 0; a < 8; ++a) {
                float row[8];
                #pragma unroll
                for (int b = 0; b < 8; ++b) row[b] = b >= a ? A[(first + a) * stride + first + b] : 0.0f;
                const float floor = fmaxf(1.0e-6f * fabsf(row[a]), 1.0e-30f);
                #pragma unroll
                for (int s = 0; s < a; ++s) {
                    #pragma unroll
                    for (int b = a; b < 8; ++b) row[b] -= U[s][a] * U[s][b];
                }
                if (row[a] < floor) bad = 1;
                const float inverse = 1.0f / sqrtf(fmaxf(row[a], floor));
                #pragma unroll
                for (int b = a; b < 8; ++b) U[a][b] = inverse * row[b];
                U[a][a] = inverse;
            }
            if (member == 0) {
                #pragma unroll
                for (int a = 0; a < 8; ++a) {
                    #pragma unroll
                    for (int b = a; b < 8; ++b) D[(first + a) * 8 + b] = U[a][b];
                }
            }
            for (int l = first + 8 + member; l < W; l += team) {
                float x[8];
                #pragma unroll
                for (int a = 0; a < 8; ++a) {
                    float value = A[(first + a) * stride + l];
                    #pragma unroll
                    for (int s = 0; s < a; ++s) value -= U[s][a] * x[s];
                    x[a] = U[a][a] * value;
                    A[(first + a) * stride + l] = x[a];
                    if (l >= N) g[(first + a) * W + l] = x[a];
                }
            }
            __syncthreads();
        }
        if (member == 0) arrays.systems.indefinite.data[i] = bad;
        return;
    }
    const int tail_count = rigid.count.data[world];
    const double* t = (const double*)rigid.direction.data + (size_t)world * rigid.direction.shape[1];
    for (int row = member; row < N; row += team) {
        float value = A[row * stride + N + rigid_max];
        for (int j = 0; j < tail_count; ++j) value -= A[row * stride + N + j] * (float)t[j];
        right[row] = value;
    }
    __syncthreads();
    float* out = (float*)arrays.direction.data + (size_t)i * N;
    for (int first = N - 8; first >= 0; first -= 8) {
        float x[8];
        #pragma unroll
        for (int a = 7; a >= 0; --a) {
            float value = right[first + a];
            #pragma unroll
            for (int b = a + 1; b < 8; ++b) value -= D[(first + a) * 8 + b] * x[b];
            x[a] = value * D[(first + a) * 8 + a];
        }
        if (member == 0) {
            #pragma unroll
            for (int a = 0; a < 8; ++a) out[first + a] = x[a];
        }
        for (int row = member; row < first; row += team) {
            float value = right[row];
            #pragma unroll
            for (int b = 0; b < 8; ++b) value -= A[row * stride + first + b] * x[b];
            right[row] = value;
        }
        __syncthreads();
    }
#endif
""")
)
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
    """Assemble and factor system ``i`` (mode 0), later solve it (mode 1). CUDA only, one body per world, no pins."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const int blocks = basis.row.shape[1];
    const int n = 8 * blocks;
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
        // points in memory one after another, three rows of n functions each
        const float* G = (const float*)basis.gradient_across.data + (size_t)first_point * 3 * n + k;
        double value = 0.0;
        #pragma unroll 8
        for (int p = 0; p < point_count; ++p) {
            value += P[9 * p + 3 * axis] * (double)G[3 * n * p];
            value += P[9 * p + 3 * axis + 1] * (double)G[3 * n * p + n];
            value += P[9 * p + 3 * axis + 2] * (double)G[3 * n * p + 2 * n];
        }
        #pragma unroll 8
        for (int s = 0; s < acting_count; ++s) {
            const int e = acting[s];
            value -= F[3 * e + axis] * (double)values[(size_t)rows[e] * n + k];
        }
        out[t] = value;
    }
#endif
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
    """Sum V P grad b_k over the points, less b_k f over the constraints, a thread per unknown. CUDA only."""
    ...
