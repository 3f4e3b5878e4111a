"""A morph once more, with points that ride along: splats, markers, samples of a surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from softmode.errors import ConfigError
from softmode.mpm.losses import MassLoss
from softmode.mpm.particles import ParticleBody
from softmode.mpm.planner import MorphOptions
from softmode.mpm.run import MorphRun
from softmode.mpm.simulation import TYPES, MpmSimulation
from softmode.mpm.step_kernels import grid_to_particles

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayFrame:
    """One time of a morph."""

    step: int
    """Steps since the start."""
    target: int
    """Which target the particles are on the way to."""
    particles: Array
    """Particles [m], shape (N, 3)."""
    points: Array
    """Points that ride along [m], shape (M, 3)."""
    gradients: Array
    """Deformation gradients of the motion at these points since the start, shape (M, 3, 3)."""
    residual: Array
    """|ln((m + s) / (m* + s))| of the grid at particles and points, 0 where masses are right, shape (N + M,)."""


def replay(
    run: MorphRun,
    source: ParticleBody,
    targets: ParticleBody | list[ParticleBody],
    options: MorphOptions | None = None,
    *,
    points: ArrayLike = (),
    stride: int = 2,
    device: wp.DeviceLike = None,
) -> Iterator[ReplayFrame]:
    """Step through a morph with its controls; points ride on the velocities of the grid.

    Every segment begins where the run has it, so that a replay does not drift from it on a GPU either.

    Args:
        run: The morph.
        source: What it began with, before it was moved to the middle of the grid.
        targets: What it came to, likewise.
        options: Those of the run.
        points: Points that ride along, in the frame of the source [m], shape (M, 3).
        stride: Steps from one frame to the next; a divisor of a segment's.
        device: Where to compute; Warp's preferred device when None.

    Yields:
        The start, and every ``stride``-th step.

    Raises:
        ConfigError: If source and targets are not those of the run, or the stride does not divide a segment.
    """
    o = options or MorphOptions()
    goals = [targets] if isinstance(targets, ParticleBody) else list(targets)
    if run.positions.shape[1] != source.count or run.target_count != len(goals):
        raise ConfigError(
            f"run: is of {run.positions.shape[1]} particles and {run.target_count} targets, source and targets have "
            f"{source.count} and {len(goals)}"
        )
    if stride < 1 or o.segment_length % stride:
        raise ConfigError(f"stride: {stride} does not divide a segment of {o.segment_length} steps")
    steps, layers = o.segment_length, run.layer_count
    mpm = o.mpm
    if o.grid == "follow":
        aims = [goal.moved(offset).positions for goal, offset in zip(goals, run.offsets[1:], strict=True)]
        mpm = replace(mpm, grid=mpm.grid.reaching(run.positions, *aims, room=steps))
    s = MpmSimulation(source.moved(run.offsets[0]), mpm, step_count=steps, layer_count=layers, device=device)
    real, vec, mat = TYPES[mpm.precision]
    found = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    riders = _Riders(s, found + run.offsets[0], (real, vec, mat))
    loss = MassLoss(mpm.grid, goals[0].moved(run.offsets[1]), mass_scale=o.mass_scale, dtype=real, device=s.device)

    def frame(step: int, leg: int, x: wp.array) -> ReplayFrame:
        """Read what is on the device."""
        particles, moved = x.numpy()[0].astype(np.float64), riders.x.numpy()[0].astype(np.float64)
        ratio = (s.grid_mass.numpy()[0] + o.mass_scale) / (loss.target_mass.numpy()[0] + o.mass_scale)
        at = (np.concatenate([particles, moved]) - mpm.grid.low) / mpm.grid.spacing
        residual = map_coordinates(np.abs(np.log(ratio)).astype(np.float64), at.T, order=1, mode="nearest")
        gradients = riders.F.numpy()[0].astype(np.float64)
        return ReplayFrame(
            step=step, target=leg, particles=particles, points=moved, gradients=gradients, residual=residual
        )

    s.scatter_mass(s.first)
    yield frame(0, 0, s.first.x)
    leg = 0
    for segment, target in enumerate(run.legs.tolist()):
        if target != leg:
            leg = target
            loss.aim(goals[leg].moved(run.offsets[leg + 1]))
        s.start(x=run.positions[segment][None], F=run.deformation[segment][None])
        s.control.assign(run.control[segment * layers : (segment + 1) * layers, None])
        s.forward()
        for step in range(o.segment_length):
            riders.move(step)
            if (step + 1) % stride == 0:
                state = s.states()[step + 1]
                s.scatter_mass(state)
                yield frame(segment * o.segment_length + step + 1, leg, state.x)
        s.first.copy_from(s.last)


class _Riders:
    """Points without mass that the grid carries."""

    def __init__(self, simulation: MpmSimulation, points: Array, types: tuple[type, type, type]) -> None:
        """Put points on the grid."""
        self._simulation, count = simulation, len(points)
        real, vec, mat = types
        with wp.ScopedDevice(simulation.device):
            self.x = wp.array(points[None], dtype=vec)
            self.F = wp.array(np.tile(np.eye(3), (1, count, 1, 1)), dtype=mat)
            self._v, self._C = wp.zeros((1, count), dtype=vec), wp.zeros((1, count), dtype=mat)
            self._control, self._mass = wp.zeros((1, count), dtype=mat), wp.full((1, count), 1.0, dtype=real)
            self._failure = wp.zeros((1, 4), dtype=int)
        self._real = real

    def move(self, step: int) -> None:
        """Move with a step of the simulation; a point that leaves the grid stays where it left it."""
        o = self._simulation.options
        inputs = [self.x, self.F, self._control, self._mass, 0, self._simulation.find_velocities(step)]
        inputs += [*self._simulation.place, *map(self._real, (o.dt, 0.0))]
        outputs = [self.x, self._v, self._C, self.F, self._failure, step, self._simulation.active]
        wp.launch(grid_to_particles, self.x.shape, inputs=[*inputs, *outputs], device=self._simulation.device)
