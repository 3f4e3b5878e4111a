"""Bake: splats that stand for a radiance field, so that everything that draws splats draws it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from softmode.checks import require_number
from softmode.radiance.grid import RadianceGrid
from softmode.radiance.march import render_radiance
from softmode.splats.fit.picture_fit import FitOptions, fit_splats
from softmode.splats.principal_axes import axes_of_covariances
from softmode.splats.splats import Splats, quats_from_rotations, rotate_sh

Array = NDArray[np.float64]

DEEP = 4.0
"""Optical depth below the surface from which on nothing is seen."""


@dataclass(frozen=True)
class RadianceFit:
    """Splats that stand for a radiance field, and how well they do."""

    splats: Splats
    """In the frame and unit of the field, with its degree of spherical harmonics."""
    psnr: float
    """Mean peak signal-to-noise ratio over the held-out pictures, before white [dB]."""
    history: tuple[tuple[int, float], ...]
    """Iteration and PSNR [dB] from the first splats (0) to the result."""


def splats_from_radiance(
    grid: RadianceGrid,
    *,
    count: int = 12_000,
    options: FitOptions | None = None,
    device: wp.DeviceLike = None,
    progress: Callable[[int, float], None] | None = None,
) -> RadianceFit:
    """Cover a radiance field with splats and fit them to marched pictures of it.

    A splat stands for what can be seen of the field in a cube: it has the mean and covariance of that, its opacity and
    its colour, view-dependent too. Then centres, shapes, opacities and the constant part of the colours are fitted as
    those of `splats_from_mesh` are.

    Args:
        grid: The field.
        count: Number of splats, about.
        options: Pictures and steps; `FitOptions(samples=2)` if None.
        device: Warp device.
        progress: Called with the iteration and the loss after every step.

    Raises:
        ConfigError: If an option is out of range.
    """
    require_number("count", count, at_least=100)
    options = options if options is not None else FitOptions(samples=2)
    middle, radius = grid.bounds.mean(axis=0), 0.5 * float(np.linalg.norm(np.ptp(grid.bounds, axis=0)))
    unit = grid.transformed(translation=-middle / radius, scale=1.0 / radius)
    first, spacing = covering_splats(unit, count)
    size: dict[str, Any] = {"width": options.size, "height": options.size, "samples": options.samples}
    draw = partial(render_radiance, unit, device=device, **size)
    fitted, history = fit_splats(first, spacing, draw, options, device=device, progress=progress)
    return RadianceFit(fitted.transformed(scale=radius, translation=middle), history[-1][1], history)


def covering_splats(grid: RadianceGrid, count: int) -> tuple[Splats, float]:
    """Return splats, one for each cube of the field in which something can be seen, and the edge of the cubes [m]."""
    density = grid.density.astype(np.float64)
    occupied = grid.occupied if grid.occupied.any() else density > 0.0
    depth: Any = ndimage.distance_transform_edt(np.pad(occupied, 1))
    depth = depth[1:-1, 1:-1, 1:-1]
    index = np.argwhere(occupied & (density * (depth - 1.0) * grid.spacing < DEEP))
    sigma = density[tuple(index.T)]

    def cubes(edge: float) -> NDArray[np.int64]:
        return np.unique(np.floor(index / edge), axis=0, return_inverse=True)[1].ravel()

    low, high = 1.0, 32.0
    cube = cubes(low)
    if cube.max() + 1 > count:
        for _ in range(12):
            middle = 0.5 * (low + high)
            cube = cubes(middle)
            low, high = (middle, high) if cube.max() + 1 > count else (low, middle)
        cube = cubes(high)
    edge = grid.spacing * (high if low > 1.0 or high < 32.0 else 1.0)
    weight = -np.expm1(-sigma * grid.spacing)
    total: Any = np.bincount(cube, weight)

    def mean(values: Array) -> Array:
        flat = values.reshape(len(values), -1)
        return np.stack([np.bincount(cube, weight * x) for x in flat.T], axis=1) / total[:, None]

    place = grid.origin + index @ grid.axes.T
    centre = mean(place)
    away = place - centre[cube]
    spread = mean(away[:, :, None] * away[:, None]).reshape(-1, 3, 3) + np.eye(3) * (0.5 * grid.spacing) ** 2
    still = np.broadcast_to(np.eye(3), spread.shape)
    frames, scales = axes_of_covariances(spread, still)
    filled = np.bincount(cube) * grid.spacing**3 / edge**3
    opacity = -np.expm1(-mean(sigma[:, None])[:, 0] * edge * np.minimum(filled, 1.0))
    shades = mean(grid.spread_sh[tuple(index.T)].astype(np.float64)).reshape(len(total), -1, 3)
    splats = Splats(
        means=centre,
        quats=quats_from_rotations(frames),
        scales=scales,
        opacities=np.clip(opacity, 0.02, 0.98),
        sh=rotate_sh(shades, grid.rotation),
        name=grid.name,
    )
    return splats, edge
