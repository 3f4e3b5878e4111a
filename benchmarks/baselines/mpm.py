"""Newton's `SolverImplicitMPM`: particles on a background grid, settings of newton's own `mpm_beam_twist` example.

Its elasticity is linear in a strain that is accumulated step by step. The clamp is the paper's: the particles of the
first half metre are kinematic. Particles sit at the centres of a uniform grid, so that they are compared with the
reference at their own rest positions.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

from benchmarks.baselines.common import CLAMP, SCENE, Row, measure


def run(voxel: float, steps: int, *, substeps: int = 1, per_cell: int = 3) -> Row:
    """Bend the beam with grid cells of `voxel` [m], `per_cell`^3 particles each, `substeps` per step."""
    lower, upper = SCENE.shape.bounds
    count = np.round((upper - lower) / voxel * per_cell).astype(int)
    width = (upper - lower) / count
    identity: Any = wp.quat_identity()
    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    first = lower + 0.5 * width
    builder.add_particle_grid(
        pos=wp.vec3(*first),
        rot=identity,
        vel=wp.vec3(0.0),
        dim_x=int(count[0]),
        dim_y=int(count[1]),
        dim_z=int(count[2]),
        cell_x=float(width[0]),
        cell_y=float(width[1]),
        cell_z=float(width[2]),
        mass=float(SCENE.density * width.prod()),
        jitter=0.0,
        radius_mean=0.5 * float(np.cbrt(width.prod())),
    )
    model: Any = builder.finalize(device="cpu")
    model.set_gravity(SCENE.gravity)
    model.mpm.young_modulus.fill_(SCENE.youngs_modulus)
    model.mpm.poisson_ratio.fill_(SCENE.poissons_ratio)
    model.mpm.damping.fill_(0.0)
    model.mpm.tensile_yield_ratio.fill_(1.0)
    rest = model.particle_q.numpy().astype(np.float64)
    mass = model.particle_mass.numpy()
    mass[rest[:, 0] < CLAMP] = 0.0
    model.particle_mass.assign(mass)
    solver = SolverImplicitMPM(
        model,
        config=SolverImplicitMPM.Config(
            voxel_size=voxel,
            solver="cr",
            strain_basis="P1d",
            velocity_basis="Q1",
            max_iterations=250,
            tolerance=1.0e-6,
            carry_residual_strain="unconverged",
            warmstart_mode="particles",
            air_drag=0.0,
        ),
    )
    states = [model.state(), model.state()]
    control: Any = None
    contacts: Any = None

    def step() -> None:
        for _ in range(substeps):
            solver.step(states[0], states[1], control, contacts, SCENE.dt / substeps)
            states.reverse()

    step()  # compiles
    states[:] = [model.state(), model.state()]
    nodes = int(np.prod(np.ceil((upper - lower) / voxel).astype(int) + 1))
    return measure(
        "Newton implicit MPM",
        f"voxel {voxel:g} m, {len(rest)} particles" + (f", {substeps} substeps" if substeps > 1 else ""),
        3 * nodes,
        steps,
        step,
        lambda: states[0].particle_q.numpy().astype(np.float64) - rest,
        points=rest,
        weights=np.ones(len(rest)),
    )
