"""Third phase of a step: minimise the incremental potential of every world by Newton with a line search."""

import warp as wp

from softmode.deformables.model.declare import launch_teams
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.newton import rigid_start_kernels
from softmode.deformables.newton import round_kernels as rounds
from softmode.deformables.newton import search_kernels as search
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.evaluate import (
    assemble,
    evaluate,
    evaluate_trial,
    gather_gradient,
    solve,
    stiffness_tasks,
)
from softmode.deformables.solver.step_tables import StepTables


def minimise(tables: StepTables, dt: float) -> None:
    """Find the coordinates, and the rigid unknowns, at the end of a step of ``dt`` [s]."""
    t, worlds, step = tables, tables.layout.world_count, tables.newton_step(dt)
    if t.rounds:
        t.newton.level_count.zero_()
        t.launch(rounds.expect_iterations, worlds, step)
    t.launch(kernels.begin_newton, worlds, step)
    t.launch(kernels.extrapolate, t.unknowns, step)
    if t.model.shape_count:
        t.launch_teams(rigid_start_kernels.start_rigidly, t.layout.instance_count, step, t.samples, t.team)
    if t.options.carry_stiffness:
        t.launch_teams(search.reuse_hessians, worlds, step, t.team)
    if t.rounds:
        _take_rounds(t, dt)
    if t.one_launch:
        _go_on_to_the_end(t, dt)
    else:
        wp.capture_while(t.newton.any_active, _iterate, tables=t, dt=dt)


def _take_rounds(tables: StepTables, dt: float) -> None:
    """Take most worlds through their first iterations, all at once, and beside them the slowest to their end."""
    t, always = tables, min(tables.rounds, rounds.ALWAYS)
    dim = (t.layout.world_count, max(3 * t.layout.block_count, t.rigid.count_max))
    t.launch(rounds.start_trials, dim, t.newton_step(dt), t.rounds - always, t.room)
    with t.beside:
        _go_on_to_the_end(t, dt, only_aside=True)
    for _ in range(always):
        _take_round(t, dt)
    t.beside.join()
    _count_left(t, dt)
    wp.capture_while(t.newton.any_left, _take_another_round, tables=t, dt=dt)


def _go_on_to_the_end(tables: StepTables, dt: float, *, only_aside: bool = False) -> None:
    """Take every world that is not done, or only those beside the rounds, through all further iterations."""
    t, team = tables, tables.world_team
    known = (t.newton_step(dt), t.system.unit, team, t.system.relation, int(only_aside))
    t.launch(t.fused_kernel, (t.layout.world_count, team), *known, block_dim=team)


def _take_round(tables: StepTables, dt: float) -> None:
    """Check the trials of all worlds that are not done, and find directions and next trials where they are accepted."""
    t, step, worlds, team = tables, tables.newton_step(dt), tables.layout.world_count, tables.round_team
    points, constraints, threads = rounds.tasks(t.layout.point_max, t.constraints.row.shape[1], t.rigid.row_max)
    t.launch(rounds.evaluate_trials, (worlds, threads), step, points, constraints, block_dim=rounds.BLOCK)
    t.launch(rounds.check_kernel(team), (worlds, team), step, team, block_dim=team)
    t.launch(rounds.differentiate_points, (worlds, t.layout.point_max), step, block_dim=rounds.BLOCK)
    dim = (worlds, t.arrays.stiffness.shape[1], stiffness_tasks(t.layout.block_count))
    t.launch(rounds.assemble_stiffness, dim, step, block_dim=rounds.BLOCK)
    kernel = rounds.direct_kernel(t.system.size, t.system.scalars.shape[2], team)
    t.launch(kernel, (worlds, team), step, team, block_dim=team)


def _take_another_round(tables: StepTables, dt: float) -> None:
    """Take a round where another one is worth it."""
    _take_round(tables, dt)
    _count_left(tables, dt)


def _count_left(tables: StepTables, dt: float) -> None:
    """Say whether another round is worth it: while the one launch cannot hold all worlds that are left at a time."""
    t, device = tables, tables.model.device
    team = rounds.BLOCK if device.is_cuda else 1
    launch_teams(device, rounds.count_left, 1, team, t.newton_step(dt), t.layout.world_count, t.held, team)


def _iterate(tables: StepTables, dt: float) -> None:
    """Take one Newton step in every world that is not done."""
    evaluate(tables, dt, derivatives=True)
    gather_gradient(tables, dt)
    check_convergence(tables, dt)
    assemble(tables, dt)
    solve(tables)
    start_line_search(tables, dt)
    wp.capture_while(tables.newton.any_searching, _try_step, tables=tables, dt=dt)
    accept_step(tables, dt)


def check_convergence(tables: StepTables, dt: float) -> None:
    """Sum the potential and stop the worlds that have converged or used up their iterations."""
    tables.newton.any_active.zero_()
    tables.launch_teams(search.check_iterates, tables.layout.world_count, tables.newton_step(dt), tables.team)


def start_line_search(tables: StepTables, dt: float) -> None:
    """Start the line search of every active world."""
    tables.newton.any_searching.zero_()
    tables.launch_teams(search.start_line_searches, tables.layout.world_count, tables.newton_step(dt), tables.team)


def _try_step(tables: StepTables, dt: float) -> None:
    """Evaluate one trial step in every searching world and accept or halve it."""
    t, step = tables, tables.newton_step(dt)
    threads = LANES * t.layout.block_count if t.model.device.is_cuda else 1  # one for each function
    t.launch(search.trial_functions, (t.layout.instance_count, threads), step, threads)
    if t.rigid.count_max:
        t.launch(search.trial_rigid, (t.layout.world_count, t.rigid.count_max), step)
    evaluate_trial(t, dt)
    t.newton.any_searching.zero_()
    t.launch_teams(search.check_trials, t.layout.world_count, step, t.team)


def accept_step(tables: StepTables, dt: float) -> None:
    """Take the accepted steps, and say which Hessians are to be refreshed."""
    tables.launch_teams(search.accept_steps, tables.layout.world_count, tables.newton_step(dt), tables.team)
