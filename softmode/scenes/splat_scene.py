"""`SplatScene`: soft objects with their splats among rigid shapes, fixed or not: physics, pictures, energies."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.contact.dents import contact_dents
from softmode.deformables.coupling.rigid_solver import mujoco_warnings
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.model.neighbours import listed, movable_bodies
from softmode.deformables.model.status import status_reasons
from softmode.deformables.solver.observables import ReducedObservableKind
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.deformables.tools.gaps import rigid_gaps, warn_of_overlaps
from softmode.deformables.tools.grips import GripOptions, Grips, add_grip_slots
from softmode.errors import ConfigError
from softmode.objects.placed import Placed
from softmode.pause import cut_circles
from softmode.radiance.march import MarchOptions
from softmode.scenes.binding import BoundSplats
from softmode.scenes.capture import capture_graph, capture_step, require_even
from softmode.scenes.fixture import Fixture, add_fixture
from softmode.scenes.recording import Recording
from softmode.scenes.scene import cameras_by_size, marched_fields
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.stages import KERNELS, stage


@cache
def _say_once(note: str) -> None:
    """Write a note to the log of softmode, which ends on the standard error unless logging is set up otherwise."""
    logging.getLogger("softmode").warning("SplatScene: %s", note)


class FrameSink(Protocol):
    """What takes pictures one by one, such as a film (:class:`softmode.viz.film.Film`)."""

    def add(self, frame: NDArray[np.uint8], rate: int, /) -> None:
        """Add a picture, shape (height, width, 3), of a film with ``rate`` pictures per second."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """What the physics did while it was filmed."""

    peak_energy: float
    """Largest kinetic energy [J]."""
    energy: float
    """Kinetic energy at the end [J]."""
    depth: float
    """Deepest any surface was in a fixed shape [m]."""
    overlap: float
    """Deepest any surface was in another object [m]."""
    milliseconds: float
    """Mean time of a physics step [ms]."""
    reasons: tuple[str, ...]
    """Status bits that were set in any step, by name."""

    def __str__(self) -> str:
        """Return two lines for people."""
        return (
            f"kinetic energy {self.peak_energy:.3g} J at most, {self.energy:.1e} J at the end; "
            f"status: {', '.join(self.reasons) or 'fine'}; {self.milliseconds:.1f} ms per step\n"
            f"deepest in a fixed shape {1e3 * self.depth:.2f} mm, in each other {1e3 * self.overlap:.2f} mm"
        )


class SplatScene:
    """A scene of one's own: soft objects among rigid shapes in one world. Time and pictures are captured in graphs.

    Where something rigid can move, such as a free body or a joint, MuJoCo moves it in one step with the objects
    (:class:`softmode.deformables.SolverCoupledReduced`), and :attr:`notes` and a line of the log "softmode" say so.
    Otherwise :class:`softmode.deformables.SolverReduced` steps the objects alone.

    Args:
        fixtures: Shapes that do not move; or a builder with whatever is rigid, to which the objects are added.
        objects: The soft objects.
        cameras: What to draw; none draws nothing.
        dt: Physics step [s].
        steps_per_frame: Physics steps of a frame; even.
        options: How the soft step is solved.
        rigid: Makes MuJoCo's solver of the model where something rigid can move; default ``SolverMuJoCo``, whose room
            for contacts may be too small: ``lambda model: SolverMuJoCo(model, njmax=400, nconmax=100)``.
        camera_options: Light and background.
        grip_slots: Points of each object that may be gripped while the scene runs; see :attr:`grips`.
        grip_options: How stiff such grips are.
        march: March rays through the radiance fields of all objects that have one, instead of drawing splats baked of
            them, and how; those of `ObjectConfig.march` are marched without it.
        device: Warp device; the default one if None.

    Raises:
        ConfigError: If there is no object, the number of steps is odd, or there is nothing to march.
    """

    def __init__(
        self,
        fixtures: newton.ModelBuilder | Sequence[Fixture],
        objects: Sequence[Placed],
        *,
        cameras: Sequence[PinholeCamera] = (),
        dt: float = 1.0 / 240.0,
        steps_per_frame: int = 8,
        options: SolverReducedOptions | None = None,
        rigid: Callable[[newton.Model], SolverMuJoCo] = SolverMuJoCo,
        camera_options: CameraOptions | None = None,
        grip_slots: int = 0,
        grip_options: GripOptions | None = None,
        march: bool | MarchOptions = False,
        device: wp.DeviceLike = None,
    ) -> None:
        """Build model, solver, splats and cameras."""
        if not objects:
            raise ConfigError("objects is empty", hint="give at least one Placed")
        require_even("steps_per_frame", steps_per_frame)
        self.placed, self.dt, self.steps_per_frame = tuple(objects), dt, steps_per_frame
        self.objects = tuple(placed.object for placed in self.placed)
        """The soft objects; :attr:`placed` says where they start."""
        if isinstance(fixtures, newton.ModelBuilder):
            builder = fixtures
        else:
            builder = newton.ModelBuilder()
            for fixture in fixtures:
                add_fixture(builder, fixture)
        for placed in self.placed:
            instance = placed.add_to(builder)
            if grip_slots:
                add_grip_slots(builder, instance, grip_slots)
        self.model: Any = builder.finalize(device=device)  # Any: it carries the attributes of soft bodies
        cut_circles(self.model)
        moving = movable_bodies(self.model)
        self.notes: tuple[str, ...] = ()
        """What the scene decided by itself."""
        if moving:
            self.notes = (f"{listed(moving)} can move: SolverCoupledReduced steps the scene, with MuJoCo",)
            _say_once(self.notes[0])
        bodies = list({id(thing.body): thing.body for thing in self.objects}.values())
        self.solver: SolverReduced | SolverCoupledReduced
        with stage(KERNELS), mujoco_warnings():
            if moving:
                self.solver = SolverCoupledReduced(self.model, bodies, options=options, rigid=rigid(self.model))
            else:
                self.solver = SolverReduced(self.model, bodies, options=options)
        self.state: Any = self.model.state()
        self._scratch, self.control = self.model.state(), self.model.control()
        for state in (self.state, self._scratch):
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, state)
        self.grips = tuple(
            Grips(self.solver, i, slot_count=grip_slots, options=grip_options)
            for i in range(len(self.objects) if grip_slots else 0)
        )
        """Grips of each object, that pull and hold it while the scene runs; none without slots."""
        if march and all(thing.radiance is None for thing in self.objects):
            raise ConfigError("march: no object has a radiance field", hint="load one, or leave it out")
        self.fields = marched_fields(self.solver, self.objects, march) if cameras else None
        """Radiance fields that cameras march through; None if there are none."""
        self.splats = BoundSplats(self.model, self.objects) if cameras else None
        """The splats of the objects as cameras see them, those baked of marched fields for their shadows; None without
        cameras."""
        self.cameras: dict[tuple[int, int], SplatCamera] = {}
        """The cameras by the width and height of their pictures [px]."""
        if cameras:
            self.cameras = cameras_by_size(
                self.model, self.splats, cameras, options=camera_options, overlay=self.fields
            )
        self._step_graph: Recording | None = None
        self._draw_graph: Recording | None = None

    # -- time and pictures --------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Take the physics steps of one frame; the first time, say what starts inside something else."""
        if self._step_graph is None:
            self._step_graph = capture_step(self, self._steps)
            self.notes += warn_of_overlaps(self.solver, self.state, self.dt)
        self._step_graph.launch()

    def _steps(self) -> None:
        """Step there and back between the two states."""
        for _ in range(self.steps_per_frame // 2):
            for first, second in ((self.state, self._scratch), (self._scratch, self.state)):
                for grips in self.grips:
                    grips.apply(first, self.control, self.dt)
                self.solver.step(first, second, self.control, None, self.dt)

    def push(self, index: int, force: ArrayLike) -> None:
        """Let forces act on the surface samples of an object, such as those of wind, until others are given.

        They keep their directions while the object turns, so that forces which press it from two sides turn it round
        and pull it: squeeze between fixtures, or by :attr:`grips`.

        Args:
            index: Which object.
            force: One for each sample [N], shape (surface_count, 3), or one for all.

        Raises:
            ConfigError: If they are not finite or of another shape.
        """
        count, given = self.objects[index].body.surface_count, np.asarray(force, dtype=np.float32)
        if given.shape not in ((3,), (count, 3)) or not np.isfinite(given).all():
            raise ConfigError(f"force: expected finite values, shape ({count}, 3) or (3,), got {given.shape}")
        start = int(self.model.softmode.particle_start.numpy()[index])
        for state in (self.state, self._scratch):
            state.particle_f[start : start + count].assign(np.broadcast_to(given, (count, 3)))

    def reset(self) -> None:
        """Put everything back where it was placed, at rest."""
        self.solver.reset(self.state)

    def draw(self, name: str | None = None) -> NDArray[np.uint8]:
        """Return the picture of a camera, the first if no name is given, shape (height, width, 3).

        Raises:
            ConfigError: If the scene has no such camera.
        """
        known = {camera.name: drawn for drawn in self.cameras.values() for camera in drawn.cameras}
        if not known:
            raise ConfigError("the scene has no camera", hint="pass cameras to SplatScene")
        name = next(iter(known)) if name is None else name
        if name not in known:
            raise ConfigError(f"no camera {name!r}, there are {sorted(known)}")
        if self._draw_graph is None:
            self._draw_graph = capture_graph(self._draw, self.model.device)
        self._draw_graph.launch()
        return known[name].images(name).numpy()[0].copy()

    def _draw(self) -> None:
        """Move the splats and draw every camera."""
        if self.splats is not None:
            self.splats.update(self.state)
        if self.fields is not None:
            self.fields.update(self.state)
        for camera in self.cameras.values():
            camera.render(self.state)

    def record(self, film: FrameSink, frame_count: int, depth: Callable[[SplatScene], float]) -> Record:
        """Film the scene's first camera, measuring after every frame; the film is not published yet.

        Args:
            film: Where the pictures go, in real time.
            frame_count: Number of frames.
            depth: Returns how deep the deepest surface sample is in a fixed shape [m].
        """
        peak, deepest, overlap, seconds = 0.0, 0.0, 0.0, 0.0
        for _ in range(frame_count):
            film.add(self.draw(), round(1.0 / (self.dt * self.steps_per_frame)))
            clock = time.perf_counter()
            self.step()
            peak = max(peak, self.kinetic_energy())  # reads back, so that the clock sees the end of the step
            seconds += time.perf_counter() - clock
            deepest, overlap = max(deepest, depth(self)), max(overlap, self.soft_overlap())
        return Record(
            peak_energy=peak,
            energy=self.kinetic_energy(),
            depth=deepest,
            overlap=overlap,
            milliseconds=1e3 * seconds / (frame_count * self.steps_per_frame),
            reasons=status_reasons(int(self.solver.status.numpy()[0])),
        )

    # -- measures -----------------------------------------------------------------------------------------------------

    def surface(self, index: int) -> NDArray[np.float64]:
        """Return the surface samples of an object [m], shape (surface_count, 3)."""
        start = int(self.model.softmode.particle_start.numpy()[index])
        count = self.objects[index].body.surface_count
        return self.state.particle_q.numpy()[start : start + count].astype(np.float64)

    def kinetic_energy(self) -> float:
        """Return the kinetic energy of the soft objects, rho V / 2 sum_k |dq_k/dt|^2 [J]; functions are orthonormal."""
        start, qd = self.model.softmode.function_start.numpy(), self.state.softmode.qd.numpy()
        total = 0.0
        for placed, first in zip(self.placed, start, strict=True):
            body = placed.body
            total += 0.5 * placed.mass * float((qd[first : first + body.function_count] ** 2).sum())
        return total

    def momentum(self) -> NDArray[np.float64]:
        """Return the momentum of the soft objects, sum of m sum_k mean(b_k) dq_k/dt [kg m/s], shape (3,)."""
        start, qd = self.model.softmode.function_start.numpy(), self.state.softmode.qd.numpy()
        total = np.zeros(3)
        for placed, first in zip(self.placed, start, strict=True):
            body = placed.body
            total += placed.mass * (body.mean_basis @ qd[first : first + body.function_count])
        return total

    def momentum_error(self, steps: int) -> float:
        """Take steps one by one; return the largest error of the momentum after two of them [kg m/s].

        The change of momentum of all soft objects is to be what weight and contact gave them in these steps. Grips,
        pins, attachments and forces of :meth:`push` are not counted.

        Args:
            steps: How many; even.
        """
        require_even("steps", steps)
        wanted: Any = self.solver.observables({ReducedObservableKind.INSTANCE_CONTACT_F})
        weight = self.model.gravity.numpy()[0] * sum(placed.mass for placed in self.placed)
        worst = 0.0
        for _ in range(steps // 2):
            expected = self.momentum()
            for first, second in ((self.state, self._scratch), (self._scratch, self.state)):
                self.solver.step(first, second, self.control, None, self.dt, observables=wanted)
                expected += self.dt * (weight + wanted.instance_contact_f.numpy().sum(axis=0))
            worst = max(worst, float(np.linalg.norm(self.momentum() - expected)))
        return worst

    def rigid_gaps(self) -> NDArray[np.float64]:
        """Return the gaps of skins, dents in, to the rigid shapes near them in the last step [m], negative inside."""
        return rigid_gaps(self.solver)

    def soft_overlap(self) -> float:
        """Return how deep the surface of an object was in another at the start of the last step, besides dents [m]."""
        pairs = self.solver.view.pairs
        if pairs is None:
            return 0.0
        count = np.array([thing.body.surface_count for thing in self.objects])
        found = pairs.near.numpy().astype(bool)[:, None] & (np.arange(pairs.gap.shape[1]) < count[:, None])
        gap = np.where(found[:, :, None] & (pairs.other.numpy() >= 0), pairs.gap.numpy(), 0.0)
        held, dents = pairs.held.numpy(), contact_dents(self.solver.view.constraints)
        given = np.where(held >= 0, dents[np.arange(len(dents))[:, None, None], held], 0.0)
        return float(max(-(gap + given).min(), 0.0))
