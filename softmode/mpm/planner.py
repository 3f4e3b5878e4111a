"""MorphPlanner: controls that turn one body into another, segment by segment.

A segment is a few steps with one control for each particle. Its controls descend the loss of the masses at the end of
the segment, by Adam with a halving line search; the state at its end is the start of the next (Xu, Song, Levin, Hyde
2025, algorithms 1 and 2, with their errors mended: ``docs/morphing.md``). A segment stays on the device, as one graph:
gradients, steps, trials, their acceptance, what the next begins with, and what is kept. Losses alone are read back.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_choice, require_number
from softmode.deformables import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import AssetError, ConfigError, SolverDiverged
from softmode.mpm.grid import Grid
from softmode.mpm.losses import MassLoss, MassLossKind
from softmode.mpm.options import MpmOptions
from softmode.mpm.particles import ParticleBody
from softmode.mpm.places import PlaceLoss, transported
from softmode.mpm.planner_kernels import (
    Record,
    Search,
    adam_direction,
    begin_gradient,
    begin_search,
    end_gradient,
    end_segment,
    gradient_norm,
    hand_over,
    judge_start,
    judge_trial,
    keep_trial,
    try_control,
)
from softmode.mpm.run import MorphRun
from softmode.mpm.simulation import TYPES, MpmSimulation, ParticleState

Array = NDArray[np.float64]

UNEQUAL_MASS = 0.3
"""Part by which masses may differ before it is told."""
NORM_THREADS = 512
"""Threads of a GPU that sum up the gradient of a world."""
KEPT_BYTES = 1.0e8
"""Most memory that segments take on the device before they are read back."""
ROOM = 4
"""Cells that a grid which follows leaves free around particles and target, beside those that velocities cross."""
WRITING = 9.0
"""Time between two writings of a file over the time that one takes."""

GridMotion = Literal["fixed", "follow"]

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
    has no places."""
    mass_scale: float = 1.0
    """Mass scale of the logarithmic loss [kg]."""
    target_accuracy: float | None = None
    """Leave a target when 1 - loss / first loss exceeds this, 0 < accuracy < 1; None goes on to the last frame."""
    places: float = 0.4
    """First part of the segments to a target, 0..1, in which particles are also drawn to places of their own in it,
    with a weight that falls to 0. What lies over a cell away from the target is drawn to it until the body settles.
    With 0 neither is done, and what lies in a hole that should open is pressed out and left."""
    settling: float = 0.15
    """Last part of the segments to the last target, 0..1. Each of them begins, and the run ends, with half of the
    velocity and without stress: the shape at hand becomes the rest shape (F = I). Else the body moves on, and what
    stress is left bends it, when control ends."""
    grid: GridMotion = "fixed"
    """What happens where particles come near the border of the grid: "fixed" rejects controls that take them there, and
    the run ends when all do; "follow" moves the grid by whole cells between segments, and gives it more nodes where it
    has too few, as far as ``MpmOptions.memory_limit`` allows. On a CPU the bits are those of a grid that is
    large from the start, while no particle leaves its room within a segment (``docs/morphing.md``)."""
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
        require_choice("grid", self.grid, get_args(GridMotion))
        require_number("mass_scale", self.mass_scale, above=0.0, unit="kg")
        require_number("places", self.places, at_least=0.0, at_most=1.0)
        require_number("settling", self.settling, at_least=0.0, at_most=1.0)
        if self.target_accuracy is not None:
            require_number("target_accuracy", self.target_accuracy, above=0.0, below=1.0)


class _Log:
    """What all worlds did so far."""

    def __init__(self, fingerprint: str, names: tuple[str, ...], offsets: Array, notes: tuple[str, ...]) -> None:
        """Begin with nothing."""
        self.fingerprint, self.names, self.offsets, self.notes = fingerprint, names, offsets, notes
        self.first_losses: list[Array] = []
        """Losses to each target when its turn came, each (W,)."""
        self.losses: list[Array] = []
        """Losses at the start and after each segment, each (W,)."""
        self.ends: list[int] = []
        self.counts: tuple[int, int] = (0, 0)
        """Gradients and trials of the part that a file held."""

    @property
    def segment_count(self) -> int:
        """Number of segments so far."""
        return len(self.losses) - 1


