"""Boxes, cylinders, capsules and spheres: surface, solid and two-coloured splats of the primitive soft objects."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_capsule
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.splats import SH_DC, Splats, rotations_from_quats

if TYPE_CHECKING:
    import trimesh

Primitive = Literal["box", "cylinder", "capsule", "sphere"]
Array = NDArray[np.float64]
Color = tuple[float, float, float]
Extents = tuple[float, float, float]

SECTIONS = 64
"""Sides of the polygon that stands for a circle; its radius is such that the polygon has the circle's area."""
KEY_LIGHT = (0.37, 0.29, 0.88)
"""Direction towards the light that is painted on the splats, which are not lit otherwise."""


def find_axis(shape: Primitive, extents: Extents) -> int | None:
    """Return the axis of symmetry of a round shape, whose other two extents are equal; None if there is none.

    A cylinder may be a disc; a capsule is at least as long as it is wide, a sphere has three equal extents.

    Args:
        shape: Which shape.
        extents: Edges of the bounding box [m].
    """
    a = np.asarray(extents, dtype=np.float64)
    spread = [float(np.ptp(np.delete(a, k))) for k in range(3)]
    axis = 2 if np.ptp(a) <= 1e-9 else int(np.argmin(spread))
    if shape == "box":
        return axis
    round_ = spread[axis] <= 1e-6 * a.max()
    if shape == "sphere":
        return axis if np.ptp(a) <= 1e-6 * a.max() else None
    return axis if round_ and (shape == "cylinder" or a[axis] >= (1.0 - 1e-6) * a.max()) else None


def primitive_mesh(shape: Primitive, extents: Extents) -> trimesh.Trimesh:
    """Return the surface, centred at the origin.

    Args:
        shape: Which shape.
        extents: Edges of the bounding box [m]; see :func:`find_axis`.
    """
    import trimesh

    if shape == "box":
        return trimesh.creation.box(extents)
    axis, radius, length = _round(shape, extents)
    if shape == "cylinder":
        turn = 2.0 * np.pi / SECTIONS
        mesh = trimesh.creation.cylinder(radius * np.sqrt(turn / np.sin(turn)), length, sections=SECTIONS)
    elif shape == "capsule":
        mesh = trimesh.creation.capsule(length - 2.0 * radius, radius, count=[SECTIONS, SECTIONS])
        mesh.vertices -= mesh.bounds.mean(axis=0)
    else:
        mesh = trimesh.creation.icosphere(4, radius)
    mesh.apply_transform(np.block([[_along(axis), np.zeros((3, 1))], [np.eye(4)[3:]]]))
    return mesh


def primitive_quadrature(shape: Primitive, extents: Extents, surface_count: int) -> Quadrature:
    """Integrate the solid: volume and area of boxes, capsules and spheres are exact, cylinders have their volume.

    Args:
        shape: Which shape.
        extents: Edges of the bounding box [m]; see :func:`find_axis`.
        surface_count: Number of surface samples.
    """
    if shape == "box":
        return quadrature_from_box(extents, surface_count=surface_count)
    if shape == "cylinder":
        mesh = primitive_mesh(shape, extents)
        return quadrature_from_mesh(mesh.vertices, mesh.faces, surface_count=surface_count)
    axis, radius, length = _round(shape, extents)
    found = quadrature_from_capsule(radius, max(0.5 * length - radius, 0.0), surface_count=surface_count)
    half = 0.5 * np.asarray(extents, dtype=np.float64)
    return replace(turned(found, _along(axis), found.surface_points), bounds=np.stack([-half, half]))


def turned(quadrature: Quadrature, rotation: Array, outline: Array) -> Quadrature:
    """Return the quadrature after a rotation; the same points, so that a stable pose stays one.

    Args:
        quadrature: The solid.
        rotation: The rotation, shape (3, 3).
        outline: Points on its surface that span its new bounding box [m], shape (H, 3).
    """
    turn, cells, surface = rotation, quadrature.cells, outline @ rotation.T
    return replace(
        quadrature,
        points=quadrature.points @ turn.T,
        surface_points=quadrature.surface_points @ turn.T,
        surface_normals=quadrature.surface_normals @ turn.T,
        bounds=np.stack([surface.min(axis=0), surface.max(axis=0)]),
        cells=cells
        and replace(
            cells, octants=cells.octants @ turn.T, axes=(np.eye(3) if cells.axes is None else cells.axes) @ turn.T
        ),
    )


def scaled(quadrature: Quadrature, factor: float) -> Quadrature:
    """Return the quadrature of an object that is `factor` times as large."""
    cells, lengths = quadrature.cells, ("voxel", "smoothing", "wall")
    told = {key: value * factor if key in lengths else value for key, value in quadrature.report.items()}
    return replace(
        quadrature,
        points=quadrature.points * factor,
        weights=quadrature.weights * factor**3,
        spacing=quadrature.spacing * factor,
        surface_points=quadrature.surface_points * factor,
        surface_areas=quadrature.surface_areas * factor**2,
        volume=quadrature.volume * factor**3,
        bounds=quadrature.bounds * factor,
        report=told,
        cells=cells
        and replace(
            cells,
            octants=cells.octants * factor,
            weights=cells.weights * factor**3,
            borders=None if cells.borders is None else cells.borders * factor,
        ),
    )


def surface_splats(mesh: ColoredMesh, count: int, colors: tuple[Color, Color] | None = None) -> Splats:
    """Cover a surface with flat splats, with light from above painted on.

    Args:
        mesh: The surface.
        count: Number of splats.
        colors: Colours 0..1 of a checker pattern, see :func:`checker`; None keeps the mesh's.
    """
    splats = sample_mesh(mesh, count)
    normals = rotations_from_quats(splats.quats)[:, :, 2]
    color = splats.colors().astype(np.float64) if colors is None else np.asarray(colors)[checker(splats.means)]
    light = 0.74 + 0.12 * normals[:, 2] + 0.14 * np.clip(normals @ np.asarray(KEY_LIGHT), 0.0, 1.0)
    return replace(splats, sh=((color * light[:, None] - 0.5) / SH_DC)[:, None])


def checker(points: ArrayLike) -> NDArray[np.int64]:
    """Return which of two colours a three-dimensional checker board has at each point, 0 or 1, shape (N,).

    Its cells are cubes, nearly: a quarter of the longest edge of the points' bounding box or, if that is less, its
    shortest edge. A slender object is striped.

    Args:
        points: Positions [m], shape (N, 3).
    """
    x = np.asarray(points, dtype=np.float64)
    low, extent = x.min(axis=0), np.maximum(np.ptp(x, axis=0), 1e-12)
    cells = np.maximum(np.round(extent / np.clip(extent.min(), 0.05 * extent.max(), 0.25 * extent.max())), 1.0)
    index = np.clip(np.floor((x - low) / extent * cells), 0.0, cells - 1.0)
    return index.sum(axis=1).astype(np.int64) % 2


def _round(shape: Primitive, extents: Extents) -> tuple[int, float, float]:
    """Return the axis of a round shape, its radius and its length along the axis [m]."""
    axis = find_axis(shape, extents)
    if axis is None:
        raise ValueError(f"extents {extents} are not those of a {shape}")
    return axis, 0.5 * float(extents[(axis + 1) % 3]), float(extents[axis])


def _along(axis: int) -> Array:
    """Return the rotation that takes z to an axis and keeps the axes' lines."""
    return np.roll(np.eye(3), axis + 1, axis=0)
