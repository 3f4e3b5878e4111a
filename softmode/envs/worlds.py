"""Where the worlds of a vector environment live: in this process, or in one of several child processes.

Warp keeps the scratch memory of tiles, which MuJoCo-Warp's kernels use, once per process on CPU, so that worlds cannot
be shared among threads; processes can share them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from multiprocessing.connection import Connection
from typing import Any, cast

import gymnasium as gym
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.envs.env_state import set_worlds_state, worlds_state
from softmode.envs.handling import HANDLED
from softmode.envs.results import Tree
from softmode.envs.task import Task
from softmode.errors import SoftmodeError, WorkerError
from softmode.pause import collector_paused
from softmode.vector_check.tensors import map_tree

ANSWERED = ("reset", "step", "set_state")
"""Calls whose answer is the result of all worlds."""


class LocalWorlds:
    """A task in this process; results are trees of arrays, overwritten by the next call: on CPU NumPy's, else Warp's.

    Args:
        task_class: The task.
        arguments: What it is made from.
    """

    def __init__(self, task_class: type[Task], arguments: dict[str, Any]) -> None:
        """Build the task."""
        with collector_paused():
            self.task = task_class(**arguments)
        self._result: dict[str, Any] | None = None
        self._actions = host_view(self.task.scene.actions)
        self.parameters = self.task.table.options
        self.segments = {name: columns for name, (columns, _) in self.task.segments.items()}
        self.action_space, self.observation_space = spaces_of(self.task)

    def connect(self) -> None:
        """Do nothing: the task is built."""

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64], options: dict[str, NDArray[np.float32]]) -> None:
        """Start episodes in the masked worlds; a seed below 0 lets the world's draws go on."""
        for some, value in ((mask & (seeds >= 0), seeds), (mask & (seeds < 0), None)):
            if some.any():
                self.task.reset(world_mask=some, seeds=value, options=options)

    def get_state(self) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
        """Return whose the state is, and its arrays by world."""
        return worlds_state(self.task)

    def set_state(
        self, owner: dict[str, str], arrays: dict[str, NDArray[Any]], mask: NDArray[np.bool_], begin: bool
    ) -> None:
        """Give the masked worlds a state; `begin` lets episodes begin there, see :meth:`Episodes.begin`."""
        set_worlds_state(self.task, owner, arrays, mask)
        if begin:
            self.task.episodes.begin(mask)

    def step(self, actions: NDArray[np.float32] | None) -> None:
        """Advance all worlds; None takes the actions that are on the device already."""
        if actions is not None:
            write(actions, self._actions)
        self.task.step()

    def result(self) -> dict[str, Any]:
        """Return what the last reset or step made: always the same arrays, since a task's step is captured."""
        if self._result is not None:
            return self._result
        task = self.task
        made = {
            "observation": observation_arrays(task),
            "state": task.observation,
            "reward": task.episodes.reward,
            "terminated": task.episodes.terminated,
            "truncated": task.episodes.truncated,
            "info": info_arrays(task),
        }
        self._result = result = map_tree(host_view, made)
        return result

    def final(self) -> dict[str, Any]:
        """Return how the episodes that ended in the last step ended."""
        return {"observation": observation_arrays(self.task, final=True), "info": info_arrays(self.task, final=True)}

    def render(self) -> NDArray[np.uint8]:
        """Return a frame per world."""
        return self.task.film.draw(self.task)

    def close(self) -> None:
        """Do nothing."""


class RemoteWorlds:
    """The same in a child process; results are trees of numpy arrays.

    Args:
        task_class: The task.
        arguments: What it is made from; picklable.

    Raises:
        SoftmodeError: What the task raised, here or in any call.
        WorkerError: If the child has died or is closed.
    """

    def __init__(self, task_class: type[Task], arguments: dict[str, Any]) -> None:
        """Start the child; `connect` waits until it is built."""
        context = multiprocessing.get_context()
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, task_class, {**arguments, "progress": None}), daemon=True
        )
        self._process.start()
        theirs.close()
        self._pending = True  # whether an answer is due
        self._result: dict[str, Any] = {}

    def connect(self) -> None:
        """Wait until the task is built."""
        self.parameters, self.segments, self.action_space, self.observation_space = self._receive()

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64], options: dict[str, NDArray[np.float32]]) -> None:
        """Start episodes; see :meth:`LocalWorlds.reset`."""
        self._send("reset", mask, seeds, options)

    def get_state(self) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
        """Return whose the state is, and its arrays by world."""
        self._send("get_state")
        return self._receive()

    def set_state(
        self, owner: dict[str, str], arrays: dict[str, NDArray[Any]], mask: NDArray[np.bool_], begin: bool
    ) -> None:
        """Give the masked worlds a state; `result` waits for it. See :meth:`LocalWorlds.set_state`."""
        self._send("set_state", owner, arrays, mask, begin)

    def step(self, actions: NDArray[np.float32] | None) -> None:
        """Have the child advance its worlds; `result` waits for it."""
        self._send("step", actions)

    def result(self) -> dict[str, Any]:
        """Return what the last reset or step made."""
        self._result = self._receive()
        return self._result

    def final(self) -> dict[str, Any]:
        """Return how the episodes that ended in the last step ended."""
        self._send("final")
        return self._receive()

    def render(self) -> NDArray[np.uint8]:
        """Return a frame per world."""
        self._send("render")
        return self._receive()

    def close(self) -> None:
        """Stop the child."""
        if self._pipe.closed:
            return
        with contextlib.suppress(OSError):
            self._pipe.send(("close", ()))
        if self._pending:  # a large answer that nobody waits for must not hold the child up
            with contextlib.suppress(EOFError, OSError):
                if self._pipe.poll(5.0):
                    self._pipe.recv()
        self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.terminate()
        self._pipe.close()

    def _send(self, name: str, *arguments: object) -> None:
        """Send a call; the answer to an earlier one that an error or an interruption left there is thrown away."""
        if self._pending:
            with contextlib.suppress(SoftmodeError):
                self._receive()
        try:
            self._pipe.send((name, arguments))
        except OSError as error:
            raise self._lost() from error
        self._pending = True

    def _receive(self) -> Any:
        """Return the answer to the last call, or raise the error that it is."""
        try:
            fine, value = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._lost() from error
        self._pending = False
        if not fine:
            raise value
        return value

    def _lost(self) -> WorkerError:
        """Return the error of a child that no longer answers."""
        if self._pipe.closed:
            return WorkerError("the environment is closed", hint="make it again")
        self._process.join(timeout=1.0)
        return WorkerError(
            f"a process that holds worlds has died (exit code {self._process.exitcode})",
            hint="make the environment again",
        )


