"""Device side of Newton's iteration in one launch: a team of threads takes a world through all of its iterations.

The same functions as in the launches of :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, one after
another with barriers between. A launch per phase waits for the world that needs most iterations, and each of its phases
for its own slowest world; here a world that is done makes room for the next one.
"""

from functools import cache
from typing import Any

import warp as wp

from softmode.deformables.model.declare import Kernel
from softmode.deformables.model.lane_kernels import LANES, WARP, barrier, copy_blocks, here, rolled, vec8
from softmode.deformables.model.newton_step_kernels import ALL, NewtonStep
from softmode.deformables.model.struct_kernels import instance_end
from softmode.deformables.newton.search_kernels import (
    accept_step,
    check_convergence,
    check_trial,
    move_functions,
    start_line_search,
    world_potential,
)
from softmode.deformables.potential.constraint_cpu_kernels import evaluate_constraints_of
from softmode.deformables.potential.evaluate_kernels import (
    evaluate_constraint,
    evaluate_point,
    gradient_block,
    gradient_number,
    list_acting,
    sum_force_block,
)
from softmode.deformables.potential.point_cpu_kernels import differentiate_eight, evaluate_eight
from softmode.deformables.potential.rigid_row_kernels import evaluate_row
from softmode.deformables.system.assembly_cpu_kernels import (
    columns_of,
    condense_world,
    forces_of,
    matrix_of,
    rigid_of,
    stiffness_of,
)
from softmode.deformables.system.assembly_kernels import (
    column_block,
    condensed_entry,
    contact_block,
    direction_entry,
    inertia_of,
    matrix_row,
    pair_block,
    rigid_entry,
    solve_rigid_team,
    stiffness_block,
)
from softmode.deformables.system.factor_kernels import factor_system, solve_system
from softmode.deformables.system.shared_system_kernels import dynamic_floats, shared_direction_of, sum_forces_of

wp.set_module_options({"enable_backward": False})

SMALL_TEAM = 96
"""Threads that share a world on CUDA where the points are few and the worlds many,"""
LARGE_TEAM = 256
"""where every world has a multiprocessor to itself,"""
TEAM = 128
"""and elsewhere. All are measured, see ``benchmarks/JOURNAL.md``."""
TAIL_TEAM = 192
"""Threads that share a world of few points where rounds of launches take most worlds to their end."""
FEW_POINTS = 128
"""Most points that count as few."""
THREADS = 384
"""Threads that a multiprocessor takes at a time: what registers are given out for."""


def team_of(point_count: int, world_count: int, device: wp.Device) -> int:
    """Return how many threads share a world on a device."""
    if device.is_cpu:
        return 1
    if world_count <= device.sm_count:
        return LARGE_TEAM
    many = world_count > held_at_a_time(TEAM, device)
    return SMALL_TEAM if point_count <= FEW_POINTS and many else TEAM


def held_at_a_time(team: int, device: wp.Device) -> int:
    """Return how many worlds a device takes at a time through Newton's iteration in one launch."""
    return THREADS // team * device.sm_count if device.is_cuda else 1


