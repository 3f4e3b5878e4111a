"""Device side of Newton's iteration in one launch: a team of threads takes a world through all of its iterations.

The same functions as in the launches of :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, one after
another with barriers between. A launch per phase waits for the world that needs most iterations, and each of its phases
for its own slowest world; here a world that is done makes room for the next one.
"""

from typing import Any

import warp as wp

from softmode.deformables.contact.penalty_kernels import evaluate_constraint
from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import LANES, barrier, vec8, vec8d
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Rigid,
)
from softmode.deformables.solver.assembly_kernels import (
    column_block,
    condensed_entry,
    contact_block,
    matrix_row,
    rigid_entry,
    solve_rigid_team,
    stiffness_block,
)
from softmode.deformables.solver.factor_kernels import factor_system, solve_system
from softmode.deformables.solver.fused_system_kernels import shared_system, sum_forces_of
from softmode.deformables.solver.rigid_row_kernels import evaluate_row
from softmode.deformables.solver.search_kernels import accept_step, check_convergence, check_trial, start_line_search
from softmode.deformables.solver.step_kernels import evaluate_point, gradient_block, sum_force_block

wp.set_module_options({"enable_backward": False})

TEAM = 96
"""Threads that share a world on CUDA."""


@struct
class NewtonOptions:
    """How the iteration goes, see ``SolverReducedOptions``."""

    iteration_max: int
    force_tolerance: wp.float64
    stick_range: wp.float64  # [m]
    step_length_min: wp.float64
    refresh_interval: int
    refresh_distance: float
    rigid_max: int  # joint dofs that there is room for
    gradient_chunks: int
    stiffness_chunks: int
    shared: int  # 1 where every world has one system, which fits in shared memory
    factor_width: int  # columns that a thread of the factorisation takes at a time
    dt: wp.float64


@struct
class NewtonArrays:
    """What the phases hand on, see ``SolverReduced``."""

    q: wp.array2d[vec8d]
    q_trial: wp.array2d[vec8d]
    gradient: wp.array2d[vec8d]
    reaction: wp.array2d[vec8d]
    gradient_chunk: wp.array3d[vec8d]
    stiffness: wp.array4d[vec8]
    pins: wp.array3d[vec8]
    rigid_tolerance: wp.array[float]
    system_start: wp.array[int]
    system_world: wp.array[int]
    matrix: wp.array3d[vec8]
    scalars: wp.array3d[float]
    pattern: wp.array3d[int]
    diagonal: wp.array2d[vec8]
    indefinite: wp.array[int]
    right: wp.array2d[float]
    direction: wp.array2d[vec8]


