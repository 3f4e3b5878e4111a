"""Third phase of a step: minimise the incremental potential of every world by Newton with a line search."""

import warp as wp

from softmode.deformables.solver import fused_newton_kernels as fused
from softmode.deformables.solver import search_kernels as search
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve
from softmode.deformables.solver.step_tables import StepTables


def minimise(tables: StepTables, dt: float) -> None:
    """Find the coordinates, and the rigid unknowns, at the end of a step of ``dt`` [s]."""
    t, worlds = tables, tables.layout.world_count
    t.launch(kernels.begin_newton, worlds, t.newton, t.instances, t.constraints)
    t.launch(kernels.extrapolate, t.unknowns, t.instances, t.motion, t.constraints, wp.float64(dt), t.arrays.q)
    if t.options.carry_stiffness:
        given = (t.instances, t.basis, t.options.renewal_distance, float(dt), t.team, t.arrays.q)
        t.launch_teams(search.reuse_hessians, worlds, *given, t.newton)
    if t.one_launch:
        _minimise_at_once(t, dt)
    else:
        wp.capture_while(t.newton.any_active, _iterate, tables=t, dt=dt)


def _minimise_at_once(t: StepTables, dt: float) -> None:
    """Take every world through its iterations in one launch, a team of threads per world."""
    options, given = t.options, fused.NewtonOptions()
    given.iteration_max, given.force_tolerance = options.iteration_max, wp.float64(options.force_tolerance)
    given.stick_range = wp.float64(options.stick_velocity * dt)
    given.step_length_min = wp.float64(options.step_length_min)
    given.refresh_interval, given.refresh_distance = options.stiffness_renewal, options.renewal_distance
    given.rigid_max, given.dt = t.rigid.count_max, wp.float64(dt)
    given.gradient_chunks, given.stiffness_chunks = t.arrays.gradient_chunk.shape[1], t.arrays.stiffness.shape[1]
    given.factor_width, given.shared = t.system.width, int(t.shared)
    team = fused.TEAM if t.model.device.is_cuda else 1
    bodies = (t.instances, t.basis, t.motion, t.points, t.constraints, t.rigid.table, t.newton)
    inputs = (*bodies, given, t.arrays, t.system.unit, team)
    t.launch(t.fused_kernel, (t.layout.world_count, team), *inputs, block_dim=team)


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
    t, options = tables, tables.options
    given = (options.iteration_max, wp.float64(options.force_tolerance), t.arrays.gradient, t.arrays.q, wp.float64(dt))
    t.newton.any_active.zero_()
    t.launch_teams(search.check_iterates, t.layout.world_count, *_potential(t), *given, t.newton)


def start_line_search(tables: StepTables, dt: float) -> None:
    """Start the line search of every active world."""
    t, arrays = tables, tables.arrays
    t.newton.any_searching.zero_()
    limits = (arrays.rigid_tolerance, wp.float64(t.options.stick_velocity * dt), t.team)
    linear = (arrays.gradient, arrays.direction, arrays.indefinite)
    bodies = (t.instances, t.constraints, t.rigid.table)
    t.launch_teams(search.start_line_searches, t.layout.world_count, *bodies, *limits, *linear, t.newton)


def _try_step(tables: StepTables, dt: float) -> None:
    """Evaluate one trial step in every searching world and accept or halve it."""
    t, arrays, rigid = tables, tables.arrays, tables.rigid
    worlds = t.layout.world_count
    t.launch(search.trial_functions, t.unknowns, t.instances, t.newton, arrays.q, arrays.direction, arrays.q_trial)
    if rigid.count_max:
        t.launch(search.trial_rigid, (worlds, rigid.count_max), t.newton, rigid.table)
    evaluate(t, dt, derivatives=False, trial=True)
    t.newton.any_searching.zero_()
    given = (wp.float64(t.options.step_length_min), arrays.q_trial, wp.float64(dt))
    t.launch_teams(search.check_trials, worlds, *_potential(t), *given, t.newton)


def accept_step(t: StepTables, dt: float) -> None:
    """Take the accepted steps, and say which Hessians are to be refreshed."""
    given = (t.team, t.options.stiffness_renewal, t.options.renewal_distance, float(dt))
    steps = (t.arrays.direction, t.arrays.q, t.newton)
    t.launch_teams(search.accept_steps, t.layout.world_count, t.instances, t.rigid.table, *given, *steps)


def _potential(t: StepTables) -> tuple[object, ...]:
    """Return what the sum of the potential reads."""
    return t.instances, t.motion, t.points, t.constraints, t.rigid.table, t.team
