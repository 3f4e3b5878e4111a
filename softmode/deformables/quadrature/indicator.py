"""The indicator of a solid from oriented samples of its surface, on a grid (Poisson reconstruction)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.float64]
Grid = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Indicator:
    """A smoothed indicator, about one inside and zero outside, and the level at which the samples lie."""

    value: Grid
    """The indicator at the nodes."""
    level: Grid
    """The level at the nodes: inside is where the indicator is above it."""
    mean_level: float
    """Its mean over the samples."""
    origin: Array
    """Position of the first node [m], shape (3,)."""
    voxel: float
    """Distance between nodes [m]."""


def grid_of(low: Array, high: Array, margin: float, voxel: float) -> tuple[int, ...]:
    """Return how many nodes a grid around a box has along the axes, each a length that transforms fast."""
    cells = np.ceil((high - low + 2.0 * margin) / voxel) + 1
    return tuple(int(fft.next_fast_len(int(k), real=True)) for k in cells)  # pyright: ignore[reportArgumentType]


def solve_indicator(
    sample: Array, normal: Array, confidence: Array, *, voxel: float, sigma: float, margin: float
) -> Indicator:
    """Solve lap(chi) = -div(sum_i a_i n_i G(X - X_i)) and find the level on which the samples lie.

    a_i is the area of a sample, from the density of samples around it that face its way: (rho + n_i . d) / 2 with rho
    the smoothed count and d the smoothed sum of normals, to which the other side of a thin wall adds nothing. G is a
    Gaussian. In a wall as thin as G chi does not reach one, and its surface lies on a lower level; the level is
    therefore the mean of chi over the samples nearby, smoothed by a Gaussian of twice the width.

    Args:
        sample: Surface samples [m], shape (N, 3).
        normal: Their outward unit normals, shape (N, 3).
        confidence: Weight of each, 0..1, shape (N,).
        voxel: Distance between the nodes of the grid [m].
        sigma: Standard deviation of G [m].
        margin: Empty space around the samples [m].
    """
    low, high = sample.min(axis=0), sample.max(axis=0)
    origin, shape = low - margin, grid_of(low, high, margin, voxel)
    where = (sample - origin) / voxel
    blur = sigma / voxel
    wave = [
        2.0 * np.pi * f(n).astype(np.float32)
        for f, n in zip((fft.fftfreq, fft.fftfreq, fft.rfftfreq), shape, strict=True)
    ]
    wave = [k.reshape([-1 if d == axis else 1 for d in range(3)]) for axis, k in enumerate(wave)]

    def smoothed(value: Array, width: float) -> Grid:
        spectrum = fft.rfftn(_deposit(where, value, shape))
        for k in wave:
            spectrum *= np.exp(-0.5 * (width * k) ** 2)
        return fft.irfftn(spectrum, s=shape, overwrite_x=True)  # pyright: ignore[reportReturnType]

    facing = _read(smoothed(np.ones(len(sample)), blur), where)
    for d in range(3):
        facing += normal[:, d] * _read(smoothed(normal[:, d], blur), where)
    # A plane with one sample per area a shows the density 1 / (a sqrt(2 pi) blur); depositing and reading back widen
    # the filter.
    peak = 1.0 / np.sqrt(2.0 * np.pi * (blur**2 + 1.0 / 3.0))
    least = 0.5 * peak / (2.0 * np.pi * blur**2)
    weight = confidence * peak / np.maximum(0.5 * facing, least)
    total = np.zeros((shape[0], shape[1], shape[2] // 2 + 1), dtype=np.complex64)
    for d in range(3):
        flux: Any = fft.rfftn(_deposit(where, weight * normal[:, d], shape))
        total += wave[d] * flux
    square = wave[0] ** 2 + wave[1] ** 2 + wave[2] ** 2
    square[0, 0, 0] = 1.0
    total *= 1j / square
    total[0, 0, 0] = 0.0
    for k in wave:
        total *= np.exp(-0.5 * (blur * k) ** 2)
    chi: Grid = fft.irfftn(total, s=shape, overwrite_x=True)  # pyright: ignore[reportAssignmentType]
    chi -= np.mean([side.mean() for axis in range(3) for side in (chi.take(0, axis), chi.take(-1, axis))])
    here = _read(chi, where)
    mean = float(np.average(here, weights=weight))
    spread = smoothed(weight, 2.0 * blur)
    faint = 1e-3 * float(np.median(_read(spread, where)))
    level = (np.maximum(smoothed(weight * here, 2.0 * blur), 0.0) + faint * mean) / (np.maximum(spread, 0.0) + faint)
    return Indicator(value=chi, level=level.astype(np.float32), mean_level=mean, origin=origin, voxel=voxel)


def _deposit(where: Array, value: Array, shape: tuple[int, ...]) -> Grid:
    """Spread values at fractional grid positions trilinearly; the sum is kept."""
    base = np.floor(where).astype(np.int64)
    part = where - base
    first = np.ravel_multi_index(tuple(base.T), shape)
    index, share = [], []
    for corner in np.ndindex(2, 2, 2):
        index.append(first + (corner[0] * shape[1] + corner[1]) * shape[2] + corner[2])
        share.append(np.prod(np.where(corner, part, 1.0 - part), axis=1) * value)
    grid = np.bincount(np.concatenate(index), np.concatenate(share), minlength=int(np.prod(shape)))
    return grid.reshape(shape).astype(np.float32)


def _read(grid: Grid, where: Array) -> Array:
    """Interpolate trilinearly; positions outside the grid take the border's value."""
    return ndimage.map_coordinates(grid, where.T, order=1, mode="nearest", output=np.float64)
