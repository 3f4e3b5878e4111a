"""The film of a fit: the film, the twin over its background, and where they differ, side by side."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from softmode.fitting.film_residuals import FilmResiduals

SCALE = 2
"""Pixels of a picture for one of the film's."""


def side_by_side(residuals: FilmResiduals, x: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
    """Yield a picture for each frame: the film, the twin, and their difference in coverage.

    Args:
        residuals: What the film was fitted with.
        x: All parameters.
    """
    q, poses = residuals.states(x[None])[0], residuals.poses(x[None])[0]
    colors = residuals.pictures.draw(q, poses, color=True)
    alpha = residuals.pictures.draw(q, poses)[..., None]
    frames = residuals.clip.frames
    back = np.median(frames, axis=0)
    for k, frame in enumerate(frames):
        twin = np.clip(255.0 * colors[k] + (1.0 - alpha[k]) * (0.4 * back + 90.0), 0.0, 255.0)
        off = np.clip(alpha[k, ..., 0] - residuals.cover[k], -1.0, 1.0)
        difference = 255.0 * np.stack([np.maximum(off, 0.0), 0.0 * off, np.maximum(-off, 0.0)], axis=-1)
        picture = np.concatenate([frame, twin.astype(np.uint8), difference.astype(np.uint8)], axis=1)
        yield picture.repeat(SCALE, axis=0).repeat(SCALE, axis=1)
