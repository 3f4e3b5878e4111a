"""Device side of the linear system: [K | C | -g] of every body, the rigid part, and its condensation.

Unknowns of one instance are ordered component-major in blocks of eight, see ``tables``.
"""

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import LANES, barrier, free_part, vec8, vec8d
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Rigid,
    first_coupled,
    has_contacts,
)

wp.set_module_options({"enable_backward": False})

CONDENSED_ROUNDING = wp.constant(wp.float64(1.0e-6))
"""Rounding of a condensed diagonal entry as a fraction of the entry before: the bodies are factored in float32."""


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


@wp.func
def block_task(task: int, block_count: int):
    """Return the component pair, row block and column block of a task, without those below the diagonal.

    The 3 block_count^2 blocks of the pairs 01, 02, 12 come first, then the upper triangles of 00, 11, 22.
    """
    square = block_count * block_count
    if task < 3 * square:
        pair = task / square
        rest = task % square
        return wp.where(pair < 2, pair + 1, 4), rest / block_count, rest % block_count
    triangle = (square + block_count) / 2
    diagonal = (task - 3 * square) / triangle
    columns = int((task - 3 * square) % triangle)
    rows = int(0)
    while columns >= block_count - rows:
        columns -= block_count - rows
        rows += 1
    return wp.where(diagonal == 0, 0, wp.where(diagonal == 1, 3, 5)), rows, rows + columns


@wp.func
def stiffness_block(
    instances: Instances,
    basis: Basis,
    points: Points,
    active: wp.array[int],
    refresh: wp.array[int],
    chunk_count: int,
    # Out:
    stiffness_out: wp.array4d[vec8],  # (instance_count, chunk_count, 3 stride, 3 block_count), upper triangle
    i: int,
    chunk: int,
    task: int,
):
    """Assemble 8x8 blocks of sum_p grad b^T C grad b over one chunk of the points."""
    if active[instances.world[i]] == 0 or refresh[instances.world[i]] == 0:
        return
    block_count = basis.row.shape[1]
    pair, rows, columns = block_task(task, block_count)
    c, d = block_pair(pair)
    a0 = vec8()
    a1 = vec8()
    a2 = vec8()
    a3 = vec8()
    a4 = vec8()
    a5 = vec8()
    a6 = vec8()
    a7 = vec8()
    first = instances.point_start[i]
    count = instances.point_count[i]
    n = instances.function_count[i]
    if LANES * rows < n and LANES * columns < n:
        for p in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
            C = points.hessian[i, pair, p]
            gx = basis.gradient_across[columns, first + p, 0]
            gy = basis.gradient_across[columns, first + p, 1]
            gz = basis.gradient_across[columns, first + p, 2]
            ux = C[0, 0] * gx + C[0, 1] * gy + C[0, 2] * gz
            uy = C[1, 0] * gx + C[1, 1] * gy + C[1, 2] * gz
            uz = C[2, 0] * gx + C[2, 1] * gy + C[2, 2] * gz
            r = basis.gradient_across[rows, first + p, 0]
            a0 = a0 + r[0] * ux
            a1 = a1 + r[1] * ux
            a2 = a2 + r[2] * ux
            a3 = a3 + r[3] * ux
            a4 = a4 + r[4] * ux
            a5 = a5 + r[5] * ux
            a6 = a6 + r[6] * ux
            a7 = a7 + r[7] * ux
            r = basis.gradient_across[rows, first + p, 1]
            a0 = a0 + r[0] * uy
            a1 = a1 + r[1] * uy
            a2 = a2 + r[2] * uy
            a3 = a3 + r[3] * uy
            a4 = a4 + r[4] * uy
            a5 = a5 + r[5] * uy
            a6 = a6 + r[6] * uy
            a7 = a7 + r[7] * uy
            r = basis.gradient_across[rows, first + p, 2]
            a0 = a0 + r[0] * uz
            a1 = a1 + r[1] * uz
            a2 = a2 + r[2] * uz
            a3 = a3 + r[3] * uz
            a4 = a4 + r[4] * uz
            a5 = a5 + r[5] * uz
            a6 = a6 + r[6] * uz
            a7 = a7 + r[7] * uz
    row = LANES * (c * block_count + rows)
    column = d * block_count + columns
    stiffness_out[i, chunk, row, column] = a0
    stiffness_out[i, chunk, row + 1, column] = a1
    stiffness_out[i, chunk, row + 2, column] = a2
    stiffness_out[i, chunk, row + 3, column] = a3
    stiffness_out[i, chunk, row + 4, column] = a4
    stiffness_out[i, chunk, row + 5, column] = a5
    stiffness_out[i, chunk, row + 6, column] = a6
    stiffness_out[i, chunk, row + 7, column] = a7


