"""Painted materials: fields of stiffness and density from splats by their labels or colours, and from files of points.

A field is a function of positions, as :func:`softmode.deformables.build_body` and :func:`softmode.deformables.paint`
take it: relative Young's modulus, or relative density. A place has the value of the nearest splat or point, so that a
colour on the surface reaches inwards half way to the other side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.errors import AssetError, ConfigError, MaterialError
from softmode.files import UNPACKED_FREE, damage_errors, read_arrays
from softmode.objects.shapes.primitives import Color
from softmode.splats.point_cloud import distinct
from softmode.splats.splats import Splats

Array = NDArray[np.float64]
Field = Callable[[Array], Array]

FACTORS = (1.0e-3, 1.0e3)
"""Range of a factor of stiffness or density."""
TOLERANCE = 0.25
"""How far colours may lie apart, root of the sum of squares over three channels 0..1, to be the same."""


def require_factor(name: str, value: float) -> None:
    """Raise unless a factor lies in 0.001..1000.

    Raises:
        MaterialError: If it does not.
    """
    require_number(name, value, at_least=FACTORS[0], at_most=FACTORS[1], error=MaterialError)


@dataclass(frozen=True, kw_only=True)
class StifferColor:
    """The parts of an object whose splats have about one colour, of another stiffness."""

    color: Color
    """sRGB 0..1."""
    factor: float
    """Young's modulus there over that of the body, 0.001 to 1000."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if len(self.color) != 3 or not all(0.0 <= x <= 1.0 for x in self.color):
            raise ConfigError(f"stiffness: color {self.color} is no colour", hint="give (r, g, b) in 0..1")
        require_factor("stiffness: factor", self.factor)

    @classmethod
    def parse(cls, text: str) -> StifferColor:
        """Return the part of ``#rrggbb:factor``.

        Raises:
            ConfigError: If the text is no such thing.
        """
        color, _, factor = text.partition(":")
        try:
            red, green, blue = bytes.fromhex(color.removeprefix("#"))
            value = float(factor)
        except ValueError as error:
            raise ConfigError(f"{text!r} is no colour and factor", hint="give it like '#3a7f2a:0.1'") from error
        return cls(color=(red / 255.0, green / 255.0, blue / 255.0), factor=value)


def nearest_field(points: ArrayLike, values: ArrayLike) -> Field:
    """Return the field that has, everywhere, the value of the nearest of some points.

    Args:
        points: Positions [m], of splats for instance, in the coordinates that the field is asked in, shape (N, 3).
        values: Factors, 0.001 to 1000, such as one per label: ``factors[labels]``, shape (N,).

    Raises:
        MaterialError: If a factor lies outside its range, or the shapes do not match.
    """
    x, factors = np.asarray(points, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or factors.shape != (len(x),) or not len(x) or not np.isfinite(x).all():
        what = f"field: expected points (N > 0, 3), finite, and values (N,), got {x.shape} and {factors.shape}"
        raise MaterialError(what, hint="give one factor for each point")
    bad = np.flatnonzero(~((factors >= FACTORS[0]) & (factors <= FACTORS[1])))
    if len(bad):
        raise MaterialError(
            f"field: factors must lie in {FACTORS[0]:g}..{FACTORS[1]:g}, got {factors[bad[0]]} at row {bad[0]}",
            hint="a factor is that of the material there over that of the body",
        )
    first, _ = distinct(x)
    tree, factors = KDTree(x[first]), factors[first]

    def field(places: Array) -> Array:
        return factors[np.asarray(tree.query(places)[1])]

    return field


def color_field(splats: Splats, parts: Sequence[StifferColor]) -> Field:
    """Return the field of stiffness that the colours of splats say; ones where none of the colours is near.

    Args:
        splats: Splats where the field is asked.
        parts: Colours and factors; the nearest colour counts.

    Raises:
        ConfigError: If no splat has one of the colours.
    """
    apart = np.stack([np.linalg.norm(splats.colors() - np.array(part.color), axis=1) for part in parts], axis=1)
    nearest = np.where(apart.min(axis=1) <= TOLERANCE, apart.argmin(axis=1), -1)
    for number, part in enumerate(parts):
        if not (nearest == number).any():
            mean = ", ".join(f"{x:.2f}" for x in splats.colors().mean(axis=0))
            raise ConfigError(
                f"stiffness: no splat is near the colour {part.color}", hint=f"the mean of the splats is ({mean})"
            )
    return nearest_field(splats.means, np.append([part.factor for part in parts], 1.0)[nearest])


def read_field(path: str | os.PathLike[str]) -> Field:
    """Read a field: an .npz with `points` (N, 3) [m] and `factors` (N,).

    Raises:
        AssetError: If the file is missing, damaged, or holds something else.
        MaterialError: If a factor lies outside 0.001..1000.
    """
    hint = "give an .npz with points (N, 3) and factors (N,)"
    arrays = read_arrays(path, ("points", "factors"), what="field", hint=hint, free=UNPACKED_FREE // 2)
    if arrays.keys() < {"points", "factors"}:
        raise AssetError(f"field {path}: holds {sorted(arrays)}", hint=hint)
    with damage_errors(f"field {path}", hint=hint):
        return nearest_field(arrays["points"], arrays["factors"])


def brushed(points: Array, touched: Array, inward: Array, radius: float, depth: float) -> NDArray[np.bool_]:
    """Return which points (N, 3) a brush reached that was drawn over a surface.

    Args:
        points: Positions [m], shape (N, 3).
        touched: Where the brush touched [m], shape (H, 3).
        inward: Unit normals into the object there, shape (H, 3).
        radius: Radius of the brush [m].
        depth: How deep it reaches [m].

    Raises:
        ConfigError: If radius or depth are not finite numbers > 0.
    """
    for name, value in (("radius", radius), ("depth", depth)):
        require_number(name, value, above=0.0, unit="m")
    found = np.zeros(len(points), dtype=bool)
    for place, normal in zip(touched, inward, strict=True):
        away = points - place
        deep = away @ normal
        aside = np.linalg.norm(away - deep[:, None] * normal, axis=1)
        found |= (aside <= radius) & (deep >= -radius) & (deep <= depth)
    return found
