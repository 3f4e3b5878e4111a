"""What a rerun logger reads: a scene of one's own, or an environment with its task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import newton
import numpy as np

from softmode.deformables.model.status import status_reasons
from softmode.envs.end_reason import EndReason
from softmode.envs.results import info_arrays
from softmode.envs.task import Task
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.scenes.splat_scene import SplatScene
from softmode.splats.camera import SplatCamera
from softmode.splats.splats import Splats


@dataclass(frozen=True, kw_only=True, eq=False)
class RerunScene:
    """A scene of one's own: what a :class:`softmode.viz.rerun_logger.RerunLogger` shows of it.

    ``record`` is then called with the state and its time.
    """

    model: Any
    """The model."""
    solver: Any
    """Its :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, or one that couples it."""
    objects: Sequence[SoftObject | None] = ()
    """The soft bodies of a world in the order in which they were added, None for one without splats."""
    cameras: Sequence[SplatCamera] = ()
    """Cameras whose last pictures are recorded; render them before ``record``."""


@dataclass(frozen=True)
class Moment:
    """What a logger shows of one moment."""

    state: newton.State
    """Where everything is."""
    step: int
    """Value of the timeline "step"."""
    time: float
    """Value of the timeline "sim_time" [s]."""


class Source(Protocol):
    """What a logger reads."""

    model: Any
    solver: Any
    objects: Sequence[SoftObject | None]
    name: str
    """Name of the recording."""

    def moment(self, state: Any, time: float | None) -> Moment:
        """Return the present moment."""
        ...

    def cameras(self) -> Sequence[SplatCamera]:
        """Return the cameras, with pictures of the present moment."""
        ...

    def marker(self, world: int) -> Splats | None:
        """Return the splats that mark a goal."""
        ...

    def scalars(self, world: int) -> Mapping[str, float | Sequence[float]]:
        """Return numbers by path."""
        ...

    def remarks(self, world: int) -> Sequence[tuple[str, str]]:
        """Return lines of text with their level."""
        ...


class SceneSource:
    """A :class:`RerunScene`."""

    def __init__(self, scene: RerunScene) -> None:
        """Keep the scene."""
        self.name: str = "scene"
        self.model, self.solver = scene.model, scene.solver
        self.objects: Sequence[SoftObject | None] = scene.objects
        self._cameras, self._step = scene.cameras, -1

    def moment(self, state: Any, time: float | None) -> Moment:
        """Return the state that was given."""
        if state is None or time is None:
            raise ConfigError("record of a scene needs its state and time", hint="call record(state, time=seconds)")
        self._step += 1
        return Moment(state, self._step, float(time))

    def cameras(self) -> Sequence[SplatCamera]:
        """Return the cameras as they are."""
        return self._cameras

    def marker(self, world: int) -> Splats | None:
        """Return nothing."""

    def scalars(self, world: int) -> Mapping[str, float | Sequence[float]]:
        """Return the solver's iterations and status."""
        return solver_scalars(self.solver, world)

    def remarks(self, world: int) -> Sequence[tuple[str, str]]:
        """Return what the solver complains about."""
        return solver_remarks(self.solver, world)


