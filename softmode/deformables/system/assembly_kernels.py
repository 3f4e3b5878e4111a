"""Device side of the linear system: [K | C | -g] of every body, the rigid part, and its condensation.

Unknowns of one instance are ordered component-major in blocks of eight, see ``tables``.
"""

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import LANES, barrier, free_part, mat88, vec8
from softmode.deformables.model.newton_step_kernels import NewtonStep, add_outer
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    Rigid,
    exists,
    first_coupled,
)
from softmode.deformables.system.factor_kernels import used_blocks

wp.set_module_options({"enable_backward": False})

CONDENSED_ROUNDING = wp.constant(wp.float64(1.0e-6))
"""Rounding of a condensed diagonal entry as a fraction of the entry before: the bodies are factored in float32."""


@wp.func
def block_pair(pair: int):
    """Return the components (c, d) of the six blocks 00, 01, 02, 11, 12, 22."""
    c = wp.where(pair < 3, 0, wp.where(pair < 5, 1, 2))
    return c, pair - c * (5 - c) / 2


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
def left_out(instances: Instances, pattern: wp.array3d[int], i: int):
    """Return whether an instance has no place in the system of its world: it is none, and others share the system."""
    return not exists(instances, i) and pattern.shape[1] > 1


@wp.func
def stiffness_block(step: NewtonStep, i: int, chunk: int, task: int):
    """Assemble 8x8 blocks of sum_p grad b^T C grad b over one chunk of the points."""
    if step.state.active[step.instances.world[i]] == 0 or step.state.refresh[step.instances.world[i]] == 0:
        return
    if not exists(step.instances, i):
        return
    block_count = step.basis.row.shape[1]
    chunk_count = step.arrays.stiffness.shape[1]
    pair, rows, columns = block_task(task, block_count)
    c, d = block_pair(pair)
    block = mat88()
    first = step.instances.point_start[i]
    count = step.instances.point_count[i]
    n = step.instances.function_count[i]
    if LANES * rows < n and LANES * columns < n:
        for p in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
            C = step.points.hessian[i, pair, p]
            gx = step.basis.gradient_across[columns, first + p, 0]
            gy = step.basis.gradient_across[columns, first + p, 1]
            gz = step.basis.gradient_across[columns, first + p, 2]
            for k in range(3):
                u = C[k, 0] * gx + C[k, 1] * gy + C[k, 2] * gz
                block = add_outer(block, step.basis.gradient_across[rows, first + p, k], u)
    row = LANES * (c * block_count + rows)
    column = d * block_count + columns
    for a in range(LANES):
        step.arrays.stiffness[i, chunk, row + a, column] = block[a]


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
    block = mat88()
    for e in range(instances.pin_start[i], instances.pin_start[i] + instances.pin_count[i]):
        b = wp.max(pin_stiffness[e], 0.0) * basis.row[first_row + e, rows]
        v = basis.row[first_row + e, columns]
        block = add_outer(block, b, v)
    for a in range(LANES):
        pins_out[i, LANES * rows + a, columns] = block[a]


@wp.func
def inertia_of(instances: Instances, motion: Motion, dt: wp.float64, i: int):
    """Return m c/dt (c/dt + alpha) of an instance [N/m], what inertia and mass damping add to the diagonal."""
    rate = motion.rate[i] / dt
    return float(instances.mass[i] * rate * (rate + wp.float64(instances.mass_damping[i])))


@wp.func
def matrix_row(step: NewtonStep, team: int, i: int, row: int, member: int):
    """Add inertia and pins to the stiffness; driven unknowns stay put."""
    if step.state.active[step.instances.world[i]] == 0 or left_out(step.instances, step.arrays.systems.pattern, i):
        return
    block_count = step.basis.row.shape[1]
    c = row / (LANES * block_count)
    k = row % (LANES * block_count)
    driven = step.instances.driven_count[i]
    first = step.instances.system_block[i]
    for column in range(member, 3 * block_count, team):
        d = column / block_count
        columns = column % block_count
        if LANES * column + 7 >= row:
            value = step.arrays.stiffness[i, 0, row, column]
            for chunk in range(1, step.arrays.stiffness.shape[1]):
                value = value + step.arrays.stiffness[i, chunk, row, column]
            if c == d and step.instances.pin_count[i] > 0:
                value = value + step.arrays.pins[i, k, columns]
            value = free_part(value, wp.where(k < driven, LANES, driven - LANES * columns))
            if row / LANES == column:
                # the padding behind the functions carries inertia alone
                inertia = inertia_of(step.instances, step.motion, step.options.dt, i)
                for lane in range(LANES):
                    if lane == row % LANES:
                        value[lane] = value[lane] + inertia
            step.arrays.systems.matrix[step.instances.system[i], LANES * first + row, first + column] = value


