"""The one place that allocates the tables of a step: the arrays of a struct, from its own annotations."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import newton
import numpy as np
import warp as wp

Table = TypeVar("Table")


def allocate(
    struct: type[Table],
    axes: str | Mapping[str, str],
    sizes: Mapping[str, int],
    device: wp.Device,
    *,
    fill: Mapping[str, float] | None = None,
    given: Mapping[str, Any] | None = None,
) -> Table:
    """Return a struct whose arrays have the types that it declares and the shapes that ``axes`` name.

    Args:
        struct: A class declared by :func:`softmode.deformables.model.declare.struct`.
        axes: Names of the axes of an array, as in "instance sample", where a number stands for itself; or a mapping
            from names of arrays, several in one key, to them, with "" for all others.
        sizes: Length of every axis; one that is 0 becomes 1.
        device: Where the arrays lie.
        fill: What arrays hold at the start; zero for the others.
        given: Values that need no array of their own: a ``wp.array`` is taken as it is, host data are copied to the
            device in the declared type.
    """
    declared: Any = struct
    kinds: dict[str, Any] = {name: var.type for name, var in declared.vars.items()}
    spelled = {"": axes} if isinstance(axes, str) else axes
    shapes = {name: value for names, value in spelled.items() for name in (names.split() or [""])}
    fill, given, table = fill or {}, given or {}, struct()
    for name, kind in kinds.items():
        if name in given:
            value = given[name]
            if hasattr(kind, "ndim") and not isinstance(value, wp.array):
                value = wp.array(np.ascontiguousarray(value), dtype=kind.dtype, device=device)
        elif hasattr(kind, "ndim"):
            words = shapes.get(name, shapes.get("", "")).split()
            shape = tuple(int(word) if word.isdigit() else max(sizes[word], 1) for word in words)
            if len(shape) != kind.ndim:
                raise ValueError(f"{struct.__name__}.{name} has {kind.ndim} axes, given are {words}")
            value = wp.zeros(shape, dtype=kind.dtype, device=device)
            if name in fill:
                value.fill_(fill[name])
        else:
            continue
        setattr(table, name, value)
    return table


def present(array: wp.array | None) -> wp.array:
    """Return an array of a model or a state, all of which Newton declares as optional.

    Raises:
        ValueError: If there is none.
    """
    if array is None:
        raise ValueError("the model, the state or the report has no such array")
    return array


def host(array: wp.array | None) -> np.ndarray:
    """Return a copy on the host of an array that is there; see :func:`present`."""
    return present(array).numpy()


def starts_of(counts: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return where each of several runs of so many elements begins when they follow each other."""
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)


def body_world(model: newton.Model) -> np.ndarray:
    """Return the world of every rigid body, 0 for those outside all worlds, shape (body_count,)."""
    return np.maximum(host(model.body_world)[: model.body_count], 0) if model.body_count else np.zeros(0, int)