@cache
def newton_kernel(unit_type: Any, size: int = 0, width: int = 0, *, team: int = TEAM, joined: bool = False) -> Kernel:
    """Return the kernel that minimises the incremental potential of every world by Newton with a line search.

    Args:
        unit_type: What the factorisation takes at a time, ``float`` or, on CPU, ``vec8``; there points too are
            evaluated eight at a time.
        size: Unknowns of the systems that are solved in shared memory, one per world; 0 for any in global memory.
        width: Columns of those systems.
        team: Threads that share a world.
        joined: Whether the bodies of a world, which may touch each other, share a system.
    """
    shared, dynamic, lanes = size > 0, dynamic_floats(size, width), unit_type == vec8
    shared_direction = shared_direction_of(size or 24, width or 32)  # called where ``shared`` says so

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(team, THREADS // team))
    def minimise_worlds(
        step: NewtonStep,
        unit: wp.array3d[unit_type],  # the systems in units of ``factor_width`` columns
        team: int,
        relation: wp.array3d[int],  # (system_count, part_count, part_count), which bodies of a system touch
        only_aside: int,  # whether only the worlds take part that go beside the rounds of launches
    ):
        """Minimise the incremental potential of every world by Newton with a line search."""
        w, member = wp.tid()
        if wp.static(dynamic > 0):
            _room = wp.tile_empty(shape=wp.static(dynamic), dtype=float, storage="shared")
        if only_aside != 0 and step.state.aside[w] == 0:
            return
        begin = step.state.instance_start[w]
        end = instance_end(step.instances, step.state.instance_start, w)
        blocks = step.basis.row.shape[1]
        n = step.rigid.count[w]
        tasks = 3 * blocks * blocks + 3 * (blocks * blocks + blocks) / 2
        chunks = step.arrays.gradient_chunk.shape[1]
        parts = chunks
        if wp.static(shared):
            parts = wp.max(team / WARP, 1)
        stiffness_chunks = step.arrays.stiffness.shape[1]
        rigid_max = step.options.rigid_max
        columns = rigid_max + 1
        q = step.arrays.q_trial
        r = step.rigid.trial
        trial = step.state.searching[w]
        while step.state.active[w] != 0:
            w = here(w)
            member = here(member)
            begin = here(begin)
            end = here(end)
            if trial == 0:
                for i in range(begin, end):
                    copy_blocks(step.arrays.q, q, i, member, team)
                for j in range(member, n, team):
                    rolled()
                    r[w, j] = step.rigid.r[w, j]
                barrier()
            # one copy of this code serves iterates and trials
            found = ALL + trial
            for i in range(begin, end):
                if wp.static(lanes):
                    for t in range(member, (step.instances.point_count[i] + LANES - 1) / LANES, team):
                        evaluate_eight(step, step.state.active, q, found, i, t)
                    evaluate_constraints_of(step, step.state.active, q, r, 1 - trial, i)
                else:
                    # points and constraints at the same time, but not in one warp
                    points = step.instances.point_count[i]
                    first = points
                    if team > 1:
                        first = (points + WARP - 1) / WARP * WARP
                    for t in range(member, first + step.constraints.count[i], team):
                        if t < points:
                            evaluate_point(step, step.state.active, q, found, i, t)
                        if t >= first:
                            evaluate_constraint(step, step.state.active, q, r, 1 - trial, i, t - first)
            for k in range(member, step.rigid.row_count[w], team):
                evaluate_row(step, step.state.active, r, found, w, k)
            barrier()
            potential = world_potential(step, q, r, w, member, team)
            if trial == 0:
                for i in range(begin, end):
                    list_acting(step, team, i, member)
                barrier()
                for i in range(begin, end):
                    if wp.static(shared):
                        sum_forces_of(
                            step.instances, step.basis, step.points, step.constraints, step.arrays, i, member, team
                        )
                    elif wp.static(lanes):
                        forces_of(step, step.state.active, i)
                    else:
                        for t in range(member, chunks * blocks, team):
                            sum_force_block(step, step.state.active, i, t / blocks, t % blocks)
                    barrier()
                    if wp.static(lanes):
                        for e in range(member, 3 * blocks, team):
                            gradient_block(step, i, e)
                    else:
                        for k in range(member, 3 * LANES * blocks, team):
                            rolled()
                            gradient_number(step, parts, i, k)
                barrier()
                check_convergence(step, potential, team, w, member)
                barrier()
                if step.state.active[w] != 0:
                    for i in range(begin, end):
                        if step.state.refresh[w] != 0:
                            if wp.static(lanes):
                                for t in range(member, (step.instances.point_count[i] + LANES - 1) / LANES, team):
                                    differentiate_eight(step, i, t)
                                stiffness_of(step, i)
                            else:
                                for t in range(member, stiffness_chunks * tasks, team):
                                    stiffness_block(step, i, t / tasks, t % tasks)
                            barrier()
                        if wp.static(not shared):
                            if wp.static(lanes):
                                matrix_of(step, i)
                                columns_of(step, i)
                            else:
                                width = 3 * blocks
                                for t in range(member, LANES * width * width, team):
                                    matrix_row(step, width, i, t / width, t % width)
                                barrier()
                                for t in range(member, tasks, team):
                                    contact_block(step, i, t)
                                for t in range(member, 3 * blocks * columns, team):
                                    column_block(step, i, t / columns, t % columns)
                    if wp.static(joined):
                        for both in range(relation.shape[1] * relation.shape[1]):
                            if relation[w, both / relation.shape[1], both % relation.shape[1]] != 0:
                                for t in range(member, 9 * blocks * blocks, team):
                                    pair_block(step, relation, w, both, t)
                    if wp.static(shared):
                        # the padding behind the functions carries inertia alone
                        inertia = inertia_of(step.instances, step.motion, step.options.dt, begin)
                        shared_direction(
                            inertia,
                            rigid_max,
                            step.basis,
                            step.constraints,
                            step.rigid,
                            step.arrays,
                            begin,
                            w,
                            member,
                            team,
                        )
                    if wp.static(not shared):
                        if wp.static(lanes):
                            rigid_of(step, w)
                        else:
                            for t in range(member, n * n, team):
                                rigid_entry(step, w, t / n, t % n)
                        barrier()
                        for s in range(step.arrays.system_start[w], step.arrays.system_start[w + 1]):
                            factor_system(
                                step.state.active, team, step.options.factor_width, unit, step.arrays.systems, s, member
                            )
                        barrier()
                        if n > 0:
                            if wp.static(lanes):
                                condense_world(step, w)
                            else:
                                for t in range(member, n * (n + 1), team):
                                    condensed_entry(step, w, t / (n + 1), t % (n + 1))
                            barrier()
                            solve_rigid_team(step.state.active, team, step.rigid, w, member)
                            barrier()
                        for s in range(step.arrays.system_start[w], step.arrays.system_start[w + 1]):
                            solve_system(
                                step.state.active,
                                rigid_max,
                                team,
                                step.rigid.direction,
                                rigid_max,
                                step.arrays.systems,
                                s,
                                member,
                            )
                    if wp.static(joined):
                        for i in range(begin, end):
                            for e in range(member, 3 * blocks, team):
                                direction_entry(
                                    step.instances, step.arrays.systems.solution, step.arrays.direction, i, e
                                )
                    barrier()
                    start_line_search(step, team, w, member)
            else:
                check_trial(step, potential, w, member)
            barrier()
            if step.state.active[w] != 0:
                # one copy of this code serves trials and accepted steps
                trial = step.state.searching[w]
                alpha = step.state.step_length[w]
                if trial == 0:
                    accept_step(step, team, w, member)
                if alpha > wp.float64(0.0):
                    for i in range(begin, end):
                        move_functions(step.instances, step.basis, step.arrays, alpha, i, member, team, q)
                    for j in range(member, n, team):
                        rolled()
                        r[w, j] = step.rigid.r[w, j] + alpha * step.rigid.direction[w, j]
                barrier()
                if trial == 0 and alpha > wp.float64(0.0):
                    for i in range(begin, end):
                        copy_blocks(q, step.arrays.q, i, member, team)
                    for j in range(member, n, team):
                        rolled()
                        step.rigid.r[w, j] = r[w, j]
                    barrier()

    return minimise_worlds