assemble_matrix = kernel_over(matrix_row, "assemble_matrix", "i", "row", "member")


@wp.func
def contact_block(step: NewtonStep, i: int, task: int):
    """Add the contacts, sum_e b^T H b, to 8x8 blocks; driven unknowns stay put."""
    pins = step.instances.pin_count[i]
    count = step.constraints.acting_count[i]
    if step.state.active[step.instances.world[i]] == 0 or count == pins:
        return
    block_count = step.basis.row.shape[1]
    pair, rows, columns = block_task(task, block_count)
    c, d = block_pair(pair)
    driven = step.instances.driven_count[i]
    block = mat88()
    for k in range(pins, count):
        e = step.constraints.acting[i, k]
        r = step.constraints.row[i, e]
        b = free_part(step.basis.row[r, rows], driven - LANES * rows)
        v = step.constraints.hessian[i, e][c, d] * free_part(step.basis.row[r, columns], driven - LANES * columns)
        block = add_outer(block, b, v)
    first = step.instances.system_block[i]
    row = LANES * (first + c * block_count + rows)
    column = first + d * block_count + columns
    matrix = step.arrays.systems.matrix
    i = step.instances.system[i]
    for a in range(LANES):
        matrix[i, row + a, column] = matrix[i, row + a, column] + block[a]


add_contacts = kernel_over(contact_block, "add_contacts", "i", "task")


@wp.func
def column_block(step: NewtonStep, i: int, rows: int, j: int):
    """Fill the columns right of K: d2E/dq dr = -sum_e b_k H_e J_e, and -g in column rigid_max."""
    if step.state.active[step.instances.world[i]] == 0 or left_out(step.instances, step.arrays.systems.pattern, i):
        return
    block_count = step.basis.row.shape[1]
    c = rows / block_count
    b = rows % block_count
    value = vec8()
    if j == step.options.rigid_max:
        value = vec8(-step.arrays.gradient[i, rows])
    elif j < step.rigid.count[step.instances.world[i]]:
        for k in range(first_coupled(step.instances, i), step.constraints.acting_count[i]):
            e = step.constraints.acting[i, k]
            if j < step.constraints.dof_begin[i, e] or j >= step.constraints.dof_end[i, e]:
                continue
            value = value - step.constraints.coupling[i, e, j][c] * step.basis.row[step.constraints.row[i, e], b]
        value = free_part(value, step.instances.driven_count[i] - LANES * b)
    for a in range(LANES):
        row = LANES * (step.instances.system_block[i] + rows) + a
        step.arrays.systems.scalars[step.instances.system[i], row, step.arrays.systems.matrix.shape[1] + j] = value[a]


assemble_columns = kernel_over(column_block, "assemble_columns", "i", "rows", "j")


@wp.func
def rigid_entry(step: NewtonStep, w: int, j: int, l: int):
    """Compute gradient and Hessian of the rigid dofs: M_eff/dt^2 (r - r_predicted) + sum_e J_e^T f_e, and the rows."""
    if step.state.active[w] == 0 or j >= step.rigid.count[w] or l > j:
        return
    first = step.state.instance_start[w]
    end = step.state.instance_start[w + 1]
    h = step.rigid.inertia[w, j, l]
    for i in range(first, end):
        for m in range(first_coupled(step.instances, i), step.constraints.acting_count[i]):
            e = step.constraints.acting[i, m]
            if l >= step.constraints.dof_begin[i, e] and j < step.constraints.dof_end[i, e]:
                h += wp.float64(wp.dot(step.constraints.jacobian[i, e, j], step.constraints.coupling[i, e, l]))
    for k in range(step.rigid.row_count[w]):
        h += wp.float64(step.rigid.row_jacobian[w, k, j]) * step.rigid.row_coupling[w, k, l]
    step.rigid.matrix[w, j, l] = h
    step.rigid.matrix[w, l, j] = h
    if l == 0:
        g = wp.float64(0.0)
        for k in range(step.rigid.count[w]):
            g += step.rigid.inertia[w, j, k] * (step.rigid.r[w, k] - step.rigid.predicted[w, k])
        for i in range(first, end):
            for m in range(first_coupled(step.instances, i), step.constraints.acting_count[i]):
                e = step.constraints.acting[i, m]
                if j >= step.constraints.dof_begin[i, e] and j < step.constraints.dof_end[i, e]:
                    g += wp.dot(wp.vec3d(step.constraints.jacobian[i, e, j]), step.constraints.force[i, e])
        for k in range(step.rigid.row_count[w]):
            g += wp.float64(step.rigid.row_jacobian[w, k, j]) * step.rigid.row_force[w, k]
        step.rigid.gradient[w, j] = g


