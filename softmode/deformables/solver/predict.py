"""First phase of a step: read the state, and predict where the bodies go without contact."""

import newton
import warp as wp

from softmode.deformables.model.namespaces import SoftControl, soft
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
    data, chunk = soft(state), tables.arrays.gradient_chunk
    count, blocks, bodies = tables.layout.instance_count, tables.layout.block_count, (tables.instances, tables.basis)
    dim = (count, chunk.shape[1], blocks)
    tables.launch(kernels.sum_external, dim, *bodies, state.particle_f, chunk.shape[1], chunk)
    before = (data.q, data.qd, data.q_before, data.qd_before, data.dt_before)
    given = (tables.model.gravity, *before, control.q_driven, chunk, wp.float64(dt))
    bdf2 = int(tables.options.integrator == "bdf2")
    tables.launch(kernels.begin_step, (count, blocks), *bodies, *given, bdf2, tables.motion, tables.arrays.q)
