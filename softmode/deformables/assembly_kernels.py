"""Device side of the linear system: [K | C | -g] of every body, the rigid part, and its condensation.

Unknowns of one instance are ordered component-major, row = c * stride + k; see ``kernels`` for the potential.
"""

import warp as wp

from softmode.deformables.factor import LANES, vec8

wp.set_module_options({"enable_backward": False})


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
    grad_basis8: wp.array3d[vec8],  # (stride / 8, point_total, 3), so that a block walks through contiguous memory
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
            C = point_hessian[i, pair, p]
            point = first + p
            gx = grad_basis8[lanes, point, 0]
            gy = grad_basis8[lanes, point, 1]
            gz = grad_basis8[lanes, point, 2]
            ux = C[0, 0] * gx + C[0, 1] * gy + C[0, 2] * gz
            uy = C[1, 0] * gx + C[1, 1] * gy + C[1, 2] * gz
            uz = C[2, 0] * gx + C[2, 1] * gy + C[2, 2] * gz
            rx = grad_basis8[rows, point, 0]
            ry = grad_basis8[rows, point, 1]
            rz = grad_basis8[rows, point, 2]
            a0 += rx[0] * ux + ry[0] * uy + rz[0] * uz
            a1 += rx[1] * ux + ry[1] * uy + rz[1] * uz
            a2 += rx[2] * ux + ry[2] * uy + rz[2] * uz
            a3 += rx[3] * ux + ry[3] * uy + rz[3] * uz
            a4 += rx[4] * ux + ry[4] * uy + rz[4] * uz
            a5 += rx[5] * ux + ry[5] * uy + rz[5] * uz
            a6 += rx[6] * ux + ry[6] * uy + rz[6] * uz
            a7 += rx[7] * ux + ry[7] * uy + rz[7] * uz
    stride = LANES * grad_basis8.shape[0]
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
    """Fill the columns right of K: d2E/dq dr = -sum_e b_k H_e J_e, and -g in column rigid_count."""
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
