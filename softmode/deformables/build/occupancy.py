"""Interior of a shell: the smooth occupancy field that a cloud of Gaussian splats encloses.

A trained splat is a shell of discs without orientation, with stray splats outside, junk inside, and holes where no
camera looked. `fill_splats` states the rule that turns it into a solid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.errors import AssetError

Array = NDArray[np.float64]

OPACITY_FLOOR = 0.1
"""Fainter splats are haze."""
SCALE_LIMIT = 0.25
"""Splats with a standard deviation over this fraction of the object's (robust) diagonal are background."""
SMALL_PART = 0.01
"""Detached parts with less than this fraction of all area are floaters."""
LINK = 2.0
"""Splats are linked when closer than this many times their distance to the sixth neighbour (the smaller of the two),
or within a half-opaque disc."""
PART_LIMIT = 6
"""At most this many parts, the largest by area, are tried as the object."""
VIEW_COUNT = 96
"""Directions from which the shell is looked at."""


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """The solid that a shell of splats encloses."""

    level: Callable[[Array], Array]
    """Level-set function of points (N, 3), negative inside, trilinear."""
    bounds: Array
    """Corners of a box that holds the solid [m], shape (2, 3)."""
    members: NDArray[np.bool_]
    """Which splats belong to the object: its shell, what it hides, and the haze on it; shape (N,)."""
    satellites: NDArray[np.bool_]
    """Which splats belong to smaller detached parts close by (a hovering hand); not in the solid; shape (N,)."""
    report: dict[str, Any]
    """Counts and lengths for the record."""


