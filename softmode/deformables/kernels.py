"""Device side of the reduced step: elastic energy, gradient and Hessian, the linear system, the line search.

One *instance* is one body in one world. The incremental potential of a world is, over its instances,

    sum_i [ m/(2 dt^2) |q - q_n - dt v_n|^2 + m alpha/(2 dt) |q - q_n|^2 + sum_p V_p Psi(F_p) - f . q + contacts and pins ]
    + 1/2 (r - r_predicted)^T M_eff/dt^2 (r - r_predicted)

with r = dt * joint velocity of the rigid dofs that take part (see ``coupling``). The basis is mass-orthonormal, so the
mass matrix of a body is its mass times the identity. Unknowns of one instance are ordered component-major,
row = c * stride + k, with the function count padded to ``stride``, a multiple of 8.

Precision: basis data float32; q, energy and residual float64; the Newton direction float32.
"""

import warp as wp

from softmode.deformables.factor import LANES, vec8
from softmode.deformables.materials import MaterialParameters, energy, hessian, lame, stress

wp.set_module_options({"enable_backward": False})

WORLD_ITERATION_LIMIT = 1
"""Status bit: Newton stopped at its iteration limit."""
WORLD_NO_DESCENT = 2
"""Status bit: the line search found no lower potential and the step was not yet small."""
WORLD_CONTACT_OVERFLOW = 4
"""Status bit: an instance had more contacts than its capacity; near ones were dropped, then the last of the touching."""
WORLD_NOT_FINITE = 8
"""Status bit: the step produced a value that is not finite; the world kept its state at rest."""


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
    hessian_out: wp.array3d[wp.mat33],  # (instance_count, point_max, 6), blocks of V d2Psi/dF2 [N m]
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
            hessian_out[i, p, pair] = wp.mat33(
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
def check_convergence(
    # Instances:
    function_count: wp.array[int],
    mass: wp.array[wp.float64],
    tolerance: wp.array[float],  # (instance_count,) [m]
    # Worlds:
    instance_start: wp.array[int],
    iteration_max: int,
    force_tolerance: wp.float64,
    dt: wp.float64,
    # State in:
    gradient: wp.array2d[wp.vec3d],
    force: wp.array2d[wp.vec3d],
    pin_count: wp.array[int],
    entry_count: wp.array[int],
    entry_force: wp.array2d[wp.vec3d],
    last: wp.array[int],
    iteration: wp.array[int],
    # In and out:
    active: wp.array[int],
    status: wp.array[int],
):
    """Stop a world whose last step was small and whose residual is small against the forces on each of its bodies.

    The second condition matters in contact: within a step's tolerance friction goes from one side of its cone to the
    other, and a residual is momentum that the other body receives and this one does not.
    """
    w = wp.tid()
    if active[w] == 0 or iteration[w] == 0:
        return
    done = last[w]
    for i in range(instance_start[w], instance_start[w + 1]):
        residual = wp.float64(0.0)
        external = wp.float64(0.0)
        for k in range(function_count[i]):
            residual += wp.length_sq(gradient[i, k])
            external += wp.length_sq(force[i, k])
        scale = wp.sqrt(external)
        for e in range(entry_count[i]):
            scale += wp.length(entry_force[i, e])
        floor = wp.float64(1.0e-3) * mass[i] * wp.float64(tolerance[i]) / (dt * dt)
        if entry_count[i] > pin_count[i] and not (wp.sqrt(residual) <= force_tolerance * scale + floor):
            done = 0
    if done == 1:
        active[w] = 0
    elif iteration[w] >= iteration_max:
        active[w] = 0
        status[w] = status[w] | WORLD_ITERATION_LIMIT


@wp.func
def block_pair(pair: int):
    """Return the components (c, d) of the six blocks 00, 01, 02, 11, 12, 22."""
    c = int(0)
    d = pair
    if pair >= 3:
        c = 1
        d = pair - 2
    if pair == 5:
        c = 2
        d = 2
    return c, d


@wp.kernel
def assemble_stiffness(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    point_start: wp.array[int],
    point_count: wp.array[int],
    mass: wp.array[wp.float64],
    mass_damping: wp.array[float],
    # Assets:
    grad_basis: wp.array2d[wp.vec3],  # (point_total, stride)
    grad_basis8: wp.array3d[vec8],  # (3, point_total, stride / 8), the same numbers by component
    # State in:
    active: wp.array[int],
    renew: wp.array[int],
    point_hessian: wp.array3d[wp.mat33],  # blocks (c, d) = 00, 01, 02, 11, 12, 22
    dt: float,
    # Out:
    stiffness_out: wp.array3d[vec8],  # (instance_count, 3 stride, 3 stride / 8), upper triangle
):
    """Assemble 8x8 blocks of sum_p grad b^T C grad b with inertia on the diagonal."""
    i, pair, rows, lanes = wp.tid()
    if active[world[i]] == 0 or renew[world[i]] == 0:
        return
    c, d = block_pair(pair)
    if c == d and lanes < rows:
        return
    k0 = LANES * rows
    a0 = vec8()
    a1 = vec8()
    a2 = vec8()
    a3 = vec8()
    a4 = vec8()
    a5 = vec8()
    a6 = vec8()
    a7 = vec8()
    first = point_start[i]
    n = function_count[i]
    if k0 < n and LANES * lanes < n:
        for p in range(point_count[i]):
            C = point_hessian[i, p, pair]
            point = first + p
            gx = grad_basis8[0, point, lanes]
            gy = grad_basis8[1, point, lanes]
            gz = grad_basis8[2, point, lanes]
            ux = C[0, 0] * gx + C[0, 1] * gy + C[0, 2] * gz
            uy = C[1, 0] * gx + C[1, 1] * gy + C[1, 2] * gz
            uz = C[2, 0] * gx + C[2, 1] * gy + C[2, 2] * gz
            g = grad_basis[point, k0]
            a0 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 1]
            a1 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 2]
            a2 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 3]
            a3 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 4]
            a4 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 5]
            a5 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 6]
            a6 += g[0] * ux + g[1] * uy + g[2] * uz
            g = grad_basis[point, k0 + 7]
            a7 += g[0] * ux + g[1] * uy + g[2] * uz
    stride = grad_basis.shape[1]
    if c == d and lanes == rows:
        inertia = float(mass[i]) * (1.0 / dt + mass_damping[i]) / dt
        a0[0] += wp.where(k0 < n, inertia, 1.0)
        a1[1] += wp.where(k0 + 1 < n, inertia, 1.0)
        a2[2] += wp.where(k0 + 2 < n, inertia, 1.0)
        a3[3] += wp.where(k0 + 3 < n, inertia, 1.0)
        a4[4] += wp.where(k0 + 4 < n, inertia, 1.0)
        a5[5] += wp.where(k0 + 5 < n, inertia, 1.0)
        a6[6] += wp.where(k0 + 6 < n, inertia, 1.0)
        a7[7] += wp.where(k0 + 7 < n, inertia, 1.0)
    row = c * stride + k0
    column = d * (stride / LANES) + lanes
    stiffness_out[i, row, column] = a0
    stiffness_out[i, row + 1, column] = a1
    stiffness_out[i, row + 2, column] = a2
    stiffness_out[i, row + 3, column] = a3
    stiffness_out[i, row + 4, column] = a4
    stiffness_out[i, row + 5, column] = a5
    stiffness_out[i, row + 6, column] = a6
    stiffness_out[i, row + 7, column] = a7


