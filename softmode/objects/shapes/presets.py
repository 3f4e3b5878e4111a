"""Presets: a library of soft objects made by code, each with its shape, its colours and what it is made of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.objects.shapes import preset_shapes as shapes
from softmode.objects.shapes.level_sets import level_mesh, level_slope
from softmode.objects.shapes.preset_shapes import PaintedSolid
from softmode.splats.colored_mesh import ColoredMesh

if TYPE_CHECKING:
    import trimesh

SHADE, SHADE_REACH = 0.45, 0.05
"""How much darker the deepest corner is, and how far from the surface what stands in the light is looked for, over the
size."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """One soft object of the library."""

    what: str
    """What it is."""
    shape: Callable[[], PaintedSolid]
    """Makes its solid."""
    material: Material
    """What it is made of."""
    why: str
    """Where the material's numbers come from."""

    @property
    def properties(self) -> dict[str, float]:
        """The properties of the material that differ between presets, as fields of `Material`."""
        names = ("youngs_modulus", "poissons_ratio", "density", "friction")
        return {name: getattr(self.material, name) for name in names}


def _material(youngs_modulus: float, poissons_ratio: float, density: float, friction: float) -> Material:
    return Material(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio, density=density, friction=friction)


def _block(letter: str, tint: str) -> Preset:
    return Preset(
        what=f"letter block {letter}, a cube with sunken letters",
        shape=functools.partial(shapes.letter_block, letter, tint),
        material=_material(3e5, 0.3, 100.0, 0.8),
        why="EVA play foam",
    )


PRESETS: dict[str, Preset] = {
    "bear": Preset(
        what="sitting teddy bear",
        shape=shapes.bear,
        material=_material(3e4, 0.3, 80.0, 0.8),
        why="polyester filling in cloth",
    ),
    "sponge": Preset(
        what="kitchen sponge with a waist and pores",
        shape=shapes.sponge,
        material=_material(6e4, 0.3, 40.0, 0.8),
        why="open-celled polyurethane foam",
    ),
    "ball": Preset(
        what="small basketball",
        shape=shapes.toy_ball,
        material=_material(3e5, 0.4, 200.0, 0.9),
        why="moulded polyurethane foam",
    ),
    "rope": Preset(
        what="rope of three strands, slender",
        shape=shapes.rope,
        material=_material(1e6, 0.3, 700.0, 0.7),
        why="cotton: its strands slide, so it bends far more easily than its fibres stretch",
    ),
    "cable": Preset(
        what="cable with plug and connector, slender",
        shape=shapes.cable,
        material=_material(4e6, 0.4, 1200.0, 0.6),
        why="soft PVC, 70 Shore A",
    ),
    "mug": Preset(
        what="mug with a handle, thin and concave",
        shape=shapes.mug,
        material=_material(2e6, 0.45, 1150.0, 0.8),
        why="silicone rubber, 45 Shore A",
    ),
    "banana": Preset(
        what="banana",
        shape=shapes.banana,
        material=_material(1e6, 0.4, 950.0, 0.6),
        why="flesh of some 0.3 MPa in a stiffer peel",
    ),
    "bread": Preset(
        what="loaf of tin bread, cut at one end",
        shape=shapes.bread,
        material=_material(3e4, 0.2, 250.0, 0.7),
        why="crumb of some 10 kPa in a stiffer crust",
    ),
    "doughnut": Preset(
        what="doughnut with icing, a ring",
        shape=shapes.doughnut,
        material=_material(3e4, 0.3, 350.0, 0.7),
        why="yeast dough, denser than bread",
    ),
    "cushion": Preset(
        what="small cushion with piping and a button",
        shape=shapes.cushion,
        material=_material(3e4, 0.3, 80.0, 0.7),
        why="polyester filling in cloth",
    ),
    "glove": Preset(
        what="child's knitted glove, branching, its cuff open",
        shape=shapes.glove,
        material=_material(1e5, 0.3, 150.0, 0.8),
        why="padded wool",
    ),
    "fish": Preset(
        what="clownfish, a bath toy with thin fins",
        shape=shapes.fish,
        material=_material(8e5, 0.45, 1000.0, 0.8),
        why="soft vinyl, 25 Shore A",
    ),
    "block-a": _block("A", "c8402f"),
    "block-b": _block("B", "2f6fb0"),
    "block-c": _block("C", "3f8f4f"),
}
"""The presets by name."""


def find_preset(name: str) -> Preset:
    """Return a preset.

    Raises:
        ConfigError: If there is none of that name.
    """
    if name not in PRESETS:
        raise ConfigError(f"there is no preset {name!r}", hint=f"use one of {', '.join(PRESETS)}")
    return PRESETS[name]


@functools.cache
def preset_mesh(name: str) -> ColoredMesh:
    """Return the surface of a preset at its own size, z up [m].

    Raises:
        ConfigError: If there is none of that name.
    """
    return ColoredMesh.from_trimesh(preset_surface(name), name=name)


def preset_surface(name: str) -> trimesh.Trimesh:
    """Return the surface of a preset with colours at its vertices: closed, z up, standing on z = 0 over the origin [m].

    Corners that little light reaches are painted darker.

    Raises:
        ConfigError: If there is none of that name.
    """
    import trimesh

    solid = find_preset(name).shape()
    mesh = level_mesh(solid.level, solid.low, solid.high, solid.cell)
    points = np.asarray(mesh.vertices)
    reach = SHADE_REACH * float(np.ptp(points, axis=0).max())
    normals = level_slope(solid.level, points, 0.5 * solid.cell)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    open_ = np.mean([np.clip(solid.level(points + r * normals) / r, 0.0, 1.0) for r in (0.3 * reach, reach)], axis=0)
    colors = np.clip(solid.paint(points) * (1.0 - SHADE * (1.0 - open_))[:, None], 0.02, 0.98)
    painted = np.round(255.0 * np.column_stack([colors, np.ones(len(colors))])).astype(np.uint8)
    mesh = trimesh.Trimesh(points, mesh.faces, vertex_colors=painted, process=False)
    low, high = mesh.bounds
    mesh.apply_translation([*(-0.5 * (low + high)[:2]), -low[2]])
    return mesh
