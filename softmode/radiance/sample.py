"""Sample a field in Python, such as a trained network: where its object is, and how finely, is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import AssetError
from softmode.radiance.grid import VISIBLE, Field, RadianceGrid

Array = NDArray[np.float64]

COARSE, WIDEST = 48, 64.0
"""Nodes along an edge while the object is looked for, and the largest half edge of the box."""
RESOLUTIONS = (64, 96, 128, 192, 256)
"""Numbers of nodes along the longest edge, of which the first that is fine enough is taken."""
PROBES, ROUGH = 20_000, 0.02
"""Random places at which a grid is compared with its field, and the mean error of the opacity of a voxel there."""


def sampled_field(
    field: Field,
    bounds: ArrayLike | None = None,
    resolution: int | None = None,
    *,
    name: str = "radiance field",
    metres: float | None = None,
) -> RadianceGrid:
    """Sample a field once, in the box of its object and as finely as that needs.

    Args:
        field: As for `RadianceGrid.from_function`.
        bounds: Corners of a box that holds the object, shape (2, 3); None looks for it around the origin.
        resolution: Nodes along the longest edge; None takes the first of `RESOLUTIONS` at which the opacity of a voxel
            between the nodes errs by less than `ROUGH`.
        name: Where it comes from; used in messages.
        metres: Metres of a unit of length, None if not known.

    Raises:
        AssetError: If the field is none, is empty, or has no end.
    """
    box = _found_box(field, name) if bounds is None else np.asarray(bounds, dtype=np.float64)
    rng = np.random.default_rng(0)
    counts = RESOLUTIONS if resolution is None else (resolution,)
    while True:
        grid = replace(RadianceGrid.from_function(field, box, resolution=counts[0], name=name), metres=metres)
        low, high = grid.bounds
        places = low + (high - low) * rng.random((PROBES, 3))
        wanted, got = np.asarray(field(places)[0], dtype=np.float64), grid.densities(places)
        error = np.abs(np.exp(-wanted * grid.spacing) - np.exp(-got * grid.spacing)).mean()
        if error < ROUGH or len(counts) == 1:
            return grid
        counts = counts[1:]


def _found_box(field: Field, name: str) -> Array:
    """Return a box around what can be seen of a field: doubled while it reaches the border, then narrowed twice."""
    half = 1.0
    while True:
        box = np.array([[-half] * 3, [half] * 3])
        low, high = _seen(field, box, name)
        if (low > box[0]).all() and (high < box[1]).all():
            break
        half *= 2.0
        if half > WIDEST:
            raise AssetError(
                f"{name}: it has no end within {WIDEST:.0f} units", hint="give bounds around the object (--bounds)"
            )
    for _ in range(2):
        low, high = _seen(field, np.stack([low, high]), name)
    return np.stack([low, high])


def _seen(field: Field, box: Array, name: str) -> Array:
    """Return the corners of what can be seen of a field in a box, a step wider, but not wider than the box."""
    try:
        grid = RadianceGrid.from_function(field, box, resolution=COARSE, name=name)
    except AssetError as error:
        hint = "give bounds around the object (--bounds)"
        raise AssetError(f"{error.message}, sampled at {COARSE} nodes an edge in {box.tolist()}", hint=hint) from error
    if not (grid.density * grid.spacing > VISIBLE).any():
        raise AssetError(f"{name}: nothing can be seen in {box.tolist()}", hint="check the unit of its density")
    return np.clip(grid.surroundings, *box)
