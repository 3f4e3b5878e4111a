"""Points that sample the regions of a body, and how motions of those points become driven coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.quadrature_grid import Cells, Quadrature
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]

_REFINED = 1.25
"""Boxes are refined up to this many of their widths from a face."""
_GAUSS = {2: np.polynomial.legendre.leggauss(2), 3: np.polynomial.legendre.leggauss(3)}
"""Places and weights of Gauss's rules on (-1, 1)."""


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """What an object is cut into where regions come near: boxes there, and the points of its whole cells elsewhere."""

    points: Array
    """Centroids of the boxes, and points [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], shape (P,)."""
    parent: NDArray[np.intp]
    """Quadrature point that each is or is nearest to, shape (P,)."""
    edges: Array
    """Edges of the boxes along `axes` [m], shape (P, 3); zeros for points of whole cells."""
    axes: Array
    """Axes of the boxes, unit vectors in rows, shape (3, 3)."""


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


def pieces_near(quadrature: Quadrature, regions: Sequence[Region]) -> Pieces:
    """Take the octants of cells that faces of regions cut or come near to, in place of their points.

    Octants tile the object, so that the part of them inside a face is known; Gauss points do not.

    Args:
        quadrature: The object.
        regions: The regions, in its frame.
    """
    points, weights, cells = quadrature.points, quadrature.weights, quadrature.cells
    every, frame = np.arange(len(points)), np.eye(3)
    if cells is None or not regions:
        edges = np.full((len(points), 3), quadrature.spacing if regions else 0.0)
        return Pieces(points=points, weights=weights, parent=every, edges=edges, axes=frame)
    edges, frame = _octant_edges(cells), frame if cells.axes is None else cells.axes
    near = np.zeros(1 + max(cells.of_point.max(), cells.of_octant.max()), dtype=bool)
    for region in regions:
        distance, _, width, _ = region.cut(cells.octants, edges, frame)
        near[cells.of_octant[(distance > -width) & (distance < 0.75 * width)]] = True
    kept, split = every[~near[cells.of_point]], near[cells.of_octant]
    nearest = KDTree(points).query(cells.octants[split])[1]
    return Pieces(
        points=np.concatenate([points[kept], cells.octants[split]]),
        weights=np.concatenate([weights[kept], cells.weights[split]]),
        parent=np.concatenate([kept, nearest]),
        edges=np.concatenate([np.zeros((len(kept), 3)), edges[split]]),
        axes=frame,
    )


def longest_edge(quadrature: Quadrature) -> float:
    """Return the longest edge of an octant, the median over all of them [m]."""
    cells = quadrature.cells
    return quadrature.spacing if cells is None else float(np.median(_octant_edges(cells).max(axis=1)))


def _octant_edges(cells: Cells) -> Array:
    """Return the edges of octants along the axes of their grid [m], (Q, 3), made shorter where less is filled."""
    if cells.borders is None or cells.place is None:
        return np.repeat(np.cbrt(cells.weights)[:, None], 3, axis=1)
    ends = [line[cells.place[:, d] + 1] - line[cells.place[:, d]] for d, line in enumerate(cells.borders)]
    edges = np.stack(ends, axis=1)
    return edges * np.cbrt(np.minimum(cells.weights / edges.prod(axis=1), 1.0))[:, None]


