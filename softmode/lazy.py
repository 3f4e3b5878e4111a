"""Public names of a package that are imported when they are first used, so that importing the package stays light."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package whose public names live in other modules.

    A package says once what it offers and where that lives, in the imports that type checkers read. They are looked up
    in its source when the first name is asked for, and are its ``__all__``::

        if TYPE_CHECKING:
            from softmode.shop.apples import Apple as Apple

        __getattr__, __dir__ = lazy_names(__name__)

    Args:
        package: ``__name__`` of the package.

    Returns:
        ``__getattr__``, which imports a name and keeps it in the package, and ``__dir__``.
    """

    @functools.cache
    def homes() -> dict[str, str]:
        """Return the module of each public name."""
        import ast
        import inspect

        # Not by the package's loader: pytest's, which loads the packages of its plug-ins, gives no source.
        source = inspect.getsource(sys.modules[package])
        blocks = (block.body for block in ast.parse(source).body if isinstance(block, ast.If))
        imports = (node for block in blocks for node in block if isinstance(node, ast.ImportFrom))
        return {name.name: "." * node.level + (node.module or "") for node in imports for name in node.names}

    def load(name: str) -> Any:
        """Import a public name from its module."""
        module = sys.modules[package]
        if name == "__all__":
            return sorted(homes())
        if name.startswith("__") or name not in homes():  # reading the source asks for names with underscores
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes()[name], package), name)
        setattr(module, name, value)
        return value

    def names() -> list[str]:
        """Return the names of the package, those included that are not imported yet."""
        return sorted({*vars(sys.modules[package]), *homes()})

    return load, names
