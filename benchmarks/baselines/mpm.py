"""Newton's `SolverImplicitMPM`: particles on a background grid, settings of newton's own `mpm_beam_twist` example.

Its elasticity is linear in a strain that is accumulated step by step. Clamps are the paper's: their particles are
kinematic. Particles sit at the centres of a uniform grid, so that they are compared with the reference at their own
rest positions.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM
from numpy.typing import NDArray

from benchmarks.baselines.common import SCENE, Row, measure
from tests.oracle.scenes import Scene

Array = NDArray[np.float64]


class Particles:
    """A scene of one box as particles.

    Args:
        scene: The scene.
        voxel: Edge of the grid's cells [m].
        substeps: Steps of the solver per step of the scene.
        per_cell: Particles per cell and axis.
    """

    def __init__(self, scene: Scene, voxel: float, *, substeps: int = 1, per_cell: int = 3) -> None:
        """Place the particles and make the solver."""
        self.scene, self.substeps = scene, substeps
        lower, upper = scene.shape.bounds
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
            mass=float(scene.density * width.prod()),
            jitter=0.0,
            radius_mean=0.5 * float(np.cbrt(width.prod())),
        )
        model: Any = builder.finalize(device="cpu")
        model.set_gravity(scene.gravity)
        model.mpm.young_modulus.fill_(scene.youngs_modulus)
        model.mpm.poisson_ratio.fill_(scene.poissons_ratio)
        model.mpm.damping.fill_(0.0)
        model.mpm.tensile_yield_ratio.fill_(1.0)
        self.rest: Array = model.particle_q.numpy().astype(np.float64)
        self.held = [(np.flatnonzero(clamp.region.contains(self.rest)), clamp.motion) for clamp in scene.clamps]
        mass = model.particle_mass.numpy()
        for index, _ in self.held:
            mass[index] = 0.0
        model.particle_mass.assign(mass)
        self.model = model
        self.solver = SolverImplicitMPM(
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
        self.unknowns = 3 * int(np.prod(np.ceil((upper - lower) / voxel).astype(int) + 1))
        self.restart()
        self.step()  # compiles
        self.restart()

    def restart(self) -> None:
        """Return to the initial state."""
        self.states: list[Any] = [self.model.state(), self.model.state()]
        self.time = 0.0

    def step(self) -> None:
        """Take a step of the scene."""
        dt, control, contacts = self.scene.dt / self.substeps, None, None
        for _ in range(self.substeps):
            self._move(dt)
            self.solver.step(self.states[0], self.states[1], control, contacts, dt)  # type: ignore[arg-type]
            self.states.reverse()
            self.time += dt

    def _move(self, dt: float) -> None:
        """Give the particles of moving clamps the velocity that takes them through a substep."""
        if not any(motion.rate or any(motion.velocity) for _, motion in self.held):
            return
        state = self.states[0]
        q, qd, slope = (array.numpy() for array in (state.particle_q, state.particle_qd, state.mpm.particle_qd_grad))
        for index, motion in self.held:
            now, then = (motion.position(self.rest[index], time) for time in (self.time, self.time + dt))
            x, y, z = motion.rate * np.asarray(motion.axis)
            q[index], qd[index] = now, (then - now) / dt
            slope[index] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        for array, value in ((state.particle_q, q), (state.particle_qd, qd), (state.mpm.particle_qd_grad, slope)):
            array.assign(value)

    def displacement(self) -> Array:
        """Return the displacements of all particles [m], (P, 3)."""
        found = self.states[0].particle_q.numpy().astype(np.float64) - self.rest
        for index, motion in self.held:
            found[index] = motion.position(self.rest[index], self.time) - self.rest[index]
        return found


def run(voxel: float, steps: int, *, substeps: int = 1, per_cell: int = 3) -> Row:
    """Bend the beam with grid cells of `voxel` [m], `per_cell`^3 particles each, `substeps` per step."""
    beam = Particles(SCENE, voxel, substeps=substeps, per_cell=per_cell)
    return measure(
        "Newton implicit MPM",
        f"voxel {voxel:g} m, {len(beam.rest)} particles" + (f", {substeps} substeps" if substeps > 1 else ""),
        beam.unknowns,
        steps,
        beam.step,
        beam.displacement,
        points=beam.rest,
        weights=np.ones(len(beam.rest)),
    )
