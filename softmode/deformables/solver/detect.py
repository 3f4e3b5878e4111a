"""Second phase of a step: find what touches, and write it behind the pins as point constraints."""

import newton
import warp as wp

from softmode.deformables.contact import detection_kernels as kernels
from softmode.deformables.contact import sample_cpu_kernels as eights
from softmode.deformables.model.namespaces import SoftControl, soft
from softmode.deformables.solver.step_kernels import fall_back_to_euler
from softmode.deformables.solver.step_tables import StepTables
from softmode.deformables.system import assembly_kernels as assembly


def detect(tables: StepTables, state: newton.State, control: SoftControl, dt: float, *, prescribed: bool) -> None:
    """Find the point constraints of the step, and which bodies they join in one linear system.

    Args:
        tables: Tables of the step.
        state: State at its start.
        control: Where the pins are to be at its end.
        dt: Step [s].
        prescribed: Whether rigid bodies move as their velocities say, instead of as the solve finds.
    """
    t, constraints = tables, tables.constraints
    t.shapes.body_q, t.shapes.body_qd = state.body_q, state.body_qd
    if t.layout.pin_max:
        _gather_pins(t, control, dt, prescribed)
    if t.model.shape_count or t.pairs is not None:
        place = kernels.place_samples if t.model.device.is_cuda else eights.place_eights
        t.launch(place, t.sample_tasks, t.instances, t.basis, t.motion, t.samples)
        t.launch_teams(kernels.bound_samples, t.layout.instance_count, t.instances, t.team, t.samples)
    if t.model.shape_count:
        _find_contacts(t, state, dt, prescribed)
    else:
        wp.copy(constraints.count, t.instances.pin_count)
    if t.pairs is not None:
        t.pairs.detect(t.motion, t.samples, t.newton, soft(state), constraints, dt=float(dt))
    if t.layout.part_count > 1:
        dim = (t.layout.world_count, t.layout.part_count)
        t.launch(assembly.relate_pairs, dim, t.step, t.system.relation)
        t.system.order_parts()
        place = (t.instances, t.newton, t.system.place, 3 * t.layout.block_count)
        t.launch(assembly.place_parts, t.layout.instance_count, *place)
    adapt(t, dt)


def adapt(tables: StepTables, dt: float) -> None:
    """Let bodies in contact or attached to a rigid body take an Euler step, whatever the integrator."""
    if tables.options.integrator == "bdf2":
        blocks = (tables.layout.instance_count, tables.layout.block_count)
        tables.launch(fall_back_to_euler, blocks, tables.newton_step(dt), tables.spin)


def differentiate_constraints(tables: StepTables) -> None:
    """Compute how point constraints move with the joint dofs, and the least pivots of the rigid system."""
    t, rigid = tables, tables.rigid.table
    t.launch_teams(assembly.bound_pivots, t.layout.world_count, t.team, rigid)
    t.launch(kernels.constraint_jacobians, t.constraints.row.shape, t.instances, rigid, t.constraints)


def _gather_pins(t: StepTables, control: SoftControl, dt: float, prescribed: bool) -> None:
    """Write the pins as the first constraints of the step and assemble their stiffness."""
    layout, bodies, row = t.layout, (t.instances, t.basis), t.layout.first_pin_row
    dim = (layout.instance_count, layout.pin_max)
    pins = (*t.pin_arrays, control.pin_target, int(prescribed), float(dt))
    t.launch(kernels.gather_pins, dim, *bodies, t.motion, t.shapes, row, *pins, t.constraints, t.newton.status)
    dim = (layout.instance_count, layout.block_count, layout.block_count)
    t.launch(assembly.assemble_pins, dim, *bodies, row, t.parameters.pin_stiffness, t.arrays.pins)


def _find_contacts(t: StepTables, state: newton.State, dt: float, prescribed: bool) -> None:
    """Find the contacts of the surface samples with the rigid shapes."""
    memory, candidate = soft(state), t.candidate
    culled = (t.instances, candidate, t.shapes, t.samples, *t.pin_arrays, float(dt), t.near, t.newton.status)
    t.launch(kernels.cull_shapes, candidate.shape, *culled)
    before = (memory.stick_shape, memory.dt_before)
    if not t.model.device.is_cuda:
        shapes = (candidate, t.near, t.shapes, float(dt))
        t.launch(eights.cull_samples, t.layout.instance_count, t.instances, t.basis, *shapes, *before, t.samples)
    known = (t.instances, t.basis, t.motion, candidate, t.near, t.shapes, t.surface.inset, float(dt))
    t.launch(kernels.find_contacts, t.samples.position.shape, *known, *before, t.samples)
    stick = (int(prescribed), wp.float64(t.options.stick_ratio), t.team, float(dt))
    t.launch_teams(
        kernels.gather_contacts,
        t.layout.instance_count,
        *(t.instances, t.basis, t.shapes, t.samples, t.motion, t.surface),
        *(t.constraints.row.shape[1], *stick),
        *(memory.stick_shape, memory.stick_point, t.constraints, t.newton.status),
    )
