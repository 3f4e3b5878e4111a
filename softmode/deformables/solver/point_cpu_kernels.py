"""Device side of the cubature points on CPU: eight points of an instance at a time, one in each lane.

The functions of a row are in lanes in memory. Their sums for eight points are transposed as they are added up, so that
from the deformation gradient on a lane is a point; results are written point by point, where the per-point kernels of
CUDA have theirs. The last eight are fewer where the count is no multiple of eight: the idle lanes repeat the last point.
"""

import warp as wp

from softmode.deformables.materials.material_cpu_kernels import (
    HessianLanes,
    PointLanes,
    energy_and_stress,
    hessian_lanes,
    mat98d,
)
from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d
from softmode.deformables.model.struct_kernels import Instances, Points
from softmode.deformables.solver.iteration_kernels import ALL, ENERGIES, NewtonStep

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    snippet="""{
    #pragma clang fp contract(fast)
    typedef float floats __attribute__((ext_vector_type(8)));
    typedef double lanes __attribute__((ext_vector_type(8)));
    const size_t by_block = gradient.strides[0], by_point = gradient.strides[1], by_axis = gradient.strides[2];
    const int stride = q.shape[1] / 3;
    const int blocks = (function_count + 7) / 8;
    const lanes* Q = (const lanes*)((const char*)q.data + (size_t)i * q.strides[0]);
    const char* first = (const char*)gradient.data + (size_t)point * by_point;
    lanes G[9];
    for (int c = 0; c < 3; ++c) {
        lanes sum[3][8] = {};
        for (int b = 0; b < blocks; ++b) {
            lanes x[3];
            for (int axis = 0; axis < 3; ++axis) __builtin_memcpy(x + axis, Q + axis * stride + b, sizeof(lanes));
            const char* at = first + b * by_block + c * by_axis;
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                floats g;
                __builtin_memcpy(&g, at + (k < count ? k : count - 1) * by_point, sizeof(g));
                const lanes wide = __builtin_convertvector(g, lanes);
                for (int axis = 0; axis < 3; ++axis) sum[axis][k] += x[axis] * wide;
            }
        }
        for (int axis = 0; axis < 3; ++axis) {
            lanes four[4], two[2];
            for (int k = 0; k < 4; ++k) {
                const lanes a = sum[axis][2 * k], b = sum[axis][2 * k + 1];
                four[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11)
                    + __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
            }
            for (int k = 0; k < 2; ++k) {
                const lanes a = four[2 * k], b = four[2 * k + 1];
                two[k] = __builtin_shufflevector(a, b, 0, 1, 4, 5, 8, 9, 12, 13)
                    + __builtin_shufflevector(a, b, 2, 3, 6, 7, 10, 11, 14, 15);
            }
            G[3 * axis + c] = __builtin_shufflevector(two[0], two[1], 0, 2, 4, 6, 8, 10, 12, 14)
                + __builtin_shufflevector(two[0], two[1], 1, 3, 5, 7, 9, 11, 13, 15);
        }
    }
    if (scale != 1.0)
        for (int k = 0; k < 9; ++k) G[k] = 1.0 / scale * (k % 4 == 0 ? G[k] - (scale - 1.0) : G[k]);
    wp::mat_t<9, 8, wp::float64> out;
    __builtin_memcpy(&out, G, sizeof(out));
    return out;
}"""
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
    snippet="""
    const double* in = (const double*)values.data + 9 * ((size_t)i * values.shape[1] + p);
    wp::mat_t<9, 8, wp::float64> out;
    for (int lane = 0; lane < 8; ++lane)
        for (int k = 0; k < 9; ++k) out.data[k][lane] = in[9 * (lane < count ? lane : count - 1) + k];
    return out;
"""
)
def load_matrices(values: wp.array2d[wp.mat33d], i: int, p: int, count: int) -> mat98d:  # pyright: ignore[reportReturnType]
    """Return ``count`` matrices of an instance from point ``p`` on."""
    ...


@wp.func_native(
    snippet="""
    double* out = (double*)values.data + 9 * ((size_t)i * values.shape[1] + p);
    for (int lane = 0; lane < count; ++lane)
        for (int k = 0; k < 9; ++k) out[9 * lane + k] = found.data[k][lane];
"""
)
def store_matrices(values: wp.array2d[wp.mat33d], i: int, p: int, count: int, found: mat98d) -> None:
    """Write ``count`` matrices of an instance from point ``p`` on."""


@wp.func_native(
    snippet="""
    const float* in = (const float*)values.data + first;
    wp::vec_t<8, wp::float32> out;
    for (int lane = 0; lane < 8; ++lane) out.c[lane] = in[lane < count ? lane : count - 1];
    return out;
"""
)
def load_scales(values: wp.array[float], first: int, count: int) -> vec8:  # pyright: ignore[reportReturnType]
    """Return ``count`` numbers from ``first`` on."""
    ...


