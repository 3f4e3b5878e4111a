"""Quadrature of a density, such as a radiance field's: on the grid with partial cells, or in adaptive Poisson disks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.optimize import brentq
from scipy.spatial import KDTree

from softmode.checks import require_choice, require_number
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.errors import AssetError

Array = NDArray[np.float64]
Density = Callable[[Array], ArrayLike]
Sampling = Literal["grid", "poisson"]

ALPHA = 1.0e-3
"""Keeps disks finite where occupancy is flat; as in PIE-NeRF."""
KAPPA = 0.5
"""Disk over spacing where occupancy rises by one over it. The paper has no value; above sqrt(ALPHA) flat parts keep the
full spacing, and 0.5 doubles the linear density of points at a sharp surface."""
FAINT = 1.0e-2
"""Occupancy below which there is nothing."""
LEVELS = (0.5, 0.4, 0.3, 0.2, 0.1, 0.05)
"""Levels of a solid's surface, as shares of the 95th percentile of the occupancy. The first counts where there are
walls."""
FOGGY = 1.0
"""Voxels by which half the level moves the surface out from which on a density is fog, however thin its walls."""
DOUBTED, ALLOWED = 0.03, 1.35
"""Share of a surface in a patch that pictures contradict, and volume with the thick parts that they allow beside it
over its own, from which on a trained solid is doubtful. Patches are at most 0.018 on true surfaces and 0.06 to 0.10
where a cup is full. A true bear, doughnut or glove is allowed 1.03 to 1.16 times its volume, a mug 2.7 times."""
LID = 0.8
"""Share of the full occupancy that walls around a void have, two voxels thick; what closes it with less may be none."""
DEPTH, REACH, STEP = 0.5, 3.0, 0.25
"""Optical depth at a surface, as a density of distances (VolSDF) has it at 0 whatever its width; how far from a voxel
light is followed and in what steps [voxels]."""
PACKING = 2.7
"""Sum of the balls 4/3 pi r^3 of equal disks over the volume that they fill."""
DARTS, ROUNDS = 8, 12
"""Darts per wanted disk in a round, and rounds; the last one finds a place for one disk in a hundred."""


def is_doubtful(contradicted: float, allowed: float) -> bool:
    """Return whether a trained solid is doubtful, by what its pictures contradict and allow (`RadianceGrid`)."""
    return contradicted > DOUBTED or allowed > ALLOWED


def quadrature_from_density(
    sigma: Density,
    bounds: ArrayLike,
    *,
    sampling: Sampling = "grid",
    radius: float | None = None,
    resolution: int = 64,
    fill_voids: bool = True,
    point_count: int = 4000,
    surface_count: int = SURFACE_COUNT,
    seed: int = 0,
) -> Quadrature:
    """Integrate the solid that a density shows.

    Densities have no common scale, so they become occupancies first, s = 1 - exp(-sigma r): the share of light that is
    lost over a length r. The solid is about where s, averaged over a voxel, is above half of its 95th percentile s1:
    the largest connected part of that, without enclosed voids, which captures have because only surfaces are seen. Its
    surface is where light along the normal has lost an optical depth of `DEPTH`: where pictures see it, however large
    the density is. A voxel at the surface counts in part.

    Fields that were trained on pictures may be fog: nowhere opaque, so that half of s1 cuts through their inside. Their
    solid is then where s is above the highest of `LEVELS` of which half moves the surface by less than `FOGGY` voxels:
    fog ends where its object does, as silhouettes are sharp. Cavities that are full of fog are full.

    Args:
        sigma: Maps points (N, 3) [m] to densities (N,) [1/m], zero or more.
        bounds: Corners of a box that holds the object [m], shape (2, 3).
        sampling: "grid" has points in cells, partial ones at the surface. "poisson" has one point per disk of radius
            min(r, KAPPA r / sqrt(r |grad s| + ALPHA)) (Feng et al. 2024, equation 3, made dimensionless), where
            r is chosen for `point_count`, with volumes as r^3, scaled to the solid's: the balls alone, equation 4, sum
            to 1.6 to 2.3 times the volume. For comparison; the grid integrates better.
        radius: Length r over which occupancy is counted [m]; None takes two voxels.
        resolution: Voxels along the longest edge of the box, in which the density is sampled, 8 times each, at the
            surface 27 times.
        fill_voids: Whether voids that the solid encloses belong to it.
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        seed: Seed of the places where the density is sampled, of surface samples and disks.

    Returns:
        The quadrature. Its report says which share of the matter was detached and left out, and which was filled; as
        `fog`, by how many voxels half the first level moves the surface, and as `level_share` which level was taken; as
        `open_share`, how much of its volume was filled that only something thin or faint closes.

    Raises:
        AssetError: If the density is not finite, negative, zero or the same everywhere, or encloses no volume.
        ConfigError: If an option is out of range.
    """
    require_choice("sampling", sampling, get_args(Sampling))
    require_number("resolution", resolution, at_least=8, at_most=512)
    if radius is not None:
        require_number("radius", radius, above=0.0, unit="m")
    box = np.array(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise AssetError(f"bounds: expected finite corners (2, 3) with upper > lower, got {np.asarray(bounds)}")
    voxel = float((box[1] - box[0]).max()) / resolution
    # One voxel of nothing around the box closes solids that touch it.
    shape = np.ceil((box[1] - box[0]) / voxel - 1.0e-9).astype(int) + 2
    origin = box.mean(axis=0) - 0.5 * voxel * (shape - 1)
    axes = [origin[d] + voxel * np.arange(shape[d]) for d in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sampler = _Sampler(sigma, box, voxel, 2.0 * voxel if radius is None else radius, seed)
    solid, level, void, report = _solid(_occupancy(sampler, nodes), fill_voids)
    if report["level_share"] == LEVELS[0]:
        _cut(sampler, nodes, solid, level, void)

    def interpolated(field: Array, x: Array) -> Array:
        where = ((x - origin) / voxel).T
        return ndimage.map_coordinates(field, where, order=1, mode="nearest", output=np.float64)

    found = quadrature_from_implicit(
        lambda x: (level - interpolated(solid, x)) * voxel / level,
        np.stack([origin, origin + voxel * (shape - 1)]),
        point_count=point_count,
        surface_count=surface_count,
        seed=seed,
        volume=float(np.minimum(solid / (2.0 * level), 1.0).sum() * voxel**3),
        detail=voxel,
    )
    report = {**found.report, **report, "source": "density", "voxel": voxel}
    if sampling == "grid":
        return replace(found, report=report)
    slopes: Any = np.gradient(solid, voxel)
    slope = np.linalg.norm(slopes, axis=0)
    points, radii = _poisson_disks(
        lambda x: (interpolated(solid, x), interpolated(slope, x)),
        *(level, origin, voxel, np.argwhere(ndimage.maximum_filter(solid, 2) >= level)),
        *(found.volume, point_count, seed),
    )
    balls = 4.0 / 3.0 * np.pi * radii**3
    return replace(
        found,
        points=points,
        weights=balls * (found.volume / balls.sum()),
        spacing=float((found.volume / len(points)) ** (1.0 / 3.0)),
        report={**report, "points": len(points), "ball_volume": float(balls.sum() / found.volume)},
        cells=None,
    )


class _Sampler:
    """Averages the occupancy over voxels at jittered places, and refuses what is no density.

    Args:
        sigma: The density.
        box: Corners of the box outside which there is nothing [m], shape (2, 3).
        voxel: Edge of a voxel [m].
        radius: Length over which occupancy is counted [m].
        seed: Seed of the places.
    """

    def __init__(self, sigma: Density, box: Array, voxel: float, radius: float, seed: int) -> None:
        """Remember the arguments."""
        self._sigma, self._box, self.voxel, self.radius = sigma, box, voxel, radius
        self._rng = np.random.default_rng(seed)
        self.least, self.most = np.inf, 0.0

    def average(self, nodes: Array, cuts: int) -> Array:
        """Return the occupancy of the voxels around nodes (N, 3), one place in each of their `cuts`^3 parts."""
        return np.mean([-np.expm1(-value * self.radius) for value in self.within(nodes, cuts)], axis=0)

    def within(self, nodes: Array, cuts: int) -> Iterator[Array]:
        """Yield the density at one place in each of the `cuts`^3 parts of the voxels around nodes (N, 3)."""
        for part in np.ndindex(cuts, cuts, cuts):
            yield self.at(nodes + self.voxel * ((np.array(part) + self._rng.random(nodes.shape)) / cuts - 0.5))

    def at(self, place: Array) -> Array:
        """Return the density at places (N, 3), none outside the box."""
        inside, found = ((place >= self._box[0]) & (place <= self._box[1])).all(axis=1), np.zeros(len(place))
        value = np.asarray(self._sigma(place[inside]), dtype=np.float64)
        if value.shape != (int(inside.sum()),) or not np.isfinite(value).all():
            raise AssetError(f"sigma: expected {int(inside.sum())} finite densities, got shape {value.shape}")
        if len(value):
            self.least, self.most = min(self.least, float(value.min())), max(self.most, float(value.max()))
        if self.least < 0.0:
            raise AssetError(f"sigma: negative, {self.least:.3g}", hint="clip it at zero, as renderers do")
        found[inside] = value
        return found


def _occupancy(sampler: _Sampler, nodes: Array) -> Array:
    """Return the occupancy averaged over the voxel around every node, shape of nodes less the last axis."""
    found = sampler.average(nodes.reshape(-1, 3), 2).reshape(nodes.shape[:-1])
    if not found.max() > FAINT:
        hint = "check bounds, unit and radius"
        raise AssetError(f"sigma: the field is empty, its largest density {sampler.most:.3g} 1/m", hint=hint)
    if sampler.least == sampler.most:
        hint = "give a field with empty space"
        raise AssetError(f"sigma: {sampler.most:.3g} 1/m everywhere, there is no object", hint=hint)
    # Voxels that are full or empty with their neighbours are known; those at the surface are sampled more finely.
    steep = ndimage.maximum_filter(found, 3) - ndimage.minimum_filter(found, 3) > 0.25 * found.max()
    found[steep] = sampler.average(nodes[steep], 3)
    return found


def _solid(occupancy: Array, fill_voids: bool) -> tuple[Array, float, NDArray[np.bool_], dict[str, float]]:
    """Return the occupancy of the largest part, its surface's level, where it was filled, and shares of what was."""
    full = float(np.quantile(occupancy[occupancy > FAINT], 0.95))

    @functools.cache
    def found(share: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_], float]:
        """Return the largest part above a share of the full occupancy, what it encloses too, and its share of all."""
        parts: Any = ndimage.label(occupancy > share * full)
        labelled, count = parts
        mass: Any = ndimage.sum_labels(occupancy, labelled, np.arange(1, count + 1))
        main = labelled == 1 + int(mass.argmax())
        whole: Any = ndimage.binary_fill_holes(main) if fill_voids else main
        return main, whole, float(mass.max() / mass.sum())

    def grows(share: float) -> float:
        """Return by how many voxels half a level moves the surface out."""
        wide, whole = found(0.5 * share)[1], found(share)[1]
        core: Any = ndimage.binary_erosion(whole)
        return float((wide & ~whole).sum() / (whole & ~core).sum())

    fog = grows(LEVELS[0])
    share = LEVELS[0] if fog < FOGGY else next((s for s in LEVELS[1:] if grows(s) < FOGGY), LEVELS[-1])
    main, whole, largest = found(share)
    level = share * full
    void = whole & ~main
    shut: Any = ndimage.binary_fill_holes(main & (occupancy > LID * full))
    near: Any = ndimage.binary_dilation(whole, np.ones((3, 3, 3)))
    solid = np.where(near & ~((occupancy > level) & ~main), occupancy, 0.0)
    # What borders on a void but not on the outside is full, and so is fog.
    beside: Any = ndimage.binary_dilation(void) if share == LEVELS[0] else whole
    solid[void | (beside & ndimage.binary_erosion(whole))] = 2.0 * level
    return solid, level, void, {
        "level": level,
        "level_share": share,
        "fog": fog,
        "detached_share": 1.0 - largest,
        "filled_share": float(void.sum() / whole.sum()),
        "open_share": float((void & ~shut).sum() / whole.sum()),
    }  # fmt: skip