class _Kept:
    """States, controls and kinetic energies of segments: rows on the device until they are read into the host's."""

    def __init__(self, simulation: MpmSimulation, segments: int) -> None:
        """Make room for a number of segments of a simulation."""
        s = self._simulation = simulation
        _, vec, mat = TYPES[s.options.precision]
        self._mass = s.mass.numpy().astype(np.float64)
        self._segments, shape, layers = segments, (s.world_count, s.count), s.layer_count
        row = (15 + 9 * layers) * np.dtype(s.options.precision).itemsize * math.prod(shape)
        self.rows = max(1, min(segments, int(KEPT_BYTES / row)))
        with wp.ScopedDevice(s.device):
            self.x, self.v = (wp.zeros((self.rows, *shape), dtype=vec) for _ in range(2))
            self.F = wp.zeros((self.rows, *shape), dtype=mat)
            self.control = wp.zeros((self.rows, layers, *shape), dtype=mat)
            kept = (self.x, self.v, self.F, self.control)
            pinned = s.device.is_cuda
            self._fetched = tuple(wp.empty(a.shape, dtype=a.dtype, device="cpu", pinned=pinned) for a in kept)
            self.record = Record()
            for name in ("count", "row", "settles", "settling"):
                setattr(self.record, name, wp.zeros(1, dtype=int))
            self.record.goal = wp.zeros(shape[0], dtype=wp.float64)
            self.record.status = wp.zeros((shape[0], 2), dtype=wp.float64)
        self.begin()

    def begin(self) -> None:
        """Begin with the state at hand, and nothing else."""
        s, count, plain = self._simulation, self._segments, np.dtype(self._simulation.options.precision)
        self.positions = np.empty((count + 1, *s.mass.shape, 3), dtype=plain)
        self.deformation = np.empty((count + 1, *s.mass.shape, 3, 3), dtype=plain)
        self.controls = np.empty((count, *s.control.shape, 3, 3), dtype=plain)
        self.kinetic_energy = np.empty((count, s.world_count))
        self.read, self._unstowed, self.waiting = 0, 0, 0
        """Segments on the host, those that were fetched, and those on the device alone."""
        self.positions[0], self.deformation[0] = s.first.x.numpy(), s.first.F.numpy()
        self.record.count.zero_()

    def take(self, run: MorphRun) -> None:
        """Take the segments of a run of one world."""
        self.read = n = run.segment_count
        self.positions[: n + 1, 0], self.deformation[: n + 1, 0] = run.positions, run.deformation
        self.controls[:n, :, 0] = run.control.reshape(n, *self.controls.shape[1:2], *self.controls.shape[3:])
        self.kinetic_energy[:n, 0] = run.kinetic_energy

    def keep(self) -> None:
        """Note that a segment left a row; when there is no room for another take all off the device."""
        self.waiting += 1
        if self.waiting == self.rows:
            self._fetch()

    def flush(self) -> None:
        """Read all rows back."""
        self.stow()
        if self.waiting:
            self._fetch()
            self.stow()

    def _fetch(self) -> None:
        """Take all rows off the device."""
        for fetched, rows in zip(self._fetched, (self.x, self.v, self.F, self.control), strict=True):
            wp.copy(fetched, rows, count=self.waiting * math.prod(rows.shape[1:]))
        wp.synchronize_device(self._simulation.device)
        self.record.count.zero_()
        self._unstowed, self.waiting = self.waiting, 0

    def stow(self) -> None:
        """Put what was taken off the device where it belongs; a GPU goes on with the next segment meanwhile."""
        begin, end = self.read, self.read + self._unstowed
        if begin == end:
            return
        x, v, F, control = (fetched.numpy()[: self._unstowed] for fetched in self._fetched)
        self.positions[begin + 1 : end + 1], self.deformation[begin + 1 : end + 1] = x, F
        self.controls[begin:end] = control
        self.kinetic_energy[begin:end] = 0.5 * (self._mass * (v.astype(np.float64) ** 2).sum(axis=3)).sum(axis=2)
        self.read, self._unstowed = end, 0

    def of_world(self, world: int, count: int) -> dict[str, np.ndarray]:
        """Return what was read of a world, without padding; it shares the memory of all worlds."""
        n = self.read
        control = self.controls[:n, :, world, :count]
        return {
            "positions": self.positions[: n + 1, world, :count],
            "deformation": self.deformation[: n + 1, world, :count],
            "control": control.reshape(-1, *control.shape[2:]),
            "kinetic_energy": self.kinetic_energy[:n, world],
        }


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
        sources = (source,) if isinstance(source, ParticleBody) else tuple(source)
        points = [body.positions for body in sources] if o.grid == "follow" else []
        if points:
            mpm = replace(mpm, grid=mpm.grid.reaching(*points, room=ROOM))
        self.simulation = s = MpmSimulation(
            sources,
            mpm,
            step_count=o.segment_length,
            layer_count=o.control_layers,
            keep_grids=True,
            device=device,
        )
        if points:
            s.place_grid(mpm.grid.reaching(*points, self.targets[0].positions, room=ROOM))
        grid = s.options.grid
        for goal in self.targets[: 1 if points else None]:
            grid.require(goal.positions, "target")
        real, _, mat = TYPES[mpm.precision]
        self.loss = MassLoss(grid, self.targets[0], kind=o.loss, mass_scale=o.mass_scale, dtype=real, device=s.device)
        self._places = PlaceLoss(s) if o.places and o.loss == "log" else None
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
            for name in ("any_searching", "stale", "left"):
                setattr(self._search, name, wp.zeros(1, dtype=int))
            self._accepted_now = wp.zeros(worlds, dtype=int)
            names = ("accepted", "first_moment", "second_moment", "first_trial", "second_trial", "direction")
            self._accepted, self._first, self._second, self._first_trial, self._second_trial, self._direction = (
                wp.zeros(shape, dtype=mat) for _ in names
            )
        self._kept = _Kept(s, self.segments * len(self.targets))
        self._graph: wp.Graph | None = None

    @property
    def segments(self) -> int:
        """Most segments to a target."""
        return -(-self.options.frame_count // self.options.segment_length)

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
        s = self.simulation
        if file is not None and s.world_count > 1:
            raise ConfigError(f"file: holds one morph, there are {s.world_count}", hint="save the runs one by one")
        self._log = log = _Log(
            self.fingerprint,
            tuple(names),
            np.zeros((len(self.targets) + 1, 3)) if offsets is None else np.asarray(offsets, dtype=np.float64),
            self.notes,
        )
        self._kept.begin()
        if file is not None and Path(file).exists():
            self._resume(MorphRun.load(file), file)
        due = 0.0
        for target in range(len(log.ends), len(self.targets)):
            self._aim(target)
            while log.segment_count < sum(self._settling(target)):
                self._set_up_segment(target)
                try:
                    loss = self._find_segment(target)
                except (ConfigError, SolverDiverged) as error:
                    if not log.segment_count:
                        raise
                    log.notes = (*log.notes, f"ended after {log.segment_count} segments: {error}")
                    warnings.warn(log.notes[-1], RuntimeWarning, stacklevel=2)
                    return self._runs(file)
                log.losses.append(loss)
                self._kept.keep()
                if progress is not None:
                    progress(log.segment_count - 1, float(loss.max()))
                now = time.monotonic()
                if file is not None and now >= due:
                    self._runs(file)
                    due = time.monotonic() + WRITING * (time.monotonic() - now)
            log.ends.append(log.segment_count)
        return self._runs(file)

    def _find_segment(self, target: int) -> Array:
        """Plan a segment and return its losses, (W,); with a grid that follows on one where it has room.

        Raises:
            ConfigError: If that grid does not fit into the memory limit.
            SolverDiverged: If no control keeps the particles on the grid and finite.
        """
        if self.options.grid == "follow":
            self._follow(target)
        self._run_segment()
        self._kept.stow()
        loss, failed = self._kept.record.status.numpy().T
        if failed.any():
            self.simulation.check()
        return np.array(loss)

    def _follow(self, target: int) -> None:
        """Bring the grid to where particles, moving on, and the target have room."""
        s = self.simulation
        grid, duration = s.options.grid, s.step_count * s.options.dt
        x, v = (array.numpy().astype(np.float64).reshape(-1, 3) for array in (s.first.x, s.first.v))
        moved = x + duration * v
        if np.isfinite(moved).all():
            self._place(grid.reaching(x, moved, self.targets[target].positions, room=ROOM), target)

    def _place(self, grid: Grid, target: int) -> None:
        """Take another part of the grid's nodes; a graph is captured again if arrays changed with it."""
        s = self.simulation
        if grid == s.options.grid:
            return
        self._kept.flush()
        if s.place_grid(grid):
            self._graph = None
        self.loss.place(grid, self.targets[target])
        if self._places is not None:
            self._places.place(grid, self.targets[target])

    def _aim(self, target: int) -> None:
        """Turn to a target."""
        if self.options.grid == "follow":
            self._follow(target)
        self.loss.aim(self.targets[target])
        if self._places is not None:
            self._places.place(self.loss.grid, self.targets[target])
            self._places.aim(self._find_places(target))
        log = self._log
        if len(log.first_losses) == target:
            self._find_loss_of(self.simulation.first)
            log.first_losses.append(self._search.trial_loss.numpy().copy())
            if not log.losses:
                log.losses.append(log.first_losses[0])
        settles = self._settling(target)[1] > 0
        goal = self._goal(target) if settles else np.full(self.simulation.world_count, -np.inf)
        self._kept.record.goal.assign(goal)

    def _find_places(self, target: int) -> Array:
        """Return a place in the target for every particle, from where its turn came [m], (W, N, 3)."""
        s, log = self.simulation, self._log
        begun = log.ends[target - 1] if target else 0
        resumed = log.segment_count > begun
        x = wp.array(self._kept.positions[begun], dtype=s.first.x.dtype, device=s.device) if resumed else s.first.x
        points, goal = x.numpy().astype(np.float64), self.targets[target]
        grid = s.options.grid.reaching(points.reshape(-1, 3), goal.positions, room=0)
        loss = MassLoss(grid, goal, dtype=self.loss.dtype, device=s.device)
        mass = wp.zeros((s.world_count, *grid.shape), dtype=self.loss.dtype, device=s.device)
        loss.scatter(x, s.mass, mass)
        full = loss.target_mass.numpy()[0]
        return np.stack([transported(x, m, full, grid) for x, m in zip(points, mass.numpy(), strict=True)])

    def _goal(self, target: int) -> Array:
        """Return the losses with which a target is reached, (W,)."""
        accuracy = self.options.target_accuracy
        first = self._log.first_losses[target]
        return np.full_like(first, -np.inf) if accuracy is None else (1.0 - accuracy) * first

    def _settling(self, target: int) -> tuple[int, int]:
        """Return how many segments of the run end before a target settles or is left, and how many settle."""
        o, log = self.options, self._log
        settling = int(o.settling * self.segments) if target + 1 == len(self.targets) else 0
        begun, goal = log.ends[target - 1] if target else 0, self._goal(target)
        reached = [k for k, loss in enumerate(log.losses[begun + 1 :], 1) if (loss <= goal).all()]
        return begun + min([self.segments - settling, *reached]), settling

    def _set_up_segment(self, target: int) -> None:
        """Tell the device what differs in the segment to come: weights, and whether it settles for sure."""
        log = self._log
        begun = log.ends[target - 1] if target else 0
        first, settling = self._settling(target)
        settles = settling > 0 and log.segment_count + 1 >= first
        if self._places is not None:
            done = (log.segment_count - begun) / self.segments
            self._places.weigh(max(0.0, 1.0 - done / self.options.places), float(not settles))
        self._kept.record.settling.fill_(int(settles))

    @property
    def fingerprint(self) -> str:
        """SHA-256 of bodies, targets and options."""
        found = hashlib.sha256(repr(self.options).encode())
        for body in (*self.simulation.bodies, *self.targets):
            limit = () if body.yield_stress is None else (body.yield_stress,)
            found.update(repr((body.count, body.material, *limit)).encode())
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
        self._kept.take(run)
        log.losses, log.first_losses = ([loss[None] for loss in row] for row in (run.losses, run.first_losses))
        log.ends = list(run.ends)
        log.counts = (run.gradient_count, run.trial_count)
        log.names, log.offsets = run.names, run.offsets
        ends = (run.positions[-1], run.velocity, run.affine_velocity, run.deformation[-1])
        s.start(*(value[None] for value in ends))

    def _runs(self, file: str | os.PathLike[str] | None) -> list[MorphRun]:
        """Return the runs as they are, and write that of a file."""
        s, log = self.simulation, self._log
        self._kept.flush()
        counts = (self._search.gradient_count.numpy(), self._search.trial_count.numpy())
        v, C = s.first.v.numpy(), s.first.C.numpy()
        found = [
            MorphRun(
                **self._kept.of_world(w, body.count),
                losses=np.array([loss[w] for loss in log.losses]),
                first_losses=np.array([loss[w] for loss in log.first_losses]),
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

    def _find_loss_of(self, state: ParticleState) -> None:
        """Find the losses of a state, on the fine grid alone."""
        s = self.simulation
        s.scatter_mass(state)
        self.loss.evaluate(s.grid_mass, self._search.trial_loss, s.grid_mass_bar)

    def _run_segment(self) -> None:
        """Find the controls of the next segment, step through it and hand over to the next; nothing is read back."""
        if self._graph is None:
            self._warm_up()
            with wp.ScopedCapture(device=self.simulation.device) as capture:
                self._plan_segment()
            self._graph = capture.graph
        assert self._graph is not None
        wp.capture_launch(self._graph)

    def _warm_up(self) -> None:
        """Run every kernel of a segment once and forget what they did: compiles, and allocates what a graph needs."""
        s, search = self.simulation, self._search
        changed = (*s.first.arrays, search.gradient_count, search.trial_count, self._kept.record.count)
        begin = [(array, wp.clone(array)) for array in changed]
        self._begin_segment(self.options.iteration_count)
        self._descend()
        self._end_segment()
        for array, value in begin:
            wp.copy(array, value)

    def _plan_segment(self) -> None:
        self._begin_segment(self.options.pass_count * self.options.iteration_count)
        wp.capture_while(self._search.left, self._descend)
        self._end_segment()

    def _begin_segment(self, gradients: int) -> None:
        """Begin without control."""
        for array in (self._accepted, self._first, self._second, self.simulation.control):
            array.zero_()
        self._evaluate()
        self._per_world(judge_start, [self._search, self.simulation.failure, gradients])

    def _end_segment(self) -> None:
        """Judge the segment, begin the next where it ends, and keep that."""
        s, kept = self.simulation, self._kept
        self._find_loss_of(s.last)
        wp.launch(end_segment, 1, inputs=[self._search, s.failure, kept.record], device=s.device)
        inputs = [kept.record, *s.last.arrays, s.control, *s.first.arrays, kept.x, kept.v, kept.F, kept.control]
        wp.launch(hand_over, (s.world_count, s.count), inputs=inputs, device=s.device)

    def _descend(self) -> None:
        """Take a gradient and step along it."""
        o, s = self.options, self.simulation
        self._per_world(begin_gradient, [self._search, o.step_length, o.iteration_count])
        control_bar = self.loss.gradient(s, self._places)[1].control
        threads = NORM_THREADS if s.device.is_cuda else 1
        self._per_layer(gradient_norm, [control_bar, self._search.norm, threads], threads)
        self._per_world(begin_search, [self._search, wp.float64(o.gradient_tolerance), o.iteration_count])
        moments = [self._first, self._second, self._first_trial, self._second_trial]
        self._per_layer(adam_direction, [self._search, control_bar, *moments, self._direction])
        wp.capture_while(self._search.any_searching, self._try)
        wp.capture_while(self._search.stale, self._restore)
        wp.launch(end_gradient, 1, inputs=[self._search], device=s.device)

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
        if self._places is not None:
            self._places.add(self._search.trial_loss)

    def _per_world(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        wp.launch(kernel, self.simulation.world_count, inputs=inputs, device=self.simulation.device)

    def _per_layer(self, kernel: Callable[..., object], inputs: list[object], threads: int | None = None) -> None:
        """Launch a kernel with the particles of a layer after another, arrays (L, W, N) being given layer by layer."""
        s = self.simulation
        for layer in range(s.layer_count):
            of_layer = [a[layer] if isinstance(a, wp.array) and a.ndim == 3 else a for a in inputs]
            wp.launch(kernel, (s.world_count, threads or s.count), inputs=of_layer, device=s.device)
