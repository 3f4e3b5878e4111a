"""Potential, gradient and Hessian of a step: the launches of one Newton iteration up to its linear system."""

import warp as wp

from softmode.deformables.model.newton_step_kernels import ALL, ENERGIES, TRIAL, NewtonStep
from softmode.deformables.potential import constraint_cpu_kernels as constraint_cpu
from softmode.deformables.potential import evaluate_kernels
from softmode.deformables.potential import point_cpu_kernels as eights
from softmode.deformables.potential.rigid_row_kernels import evaluate_rows
from softmode.deformables.solver.step_tables import StepTables
from softmode.deformables.system import assembly_cpu_kernels as assembly_cpu
from softmode.deformables.system import assembly_kernels as assembly
from softmode.deformables.system.tile_kernels import TILE_TEAM, assemble_tiles, tile_count


def evaluate(tables: StepTables, dt: float, *, derivatives: bool) -> None:
    """Evaluate cubature points, point constraints and constraint rows at the iterate of every active world.

    What the trial that became the iterate has found already is not evaluated again.

    Args:
        tables: Tables of the step.
        dt: Step [s].
        derivatives: Whether forces and Hessians are evaluated beside energies.
    """
    t = tables
    found = ALL if derivatives else ENERGIES
    _evaluate(t, dt, t.newton.active, t.arrays.q, t.rigid.table.r, found=int(found), forces=derivatives)
    if derivatives:
        t.launch_teams(evaluate_kernels.list_constraints, t.layout.instance_count, t.step, t.team)


def evaluate_trial(tables: StepTables, dt: float) -> None:
    """Evaluate the trial of every world in a line search: the energies, and the stress for the case that it serves."""
    t = tables
    _evaluate(t, dt, t.newton.searching, t.arrays.q_trial, t.rigid.table.trial, found=int(TRIAL), forces=False)


def _evaluate(
    t: StepTables, dt: float, selected: wp.array, q: wp.array, r: wp.array, *, found: int, forces: bool
) -> None:
    """Evaluate the selected worlds at (q, r): of points and rows what ``found`` says, of contacts forces or not."""
    step = t.newton_step(dt)
    if t.model.device.is_cuda:
        points, constraints = (*t.point_tasks, t.lanes), (*t.constraints.row.shape, t.lanes)
        t.launch(evaluate_kernels.evaluate_points, points, step, selected, q, found, t.lanes)
        t.launch(evaluate_kernels.evaluate_constraints, constraints, step, selected, q, r, int(forces), t.lanes)
    else:
        t.launch(eights.evaluate_eights, t.point_tasks, step, selected, q, found)
        t.launch(constraint_cpu.evaluate_constraints, t.layout.instance_count, step, selected, q, r, int(forces))
    if t.rigid.row_max:
        t.launch(evaluate_rows, (t.layout.world_count, t.rigid.row_max), step, selected, r, found)


def gather_gradient(tables: StepTables, dt: float) -> None:
    """Gather the gradient of the potential with respect to q, and what holds the driven functions."""
    t, step = tables, tables.newton_step(dt)
    count = t.layout.instance_count
    if t.model.device.is_cuda:
        dim = (count, t.arrays.gradient_chunk.shape[1], t.layout.block_count)
        t.launch(evaluate_kernels.sum_forces, dim, step, t.newton.active)
    else:
        t.launch(assembly_cpu.sum_forces, count, step, t.newton.active)
    t.launch(evaluate_kernels.sum_gradient, t.unknowns, step)


def stiffness_tasks(blocks: int) -> int:
    """Return how many 8x8 blocks the upper triangle of a stiffness of so many blocks of functions has."""
    return 3 * blocks * blocks + 3 * (blocks * blocks + blocks) // 2


def assemble(tables: StepTables, dt: float) -> None:
    """Assemble the Hessian into the block systems [K | C | -g] and the rigid part."""
    t, step = tables, tables.newton_step(dt)
    blocks, count, worlds = t.layout.block_count, t.layout.instance_count, t.layout.world_count
    tasks = stiffness_tasks(blocks)
    if t.model.device.is_cpu:
        t.launch(eights.differentiate_eights, t.point_tasks, step)
    if t.tiled:
        team = TILE_TEAM if t.model.device.is_cuda else 1
        dim = (count, t.arrays.stiffness.shape[1], tile_count(t.layout.stride), team)
        t.launch(assemble_tiles, dim, step, team, block_dim=team)
    elif t.model.device.is_cuda:
        # more than 100 registers per thread: larger blocks leave half of a multiprocessor idle
        t.launch(assembly.assemble_stiffness, (count, t.arrays.stiffness.shape[1], tasks), step, block_dim=128)
    else:
        t.launch(assembly_cpu.assemble_stiffness, count, step)
    if t.model.device.is_cuda:
        _assemble_by_entries(t, step, tasks)
    else:
        _assemble_by_bodies(t, step)
    if t.layout.part_count > 1:
        dim = (worlds, t.layout.part_count**2, 9 * blocks * blocks)
        t.launch(assembly.assemble_pairs, dim, step, t.system.relation, block_dim=128)


def _assemble_by_entries(t: StepTables, step: NewtonStep, tasks: int) -> None:
    """Assemble matrix, columns and rigid part, a thread for a few entries or one of ``tasks`` blocks of each."""
    blocks, count, rigid_max = t.layout.block_count, t.layout.instance_count, t.rigid.count_max
    columns = 3 * blocks  # threads that share a row of the matrix
    t.launch(assembly.assemble_matrix, (count, t.arrays.stiffness.shape[2], columns), step, columns)
    t.launch(assembly.add_contacts, (count, tasks), step, block_dim=128)
    t.launch(assembly.assemble_columns, (count, 3 * blocks, rigid_max + 1), step)
    if rigid_max:
        t.launch(assembly.assemble_rigid, (t.layout.world_count, rigid_max, rigid_max), step)


def _assemble_by_bodies(t: StepTables, step: NewtonStep) -> None:
    """Assemble them on a CPU, a thread for a body or a world."""
    t.launch(assembly_cpu.assemble_matrix, t.layout.instance_count, step)
    t.launch(assembly_cpu.assemble_columns, t.layout.instance_count, step)
    if t.rigid.count_max:
        t.launch(assembly_cpu.assemble_rigid, t.layout.world_count, step)


def solve(tables: StepTables) -> None:
    """Factor every body, condense onto the rigid dofs, solve those, substitute back."""
    t, rigid, system, active = tables, tables.rigid, tables.system, tables.newton.active
    worlds, count = t.layout.world_count, rigid.count_max
    system.factor(active)
    if count:
        if t.model.device.is_cuda:
            t.launch(assembly.condense, (worlds, count, count + 1), t.step)
        else:
            t.launch(assembly_cpu.condense, worlds, t.step)
        t.launch_teams(assembly.solve_rigid, worlds, active, t.team, rigid.table)
    solution = system.solve(active, count, rigid.table.direction, count)
    if t.layout.part_count > 1:
        t.launch(assembly.read_direction, t.unknowns, t.instances, solution, t.arrays.direction)