class TaskSource:
    """A task in its environment; time runs on from episode to episode."""

    def __init__(self, task: Task, world: int, name: str) -> None:
        """Keep the task; ``world`` is the one whose steps count."""
        scene = task.scene
        self.name, self.model, self.solver = name, scene.model, scene.solver
        self.objects: Sequence[SoftObject | None] = scene.objects
        self.task, self._world, self._step, self._elapsed = task, world, -1, 0
        self._drawn = False

    def moment(self, state: Any, time: float | None) -> Moment:
        """Return the present state of the task's scene."""
        if state is not None or time is not None:
            raise ConfigError("record of an environment takes no state and no time", hint="call record()")
        elapsed = int(self.task.elapsed.numpy()[self._world])
        self._step += max(elapsed - self._elapsed, 1)
        self._elapsed = elapsed
        scene = self.task.scene
        return Moment(scene.state, self._step, self._step / scene.config.control_hz)

    def cameras(self) -> Sequence[SplatCamera]:
        """Draw and return the cameras."""
        scene = self.task.scene
        self._drawn = bool(scene.cameras)
        return [scene.render(size) for size in scene.cameras]

    def marker(self, world: int) -> Splats | None:
        """Return the task's marker where the last picture has it."""
        scene = self.task.scene
        if not self._drawn or scene.marker is None:
            return None
        means: Any = scene.splat_arrays.means
        return replace(scene.marker, means=means.numpy()[world, -scene.marker.count :].copy())

    def scalars(self, world: int) -> Mapping[str, float | Sequence[float]]:
        """Return reward, its terms, metrics, action, success and solver's figures; no reward before the first step."""
        task, found = self.task, dict(solver_scalars(self.solver, world))
        info = info_arrays(task)
        found["success"] = float(info.pop("is_success").numpy()[world])
        terms = info.pop("reward_terms")
        for name in ("parameters", "solver_status", "end_reason"):
            info.pop(name)
        for name, array in info.items():
            found[f"metrics/{name}"] = array.numpy()[world].astype(float).tolist()
        if int(task.elapsed.numpy()[world]) > 0:
            found["reward/total"] = float(task.reward.numpy()[world])
            for name, array in terms.items():
                found[f"reward/terms/{name}"] = float(array.numpy()[world])
            found["action"] = task.scene.actions.numpy()[world].astype(float).tolist()
        return found

    def remarks(self, world: int) -> Sequence[tuple[str, str]]:
        """Return begin and end of an episode, and what the solver complains about."""
        task, lines = self.task, list(solver_remarks(self.solver, world))
        if int(task.elapsed.numpy()[world]) == 0:
            drawn = ", ".join(f"{n} {v}" for n, v in self._parameters(world).items())
            lines.append(("INFO", f"episode begins: {drawn}"))
        reason = EndReason(int(task.end.numpy()[world]))
        if reason != EndReason.RUNNING:
            lines.append(("INFO" if reason == EndReason.TIME_LIMIT else "WARN", f"episode ends: {reason.name.lower()}"))
        return lines

    def _parameters(self, world: int) -> dict[str, str]:
        """Return what was drawn at reset, in words."""
        table, values = self.task.table, self.task.table.values.numpy()[world]
        return {
            name: " ".join(f"{v:.3g}" for v in np.atleast_1d(values[table.columns(name)])) for name in table.parameters
        }


def solver_scalars(solver: Any, world: int) -> dict[str, float | Sequence[float]]:
    """Return iterations of the last step and the status bits of a world."""
    reduced = getattr(solver, "reduced", solver)
    return {
        "solver/iterations": float(reduced.iteration.numpy()[world]),
        "solver/status": float(reduced.status.numpy()[world]),
    }


def solver_remarks(solver: Any, world: int) -> list[tuple[str, str]]:
    """Return the names of the status bits that are set."""
    reasons = status_reasons(int(getattr(solver, "reduced", solver).status.numpy()[world]))
    return [("WARN", f"solver: {', '.join(reasons)}")] if reasons else []


def source_of(scene: Any, worlds: Sequence[int]) -> Source:
    """Return what reads a scene or an environment.

    Raises:
        ConfigError: If it is neither, or its worlds live in other processes.
    """
    if isinstance(scene, RerunScene):
        return SceneSource(scene)
    if isinstance(scene, SplatScene):
        cameras = () if scene.camera is None else (scene.camera,)
        things = [replace(placed.thing, splats=placed.splats or placed.thing.splats) for placed in scene.objects]
        return SceneSource(RerunScene(model=scene.model, solver=scene.solver, objects=things, cameras=cameras))
    env = getattr(scene, "unwrapped", scene)
    task = scene if isinstance(scene, Task) else getattr(env, "task", None)
    if not isinstance(task, Task):
        raise ConfigError(
            f"scene is a {type(scene).__name__}",
            hint="pass an environment of softmode, a SplatScene, or RerunScene(model=..., solver=..., objects=...)",
        )
    spec = getattr(env, "spec", None)
    return TaskSource(task, worlds[0], spec.id if spec is not None else type(task).__name__)
