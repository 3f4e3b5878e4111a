"""Soft objects for scenes: splats to look at, with the reduced body that moves them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body import BuildOptions, ReducedBody, build_body, cached_body
from softmode.deformables.quadrature import Quadrature, quadrature_from_splats
from softmode.errors import AssetError, ConfigError
from softmode.splats import Splats, make_plush, read_splats


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """Which soft object, how large, how finely reduced."""

    splat: str | Path | None = None
    """Splat file (INRIA .ply, SOG v2); None for the built-in plush."""
    size: float = 0.08
    """Longest edge of the object's bounding box [m]; the gripper opens 0.09 m."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "-y"
    """Axis of the splat file that points up; trained captures mostly have y down. The plush stands as it is."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box (x0, y0, z0, x1, y1, z1) of the file, after turning it up, outside which splats are dropped; cuts an object
    off the ground it was captured on."""
    build: BuildOptions = field(default_factory=BuildOptions)
    """How the body is reduced."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0.005 <= self.size <= 1.0:
            raise ConfigError(f"size must lie in 0.005..1 m, got {self.size!r}", hint="give the longest edge in metres")
        if self.crop is not None and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise ConfigError(f"crop {self.crop} is empty", hint="give x0 y0 z0 x1 y1 z1 with every 0 below its 1")


@dataclass(frozen=True)
class SoftObject:
    """A body and its splats in the body frame."""

    body: ReducedBody
    """The reduced body."""
    splats: Splats
    """Splats with centres in the body frame [m]."""
    basis: NDArray[np.float64]
    """Functions at the splat centres, shape (N, n)."""
    grad_basis: NDArray[np.float64]
    """Their gradients [1/m], shape (N, n, 3)."""
    height: float
    """Height of the body frame's origin over the lowest surface sample [m]."""


def load_object(config: ObjectConfig, progress: Callable[[str, float], None] | bool | None = None) -> SoftObject:
    """Read or make the splats, build or recall the body, and tie them together.

    Args:
        config: Which object.
        progress: Passed to :func:`softmode.deformables.body.build_body`.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
    """
    splats = _read(config)
    quadrature: list[Quadrature] = []

    def fill() -> Quadrature:
        if not quadrature:
            quadrature.append(quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities))
        return quadrature[0]

    name = "plush" if config.splat is None else Path(config.splat).name
    key = ("splats", splats.means, splats.scales, splats.quats, splats.opacities, config.build)
    body = cached_body(key, lambda: build_body(fill(), config.build, name=name, progress=progress))
    kept = _drawn(splats, body)
    shown = splats.subset(kept)
    shown = shown.transformed(translation=-body.offset)
    basis, grad_basis = body.evaluate(shown.means)
    return SoftObject(body, shown, basis, grad_basis, float(-body.surface_points[:, 2].min()))


def _read(config: ObjectConfig) -> Splats:
    """Return the splats upright, standing on z = 0 around the origin, scaled to the wanted size."""
    if config.splat is None:
        splats = make_plush()
    else:
        splats = read_splats(config.splat).oriented(config.up)
        if config.crop is not None:
            splats = splats.cropped(config.crop[:3], config.crop[3:])
            if splats.count == 0:
                raise AssetError(f"{config.splat}: no splat lies inside crop {config.crop}", hint="widen the box")
    low, high = splats.bounds(quantile=0.0 if config.splat is None else 0.002)
    extent = float((high - low).max())
    if not extent > 0.0:
        raise AssetError(f"{splats.name}: all splats lie at one point", hint="export the asset again")
    scale = config.size / extent
    centre = np.array([*(0.5 * (low + high))[:2], low[2]])
    return splats.transformed(translation=-scale * centre, scale=scale)


def _drawn(splats: Splats, body: ReducedBody) -> NDArray[np.bool_]:
    """Keep the splats within an eighth of the body's size of its bounding box: the rest are floaters of the capture."""
    low, high = body.bounds + body.offset
    margin = 0.125 * np.linalg.norm(high - low)
    return ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