@wp.kernel
def assemble_matrix(
    # Instances:
    world: wp.array[int],
    stride: int,
    # Assets:
    row_basis8: wp.array2d[vec8],
    # State in:
    active: wp.array[int],
    stiffness: wp.array3d[vec8],
    entry_count: wp.array[int],
    entry_row: wp.array2d[int],
    entry_hessian: wp.array2d[wp.mat33],
    # Out:
    matrix_out: wp.array3d[vec8],  # (instance_count, 3 stride, ...), upper triangle
):
    """Add the pins and contacts, sum_e b^T H b, to 8x8 blocks of the stiffness."""
    i, pair, rows, lanes = wp.tid()
    if active[world[i]] == 0:
        return
    c, d = block_pair(pair)
    if c == d and lanes < rows:
        return
    row = c * stride + LANES * rows
    column = d * (stride / LANES) + lanes
    a0 = stiffness[i, row, column]
    a1 = stiffness[i, row + 1, column]
    a2 = stiffness[i, row + 2, column]
    a3 = stiffness[i, row + 3, column]
    a4 = stiffness[i, row + 4, column]
    a5 = stiffness[i, row + 5, column]
    a6 = stiffness[i, row + 6, column]
    a7 = stiffness[i, row + 7, column]
    for e in range(entry_count[i]):
        basis_row = entry_row[i, e]
        v = entry_hessian[i, e][c, d] * row_basis8[basis_row, lanes]
        b = row_basis8[basis_row, rows]
        a0 += b[0] * v
        a1 += b[1] * v
        a2 += b[2] * v
        a3 += b[3] * v
        a4 += b[4] * v
        a5 += b[5] * v
        a6 += b[6] * v
        a7 += b[7] * v
    matrix_out[i, row, column] = a0
    matrix_out[i, row + 1, column] = a1
    matrix_out[i, row + 2, column] = a2
    matrix_out[i, row + 3, column] = a3
    matrix_out[i, row + 4, column] = a4
    matrix_out[i, row + 5, column] = a5
    matrix_out[i, row + 6, column] = a6
    matrix_out[i, row + 7, column] = a7


