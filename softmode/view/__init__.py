"""A live session with a soft body, to pull, pin and tune it while it moves, and the page in the browser.

Names are imported when they are first used; the page needs the extra `[viz]`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.view.app import ViewApp as ViewApp
    from softmode.view.app import ViewOptions as ViewOptions
    from softmode.view.live_types import DragView as DragView
    from softmode.view.live_types import Energies as Energies
    from softmode.view.live_types import Hit as Hit
    from softmode.view.live_types import LiveOptions as LiveOptions
    from softmode.view.live_types import LiveParameters as LiveParameters
    from softmode.view.live_types import LiveStatus as LiveStatus
    from softmode.view.live_types import PinView as PinView
    from softmode.view.live_types import SplatPicture as SplatPicture
    from softmode.view.session import LiveSession as LiveSession

__getattr__, __dir__ = lazy_names(__name__)
