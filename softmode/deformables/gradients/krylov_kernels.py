"""Device side of GMRES: one linear system per instance, a team of threads on each, preconditioned in float32.

Vectors have the layout of the solver's unknowns, (instance_count, 3 block_count) blocks of eight. Saad and Schultz
1986, doi:10.1137/0907058, right-preconditioned and restarted; each system stops by itself, so that a batch gives what
single systems give.
"""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import LANES, barrier, free_part, team_sum, vec8, vec8d
from softmode.deformables.model.newton_step_kernels import Systems
from softmode.deformables.model.struct_kernels import Instances
from softmode.deformables.system.factor_kernels import back_substitute

wp.set_module_options({"enable_backward": False})


@struct
class Krylov:
    """GMRES of every instance, shape (instance_count,) where not said."""

    active: wp.array[int]  # whether it is above its tolerance
    running: wp.array[int]  # whether its cycle goes on
    world_running: wp.array[int]  # (world_count,)
    any_running: wp.array[int]  # (1,)
    column: wp.array[int]
    target: wp.array[wp.float64]  # residual at which to stop
    error: wp.array[wp.float64]  # |b - H^T x| / |b|
    basis: wp.array3d[vec8d]  # (cycle_length + 1, instance_count, 3 block_count)
    triangle: wp.array3d[wp.float64]  # (instance_count, cycle_length, cycle_length)
    rotation: wp.array2d[wp.vec2d]  # (instance_count, cycle_length)
    tail: wp.array2d[wp.float64]  # (instance_count, cycle_length + 1), the rotated right-hand side
    search: wp.array2d[vec8d]  # M^-1 of the newest vector
    product: wp.array2d[vec8d]  # H^T of the search direction, or of the solution
    systems: Systems  # factored: M = U^T U is the solver's matrix
    work: wp.array2d[vec8]  # (instance_count, N / 8)
    rows: wp.array2d[float]  # (instance_count, N)


@wp.func
def precondition(k: Krylov, i: int, lane: int, team: int, size: wp.float64, right: wp.array2d[vec8d]):
    """Solve U^T U search = right in float32; ``size`` is the length of ``right``."""
    blocks = k.work.shape[1]
    scale = wp.float64(0.0)
    if size > wp.float64(0.0):
        scale = wp.float64(1.0) / size
    for l in range(lane, blocks, team):
        k.work[i, l] = vec8(scale * right[i, l])
    barrier()
    for block in range(blocks):
        first = LANES * block
        y = k.work[i, block]
        for a in range(8):
            d = k.systems.diagonal[i, first + a]
            value = y[a] * d[a]
            y[a] = value
            for b in range(8):
                if b > a:
                    y[b] -= value * d[b]
        if lane == 0:
            for a in range(8):
                k.rows[i, first + a] = y[a]
        for l in range(block + 1 + lane, blocks, team):
            rest = k.work[i, l]
            for a in range(8):
                rest = rest - y[a] * k.systems.matrix[i, first + a, l]
            k.work[i, l] = rest
        barrier()
    back_substitute(k.systems.matrix, k.systems.diagonal, k.systems.pattern, k.rows, k.work, i, lane, team)
    for l in range(lane, blocks, team):
        k.search[i, l] = size * vec8d(k.work[i, l])


@wp.kernel
def begin_cycle(
    instances: Instances,
    tolerance: wp.float64,
    first_cycle: int,
    team: int,
    right: wp.array2d[vec8d],  # b; its driven functions are left out
    # In and out:
    k: Krylov,
    # Out:
    solution: wp.array2d[vec8d],
):
    """Start a cycle at r = b - H^T x; instances that have reached the tolerance stop."""
    i, lane = wp.tid()
    total = solution.shape[1]
    stride = total / 3
    if first_cycle == 0 and k.active[i] == 0:
        return
    rho = wp.float64(0.0)
    for e in range(lane, total, team):
        r = free_part(right[i, e], instances.driven_count[i] - LANES * (e % stride))
        if first_cycle != 0:
            solution[i, e] = vec8d()
        else:
            r = r - k.product[i, e]
        k.basis[0, i, e] = r
        rho += wp.dot(r, r)
    rho = wp.sqrt(team_sum(rho))
    if first_cycle != 0 and lane == 0:
        k.target[i] = tolerance * rho
    barrier()
    on = int(0)
    if rho > k.target[i]:
        on = 1
    if lane == 0:
        k.active[i] = on
        k.running[i] = on
        k.error[i] = wp.float64(0.0)
        if rho > wp.float64(0.0):
            k.error[i] = tolerance * rho / k.target[i]
        k.column[i] = 0
        k.tail[i, 0] = rho
        if on != 0:
            wp.atomic_max(k.world_running, instances.world[i], 1)
            wp.atomic_max(k.any_running, 0, 1)
    if on == 0:
        return
    for e in range(lane, total, team):
        k.basis[0, i, e] = k.basis[0, i, e] / rho
    precondition(k, i, lane, team, wp.float64(1.0), k.basis[0])


