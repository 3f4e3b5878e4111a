"""Films, recordings for rerun, and pictures of bodies.

Names are imported when they are first used; recordings and pictures need the extra `[viz]`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.viz.body_picture import write_body_picture as write_body_picture
    from softmode.viz.film import Film as Film
    from softmode.viz.morph_film import MorphScene as MorphScene
    from softmode.viz.morph_film import film_morph as film_morph
    from softmode.viz.morph_recording import record_morph as record_morph
    from softmode.viz.rerun_logger import RerunLogger as RerunLogger
    from softmode.viz.rerun_options import RerunOptions as RerunOptions
    from softmode.viz.rerun_sources import RerunScene as RerunScene

__getattr__, __dir__ = lazy_names(__name__)
