"""What a rerun logger reads: a scene of one's own, or an environment with its task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol, runtime_checkable

import newton
import numpy as np
import warp as wp

from softmode.deformables.model.status import status_reasons
from softmode.deformables.solver.solver_base import ReducedSolver
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.scenes.splat_scene import SplatScene
from softmode.scenes.table_scene import TableScene
from softmode.splats.cameras.camera import SplatCamera
from softmode.splats.splats import Splats

Numbers = Mapping[str, float | Sequence[float]]
"""Numbers by path."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RerunScene:
    """What a :class:`softmode.viz.RerunLogger` shows of a model that you step yourself.

    ``record`` is then called with the state and its time.
    """

    model: newton.Model
    """The model."""
    solver: ReducedSolver
    """What moves its soft bodies."""
    objects: Sequence[SoftObject | None] = ()
    """The soft bodies of a world in the order in which they were added, None for one without splats."""
    control: newton.Control | None = None
    """What drives the joints; their targets are recorded."""
    cameras: Sequence[SplatCamera] = ()
    """Cameras whose last pictures are recorded; render them before ``record``."""


class ParameterColumns(Protocol):
    """The parameters of the worlds of a task."""

    parameters: Mapping[str, object]
    """What may be drawn, by name."""
    values: wp.array
    """What was drawn, shape (world_count, columns)."""

    def columns(self, name: str) -> slice:
        """Return the columns of a parameter."""
        ...


class RecordedEpisodes(Protocol):
    """How the episodes of all worlds go on, as :class:`softmode.envs.episodes.Episodes` tells; each (world_count,)."""

    elapsed: wp.array
    """Steps of the episode."""
    reward: wp.array
    """Reward of the step."""
    end: wp.array
    """Why the episode ended, one of `RecordedTask.end_reasons`."""


@runtime_checkable
class RecordedTask(Protocol):
    """A task that runs in worlds of this process, as :class:`softmode.envs.task.Task` does."""

    scene: TableScene
    """Where it happens."""
    table: ParameterColumns
    """What was drawn for each episode."""
    episodes: RecordedEpisodes
    """How far each episode is, and how it ends."""
    success: wp.array
    """Whether the task counts as solved, shape (world_count,)."""
    end_reasons: type[IntEnum]
    """RUNNING, TIME_LIMIT, and failures."""
    observation: wp.array
    """What the policy sees, shape (world_count, columns)."""
    segments: Mapping[str, tuple[slice, object]]
    """Columns of the observation by name, "finger_force" among them."""
    terms: wp.array
    """Terms of the reward, shape (world_count, at least as many)."""
    term_names: Sequence[str]
    """Their names."""
    metrics: wp.array
    """Metrics, shape (world_count, at least as many)."""
    metric_names: Sequence[str]
    """Their names."""


@dataclass(frozen=True)
class Moment:
    """What a logger shows of one moment."""

    state: newton.State
    """Where everything is."""
    step: int
    """Value of the timeline "step"."""
    time: float
    """Value of the timeline "sim_time" [s]."""


class SceneSource:
    """A :class:`RerunScene`."""

    def __init__(self, scene: RerunScene) -> None:
        """Keep the scene."""
        self.name: str = "scene"
        self.model, self.solver = scene.model, scene.solver
        self.objects: Sequence[SoftObject | None] = scene.objects
        self.control = scene.control
        self._cameras, self._step = scene.cameras, -1

    def moment(self, state: newton.State | None, time: float | None) -> Moment:
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

    def scalars(self, world: int) -> Numbers:
        """Return the solver's iterations and status."""
        return solver_scalars(self.solver, world)

    def remarks(self, world: int) -> Sequence[tuple[str, str]]:
        """Return what the solver complains about."""
        return solver_remarks(self.solver, world)