@wp.kernel
def assemble_columns(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    stride: int,
    # Assets:
    row_basis: wp.array2d[float],
    # State in:
    active: wp.array[int],
    gradient: wp.array2d[wp.vec3d],
    entry_count: wp.array[int],
    entry_row: wp.array2d[int],
    entry_coupling: wp.array3d[wp.vec3],  # (instance_count, entry_max, rigid_count), H_e J_e
    rigid_count: int,
    # Out:
    matrix_out: wp.array3d[vec8],
):
    """Fill the columns right of K: d2E/dq dr = -sum_e b_k H_e J_e, then the right-hand side -g in column rigid_count."""
    i, row, block = wp.tid()
    if active[world[i]] == 0:
        return
    c = row / stride
    k = row % stride
    value = vec8()
    if k < function_count[i]:
        for lane in range(LANES):
            j = LANES * block + lane
            if j == rigid_count:
                value[lane] = -float(gradient[i, k][c])
            if j < rigid_count:
                total = float(0.0)
                for e in range(entry_count[i]):
                    total -= row_basis[entry_row[i, e], k] * entry_coupling[i, e, j][c]
                value[lane] = total
    matrix_out[i, row, 3 * stride / LANES + block] = value


@wp.kernel
def assemble_rigid(
    # Worlds:
    instance_start: wp.array[int],  # (world_count + 1,)
    rigid_count: wp.array[int],  # (world_count,)
    # State in:
    active: wp.array[int],
    inertia: wp.array3d[wp.float64],  # (world_count, rigid_max, rigid_max), M_eff / dt^2
    r_predicted: wp.array2d[wp.float64],
    r: wp.array2d[wp.float64],
    entry_count: wp.array[int],
    entry_force: wp.array2d[wp.vec3d],
    entry_jacobian: wp.array3d[wp.vec3],  # (instance_count, entry_max, rigid_max)
    entry_coupling: wp.array3d[wp.vec3],
    # Out:
    gradient_out: wp.array2d[wp.float64],
    matrix_out: wp.array3d[wp.float64],
):
    """Compute gradient and Hessian of the rigid dofs: M_eff/dt^2 (r - r_predicted) + sum_e J_e^T f_e."""
    w, j = wp.tid()
    if active[w] == 0 or j >= rigid_count[w]:
        return
    g = wp.float64(0.0)
    for l in range(rigid_count[w]):
        m = inertia[w, j, l]
        g += m * (r[w, l] - r_predicted[w, l])
        h = m
        for i in range(instance_start[w], instance_start[w + 1]):
            for e in range(entry_count[i]):
                h += wp.float64(wp.dot(entry_jacobian[i, e, j], entry_coupling[i, e, l]))
        matrix_out[w, j, l] = h
    for i in range(instance_start[w], instance_start[w + 1]):
        for e in range(entry_count[i]):
            g += wp.dot(wp.vec3d(entry_jacobian[i, e, j]), entry_force[i, e])
    gradient_out[w, j] = g


