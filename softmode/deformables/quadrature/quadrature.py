"""Quadrature: an object as interior points with weights [m^3] and surface samples with areas [m^2].

Every source ends on a grid over the bounding box (a grid integrates two to four times better than random points). Each
cell becomes eight points with the volume, the centroid and the second moments of what lies inside it, so quadratic
functions are integrated as well at the boundary as inside. Meshes are integrated column by column, exactly along z, and
moved until the moments of the whole match; implicit functions by sub-sampling with a linear boundary layer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.quadrature.occupancy import fill_splats
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_implicit import SignedDistance, quadrature_from_implicit
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.errors import AssetError

__all__ = [
    "Quadrature",
    "SignedDistance",
    "quadrature_from_box",
    "quadrature_from_capsule",
    "quadrature_from_implicit",
    "quadrature_from_mesh",
    "quadrature_from_points",
    "quadrature_from_sphere",
    "quadrature_from_splats",
]

Array = NDArray[np.float64]


def quadrature_from_box(
    size: ArrayLike, *, point_count: int = 4000, surface_count: int = SURFACE_COUNT, seed: int = 0
) -> Quadrature:
    """Integrate a box with edges `size` [m] centred at the origin; see `quadrature_from_mesh`."""
    extent = np.asarray(size, dtype=np.float64)
    if extent.shape != (3,) or not (np.isfinite(extent).all() and (extent > 0.0).all()):
        raise AssetError(f"size: expected three positive edge lengths [m], got {size!r}")
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * extent
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return quadrature_from_mesh(corner, faces, point_count=point_count, surface_count=surface_count, seed=seed)


def quadrature_from_sphere(
    radius: float, *, point_count: int = 4000, surface_count: int = SURFACE_COUNT, seed: int = 0
) -> Quadrature:
    """Integrate a sphere of `radius` [m] centred at the origin; volume and area are the exact ones."""
    return quadrature_from_capsule(radius, 0.0, point_count=point_count, surface_count=surface_count, seed=seed)


def quadrature_from_capsule(
    radius: float, half_height: float, *, point_count: int = 4000, surface_count: int = SURFACE_COUNT, seed: int = 0
) -> Quadrature:
    """Integrate a capsule: a segment of 2 `half_height` [m] along z, swept by `radius` [m]; exact volume and area."""
    if not (np.isfinite(radius) and radius > 0.0):
        raise AssetError(f"radius: expected a positive length [m], got {radius!r}")
    if not (np.isfinite(half_height) and half_height >= 0.0):
        raise AssetError(f"half_height: expected a length of zero or more [m], got {half_height!r}")

    def distance(x: Array) -> Array:
        axial = x[:, 2] - np.clip(x[:, 2], -half_height, half_height)
        return np.sqrt(x[:, 0] ** 2 + x[:, 1] ** 2 + axial**2) - radius

    upper = np.array([radius, radius, radius + half_height])
    return quadrature_from_implicit(
        distance,
        np.stack([-upper, upper]),
        point_count=point_count,
        surface_count=surface_count,
        seed=seed,
        volume=np.pi * radius**2 * (4.0 / 3.0 * radius + 2.0 * half_height),
        area=4.0 * np.pi * radius * (radius + half_height),
    )


def quadrature_from_splats(
    means: ArrayLike,
    scales: ArrayLike,
    quats: ArrayLike,
    opacities: ArrayLike,
    *,
    outset: ArrayLike = 0.0,
    point_count: int = 4000,
    surface_count: int = SURFACE_COUNT,
    resolution: int | None = None,
    seed: int = 0,
) -> Quadrature:
    """Fill a shell of Gaussian splats and integrate its interior; `occupancy.fill_splats` states the rule.

    The report's `volume_uncertainty` is the share of the volume in a layer of a tenth of a voxel and a tenth of the
    splats' thickness on the surface.

    Args:
        means: Splat centres [m], shape (N, 3).
        scales: Standard deviations along the splat's axes [m], shape (N, 3).
        quats: Orientations, xyzw, shape (N, 4).
        opacities: Opacities 0..1, shape (N,).
        outset: How far the surface lies outside the centres [m], one for all or shape (N,).
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        resolution: Voxels along the longest edge of the occupancy grid; None raises it as thin parts need.
        seed: Seed of the surface samples.

    Returns:
        The quadrature; its report says what was removed and filled.

    Raises:
        AssetError: If arrays do not match, hold NaN, or enclose no volume.
    """
    solid = fill_splats(means, scales, quats, opacities, resolution=resolution, outset=outset)
    found = quadrature_from_implicit(
        solid.level, solid.bounds, point_count=point_count, surface_count=surface_count, seed=seed, detail=solid.voxel
    )
    thick = float(np.median(np.asarray(scales, dtype=np.float64).min(axis=1)[solid.members]))
    layer = 0.1 * (solid.voxel + thick) * float(found.surface_areas.sum())
    report = {**found.report, **solid.report, "volume_uncertainty": layer / found.volume, "source": "splats"}
    return replace(found, report=report, members=solid.members, satellites=solid.satellites)


def quadrature_from_points(
    points: ArrayLike,
    *,
    radius: float = 0.0,
    point_count: int = 4000,
    surface_count: int = SURFACE_COUNT,
    resolution: int | None = None,
    seed: int = 0,
) -> Quadrature:
    """Integrate the object whose surface a point cloud samples.

    The points are treated as opaque splats without extent; see `quadrature_from_splats`. A few points inside do not
    matter, but a cloud that fills the object comes out too small: its layers behind the surface are seen in part.

    Args:
        points: Positions [m], shape (N, 3).
        radius: How far the surface lies outside the points [m].
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        resolution: Voxels along the longest edge of the occupancy grid; None raises it as thin parts need.
        seed: Seed of the surface samples.

    Returns:
        The quadrature.

    Raises:
        AssetError: If the points enclose no volume.
    """
    x = np.asarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise AssetError(f"points: expected shape (N, 3), got {x.shape}")
    if not (np.isfinite(radius) and radius >= 0.0):
        raise AssetError(f"radius: expected a length of zero or more [m], got {radius!r}")
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (len(x), 1))
    found = quadrature_from_splats(
        x,
        np.zeros_like(x),
        quats,
        np.ones(len(x)),
        outset=radius,
        point_count=point_count,
        surface_count=surface_count,
        resolution=resolution,
        seed=seed,
    )
    return replace(found, report={**found.report, "source": "points"}, satellites=None)