def fill_splats(
    means: ArrayLike,
    scales: ArrayLike,
    quats: ArrayLike,
    opacities: ArrayLike,
    *,
    resolution: int = 64,
    outset: float = 0.0,
) -> Occupancy:
    """Turn a shell of splats into a level-set function of the solid it encloses.

    1. *Floaters* go: opacity under 0.1, a standard deviation over a quarter of the scene's diagonal, and detached
       parts (linked when closer than twice their distance to the sixth neighbour, or within the half-opaque disc of
       one of them) with less than 1 % of the area.
    2. *The object* is the part whose solid holds the largest ball: a floor slab under the object loses, however wide.
    3. *Samples*: each splat is spread over its disc with one sample per voxel. The surface lies where a splat seen
       edge-on is half opaque: outside the centre by sigma_n sqrt(2 ln(2 alpha)), zero for flat splats, so the shell's
       thickness does not inflate the volume.
    4. *Orientation by views*: 96 orthographic depth buffers tell which samples are seen from where. The normal (the
       splat's thin axis; of round splats, that of the neighbourhood) points to the side seen more. Samples that no
       view sees (inside) or seen equally from both sides (open sheets) are dropped.
    5. *Fill*: with a_i the area of a sample from the local density, solve  lap(chi) = -div(sum_i a_i n_i G(X - X_i))
       (Poisson reconstruction with a sine transform). chi is the indicator of the solid smoothed over about one sample
       spacing; a hole in the shell is closed by a smooth cap.
    6. *The solid* is chi > the mean of chi over the samples: the connected part that holds the largest ball, without
       internal voids.

    Args:
        means: Splat centres [m], shape (N, 3).
        scales: Standard deviations [m], shape (N, 3).
        quats: Orientations, xyzw, shape (N, 4).
        opacities: Opacities 0..1, shape (N,).
        resolution: Voxels along the longest edge; sparse shells get larger voxels.
        outset: Distance [m] added outside every sample.

    Returns:
        The occupancy.

    Raises:
        AssetError: If the arrays do not match, hold NaN, or enclose no volume.
    """
    mean, scale, axes, opacity = _validate(means, scales, quats, opacities)
    part, link, report = _split_parts(mean, scale, opacity)

    def fill(index: NDArray[np.intp], voxels: int) -> _Solid:
        return _fill_part(mean[index], scale[index], axes[index], opacity[index], voxels, outset)

    bulk = np.bincount(part[part >= 0], _area_of(scale, opacity, link)[part >= 0])
    tried = [k for k in np.argsort(-bulk, kind="stable")[:PART_LIMIT] if bulk[k] >= SMALL_PART * bulk.sum()]
    members = [np.flatnonzero(part == k) for k in tried]
    best = 0
    if len(tried) > 1:
        balls = []
        for index in members:
            try:
                balls.append(fill(index, resolution // 2).ball)
            except AssetError:
                balls.append(0.0)
        best = int(np.argmax(balls))
    solid = fill(members[best], resolution)
    chosen = members[best]

    tree = KDTree(mean[chosen])
    size = np.ptp(mean[chosen], axis=0)
    member, satellite = np.zeros(len(mean), dtype=bool), np.zeros(len(mean), dtype=bool)
    member[chosen] = True
    loose = np.flatnonzero((part < 0) & (scale[:, 0] < 0.25 * float(np.linalg.norm(size))))
    if len(loose):
        member[loose[tree.query(mean[loose])[0] < 0.5 * link]] = True
    for k in np.flatnonzero(bulk >= 0.02 * bulk[tried[best]]):
        index = np.flatnonzero(part == k)
        if k != tried[best] and (np.ptp(mean[index], axis=0) < 0.5 * size.max()).all():
            satellite[index] = tree.query(mean[index])[0].min() < 0.2 * float(np.linalg.norm(size))
    report |= {
        "splats": len(mean),
        "splats_of_object": int(member.sum()),
        "splats_of_satellites": int(satellite.sum()),
        "parts": len(tried),
        **solid.report,
    }
    return Occupancy(level=solid.level, bounds=solid.bounds, members=member, satellites=satellite, report=report)


@dataclass(frozen=True)
class _Solid:
    level: Callable[[Array], Array]
    bounds: Array
    ball: float
    report: dict[str, Any]


def _fill_part(mean: Array, scale: Array, axes: Array, opacity: Array, resolution: int, outset: float) -> _Solid:
    """Fill one linked part; steps 3 to 6 of `fill_splats`."""
    if len(mean) < 16:
        raise _no_volume(f"{len(mean)} splats")
    extent = np.ptp(mean, axis=0)
    if not extent.max() > 0.0:
        raise _no_volume("all splats lie at one point")
    spacing = _typical_spacing(mean)
    width = float(np.median(scale[:, 1])) if scale.any() else spacing
    voxel = float(max(extent.max() / resolution, 0.7 * min(spacing, width)))
    voxel = min(voxel, float(extent.max()) / 12.0)

    sample, owner = _spread(mean, scale, axes, voxel)
    # Samples of one splat are a voxel apart; where splats do not overlap, the gap between them decides how much to
    # smooth.
    gap = float(np.median(KDTree(sample).query(sample, k=7)[0][:, 6]))
    sigma = max(1.2 * voxel, 0.6 * gap)
    normal = _normals(mean, scale, axes)
    sign, confidence, seen = _orient(sample, normal[owner], owner, len(mean), max(voxel, gap))
    normal *= sign[:, None]
    lift = scale[:, 2] * _half_opaque(opacity) + outset
    keep = seen & (confidence[owner] > 0.0)
    sample = (sample + (lift[:, None] * normal)[owner])[keep]
    owner = owner[keep]
    if len(sample) < 32:
        raise _no_volume("no closed shell is seen from outside")

    margin = max(8.0 * voxel, 3.0 * sigma, 0.15 * float(extent.max()))
    origin = sample.min(axis=0) - margin
    cells = np.ceil((np.ptp(sample, axis=0) + 2.0 * margin) / voxel) + 1
    shape = np.array([fft.next_fast_len(int(k), real=True) for k in cells])
    where = (sample - origin) / voxel
    blur = sigma / voxel
    density = ndimage.gaussian_filter(_deposit(where, np.ones(len(sample)), shape), blur, mode="constant")
    # A plane with one sample per area a shows the density 1 / (a sqrt(2 pi) blur); depositing and reading back widen
    # the filter.
    area = 1.0 / (np.maximum(_read(density, where), 1e-12) * np.sqrt(2.0 * np.pi * (blur**2 + 1.0 / 3.0)))
    weight = area * confidence[owner]
    source = np.zeros(tuple(shape))
    for d in range(3):
        flux = _deposit(where, weight * normal[owner, d], shape)
        source -= np.gradient(ndimage.gaussian_filter(flux, blur, mode="constant"), axis=d)
    chi = _solve_poisson(source)
    level = float(np.average(_read(chi, where), weights=weight))
    solid = chi > level
    labelled: Any = ndimage.label(solid)
    label, count = labelled
    if not level > 0.15 or count == 0 or float(chi.max()) < 1.3 * level:
        raise _no_volume("the splats enclose nothing")
    depth: Any = ndimage.distance_transform_edt(solid)
    largest: Any = ndimage.maximum(depth, label, np.arange(1, count + 1))
    balls = np.asarray(largest, dtype=np.float64)
    main = label == 1 + int(balls.argmax())
    whole: Any = ndimage.binary_fill_holes(main)
    inside = np.argwhere(whole)
    if len(inside) < 64 or balls.max() < 1.5:
        raise _no_volume(f"{len(inside)} voxels are enclosed")
    chi = np.where(solid & ~main, 0.5 * level, chi)
    chi = np.where(whole & ~main, np.maximum(chi, 1.5 * level), chi)
    # One and a half voxels around the outermost inner nodes hold the whole zero level of the trilinear field.
    bounds = origin + voxel * np.stack([inside.min(axis=0) - 1.5, inside.max(axis=0) + 1.5])

    def signed(x: Array) -> Array:
        return (level - _read(chi, (x - origin) / voxel)) * voxel

    report = {
        "hidden_samples": float(1.0 - keep.mean()),
        "voxel": voxel,
        "smoothing": sigma,
        "level": level,
        "detached_volume": float(1.0 - main.sum() / solid.sum()),
        "void_volume": float((whole & ~main).sum() / len(inside)),
    }
    return _Solid(signed, bounds, float(balls.max()) * voxel, report)


def _no_volume(reason: str) -> AssetError:
    return AssetError(f"splats: the object has no volume ({reason})", hint="Give a closed object, seen from all sides.")


def _validate(
    means: ArrayLike, scales: ArrayLike, quats: ArrayLike, opacities: ArrayLike
) -> tuple[Array, Array, Array, Array]:
    """Return means, scales sorted descending, axes (N, 3, 3) in that order as columns, and opacities."""
    arrays = {"means": (means, 3), "scales": (scales, 3), "quats": (quats, 4), "opacities": (opacities, 0)}
    checked: list[Array] = []
    for name, (value, columns) in arrays.items():
        array = np.asarray(value, dtype=np.float64)
        expected = (len(np.asarray(means)), columns) if columns else (len(np.asarray(means)),)
        if array.shape != expected:
            raise AssetError(f"{name}: expected shape {expected}, got {array.shape}")
        if not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0])
            raise AssetError(f"{name}: not finite at row {bad}", hint="Remove the splats that hold NaN or infinity.")
        checked.append(array)
    mean, scale, quat, opacity = checked
    if len(mean) < 16:
        raise _no_volume(f"{len(mean)} splats")
    if (scale < 0.0).any():
        raise AssetError("scales: expected standard deviations >= 0 (linear, not logarithms)")
    if not (np.linalg.norm(quat, axis=1) > 0.0).all():
        raise AssetError("quats: expected non-zero quaternions")
    order = np.argsort(-scale, axis=1, kind="stable")
    axes = np.take_along_axis(Rotation.from_quat(quat).as_matrix(), order[:, None, :], axis=2)
    return mean, np.take_along_axis(scale, order, axis=1), axes, opacity


