"""OpenUSD: stages with soft bodies, in and out; needs the extra `[usd]`.

Names are loaded when first used: the reader of splat files shares a module with this package and nothing else, and the
process that opens untrusted stages must start in no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.usd.importer import UsdBody, UsdImport, add_usd
    from softmode.usd.scene import UsdDeformable, UsdScene, read_usd_scene

_HOME = {
    "UsdBody": "importer",
    "UsdImport": "importer",
    "add_usd": "importer",
    "UsdDeformable": "scene",
    "UsdScene": "scene",
    "read_usd_scene": "scene",
}

__all__ = ["UsdBody", "UsdDeformable", "UsdImport", "UsdScene", "add_usd", "read_usd_scene"]


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
