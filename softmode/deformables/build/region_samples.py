"""Points that sample the regions of a body, and how motions of those points become driven coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.regions import Region
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]

_REFINED = 1.25
"""Cells are refined up to this many spacings from a face."""


@dataclass(frozen=True, kw_only=True)
class RegionSamples:
    """Points of all regions together."""

    points: Array
    """Positions [m], shape (N, 3)."""
    index: NDArray[np.int64]
    """Region of each, shape (N,)."""
    weights: Array
    """Volumes [m^3], of soft regions times relative Young's modulus, shape (N,); corners of exact regions have none."""
    exact: NDArray[np.bool_]
    """Whether the region of each is exact, shape (N,)."""


def octants_near(quadrature: Quadrature, regions: Sequence[Region]) -> tuple[Array, Array, NDArray[np.intp]]:
    """Take the octants of cells that regions hold or come near to, in place of their points.

    Octants tile the object, so that the part of them inside a face is known; Gauss points do not.

    Args:
        quadrature: The object.
        regions: The regions, in its frame.

    Returns:
        Points [m] (P', 3), volumes [m^3] (P',), and the quadrature point that each came from or is nearest to (P',).
    """
    points, weights, cells = quadrature.points, quadrature.weights, quadrature.cells
    if cells is None or not regions:
        return points, weights, np.arange(len(points))
    reach = np.min([region.distance(cells.octants)[0] for region in regions], axis=0)
    near = np.zeros(1 + max(cells.of_point.max(), cells.of_octant.max()), dtype=bool)
    near[cells.of_octant[reach < 2.0 * quadrature.spacing]] = True
    kept, split = np.flatnonzero(~near[cells.of_point]), near[cells.of_octant]
    nearest = KDTree(points).query(cells.octants[split])[1]
    return (
        np.concatenate([points[kept], cells.octants[split]]),
        np.concatenate([weights[kept], cells.weights[split]]),
        np.concatenate([kept, nearest]),
    )


def sample_regions(
    regions: Sequence[Region], points: Array, weights: Array, stiffness: Array, spacing: float
) -> RegionSamples:
    """Sample regions by the cells of a quadrature; exact ones also by corners, so that a layer of cells has thickness.

    Args:
        regions: The regions, in the frame of the points.
        points: Quadrature points [m], shape (P, 3).
        weights: Their volumes [m^3], shape (P,).
        stiffness: Their relative Young's modulus, shape (P,): springs of a soft region are as stiff as what they hold.
        spacing: Edge of their cells [m].

    Raises:
        ConfigError: If two regions have one name.
        BasisError: If a region holds too few points, exact regions overlap, or they hold the whole body.
    """
    names = [region.name for region in regions]
    if len(set(names)) != len(names):
        raise ConfigError(f"regions: names must differ, got {names}")
    held = np.full(len(points), -1)
    places, volumes, index = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for i, region in enumerate(regions):
        place, volume = region.integrate(points, weights, spacing)
        if region.stiffness is None:
            inside = region.distance(points)[0] <= 0.0
            if (held[inside] >= 0).any():
                other = names[held[inside].max()]
                raise BasisError(f"regions {other!r} and {region.name!r} overlap", hint="Merge them or make one soft.")
            held[inside] = i
            corner = region.corners(place, spacing)
            place, volume = np.concatenate([place, corner]), np.concatenate([volume, np.zeros(len(corner))])
        else:
            volume = volume * stiffness[KDTree(points).query(place)[1]]
        places.append(place)
        volumes.append(volume)
        index.append(np.full(len(place), i, dtype=np.int64))
    if (held >= 0).all():
        raise BasisError("the exact regions hold the whole body", hint="Regions are given in asset coordinates.")
    found = np.concatenate(index)
    exact = np.array([region.stiffness is None for region in regions], dtype=bool)
    return RegionSamples(
        points=np.concatenate(places), index=found, weights=np.concatenate(volumes), exact=exact[found]
    )


def drive_matrices(samples: RegionSamples, values: Array, region_count: int) -> tuple[Array, Array]:
    """Return how motions of the regions become driven coordinates.

    Args:
        samples: The samples, N of them.
        values: Driven functions at the samples of exact regions, (N_exact, r).
        region_count: Number of regions R.

    Returns:
        Least squares from displacements of the samples, (r, N), and from affine motions, (R, r, 4).
    """
    count = values.shape[1]
    drive = np.zeros((count, len(samples.points)))
    if count:
        drive[:, samples.exact] = np.linalg.pinv(values, rcond=1e-9)
    z = np.column_stack([samples.points, np.ones(len(samples.points))])
    affine = [drive[:, mine] @ z[mine] for mine in (samples.index == i for i in range(region_count))]
    return drive, np.stack(affine) if affine else np.zeros((0, count, 4))


def rigid_motions(samples: RegionSamples, values: Array, region_count: int) -> Array:
    """Return the rigid motions of every exact region while the others stand still, in the driven functions.

    Args:
        samples: The samples.
        values: Driven functions at the samples of exact regions, (N_exact, r).
        region_count: Number of regions.

    Returns:
        Coordinates (3 r, 6 E) for E exact regions, all x components first; none for a single one, which moves with all.
    """
    moved = np.unique(samples.index[samples.exact])
    if len(moved) < 2:
        return np.zeros((3 * values.shape[1], 0))
    generator = np.zeros((6, 4, 3))
    generator[range(3), 3, range(3)] = 1.0
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 0)), start=3):
        generator[k, a, b], generator[k, b, a] = 1.0, -1.0
    found = np.einsum("erc,kca->arek", drive_matrices(samples, values, region_count)[1][moved], generator)
    return found.reshape(3 * values.shape[1], -1)


def refine_at_faces(
    regions: Sequence[Region], points: Array, weights: Array, spacing: float
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Refine a quadrature at the faces of exact regions, where displacements have a kink.

    Cells near a face are halved along every axis, and those that the face cuts are cut: a function that rises between
    a face and the first point away from it would cost no energy.

    Returns:
        Points [m] (P', 3), volumes [m^3] (P',), and the cell that each came from (P',).
    """
    parent = np.arange(len(points))
    faces = [region for region in regions if region.stiffness is None]
    if not faces:
        return points, weights, parent
    near = np.min([np.abs(region.distance(points)[0]) for region in faces], axis=0) < _REFINED * spacing
    octants = 0.25 * spacing * np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.concatenate([points[~near], (points[near][:, None] + octants).reshape(-1, 3)])
    weights = np.concatenate([weights[~near], np.repeat(weights[near] / 8.0, 8)])
    parent = np.concatenate([parent[~near], np.repeat(parent[near], 8)])
    half = 0.5 * spacing
    for region in faces:
        distance, normal = region.distance(points)
        share = np.clip(0.5 - distance / half, 0.0, 1.0)
        cut = np.flatnonzero((share > 0.01) & (share < 0.99))
        inner = points[cut] - (0.5 * (distance[cut] + 0.5 * half))[:, None] * normal[cut]
        outer = points[cut] + (0.5 * (0.5 * half - distance[cut]))[:, None] * normal[cut]
        points = np.concatenate([points, inner])
        weights = np.concatenate([weights, weights[cut] * share[cut]])
        parent = np.concatenate([parent, parent[cut]])
        points[cut], weights[cut] = outer, weights[cut] * (1.0 - share[cut])
    return points, weights, parent
