"""Solids to morph between: by name (shapes, letters, animals, a car), from a file, or an object's configuration.

Named shapes are level-set functions, negative inside, about one unit long, with z up; what looks at the camera looks
along -y.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.materials.material import Material
from softmode.deformables.quadrature.interior import winding_numbers
from softmode.errors import AssetError, needs_extra
from softmode.mpm import MORPH_MATERIAL, ParticleBody, particles_from_shape
from softmode.objects.config import ObjectConfig
from softmode.objects.object_file import file_kind
from softmode.objects.pipeline import standing_quadrature
from softmode.objects.shapes.level_sets import Level, ball, box, capsule, cylinder, ellipsoid, level_slope, torus
from softmode.objects.shapes.primitives import KEY_LIGHT, Color, checker
from softmode.objects.source import DEFAULT_COLORS, object_source
from softmode.splats.mesh_samples import eliminate_samples
from softmode.splats.point_cloud import splats_from_points
from softmode.splats.splats import Splats

Array = NDArray[np.float64]

SPLAT_COUNT = 8_000
"""Splats on a named shape or mesh."""
SAMPLE_COUNT = 3_000
"""Surface samples that say what lies inside a file's object."""
CANDIDATES = 3
"""Points on the surface of a named shape of which each splat is one."""
SHELL = 0.02
"""Half thickness of the shell in which they are drawn."""
CORNER = 3
"""Neighbours of a lattice point at the corner of a box."""
SLOPE_STEP = 1.0e-4
"""Step of the differences that give a level-set function's slope."""
GLYPH = 96
"""Pixels of a letter's height."""
VOLUME = 4.0 / 3.0 * np.pi * 6.93**3
"""Volume of the paper's ball [m^3]."""
LONGEST = 21.0
"""Longest edge of what is morphed on a grid of 32 m [m]: particles need room to swing."""
ASSETS = ("bunny", "bear")
"""Meshes that newton installs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """What a morph begins or ends with."""

    name: str
    """What it was made from."""
    inside: Callable[[Array], NDArray[np.bool_]]
    """Which of points (M, 3) lie inside, shape (M,)."""
    bounds: Array
    """Bounding box, shape (2, 3)."""
    volume: float
    """Volume."""
    splats: Splats
    """What shows it, in the same frame."""

    @property
    def extent(self) -> float:
        """Longest edge of the bounding box."""
        return float(np.ptp(self.bounds, axis=0).max())

    def scaled(self, factor: float) -> Solid:
        """Return the solid scaled about the origin."""
        inside = self.inside
        return replace(
            self,
            inside=lambda points: inside(points / factor),
            bounds=self.bounds * factor,
            volume=self.volume * factor**3,
            splats=self.splats.transformed(scale=factor),
        )


def solid_names() -> tuple[str, ...]:
    """Return the names that :func:`solid_of` knows beside letters and digits."""
    return (*_SHAPES, *ASSETS, "plush")


def solid_of(what: str | os.PathLike[str] | ObjectConfig) -> Solid:
    """Return a solid by name, from a file, or from an object's configuration.

    Args:
        what: One of :func:`solid_names`; a letter or digit; a file of a mesh, splats, points, or an OpenUSD stage; a
            configuration.

    Raises:
        AssetError: If there is no such name or file, or it cannot be read or encloses no volume.
        MissingExtraError: If what reads it is not installed.
    """
    if isinstance(what, ObjectConfig):
        return _solid_of_object(what, what.shape)
    name = os.fspath(what)
    if name in _SHAPES:
        level, half, colors = _SHAPES[name]
        return _solid_of_level(name, level, np.array([-np.array(half), half]), colors)
    if name in ASSETS:
        return _solid_of_object(_asset(name), name)
    if name == "plush":
        return _solid_of_object(_FILLED, name)
    if len(name) == 1 and name.isalnum():
        level, bounds = _glyph(name)
        return _solid_of_level(name, level, bounds, DEFAULT_COLORS)
    if not Path(name).exists():
        raise AssetError(
            f"{name}: neither a file nor a name",
            hint=f"give a mesh or splat file, a letter, or one of {', '.join(solid_names())}",
        )
    kind = file_kind(name)
    if kind == "body":
        raise AssetError(f"{name}: a body holds no solid to fill", hint="give the file that it was built from")
    made = _FILLED.changed(**{kind if kind in ("mesh", "radiance") else "splat": Path(name)})
    return _solid_of_object(made, name)


def filled(
    solids: Sequence[Solid],
    *,
    spacing: float | None = 0.5,
    count: int = 10_000,
    material: Material = MORPH_MATERIAL,
    longest: float = LONGEST,
) -> tuple[list[Solid], list[ParticleBody]]:
    """Scale solids to one volume and fill them with particles.

    Args:
        solids: The solids.
        spacing: Distance between particles [m]; None for one that makes about ``count`` of them.
        count: How many particles then.
        material: What they are made of.
        longest: Longest edge that any of them may have [m].

    Returns:
        The scaled solids, in metres, and their particles, in the same frames. The volume is that of the paper's ball,
        or less where a solid would be too long.

    Raises:
        AssetError: If a solid is so thin that it holds no particle.
    """
    volume = min(VOLUME, *(solid.volume * (longest / solid.extent) ** 3 for solid in solids))
    h = (volume / count) ** (1.0 / 3.0) if spacing is None else spacing
    scaled = [solid.scaled((volume / solid.volume) ** (1.0 / 3.0)) for solid in solids]

    def dense(inside: Callable[[Array], NDArray[np.bool_]], points: Array) -> NDArray[np.bool_]:
        """Leave out particles with fewer neighbours than the corner of a box, which sound would tear off."""
        found = np.asarray(inside(points), dtype=bool)
        tree = KDTree(points[found])
        found[found] = tree.query_ball_point(tree.data, 1.01 * h, return_length=True) > CORNER
        return found

    return scaled, [
        particles_from_shape(
            partial(dense, solid.inside), solid.bounds, spacing=h, material=material, volume=solid.volume
        )
        for solid in scaled
    ]


def _solid_of_object(config: ObjectConfig, name: str) -> Solid:
    """Return the solid of a configuration, as it would be integrated for a body."""
    source = object_source(config)
    quadrature, turn = standing_quadrature(config, source)
    factor = float(np.cbrt(np.linalg.det(turn)))
    rotation = turn / factor
    turned = None if np.allclose(rotation, np.eye(3), atol=1e-12) else rotation
    surface = (quadrature.surface_points, quadrature.surface_normals, quadrature.surface_areas)
    return Solid(
        name=name,
        inside=lambda points: winding_numbers(points, *surface) > 0.5,
        bounds=quadrature.bounds,
        volume=quadrature.volume,
        splats=source.splats.transformed(turned, scale=factor),
    )


def _solid_of_level(name: str, level: Level, bounds: Array, colors: tuple[Color, Color]) -> Solid:
    """Return the solid of a function that is nearly a distance, in a checker pattern.

    Points drawn in its box say how much of it is filled; those in a thin shell go to the surface, evenly by area.
    """
    rng, size = np.random.default_rng(0), bounds[1] - bounds[0]
    near, filled, drawn = np.zeros((0, 3)), 0, 0
    while len(near) < CANDIDATES * SPLAT_COUNT:
        x = bounds[0] + size * rng.random((200_000, 3))
        value = level(x)
        near = np.concatenate([near, x[np.abs(value) < SHELL]])
        filled, drawn = filled + int((value < 0.0).sum()), drawn + len(x)
    area = len(near) / drawn * float(size.prod()) / (2.0 * SHELL)
    for _ in range(3):
        slope = level_slope(level, near, SLOPE_STEP)
        near = near - level(near)[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 0.04)
    slope = level_slope(level, near, SLOPE_STEP)
    normals = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    kept = eliminate_samples(near, normals, area, SPLAT_COUNT)
    points, normals = near[kept], normals[kept]
    light = 0.74 + 0.12 * normals[:, 2] + 0.14 * np.clip(normals @ np.asarray(KEY_LIGHT), 0.0, 1.0)
    shade = np.asarray(colors)[checker(points)] * light[:, None]
    return Solid(
        name=name,
        inside=lambda points: level(points) < 0.0,
        bounds=np.stack([points.min(axis=0), points.max(axis=0)]),
        volume=filled / drawn * float(size.prod()),
        splats=splats_from_points(points, normals, np.clip(shade, 0.0, 1.0), name=name),
    )


def _asset(name: str) -> ObjectConfig:
    """Return a mesh that newton installs, upright."""
    with needs_extra("usd", f"the {name} is an OpenUSD asset of newton"):
        import newton.examples
        import pxr  # noqa: F401
    return _FILLED.changed(mesh=Path(newton.examples.get_asset(f"{name}.usd")))


# -- level sets -------------------------------------------------------------------------------------------------------


def _joined(blend: float, *parts: Level) -> Level:
    """Return the union of parts, round where they meet."""

    def level(x: Array) -> Array:
        stack = np.stack([part(x) for part in parts])
        least = stack.min(axis=0)
        return least - blend * np.log(np.exp(-(stack - least) / blend).sum(axis=0))

    return level


def _duck() -> Level:
    """Return a swimming ring with the head of a duck."""
    return _joined(
        0.015,
        torus(0.33, 0.17),
        capsule((-0.31, 0.0, 0.05), (-0.34, 0.0, 0.3), 0.11),
        ellipsoid((0.17, 0.16, 0.16), (-0.34, 0.0, 0.4)),
        ellipsoid((0.09, 0.09, 0.05), (-0.52, 0.0, 0.37)),
        capsule((0.4, 0.0, 0.05), (0.48, 0.0, 0.22), 0.06),
    )


def _cow() -> Level:
    """Return a four-legged animal with a head, ears and a tail."""
    feet = [(dx, dy) for dx in (-0.22, 0.22) for dy in (-0.13, 0.13)]
    return _joined(
        0.02,
        ellipsoid((0.38, 0.26, 0.25)),
        capsule((-0.22, 0.0, 0.05), (-0.36, 0.0, 0.22), 0.14),
        ellipsoid((0.17, 0.17, 0.16), (-0.42, 0.0, 0.25)),
        capsule((0.34, 0.0, 0.1), (0.44, 0.0, -0.05), 0.045),
        *(capsule((dx, dy, -0.1), (1.15 * dx, 1.2 * dy, -0.4), 0.09) for dx, dy in feet),
        *(capsule((-0.38, 0.12 * s, 0.33), (-0.36, 0.25 * s, 0.42), 0.05) for s in (-1.0, 1.0)),
    )


def _car() -> Level:
    """Return a car."""
    axles = [(dx, dy) for dx in (-0.28, 0.28) for dy in (-0.2, 0.2)]
    return _joined(
        0.015,
        box((1.0, 0.44, 0.2), (0.0, 0.0, -0.06), 0.07),
        box((0.5, 0.38, 0.24), (0.05, 0.0, 0.1), 0.09),
        *(cylinder(0.12, dy - 0.05, dy + 0.05, (dx, -0.16), axis=1, rounding=0.015) for dx, dy in axles),
    )


def _star(x: Array) -> Array:
    """Return a thick star with five points, standing."""
    angle = np.arctan2(x[:, 0], x[:, 2])
    across = np.hypot(x[:, 0], x[:, 2])
    turn = np.abs((angle + np.pi / 5.0) % (2.0 * np.pi / 5.0) - np.pi / 5.0)  # from the nearest tip
    # Within its sector a point is bounded by the line from the tip to the notch.
    tip, notch = np.array([0.5, 0.0]), 0.24 * np.array([np.cos(np.pi / 5.0), np.sin(np.pi / 5.0)])
    normal = np.array([notch[1] - tip[1], tip[0] - notch[0]])
    normal /= np.linalg.norm(normal)
    flat = (across * np.cos(turn) - tip[0]) * normal[0] + across * np.sin(turn) * normal[1]
    return np.maximum(flat, np.abs(x[:, 1]) - 0.12)


def _glyph(letter: str) -> tuple[Level, Array]:
    """Return a letter or digit of Pillow's font, standing and a quarter as thick as it is high, and its bounds."""
    from PIL import Image, ImageDraw, ImageFont
    from scipy.ndimage import distance_transform_edt, map_coordinates

    font = ImageFont.load_default(size=GLYPH)
    picture = Image.new("L", (2 * GLYPH, 2 * GLYPH))
    ImageDraw.Draw(picture).text((GLYPH // 2, GLYPH // 2), letter, fill=255, font=font, stroke_width=4)
    filled = np.asarray(picture) > 127
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    if not len(rows):
        raise AssetError(f"{letter}: the font has no such letter", hint="give another letter")
    filled = np.pad(filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 4)
    outside, inside = (np.asarray(distance_transform_edt(part), dtype=np.float64) for part in (~filled, filled))
    distance = outside - inside
    pixel = 1.0 / (rows[-1] - rows[0] + 1)
    height, width = filled.shape
    thick = 0.125

    def level(x: Array) -> Array:
        """Look the distance up, and cap it in front and behind."""
        at = np.stack([0.5 * (height - 1) - x[:, 2] / pixel, x[:, 0] / pixel + 0.5 * (width - 1)])
        flat = pixel * map_coordinates(distance, at, order=1, mode="nearest")
        return np.maximum(flat, np.abs(x[:, 1]) - thick)

    half = np.array([0.5 * width * pixel, thick + 2.0 * pixel, 0.5 * height * pixel])
    return level, np.stack([-half, half])


_FILLED = ObjectConfig(pose="captured", splat_count=SPLAT_COUNT, surface_count=SAMPLE_COUNT)
"""How files are filled: as they stand."""
_BLUE: tuple[Color, Color] = ((0.25, 0.45, 0.78), (0.80, 0.88, 0.96))
_RED: tuple[Color, Color] = ((0.80, 0.25, 0.22), (0.96, 0.82, 0.78))
_YELLOW: tuple[Color, Color] = ((0.95, 0.76, 0.20), (0.98, 0.90, 0.60))
_BROWN: tuple[Color, Color] = ((0.55, 0.38, 0.26), (0.95, 0.93, 0.90))
_GREEN: tuple[Color, Color] = ((0.30, 0.62, 0.40), (0.85, 0.94, 0.82))
_SHAPES: dict[str, tuple[Level, tuple[float, float, float], tuple[Color, Color]]] = {
    "sphere": (ball(0.5), (0.55, 0.55, 0.55), DEFAULT_COLORS),
    "box": (box((1.0,) * 3, rounding=0.05), (0.55, 0.55, 0.55), _GREEN),
    "cylinder": (cylinder(0.35, -0.5, 0.5), (0.4, 0.4, 0.55), _BLUE),
    "torus": (torus(0.345, 0.155, axis=1), (0.55, 0.2, 0.55), _BLUE),
    "star": (_star, (0.52, 0.16, 0.55), _YELLOW),
    "duck": (_duck(), (0.7, 0.55, 0.6), _YELLOW),
    "cow": (_cow(), (0.7, 0.4, 0.55), _BROWN),
    "car": (_car(), (0.55, 0.3, 0.35), _RED),
}
"""Level-set function, half edges of a box that holds it, and colours by name."""
