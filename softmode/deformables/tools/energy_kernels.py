"""Device side of the energies of soft bodies: one thread per instance and energy, sums in a fixed order, in float64."""

import warp as wp

from softmode.deformables.materials.material_kernels import energy
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.model.struct_kernels import Basis, Instances
from softmode.deformables.potential.evaluate_kernels import material_of

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_kinetic_and_gravitational(
    instances: Instances,
    basis: Basis,
    gravity: wp.array[wp.vec3],  # (world_count,) [m/s^2]
    # State in:
    q: wp.array[wp.vec3d],  # (function_total,) [m]
    qd: wp.array[wp.vec3d],  # (function_total,) [m/s]
    # Out:
    kinetic_out: wp.array[wp.float64],  # (instance_count,) [J]
    gravitational_out: wp.array[wp.float64],  # (instance_count,) [J]
):
    """T = m/2 sum_k |dq_k/dt|^2, as the functions are orthonormal, and U = -m g.c, c = sum_k mean(b_k) q_k."""
    i = wp.tid()
    first = instances.function_start[i]
    moved = wp.float64(0.0)
    center = wp.vec3d()
    for k in range(instances.function_count[i]):
        moved += wp.dot(qd[first + k], qd[first + k])
        center += basis.mean[instances.asset[i], k / LANES][k % LANES] * q[first + k]
    g = wp.vec3d(gravity[wp.max(instances.world[i], 0)])
    kinetic_out[i] = wp.float64(0.5) * instances.mass[i] * moved
    gravitational_out[i] = -instances.mass[i] * wp.dot(g, center)


@wp.kernel
def sum_elastic(
    instances: Instances,
    basis: Basis,
    # State in:
    q: wp.array[wp.vec3d],  # (function_total,) [m]
    # Out:
    elastic_out: wp.array[wp.float64],  # (instance_count,) [J]
):
    """U = s^3 sum_p V_p Psi(F_p / s) over the cubature points, without the dissipation of a step."""
    i = wp.tid()
    first = instances.function_start[i]
    s = wp.float64(instances.scale[i])
    total = wp.float64(0.0)
    for p in range(instances.point_count[i]):
        point = instances.point_start[i] + p
        G = wp.mat33d()
        for k in range(instances.function_count[i]):
            b = k / LANES
            lane = k % LANES
            gradient = wp.vec3d(
                wp.float64(basis.gradient[b, point, 0][lane]),
                wp.float64(basis.gradient[b, point, 1][lane]),
                wp.float64(basis.gradient[b, point, 2][lane]),
            )
            G += wp.outer(q[first + k], gradient)
        excess = s - wp.float64(1.0)
        G = wp.float64(1.0) / s * (G - wp.diag(wp.vec3d(excess, excess, excess)))
        material = material_of(instances, basis, i, point)
        material.viscosity = wp.float64(0.0)
        total += basis.point_weight[point] * energy(material, G, G, wp.float64(1.0))
    elastic_out[i] = s * s * s * total
