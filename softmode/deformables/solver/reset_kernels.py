"""Device side of a reset: bodies at rest where they are put, and worlds as they begin."""

import warp as wp

from softmode.deformables.model.lane_kernels import (
    LANES,
)
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    in_mask,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def scaled_about_centre(basis: Basis, a: int, k: int, x: wp.vec3d, centre: wp.vec3d, ratio: wp.float64, rest: int):
    """Return coordinate k of centre + ratio (x - centre), of a field with coordinates x and mean ``centre``.

    ``rest`` says whether the field is a placement, which the rest position X is added to, or a velocity.
    """
    c = basis.linear[a, k]
    shift = -c[3] * centre
    if rest != 0:
        shift += wp.vec3d(c[0], c[1], c[2])
    return ratio * x + (ratio - wp.float64(1.0)) * shift


@wp.func
def mean_of_functions(basis: Basis, a: int, q: wp.array[wp.vec3d], first: int, count: int):
    """Return the mean over the mass of a field with coordinates q: of a placement, the centre of mass."""
    total = wp.vec3d()
    for k in range(count):
        total += basis.mean[a, k / LANES][k % LANES] * q[first + k]
    return total


@wp.kernel
def reset_functions(
    instances: Instances,
    basis: Basis,
    placed_scale: wp.array[float],  # (instance_count,), of the initial coordinates
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    positions: int,
    velocities: int,
    q_in: wp.array[wp.vec3d],
    qd_in: wp.array[wp.vec3d],
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
    dt_before_out: wp.array[wp.float64],
):
    """Copy the initial coordinates of the bodies in masked worlds and forget the step before.

    A body that has another scale than it was placed with is scaled about its centre of mass, and its motion with it.
    """
    i, k = wp.tid()
    if k >= instances.function_count[i] or not in_mask(instance_world[i], world_mask):
        return
    first = instances.function_start[i]
    f = first + k
    a = instances.asset[i]
    ratio = wp.float64(instances.scale[i]) / wp.float64(placed_scale[i])
    other = ratio != wp.float64(1.0)
    if positions != 0:
        x = q_in[f]
        if other:
            centre = mean_of_functions(basis, a, q_in, first, instances.function_count[i])
            x = scaled_about_centre(basis, a, k, x, centre, ratio, 1)
        q_out[f] = x
    if velocities != 0:
        v = qd_in[f]
        if other:
            centre = mean_of_functions(basis, a, qd_in, first, instances.function_count[i])
            v = scaled_about_centre(basis, a, k, v, centre, ratio, 0)
        qd_out[f] = v
    dt_before_out[i] = wp.float64(0.0)


@wp.kernel
def reset_worlds(
    instances: Instances,
    instance_world: wp.array[int],
    body_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # Out:
    status_out: wp.array[int],
    instance_force_out: wp.array[wp.vec3d],
    body_wrench_out: wp.array[wp.spatial_vector],
    count_out: wp.array[int],
    pair_count_out: wp.array[int],
    cached_out: wp.array[int],
):
    """Clear what the masked worlds report: status, constraints, contact force on bodies, wrench on rigid bodies."""
    i = wp.tid()
    if i < instance_world.shape[0] and in_mask(instance_world[i], world_mask):
        status_out[instances.world[i]] = 0
        instance_force_out[i] = wp.vec3d()
        count_out[i] = 0
        pair_count_out[i] = 0
        cached_out[instances.world[i]] = 0
    if i < body_world.shape[0] and in_mask(body_world[i], world_mask):
        body_wrench_out[i] = wp.spatial_vector()