class TaskSource:
    """A task in its environment; time runs on from episode to episode."""

    def __init__(self, task: RecordedTask, world: int, name: str) -> None:
        """Keep the task; ``world`` is the one whose steps count."""
        scene = task.scene
        if scene.occupancy.slots > 1:
            hint = "record an environment of one object per world"
            raise ConfigError("a recording cannot follow worlds whose number of objects changes", hint=hint)
        self.name, self.model, self.solver = name, scene.model, scene.solver
        self.objects: Sequence[SoftObject | None] = scene.objects_of(world)
        self.control: newton.Control | None = scene.control
        self.task, self._world, self._step, self._elapsed = task, world, -1, 0
        self._drawn = False

    def moment(self, state: newton.State | None, time: float | None) -> Moment:
        """Return the present state of the task's scene."""
        if state is not None or time is not None:
            raise ConfigError("record of an environment takes no state and no time", hint="call record()")
        elapsed = int(self.task.episodes.elapsed.numpy()[self._world])
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
        marker = scene.marker_of(world)
        if not self._drawn or marker is None:
            return None
        assert scene.splats is not None  # it has just drawn them
        means = scene.splats.arrays.means.numpy()[world, scene.splats.columns[-1]]
        return replace(marker, means=means[: marker.count].copy())

    def scalars(self, world: int) -> Numbers:
        """Return reward, its terms, metrics, observation, action, success, solver; no reward before the first step."""
        task, found = self.task, dict(solver_scalars(self.solver, world))
        found["success"] = float(task.success.numpy()[world])
        for k, name in enumerate(task.metric_names):
            found[f"metrics/{name}"] = float(task.metrics.numpy()[world, k])
        seen = task.observation.numpy()[world].astype(float)
        for name, (columns, _) in task.segments.items():
            found[f"observation/{name}"] = seen[columns].tolist()
        found["metrics/finger_force"] = found["observation/finger_force"]
        if int(task.episodes.elapsed.numpy()[world]) > 0:
            found["reward/total"] = float(task.episodes.reward.numpy()[world])
            for k, name in enumerate(task.term_names):
                found[f"reward/terms/{name}"] = float(task.terms.numpy()[world, k])
            found["action"] = task.scene.actions.numpy()[world].astype(float).tolist()
        return found

    def remarks(self, world: int) -> Sequence[tuple[str, str]]:
        """Return begin and end of an episode, and what the solver complains about."""
        task, lines = self.task, list(solver_remarks(self.solver, world))
        if int(task.episodes.elapsed.numpy()[world]) == 0:
            drawn = ", ".join(f"{n} {v}" for n, v in self._parameters(world).items())
            lines.append(("INFO", f"episode begins: {drawn}"))
        reason = task.end_reasons(int(task.episodes.end.numpy()[world])).name.lower()
        if reason != "running":
            lines.append(("INFO" if reason == "time_limit" else "WARN", f"episode ends: {reason}"))
        return lines

    def _parameters(self, world: int) -> dict[str, str]:
        """Return what was drawn at reset, in words."""
        table, values = self.task.table, self.task.table.values.numpy()[world]
        return {
            name: " ".join(f"{v:.3g}" for v in np.atleast_1d(values[table.columns(name)])) for name in table.parameters
        }


Source = SceneSource | TaskSource
"""What a logger reads: model, solver and objects, the present moment, pictures, the marker of a goal, numbers, text."""


def solver_scalars(solver: ReducedSolver, world: int) -> Numbers:
    """Return iterations of the last step and the status bits of a world."""
    return {
        "solver/iterations": float(solver.iteration.numpy()[world]),
        "solver/status": float(solver.status.numpy()[world]),
    }


def solver_remarks(solver: ReducedSolver, world: int) -> list[tuple[str, str]]:
    """Return the names of the status bits that are set."""
    reasons = status_reasons(int(solver.status.numpy()[world]), remedies=True)
    return [("WARN", f"solver: {', '.join(reasons)}")] if reasons else []


def source_of(scene: object, worlds: Sequence[int]) -> Source:
    """Return what reads a scene or an environment.

    Raises:
        ConfigError: If it is neither, or its worlds live in other processes.
    """
    if isinstance(scene, RerunScene):
        return SceneSource(scene)
    if isinstance(scene, SplatScene):
        cameras = tuple(scene.cameras.values())
        parts = {"model": scene.model, "solver": scene.solver, "objects": scene.objects, "control": scene.control}
        return SceneSource(RerunScene(**parts, cameras=cameras))
    env = getattr(scene, "unwrapped", scene)
    task = scene if isinstance(scene, RecordedTask) else getattr(env, "task", None)
    if not isinstance(task, RecordedTask):
        raise ConfigError(
            f"scene is a {type(scene).__name__}",
            hint="pass an environment of softmode, a SplatScene, or RerunScene(model=..., solver=..., objects=...)",
        )
    spec = getattr(env, "spec", None)
    return TaskSource(task, worlds[0], spec.id if spec is not None else type(task).__name__)
