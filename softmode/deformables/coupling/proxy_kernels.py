"""Device side of the proxy entry: free rigid bodies as unknowns, what the contact did to them, effective masses."""

import warp as wp

from softmode.deformables.model.lane_kernels import sum8d, vec8d
from softmode.deformables.model.struct_kernels import Basis, Instances, Rigid, blocks_of

wp.set_module_options({"enable_backward": False})

IMMOVABLE = wp.constant(1.0e9)
"""Mass [kg] and moment of inertia [kg m^2] of a body without inverse mass: it moves as its twist says."""


@wp.kernel
def predict_bodies(
    # Bodies:
    body_world: wp.array[int],
    body_inv_mass: wp.array[float],
    body_mass: wp.array[float],
    body_inertia: wp.array[wp.mat33],
    body_inv_inertia: wp.array[wp.mat33],
    # State in:
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_f: wp.array[wp.spatial_vector],
    dt: wp.float64,
    # Out: inertia / dt^2, dt times the twist without contact, and where Newton starts
    rigid: Rigid,
):
    """Give every free body the twist V + dt M^-1 f and its inertia in the world's axes."""
    body = wp.tid()
    w = wp.max(body_world[body], 0)
    first = 6 * body - rigid.dof_start[w]
    mass = IMMOVABLE
    inertia = IMMOVABLE * wp.identity(n=3, dtype=float)
    linear = wp.spatial_top(body_qd[body])
    angular = wp.spatial_bottom(body_qd[body])
    start_linear = linear
    start_angular = angular
    if body_inv_mass[body] > 0.0:
        R = wp.quat_to_matrix(wp.transform_get_rotation(body_q[body]))
        mass = body_mass[body]
        inertia = R * body_inertia[body] * wp.transpose(R)
        linear = linear + float(dt) * body_inv_mass[body] * wp.spatial_top(body_f[body])
        turn = body_inv_inertia[body] * (wp.transpose(R) * wp.spatial_bottom(body_f[body]))
        angular = angular + float(dt) * (R * turn)
    for a in range(3):
        rigid.inertia[w, first + a, first + a] = wp.float64(mass) / (dt * dt)
        for b in range(3):
            rigid.inertia[w, first + 3 + a, first + 3 + b] = wp.float64(inertia[a, b]) / (dt * dt)
        rigid.predicted[w, first + a] = dt * wp.float64(linear[a])
        rigid.predicted[w, first + 3 + a] = dt * wp.float64(angular[a])
        rigid.r[w, first + a] = dt * wp.float64(start_linear[a])
        rigid.r[w, first + 3 + a] = dt * wp.float64(start_angular[a])


@wp.kernel
def move_bodies(
    body_world: wp.array[int],
    body_com: wp.array[wp.vec3],
    rigid: Rigid,
    wrench: wp.array[wp.spatial_vector],
    dt: float,
    # State in:
    body_q: wp.array[wp.transform],
    # Out:
    body_q_out: wp.array[wp.transform],
    body_qd_out: wp.array[wp.spatial_vector],
    impulse: wp.array[wp.spatial_vector],  # of the contact, gathered over substeps [N s, N m s]
):
    """Move every free body by the solved r = dt * twist about its centre of mass."""
    body = wp.tid()
    w = wp.max(body_world[body], 0)
    first = 6 * body - rigid.dof_start[w]
    r = rigid.r
    step = wp.vec3(float(r[w, first]), float(r[w, first + 1]), float(r[w, first + 2]))
    turn = wp.vec3(float(r[w, first + 3]), float(r[w, first + 4]), float(r[w, first + 5]))
    pose = body_q[body]
    rotation = wp.transform_get_rotation(pose)
    centre = wp.transform_point(pose, body_com[body]) + step
    rotation = wp.normalize(rotation + 0.5 * (wp.quat(turn, 0.0) * rotation))
    body_q_out[body] = wp.transform(centre - wp.quat_rotate(rotation, body_com[body]), rotation)
    body_qd_out[body] = wp.spatial_vector(step / dt, turn / dt)
    impulse[body] = impulse[body] + dt * wrench[body]


@wp.kernel
def harvest_wrenches(
    local_to_proxy: wp.array[int],  # (body_count,), index into the coupler's forces, -1 for no proxy
    impulse: wp.array[wp.spatial_vector],
    dt: float,
    # Out:
    body_f_out: wp.array[wp.spatial_vector],
):
    """Hand the mean contact wrench of the step to the coupler."""
    body = wp.tid()
    proxy = local_to_proxy[body]
    if proxy >= 0:
        body_f_out[proxy] = impulse[body] / dt


@wp.kernel
def sample_masses(
    instances: Instances,
    basis: Basis,
    particle: int,
    endpoint_kind: wp.array[int],
    endpoint_index: wp.array[int],
    # Out:
    mass_out: wp.array[float],
):
    """Compute 3 / tr(J M^-1 J^T) = m / |b|^2 of surface samples: the basis is mass-orthonormal, J = b^T kron I."""
    e = wp.tid()
    if endpoint_kind[e] != particle:
        return
    for i in range(instances.world.shape[0]):
        s = endpoint_index[e] - instances.particle_start[i]
        if s >= 0 and s < instances.sample_count[i]:
            total = wp.float64(0.0)
            for b in range(blocks_of(instances.function_count[i])):
                value = basis.row[instances.row_start[i] + s, b]
                total += sum8d(vec8d(wp.cw_mul(value, value)))
            mass_out[e] = float(instances.mass[i] / total)
