"""Device side of the reduced step: state in and out, elastic energy, stress and Hessian, the gradient.

One *instance* is one body in one world. The incremental potential of a world is, over its instances,

    sum_i [ m/(2 dt^2) |q - q_n - dt v_n|^2 + m alpha/(2 dt) |q - q_n|^2
            + sum_p V_p Psi(F_p) - f . q + contacts and pins ]
    + 1/2 (r - r_predicted)^T M_eff/dt^2 (r - r_predicted)

with r = dt * joint velocity of the rigid dofs that take part (see ``coupling``). The basis is mass-orthonormal, so the
mass matrix of a body is its mass times the identity. Unknowns of one instance are ordered component-major,
row = c * stride + k, with the function count padded to ``stride``, a multiple of 8.

Precision: basis data float32; q, energy and residual float64; the Newton direction float32.
"""

import warp as wp

from softmode.deformables.materials import MaterialParameters, energy, hessian, lame, stress
from softmode.deformables.status import WORLD_NOT_FINITE

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_step(
    # Instances:
    function_start: wp.array[int],
    function_count: wp.array[int],
    asset: wp.array[int],
    world: wp.array[int],
    mass: wp.array[wp.float64],  # (instance_count,) [kg]
    row_start: wp.array[int],
    sample_count: wp.array[int],
    particle_start: wp.array[int],
    # Assets:
    mean_basis: wp.array2d[wp.float64],  # (asset_count, stride)
    row_basis: wp.array2d[float],  # (row_count, stride)
    # Model and state in:
    gravity: wp.array[wp.vec3],  # (world_count,) [m/s^2]
    q_in: wp.array[wp.vec3d],  # (function_total,) [m]
    qd_in: wp.array[wp.vec3d],  # (function_total,) [m/s]
    particle_f: wp.array[wp.vec3],  # (particle_count,) [N]
    dt: wp.float64,
    # Out:
    q_start_out: wp.array2d[wp.vec3d],  # (instance_count, stride)
    q_inertial_out: wp.array2d[wp.vec3d],
    q_out: wp.array2d[wp.vec3d],
    force_out: wp.array2d[wp.vec3d],
):
    """Read the state, predict q + dt v and gather gravity and external point forces as generalised forces."""
    i, k = wp.tid()
    if k >= function_count[i]:
        return
    q = q_in[function_start[i] + k]
    qd = qd_in[function_start[i] + k]
    force = mass[i] * mean_basis[asset[i], k] * wp.vec3d(gravity[wp.max(world[i], 0)])
    if particle_f.shape[0] > 0:
        for s in range(sample_count[i]):
            force += wp.float64(row_basis[row_start[i] + s, k]) * wp.vec3d(particle_f[particle_start[i] + s])
    q_start_out[i, k] = q
    q_inertial_out[i, k] = q + dt * qd
    q_out[i, k] = q + dt * qd
    force_out[i, k] = force


@wp.func
def displacement_gradient(
    grad_basis: wp.array2d[wp.vec3], q: wp.array2d[wp.vec3d], instance: int, point: int, function_count: int
):
    """Return G = F - I = sum_k q_k (grad b_k)^T."""
    G = wp.mat33d()
    for k in range(function_count):
        G += wp.outer(q[instance, k], wp.vec3d(grad_basis[point, k]))
    return G


@wp.kernel
def evaluate_points(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    point_start: wp.array[int],
    point_count: wp.array[int],
    material_model: wp.array[int],
    youngs_modulus: wp.array[float],  # [Pa]
    poissons_ratio: wp.array[float],
    viscosity: wp.array[float],  # [s]
    # Assets:
    grad_basis: wp.array2d[wp.vec3],  # (point_total, stride) [1/m]
    point_weight: wp.array[wp.float64],  # (point_total,) [m^3]
    stiffness_scale: wp.array[float],  # (point_total,)
    # State in:
    selected: wp.array[int],  # (world_count,)
    q_start: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    dt: wp.float64,
    derivatives: int,
    renew: wp.array[int],  # (world_count,), whether to evaluate the Hessian too
    # Out:
    energy_out: wp.array2d[wp.float64],  # (instance_count, point_max) [J]
    stress_out: wp.array2d[wp.mat33d],  # (instance_count, point_max), V P [N m]
    hessian_out: wp.array3d[wp.mat33],  # (instance_count, 6, point_max), blocks of V d2Psi/dF2 [N m]
):
    """Evaluate V_p Psi(F_p) and, where asked, its derivatives at every cubature point."""
    i, p = wp.tid()
    if selected[world[i]] == 0 or p >= point_count[i]:
        return
    row = point_start[i] + p
    parameters = MaterialParameters()
    mu, lam = lame(youngs_modulus[i] * stiffness_scale[row], poissons_ratio[i])
    parameters.model = material_model[i]
    parameters.mu = mu
    parameters.lam = lam
    parameters.viscosity = wp.float64(viscosity[i])
    weight = point_weight[row]

    G = displacement_gradient(grad_basis, q, i, row, function_count[i])
    G_start = G
    if viscosity[i] > 0.0:
        G_start = displacement_gradient(grad_basis, q_start, i, row, function_count[i])
    energy_out[i, p] = weight * energy(parameters, G, G_start, dt)
    if derivatives != 0:
        stress_out[i, p] = weight * stress(parameters, G, G_start, dt)
    if derivatives != 0 and renew[world[i]] != 0:
        C = float(weight) * hessian(parameters, G, dt)
        for pair in range(6):
            r = 3 * pair
            hessian_out[i, pair, p] = wp.mat33(
                C[r, 0], C[r, 1], C[r, 2], C[r + 1, 0], C[r + 1, 1], C[r + 1, 2], C[r + 2, 0], C[r + 2, 1], C[r + 2, 2]
            )