assemble_stiffness = kernel_over(stiffness_block, "assemble_stiffness", "i", "chunk", "task")


@wp.kernel
def assemble_pins(
    instances: Instances,
    basis: Basis,
    first_row: int,
    pin_stiffness: wp.array[float],  # (pin_total,) [N/m]
    # Out:
    pins_out: wp.array3d[vec8],  # (instance_count, stride, block_count), upper triangle
):
    """Assemble 8x8 blocks of sum_e k_e b b^T over the pins: the same for x, y and z, and constant."""
    i, rows, columns = wp.tid()
    if columns < rows:
        return
    a0 = vec8()
    a1 = vec8()
    a2 = vec8()
    a3 = vec8()
    a4 = vec8()
    a5 = vec8()
    a6 = vec8()
    a7 = vec8()
    for e in range(instances.pin_start[i], instances.pin_start[i] + instances.pin_count[i]):
        b = wp.max(pin_stiffness[e], 0.0) * basis.row[first_row + e, rows]
        v = basis.row[first_row + e, columns]
        a0 = a0 + b[0] * v
        a1 = a1 + b[1] * v
        a2 = a2 + b[2] * v
        a3 = a3 + b[3] * v
        a4 = a4 + b[4] * v
        a5 = a5 + b[5] * v
        a6 = a6 + b[6] * v
        a7 = a7 + b[7] * v
    row = LANES * rows
    pins_out[i, row, columns] = a0
    pins_out[i, row + 1, columns] = a1
    pins_out[i, row + 2, columns] = a2
    pins_out[i, row + 3, columns] = a3
    pins_out[i, row + 4, columns] = a4
    pins_out[i, row + 5, columns] = a5
    pins_out[i, row + 6, columns] = a6
    pins_out[i, row + 7, columns] = a7


@wp.func
def matrix_row(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    active: wp.array[int],
    stiffness: wp.array4d[vec8],
    pins: wp.array3d[vec8],
    dt: wp.float64,
    team: int,
    # Out:
    matrix_out: wp.array3d[vec8],  # (system_count, N, ...), upper triangle
    i: int,
    row: int,
    member: int,
):
    """Add inertia and pins to the stiffness; driven unknowns stay put."""
    if active[instances.world[i]] == 0:
        return
    block_count = basis.row.shape[1]
    c = row / (LANES * block_count)
    k = row % (LANES * block_count)
    driven = instances.driven_count[i]
    first = instances.system_block[i]
    for column in range(member, 3 * block_count, team):
        d = column / block_count
        columns = column % block_count
        if LANES * column + 7 >= row:
            value = stiffness[i, 0, row, column]
            for chunk in range(1, stiffness.shape[1]):
                value = value + stiffness[i, chunk, row, column]
            if c == d and instances.pin_count[i] > 0:
                value = value + pins[i, k, columns]
            value = free_part(value, wp.where(k < driven, LANES, driven - LANES * columns))
            if row / LANES == column:
                # the padding behind the functions carries inertia alone
                rate = motion.rate[i] / dt
                inertia = float(instances.mass[i] * rate * (rate + wp.float64(instances.mass_damping[i])))
                for lane in range(LANES):
                    if lane == row % LANES:
                        value[lane] = value[lane] + inertia
            matrix_out[instances.system[i], LANES * first + row, first + column] = value


assemble_matrix = kernel_over(matrix_row, "assemble_matrix", "i", "row", "member")