@wp.kernel
def condense(
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    rigid_max: int,
    # State in:
    active: wp.array[int],
    gradient: wp.array2d[wp.float64],
    factored: wp.array3d[vec8],  # [U | Y | y], Y = U^-T C, y = U^-T (-g)
    row_count: int,
    # In and out:
    matrix: wp.array3d[wp.float64],  # (world_count, rigid_max, rigid_max)
    # Out:
    right_out: wp.array2d[wp.float64],
):
    """Subtract the bodies: S = R - sum_i Y_i^T Y_i and s = -g_r - sum_i Y_i^T y_i."""
    w, j = wp.tid()
    if active[w] == 0 or j >= rigid_count[w]:
        return
    first = row_count / LANES
    right = -gradient[w, j]
    for i in range(instance_start[w], instance_start[w + 1]):
        for row in range(row_count):
            y = factored[i, row, first + j / LANES][j % LANES]
            if y != 0.0:
                right -= wp.float64(y) * wp.float64(factored[i, row, first + rigid_max / LANES][rigid_max % LANES])
                for l in range(rigid_count[w]):
                    matrix[w, j, l] = matrix[w, j, l] - wp.float64(y) * wp.float64(
                        factored[i, row, first + l / LANES][l % LANES]
                    )
    right_out[w, j] = right


@wp.kernel
def solve_rigid(
    # Worlds:
    rigid_count: wp.array[int],
    active: wp.array[int],
    # In and out:
    matrix: wp.array3d[wp.float64],  # overwritten by its lower Cholesky factor
    # In: right-hand side, out: solution
    solution: wp.array2d[wp.float64],
):
    """Solve S x = s by Cholesky, one thread per world (S holds one row per rigid dof of a world)."""
    w = wp.tid()
    if active[w] == 0:
        return
    n = rigid_count[w]
    for a in range(n):
        pivot = matrix[w, a, a]
        for s in range(a):
            pivot -= matrix[w, a, s] * matrix[w, a, s]
        pivot = wp.sqrt(wp.max(pivot, wp.float64(1.0e-12) * wp.abs(matrix[w, a, a])))
        matrix[w, a, a] = pivot
        for b in range(a + 1, n):
            value = matrix[w, b, a]
            for s in range(a):
                value -= matrix[w, b, s] * matrix[w, a, s]
            matrix[w, b, a] = value / pivot
    for a in range(n):
        value = solution[w, a]
        for s in range(a):
            value -= matrix[w, a, s] * solution[w, s]
        solution[w, a] = value / matrix[w, a, a]
    for reverse in range(n):
        a = n - 1 - reverse
        value = solution[w, a]
        for s in range(a + 1, n):
            value -= matrix[w, s, a] * solution[w, s]
        solution[w, a] = value / matrix[w, a, a]


@wp.func
def unknown(direction: wp.array2d[vec8], instance: int, blocks: int, function: int):
    """Return the vec3 of one function out of a component-major solution."""
    lane = function % LANES
    block = function / LANES
    return wp.vec3d(
        wp.float64(direction[instance, block][lane]),
        wp.float64(direction[instance, blocks + block][lane]),
        wp.float64(direction[instance, 2 * blocks + block][lane]),
    )


