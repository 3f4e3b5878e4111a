"""Models: things of the papers' figures, made by code and held by their foot, to pull at.

A preset is a toy for a robot. A model has its own handles and material, and stands in its foot.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from softmode.checks import require_choice
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.objects.loader import Progress, load
from softmode.objects.paint import StifferColor
from softmode.objects.soft_object import SoftObject
from softmode.splats.colored_mesh import ColoredMesh

Vector = NDArray[np.float64]

MODELS = {"plant": 1.0 / 60.0, "excavator": 1.0 / 120.0, "jelly": 1.0 / 240.0}
"""Names that `load_model` knows, and the physics step that shows the thing in real time on one core [s]."""
WOOD = Material(youngs_modulus=1.2e8, poissons_ratio=0.3, density=500.0, viscosity=0.004, mass_damping=0.3)
RUBBER = Material(youngs_modulus=4.0e6, poissons_ratio=0.4, density=600.0, viscosity=0.004, mass_damping=4.0)
GEL = Material(youngs_modulus=2.0e4, poissons_ratio=0.45, density=1000.0, friction=0.0, mass_damping=2.0)
PLANT = BuildOptions(handles="local", local_count=78, function_count=80, cubature_count=560)
"""The number of kernels of PIE-NeRF's plant, and of their functions the 80 that count most: 240 unknowns."""
EXCAVATOR = BuildOptions(handles="local", local_count=8, function_count=48, cubature_count=480)
PLANT_FOOT, EXCAVATOR_FOOT, JELLY_FOOT = 0.03, 0.008, 0.01
"""What is held at the bottom [m]."""

_STEM = 0.36
"""Height of the plant's stem [m]."""
_BARK, _STALK, _DARK, _LIGHT = np.array([[93, 64, 38], [104, 122, 48], [38, 112, 36], [120, 178, 62]])
_T = 0.5 * (1.0 + (_BALL := trimesh.creation.icosphere(subdivisions=3)).vertices[:, 0])

EXCAVATOR_HINGES = np.array([[-0.0215, 0.0, 0.082], [0.0485, 0.0, 0.162], [0.1185, 0.0, 0.102]])
"""Places of the excavator's hinges as it stands [m]: root, elbow and wrist of its arm, shape (3, 3)."""
EXCAVATOR_BUCKET = np.array([0.1235, 0.0, 0.057])
"""Place of its bucket as it stands [m]."""
_MIDDLE = np.array([0.0665, 0.0, 0.003])
"""Where it stands in the coordinates in which its mesh is made [m]."""
_YELLOW, _GREY, _GLASS, _BLACK = ((0.94, 0.70, 0.10), (0.28, 0.28, 0.30), (0.45, 0.68, 0.80), (0.05, 0.05, 0.06))
_SLACK = 0.008
"""Half of a hinge [m]."""
_BOXES = (  # edges, places [m] and colours
    ((0.085, 0.10, 0.025), (0.0, 0.0, 0.055), _YELLOW),
    ((0.03, 0.09, 0.045), (-0.04, 0.0, 0.08), _YELLOW),
    ((0.035, 0.03, 0.04), (0.03, -0.01, 0.07), _YELLOW),
    ((0.045, 0.04, 0.05), (0.005, 0.03, 0.088), _GLASS),
    ((0.06, 0.06, 0.02), (0.0, 0.0, 0.035), _GREY),
)


def load_model(
    name: str, *, build: BuildOptions | None = None, splat_count: int | None = None, progress: Progress = None
) -> SoftObject:
    """Return a model, held by its foot.

    Args:
        name: "plant": a potted plant, PIE-NeRF's figure 1. "excavator": a toy whose arm hangs on rubber hinges, its
            figures 4 and 5. "jelly": a cube of gel.
        build: How its body is built; None for its own way.
        splat_count: Splats that cover it; None for its own number.
        progress: Reports the build.

    Raises:
        ConfigError: If there is no such model.
    """
    require_choice("model", name, MODELS)
    given: dict[str, Any] = {"progress": progress}
    if name == "jelly":
        edge = (0.1, 0.1, 0.1)
        given |= {"shape": "box", "extents": edge, "colors": ((0.85, 0.25, 0.35), (0.97, 0.62, 0.55))}
        given |= {"material": GEL, "clamped_height": JELLY_FOOT} | ({} if build is None else {"build": build})
        return load(splat_count=splat_count or 3000, **given)
    if name == "plant":
        mesh, given["material"], own, foot = plant_mesh(), WOOD, PLANT, PLANT_FOOT
    else:
        mesh, given["material"], own, foot = excavator_mesh(), RUBBER, EXCAVATOR, EXCAVATOR_FOOT
        given["stiffness_colors"] = (StifferColor(color=_BLACK, factor=0.02),)
    given |= {"build": build or own, "size": float(mesh.extents.max()), "clamped_height": foot}
    made = ColoredMesh.from_trimesh(mesh, name=name)
    return load(made, pose="captured", splat_count=splat_count or 14000, **given)