@wp.kernel
def extend_cycle(
    instances: Instances,
    cycle_length: int,
    team: int,
    # In and out:
    k: Krylov,
    # Out:
    solution: wp.array2d[vec8d],
):
    """Add one Krylov vector (modified Gram-Schmidt, Givens rotations); at the end of a cycle update the solution."""
    i, lane = wp.tid()
    if k.running[i] == 0:
        return
    total = solution.shape[1]
    j = k.column[i]
    for e in range(lane, total, team):
        k.basis[j + 1, i, e] = k.product[i, e]
    for l in range(j + 1):
        h = wp.float64(0.0)
        for e in range(lane, total, team):
            h += wp.dot(k.basis[j + 1, i, e], k.basis[l, i, e])
        h = team_sum(h)
        for e in range(lane, total, team):
            k.basis[j + 1, i, e] = k.basis[j + 1, i, e] - h * k.basis[l, i, e]
        if lane == 0:
            k.triangle[i, l, j] = h
    size = wp.float64(0.0)
    for e in range(lane, total, team):
        size += wp.dot(k.basis[j + 1, i, e], k.basis[j + 1, i, e])
    size = wp.sqrt(team_sum(size))
    if lane == 0:
        for l in range(j):
            g = k.rotation[i, l]
            upper = k.triangle[i, l, j]
            lower = k.triangle[i, l + 1, j]
            k.triangle[i, l, j] = g[0] * upper + g[1] * lower
            k.triangle[i, l + 1, j] = g[0] * lower - g[1] * upper
        pivot = k.triangle[i, j, j]
        radius = wp.sqrt(pivot * pivot + size * size)
        turn = wp.vec2d(wp.float64(1.0), wp.float64(0.0))
        if radius > wp.float64(0.0):
            turn = wp.vec2d(pivot / radius, size / radius)
        k.rotation[i, j] = turn
        k.triangle[i, j, j] = radius
        k.tail[i, j + 1] = -turn[1] * k.tail[i, j]
        k.tail[i, j] = turn[0] * k.tail[i, j]
    barrier()
    if wp.abs(k.tail[i, j + 1]) > k.target[i] and j + 1 < cycle_length and size > wp.float64(0.0):
        for e in range(lane, total, team):
            k.basis[j + 1, i, e] = k.basis[j + 1, i, e] / size
        precondition(k, i, lane, team, wp.float64(1.0), k.basis[j + 1])
        if lane == 0:
            k.column[i] = j + 1
            wp.atomic_max(k.world_running, instances.world[i], 1)
            wp.atomic_max(k.any_running, 0, 1)
        return
    if lane == 0:
        k.running[i] = 0
        for reverse in range(j + 1):
            l = j - reverse
            value = k.tail[i, l]
            for s in range(l + 1, j + 1):
                value -= k.triangle[i, l, s] * k.tail[i, s]
            if k.triangle[i, l, l] != wp.float64(0.0):
                value = value / k.triangle[i, l, l]
            k.tail[i, l] = value
    barrier()
    size = wp.float64(0.0)
    for e in range(lane, total, team):
        combined = vec8d()
        for l in range(j + 1):
            combined = combined + k.tail[i, l] * k.basis[l, i, e]
        k.basis[0, i, e] = combined
        size += wp.dot(combined, combined)
    size = wp.sqrt(team_sum(size))
    precondition(k, i, lane, team, size, k.basis[0])
    for e in range(lane, total, team):
        solution[i, e] = solution[i, e] + k.search[i, e]