assemble_rigid = kernel_over(rigid_entry, "assemble_rigid", "w", "j", "l")


@wp.func
def condensed_entry(step: NewtonStep, w: int, j: int, l: int):
    """Subtract the bodies: S = R - sum_i Y_i^T Y_i and s = -g_r - sum_i Y_i^T y_i."""
    # column l = rigid_count is the right-hand side; of the matrix only the lower triangle is read
    if (
        step.state.active[w] == 0
        or j >= step.rigid.count[w]
        or l > step.rigid.count[w]
        or (l > j and l < step.rigid.count[w])
    ):
        return
    factored = step.arrays.systems.matrix
    first = factored.shape[1] / LANES
    column = l
    value = -step.rigid.gradient[w, j]
    if l == step.rigid.count[w]:
        column = step.options.rigid_max
    else:
        value = step.rigid.matrix[w, j, l]
    for i in range(step.arrays.system_start[w], step.arrays.system_start[w + 1]):
        for row in range(LANES * used_blocks(step.arrays.systems.pattern, i, first)):
            y = factored[i, row, first + j / LANES][j % LANES]
            value -= wp.float64(y) * wp.float64(factored[i, row, first + column / LANES][column % LANES])
    if l == step.rigid.count[w]:
        step.rigid.direction[w, j] = value
        return
    if l == j:
        step.rigid.pivot_min[w, j] = wp.max(
            step.rigid.pivot_floor[w, j], CONDENSED_ROUNDING * step.rigid.matrix[w, j, j]
        )
    step.rigid.matrix[w, j, l] = value


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
    step: NewtonStep,
    # Out:
    relation: wp.array3d[int],  # (world_count, part_count, part_count)
):
    """Say which bodies of a world touch each other."""
    w, part = wp.tid()
    for other in range(relation.shape[2]):
        relation[w, part, other] = 0
    i = step.state.instance_start[w] + part
    if i >= step.state.instance_start[w + 1]:
        return
    relation[w, part, part] = wp.where(exists(step.instances, i), 1, 0)
    for e in range(step.constraints.count[i] - step.constraints.pair_count[i], step.constraints.count[i]):
        j = step.constraints.partner[i, e]
        if j >= 0:
            relation[w, part, j - step.state.instance_start[w]] = 1


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


@wp.func
def pair_block(
    step: NewtonStep,
    relation: wp.array3d[int],  # (world_count, part_count, part_count), its fill included
    w: int,
    both: int,
    task: int,
):
    """Fill the 8x8 blocks between two bodies of a world, -sum_e b_i^T H b_j; zero where only the elimination fills."""
    part_count = relation.shape[1]
    part = both / part_count
    other = both % part_count
    if step.state.active[w] == 0 or other == part or relation[w, part, other] == 0:
        return
    i = step.state.instance_start[w] + part
    j = step.state.instance_start[w] + other
    if step.instances.system_block[i] > step.instances.system_block[j]:
        return
    block_count = step.basis.row.shape[1]
    pair = task / (block_count * block_count)
    c = pair / 3
    d = pair % 3
    rows = (task / block_count) % block_count
    columns = task % block_count
    block = mat88()
    for e in range(step.constraints.count[i] - step.constraints.pair_count[i], step.constraints.count[i]):
        if step.constraints.partner[i, e] == j:
            b = free_part(
                step.basis.row[step.constraints.row[i, e], rows], step.instances.driven_count[i] - LANES * rows
            )
            v = free_part(
                step.basis.row[step.constraints.partner_row[i, e], columns],
                step.instances.driven_count[j] - LANES * columns,
            )
            v = step.constraints.hessian[i, e][c, d] * v
            block = add_outer(block, -b, v)
    row = LANES * (step.instances.system_block[i] + c * block_count + rows)
    column = step.instances.system_block[j] + d * block_count + columns
    for a in range(LANES):
        step.arrays.systems.matrix[w, row + a, column] = block[a]


assemble_pairs = kernel_over(pair_block, "assemble_pairs", "w", "both", "task")


@wp.func
def direction_entry(
    instances: Instances,
    solution: wp.array2d[vec8],  # (system_count, N / 8)
    # Out:
    direction_out: wp.array2d[vec8],  # (instance_count, 3 block_count)
    i: int,
    e: int,
):
    """Take each body's part out of the solution of its system."""
    if exists(instances, i):
        direction_out[i, e] = solution[instances.system[i], instances.system_block[i] + e]
    else:
        direction_out[i, e] = vec8()


read_direction = kernel_over(direction_entry, "read_direction", "i", "e")
