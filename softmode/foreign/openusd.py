"""Modules of OpenUSD by name, and names for its objects, of which type checkers know nothing: it comes without stubs.

The module imports nothing of softmode: it also serves the process of its own that opens untrusted stages.
"""

from __future__ import annotations

import importlib
from typing import Any

Stage = Any
Layer = Any
Prim = Any
"""A prim, or a schema on one."""
Attribute = Any
Value = Any
"""What an attribute holds, or a path, a time code, a matrix."""


def pxr(*names: str) -> list[Any]:
    """Return modules of OpenUSD, such as "Usd" and "Gf"."""
    return [importlib.import_module(f"pxr.{name}") for name in names]