def _leaf(curve: Vector, wide: float, thick: float, blunt: float, tints: Vector) -> trimesh.Trimesh:
    """Return a ball drawn out along a curve, whose points at _T are given: pointed as a leaf, or blunt as a branch."""
    values, first, back = np.unique(_T.round(6), return_index=True, return_inverse=True)
    way = np.gradient(curve[first], values, axis=0)[back]
    side = np.cross((1.0, 0.0, 0.0) if np.ptp(curve[:, 2]) > 0.2 else (0.0, 0.0, 1.0), way)
    top = np.cross(way, side)
    y, z = _BALL.vertices.T[1:] * np.maximum(4.0 * _T * (1.0 - _T), 1e-9) ** -blunt
    across = wide * y / np.linalg.norm(side, axis=1) * side.T + thick * z / np.linalg.norm(top, axis=1) * top.T
    colors = tints[0] + np.outer(_T, tints[1] - tints[0])
    return trimesh.Trimesh(curve + across.T, _BALL.faces, vertex_colors=colors.astype(np.uint8), process=False)


def _joined(parts: list[Any]) -> trimesh.Trimesh:
    """Return one mesh of many."""
    whole: Any = trimesh.util.concatenate(parts)
    return whole


def plant_mesh() -> trimesh.Trimesh:
    """Return the plant [m]: a stem, nine branches, and two leaves on each."""

    def arch(root: Vector, long: float, turn: float, rise: float, fall: float) -> Vector:
        return root + long * np.stack([np.cos(turn) * _T, np.sin(turn) * _T, rise * _T - fall * _T**2], axis=1)

    stem = np.stack([0.01 * np.sin(3.0 * _T), 0.01 * np.cos(2.4 * _T) - 0.01, _STEM * _T], axis=1)
    parts: list[Any] = [_leaf(stem, 0.0058, 0.0058, 0.45, np.array([_BARK, _STALK]))]
    for k in range(9):
        branch = arch(stem[np.abs(_T - 0.3 - 0.08 * k).argmin()], 0.105 - 0.006 * k, 2.4 * k, 0.8, 0.3)
        parts.append(_leaf(branch, 0.004, 0.004, 0.45, np.array([_STALK, _DARK])))
        for at, aside in ((0.6, 1.3), (0.96, -0.3)):
            leaf = arch(branch[np.abs(_T - at).argmin()], 0.09 - 0.004 * k, 2.4 * k + aside, 0.3, 0.75)
            parts.append(_leaf(leaf, 0.022 - 0.001 * k, 0.0026, 0.0, (0.8 + 0.04 * k) * np.array([_DARK, _LIGHT])))
    return _joined(parts)


def excavator_mesh() -> trimesh.Trimesh:
    """Return the excavator [m]: tracks, platform, cab, two beams on hinges, a bucket."""
    parts: list[Any] = []
    turned = trimesh.transformations.rotation_matrix

    def add(mesh: Any, at: Any, color: tuple[float, float, float], angle: float = 0.0, axis: int = 1) -> None:
        mesh.apply_transform(turned(angle, np.eye(3)[axis])).apply_translation(at)
        mesh.visual.vertex_colors = np.tile([*color, 1.0], (len(mesh.vertices), 1))
        parts.append(mesh)

    for size, at, color in _BOXES:
        add(trimesh.creation.box(size), at, color)
    for x, y in ((-0.055, -0.04), (-0.055, 0.04), (0.055, -0.04), (0.055, 0.04)):
        add(trimesh.creation.box((0.055, 0.028, 0.034)), (0.5 * x, y, 0.02), _GREY)
        add(trimesh.creation.cylinder(0.017, 0.028, sections=24), (x, y, 0.02), _GREY, np.pi / 2, 0)
    root, elbow, wrist = EXCAVATOR_HINGES + _MIDDLE
    for a, b, wide, ends in ((root, elbow, 0.024, (1.0, 0.4)), (elbow, wrist, 0.022, (0.4, 1.0))):
        step, angle = _SLACK * (b - a) / np.linalg.norm(b - a), np.arctan2(a[2] - b[2], b[0] - a[0])
        hinges = (a - ends[0] * step, a + 1.4 * step, 0.02, _BLACK), (b - 1.4 * step, b + ends[1] * step, 0.019, _BLACK)
        for low, high, edge, color in ((a + step, b - step, wide, _YELLOW), *hinges):
            extents = (float(np.linalg.norm(high - low)), edge, edge)
            add(trimesh.creation.box(extents), 0.5 * (low + high), color, angle)
    sides = ((0.185, 0.11), (0.20, 0.095), (0.205, 0.05), (0.165, 0.06))
    corners: Any = [(x, y, z) for y in (-0.03, 0.03) for x, z in sides]
    add(trimesh.convex.convex_hull(corners), (0.0, 0.0, 0.0), _GREY)
    return _joined(parts)