def _cut(sampler: _Sampler, nodes: Array, solid: Array, level: float, void: NDArray[np.bool_]) -> None:
    """Move the surface of a solid to where light that comes along its normal has lost an optical depth of `DEPTH`.

    The density there, or half of the largest beyond if that is less, is the level of a voxel's surface. Beside a filled
    void, whose density is none, all counts that lies behind that place.
    """
    full, cube = solid > level, np.ones((3, 3, 3))
    core: Any = ndimage.binary_erosion(full, cube, 2)
    band: Any = ndimage.binary_dilation(full, cube, 2) & ~core
    slopes: Any = np.gradient(ndimage.gaussian_filter(np.minimum(solid, 2.0 * level), 1.0))
    out = -np.stack([slope[band] for slope in slopes], axis=1)
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    before, reached, surface, most = (np.zeros(len(out)) for _ in range(4))
    place = np.full(len(out), -REACH)
    for t in np.arange(REACH, -REACH, -STEP):
        here = sampler.at(nodes[band] + sampler.voxel * t * out)
        depth = reached + 0.5 * STEP * sampler.voxel * (before + here)
        # Between two places the density is linear, and the depth a parabola.
        squared = before**2 + 2.0 * (here - before) * (DEPTH - reached) / (STEP * sampler.voxel)
        crossed = np.sqrt(np.maximum(squared, 0.0))
        there = (reached < DEPTH) & (depth >= DEPTH)
        surface = np.where(there, crossed, surface)
        place = np.where(there, t + STEP * (depth - DEPTH) / np.maximum(depth - reached, 1e-12), place)
        before, reached, most = here, depth, np.maximum(most, here)
    surface = np.where(reached < DEPTH, most, np.minimum(surface, 0.5 * most))
    share = np.mean([value > surface for value in sampler.within(nodes[band], 3)], axis=0)
    near: Any = ndimage.binary_dilation(void, cube)
    share = np.where(near[band], np.maximum(share, np.clip(place + 0.5, 0.0, 1.0)), share)
    solid[band] = 2.0 * level * np.where(void[band], 1.0, share)