@wp.kernel(launch_bounds=(TEAM, 4))
def minimise_worlds(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    points: Points,
    constraints: PointConstraints,
    rigid: Rigid,
    state: NewtonState,
    options: NewtonOptions,
    arrays: NewtonArrays,
    unit: wp.array3d[Any],  # the systems in units of ``factor_width`` columns
    team: int,
):
    """Minimise the incremental potential of every world by Newton with a line search."""
    w, member = wp.tid()
    dt = options.dt
    begin = state.instance_start[w]
    end = state.instance_start[w + 1]
    blocks = basis.row.shape[1]
    n = rigid.count[w]
    tasks = 3 * blocks * blocks + 3 * (blocks * blocks + blocks) / 2
    trial = int(0)
    while state.active[w] != 0:
        if trial == 0:
            for i in range(begin, end):
                for e in range(member, 3 * blocks, team):
                    arrays.q_trial[i, e] = arrays.q[i, e]
            for j in range(member, n, team):
                rigid.trial[w, j] = rigid.r[w, j]
            barrier()
        # one copy of this code serves iterates and trials
        for i in range(begin, end):
            for p in range(member, instances.point_count[i], team):
                evaluate_point(
                    instances, basis, motion, state.active, arrays.q_trial, dt, 1 - trial, state, points, i, p
                )
            for e in range(member, constraints.count[i], team):
                evaluate_constraint(
                    instances,
                    basis,
                    motion,
                    state,
                    rigid,
                    options.stick_range,
                    state.active,
                    arrays.q_trial,
                    rigid.trial,
                    1 - trial,
                    constraints,
                    i,
                    e,
                )
        for k in range(member, rigid.row_count[w], team):
            evaluate_row(state.active, rigid.trial, dt, 1 - trial, rigid, w, k)
        barrier()
        if trial == 0:
            for i in range(begin, end):
                if options.shared != 0:
                    sum_forces_of(
                        points.stress,
                        basis.gradient_across,
                        constraints.row,
                        constraints.force,
                        constraints.count[i],
                        basis.row,
                        instances.point_start[i],
                        instances.point_count[i],
                        arrays.gradient_chunk,
                        i,
                        member,
                        team,
                    )
                else:
                    for t in range(member, options.gradient_chunks * blocks, team):
                        sum_force_block(
                            instances,
                            basis,
                            points,
                            constraints,
                            state.active,
                            options.gradient_chunks,
                            arrays.gradient_chunk,
                            i,
                            t / blocks,
                            t % blocks,
                        )
                barrier()
                for e in range(member, 3 * blocks, team):
                    gradient_block(
                        instances,
                        basis,
                        motion,
                        state.active,
                        arrays.gradient_chunk,
                        arrays.q,
                        dt,
                        arrays.gradient,
                        arrays.reaction,
                        i,
                        e,
                    )
            barrier()
            check_convergence(
                instances,
                motion,
                points,
                constraints,
                rigid,
                team,
                options.iteration_max,
                options.force_tolerance,
                arrays.gradient,
                arrays.q,
                dt,
                state,
                w,
                member,
            )
            barrier()
            if state.active[w] != 0:
                for i in range(begin, end):
                    if state.refresh[w] != 0:
                        for t in range(member, options.stiffness_chunks * tasks, team):
                            stiffness_block(
                                instances,
                                basis,
                                points,
                                state.active,
                                state.refresh,
                                options.stiffness_chunks,
                                arrays.stiffness,
                                i,
                                t / tasks,
                                t % tasks,
                            )
                        barrier()
                    if options.shared == 0:
                        columns = 3 * blocks
                        for t in range(member, 3 * LANES * blocks * columns, team):
                            matrix_row(
                                instances,
                                basis,
                                motion,
                                state.active,
                                arrays.stiffness,
                                arrays.pins,
                                dt,
                                columns,
                                arrays.matrix,
                                i,
                                t / columns,
                                t % columns,
                            )
                        barrier()
                        for t in range(member, tasks, team):
                            contact_block(instances, basis, constraints, state.active, arrays.matrix, i, t)
                    for t in range(member, 3 * blocks * (options.rigid_max + 1), team):
                        column_block(
                            instances,
                            basis,
                            constraints,
                            state.active,
                            arrays.gradient,
                            rigid,
                            options.rigid_max,
                            LANES * arrays.direction.shape[1],
                            arrays.scalars,
                            i,
                            t / (options.rigid_max + 1),
                            t % (options.rigid_max + 1),
                        )
                for t in range(member, n * n, team):
                    rigid_entry(instances, constraints, state, rigid, w, t / n, t % n)
                barrier()
                inertia = float(0.0)
                if options.shared != 0:
                    # the padding behind the functions carries inertia alone
                    rate = motion.rate[begin] / dt
                    inertia = float(instances.mass[begin] * rate * (rate + wp.float64(instances.mass_damping[begin])))
                    shared_system(
                        0,
                        arrays.stiffness,
                        inertia,
                        constraints.row,
                        constraints.hessian,
                        constraints.count[begin],
                        basis.row,
                        arrays.scalars,
                        LANES * arrays.direction.shape[1],
                        arrays.scalars.shape[2],
                        arrays.indefinite,
                        options.rigid_max,
                        rigid.direction,
                        n,
                        arrays.direction,
                        arrays.system_start[w],
                        w,
                        member,
                        team,
                    )
                for s in range(arrays.system_start[w], arrays.system_start[w + 1 - options.shared]):
                    factor_system(
                        arrays.system_world,
                        state.active,
                        3 * blocks,
                        3 * blocks,
                        arrays.pattern,
                        team,
                        options.factor_width,
                        arrays.matrix,
                        unit,
                        arrays.diagonal,
                        arrays.indefinite,
                        s,
                        member,
                    )
                barrier()
                if n > 0:
                    for t in range(member, n * (n + 1), team):
                        condensed_entry(
                            state,
                            arrays.system_start,
                            options.rigid_max,
                            arrays.matrix,
                            rigid,
                            w,
                            t / (n + 1),
                            t % (n + 1),
                        )
                    barrier()
                    solve_rigid_team(state.active, team, rigid, w, member)
                    barrier()
                if options.shared != 0:
                    shared_system(
                        1,
                        arrays.stiffness,
                        inertia,
                        constraints.row,
                        constraints.hessian,
                        constraints.count[begin],
                        basis.row,
                        arrays.scalars,
                        LANES * arrays.direction.shape[1],
                        arrays.scalars.shape[2],
                        arrays.indefinite,
                        options.rigid_max,
                        rigid.direction,
                        n,
                        arrays.direction,
                        arrays.system_start[w],
                        w,
                        member,
                        team,
                    )
                for s in range(arrays.system_start[w], arrays.system_start[w + 1 - options.shared]):
                    solve_system(
                        arrays.system_world,
                        state.active,
                        3 * blocks,
                        options.rigid_max,
                        team,
                        arrays.matrix,
                        arrays.diagonal,
                        arrays.pattern,
                        rigid.direction,
                        options.rigid_max,
                        arrays.right,
                        arrays.direction,
                        s,
                        member,
                    )
                barrier()
                start_line_search(
                    instances,
                    constraints,
                    rigid,
                    arrays.rigid_tolerance,
                    options.stick_range,
                    team,
                    arrays.gradient,
                    arrays.direction,
                    arrays.indefinite,
                    state,
                    w,
                    member,
                )
        else:
            check_trial(
                instances,
                motion,
                points,
                constraints,
                rigid,
                team,
                options.step_length_min,
                arrays.q_trial,
                dt,
                state,
                w,
                member,
            )
        barrier()
        if state.active[w] != 0:
            trial = state.searching[w]
            if trial != 0:
                alpha = state.step_length[w]
                for i in range(begin, end):
                    for e in range(member, 3 * blocks, team):
                        arrays.q_trial[i, e] = arrays.q[i, e] + alpha * vec8d(arrays.direction[i, e])
                for j in range(member, n, team):
                    rigid.trial[w, j] = rigid.r[w, j] + alpha * rigid.direction[w, j]
                barrier()
            else:
                accept_step(
                    instances,
                    rigid,
                    team,
                    options.refresh_interval,
                    options.refresh_distance,
                    float(dt),
                    arrays.direction,
                    arrays.q,
                    state,
                    w,
                    member,
                )
                barrier()
