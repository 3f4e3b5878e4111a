"""OpenUSD: stages with soft bodies, in and out; needs the extra `[usd]`.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.stage.scene import UsdDeformable, UsdScene, read_usd_scene
    from softmode.usd.animation import UsdAnimation, UsdAnimationOptions
    from softmode.usd.importer import UsdImport, add_usd
    from softmode.usd.playback import PlayedBody, UsdPlayback, read_animation
    from softmode.usd.splat_animation import write_splat_animation
    from softmode.usd.writer import UsdExportOptions, write_usd

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
    "write_splat_animation",
    "write_usd",
]

__getattr__, __dir__ = lazy_names(__name__)
