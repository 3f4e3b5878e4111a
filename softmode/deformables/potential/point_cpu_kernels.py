"""Device side of cubature points and samples on CPU: eight of an instance at a time, one in each lane.

Results are written point by point, where the per-point kernels of CUDA have theirs. The last eight are fewer where the
count is no multiple of eight: the idle lanes repeat the last point.
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
from softmode.deformables.model.interpolation_cpu_kernels import elastic_gradients, interpolate_state
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d
from softmode.deformables.model.newton_step_kernels import ALL, ENERGIES, NewtonStep
from softmode.deformables.model.struct_kernels import Basis, Instances, Points

wp.set_module_options({"enable_backward": False})


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
def lame_lanes(instances: Instances, basis: Basis, i: int, point: int, count: int):
    """Return Lame's parameters (mu, lambda) [Pa] at eight points; see ``material_kernels.lame``."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    e = vec8d(instances.youngs_modulus[i] * load_scales(basis.stiffness_scale, point, count))
    ratio = vec8d(load_scales(basis.lame_ratio, point, count))
    nu = wp.float64(instances.poissons_ratio[i])
    return e / (two * (one + nu)), wp.cw_mul(ratio, e * nu / ((one + nu) * (one - two * nu)))


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
    """Evaluate V_p Psi(F_p) and, where asked, V_p P and J at eight points; see ``evaluate_kernels.evaluate_point``.

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
    mu, lam = lame_lanes(step.instances, step.basis, i, point, count)
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
    mu, lam = lame_lanes(step.instances, step.basis, i, point, count)
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


@wp.kernel
def skin_eights(
    instances: Instances,
    basis: Basis,
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    dent: wp.array[wp.vec3],
    # Out:
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
):
    """Write positions and velocities of eight samples as Newton particles; see ``step_kernels.skin_samples``."""
    i, eight = wp.tid()
    s = LANES * eight
    if s >= instances.sample_count[i]:
        return
    count = wp.min(LANES, instances.sample_count[i] - s)
    row = instances.row_start[i] + s
    begin = instances.function_start[i]
    found = interpolate_state(basis.row, row, count, q, qd, begin, instances.function_count[i])
    first = instances.particle_start[i] + s
    for k in range(count):
        x = basis.row_point[row + k] + wp.vec3d(found[0, k], found[1, k], found[2, k])
        particle_q_out[first + k] = wp.vec3(x + wp.vec3d(dent[first + k]))
        particle_qd_out[first + k] = wp.vec3(wp.vec3d(found[3, k], found[4, k], found[5, k]))
