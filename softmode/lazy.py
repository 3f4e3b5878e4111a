"""Public names of a package that are imported when they are first used, so that importing the package stays light."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package whose public names live in other modules.

    A package lists its names in ``__all__``, and says where they live in the imports that type checkers read. Those
    imports are looked up in its source when the first name is asked for::

        if TYPE_CHECKING:
            from softmode.shop.apples import Apple

        __all__ = ["Apple"]
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
        imports = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom))
        found = {name.name: "." * node.level + (node.module or "") for node in imports for name in node.names}
        return {name: found[name] for name in sys.modules[package].__all__}

    def load(name: str) -> Any:
        """Import a public name from its module."""
        module = sys.modules[package]
        if name not in module.__all__:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes()[name], package), name)
        setattr(module, name, value)
        return value

    def names() -> list[str]:
        """Return the names of the package, those included that are not imported yet."""
        module = sys.modules[package]
        return sorted({*vars(module), *module.__all__})

    return load, names
