"""OpenUSD: stages with soft bodies, in and out; needs the extra `[usd]`.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.stage.scene import UsdDeformable as UsdDeformable
    from softmode.objects.stage.scene import UsdScene as UsdScene
    from softmode.objects.stage.scene import read_usd_scene as read_usd_scene
    from softmode.usd.animation import UsdAnimation as UsdAnimation
    from softmode.usd.animation import UsdAnimationOptions as UsdAnimationOptions
    from softmode.usd.importer import UsdImport as UsdImport
    from softmode.usd.importer import add_usd as add_usd
    from softmode.usd.playback import PlayedBody as PlayedBody
    from softmode.usd.playback import UsdPlayback as UsdPlayback
    from softmode.usd.playback import read_animation as read_animation
    from softmode.usd.splat_animation import write_splat_animation as write_splat_animation
    from softmode.usd.writer import UsdExportOptions as UsdExportOptions
    from softmode.usd.writer import write_usd as write_usd

__getattr__, __dir__ = lazy_names(__name__)