@wp.kernel
def trial_functions(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    stride: int,
    # State in:
    searching: wp.array[int],
    step_length: wp.array[wp.float64],
    q: wp.array2d[wp.vec3d],
    direction: wp.array2d[vec8],  # (instance_count, 3 stride / 8)
    # Out:
    q_out: wp.array2d[wp.vec3d],
):
    """Set q_trial = q + alpha dq."""
    i, k = wp.tid()
    w = world[i]
    if searching[w] == 0 or k >= function_count[i]:
        return
    q_out[i, k] = q[i, k] + step_length[w] * unknown(direction, i, stride / LANES, k)


@wp.kernel
def trial_rigid(
    rigid_count: wp.array[int],
    searching: wp.array[int],
    step_length: wp.array[wp.float64],
    r: wp.array2d[wp.float64],
    direction: wp.array2d[wp.float64],
    # Out:
    r_out: wp.array2d[wp.float64],
):
    """Set r_trial = r + alpha dr."""
    w, j = wp.tid()
    if searching[w] == 0 or j >= rigid_count[w]:
        return
    r_out[w, j] = r[w, j] + step_length[w] * direction[w, j]


@wp.kernel
def sum_potential(
    # Instances:
    function_count: wp.array[int],
    point_count: wp.array[int],
    mass: wp.array[wp.float64],
    mass_damping: wp.array[float],
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    # State in:
    selected: wp.array[int],
    q_start: wp.array2d[wp.vec3d],
    q_inertial: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    force: wp.array2d[wp.vec3d],
    point_energy: wp.array2d[wp.float64],
    entry_count: wp.array[int],
    entry_energy: wp.array2d[wp.float64],
    inertia: wp.array3d[wp.float64],
    r_predicted: wp.array2d[wp.float64],
    r: wp.array2d[wp.float64],
    dt: wp.float64,
    # Out:
    potential_out: wp.array[wp.float64],  # (world_count,) [J]
):
    """Sum the incremental potential of a world, in a fixed order."""
    w = wp.tid()
    if selected[w] == 0:
        return
    half = wp.float64(0.5)
    total = wp.float64(0.0)
    for i in range(instance_start[w], instance_start[w + 1]):
        inertial = half * mass[i] / (dt * dt)
        damping = half * mass[i] * wp.float64(mass_damping[i]) / dt
        for k in range(function_count[i]):
            inertial_step = q[i, k] - q_inertial[i, k]
            step = q[i, k] - q_start[i, k]
            total += inertial * wp.length_sq(inertial_step) + damping * wp.length_sq(step) - wp.dot(force[i, k], step)
        for p in range(point_count[i]):
            total += point_energy[i, p]
        for e in range(entry_count[i]):
            total += entry_energy[i, e]
    for j in range(rigid_count[w]):
        for l in range(rigid_count[w]):
            total += half * (r[w, j] - r_predicted[w, j]) * inertia[w, j, l] * (r[w, l] - r_predicted[w, l])
    potential_out[w] = total


@wp.kernel
def begin_search(
    # Instances:
    function_count: wp.array[int],
    stride: int,
    tolerance: wp.array[float],  # (instance_count,) [m], root mean square
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    rigid_tolerance: float,  # [m or rad]
    stick_range: wp.float64,  # [m]
    # State in:
    active: wp.array[int],
    pin_count: wp.array[int],
    entry_count: wp.array[int],
    gradient: wp.array2d[wp.vec3d],
    direction: wp.array2d[vec8],
    rigid_gradient: wp.array2d[wp.float64],
    rigid_direction: wp.array2d[wp.float64],
    # Out:
    slope_out: wp.array[wp.float64],
    step_length_out: wp.array[wp.float64],
    last_out: wp.array[int],  # (world_count,), 1 where every body moves less than its tolerance
    searching_out: wp.array[int],
    any_searching_out: wp.array[int],
):
    """Compute the slope g . d of each active world and start its line search at alpha = 1.

    A step below the tolerance (in contact, far below the stick range too) is taken in full: there the change of the
    potential drowns in rounding.
    """
    w = wp.tid()
    searching_out[w] = 0
    if active[w] == 0:
        return
    slope = wp.float64(0.0)
    last = int(1)
    blocks = stride / LANES
    for i in range(instance_start[w], instance_start[w + 1]):
        moved = wp.float64(0.0)
        for k in range(function_count[i]):
            dq = unknown(direction, i, blocks, k)
            slope += wp.dot(gradient[i, k], dq)
            moved += wp.length_sq(dq)
        limit = wp.float64(tolerance[i])
        if entry_count[i] > pin_count[i]:
            limit = wp.min(limit, wp.float64(0.1) * stick_range)
        if not (wp.sqrt(moved) <= limit):
            last = 0
    for j in range(rigid_count[w]):
        slope += rigid_gradient[w, j] * rigid_direction[w, j]
        if not (wp.abs(rigid_direction[w, j]) <= wp.float64(rigid_tolerance)):
            last = 0
    slope_out[w] = slope
    step_length_out[w] = wp.float64(1.0)
    last_out[w] = last
    if last == 0:
        searching_out[w] = 1
        wp.atomic_max(any_searching_out, 0, 1)