def _typical_spacing(x: Array) -> float:
    """Return the median distance to the sixth neighbour, about one and a half spacings on a surface."""
    return float(np.median(KDTree(x).query(x, k=min(7, len(x)))[0][:, -1]))


def _half_opaque(opacity: Array) -> Array:
    """Return at how many standard deviations from its centre a splat is half opaque; 0 for opacities under one half."""
    return np.sqrt(2.0 * np.log(np.maximum(2.0 * opacity, 1.0)))


def _area_of(scale: Array, opacity: Array, link: float) -> Array:
    return opacity * np.maximum(scale[:, 0] * scale[:, 1], 1e-3 * link**2)


def _split_parts(mean: Array, scale: Array, opacity: Array) -> tuple[NDArray[np.intp], float, dict[str, Any]]:
    """Return the linked part of each splat (-1: faint or huge), the linking length, and a report."""
    low, high = np.percentile(mean, [2.0, 98.0], axis=0)
    faint = opacity < OPACITY_FLOOR
    huge = scale[:, 0] > SCALE_LIMIT * float(np.linalg.norm(high - low))
    index = np.flatnonzero(~(faint | huge))
    if len(index) < 16:
        raise _no_volume(f"{len(index)} splats are neither faint nor huge")
    x = mean[index]
    disc = scale[index, 0] * _half_opaque(opacity[index])
    # Sixteen neighbours hold a surface together and keep the graph small.
    neighbours: Any = KDTree(x).query(x, k=16)
    distance, other = neighbours
    local = distance[:, 6]
    link = LINK * float(np.median(local))
    # The cap keeps a sparse cloud of floaters from linking up into a shell of its own.
    reach = np.minimum(LINK * np.minimum(local[:, None], local[other]), 1.5 * link)
    near = distance < np.maximum(reach, np.maximum(disc[:, None], disc[other]))
    row = np.repeat(np.arange(len(x)), near.sum(axis=1))
    graph = sparse.csr_matrix((np.ones(len(row)), (row, other[near])), shape=(len(x), len(x)))
    part = np.full(len(mean), -1, dtype=np.intp)
    found: Any = connected_components(graph, directed=False)
    part[index] = found[1]
    return part, link, {"faint": int(faint.sum()), "huge": int((huge & ~faint).sum())}


