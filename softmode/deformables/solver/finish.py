"""Last phase of a step: write the state, what contacts leave (where they stick, dents), and sum what they put on."""

import newton
import warp as wp

from softmode.deformables.contact import dent_kernels, penalty_kernels
from softmode.deformables.contact import friction_memory_kernels as memory_kernels
from softmode.deformables.model.namespaces import soft
from softmode.deformables.potential import point_cpu_kernels, spin_kernels
from softmode.deformables.solver import attachment_kernels, reset_kernels
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.step_tables import StepTables


def finish(tables: StepTables, state: newton.State, dt: float, *, prescribed: bool) -> None:
    """Write coordinates, velocities and particles, and sum the contact reactions.

    Args:
        tables: Tables of the step.
        state: State at its end, which is written.
        dt: Step [s].
        prescribed: As for :func:`softmode.deformables.solver.detect.detect`.
    """
    t, out, worlds, step = tables, soft(state), tables.layout.world_count, tables.newton_step(dt)
    t.launch_teams(kernels.check_state, worlds, step, t.team)
    with t.beside:
        if t.model.shape_count:
            sticking = (t.instances, t.shapes, t.samples, t.constraints, int(prescribed))
            t.launch(
                memory_kernels.remember_slip, t.samples.position.shape, *sticking, out.stick_shape, out.stick_point
            )
        t.body_wrench.zero_()
        reactions = (t.body_wrench, t.instance_force)
        t.launch(penalty_kernels.sum_reactions, worlds, t.instances, t.newton, t.constraints, *reactions)
    t.launch_teams(spin_kernels.end_spin, t.layout.instance_count, step, t.team, t.spin)
    every = (t.layout.instance_count, t.layout.block_count)
    t.launch(kernels.end_step, every, step, t.spin, out.q, out.qd, out.q_before, out.qd_before, out.dt_before)
    t.launch(dent_kernels.leave_dents, t.samples.position.shape, t.instances, t.samples, t.constraints, out.dent)
    if t.pairs is not None:
        t.beside.join()
        t.pairs.remember(t.motion, t.newton, t.constraints, out)
        t.pairs.leave_dents(t.constraints, out)
    move_particles(t, state)
    t.beside.join()


def move_particles(tables: StepTables, state: newton.State) -> None:
    """Move the surface particles of ``state`` to where its reduced coordinates and its dents put them."""
    t, data = tables, soft(state)
    particles = (state.particle_q, state.particle_qd)
    skin = kernels.skin_samples if t.model.device.is_cuda else point_cpu_kernels.skin_eights
    t.launch(skin, t.sample_tasks, t.instances, t.basis, data.q, data.qd, data.dent, *particles)


def reset(tables: StepTables, state: newton.State, world_mask: wp.array, flags: newton.StateFlags | int) -> None:
    """Put the bodies of the chosen worlds back to the model's initial state and clear what those worlds report.

    Args:
        tables: Tables of the step.
        state: State to reset in place.
        world_mask: Boolean mask of shape (world_count + 1,).
        flags: ``newton.StateFlags``; coordinates are reset with PARTICLE_Q, velocities with PARTICLE_QD.
    """
    t, initial, out, every = tables, tables.parameters, soft(state), tables.samples.position.shape
    count, world = t.layout.instance_count, t.parameters.instance_world
    chosen = (int(flags) & int(newton.StateFlags.PARTICLE_Q), int(flags) & int(newton.StateFlags.PARTICLE_QD))
    t.launch(
        reset_kernels.reset_functions,
        (count, t.layout.stride),
        *(t.instances, t.basis, initial.placed_scale, world, world_mask, *chosen),
        *(initial.q, initial.qd, out.q, out.qd, out.dt_before),
    )
    t.launch(
        memory_kernels.forget_slip, every, t.instances, world, world_mask, out.stick_shape, out.stick_partner, out.dent
    )
    t.launch(
        reset_kernels.reset_worlds,
        max(count, t.model.body_count),
        *(t.instances, world, t.model.body_world, world_mask, t.newton.status),
        *(t.instance_force, t.body_wrench, t.constraints.count, t.constraints.pair_count, t.newton.cached),
    )
    if t.layout.pin_max:
        dim = (count, t.layout.pin_max)
        t.launch(attachment_kernels.hold_all_pins, dim, t.instances, world, world_mask, initial.pin_stiffness)
    move_particles(t, state)