def disk_radii(slope: Array, spacing: float) -> Array:
    """Return min(r, KAPPA r / sqrt(r |grad s| + ALPHA)) for slopes of the occupancy [1/m], shape (N,)."""
    return spacing * np.minimum(1.0, KAPPA / np.sqrt(spacing * slope + ALPHA))


def _poisson_disks(
    field: Callable[[Array], tuple[Array, Array]],
    level: float,
    origin: Array,
    voxel: float,
    cells: NDArray[np.int64],
    volume: float,
    point_count: int,
    seed: int,
) -> tuple[Array, Array]:
    """Return points (P, 3), of which none lies in the disk of another, and their radii (P,).

    Darts are thrown in proportion to 1 / r^3 and taken in their order wherever no earlier one is near: what Bridson's
    algorithm makes, whose annulus only finds places faster. SciPy's `PoissonDisk` has one radius for all.
    """
    rng = np.random.default_rng(seed)
    probe = origin + voxel * (cells + rng.random(cells.shape) - 0.5)
    inside, slope = field(probe)
    slope = slope[inside >= level]
    each = volume / len(slope)

    def excess(spacing: float) -> float:
        return float(
            np.log(PACKING / (4.0 / 3.0 * np.pi) * (each / disk_radii(slope, spacing) ** 3).sum() / point_count)
        )

    guess = (PACKING * volume / (4.0 / 3.0 * np.pi * point_count)) ** (1.0 / 3.0)
    spacing = float(brentq(excess, 0.5 * guess, 50.0 * guess))  # type: ignore[arg-type]
    radius = disk_radii(field(origin + voxel * cells)[1], spacing)
    share = radius**-3.0 / (radius**-3.0).sum()
    points, radii = np.zeros((0, 3)), np.zeros(0)
    for _ in range(ROUNDS):
        pick = rng.choice(len(cells), size=DARTS * point_count, p=share)
        darts = origin + voxel * (cells[pick] + rng.random((len(pick), 3)) - 0.5)
        inside, slope = field(darts)
        darts, own = darts[inside >= level], disk_radii(slope[inside >= level], spacing)
        tree, reach = KDTree(darts), float(radius.max())
        if len(points):
            near = tree.sparse_distance_matrix(KDTree(points), reach, output_type="ndarray")
            barred = near["i"][near["v"] < np.maximum(own[near["i"]], radii[near["j"]])]
            kept = np.ones(len(darts), dtype=bool)
            kept[barred] = False
            darts, own = darts[kept], own[kept]
            tree = KDTree(darts)
        free = _first_come(tree.query_pairs(reach, output_type="ndarray"), darts, own)
        points, radii = np.concatenate([points, darts[free]]), np.concatenate([radii, own[free]])
    if len(points) < 8:
        raise AssetError(f"sigma: {len(points)} disks fit into the solid", hint="raise point_count")
    return points, radii


def _first_come(pairs: NDArray[np.int64], darts: Array, radii: Array) -> NDArray[np.bool_]:
    """Return which darts have no earlier taken one in their disk, nor lie in its disk; pairs (M, 2) as i < j."""
    apart = np.linalg.norm(darts[pairs[:, 0]] - darts[pairs[:, 1]], axis=1)
    pairs = pairs[apart < np.maximum(radii[pairs[:, 0]], radii[pairs[:, 1]])]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    first = np.searchsorted(pairs[:, 0], np.arange(len(darts) + 1))
    free = np.ones(len(darts), dtype=bool)
    for k in range(len(darts)):
        if free[k]:
            free[pairs[first[k] : first[k + 1], 1]] = False
    return free
