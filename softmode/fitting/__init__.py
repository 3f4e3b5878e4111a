"""Fitting: what a real object is made of, from a film, from markers, or from forces over a way.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.fitting.estimates import Estimate as Estimate
    from softmode.fitting.estimates import Fitted as Fitted
    from softmode.fitting.film import Clip as Clip
    from softmode.fitting.film_fit import fit_film as fit_film
    from softmode.fitting.force_fit import Press as Press
    from softmode.fitting.force_fit import fit_force as fit_force
    from softmode.fitting.holding import Held as Held
    from softmode.fitting.holding import held_object as held_object
    from softmode.fitting.marker_fit import MarkerPlaces as MarkerPlaces
    from softmode.fitting.marker_fit import fit_markers as fit_markers
    from softmode.fitting.tables import read_forces as read_forces
    from softmode.fitting.tables import read_markers as read_markers

__getattr__, __dir__ = lazy_names(__name__)
