"""Dents: how far a surface gives under a patch of pressure that the functions of its body are too few to carry.

n functions in a volume V resolve patches of the size h = (V / n)^(1/3). What a narrower patch would press in beyond
their motion is, per pressure,

    w = 0.30 h (1 - nu^2) / E,

a bed of springs (Winkler) of the scale that is missing, in series with the penalty of contact. It was fitted to pairs
of opposite discs on cubes, beams, pads and spheres of 28 to 68 functions against 2,000 kernels: radii of 12 to 18 mm on
bodies of 100 mm then give 0.88 to 1.1 of the fine compliance, where the functions alone give 0.3 to 0.7. A wall is no
softer than itself: h is bounded by a share of its thickness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.pairs import thickness

Array = NDArray[np.float64]

DENT_FACTOR = 0.30
"""Dent over the size of what the functions resolve, under the pressure E / (1 - nu^2)."""
WALL_SHARE = 0.6
"""Bound of that size as a share of the thickness below a sample."""


def resolved_size(body: ReducedBody) -> float:
    """Return the size of the patches that a body's functions resolve, (V / n)^(1/3) [m].

    n counts the functions that deform the body. Those that move its exact regions do not: they say nothing of the rest.
    """
    return (body.volume / max(body.function_count - body.driven_count, 1)) ** (1.0 / 3.0)


def dent_lengths(body: ReducedBody) -> Array:
    """Return w E / (1 - nu^2) at the surface samples of a body, shape (surface_count,) [m]."""
    return DENT_FACTOR * np.minimum(resolved_size(body), WALL_SHARE * thickness(body))