@wp.func
def contact_block(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    active: wp.array[int],
    # In and out:
    matrix: wp.array3d[vec8],  # (system_count, N, ...), upper triangle
    i: int,
    task: int,
):
    """Add the contacts, sum_e b^T H b, to 8x8 blocks; driven unknowns stay put."""
    if active[instances.world[i]] == 0 or not has_contacts(instances, constraints, i):
        return
    block_count = basis.row.shape[1]
    pair, rows, columns = block_task(task, block_count)
    c, d = block_pair(pair)
    driven = instances.driven_count[i]
    a0 = vec8()
    a1 = vec8()
    a2 = vec8()
    a3 = vec8()
    a4 = vec8()
    a5 = vec8()
    a6 = vec8()
    a7 = vec8()
    for e in range(instances.pin_count[i], constraints.count[i]):
        r = constraints.row[i, e]
        b = free_part(basis.row[r, rows], driven - LANES * rows)
        v = constraints.hessian[i, e][c, d] * free_part(basis.row[r, columns], driven - LANES * columns)
        a0 = a0 + b[0] * v
        a1 = a1 + b[1] * v
        a2 = a2 + b[2] * v
        a3 = a3 + b[3] * v
        a4 = a4 + b[4] * v
        a5 = a5 + b[5] * v
        a6 = a6 + b[6] * v
        a7 = a7 + b[7] * v
    first = instances.system_block[i]
    row = LANES * (first + c * block_count + rows)
    column = first + d * block_count + columns
    i = instances.system[i]
    matrix[i, row, column] = matrix[i, row, column] + a0
    matrix[i, row + 1, column] = matrix[i, row + 1, column] + a1
    matrix[i, row + 2, column] = matrix[i, row + 2, column] + a2
    matrix[i, row + 3, column] = matrix[i, row + 3, column] + a3
    matrix[i, row + 4, column] = matrix[i, row + 4, column] + a4
    matrix[i, row + 5, column] = matrix[i, row + 5, column] + a5
    matrix[i, row + 6, column] = matrix[i, row + 6, column] + a6
    matrix[i, row + 7, column] = matrix[i, row + 7, column] + a7


add_contacts = kernel_over(contact_block, "add_contacts", "i", "task")


@wp.func
def column_block(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    active: wp.array[int],
    gradient: wp.array2d[vec8d],
    rigid: Rigid,
    rigid_count: int,
    size: int,  # N
    # Out:
    matrix_out: wp.array3d[float],  # (system_count, N, N + ...)
    i: int,
    rows: int,
    j: int,
):
    """Fill the columns right of K: d2E/dq dr = -sum_e b_k H_e J_e, and -g in column rigid_count."""
    if active[instances.world[i]] == 0:
        return
    block_count = basis.row.shape[1]
    c = rows / block_count
    b = rows % block_count
    value = vec8()
    if j == rigid_count:
        value = vec8(-gradient[i, rows])
    elif j < rigid.count[instances.world[i]]:
        for e in range(first_coupled(instances, i), constraints.count[i]):
            if j < constraints.dof_begin[i, e] or j >= constraints.dof_end[i, e]:
                continue
            value = value - constraints.coupling[i, e, j][c] * basis.row[constraints.row[i, e], b]
        value = free_part(value, instances.driven_count[i] - LANES * b)
    for a in range(LANES):
        row = LANES * (instances.system_block[i] + rows) + a
        matrix_out[instances.system[i], row, size + j] = value[a]


assemble_columns = kernel_over(column_block, "assemble_columns", "i", "rows", "j")


@wp.func
def rigid_entry(
    instances: Instances,
    constraints: PointConstraints,
    state: NewtonState,
    # In and out:
    rigid: Rigid,
    w: int,
    j: int,
    l: int,
):
    """Compute gradient and Hessian of the rigid dofs: M_eff/dt^2 (r - r_predicted) + sum_e J_e^T f_e, and the rows."""
    if state.active[w] == 0 or j >= rigid.count[w] or l > j:
        return
    first = state.instance_start[w]
    end = state.instance_start[w + 1]
    h = rigid.inertia[w, j, l]
    for i in range(first, end):
        for e in range(first_coupled(instances, i), constraints.count[i]):
            if l >= constraints.dof_begin[i, e] and j < constraints.dof_end[i, e]:
                h += wp.float64(wp.dot(constraints.jacobian[i, e, j], constraints.coupling[i, e, l]))
    for k in range(rigid.row_count[w]):
        h += wp.float64(rigid.row_jacobian[w, k, j]) * rigid.row_coupling[w, k, l]
    rigid.matrix[w, j, l] = h
    rigid.matrix[w, l, j] = h
    if l == 0:
        g = wp.float64(0.0)
        for k in range(rigid.count[w]):
            g += rigid.inertia[w, j, k] * (rigid.r[w, k] - rigid.predicted[w, k])
        for i in range(first, end):
            for e in range(first_coupled(instances, i), constraints.count[i]):
                if j >= constraints.dof_begin[i, e] and j < constraints.dof_end[i, e]:
                    g += wp.dot(wp.vec3d(constraints.jacobian[i, e, j]), constraints.force[i, e])
        for k in range(rigid.row_count[w]):
            g += wp.float64(rigid.row_jacobian[w, k, j]) * rigid.row_force[w, k]
        rigid.gradient[w, j] = g


