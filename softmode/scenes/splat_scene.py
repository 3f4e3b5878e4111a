"""`SplatScene`: soft objects with their splats among fixed shapes, without a robot: physics, pictures, energies."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.status import status_reasons
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.splats.camera import CameraOptions, SplatCamera
from softmode.splats.pinhole import PinholeCamera
from softmode.splats.rasterizer import SplatArrays
from softmode.splats.splats import Splats


class FrameSink(Protocol):
    """What takes pictures one by one, such as a film (:class:`softmode.viz.film.Film`)."""

    def add(self, frame: NDArray[np.uint8], rate: int, /) -> None:
        """Add a picture, shape (height, width, 3), of a film with ``rate`` pictures per second."""
        ...


@dataclass(frozen=True, kw_only=True)
class PlacedObject:
    """A soft object at its place."""

    thing: SoftObject
    """The object; several places may share one."""
    position: tuple[float, float, float]
    """Where its centre of mass starts [m]."""
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """How it is turned, shape (3, 3)."""
    material: Material = field(default_factory=lambda: Material(youngs_modulus=1.0e5, density=250.0))
    """What it is made of."""
    splats: Splats | None = None
    """Its splats in other colours; None for those of the object."""


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
    """One world of soft objects and fixed shapes. Time and pictures are captured in graphs.

    Args:
        fixtures: Builder with the shapes that do not move (body -1); it is added to.
        objects: The soft objects.
        cameras: Cameras of one size; none draws nothing.
        dt: Physics step [s].
        steps_per_frame: Physics steps of a frame; even.
        options: How the soft step is solved.
        camera_options: Light and background.
        device: Warp device; the default one if None.

    Raises:
        ConfigError: If there is no object, or the number of steps is odd.
    """

    def __init__(
        self,
        fixtures: newton.ModelBuilder,
        objects: Sequence[PlacedObject],
        *,
        cameras: Sequence[PinholeCamera] = (),
        dt: float = 1.0 / 240.0,
        steps_per_frame: int = 8,
        options: SolverReducedOptions | None = None,
        camera_options: CameraOptions | None = None,
        device: Any = None,
    ) -> None:
        """Build model, solver, skins and camera."""
        if not objects:
            raise ConfigError("objects is empty", hint="give at least one PlacedObject")
        if steps_per_frame < 2 or steps_per_frame % 2:
            raise ConfigError(f"steps_per_frame must be even and at least 2, got {steps_per_frame}")
        self.objects, self.dt, self.steps_per_frame = tuple(objects), dt, steps_per_frame
        for placed in self.objects:
            add_reduced_body(
                fixtures,
                placed.thing.body,
                material=placed.material,
                position=placed.position,
                rotation=placed.rotation,
            )
        self.model: Any = fixtures.finalize(device=device)
        bodies = {id(placed.thing.body): placed.thing.body for placed in self.objects}
        self.solver = SolverReduced(self.model, list(bodies.values()), options=options)
        self.state, self._scratch = self.model.state(), self.model.state()
        self._step_graph: Any = None
        self._frame_graph: Any = None
        self._build_camera(cameras, camera_options)

    def _build_camera(self, cameras: Sequence[PinholeCamera], options: CameraOptions | None) -> None:
        """Upload the splats, tie each object's to its body, make the camera."""
        self.camera: SplatCamera | None = None
        if not cameras:
            return
        device = self.model.device
        shown = [placed.splats or placed.thing.splats for placed in self.objects]
        self.splats = SplatArrays.from_splats(shown, device=device)
        self._skins = [
            SkinSplats(s.means, s.covariances(), p.thing.basis, p.thing.grad_basis, device=device)
            for s, p in zip(shown, self.objects, strict=True)
        ]
        self._first = np.concatenate([[0], np.cumsum([s.count for s in shown])]).tolist()
        self.camera = SplatCamera(self.model, self.splats, cameras, options=options)

    # -- time and pictures --------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Take the physics steps of one frame."""
        if self._step_graph is None:
            start = self.model.state()
            start.assign(self.state)
            self._two_steps()  # compiles
            with wp.ScopedCapture(device=self.model.device) as capture:
                for _ in range(self.steps_per_frame // 2):
                    self._two_steps()
            self._step_graph = capture.graph
            self.state.assign(start)
            self.solver.status.zero_()
        wp.capture_launch(self._step_graph)

    def _two_steps(self) -> None:
        """Step there and back between the two states."""
        self.solver.step(self.state, self._scratch, None, None, self.dt)
        self.solver.step(self._scratch, self.state, None, None, self.dt)

    def draw(self, name: str | None = None) -> NDArray[np.uint8]:
        """Return the picture of a camera, the first if no name is given, shape (height, width, 3).

        Raises:
            ConfigError: If the scene has no such camera.
        """
        if self.camera is None:
            raise ConfigError("the scene has no camera", hint="pass cameras to SplatScene")
        if self._frame_graph is None:
            self._draw(self.camera)
            with wp.ScopedCapture(device=self.model.device) as capture:
                self._draw(self.camera)
            self._frame_graph = capture.graph
        wp.capture_launch(self._frame_graph)
        return self.camera.images(name or self.camera.cameras[0].name).numpy()[0].copy()

    def _draw(self, camera: SplatCamera) -> None:
        """Deform the splats of every object and draw."""
        start: Any = self.model.softmode.function_start
        q, splats = self.state.softmode.q, self.splats
        for i, skin in enumerate(self._skins):
            skin.launch(
                q,
                start[i : i + 1],
                splats.means,
                splats.covariances,
                rotations=splats.rotations,
                first_splat=self._first[i],
            )
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
            self.advance()
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
        count = self.objects[index].thing.body.surface_count
        return self.state.particle_q.numpy()[start : start + count].astype(np.float64)

    def kinetic_energy(self) -> float:
        """Return the kinetic energy of all objects, rho V / 2 sum_k |dq_k/dt|^2 [J]; the functions are orthonormal."""
        start, qd = self.model.softmode.function_start.numpy(), self.state.softmode.qd.numpy()
        total = 0.0
        for placed, first in zip(self.objects, start, strict=True):
            body = placed.thing.body
            mass = placed.material.density * body.volume
            total += 0.5 * mass * float((qd[first : first + body.function_count] ** 2).sum())
        return total

    def soft_overlap(self) -> float:
        """Return how deep the surface of an object was inside another at the start of the last step [m]."""
        pairs = self.solver.view.pairs
        if pairs is None:
            return 0.0
        count = np.array([placed.thing.body.surface_count for placed in self.objects])
        found = pairs.near.numpy().astype(bool)[:, None] & (np.arange(pairs.gap.shape[1]) < count[:, None])
        gap = np.where(found[:, :, None] & (pairs.other.numpy() >= 0), pairs.gap.numpy(), 0.0)
        return float(max(-gap.min(), 0.0))
