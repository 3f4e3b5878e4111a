"""Public names of a package that are imported when they are first used, so that importing the package stays light."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package whose public names live in other modules.

    A package lists its names three times: in ``__all__``, in the imports under ``TYPE_CHECKING`` that type checkers
    read, and here. ``tests/test_faces.py`` compares the three::

        if TYPE_CHECKING:
            from softmode.shop.apples import Apple

        __all__ = ["Apple"]
        __getattr__, __dir__ = lazy_names(__name__, {"Apple": ".apples"})

    Args:
        package: ``__name__`` of the package.
        homes: The module of each name, absolute or, with a leading dot, inside the package.

    Returns:
        ``__getattr__``, which imports a name and keeps it in the package, and ``__dir__``.
    """

    def load(name: str) -> Any:
        """Import a public name from its module."""
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name], package), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        """Return the names of the package, those included that are not imported yet."""
        return sorted({*vars(sys.modules[package]), *homes})

    return load, names
