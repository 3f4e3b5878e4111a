"""What a step made, as trees of arrays: one world of them, and names where infos hold numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model.status import status_reasons
from softmode.vector_check.tensors import map_tree

Tree = wp.array | np.ndarray | dict[str, "Tree"] | list["Tree"]
"""An array whose first axis is the world, or a dict or list of such trees."""


def named_reasons(infos: dict[str, Any]) -> None:
    """Add the names of the solver's flags to infos in NumPy, with their mask: where any world has a flag."""
    status = infos["solver_status"]
    if not np.any(status):
        return
    names = np.empty(len(status), dtype=object)
    for world, bits in enumerate(status):
        names[world] = status_reasons(int(bits))
    infos["solver_reasons"], infos["_solver_reasons"] = names, infos["_solver_status"] & (status != 0)


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
