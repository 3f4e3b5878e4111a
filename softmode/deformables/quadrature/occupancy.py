"""Interior of a shell: the smooth occupancy field that a cloud of Gaussian splats encloses.

A trained splat is a shell of discs without orientation, with stray splats outside, junk inside, and holes where no
camera looked. `fill_splats` states the rule that turns it into a solid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.deformables.quadrature.indicator import grid_of, solve_indicator
from softmode.deformables.quadrature.shell_views import orient, splat_normals, spread_samples, wall_thickness
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
RESOLUTIONS = (64, 96, 128, 192, 256, 384)
"""Voxels along the longest edge that are tried in turn."""
NODE_LIMIT = 2**24
"""Most nodes of a grid: 1 GB of memory and ten seconds."""
VOXELS_ACROSS = 3.0
"""Voxels across the thinnest walls."""
SHARE_NOISE = 0.005
"""A finer fill that holds fewer splats than the coarser one by more than this is not taken."""
SETTLED = 0.01
"""Relative change of the volume from one resolution to the next below which walls count as resolved."""
POINT_WIDTH = 0.6
"""Width of splats without extent, over the distance to the sixth neighbour: discs so wide let no view through to the
wall behind."""
KEPT_SHARE, KEPT_EXTENT = 0.98, 0.95
"""Share of the object's splats that the solid holds, and of their extent along every axis, below which the resolution
is raised."""


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """The solid that a shell of splats encloses."""

    level: Callable[[Array], Array]
    """Level-set function of points (N, 3), negative inside, trilinear."""
    bounds: Array
    """Corners of a box that holds the solid [m], shape (2, 3)."""
    voxel: float
    """Distance between the nodes of its grid [m]."""
    members: NDArray[np.bool_]
    """Which splats belong to the object: what lies on the solid or in it, and the haze there; shape (N,)."""
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
    resolution: int | None = None,
    outset: ArrayLike = 0.0,
) -> Occupancy:
    """Turn a shell of splats into a level-set function of the solid it encloses.

    1. *Floaters* go: opacity under 0.1, a standard deviation over a quarter of the scene's diagonal, and detached
       parts (linked when closer than twice their distance to the sixth neighbour, or within the half-opaque disc of
       one of them) with less than 1 % of the area.
    2. *The object* is the part whose solid holds the largest ball: a floor slab under the object loses, however wide.
    3. *Samples*: each splat is spread over its disc with one sample per voxel. The surface lies where half of the
       opacity along its normal is passed, which is at the centres: a splat's thickness does not inflate the volume.
       Points without extent get discs that meet: between them views would reach the wall behind and take its back for
       its outside.
    4. *Orientation by views*: 256 orthographic depth buffers tell which splats are seen from where. The normal (the
       splat's thin axis; of round splats, that of the neighbourhood) points to the side seen more. Splats that no view
       sees (inside) or seen equally from both sides (open sheets) are dropped.
    5. *Fill*: `indicator.solve_indicator` finds the indicator of the solid, smoothed over about one sample spacing, and
       the level on which the samples lie. A hole in the shell is closed by a smooth cap.
    6. *The solid* is where the indicator is above that level: the connected part that holds the largest ball, without
       internal voids.
    7. *Resolution*: from 64 voxels along the longest edge it rises until voxels are a third of the thinnest walls, or
       the volume changes by less than 1 %, and the solid holds 98 % of the object's splats and 95 % of their extent
       along every axis; up to 2^24 nodes, and not beyond where it holds fewer splats again.

    Args:
        means: Splat centres [m], shape (N, 3).
        scales: Standard deviations [m], shape (N, 3).
        quats: Orientations, xyzw, shape (N, 4).
        opacities: Opacities 0..1, shape (N,).
        resolution: Voxels along the longest edge; None chooses. Sparse shells get larger voxels.
        outset: Distance [m] added outside every sample, one for all or shape (N,).

    Returns:
        The occupancy.

    Raises:
        AssetError: If the arrays do not match, hold NaN, or enclose no volume.
    """
    mean, scale, axes, opacity = _validate(means, scales, quats, opacities)
    beyond = np.broadcast_to(np.asarray(outset, dtype=np.float64), len(mean))
    part, link, report = _split_parts(mean, scale, opacity)

    def shell(index: NDArray[np.intp]) -> _Shell:
        return _orient_part(mean[index], scale[index], axes[index], beyond[index])

    bulk = np.bincount(part[part >= 0], _area_of(scale, opacity, link)[part >= 0])
    tried = [k for k in np.argsort(-bulk, kind="stable")[:PART_LIMIT] if bulk[k] >= SMALL_PART * bulk.sum()]
    members = [np.flatnonzero(part == k) for k in tried]
    best = 0
    if len(tried) > 1:
        balls = []
        for index in members:
            try:
                balls.append(_fill_shell(shell(index), 32).ball)
            except AssetError:
                balls.append(0.0)
        best = int(np.argmax(balls))
    solid, chosen = _fill_adaptively(shell(members[best]), mean[members[best]], resolution), members[best]

    tree = KDTree(mean[chosen])
    size = np.ptp(mean[chosen], axis=0)
    member, satellite = np.zeros(len(mean), dtype=bool), np.zeros(len(mean), dtype=bool)
    member[chosen[solid.kept]] = True
    # Large splats of a plain face may lie too far apart to be linked: what lies on the solid belongs to it.
    stray = np.flatnonzero((part >= 0) & ~member)
    member[stray[solid.holds(mean[stray])]] = True
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
        "buried_share": 0.0 if beyond.any() else float(solid.buries(mean[part >= 0]).sum() / len(chosen)),
        **solid.report,
    }
    return Occupancy(
        level=solid.level,
        bounds=solid.bounds,
        voxel=solid.voxel,
        members=member,
        satellites=satellite,
        report=report,
    )


@dataclass(frozen=True)
class _Shell:
    """The splats of a part that are seen from outside."""

    mean: Array
    tangent: Array
    normal: Array
    confidence: Array
    outset: Array
    spacing: float
    """What the splats resolve: the lesser of their distance and their width [m]."""
    extent: float
    """Longest edge of the box that holds them [m]."""
    thickness: float
    """Thickness of the thinnest walls [m], infinite if there are none."""
    hidden: float
    """Share of the part's splats that is seen from nowhere or from both sides."""


@dataclass(frozen=True)
class _Solid:
    level: Callable[[Array], Array]
    bounds: Array
    voxel: float
    ball: float
    volume: float
    holds: Callable[[Array], NDArray[np.bool_]]
    """Tells whether points (N, 3) lie in it, or on it to two voxels."""
    buries: Callable[[Array], NDArray[np.bool_]]
    """Tells whether points (N, 3) lie in it, deeper than a voxel."""
    report: dict[str, Any]
    kept: NDArray[np.bool_]
    """Which splats of the part it holds."""


def _orient_part(mean: Array, scale: Array, axes: Array, outset: Array) -> _Shell:
    """Find the outside of one linked part; steps 3 and 4 of `fill_splats`."""
    if len(mean) < 16:
        raise _no_volume(f"{len(mean)} splats")
    extent = float(np.ptp(mean, axis=0).max())
    if not extent > 0.0:
        raise _no_volume("all splats lie at one point")
    spacing = _typical_spacing(mean)
    if not scale.any():
        scale = np.full_like(scale, POINT_WIDTH * spacing)
    width = float(np.median(scale[:, 1]))
    normal, tangent, nearest, scatter = splat_normals(mean, scale, axes)
    pixel = min(max(extent / RESOLUTIONS[1], 0.7 * min(spacing, width)), extent / 12.0)
    sign, confidence, seen = orient(mean, normal, tangent, nearest, pixel)
    keep = seen & (confidence > 0.0)
    if keep.sum() < 16:
        raise _no_volume("no closed shell is seen from outside")
    normal = (normal * sign[:, None])[keep]
    low, high = np.quantile(mean[keep], [0.002, 0.998], axis=0)
    extent = float((high - low).max())
    # What lies within the scatter of the centres is no wall.
    least = min(max(extent / 256.0, 4.0 * scatter), extent / 16.0)
    wall = wall_thickness(mean[keep], normal, least, extent / 8.0)
    return _Shell(
        mean=mean[keep],
        tangent=tangent[keep],
        normal=normal,
        confidence=confidence[keep],
        outset=outset[keep],
        spacing=min(spacing, width),
        extent=extent,
        thickness=float(np.quantile(wall, 0.05, method="nearest")),
        hidden=float(1.0 - keep.mean()),
    )


def _fill_adaptively(shell: _Shell, mean: Array, resolution: int | None) -> _Solid:
    """Fill a shell so finely that thin parts are not lost; step 7 of `fill_splats`, for splats (N, 3) of its part."""
    low, high = np.quantile(mean, [0.005, 0.995], axis=0)
    wide = (high - low) > 0.1 * (high - low).max()
    best, limited = None, False
    for count in RESOLUTIONS if resolution is None else (resolution,):
        voxel, _, margin = _lengths(shell, count)
        limited = best is not None and (
            voxel >= best.voxel or bool(np.prod(grid_of(low, high, margin, voxel), dtype=float) > NODE_LIMIT)
        )
        if limited:
            break
        try:
            found = _fill_shell(shell, count)
        except AssetError:
            continue
        kept = found.holds(mean)
        span = np.minimum(found.bounds[1], high) - np.maximum(found.bounds[0], low)
        share, extent = float(kept.mean()), float((span / (high - low))[wide].min())
        if best is not None and share < best.report["kept_share"] - SHARE_NOISE:
            break  # Finer than the capture is sharp: the solid breaks up.
        settled = best is not None and abs(found.volume / best.volume - 1.0) < SETTLED
        best = replace(found, kept=kept)
        best.report.update(resolution=count, kept_share=share, kept_extent=extent)
        if share >= KEPT_SHARE and extent >= KEPT_EXTENT and (settled or VOXELS_ACROSS * voxel <= shell.thickness):
            break
    if best is None:
        raise _no_volume("the splats enclose nothing")
    best.report["resolution_limited"] = limited
    return best


def _lengths(shell: _Shell, resolution: int) -> tuple[float, float, float]:
    """Return voxel, smoothing and margin [m] at a resolution; sparse splats are not resolved more finely."""
    voxel = min(max(shell.extent / resolution, 0.5 * shell.spacing), shell.extent / 12.0)
    sigma = max(1.2 * voxel, 0.6 * shell.spacing)
    return voxel, sigma, max(8.0 * voxel, 3.0 * sigma, 0.15 * shell.extent)


def _fill_shell(shell: _Shell, resolution: int) -> _Solid:
    """Fill an oriented shell; steps 5 and 6 of `fill_splats`."""
    voxel, _, margin = _lengths(shell, resolution)
    sample, owner = spread_samples(shell.mean + shell.outset[:, None] * shell.normal, shell.tangent, voxel)
    # Samples of one splat are a voxel apart; where splats do not overlap, the gap between them decides how much to
    # smooth.
    sigma = max(1.2 * voxel, 0.6 * _typical_spacing(sample))
    field = solve_indicator(
        sample, shell.normal[owner], shell.confidence[owner], voxel=voxel, sigma=sigma, margin=max(margin, 3.0 * sigma)
    )
    level = field.mean_level
    difference = field.level - field.value
    solid = difference < 0.0
    labelled: Any = ndimage.label(solid)
    label, count = labelled
    if not level > 0.1 or count == 0 or float(field.value.max()) < 1.1 * level:
        raise _no_volume("the splats enclose nothing")
    depth: Any = ndimage.distance_transform_edt(solid)
    largest: Any = ndimage.maximum(depth, label, np.arange(1, count + 1))
    balls = np.asarray(largest, dtype=np.float64)
    main = label == 1 + int(balls.argmax())
    whole: Any = ndimage.binary_fill_holes(main)
    inside = np.argwhere(whole)
    if len(inside) < 64:
        raise _no_volume(f"{len(inside)} voxels are enclosed")
    difference[solid & ~main] = 0.5 * level
    # Samples seen through gaps of the shell raise the level around them to about the indicator: deep inside there is no
    # surface, whatever their noise says.
    cube = ndimage.generate_binary_structure(3, 3)
    core: Any = ndimage.binary_erosion(whole, cube)
    deep: Any = ndimage.binary_erosion(core, cube)
    deep |= whole & ~main
    difference[deep] = np.minimum(difference[deep], -0.5 * level)
    # One and a half voxels around the outermost inner nodes hold the whole zero level of the trilinear field.
    bounds = field.origin + voxel * np.stack([inside.min(axis=0) - 1.5, inside.max(axis=0) + 1.5])
    near: Any = ndimage.binary_dilation(whole, ndimage.generate_binary_structure(3, 2), iterations=2)

    def signed(x: Array) -> Array:
        where = (x - field.origin) / voxel
        return ndimage.map_coordinates(difference, where.T, order=1, mode="nearest", output=np.float64) * voxel

    def lies_in(nodes: NDArray[np.bool_], x: Array) -> NDArray[np.bool_]:
        node = np.rint((x - field.origin) / voxel).astype(np.int64)
        inner = ((node >= 0) & (node < nodes.shape)).all(axis=1)
        found = np.zeros(len(x), dtype=bool)
        found[inner] = nodes[tuple(node[inner].T)]
        return found

    report = {
        "hidden_samples": shell.hidden,
        "voxel": voxel,
        "smoothing": sigma,
        "level": level,
        "detached_volume": float(1.0 - main.sum() / solid.sum()),
        "void_volume": float((whole & ~main).sum() / len(inside)),
    }
    return _Solid(
        signed,
        bounds,
        voxel,
        float(balls.max()) * voxel,
        len(inside) * voxel**3,
        partial(lies_in, near),
        partial(lies_in, core),
        report,
        np.zeros(0, dtype=bool),
    )


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
    few = x[:: max(1, len(x) // 20_000)]
    return float(np.median(KDTree(x).query(few, k=min(7, len(x)))[0][:, -1]))


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