def _spread(mean: Array, scale: Array, axes: Array, voxel: float) -> tuple[Array, NDArray[np.intp]]:
    """Cover each splat's disc (one standard deviation) with samples a voxel apart; return them and their splat."""
    steps = np.clip(np.ceil(2.0 * scale[:, :2] / voxel), 1, 9).astype(int)
    position, owner = [], []
    for a, b in np.unique(steps, axis=0):
        member = np.flatnonzero((steps == (a, b)).all(axis=1))
        u, v = ((np.arange(k) + 0.5) * (2.0 / k) - 1.0 for k in (a, b))
        u, v = (g.ravel() for g in np.meshgrid(u, v, indexing="ij"))
        keep = (u * u + v * v) <= 1.0 if a > 2 and b > 2 else np.ones(len(u), dtype=bool)
        du = axes[member, :, 0] * scale[member, 0, None]
        dv = axes[member, :, 1] * scale[member, 1, None]
        grid = mean[member, None] + u[keep, None] * du[:, None] + v[keep, None] * dv[:, None]
        position.append(grid.reshape(-1, 3))
        owner.append(np.repeat(member, int(keep.sum())))
    return np.concatenate(position), np.concatenate(owner)


def _normals(mean: Array, scale: Array, axes: Array) -> Array:
    """Return unit normals (N, 3) without orientation: the thin axis; of round splats, the neighbourhood's."""
    normal = axes[:, :, 2].copy()
    round_ = np.flatnonzero(scale[:, 2] > 0.5 * scale[:, 1] - 1e-300)
    if len(round_):
        near = mean[KDTree(mean).query(mean[round_], k=min(12, len(mean)))[1]]
        near = near - near.mean(axis=1, keepdims=True)
        normal[round_] = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return normal


def _orient(
    sample: Array, normal: Array, owner: NDArray[np.intp], splat_count: int, pixel: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Look at the samples from all sides.

    Returns:
        Sign per splat that turns its normal outside, confidence 0..1 per splat, and whether each sample is seen at all.
    """
    k = np.arange(VIEW_COUNT) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * k / VIEW_COUNT), np.pi * (1.0 + np.sqrt(5.0)) * k
    toward = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    vote, most, views = np.zeros(splat_count), np.zeros(splat_count), np.zeros(len(sample), dtype=int)
    cell = 1.5 * pixel
    for direction in toward:
        helper = np.eye(3)[np.abs(direction).argmin()]
        right = np.cross(direction, helper)
        right /= np.linalg.norm(right)
        flat = np.floor(sample @ np.stack([right, np.cross(direction, right)], axis=1) / cell).astype(np.int64)
        flat -= flat.min(axis=0)
        key = flat[:, 0] * (flat[:, 1].max() + 1) + flat[:, 1]
        depth = -(sample @ direction)
        front = np.full(key.max() + 1, np.inf)
        np.minimum.at(front, key, depth)
        visible = depth <= front[key] + 0.75 * cell
        views += visible
        facing = np.where(visible, normal @ direction, 0.0)
        vote += np.bincount(owner, facing, minlength=splat_count)
        most += np.bincount(owner, np.abs(facing), minlength=splat_count)
    trust = np.abs(vote) / np.maximum(most, 1e-300)
    # Seen almost as much from behind: an open sheet. A wall opposite a hole keeps most of its votes.
    confidence = np.clip((trust - 0.1) / 0.3, 0.0, 1.0)
    return np.where(vote < 0.0, -1.0, 1.0), confidence, views >= 2


def _corners(where: Array) -> list[tuple[NDArray[np.int64], Array]]:
    base = np.floor(where).astype(np.int64)
    part = where - base
    found = []
    for corner in np.ndindex(2, 2, 2):
        found.append((base + corner, np.prod(np.where(corner, part, 1.0 - part), axis=1)))
    return found


def _deposit(where: Array, value: Array, shape: NDArray[np.int64]) -> Array:
    """Spread values at fractional grid positions trilinearly; the sum is kept."""
    grid = np.zeros(int(np.prod(shape)))
    for node, part in _corners(where):
        grid += np.bincount(np.ravel_multi_index(tuple(node.T), tuple(shape)), part * value, minlength=len(grid))
    return grid.reshape(tuple(shape))


def _read(grid: Array, where: Array) -> Array:
    """Interpolate trilinearly; positions outside the grid take the border's value."""
    return ndimage.map_coordinates(grid, where.T, order=1, mode="nearest")


def _solve_poisson(source: Array) -> Array:
    """Solve lap(u) = source on the unit grid with u = 0 outside (seven-point stencil, sine transform)."""
    eigen: Array = np.zeros((1, 1, 1))
    for axis, n in enumerate(source.shape):
        shape = [1, 1, 1]
        shape[axis] = n
        eigen = eigen + (2.0 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1)) - 2.0).reshape(shape)
    spectrum: Any = fft.dstn(source, type=1)
    solution: Any = fft.idstn(spectrum / eigen, type=1)
    return solution
