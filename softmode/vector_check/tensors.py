"""What the environments use of torch's tensors, without importing torch; one world of a tree of arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Tensor(Protocol):
    """A tensor of torch, recognised by its methods."""

    dtype: Any
    shape: tuple[int, ...]
    device: Any

    def detach(self) -> Tensor:
        """Return it without its gradient."""
        ...

    def cpu(self) -> Tensor:
        """Return it on the host."""
        ...

    def numpy(self) -> np.ndarray:
        """Return it as an array, of the same memory on the host."""
        ...


def host_array(tensor: Tensor) -> np.ndarray:
    """Return a tensor as an array on the host."""
    return tensor.detach().cpu().numpy()


def map_tree(function: Callable[[Any], Any], tree: Any) -> Any:
    """Return a tree of the results of a function on each leaf; mappings, tuples and lists are branches."""
    if isinstance(tree, Mapping):
        return {name: map_tree(function, value) for name, value in tree.items()}
    if isinstance(tree, tuple | list):
        items = [map_tree(function, value) for value in tree]
        return type(tree)(*items) if hasattr(tree, "_fields") else type(tree)(items)
    return function(tree)


def world_of(values: Any, world: int) -> Any:
    """Return world ``world`` of info values: a dict of arrays, an array of objects, or one array for all worlds."""
    if isinstance(values, Mapping):
        return {key: world_of(item, world) for key, item in values.items()}
    if isinstance(values, tuple):
        return tuple(world_of(item, world) for item in values)
    return values[world]
