"""A radiance field that several test files share, bodies of its solid, and pictures of it.

Builds a body from a radiance field's density.
"""

from __future__ import annotations

import functools

import numpy as np

from softmode.deformables import BuildOptions, ReducedBody, build_body, quadrature_from_density
from softmode.radiance import RadianceGrid
from softmode.splats import PinholeCamera

SIZE = (0.16, 0.04, 0.04)
"""Edges of the block [m]."""
SIGMA = 2.0e3
"""Its density [1/m]."""


def block(x):
    """Return density and colour of a block along X with soft faces, in a smooth pattern."""
    away = (0.5 * np.array(SIZE) - np.abs(x)).min(axis=1)
    density = SIGMA * np.clip(0.5 + away / 0.004, 0.0, 1.0)
    waves = np.sin(90.0 * x[:, 0]), np.sin(110.0 * x[:, 1] + 40.0 * x[:, 0]), np.cos(120.0 * x[:, 2])
    return density, 0.5 + 0.35 * np.stack(waves, axis=1)


@functools.cache
def block_field(degree: int = 0) -> RadianceGrid:
    """Return the block as a grid; of degree 2 its colour changes with the direction."""
    half = 0.5 * np.array(SIZE) + 0.008
    grid = RadianceGrid.from_function(block, [-half, half], resolution=97, name="block")
    if degree == 0:
        return grid
    sh = np.zeros((*grid.shape, 9, 3))
    sh[..., :1, :] = grid.sh
    sh[..., 1:, :] = 0.25 * np.random.default_rng(0).normal(size=(8, 3))
    return RadianceGrid(density=grid.density, sh=sh, origin=grid.origin, axes=grid.axes)


@functools.cache
def block_body() -> ReducedBody:
    """Return the body of the block, its frame that of the field to rounding."""
    field = block_field()
    body = build_body(quadrature_from_density(field.densities, field.bounds), BuildOptions(kernel_count=400))
    assert np.abs(body.offset).max() < 1e-4
    return body


def bent(x):
    """Return points of the block bent by 90 degrees about Y."""
    curve = 0.5 * np.pi / SIZE[0]
    turn, radius = curve * x[:, 0], 1.0 / curve - x[:, 2]
    return np.stack([np.sin(turn) * radius, x[:, 1], 1.0 / curve - np.cos(turn) * radius], axis=1)


def camera(size: int = 96) -> PinholeCamera:
    """Return a camera on the block."""
    eye = (0.12, -0.22, 0.18)
    return PinholeCamera.look_at("c", position=eye, target=(0.0, 0.0, 0.01), width=size, height=size, fov_y=0.6)


def psnr(one, other) -> float:
    """Return the peak signal-to-noise ratio of two pictures 0..1 [dB]."""
    error = np.clip(np.asarray(one, float), 0, 1) - np.clip(np.asarray(other, float), 0, 1)
    return float(-10.0 * np.log10(max((error**2).mean(), 1e-12)))
