"""Device side of the batched block Cholesky factorisation and solve, on CPU and CUDA alike.

Each system is a dense symmetric positive definite matrix A (N x N) with M extra columns B appended: [A | B]. The
factorisation A = U^T U runs row block by row block and carries B along, so that it ends as [U | U^-T B]: the forward
substitution of every right-hand side, and the half of a Schur complement, come with it.

A system may be made of equal *parts*, the bodies of a world, most of which have nothing to do with each other: a
pattern says which blocks of parts are not zero, its fill included; the others are neither read nor written. The order
of the parts is chosen anew for each pattern, by least degree (:func:`order_parts`): half the work of a
fixed order for a heap of 13 bodies. Parts that do not exist come last and cost nothing.

Rows are stored as 8-wide vectors. Measured on one CPU core (112 x 256 x 112 product, AVX-512): arithmetic on
``wp.types.vector(length=8)`` or 16 reaches 50-150 Gflop/s where ``wp.tile_matmul`` reaches 9, because Warp's CPU tiles
are scalar loops. On CUDA a team of threads shares a system, each with columns of its own, in one launch: with eight
columns per thread instead one H200 needs ten times as long for a single system of 192 unknowns, twice for 4,096.
"""

from typing import Any

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import LANES, barrier, mat88, sum8, vec8
from softmode.deformables.model.newton_step_kernels import Systems

wp.set_module_options({"enable_backward": False})


@wp.func
def related(pattern: wp.array3d[int], i: int, part: int, other: int):
    """Return whether the block of two parts, or of a part and the right-hand columns behind them, is not zero."""
    return part == other or other >= pattern.shape[1] or pattern[i, part, other] != 0


@wp.func
def used_blocks(pattern: wp.array3d[int], i: int, block_count: int):
    """Return how many blocks of eight rows the parts that exist have: the first ones."""
    count = pattern.shape[1]
    used = int(0)
    for part in range(count):
        if pattern[i, part, part] != 0:
            used += block_count / count
    return used


@wp.func
def eight_of(entry: vec8):
    """Return room for eight rows of an entry that is a block of eight columns."""
    return mat88()


@wp.func
def eight_of(entry: float):  # pyright: ignore[reportRedeclaration]  # noqa: F811
    """Return room for eight rows of an entry that is a number."""
    return vec8()


@wp.func
def factor_system(
    active: wp.array[int],  # (world_count,)
    team: int,
    width: int,
    # In and out, the same memory as ``matrix`` in units of ``width`` = 8 (vec8) or 1 (float) columns:
    unit: wp.array3d[Any],  # (system_count, N, (N + M) / width)
    systems: Systems,
    i: int,
    member: int,
):
    """Factor row block by row block: subtract what is above (left-looking), then solve with the diagonal block."""
    if active[systems.world[i]] == 0:
        return
    matrix = systems.matrix
    pattern = systems.pattern
    block_count = systems.solution.shape[1]
    part_blocks = block_count / pattern.shape[1]
    total = unit.shape[2]
    indefinite = int(0)
    for block in range(used_blocks(pattern, i, block_count)):
        first = LANES * block
        part = block / part_blocks
        for l in range(first / width + member, total, team):
            other = width * l / (LANES * part_blocks)
            if not related(pattern, i, part, other):
                continue
            r = eight_of(unit[i, first, l])
            for a in range(LANES):
                r[a] = unit[i, first + a, l]
            # one flat loop: inside a second one the sums do not stay in registers, and cost seven times as much on CPU
            above = int(0)
            while above < block:
                before = above / part_blocks
                if not (related(pattern, i, before, part) and related(pattern, i, before, other)):
                    above = part_blocks * (before + 1)
                    continue
                for a in range(LANES):
                    s = LANES * above + a
                    u = matrix[i, s, block]
                    v = unit[i, s, l]
                    for b in range(LANES):
                        r[b] = r[b] - u[b] * v
                above += 1
            for a in range(LANES):
                unit[i, first + a, l] = r[a]
        barrier()
        # every thread factors its own copy of the diagonal block (inverse pivots): cheaper than waiting for one
        U = mat88()
        bounds = systems.bounds[i, block]
        for a in range(8):
            row = matrix[i, first + a, block]
            floor = wp.max(1.0e-6 * wp.abs(row[a]), 1.0e-30)
            least = wp.where(bounds[1] > 0.0, -bounds[1], floor)
            floor = wp.max(floor, bounds[0])
            for s in range(a):
                factor = U[s, a]
                for b in range(8):
                    row[b] -= factor * U[s, b]
            if not (row[a] >= least):
                indefinite = 1
            inverse = 1.0 / wp.sqrt(wp.max(row[a], floor))
            for b in range(8):
                U[a, b] = inverse * row[b]
            U[a, a] = inverse
            if member == 0:
                diagonal = vec8()
                for b in range(8):
                    diagonal[b] = U[a, b]
                systems.diagonal[i, first + a] = diagonal
        for l in range((first + LANES) / width + member, total, team):
            if not related(pattern, i, part, width * l / (LANES * part_blocks)):
                continue
            x = eight_of(unit[i, first, l])
            for a in range(LANES):
                value = unit[i, first + a, l]
                for b in range(a):
                    value = value - U[b, a] * x[b]
                x[a] = U[a, a] * value
                unit[i, first + a, l] = x[a]
        barrier()
    if member == 0:
        systems.indefinite[i] = indefinite