@wp.func_native(
    snippet="""
    const size_t at = (size_t)i * points.energy.shape[1] + p;
    const double* weights = (const double*)point_weight.data + point;
    double* energy = (double*)points.energy.data + at;
    double* stress = (double*)points.stress.data + 9 * at;
    float* ratio = (float*)points.volume_ratio.data + at;
    for (int lane = 0; lane < count; ++lane) {
        const double weight = scale * weights[lane];
        energy[lane] = scale * scale * weight * found.data[0][lane];
        if (!forces) continue;
        for (int k = 0; k < 9; ++k) stress[9 * lane + k] = scale * weight * found.data[1 + k][lane];
        ratio[lane] = (float)found.data[10][lane];
    }
"""
)
def store_points(
    points: Points,
    point_weight: wp.array[wp.float64],
    scale: wp.float64,
    i: int,
    p: int,
    point: int,
    count: int,
    found: PointLanes,
    forces: int,
) -> None:
    """Write V Psi and, where asked, V P and J of ``count`` points of an instance from ``p`` on."""


@wp.func_native(
    snippet="""
    const double* weights = (const double*)point_weight.data + point;
    for (int pair = 0; pair < 6; ++pair) {
        float* out = (float*)points.hessian.data;
        out += 9 * (((size_t)i * 6 + pair) * points.hessian.shape[2] + p);
        for (int lane = 0; lane < count; ++lane) {
            const float weight = (float)(scale * weights[lane]);
            for (int k = 0; k < 9; ++k) out[9 * lane + k] = weight * found.data[9 * pair + k][lane];
        }
    }
"""
)
def store_hessians(
    points: Points,
    point_weight: wp.array[wp.float64],
    scale: wp.float64,
    i: int,
    p: int,
    point: int,
    count: int,
    found: HessianLanes,
) -> None:
    """Write V d2Psi/dF2 of ``count`` points of an instance from ``p`` on."""


@wp.func
def lame_lanes(instances: Instances, stiffness_scale: wp.array[float], i: int, point: int, count: int):
    """Return Lame's parameters (mu, lambda) [Pa] at eight points; see ``material_kernels.lame``."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    e = vec8d(instances.youngs_modulus[i] * load_scales(stiffness_scale, point, count))
    nu = wp.float64(instances.poissons_ratio[i])
    return e / (two * (one + nu)), e * nu / ((one + nu) * (one - two * nu))


@wp.func
def evaluate_eight(
    step: NewtonStep,
    # State in:
    selected: wp.array[int],  # (world_count,)
    q: wp.array2d[vec8d],
    derivatives: int,
    i: int,
    eight: int,
):
    """Evaluate V_p Psi(F_p) and, where asked, V_p P and J at eight points; see ``step_kernels.evaluate_point``.

    The Hessian is left to :func:`differentiate_eight`.
    """
    w = step.instances.world[i]
    p = LANES * eight
    if selected[w] == 0 or p >= step.instances.point_count[i]:
        return
    if derivatives == ALL and step.state.evaluated[w] != 0:
        return
    count = wp.min(LANES, step.instances.point_count[i] - p)
    point = step.instances.point_start[i] + p
    s = wp.float64(step.instances.scale[i])
    rate = wp.float64(step.instances.viscosity[i]) / step.options.dt
    mu, lam = lame_lanes(step.instances, step.basis.stiffness_scale, i, point, count)
    G = elastic_gradients(step.basis.gradient, q, i, point, count, step.instances.function_count[i], s)
    start = G
    if step.instances.viscosity[i] > 0.0:
        start = load_matrices(step.points.start, i, p, count)
    found = energy_and_stress(step.instances.material_model[i], mu, lam, rate, G, start)
    forces = wp.where(derivatives != ENERGIES, 1, 0)
    store_points(step.points, step.basis.point_weight, s, i, p, point, count, found, forces)


@wp.func
def differentiate_eight(step: NewtonStep, i: int, eight: int):
    """Evaluate V_p d2Psi/dF2 at eight points of the iterate, in worlds that are about to assemble it."""
    w = step.instances.world[i]
    p = LANES * eight
    if step.state.active[w] == 0 or step.state.refresh[w] == 0 or p >= step.instances.point_count[i]:
        return
    count = wp.min(LANES, step.instances.point_count[i] - p)
    point = step.instances.point_start[i] + p
    s = wp.float64(step.instances.scale[i])
    rate = wp.float64(step.instances.viscosity[i]) / step.options.dt
    mu, lam = lame_lanes(step.instances, step.basis.stiffness_scale, i, point, count)
    G = elastic_gradients(step.basis.gradient, step.arrays.q, i, point, count, step.instances.function_count[i], s)
    start = G
    if step.instances.viscosity[i] > 0.0:
        start = load_matrices(step.points.start, i, p, count)
    found = hessian_lanes(step.instances.material_model[i], mu, lam, rate, G, start, step.state.project[w])
    store_hessians(step.points, step.basis.point_weight, s, i, p, point, count, found)


@wp.func
def start_eight(step: NewtonStep, i: int, eight: int):
    """Evaluate the deformation of eight points at the start of the step; see ``step_kernels.start_points``."""
    p = LANES * eight
    if p >= step.instances.point_count[i] or step.instances.viscosity[i] <= 0.0:
        return
    count = wp.min(LANES, step.instances.point_count[i] - p)
    point = step.instances.point_start[i] + p
    s = wp.float64(step.instances.scale[i])
    functions = step.instances.function_count[i]
    G = elastic_gradients(step.basis.gradient, step.motion.q_start, i, point, count, functions, s)
    store_matrices(step.points.start, i, p, count, G)


evaluate_eights = kernel_over(evaluate_eight, "evaluate_eights", "i", "eight")
differentiate_eights = kernel_over(differentiate_eight, "differentiate_eights", "i", "eight")
start_eights = kernel_over(start_eight, "start_eights", "i", "eight")
