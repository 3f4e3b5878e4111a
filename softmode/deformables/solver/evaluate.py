"""Potential, gradient and Hessian of a step: the launches of one Newton iteration up to its linear system."""

import warp as wp

from softmode.deformables.contact.penalty_kernels import evaluate_constraints
from softmode.deformables.solver import assembly_kernels as assembly
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.rigid_row_kernels import evaluate_rows
from softmode.deformables.solver.step_tables import StepTables


def evaluate(tables: StepTables, dt: float, *, derivatives: bool, trial: bool = False) -> None:
    """Evaluate cubature points, point constraints and constraint rows at the iterate of every active world.

    Args:
        tables: Tables of the step.
        dt: Step [s].
        derivatives: Whether forces and Hessians are evaluated beside energies.
        trial: Whether it is done at the trial of every world in a line search instead.
    """
    t, rigid, asked = tables, tables.rigid, int(derivatives)
    at = (t.newton.active, t.arrays.q, rigid.table.r)
    if trial:
        at = (t.newton.searching, t.arrays.q_trial, rigid.table.trial)
    selected, q, r = at
    step = (selected, q, wp.float64(dt), asked, t.newton)
    t.launch(kernels.evaluate_points, t.points.energy.shape, t.instances, t.basis, t.motion, *step, t.points)
    bodies = (t.instances, t.basis, t.motion, t.newton, rigid.table)
    given = (wp.float64(t.options.stick_velocity * dt), *at, asked)
    t.launch(evaluate_constraints, t.constraints.row.shape, *bodies, *given, t.constraints)
    if rigid.row_max:
        dim = (t.layout.world_count, rigid.row_max)
        t.launch(evaluate_rows, dim, selected, r, wp.float64(dt), asked, rigid.table)


def gather_gradient(tables: StepTables, dt: float) -> None:
    """Gather the gradient of the potential with respect to q, and what holds the driven functions."""
    t, arrays, active, chunk = tables, tables.arrays, tables.newton.active, tables.arrays.gradient_chunk
    bodies = (t.instances, t.basis)
    dim = (t.layout.instance_count, chunk.shape[1], t.layout.block_count)
    t.launch(kernels.sum_forces, dim, *bodies, t.points, t.constraints, active, chunk.shape[1], chunk)
    given = (t.motion, active, chunk, arrays.q, wp.float64(dt))
    t.launch(kernels.sum_gradient, t.unknowns, *bodies, *given, arrays.gradient, arrays.reaction)


def assemble(tables: StepTables, dt: float) -> None:
    """Assemble the Hessian into the block systems [K | C | -g] and the rigid part."""
    t, arrays, rigid, system = tables, tables.arrays, tables.rigid, tables.system
    active, blocks, count, worlds = t.newton.active, t.layout.block_count, t.layout.instance_count, t.layout.world_count
    bodies, chunks, stiffness = (t.instances, t.basis), arrays.stiffness.shape[1], arrays.stiffness
    tasks = 3 * blocks * blocks + 3 * (blocks * blocks + blocks) // 2  # 8x8 blocks of the upper triangle
    columns = 3 * blocks if t.model.device.is_cuda else 1  # threads that share a row of the matrix
    # more than 100 registers per thread: larger blocks leave half of a multiprocessor idle
    given = (t.points, active, t.newton.refresh, chunks, stiffness)
    t.launch(assembly.assemble_stiffness, (count, chunks, tasks), *bodies, *given, block_dim=128)
    given = (t.motion, active, stiffness, arrays.pins, wp.float64(dt), columns, system.matrix)
    t.launch(assembly.assemble_matrix, (count, stiffness.shape[2], columns), *bodies, *given)
    given = (t.constraints, active, system.matrix)
    t.launch(assembly.add_contacts, (count, tasks), *bodies, *given, block_dim=128)
    given = (t.constraints, active, arrays.gradient, rigid.table, rigid.count_max, system.size, system.scalars)
    t.launch(assembly.assemble_columns, (count, 3 * blocks, rigid.count_max + 1), *bodies, *given)
    if t.layout.part_count > 1:
        given = (t.constraints, t.newton, system.relation, system.matrix)
        dim = (worlds, t.layout.part_count**2, 9 * blocks * blocks)
        t.launch(assembly.assemble_pairs, dim, *bodies, *given, block_dim=128)
    if rigid.count_max:
        dim = (worlds, rigid.count_max, rigid.count_max)
        t.launch(assembly.assemble_rigid, dim, t.instances, t.constraints, t.newton, rigid.table)


def solve(tables: StepTables) -> None:
    """Factor every body, condense onto the rigid dofs, solve those, substitute back."""
    t, rigid, system, active = tables, tables.rigid, tables.system, tables.newton.active
    worlds = t.layout.world_count
    system.factor(active)
    if rigid.count_max:
        dim = (worlds, rigid.count_max, rigid.count_max + 1)
        start = t.arrays.system_start
        t.launch(assembly.condense, dim, t.newton, start, rigid.count_max, system.matrix, rigid.table)
        t.launch_teams(assembly.solve_rigid, worlds, active, t.team, rigid.table)
    solution = system.solve(active, rigid.count_max, rigid.table.direction, rigid.count_max)
    if t.layout.part_count > 1:
        t.launch(assembly.read_direction, t.unknowns, t.instances, solution, t.arrays.direction)