factor = kernel_over(factor_system, "factor", "i", "member")


@wp.func
def back_substitute(
    matrix: wp.array3d[vec8],
    diagonal: wp.array2d[vec8],
    pattern: wp.array3d[int],
    right: wp.array2d[float],
    solution: wp.array2d[vec8],
    i: int,
    member: int,
    team: int,
):
    """Solve U x = right of system i from the last row up; overwrites ``right`` and ends with a barrier."""
    block_count = solution.shape[1]
    part_blocks = block_count / pattern.shape[1]
    used = used_blocks(pattern, i, block_count)
    for step in range(used):
        block = used - 1 - step
        first = LANES * block
        x = vec8()
        for reverse in range(8):
            a = 7 - reverse
            value = right[i, first + a]
            d = diagonal[i, first + a]
            for b in range(8):
                if b > a:
                    value -= d[b] * x[b]
            x[a] = value * d[a]
        if member == 0:
            solution[i, block] = x
        for row in range(member, first, team):
            if related(pattern, i, row / (LANES * part_blocks), block / part_blocks):
                right[i, row] = right[i, row] - sum8(wp.cw_mul(matrix[i, row, block], x))
        barrier()


@wp.func
def solve_system(
    active: wp.array[int],
    column: int,
    team: int,
    tail: wp.array2d[wp.float64],  # (world_count, ...): unknowns already known
    tail_count: int,
    # In and out:
    systems: Systems,
    i: int,
    member: int,
):
    """Solve U x = y - Y t from the last row up; y is right-hand column ``column``, Y the ``tail_count`` first ones."""
    world = systems.world[i]
    if active[world] == 0:
        return
    block_count = systems.solution.shape[1]
    for row in range(member, LANES * used_blocks(systems.pattern, i, block_count), team):
        value = systems.matrix[i, row, block_count + column / 8][column % 8]
        for j in range(tail_count):
            value -= systems.matrix[i, row, block_count + j / 8][j % 8] * float(tail[world, j])
        systems.right[i, row] = value
    barrier()
    back_substitute(systems.matrix, systems.diagonal, systems.pattern, systems.right, systems.solution, i, member, team)


solve = kernel_over(solve_system, "solve", "i", "member")


@wp.kernel
def order_parts(
    # In and out:
    relation: wp.array3d[int],  # (system_count, part_count, part_count), symmetric
    # Out:
    place: wp.array2d[int],  # (system_count, part_count)
    pattern: wp.array3d[int],  # (system_count, part_count, part_count), upper triangle
):
    """Eliminate the part with the fewest relations, the first of them, until none is left.

    What is related to it becomes related to each other: the fill. Parts that do not exist come last.
    """
    i = wp.tid()
    count = pattern.shape[1]
    for part in range(count):
        place[i, part] = -1
    for step in range(count):
        best = int(-1)
        least = 2 * count
        for part in range(count):
            if place[i, part] < 0:
                degree = wp.where(relation[i, part, part] != 0, 0, count)
                for other in range(count):
                    if place[i, other] < 0 and other != part and relation[i, part, other] != 0:
                        degree += 1
                if degree < least:
                    least = degree
                    best = part
        place[i, best] = step
        for part in range(count):
            if place[i, part] < 0 and relation[i, best, part] != 0:
                for other in range(count):
                    if place[i, other] < 0 and relation[i, best, other] != 0:
                        relation[i, part, other] = 1
    for part in range(count):
        pattern[i, place[i, part], place[i, part]] = relation[i, part, part]
        for other in range(count):
            if place[i, part] < place[i, other]:
                pattern[i, place[i, part], place[i, other]] = relation[i, part, other]