assemble_rigid = kernel_over(rigid_entry, "assemble_rigid", "w", "j", "l")


@wp.func
def condensed_entry(
    state: NewtonState,
    system_start: wp.array[int],  # (world_count + 1,)
    rigid_max: int,
    factored: wp.array3d[vec8],  # [U | Y | y], Y = U^-T C, y = U^-T (-g)
    # In and out:
    rigid: Rigid,
    w: int,
    j: int,
    l: int,
):
    """Subtract the bodies: S = R - sum_i Y_i^T Y_i and s = -g_r - sum_i Y_i^T y_i."""
    # column l = rigid_count is the right-hand side; of the matrix only the lower triangle is read
    if state.active[w] == 0 or j >= rigid.count[w] or l > rigid.count[w] or (l > j and l < rigid.count[w]):
        return
    row_count = factored.shape[1]
    first = row_count / LANES
    column = l
    value = -rigid.gradient[w, j]
    if l == rigid.count[w]:
        column = rigid_max
    else:
        value = rigid.matrix[w, j, l]
    for i in range(system_start[w], system_start[w + 1]):
        for row in range(row_count):
            y = factored[i, row, first + j / LANES][j % LANES]
            value -= wp.float64(y) * wp.float64(factored[i, row, first + column / LANES][column % LANES])
    if l == rigid.count[w]:
        rigid.direction[w, j] = value
        return
    if l == j:
        rigid.pivot_min[w, j] = wp.max(rigid.pivot_floor[w, j], CONDENSED_ROUNDING * rigid.matrix[w, j, j])
    rigid.matrix[w, j, l] = value


condense = kernel_over(condensed_entry, "condense", "w", "j", "l")


@wp.func
def factor_rigid(
    matrix: wp.array3d[wp.float64], pivot_min: wp.array2d[wp.float64], w: int, n: int, member: int, team: int
):
    """Replace the matrix of a world by its lower Cholesky factor; a team shares the rows below the pivot.

    A pivot is raised to ``pivot_min`` where it is below, and as far as the column under it needs to stay within what
    the diagonal allows, so that an indefinite matrix has no huge factors, after the modified Cholesky factorisation of
    Gill and Murray 1974 (doi:10.1007/BF01585529). Ends with a barrier.
    """
    for a in range(n):
        pivot = matrix[w, a, a]
        for s in range(a):
            pivot -= matrix[w, a, s] * matrix[w, a, s]
        for b in range(a + 1 + member, n, team):
            value = matrix[w, b, a]
            for s in range(a):
                value -= matrix[w, b, s] * matrix[w, a, s]
            matrix[w, b, a] = value
        barrier()
        pivot = wp.max(pivot, pivot_min[w, a])
        for b in range(a + 1, n):
            pivot = wp.max(pivot, matrix[w, b, a] * matrix[w, b, a] / wp.max(matrix[w, b, b], pivot_min[w, b]))
        pivot = wp.sqrt(pivot)
        barrier()
        if member == 0:
            matrix[w, a, a] = pivot
        for b in range(a + 1 + member, n, team):
            matrix[w, b, a] = matrix[w, b, a] / pivot
        barrier()


@wp.kernel
def bound_pivots(
    team: int,
    # In and out:
    rigid: Rigid,
):
    """Compute the pivots of M_eff / dt^2, the least that those of the condensed matrix can be.

    The condensed matrix is the inertia plus something positive semidefinite, so its pivots, the reciprocals of the last
    diagonal entries of the leading blocks' inverses, are not smaller.
    """
    w, member = wp.tid()
    n = rigid.count[w]
    for a in range(member, n, team):
        rigid.pivot_floor[w, a] = wp.float64(1.0e-12) * rigid.inertia[w, a, a]
        for b in range(a + 1):
            rigid.matrix[w, a, b] = rigid.inertia[w, a, b]
    barrier()
    factor_rigid(rigid.matrix, rigid.pivot_floor, w, n, member, team)
    for a in range(member, n, team):
        rigid.pivot_floor[w, a] = rigid.matrix[w, a, a] * rigid.matrix[w, a, a]