@wp.kernel
def judge_trial(
    # State in:
    potential: wp.array[wp.float64],
    potential_trial: wp.array[wp.float64],
    slope: wp.array[wp.float64],
    step_length_min: wp.float64,
    # In and out:
    step_length: wp.array[wp.float64],
    searching: wp.array[int],
    # Out:
    any_searching_out: wp.array[int],
):
    """Accept a trial that lowers the potential (Armijo, up to rounding) or halve the step; give up at the minimum."""
    w = wp.tid()
    if searching[w] == 0:
        return
    rounding = wp.float64(1.0e-12) * wp.abs(potential[w])
    alpha = step_length[w]
    if potential_trial[w] <= potential[w] + wp.float64(1.0e-4) * alpha * slope[w] + rounding:
        searching[w] = 0
        return
    alpha *= wp.float64(0.5)
    if alpha < step_length_min:
        alpha = wp.float64(0.0)
        searching[w] = 0
    else:
        wp.atomic_max(any_searching_out, 0, 1)
    step_length[w] = alpha


@wp.kernel
def finish_iteration(
    # Instances:
    function_count: wp.array[int],
    stride: int,
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    renewal: int,
    renewal_distance: wp.float64,  # in tolerances
    tolerance: wp.array[float],  # (instance_count,) [m]
    # State in:
    step_length: wp.array[wp.float64],
    direction: wp.array2d[vec8],
    rigid_direction: wp.array2d[wp.float64],
    last: wp.array[int],
    # In and out:
    active: wp.array[int],
    q: wp.array2d[wp.vec3d],
    r: wp.array2d[wp.float64],
    iteration: wp.array[int],
    renew: wp.array[int],
    exact: wp.array[int],
    status: wp.array[int],
    # Out:
    any_active_out: wp.array[int],
):
    """Take the accepted step; say whether the stiffness is to be renewed and how friction is to be linearised."""
    w = wp.tid()
    if active[w] == 0:
        return
    iteration[w] = iteration[w] + 1
    alpha = step_length[w]
    stale = renew[w] == 0
    renew[w] = 0
    if iteration[w] % renewal == 0 or alpha < wp.float64(1.0):
        renew[w] = 1
    for i in range(instance_start[w], instance_start[w + 1]):
        moved = wp.float64(0.0)
        for k in range(function_count[i]):
            step = alpha * unknown(direction, i, stride / LANES, k)
            moved += wp.length_sq(step)
            q[i, k] = q[i, k] + step
        if wp.sqrt(moved) > renewal_distance * wp.float64(tolerance[i]):
            renew[w] = 1
    for j in range(rigid_count[w]):
        r[w, j] = r[w, j] + alpha * rigid_direction[w, j]
    exact[w] = 0
    if iteration[w] >= 1 and alpha == wp.float64(1.0):
        exact[w] = 1
    if alpha == wp.float64(0.0) and last[w] == 0 and not stale:
        active[w] = 0
        status[w] = status[w] | WORLD_NO_DESCENT
    else:
        wp.atomic_max(any_active_out, 0, 1)


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
