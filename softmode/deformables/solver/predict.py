"""First phase of a step: read the state, and predict where the bodies go without contact."""

import newton

from softmode.deformables.model.namespaces import SoftControl, soft
from softmode.deformables.potential import spin_kernels
from softmode.deformables.potential.point_cpu_kernels import start_eights
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.step_tables import StepTables


def predict(tables: StepTables, state: newton.State, control: SoftControl, dt: float) -> None:
    """Read the state and the targets, and write the motion of the step and Newton's first iterate.

    Args:
        tables: Tables of the step.
        state: State at its start.
        control: Where driven functions are to be at its end.
        dt: Step [s].
    """
    data, step, blocks = soft(state), tables.newton_step(dt), tables.layout.block_count
    count, chunks = tables.layout.instance_count, tables.arrays.gradient_chunk.shape[1]
    turning = (tables.team, data.q, data.qd, data.qd_before, int(tables.options.keep_spin), tables.spin)
    tables.launch_teams(spin_kernels.find_spin, count, step, *turning)
    tables.launch(kernels.sum_external, (count, chunks, blocks), step, state.particle_f)
    before = (data.q, data.qd, data.q_before, data.qd_before, data.dt_before)
    bdf2 = int(tables.options.integrator == "bdf2")
    given = (control.q_driven, tables.parameters.density, tables.parameters.scale, tables.spin, bdf2)
    tables.launch(kernels.begin_step, (count, blocks), step, tables.model.gravity, *before, *given)
    tables.launch(kernels.start_points if tables.model.device.is_cuda else start_eights, tables.point_tasks, step)
