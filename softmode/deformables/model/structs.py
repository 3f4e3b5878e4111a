"""Structs of kernels, filled by the names of their fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol


class StructType(Protocol):
    """What ``wp.struct`` makes of a class."""

    @property
    def vars(self) -> Mapping[str, object]:
        """The fields by name."""
        ...

    def __call__(self) -> Any:
        """Return a struct with fields of zeros."""
        ...


def filled(struct: StructType, *sources: object, **values: object) -> Any:
    """Return a struct of a kernel.

    Args:
        struct: The struct.
        sources: Objects whose attributes give the fields of the same names; the first that has one counts.
        values: Values by name, before the sources; names that are no fields are left out.

    Raises:
        AttributeError: If a field is neither given nor found.
    """
    instance = struct()
    for name in struct.vars:
        owner = next((source for source in sources if hasattr(source, name)), None)
        setattr(instance, name, values[name] if name in values else getattr(owner, name))
    return instance
