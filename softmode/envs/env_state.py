"""States of an environment: what its next step depends on, taken from worlds, given to worlds, and as files."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.envs.task import Task
from softmode.errors import ConfigError, StateError
from softmode.files import archive_bytes, damage_errors, read_archive, write_archive

VERSION = 1
"""Version of the format of states."""
_KIND = "softmode-env-state"
_OPTIONAL = ("hessian.", "camera.")
"""Parts that an environment may lack, by the first letters of their names."""
_OBJECT = "task.object"
"""Which objects of the set each world has; where all have the same, the owner says it."""
Parts = int | NDArray[Any]
"""How the worlds lie in an array, see `_parts`."""
_SHAPES = "state.softmode.stick_shape"
"""Indices of the shapes that surfaces stick to, which a state counts within the world."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EnvState:
    """The state of one or several worlds: physics, episode, draws; no code, no pictures.

    On CPU an environment that was given a state goes on with the same bits as the one that the state was taken from, if
    their configurations are equal. Objects, robot and task must be the same; ranges and solver options may differ.
    What was drawn for cameras comes along for those that both environments have. Of environments whose worlds have
    different objects both hold the same ones, and a world takes the state of a world with its object.
    """

    owner: dict[str, str]
    """Task, robot and objects that the state belongs to."""
    arrays: dict[str, NDArray[Any]] = field(repr=False)
    """Numbers by name, each of shape (world_count, size)."""
    random: tuple[dict[str, Any] | None, ...] = field(repr=False)
    """State of the generator that draws the seeds of each world; None before the first reset."""

    @property
    def world_count(self) -> int:
        """Number of worlds."""
        return len(self.random)

    def worlds(self, index: Sequence[int] | NDArray[np.integer]) -> Self:
        """Return the state of some of the worlds, in this order; a world may be named several times."""
        chosen = np.asarray(index, int).reshape(-1)
        arrays = {name: values[chosen] for name, values in self.arrays.items()}
        return type(self)(owner=self.owner, arrays=arrays, random=tuple(self.random[i] for i in chosen))

    @classmethod
    def joined(cls, states: Sequence[Self]) -> Self:
        """Return the states of several worlds of one task as one.

        Raises:
            ConfigError: If they have different objects, as those of several processes.
        """
        if any(state.owner != states[0].owner for state in states):
            hint = "make the environment with processes=1"
            raise ConfigError("the processes hold different objects of the set, whose states differ in size", hint=hint)
        arrays = {name: np.concatenate([s.arrays[name] for s in states]) for name in states[0].arrays}
        return cls(owner=states[0].owner, arrays=arrays, random=tuple(one for s in states for one in s.random))

    def to_bytes(self) -> bytes:
        """Return the state as the bytes of an .npz."""
        return archive_bytes(self._header(), self._stored())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state as an .npz.

        Raises:
            StorageError: If the file cannot be written.
        """
        write_archive(path, self._header(), self._stored(), "state")

    @classmethod
    def load(cls, source: str | os.PathLike[str] | bytes) -> Self:
        """Return a state from a file that `save` wrote, or from the bytes of `to_bytes`.

        Raises:
            StateError: If it is damaged or of another version.
        """
        hint = "save it again with this version of softmode"
        header, arrays = read_archive(source, _KIND, VERSION, what="state", hint=hint, error=StateError)
        owner, random = header.get("owner"), header.get("random")
        if not isinstance(owner, dict) or not isinstance(random, list) or not random:
            raise StateError("the state says not whose it is", hint=hint)
        for state in random:
            generator_of(state)
        for name, values in arrays.items():
            if values.ndim != 2 or len(values) != len(random):
                raise StateError(f"the state has arrays for another number of worlds than {len(random)}", hint=hint)
            if not name.startswith("hessian.") and not np.isfinite(values).all():  # those are kept unused, too
                raise StateError(f"{name} of the state holds NaN or infinity", hint=hint)
        return cls(owner=owner, arrays=arrays, random=tuple(random))

    def _header(self) -> dict[str, Any]:
        return {"format": _KIND, "version": VERSION, "owner": self.owner, "random": list(self.random)}

    def _stored(self) -> dict[str, NDArray[Any]]:
        """Return the arrays as numbers that a file may hold."""
        return {name: a.view(np.uint8) if a.dtype == bool else a for name, a in self.arrays.items()}


def checked_state(state: object) -> EnvState:
    """Return a state that was given as one or as bytes.

    Raises:
        StateError: If it is neither, or cannot be read.
    """
    if isinstance(state, bytes):
        return EnvState.load(state)
    if not isinstance(state, EnvState):
        hint = "pass what get_state returned, its to_bytes(), or EnvState.load(file)"
        raise StateError(f"state is a {type(state).__name__}", hint=hint)
    return state


def generator_state(generator: np.random.Generator | None) -> dict[str, Any] | None:
    """Return the state of a generator, as JSON can hold it."""
    return None if generator is None else dict(generator.bit_generator.state)


def generator_of(state: dict[str, Any] | None) -> np.random.Generator | None:
    """Return a generator in a state.

    Raises:
        StateError: If it is no state of one.
    """
    if state is None:
        return None
    made = np.random.Generator(np.random.PCG64(0))
    with damage_errors("state of the random draws", hint="save the state again", error=StateError):
        made.bit_generator.state = state
    return made


def worlds_state(task: Task) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Return whose the state of a task is, and its arrays, each of shape (world_count, size).

    Raises:
        ConfigError: If the scene has grips, which are not part of a state.
    """
    if task.scene.grips:
        raise ConfigError("the scene has grips, which are not part of a state", hint="set scene.grip_slots to 0")
    arrays = {name: _rows(array, parts, task.world_count).copy() for name, array, parts in _parts(task)}
    arrays[_SHAPES] = _shifted(task, arrays[_SHAPES], -1)
    return owner_of(task), arrays