def _serve(pipe: Connection, task_class: type[Task], arguments: dict[str, Any]) -> None:
    """Build the worlds and do what the parent says until it hangs up or dies."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with wp.ScopedDevice("cpu"):
            worlds = LocalWorlds(task_class, arguments)
        pipe.send((True, (worlds.parameters, worlds.segments, worlds.action_space, worlds.observation_space)))
    except (EOFError, KeyboardInterrupt, ConnectionError):
        return
    except Exception as error:  # the parent reports what went wrong here
        pipe.send((False, _portable(error)))
        return
    try:
        while True:
            name, given = pipe.recv()
            if name == "close":
                return
            try:
                value = getattr(worlds, name)(*given)
                answer = (True, map_tree(_on_host, worlds.result() if name in ANSWERED else value))
            except Exception as error:
                answer = (False, _portable(error))
            pipe.send(answer)
    except (EOFError, KeyboardInterrupt, ConnectionError):
        return


def _end_with_parent() -> None:
    """End this process when its parent dies, in whatever it is: the pipe does not say so, both ends lie open here."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _portable(error: Exception) -> Exception:
    """Return an error that can travel to another process."""
    if isinstance(error, SoftmodeError):
        return error
    return WorkerError(
        f"{type(error).__name__} in a process that holds worlds: {error}",
        hint="try processes=1 for the whole traceback",
    )


def _on_host(value: object) -> object:
    """Return a Warp array as a NumPy array, and anything else as it is."""
    return value.numpy() if isinstance(value, wp.array) else value


def observation_arrays(task: Task, *, final: bool = False) -> Tree:
    """Return the observation of all worlds in the structure of its space; `final`: before the reset."""
    vector = (task.final_outcome if final else task.outcome)["observation"]
    if task.obs_type == "state":
        keys = task.layout.keys
        return {name: columns_of(vector, columns) for name, columns in keys.items()} if keys else vector
    images: dict[str, Tree] = dict(task.pictures.final_images if final else task.pictures.images)
    if task.obs_type == "pixels_agent_pos":
        images["agent_pos"] = columns_of(vector, slice(task.layout.agent_size))
    return images["pixels"] if list(images) == ["pixels"] else images


def spaces_of(task: Task) -> tuple[gym.spaces.Box, gym.Space]:
    """Return the spaces of one world's actions, in [-1, 1], and of its observation, with finite bounds."""
    actions = gym.spaces.Box(-1.0, 1.0, (task.scene.controller.action_size,), np.float32)
    layout = task.layout
    if task.obs_type == "state":
        keys: dict[str, gym.Space] = {name: layout.space(columns) for name, columns in layout.keys.items()}
        return actions, gym.spaces.Dict(keys) if keys else layout.space(slice(0, len(layout.low)))
    spaces = task.pictures.spaces()
    if task.obs_type == "pixels_agent_pos":
        spaces["agent_pos"] = layout.space(slice(0, layout.agent_size))
    return actions, spaces["pixels"] if list(spaces) == ["pixels"] else gym.spaces.Dict(spaces)


def info_arrays(task: Task, *, final: bool = False) -> dict[str, Tree]:
    """Return the infos of all worlds; with `final`, those of the episodes that ended in this step."""
    outcome = task.final_outcome if final else task.outcome
    success, safe, handled, metrics, parameters, vector, status, index = outcome.values()
    which = {} if task.config.object_set is None else {"object": index}
    return {
        **which,
        "is_success": success,
        "is_safe_success": safe,
        "success": success,
        **{name: columns_of(handled, k) for k, name in enumerate(HANDLED)},
        "reward_terms": {name: columns_of(task.terms, k) for k, name in enumerate(task.term_names)},
        **{name: columns_of(metrics, k) for k, name in enumerate(task.metric_names)},
        "parameters": {
            name: columns_of(parameters, columns.start if columns.stop - columns.start == 1 else columns)
            for name, columns in ((name, task.table.columns(name)) for name in task.table.parameters)
        },
        "finger_force": columns_of(vector, task.segments["finger_force"][0]),
        "solver_status": status,
        "end_reason": task.episodes.end,
    }


def columns_of(array: wp.array, columns: int | slice) -> wp.array:
    """Return a view of one column, shape (world_count,), or of several."""
    return cast(wp.array, array[:, columns])


def host_view(array: wp.array) -> wp.array | np.ndarray:
    """Return an array on CPU as a NumPy array of the same memory, and one on another device as it is."""
    device: Any = array.device
    return array.numpy() if device.is_cpu else array


def write(values: np.ndarray, out: wp.array | np.ndarray) -> None:
    """Write numbers of the host to what `host_view` returned."""
    if isinstance(out, np.ndarray):
        out[:] = values
    else:
        out.assign(values)