@wp.func
def solve_rigid_team(
    active: wp.array[int],
    team: int,
    # In and out: ``matrix`` and ``direction`` are overwritten by the factor and the solution
    rigid: Rigid,
    w: int,
    member: int,
):
    """Solve S x = s by Cholesky. Pivots that rounding put below those of the inertia are raised to them."""
    if active[w] == 0:
        return
    n = rigid.count[w]
    factor_rigid(rigid.matrix, rigid.pivot_min, w, n, member, team)
    if member != 0:
        return
    for a in range(n):
        value = rigid.direction[w, a]
        for s in range(a):
            value -= rigid.matrix[w, a, s] * rigid.direction[w, s]
        rigid.direction[w, a] = value / rigid.matrix[w, a, a]
    for reverse in range(n):
        a = n - 1 - reverse
        value = rigid.direction[w, a]
        for s in range(a + 1, n):
            value -= rigid.matrix[w, s, a] * rigid.direction[w, s]
        rigid.direction[w, a] = value / rigid.matrix[w, a, a]


solve_rigid = kernel_over(solve_rigid_team, "solve_rigid", "w", "member")


@wp.kernel
def relate_pairs(
    instances: Instances,
    state: NewtonState,
    constraints: PointConstraints,
    # Out:
    relation: wp.array3d[int],  # (world_count, part_count, part_count)
):
    """Say which bodies of a world touch each other."""
    w, part = wp.tid()
    for other in range(relation.shape[2]):
        relation[w, part, other] = 0
    i = state.instance_start[w] + part
    if i >= state.instance_start[w + 1]:
        return
    relation[w, part, part] = 1
    for e in range(constraints.count[i] - constraints.pair_count[i], constraints.count[i]):
        j = constraints.partner[i, e]
        if j >= 0:
            relation[w, part, j - state.instance_start[w]] = 1


@wp.kernel
def place_parts(
    instances: Instances,
    state: NewtonState,
    place: wp.array2d[int],  # (world_count, part_count)
    part_blocks: int,
):
    """Say where each body stands in the system of its world: writes ``instances.system_block``."""
    i = wp.tid()
    w = instances.world[i]
    instances.system_block[i] = part_blocks * place[w, i - state.instance_start[w]]


@wp.kernel
def assemble_pairs(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    state: NewtonState,
    relation: wp.array3d[int],  # (world_count, part_count, part_count), its fill included
    # In and out:
    matrix: wp.array3d[vec8],  # (world_count, N, ...), upper triangle
):
    """Fill the 8x8 blocks between two bodies of a world, -sum_e b_i^T H b_j; zero where only the elimination fills."""
    w, both, task = wp.tid()
    part_count = relation.shape[1]
    part = both / part_count
    other = both % part_count
    if state.active[w] == 0 or other == part or relation[w, part, other] == 0:
        return
    i = state.instance_start[w] + part
    j = state.instance_start[w] + other
    if instances.system_block[i] > instances.system_block[j]:
        return
    block_count = basis.row.shape[1]
    pair = task / (block_count * block_count)
    c = pair / 3
    d = pair % 3
    rows = (task / block_count) % block_count
    columns = task % block_count
    a0 = vec8()
    a1 = vec8()
    a2 = vec8()
    a3 = vec8()
    a4 = vec8()
    a5 = vec8()
    a6 = vec8()
    a7 = vec8()
    for e in range(constraints.count[i] - constraints.pair_count[i], constraints.count[i]):
        if constraints.partner[i, e] == j:
            b = free_part(basis.row[constraints.row[i, e], rows], instances.driven_count[i] - LANES * rows)
            v = free_part(
                basis.row[constraints.partner_row[i, e], columns], instances.driven_count[j] - LANES * columns
            )
            v = constraints.hessian[i, e][c, d] * v
            a0 = a0 - b[0] * v
            a1 = a1 - b[1] * v
            a2 = a2 - b[2] * v
            a3 = a3 - b[3] * v
            a4 = a4 - b[4] * v
            a5 = a5 - b[5] * v
            a6 = a6 - b[6] * v
            a7 = a7 - b[7] * v
    row = LANES * (instances.system_block[i] + c * block_count + rows)
    column = instances.system_block[j] + d * block_count + columns
    matrix[w, row, column] = a0
    matrix[w, row + 1, column] = a1
    matrix[w, row + 2, column] = a2
    matrix[w, row + 3, column] = a3
    matrix[w, row + 4, column] = a4
    matrix[w, row + 5, column] = a5
    matrix[w, row + 6, column] = a6
    matrix[w, row + 7, column] = a7


@wp.kernel
def read_direction(
    instances: Instances,
    solution: wp.array2d[vec8],  # (system_count, N / 8)
    # Out:
    direction_out: wp.array2d[vec8],  # (instance_count, 3 block_count)
):
    """Take each body's part out of the solution of its system."""
    i, e = wp.tid()
    direction_out[i, e] = solution[instances.system[i], instances.system_block[i] + e]
