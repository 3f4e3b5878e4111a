"""MorphPlanner: controls that turn one body into another, segment by segment.

A segment is a few steps with one control for each particle. Its controls descend the loss of the masses at the end of
the segment, by Adam with a halving line search; the state at its end is the start of the next (Xu, Song, Levin, Hyde
2025, algorithms 1 and 2, with their errors mended: ``docs/morphing.md``). A segment stays on the device: gradients,
steps, trials and their acceptance.
"""

from __future__ import annotations

import hashlib
import os
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_choice, require_number
from softmode.deformables import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import AssetError, ConfigError, SolverDiverged
from softmode.mpm.losses import CoarseMassLoss, MassLoss, MassLossKind
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
from softmode.mpm.run import MorphRun
from softmode.mpm.simulation import TYPES, MpmSimulation

Array = NDArray[np.float64]

UNEQUAL_MASS = 0.3
"""Part by which masses may differ before it is told."""
COARSE = (2, 4)
"""Cells of the coarser grids over those of the particles'."""
NORM_THREADS = 512
"""Threads of a GPU that sum up the gradient of a world."""
WRITING = 9.0
"""Time between two writings of a file over the time that one takes."""

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
    """Steps of a segment."""
    control_layers: int = 1
    """Controls of a particle in a segment, one after another: each acts in the first of its share of the steps."""
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
    loss: MassLossKind = "log"
    """Distance of masses on the grid: that of logarithms, or "squared" for comparison, which throws particles out. It
    is compared on the fine grid alone."""
    mass_scale: float = 1.0
    """Mass scale of the logarithmic loss [kg]."""
    target_accuracy: float | None = None
    """Leave a target when 1 - loss / first loss exceeds this, 0 < accuracy < 1; None goes on to the last frame."""
    coarse: float = 0.7
    """First part of the segments to a target, 0..1, whose loss also compares masses on grids with two and four times
    as wide cells, where particles in a hole that should open feel a push."""
    settling: float = 0.15
    """Last part of the segments to the last target, 0..1. Each of them begins, and the run ends, with half of the
    velocity and without stress: the shape at hand becomes the rest shape (F = I). Else the body moves on, and what
    stress is left bends it, when control ends."""
    mpm: MpmOptions = field(default_factory=lambda: MpmOptions(damping=4.0, smoothing=0.955, control="additive"))
    """How particles are stepped. The paper has a damping of 0.5 1/s, with which bodies arrive moving and leave again;
    and `rest_volume="grid"`, with which thin parts such as ears are too stiff for its steps."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("frame_count", "segment_length", "pass_count", "iteration_count", "most_halvings"):
            require_number(name, getattr(self, name), at_least=1)
        require_number("control_layers", self.control_layers, at_least=1, at_most=self.segment_length)
        require_number("step_length", self.step_length, above=0.0)
        require_number("gradient_tolerance", self.gradient_tolerance, at_least=0.0, below=1.0)
        require_choice("loss", self.loss, get_args(MassLossKind))
        require_number("mass_scale", self.mass_scale, above=0.0, unit="kg")
        require_number("coarse", self.coarse, at_least=0.0, at_most=1.0)
        require_number("settling", self.settling, at_least=0.0, at_most=1.0)
        if self.target_accuracy is not None:
            require_number("target_accuracy", self.target_accuracy, above=0.0, below=1.0)


class _Log:
    """What all worlds did so far."""

    def __init__(self, fingerprint: str, names: tuple[str, ...], offsets: Array, notes: tuple[str, ...]) -> None:
        """Begin with nothing."""
        self.fingerprint, self.names, self.offsets, self.notes = fingerprint, names, offsets, notes
        self.rows: defaultdict[str, list[np.ndarray]] = defaultdict(list)
        """Arrays of a :class:`MorphRun` by name, row by row, with the world as first axis."""
        self.ends: list[int] = []
        self.counts: tuple[int, int] = (0, 0)
        """Gradients and trials of the part that a file held."""

    @property
    def segment_count(self) -> int:
        """Number of segments so far."""
        return len(self.rows["kinetic_energy"])

    def add(self, **rows: wp.array | np.ndarray) -> None:
        """Append rows."""
        for name, row in rows.items():
            self.rows[name].append(row.numpy().copy() if isinstance(row, wp.array) else row)

    def of_world(self, world: int, count: int) -> dict[str, np.ndarray]:
        """Return the rows of a world without padding, stacked."""
        tensors = {"positions": (3,), "deformation": (3, 3), "control": (3, 3)}
        found = {
            name: np.array([row[world, :count] for row in self.rows[name]]).reshape(-1, count, *shape)
            for name, shape in tensors.items()
        }
        losses = ("losses", "first_losses", "kinetic_energy")
        return found | {name: np.array([row[world] for row in self.rows[name]]) for name in losses}


class MorphPlanner:
    """Plans one morph, or several at once, one in each world."""

    def __init__(
        self,
        source: ParticleBody | Sequence[ParticleBody],
        target: ParticleBody | Sequence[ParticleBody],
        options: MorphOptions | None = None,
        *,
        device: wp.DeviceLike = None,
    ) -> None:
        """Set up the particles, the loss and the search.

        Args:
            source: The body that is turned into another; several bodies are one world each.
            target: The body that it becomes; several are become one after another, by all worlds at once.
            options: How the morph is planned.
            device: Where to compute; Warp's preferred device when None.

        Raises:
            ConfigError: If a body does not fit into the grid, a step is not stable, or there is no target.

        Warns:
            RuntimeWarning: If the mass of a source and that of a target differ by more than 30 %.
        """
        self.options = options or MorphOptions()
        self.targets = (target,) if isinstance(target, ParticleBody) else tuple(target)
        if not self.targets:
            raise ConfigError("target: expected one or more")
        o, mpm = self.options, self.options.mpm
        self.simulation = s = MpmSimulation(
            source,
            mpm,
            step_count=o.segment_length,
            layer_count=o.control_layers,
            keep_grids=True,
            device=device,
        )
        real, _, mat = TYPES[mpm.precision]
        for goal in self.targets:
            mpm.grid.require(goal.positions, "target")
        self.loss = MassLoss(
            mpm.grid, self.targets[0], kind=o.loss, mass_scale=o.mass_scale, dtype=real, device=s.device
        )
        factors = COARSE if o.coarse and o.loss == "log" else ()
        self._coarse = [CoarseMassLoss(self.loss, s, self.targets[0], factor=factor) for factor in factors]
        self.notes = tuple(
            f"world {world}: masses differ, {body.mass:.4g} kg become {goal.mass:.4g} kg (ratio {ratio:.3g}), so the "
            "loss cannot vanish"
            for goal in self.targets
            for world, body in enumerate(s.bodies)
            if abs((ratio := body.mass / goal.mass) - 1.0) > UNEQUAL_MASS
        )
        """What is to be known before the run."""
        for note in self.notes:
            warnings.warn(f"{note}. Scale one of them, or change its density", RuntimeWarning, stacklevel=2)
        worlds, shape = s.world_count, (o.control_layers, s.world_count, s.count)
        with wp.ScopedDevice(s.device):
            self._search = Search()
            for name in ("loss", "trial_loss", "norm", "first_norm"):
                setattr(self._search, name, wp.zeros(worlds, dtype=wp.float64))
            self._search.step = wp.zeros(worlds, dtype=float)
            for name in ("adam_count", "halvings", "searching", "active", "gradient_count", "trial_count"):
                setattr(self._search, name, wp.zeros(worlds, dtype=int))
            self._search.any_searching, self._search.stale = wp.zeros(1, dtype=int), wp.zeros(1, dtype=int)
            self._accepted_now = wp.zeros(worlds, dtype=int)
            names = ("accepted", "first_moment", "second_moment", "first_trial", "second_trial", "direction")
            self._accepted, self._first, self._second, self._first_trial, self._second_trial, self._direction = (
                wp.zeros(shape, dtype=mat) for _ in names
            )
        self._graph: wp.Graph | None = None
        self._compiled = False
        """Whether a segment has run, which compiles kernels and allocates what a graph needs."""

    def run(
        self,
        progress: Callable[[int, float], None] | None = None,
        *,
        file: str | os.PathLike[str] | None = None,
        names: Sequence[str] = (),
        offsets: ArrayLike | None = None,
    ) -> list[MorphRun]:
        """Plan all segments, or those that a file does not have yet.

        Args:
            progress: Called after each segment with its number and the largest loss of the worlds.
            file: Where to keep the run while it goes on; one that is there is gone on with. Only with one world.
                Writing takes at most a tenth of the time, so that of a fast run not every segment is on the disk.
            names: What source and targets were made from, for the file.
            offsets: By how much they were moved [m], shape (targets + 1, 3), for the file.

        Returns:
            One run for each world.

        Raises:
            AssetError: If the file is no morph, or that of another source, target or options.
            SolverDiverged: If no control keeps the particles of the first segment on the grid and finite.

        Warns:
            RuntimeWarning: If none does in a later one: the runs then end with the last good segment.
        """
        o, s = self.options, self.simulation
        if file is not None and s.world_count > 1:
            raise ConfigError(f"file: holds one morph, there are {s.world_count}", hint="save the runs one by one")
        self._log = log = _Log(
            self.fingerprint,
            tuple(names),
            np.zeros((len(self.targets) + 1, 3)) if offsets is None else np.asarray(offsets, dtype=np.float64),
            self.notes,
        )
        if file is not None and Path(file).exists():
            self._resume(MorphRun.load(file), file)
        else:
            log.add(positions=s.first.x, deformation=s.first.F)
        due = 0.0
        for target in range(len(log.ends), len(self.targets)):
            for loss in (self.loss, *self._coarse):
                loss.aim(self.targets[target])
            if len(log.rows["first_losses"]) == target:
                loss = self._loss_at_hand()
                log.add(first_losses=loss, **({} if target else {"losses": loss}))
            while log.segment_count < sum(self._settling(target)):
                begun, count = log.ends[target - 1] if target else 0, -(-o.frame_count // o.segment_length)
                for level in self._coarse:
                    level.weigh(float(log.segment_count - begun < int(o.coarse * count)))
                self.plan_segment()
                try:
                    s.check()
                except SolverDiverged as error:
                    if not log.segment_count:
                        raise
                    log.notes = (*log.notes, f"ended after {log.segment_count} segments: {error}")
                    warnings.warn(log.notes[-1], RuntimeWarning, stacklevel=2)
                    return self._runs(file)
                log.add(losses=self._loss_at_hand())
                first, more = self._settling(target)
                if more and log.segment_count + 1 >= first:
                    s.first.F.fill_(np.eye(3))
                    s.start(v=0.5 * s.first.v.numpy(), C=0.5 * s.first.C.numpy())
                v, m = s.first.v.numpy().astype(np.float64), s.mass.numpy().astype(np.float64)
                log.add(
                    positions=s.first.x,
                    deformation=s.first.F,
                    kinetic_energy=0.5 * (m * (v**2).sum(axis=2)).sum(axis=1),
                )
                for control in s.control.numpy().copy():
                    log.add(control=control)
                if progress is not None:
                    progress(log.segment_count - 1, float(log.rows["losses"][-1].max()))
                now = time.monotonic()
                if file is not None and now >= due:
                    self._runs(file)
                    due = time.monotonic() + WRITING * (time.monotonic() - now)
            log.ends.append(log.segment_count)
        return self._runs(file)

    def _settling(self, target: int) -> tuple[int, int]:
        """Return how many segments of the run end before a target settles or is left, and how many settle."""
        o, log = self.options, self._log
        count = -(-o.frame_count // o.segment_length)
        settling = int(o.settling * count) if target + 1 == len(self.targets) else 0
        begun = log.ends[target - 1] if target else 0
        first = count - settling
        if o.target_accuracy is not None:
            goal = (1.0 - o.target_accuracy) * log.rows["first_losses"][target]
            reached = [k for k, loss in enumerate(log.rows["losses"][begun + 1 :], 1) if (loss <= goal).all()]
            first = min([first, *reached])
        return begun + first, settling

    @property
    def fingerprint(self) -> str:
        """SHA-256 of bodies, targets and options."""
        found = hashlib.sha256(repr(self.options).encode())
        for body in (*self.simulation.bodies, *self.targets):
            found.update(repr((body.count, body.material)).encode())
            for array in (body.positions, body.masses):
                found.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
        return found.hexdigest()

    def _resume(self, run: MorphRun, file: str | os.PathLike[str]) -> None:
        """Take up a run where it was cut off."""
        if run.fingerprint != self.fingerprint:
            raise AssetError(
                f"morph {file}: is that of another source, target or options", hint="name another file, or remove it"
            )
        log, s = self._log, self.simulation
        for name in ("positions", "deformation", "control", "losses", "kinetic_energy", "first_losses"):
            log.rows[name] = [row[None] for row in getattr(run, name)]
        log.ends = list(run.ends)
        log.counts = (run.gradient_count, run.trial_count)
        log.names, log.offsets = run.names, run.offsets
        ends = (run.positions[-1], run.velocity, run.affine_velocity, run.deformation[-1])
        s.start(*(value[None] for value in ends))

    def _runs(self, file: str | os.PathLike[str] | None) -> list[MorphRun]:
        """Return the runs as they are, and write that of a file."""
        s, log = self.simulation, self._log
        counts = (self._search.gradient_count.numpy(), self._search.trial_count.numpy())
        v, C = s.first.v.numpy(), s.first.C.numpy()
        found = [
            MorphRun(
                **log.of_world(w, body.count),
                velocity=v[w, : body.count].copy(),
                affine_velocity=C[w, : body.count].copy(),
                offsets=log.offsets,
                ends=tuple(log.ends),
                gradient_count=log.counts[0] + int(counts[0][w]),
                trial_count=log.counts[1] + int(counts[1][w]),
                fingerprint=log.fingerprint,
                names=log.names,
                notes=log.notes,
            )
            for w, body in enumerate(s.bodies)
        ]
        if file is not None:
            found[0].save(file)
        return found

    def _loss_at_hand(self) -> Array:
        """Return the losses of the state that the next segment begins with."""
        s = self.simulation
        s.scatter_mass(s.first)
        self.loss.evaluate(s.grid_mass, self._search.trial_loss, s.grid_mass_bar)
        return self._search.trial_loss.numpy().copy()

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
        s.first.copy_from(s.last)

    def _descend(self, *, first: bool) -> None:
        """Take a gradient and step along it."""
        o, s = self.options, self.simulation
        control_bar = self.loss.gradient(s, self._coarse)[1].control
        self._search.norm.zero_()
        self._search.any_searching.zero_()
        # Without a trial, and after one that was rejected for good, the states are not those of the accepted control.
        self._search.stale.fill_(1)
        threads = NORM_THREADS if s.device.is_cuda else 1
        self._per_layer(gradient_norm, [control_bar, self._search.norm, threads], threads)
        self._per_world(begin_search, [self._search, wp.float64(o.gradient_tolerance), int(first)])
        moments = [self._first, self._second, self._first_trial, self._second_trial]
        self._per_layer(adam_direction, [self._search, control_bar, *moments, self._direction])
        wp.capture_while(self._search.any_searching, self._try)
        wp.capture_while(self._search.stale, self._restore)

    def _restore(self) -> None:
        """Step with the accepted controls."""
        self._per_layer(try_control, [self._search, self._accepted, self._direction, self.simulation.control])
        self._evaluate()
        self._search.stale.zero_()

    def _try(self) -> None:
        """Try the step at hand in every world that searches."""
        s = self.simulation
        self._per_layer(try_control, [self._search, self._accepted, self._direction, s.control])
        everyone = s.active
        if s.keeps_states:
            # Worlds that do not search have the states, the loss and its derivative of their accepted control already.
            s.active = self._search.searching
        self._evaluate()
        s.active = everyone
        self._search.any_searching.zero_()
        inputs = [self._search, s.failure, self.options.most_halvings, self._accepted_now]
        self._per_world(judge_trial, inputs)
        self._per_layer(
            keep_trial,
            [
                self._accepted_now,
                s.control,
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
        self.loss.after(s, self._search.trial_loss)
        for level in self._coarse:
            level.add(s, self._search.trial_loss)

    def _per_world(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        wp.launch(kernel, self.simulation.world_count, inputs=inputs, device=self.simulation.device)

    def _per_layer(self, kernel: Callable[..., object], inputs: list[object], threads: int | None = None) -> None:
        """Launch a kernel with the particles of a layer after another, arrays (L, W, N) being given layer by layer."""
        s = self.simulation
        for layer in range(s.layer_count):
            of_layer = [a[layer] if isinstance(a, wp.array) and a.ndim == 3 else a for a in inputs]
            wp.launch(kernel, (s.world_count, threads or s.count), inputs=of_layer, device=s.device)
