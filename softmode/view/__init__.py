"""A live session with a soft body, to pull, pin and tune it while it moves, and the page in the browser.

Names are imported when they are first used; the page needs the extra `[viz]`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.view.app import ViewApp, ViewOptions
    from softmode.view.live_types import (
        DragView,
        Energies,
        Hit,
        LiveOptions,
        LiveParameters,
        LiveStatus,
        PinView,
        SplatPicture,
    )
    from softmode.view.session import LiveSession

__all__ = [
    "DragView",
    "Energies",
    "Hit",
    "LiveOptions",
    "LiveParameters",
    "LiveSession",
    "LiveStatus",
    "PinView",
    "SplatPicture",
    "ViewApp",
    "ViewOptions",
]

__getattr__, __dir__ = lazy_names(__name__)
