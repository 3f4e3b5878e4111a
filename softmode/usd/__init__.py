"""OpenUSD: stages with soft bodies, in and out; needs the extra `[usd]`.

Names are loaded when first used: the reader of splat files shares a module with this package and nothing else, and the
process that opens untrusted stages must start in no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.objects.stage_scene import UsdDeformable, UsdScene, read_usd_scene
    from softmode.usd.animation import UsdAnimation, UsdAnimationOptions
    from softmode.usd.importer import UsdImport, add_usd
    from softmode.usd.playback import PlayedBody, UsdPlayback, read_animation
    from softmode.usd.writer import UsdExportOptions, write_usd

_HOME = {
    "PlayedBody": "playback",
    "UsdAnimation": "animation",
    "UsdAnimationOptions": "animation",
    "UsdDeformable": "scene",
    "UsdExportOptions": "writer",
    "UsdImport": "importer",
    "UsdPlayback": "playback",
    "UsdScene": "scene",
    "add_usd": "importer",
    "read_animation": "playback",
    "read_usd_scene": "scene",
    "write_usd": "writer",
}

__all__ = [
    "PlayedBody",
    "UsdAnimation",
    "UsdAnimationOptions",
    "UsdDeformable",
    "UsdExportOptions",
    "UsdImport",
    "UsdPlayback",
    "UsdScene",
    "add_usd",
    "read_animation",
    "read_usd_scene",
    "write_usd",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
