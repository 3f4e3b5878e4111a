"""MorphPlanner: controls that turn one body into another, segment by segment.

A segment is a few steps with one control for each particle. Its controls descend the loss of the masses at the end of
the segment, by Adam with a halving line search; the state at its end is the start of the next (Xu, Song, Levin, Hyde
2025, algorithms 1 and 2, with their errors mended: ``docs/morphing.md``). A segment stays on the device: gradients,
steps, trials and their acceptance.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.deformables import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import SolverDiverged
from softmode.mpm.losses import MassLoss
from softmode.mpm.options import MpmOptions
from softmode.mpm.particles import ParticleBody
from softmode.mpm.planner_kernels import (
    Search,
    adam_direction,
    begin_pass,
    begin_search,
    gradient_norm,
    judge_start,
    judge_trial,
    keep_trial,
    try_control,
)
from softmode.mpm.simulation import TYPES, MpmSimulation

Array = NDArray[np.float64]

MORPH_MATERIAL = Material(
    youngs_modulus=1.4e5, poissons_ratio=0.2, density=75.0, viscosity=0.0, model=MaterialModel.COROTATED
)
"""The paper's material: mu = 58333.3 Pa, lambda = 38888.89 Pa."""


@dataclass(frozen=True, kw_only=True)
class MorphOptions:
    """How a morph is planned."""

    frame_count: int = 420
    """Steps in all; the last segment is filled up."""
    segment_length: int = 10
    """Steps of a segment, which have one control."""
    pass_count: int = 3
    """Passes over a segment's control; each begins with the full step length."""
    iteration_count: int = 4
    """Gradients in a pass."""
    step_length: float = 0.01
    """First length of Adam's step."""
    most_halvings: int = 10
    """Halvings of a step before a pass is left."""
    gradient_tolerance: float = 1.0e-4
    """A pass ends when the gradient is smaller than this part of the pass's first."""
    mass_scale: float = 1.0
    """Mass scale of the logarithmic loss [kg]."""
    target_accuracy: float | None = None
    """Stop when 1 - loss / first loss exceeds this, 0 < accuracy < 1; None goes on to the last frame."""
    mpm: MpmOptions = field(
        default_factory=lambda: MpmOptions(damping=8.0, smoothing=0.955, control="additive", rest_volume="grid")
    )
    """How particles are stepped. The paper has a damping of 0.5 1/s: bodies then arrive moving and leave again."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("frame_count", "segment_length", "pass_count", "iteration_count", "most_halvings"):
            require_number(name, getattr(self, name), at_least=1)
        require_number("step_length", self.step_length, above=0.0)
        require_number("gradient_tolerance", self.gradient_tolerance, at_least=0.0, below=1.0)
        require_number("mass_scale", self.mass_scale, above=0.0, unit="kg")
        if self.target_accuracy is not None:
            require_number("target_accuracy", self.target_accuracy, above=0.0, below=1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MorphRun:
    """What a morph did."""

    positions: Array
    """Particles at the start and after each segment [m], shape (S + 1, N, 3)."""
    deformation: Array
    """Deformation gradients at the end, shape (N, 3, 3)."""
    losses: Array
    """Loss at the start and after each segment, shape (S + 1,)."""
    kinetic_energy: Array
    """Kinetic energy after each segment [J], shape (S,)."""
    gradient_count: int
    """Gradients taken."""
    trial_count: int
    """Trial steps taken."""
    notes: tuple[str, ...] = ()
    """What the planner says of the run."""

    @property
    def accuracy(self) -> float:
        """1 - last loss / first loss."""
        return float(1.0 - self.losses[-1] / self.losses[0])


class MorphPlanner:
    """Plans one morph, or several at once, one in each world."""

    def __init__(
        self,
        source: ParticleBody | Sequence[ParticleBody],
        target: ParticleBody,
        options: MorphOptions | None = None,
        *,
        device: wp.DeviceLike = None,
    ) -> None:
        """Set up the particles, the loss and the search.

        Args:
            source: The body that is turned into another; several bodies are one world each.
            target: The body that it becomes.
            options: How the morph is planned.
            device: Where to compute; Warp's preferred device when None.

        Raises:
            ConfigError: If a body does not fit into the grid or a step is not stable.
        """
        self.options = options or MorphOptions()
        o, mpm = self.options, self.options.mpm
        self.simulation = MpmSimulation(source, mpm, step_count=o.segment_length, device=device)
        s = self.simulation
        real, _, mat = TYPES[mpm.precision]
        self.loss = MassLoss(mpm.grid, target, mass_scale=o.mass_scale, dtype=real, device=s.device)
        self.notes = tuple(
            f"world {world}: masses differ by {100.0 * abs(ratio - 1.0):.0f} % ({body.mass:.4g} and {target.mass:.4g} "
            "kg), so the loss cannot vanish"
            for world, body in enumerate(s.bodies)
            if abs((ratio := body.mass / target.mass) - 1.0) > 0.3
        )
        worlds, shape = s.world_count, (s.world_count, s.count)
        with wp.ScopedDevice(s.device):
            self._search = Search()
            for name in ("loss", "trial_loss", "norm", "first_norm"):
                setattr(self._search, name, wp.zeros(worlds, dtype=wp.float64))
            self._search.step = wp.zeros(worlds, dtype=float)
            for name in ("adam_count", "halvings", "searching", "active", "gradient_count", "trial_count"):
                setattr(self._search, name, wp.zeros(worlds, dtype=int))
            self._search.any_searching = wp.zeros(1, dtype=int)
            self._accepted_now = wp.zeros(worlds, dtype=int)
            names = ("accepted", "first_moment", "second_moment", "first_trial", "second_trial", "direction")
            self._accepted, self._first, self._second, self._first_trial, self._second_trial, self._direction = (
                wp.zeros(shape, dtype=mat) for _ in names
            )
        self._graph: wp.Graph | None = None
        self._compiled = False
        """Whether a segment has run, which compiles kernels and allocates what a graph needs."""
        self._evaluate()
        self.first_loss = self._search.trial_loss.numpy().copy()

    def run(self, progress: Callable[[int, float], None] | None = None) -> list[MorphRun]:
        """Plan all segments.

        Args:
            progress: Called after each segment with its number and the largest loss of the worlds.

        Returns:
            One run for each world.

        Raises:
            SolverDiverged: If no control keeps the particles of the first segment on the grid and finite.

        Warns:
            RuntimeWarning: If none does in a later one: the runs then end with the last good segment.
        """
        o, s = self.options, self.simulation
        positions, losses = [s.first.x.numpy().copy()], [self.first_loss]
        kinetic, notes, F = [], self.notes, s.first.F.numpy().copy()
        for segment in range(-(-o.frame_count // o.segment_length)):
            self.plan_segment()
            try:
                s.check()
            except SolverDiverged as error:
                if segment == 0:
                    raise
                notes = (*notes, f"ended after {segment} segments: {error}")
                warnings.warn(notes[-1], RuntimeWarning, stacklevel=2)
                break
            found = self._search.loss.numpy()
            v, m = s.first.v.numpy().astype(np.float64), s.mass.numpy().astype(np.float64)
            kinetic.append(0.5 * (m * (v**2).sum(axis=2)).sum(axis=1))
            positions.append(s.first.x.numpy().copy())
            F = s.first.F.numpy().copy()
            losses.append(found.copy())
            if progress is not None:
                progress(segment, float(found.max()))
            if o.target_accuracy is not None and (found <= (1.0 - o.target_accuracy) * self.first_loss).all():
                break
        gradients, trials = self._search.gradient_count.numpy(), self._search.trial_count.numpy()
        return [
            MorphRun(
                positions=np.stack([p[w, : body.count] for p in positions]).astype(np.float64),
                deformation=F[w, : body.count].astype(np.float64),
                losses=np.array([loss[w] for loss in losses]),
                kinetic_energy=np.array([k[w] for k in kinetic]),
                gradient_count=int(gradients[w]),
                trial_count=int(trials[w]),
                notes=notes,
            )
            for w, body in enumerate(s.bodies)
        ]

    def plan_segment(self) -> None:
        """Find the controls of the next segment and step through it; nothing is read back from the second on."""
        if not self._compiled:
            self._plan_segment()
            self._compiled = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device=self.simulation.device) as capture:
                self._plan_segment()
            self._graph = capture.graph
        assert self._graph is not None
        wp.capture_launch(self._graph)

    def _plan_segment(self) -> None:
        o, s = self.options, self.simulation
        for array in (self._accepted, self._first, self._second, s.control):
            array.zero_()
        self._evaluate()
        self._per_world(judge_start, [self._search, s.failure])
        for _ in range(o.pass_count):
            self._per_world(begin_pass, [self._search, o.step_length])
            for iteration in range(o.iteration_count):
                self._descend(first=iteration == 0)
        self._per_particle(try_control, [self._search, self._accepted, self._direction, s.control[0]])
        s.forward()
        s.first.copy_from(s.last)

    def _descend(self, *, first: bool) -> None:
        """Take a gradient and step along it."""
        o, s = self.options, self.simulation
        # The last trial may have been rejected: states are those of the accepted control before a gradient is taken.
        self._per_particle(try_control, [self._search, self._accepted, self._direction, s.control[0]])
        self._evaluate()
        bar, mass_bar, _ = s.bars()
        bar.zero()
        self.loss.spread(s.last.x, s.mass, s.grid_mass_bar, bar.x, mass_bar)
        control_bar = s.backward()[1].control[0]
        self._search.norm.zero_()
        self._search.any_searching.zero_()
        self._per_particle(gradient_norm, [control_bar, self._search.norm])
        self._per_world(begin_search, [self._search, wp.float64(o.gradient_tolerance), int(first)])
        moments = [self._first, self._second, self._first_trial, self._second_trial]
        self._per_particle(adam_direction, [self._search, control_bar, *moments, self._direction])
        wp.capture_while(self._search.any_searching, self._try)

    def _try(self) -> None:
        """Try the step at hand in every world that searches."""
        s = self.simulation
        self._per_particle(try_control, [self._search, self._accepted, self._direction, s.control[0]])
        self._evaluate()
        self._search.any_searching.zero_()
        inputs = [self._search, s.failure, self.options.most_halvings, self._accepted_now]
        self._per_world(judge_trial, inputs)
        self._per_particle(
            keep_trial,
            [
                self._accepted_now,
                s.control[0],
                self._first_trial,
                self._second_trial,
                self._accepted,
                self._first,
                self._second,
            ],
        )

    def _evaluate(self) -> None:
        """Step with the controls at hand and find the loss."""
        s = self.simulation
        s.forward()
        s.scatter_mass()
        self.loss.evaluate(s.grid_mass, self._search.trial_loss, s.grid_mass_bar)

    def _per_world(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        wp.launch(kernel, self.simulation.world_count, inputs=inputs, device=self.simulation.device)

    def _per_particle(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        shape = (self.simulation.world_count, self.simulation.count)
        wp.launch(kernel, shape, inputs=inputs, device=self.simulation.device)


def morph(
    source: ParticleBody,
    target: ParticleBody,
    options: MorphOptions | None = None,
    *,
    device: wp.DeviceLike = None,
    progress: Callable[[int, float], None] | None = None,
) -> MorphRun:
    """Turn a body into another.

    Both are moved so that their centres of mass lie in the middle of the grid: aligned boxes nearly double the loss at
    the start.

    Args:
        source: The body that is turned.
        target: What it becomes.
        options: How the morph is planned; by default a grid of 32^3 nodes of 1 m, which suits bodies 14 to 20 m long.
        device: Where to compute; Warp's preferred device when None.
        progress: Called after each segment with its number and its loss.

    Raises:
        ConfigError: If a body does not fit into the grid or a step is not stable.
        SolverDiverged: If no control keeps a segment's particles on the grid and finite.
    """
    chosen = options or MorphOptions()
    grid = chosen.mpm.grid
    middle = np.array(grid.origin) + 0.5 * (np.array(grid.shape) - 1) * grid.spacing
    bodies = [body.moved(middle - body.centre) for body in (source, target)]
    return MorphPlanner(bodies[0], bodies[1], chosen, device=device).run(progress)[0]
