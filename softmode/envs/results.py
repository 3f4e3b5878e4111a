"""What a task made, as trees of arrays: observations and infos of all worlds or of one, frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import warp as wp

from softmode.deformables.model.status import status_reasons
from softmode.envs.task import Task
from softmode.vector_check.tensors import map_tree

Tree = wp.array | np.ndarray | dict[str, "Tree"] | list["Tree"]
"""An array whose first axis is the world, or a dict or list of such trees."""


def observation_arrays(task: Task, *, final: bool = False) -> Tree:
    """Return the observation of all worlds in the structure of `Task.observation_space`; `final`: before the reset."""
    vector = task.final_observation if final else task.observation
    if task.obs_type == "state":
        keys = task.state_keys()
        return {name: columns_of(vector, columns) for name, columns in keys.items()} if keys else vector
    images: dict[str, Tree] = dict(task.final_images if final else task.images)
    if task.obs_type == "pixels_agent_pos":
        images["agent_pos"] = columns_of(vector, slice(task.agent_size))
    return images["pixels"] if list(images) == ["pixels"] else images


def info_arrays(task: Task, *, final: bool = False) -> dict[str, Tree]:
    """Return the infos of all worlds; with `final`, those of the episodes that ended in this step."""
    success, metrics, parameters, vector, status, index = (task.final_outcome if final else task.outcome).values()
    which = {} if task.object_set is None else {"object": index}
    return {
        **which,
        "is_success": success,
        "success": success,
        "reward_terms": {name: columns_of(task.terms, k) for k, name in enumerate(task.term_names)},
        **{name: columns_of(metrics, k) for k, name in enumerate(task.metric_names)},
        "parameters": {
            name: columns_of(parameters, columns.start if columns.stop - columns.start == 1 else columns)
            for name, columns in ((name, task.table.columns(name)) for name in task.table.parameters)
        },
        "finger_force": columns_of(vector, task.segments["finger_force"][0]),
        "solver_status": status,
        "end_reason": task.end,
    }


def named_reasons(infos: dict[str, Any]) -> None:
    """Add the names of the solver's flags of every world to infos in NumPy, with their mask."""
    status = infos["solver_status"]
    names = np.empty(len(status), dtype=object)
    for world, bits in enumerate(status):
        names[world] = status_reasons(int(bits))
    infos["solver_reasons"], infos["_solver_reasons"] = names, infos["_solver_status"].copy()


def add_object_names(infos: dict[str, Any], names: Sequence[str]) -> None:
    """Add the name of the object of every world to infos in NumPy, with their mask; a tuple where several may be."""
    found = np.empty(len(infos["object"]), dtype=object)
    for world, index in enumerate(infos["object"]):
        found[world] = name_of(index, names)
    infos["object_name"], infos["_object_name"] = found, infos["_object"].copy()


def name_of(index: Any, names: Sequence[str]) -> str | tuple[str, ...]:
    """Return the name of the object of a world; of several the names of those that are there.

    Args:
        index: Which object of the set it is; or that of each slot, -1 for none.
        names: Names of the objects of the set.
    """
    if np.ndim(index):
        return tuple(names[int(k)] for k in index if k >= 0)
    return names[int(index)]


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


def take(tree: Tree, world: int, *, scalars: bool = False) -> Any:
    """Return one world of a tree as NumPy arrays of its own.

    Args:
        tree: The tree.
        world: Index of the world.
        scalars: Whether single numbers become Python's.
    """

    def row(array: wp.array | np.ndarray) -> Any:
        value = (array if isinstance(array, np.ndarray) else array.numpy())[world]
        return value.item() if scalars and value.ndim == 0 else value.copy()

    return map_tree(row, tree)