def sample_regions(
    regions: Sequence[Region], pieces: Pieces, offset: Array, stiffness: Array, spacing: float, bounds: Array
) -> RegionSamples:
    """Sample regions by the cells of a quadrature; exact ones also by corners, so that a layer of cells has thickness.

    Args:
        regions: The regions, less the offset.
        pieces: The object.
        offset: What is taken from its points [m], shape (3,).
        stiffness: Their relative Young's modulus, shape (P,): springs of a soft region are as stiff as what they hold.
        spacing: Edge of their cells [m].
        bounds: Of the object, less the offset [m], shape (2, 3).

    Warns:
        RuntimeWarning: If a region is thinner than the cells there, or a soft one overlaps another.

    Raises:
        ConfigError: If two regions have one name.
        BasisError: If a region holds too few points, exact regions overlap, or they hold the whole body.
    """
    names = [region.name for region in regions]
    if len(set(names)) != len(names):
        raise ConfigError(f"regions: names must differ, got {names}")
    points, weights = pieces.points - offset, pieces.weights
    held, sprung = np.full((2, len(points)), -1)
    places, volumes, index = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for i, region in enumerate(regions):
        place, volume = region.integrate(points, weights, pieces.edges, pieces.axes)
        distance, _, width, share = region.cut(points, pieces.edges, pieces.axes)
        inside, exact = distance <= 0.0, region.stiffness is None
        taken = held if exact else sprung
        for other in (other for other in (held, sprung) if (other[inside] >= 0).any()):
            both = f"regions {names[other[inside].max()]!r} and {region.name!r} overlap"
            if exact and other is held:
                raise BasisError(both, hint="Merge them or make one soft.")
            what = "their springs add up there" if other is taken else "springs do nothing where one is held exactly"
            warnings.warn(f"{both}: {what}", RuntimeWarning, stacklevel=4)
        taken[inside] = i
        edge = float(np.median(np.append(0.0, width[(share > 0.02) & (width > 0.0)])))
        if (thickness := region.thickness(bounds)) < edge:
            warnings.warn(
                f"region {region.name!r} is {1e3 * thickness:.2g} mm thick, the cells there {1e3 * edge:.2g} mm:"
                " what it holds is coarse; enlarge it, or take more quadrature points",
                RuntimeWarning,
                stacklevel=4,
            )
        if exact:
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
    rigid = np.array([region.stiffness is None for region in regions], dtype=bool)
    return RegionSamples(
        points=np.concatenate(places), index=found, weights=np.concatenate(volumes), exact=rigid[found]
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


def refine_at_faces(regions: Sequence[Region], pieces: Pieces, offset: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Refine a quadrature at the faces of exact regions, where displacements have a kink.

    Boxes that a face cuts become two: a function that rises between a face and the first point away from it would cost
    no energy. Boxes outside get Gauss's rule of two points per axis within their own edges, three across a face beside
    them. With the rule of a cube, every second layer of points lay outside of a plate 50:1, which came out half again
    as stiff where it carries the moment of its clamp.

    Args:
        regions: The regions, less the offset.
        pieces: The object.
        offset: What is taken from its points [m], shape (3,).

    Returns:
        Points [m] (P', 3), volumes [m^3] (P',), and the piece that each came from (P',).
    """
    points, weights, edges, frame = pieces.points - offset, pieces.weights.copy(), pieces.edges.copy(), pieces.axes
    parent, boxes = np.arange(len(points)), np.einsum("pa->p", edges) > 0.0
    near, across = boxes & ~boxes.all(), np.full(len(points), -1)
    within = np.zeros(len(points), dtype=bool)
    for region in (region for region in regions if region.stiffness is None):
        distance, normal, width, share = region.cut(points, edges, frame)
        along = (np.abs(normal @ frame.T) * edges).argmax(axis=1)
        close = boxes & (np.abs(distance) < _REFINED * width)
        across[close], near = along[close], near | close
        within |= share == 1.0
        cut = np.flatnonzero(boxes & (share > 0.01) & (share < 0.99))
        f, axis, row = share[cut], along[cut], np.arange(len(cut))
        way = frame[axis] * np.sign(np.einsum("pa,pa->p", frame[axis], normal[cut]))[:, None]
        full, inside = edges[cut, axis], edges[cut]
        inside[row, axis] = f * full
        edges[cut, axis] = (1.0 - f) * full
        points = np.concatenate([points, points[cut] - (0.5 * (1.0 - f) * full)[:, None] * way])
        points[cut] += (0.5 * f * full)[:, None] * way
        weights = np.concatenate([weights, weights[cut] * f])
        weights[cut] *= 1.0 - f
        edges, parent, across = np.concatenate([edges, inside]), np.append(parent, parent[cut]), np.append(across, axis)
        boxes, near = np.append(boxes, boxes[cut]), np.append(near, near[cut])
        within = np.append(within, np.ones(len(cut), dtype=bool))
    near &= ~within
    parts = [(points[~near], weights[~near], parent[~near])]
    for axis in range(-1, 3):
        mine = np.flatnonzero(near & (across == axis))
        rule = [_GAUSS[3 if d == axis else 2] for d in range(3)]
        place = 0.5 * np.stack(np.meshgrid(*[x for x, _ in rule], indexing="ij"), axis=-1).reshape(-1, 3)
        share = np.einsum("i,j,k->ijk", *[w / 2.0 for _, w in rule]).ravel()
        inner = (points[mine][:, None] + (place * edges[mine][:, None]) @ frame).reshape(-1, 3)
        parts.append((inner, (weights[mine][:, None] * share).ravel(), np.repeat(parent[mine], len(share))))
    points, weights, parent = (np.concatenate(part) for part in zip(*parts, strict=True))
    return points, weights, parent
