"""Splats that mark goals in pictures."""

from __future__ import annotations

import numpy as np

from softmode.splats.splats import Splats

GREEN = (0.20, 0.80, 0.35)


def sphere_marker(radius: float, *, color: tuple[float, float, float] = GREEN, opacity: float = 0.4) -> Splats:
    """Return a translucent ball.

    Args:
        radius: Its radius [m].
        color: Its colour, sRGB.
        opacity: Opacity of each splat.
    """
    count = 64
    k = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k  # spiral of Fibonacci
    ring = np.sqrt(1.0 - height**2)
    means = radius * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    return dots(means, 0.22 * radius, color=color, opacity=opacity)


def ring_marker(radius: float) -> Splats:
    """Return a thin level ring.

    Args:
        radius: Its radius [m].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 181)[:-1]
    means = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    return dots(means, 0.02 * radius, opacity=0.8)


def dots(means: np.ndarray, size: float, *, color: tuple[float, float, float] = GREEN, opacity: float = 0.4) -> Splats:
    """Return round splats.

    Args:
        means: Their centres [m], shape (N, 3).
        size: Their standard deviation [m].
        color: Their colour, sRGB.
        opacity: Their opacity.
    """
    count = len(means)
    harmonic = 0.28209479177387814  # the constant function of real spherical harmonics
    return Splats(
        means=np.asarray(means, np.float32),
        quats=np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1)),
        scales=np.full((count, 3), size, np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh=np.tile(((np.array(color) - 0.5) / harmonic).astype(np.float32), (count, 1, 1)),
        name="marker",
    )