def set_worlds_state(
    task: Task, owner: dict[str, str], arrays: dict[str, NDArray[Any]], mask: NDArray[np.bool_]
) -> None:
    """Give the masked worlds of a task a state; the others keep every bit.

    Args:
        task: The task.
        owner: Whose the state is.
        arrays: Its arrays, each of shape (world_count, size); rows of other worlds are not read.
        mask: Which worlds, shape (world_count,).

    Raises:
        StateError: If the state belongs to another task, robot or object; nothing has changed then.
        ConfigError: If the scene has grips, which are not part of a state.
    """
    now = worlds_state(task)
    _check(owner, arrays, *now)
    before = now[1]
    if _OBJECT in before and not task.scene.occupancy.resampled:
        other = np.flatnonzero(mask & (arrays[_OBJECT] != before[_OBJECT])[:, 0])
        if len(other):
            found = [int(of[_OBJECT][other[0], 0]) for of in (arrays, before)]
            hint = "give a world a state of a world with the same object, see info['object']"
            raise StateError(
                f"world {other[0]} has object {found[1]} of the set, the state object {found[0]}", hint=hint
            )
    values = {name: np.where(mask[:, None], arrays.get(name, rows), rows) for name, rows in before.items()}
    if "hessian.cached" in before and "hessian.cached" not in arrays:
        values["hessian.cached"][mask] = 0  # the next step evaluates its own
    values[_SHAPES] = _shifted(task, values[_SHAPES], 1)
    parts = list(_parts(task))
    chosen = {name: (array, count) for name, array, count in parts}
    _write(*chosen["task.parameters"], values["task.parameters"])
    task.scene.world_mask.assign(mask)
    if task.scene.occupancy.resampled:
        _write(*chosen[_OBJECT], values[_OBJECT])
        task.scene.use_objects()
    task.materials.apply(task.scene.world_mask)
    if task.disturbances is not None:
        task.disturbances.set_drives()
    for name, array, count in parts:
        _write(array, count, values[name])
    task.scene.observe()
    task.write_observation()
    task.film.forget(mask)
    for name in ("task.observation", "task.metrics"):
        _write(*chosen[name], values[name])
    task.pictures.draw()


def owner_of(task: Task) -> dict[str, str]:
    """Return what a state is bound to: task, robot and objects."""
    things = (*task.scene.occupancy.choices, *task.scene.occupancy.others)
    bodies = ", ".join(thing.body.fingerprint[:16] for thing in things)
    robot = hashlib.sha256(repr(task.config.scene.arm).encode()).hexdigest()[:16]
    return {"task": type(task).__name__, "robot": robot, "objects": bodies}


def _check(
    owner: dict[str, str], arrays: dict[str, NDArray[Any]], mine: dict[str, str], have: dict[str, NDArray[Any]]
) -> None:
    """Refuse a state that is not of this task."""
    for what, name in mine.items():
        if owner.get(what) != name:
            raise StateError(
                f"the state's {what} is {owner.get(what)}, the environment's is {name}",
                hint=f"set it in an environment with the same {what}",
            )
    for name in {**arrays, **have}:
        given, wanted = arrays.get(name), have.get(name)
        if given is None or wanted is None:
            fits = name.startswith(_OPTIONAL)
        else:
            fits = given.shape == wanted.shape
        if not fits:
            found = ["absent" if a is None else f"of {a.shape[1]} numbers" for a in (given, wanted)]
            hint = "use the version and the configuration that saved it"
            raise StateError(f"{name} is {found[0]} in the state and {found[1]} in the environment", hint=hint)


