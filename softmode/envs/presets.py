"""What tasks share: the table scene as reinforcement learning wants it, and hands that learn to be gentle.

The scene is coarser, with steps of 1/120 s, and the same physics within a few percent.

What it costs in accuracy stands in benchmarks/JOURNAL.md ("A preset for reinforcement learning").
"""

from dataclasses import replace
from typing import TypeVar

from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.envs.task_config import TaskConfig
from softmode.scenes.table_scene import TableSceneConfig

RL_SOLVER = SolverReducedOptions(
    carry_stiffness=True, tolerance=1.0e-4, force_tolerance=1.0e-3, iteration_max=12, friction_lag=4
)
"""Steps end when the residual force is below a thousandth of the forces on a body in contact and on the joints that it
pushes, or when a free one moves by less than 1e-4 of its size; a body at rest keeps its stiffness from step to step."""
RL_BUILD = BuildOptions(function_count=24, cubature_count=96)
"""24 functions, a system of 72 unknowns, which on CUDA fits in shared memory."""


def rl_scene(config: TableSceneConfig | None = None, *, dt: float = 1.0 / 120.0) -> TableSceneConfig:
    """Return a scene with the coarse body and solver, in steps of about ``dt`` [s], an even number per control step."""
    config = config or TableSceneConfig()
    substeps = 2 * max(1, round(0.5 / (config.control_hz * dt)))
    return replace(config, object=replace(config.object, build=RL_BUILD), solver=RL_SOLVER, substeps=substeps)


Config = TypeVar("Config", bound=TaskConfig)


def gentle(config: Config) -> Config:
    """Return a task whose hands learn to be gentle: weak fingers, short tool steps, rough handling costs and ends.

    The fingers press with 3 N at most, as the grasp command of a real gripper limits them.
    """
    control = replace(config.scene.control, squeeze_lead=0.1, translation_scale=0.01)
    return replace(config, care=0.5, terminate_when_rough=True, scene=replace(config.scene, control=control))
