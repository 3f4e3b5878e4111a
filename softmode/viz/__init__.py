"""Films, recordings for rerun, and pictures of bodies.

Names are imported when they are first used; recordings and pictures need the extra `[viz]`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.viz.body_picture import write_body_picture
    from softmode.viz.film import Film
    from softmode.viz.morph_film import MorphScene, film_morph
    from softmode.viz.morph_recording import record_morph
    from softmode.viz.rerun_logger import RerunLogger
    from softmode.viz.rerun_options import RerunOptions
    from softmode.viz.rerun_sources import RerunScene

__all__ = [
    "Film",
    "MorphScene",
    "RerunLogger",
    "RerunOptions",
    "RerunScene",
    "film_morph",
    "record_morph",
    "write_body_picture",
]

__getattr__, __dir__ = lazy_names(__name__)