def _parts(task: Task) -> Iterator[tuple[str, Any, Parts]]:
    """Yield name and array of all that a step reads and a step before may have written.

    The third entry says in how many equal parts an array has the worlds one after another: 1, or the number of cameras;
    or where each world begins, and the end, where worlds with different objects have different sizes.
    """
    scene, controller = task.scene, task.scene.controller
    held = scene.occupancy
    differ = len(held.choices) > 1
    functions, particles = _starts(task) if differ and not held.resampled else (1, 1)
    for owner, name in ((scene.state, "state"), (scene.control, "control")):
        for field_name, array in _fields(owner, name):
            of_body = ".softmode.q" in field_name
            of_surface = (
                ".particle_" in field_name or ".softmode.stick_" in field_name or ".softmode.dent" in field_name
            )
            yield field_name, array, functions if of_body else particles if of_surface else 1
    if differ or held.slots > 1:
        yield _OBJECT, held.by_world, 1
    tables, data = scene.solver.tables, scene.solver.rigid.mjw_data
    for name in ("commanded_q", "previous_q", "target_position", "target_yaw"):
        yield f"controller.{name}", getattr(controller, name), 1
    for name in ("qacc_warmstart", "act", "time"):
        if getattr(data, name).size:
            yield f"mujoco.{name}", getattr(data, name), 1
    yield "solver.body_wrench", tables.body_wrench, 1
    yield "solver.status", tables.newton.status, 1
    if tables.options.carry_stiffness:
        for name in ("cached", "cached_q", "cached_key"):
            yield f"hessian.{name}", getattr(tables.newton, name), 1
        yield "hessian.points", tables.points.hessian, 1
        yield "hessian.stiffness", tables.arrays.stiffness, 1
    yield "scene.actions", scene.actions, 1
    for name, array in task.state_arrays().items():
        yield f"task.{name}", array, 1
    for (width, height), camera in scene.cameras.items():
        for name, array in camera.variation.state_arrays().items():
            yield f"camera.{width}x{height}.{name}", array, len(array) // task.world_count


def _shifted(task: Task, shapes: NDArray[Any], sign: int) -> NDArray[Any]:
    """Return indices of shapes (world_count, N), -1 for none, less (-1) or plus (1) the first of their world."""
    first = task.scene.model.shape_world_start.numpy()[: task.world_count, None]
    return np.where(shapes < 0, shapes, shapes + sign * first)


def _starts(task: Task) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where the functions and the surface samples of each world begin, and their ends, (world_count + 1,)."""
    scene = task.scene
    bodies = [[thing.body for thing in scene.occupancy.objects_of(world)] for world in range(task.world_count)]
    functions = [sum(body.function_count for body in world) for world in bodies]
    samples = [sum(body.surface_count for body in world) for world in bodies]
    return np.cumsum([0, *functions]), np.cumsum([0, *samples])


def _fields(owner: object, name: str) -> Iterator[tuple[str, wp.array]]:
    """Yield the arrays of a state or a control of Newton, and of the namespaces in it."""
    for key, value in sorted(vars(owner).items()):
        if isinstance(value, wp.array):
            if value.size:
                yield f"{name}.{key}", value
        elif type(value).__name__ == "AttributeNamespace":
            yield from _fields(value, f"{name}.{key}")


def _rows(array: wp.array, parts: Parts, world_count: int) -> NDArray[Any]:
    """Return an array by world, shape (world_count, size); zeros behind the numbers of a smaller world."""
    values = array.numpy()
    if not isinstance(parts, int):
        each = [values[a:b].reshape(-1) for a, b in itertools.pairwise(parts)]
        rows = np.zeros((world_count, max(map(len, each))), values.dtype)
        for row, numbers in zip(rows, each, strict=True):
            row[: len(numbers)] = numbers
        return rows
    return values.reshape(parts, world_count, -1).swapaxes(0, 1).reshape(world_count, -1)


def _write(array: wp.array, parts: Parts, rows: NDArray[Any]) -> None:
    """Write what `_rows` returned."""
    like = array.numpy()
    if not isinstance(parts, int):
        size = like[:1].size
        sizes = size * np.diff(parts)
        rows = np.concatenate([row[:n] for row, n in zip(rows, sizes, strict=True)])
        array.assign(rows.reshape(like.shape).astype(like.dtype))
        return
    array.assign(rows.reshape(len(rows), parts, -1).swapaxes(0, 1).reshape(like.shape).astype(like.dtype))