@wp.kernel
def gather_gradient(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    point_start: wp.array[int],
    point_count: wp.array[int],
    mass: wp.array[wp.float64],
    mass_damping: wp.array[float],
    # Assets:
    grad_basis: wp.array2d[wp.vec3],
    row_basis: wp.array2d[float],
    # State in:
    active: wp.array[int],
    q_start: wp.array2d[wp.vec3d],
    q_inertial: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    force: wp.array2d[wp.vec3d],
    point_stress: wp.array2d[wp.mat33d],
    entry_count: wp.array[int],
    entry_row: wp.array2d[int],
    entry_force: wp.array2d[wp.vec3d],
    dt: wp.float64,
    # Out:
    gradient_out: wp.array2d[wp.vec3d],  # (instance_count, stride) [N]
):
    """Compute g_k = m/dt^2 (q_k - q_inertial) + m alpha/dt (q_k - q_n) + sum_p V P grad b_k - f_k - sum_e b_k f_e."""
    i, k = wp.tid()
    if active[world[i]] == 0 or k >= function_count[i]:
        return
    damping = mass[i] * wp.float64(mass_damping[i]) / dt
    g = mass[i] / (dt * dt) * (q[i, k] - q_inertial[i, k]) + damping * (q[i, k] - q_start[i, k]) - force[i, k]
    first = point_start[i]
    for p in range(point_count[i]):
        g += point_stress[i, p] * wp.vec3d(grad_basis[first + p, k])
    for e in range(entry_count[i]):
        g -= wp.float64(row_basis[entry_row[i, e], k]) * entry_force[i, e]
    gradient_out[i, k] = g


@wp.kernel
def end_step(
    # Instances:
    function_start: wp.array[int],
    function_count: wp.array[int],
    world: wp.array[int],
    # State in:
    status: wp.array[int],
    q_start: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    dt: wp.float64,
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
):
    """Write the state: v = (q - q_n) / dt; a world that is not finite stays where it was, at rest."""
    i, k = wp.tid()
    if k >= function_count[i]:
        return
    out = function_start[i] + k
    if (status[world[i]] & WORLD_NOT_FINITE) != 0:
        q_out[out] = q_start[i, k]
        qd_out[out] = wp.vec3d()
        return
    q_out[out] = q[i, k]
    qd_out[out] = (q[i, k] - q_start[i, k]) / dt


@wp.kernel
def check_finite(
    # Instances:
    function_count: wp.array[int],
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    # State in:
    q: wp.array2d[wp.vec3d],
    r: wp.array2d[wp.float64],
    # In and out:
    status: wp.array[int],
):
    """Flag a world whose unknowns are not all finite."""
    w = wp.tid()
    total = wp.float64(0.0)
    for i in range(instance_start[w], instance_start[w + 1]):
        for k in range(function_count[i]):
            total += wp.length_sq(q[i, k])
    for j in range(rigid_count[w]):
        total += wp.abs(r[w, j])
    if not wp.isfinite(total):
        status[w] = status[w] | WORLD_NOT_FINITE


@wp.kernel
def skin_samples(
    # Instances:
    function_start: wp.array[int],
    function_count: wp.array[int],
    row_start: wp.array[int],
    sample_count: wp.array[int],
    particle_start: wp.array[int],
    # Assets:
    row_point: wp.array[wp.vec3d],  # (row_count,) rest points [m]
    row_basis: wp.array2d[float],
    # State in:
    q: wp.array[wp.vec3d],
    qd: wp.array[wp.vec3d],
    # Out:
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
):
    """Write position and velocity of the surface samples as Newton particles."""
    i, s = wp.tid()
    if s >= sample_count[i]:
        return
    row = row_start[i] + s
    x = row_point[row]
    v = wp.vec3d()
    for k in range(function_count[i]):
        b = wp.float64(row_basis[row, k])
        x += b * q[function_start[i] + k]
        v += b * qd[function_start[i] + k]
    particle_q_out[particle_start[i] + s] = wp.vec3(x)
    particle_qd_out[particle_start[i] + s] = wp.vec3(v)


@wp.kernel
def reset_functions(
    function_start: wp.array[int],
    function_count: wp.array[int],
    world: wp.array[int],
    world_mask: wp.array[wp.bool],
    q_in: wp.array[wp.vec3d],
    qd_in: wp.array[wp.vec3d],
    # Out:
    q_out: wp.array[wp.vec3d],
    qd_out: wp.array[wp.vec3d],
):
    """Copy the initial coordinates of the bodies in masked worlds."""
    i, k = wp.tid()
    if k >= function_count[i] or not world_mask[world[i]]:
        return
    f = function_start[i] + k
    q_out[f] = q_in[f]
    qd_out[f] = qd_in[f]


@wp.kernel
def reset_worlds(
    instance_world: wp.array[int],
    body_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # Out:
    status_out: wp.array[int],
    instance_force_out: wp.array[wp.vec3d],
    body_wrench_out: wp.array[wp.spatial_vector],
):
    """Clear what the masked worlds report: status, contact force on bodies, contact wrench on rigid bodies."""
    i = wp.tid()
    if i < status_out.shape[0] and world_mask[i]:
        status_out[i] = 0
    if i < instance_world.shape[0] and world_mask[instance_world[i]]:
        instance_force_out[i] = wp.vec3d()
    if i < body_world.shape[0]:
        w = body_world[i]
        if w < 0:
            w = world_mask.shape[0] - 1
        if world_mask[w]:
            body_wrench_out[i] = wp.spatial_vector()
