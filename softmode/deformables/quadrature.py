"""Quadrature: an object as interior points with weights [m^3] and surface samples with areas [m^2].

Every source ends on the same uniform grid over the bounding box (a grid integrates two to four times better than
random points). Each cell carries the volume of the object inside it and sits at the centroid of that part, so linear
functions are integrated as well at the boundary as inside. Meshes are integrated column by column, exactly along z;
implicit functions by sub-sampling with a linear boundary layer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.occupancy import fill_splats
from softmode.deformables.rkpm import sample_farthest
from softmode.errors import AssetError, ConfigError

Array = NDArray[np.float64]
SignedDistance = Callable[[Array], ArrayLike]

SUBDIVISION = 4
"""Each grid cell is integrated by this many sub-cells per axis."""
SMALLEST_CELL = 0.02
"""Boundary cells filled less than this are dropped; their volume is spread by the final scaling."""
_CANDIDATES_PER_SAMPLE = 24


@dataclass(frozen=True, kw_only=True)
class Quadrature:
    """Interior points, their volumes, and the sampled surface of one object, in asset coordinates, float64."""

    points: Array
    """Centroids of the occupied cells [m], shape (P, 3)."""
    weights: Array
    """Volumes [m^3], positive, sum = `volume`, shape (P,)."""
    spacing: float
    """Edge of a grid cell (geometric mean of the three) [m]."""
    surface_points: Array
    """Surface samples [m], near-uniform, shape (S, 3)."""
    surface_normals: Array
    """Outward unit normals, shape (S, 3)."""
    surface_areas: Array
    """Areas [m^2], sum = surface area, shape (S,)."""
    volume: float
    """Volume [m^3]."""
    bounds: Array
    """Lower and upper corner of the bounding box [m], shape (2, 3)."""
    report: dict[str, Any] = field(default_factory=dict)
    """How the numbers came about: source, counts, scaling applied."""
    members: NDArray[np.bool_] | None = None
    """Of splats and points: which inputs belong to the object (the others are floaters or surroundings), shape (N,)."""
    satellites: NDArray[np.bool_] | None = None
    """Of splats: smaller detached parts close to the object; not part of the solid, shape (N,)."""

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        shapes = {
            "points": (self.points, (len(self.weights), 3)),
            "weights": (self.weights, (len(self.points),)),
            "surface_points": (self.surface_points, (len(self.surface_areas), 3)),
            "surface_normals": (self.surface_normals, (len(self.surface_areas), 3)),
            "bounds": (self.bounds, (2, 3)),
        }
        for name, (value, shape) in shapes.items():
            if value.shape != shape:
                raise AssetError(f"{name}: expected shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise AssetError(f"{name}: not all finite")
        if not (len(self.points) >= 4 and (self.weights > 0.0).all() and self.volume > 0.0):
            raise AssetError(
                f"the object has no volume ({len(self.points)} points, {self.volume:.3g} m^3)",
                hint="Give a closed object of positive volume.",
            )


def quadrature_from_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, point_count: int = 4000, surface_count: int = 400, seed: int = 0
) -> Quadrature:
    """Integrate a closed triangle mesh.

    Rays along z through every sub-column give exact chords between crossings (signed, so overlapping parts count
    once); edge tests use one vertex order per edge, so no ray slips between two triangles.

    Args:
        vertices: Vertex positions [m], shape (V, 3).
        faces: Vertex indices of the triangles, counter-clockwise seen from outside, shape (T, 3).
        point_count: Target number of quadrature points; the result is near it.
        surface_count: Number of surface samples.
        seed: Seed of the surface samples.

    Returns:
        The quadrature; weights sum to the mesh volume.

    Raises:
        AssetError: If the mesh is empty, not finite, not closed, not consistently oriented, or of zero or negative
        volume.
    """
    _check_counts(point_count, surface_count)
    vertex, face = _load_mesh(vertices, faces)
    corner = vertex[face]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    twice_area = np.linalg.norm(normal, axis=1)
    area = 0.5 * float(twice_area.sum())
    lower, upper = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    centre = 0.5 * (lower + upper)
    local = corner - centre
    volume = float(np.einsum("ti,ti->", local[:, 0], np.cross(local[:, 1], local[:, 2]))) / 6.0
    if not volume > 1e-9 * float(np.prod(upper - lower)) or not volume > 0.0:
        raise AssetError(
            f"mesh: the enclosed volume is {volume:.3g} m^3, it must be positive",
            hint="Flip the faces (inside out) or close and thicken the mesh.",
        )
    shape = _grid_shape(upper - lower, volume, area, point_count)
    cell, first = _integrate_columns(corner, normal[:, 2], lower, upper, shape)
    points, weights, counted = _assemble_cells(cell, first, lower, upper, shape)
    overlapping = abs(counted / volume - 1.0) > 0.01
    if overlapping:
        volume = counted
    rng = np.random.default_rng(seed)
    candidate_count = _CANDIDATES_PER_SAMPLE * surface_count
    pick = np.searchsorted(
        np.cumsum(twice_area),
        (np.arange(candidate_count) + rng.random(candidate_count)) / candidate_count * twice_area.sum(),
    ).clip(0, len(face) - 1)
    r, t = np.sqrt(rng.random(candidate_count)), rng.random(candidate_count)
    bary = np.stack([1.0 - r, r * (1.0 - t), r * t], axis=1)
    surface = _select_surface(
        np.einsum("nk,nki->ni", bary, corner[pick]), normal[pick] / twice_area[pick, None], area, surface_count, seed
    )
    return _finish(points, weights, counted, volume, (upper - lower) / shape, surface, np.stack([lower, upper]), {
        "source": "mesh", "triangles": len(face), "overlapping": overlapping,
    })  # fmt: skip


def quadrature_from_box(
    size: ArrayLike, *, point_count: int = 4000, surface_count: int = 400, seed: int = 0
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
    radius: float, *, point_count: int = 4000, surface_count: int = 400, seed: int = 0
) -> Quadrature:
    """Integrate a sphere of `radius` [m] centred at the origin; volume and area are the exact ones."""
    return quadrature_from_capsule(radius, 0.0, point_count=point_count, surface_count=surface_count, seed=seed)


def quadrature_from_capsule(
    radius: float, half_height: float, *, point_count: int = 4000, surface_count: int = 400, seed: int = 0
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


def quadrature_from_implicit(
    signed_distance: SignedDistance,
    bounds: ArrayLike,
    *,
    point_count: int = 4000,
    surface_count: int = 400,
    seed: int = 0,
    volume: float | None = None,
    area: float | None = None,
) -> Quadrature:
    """Integrate the inside (negative side) of a level-set function.

    A true distance is not required: values are divided by the length of their gradient near the surface.

    Args:
        signed_distance: Maps points (N, 3) [m] to values (N,), negative inside.
        bounds: Lower and upper corner of a box that holds the object [m], shape (2, 3).
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        seed: Seed of the surface samples.
        volume: Exact volume [m^3] when known; else the sub-sampled one is taken.
        area: Exact surface area [m^2] when known.

    Returns:
        The quadrature.

    Raises:
        AssetError: If nothing lies inside, or values are not finite.
    """
    _check_counts(point_count, surface_count)
    box = np.array(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise AssetError(
            f"bounds: expected finite corners (2, 3) with upper > lower, got {np.asarray(bounds).tolist()}"
        )

    def level(x: Array) -> Array:
        value = np.asarray(signed_distance(x), dtype=np.float64)
        if value.shape != (len(x),) or not np.isfinite(value).all():
            raise AssetError(f"signed_distance: expected {len(x)} finite values, got shape {value.shape}")
        return value

    # A coarse pass fits the box to the object and estimates volume and area for the choice of the grid.
    coarse_shape = np.maximum(np.ceil((box[1] - box[0]) / (box[1] - box[0]).max() * 32.0), 4).astype(int)
    distance, value, nodes, width = _sample_grid(level, box, coarse_shape)
    reach = distance < width.max()
    if not (distance < 0.5 * width.max()).any():
        raise AssetError("signed_distance: nothing lies inside the bounds", hint="Check the sign and the bounds.")
    box = np.stack([
        np.maximum(box[0], nodes[reach].min(axis=0) - 0.5 * width),
        np.minimum(box[1], nodes[reach].max(axis=0) + 0.5 * width),
    ])  # fmt: skip
    rough_volume = max(float(_filled(distance, width).sum() * width.prod()), float(width.prod()))
    rough_area = float((np.abs(distance) < width.max()).sum() * width.prod() / (2.0 * width.max()))
    shape = _grid_shape(box[1] - box[0], volume or rough_volume, area or rough_area, point_count)

    distance, value, nodes, width = _sample_grid(level, box, shape * SUBDIVISION)
    filled = _filled(distance, width) * width.prod()
    parent = np.arange(len(filled)).reshape(tuple(shape * SUBDIVISION))
    parent = np.stack(np.unravel_index(parent, parent.shape), axis=-1).reshape(-1, 3) // SUBDIVISION
    index = np.ravel_multi_index(tuple(parent.T), tuple(shape))
    keep = filled > 0.0
    cell, first = _sum_by(index[keep], filled[keep], nodes[keep], int(shape.prod()))
    points, weights, counted = _assemble_cells(cell, first, box[0], box[1], shape)
    exact_area = area if area is not None else _surface_area(level, distance, value, nodes, width)
    candidates, normals = _project_surface(level, nodes, distance, width, surface_count, seed)
    surface = _select_surface(candidates, normals, exact_area, surface_count, seed)
    extent = np.stack([candidates.min(axis=0), candidates.max(axis=0)])
    return _finish(points, weights, counted, volume or counted, (box[1] - box[0]) / shape, surface, extent, {
        "source": "implicit",
    })  # fmt: skip


def quadrature_from_splats(
    means: ArrayLike,
    scales: ArrayLike,
    quats: ArrayLike,
    opacities: ArrayLike,
    *,
    point_count: int = 4000,
    surface_count: int = 400,
    resolution: int = 64,
    seed: int = 0,
) -> Quadrature:
    """Fill a shell of Gaussian splats and integrate its interior; `occupancy.fill_splats` states the rule.

    Args:
        means: Splat centres [m], shape (N, 3).
        scales: Standard deviations along the splat's axes [m], shape (N, 3).
        quats: Orientations, xyzw, shape (N, 4).
        opacities: Opacities 0..1, shape (N,).
        point_count: Target number of quadrature points.
        surface_count: Number of surface samples.
        resolution: Voxels along the longest edge of the occupancy grid.
        seed: Seed of the surface samples.

    Returns:
        The quadrature; its report says what was removed and filled.

    Raises:
        AssetError: If arrays do not match, hold NaN, or enclose no volume.
    """
    solid = fill_splats(means, scales, quats, opacities, resolution=resolution)
    found = quadrature_from_implicit(
        solid.level, solid.bounds, point_count=point_count, surface_count=surface_count, seed=seed
    )
    report = {**found.report, **solid.report, "source": "splats"}
    return replace(found, report=report, members=solid.members, satellites=solid.satellites)


def quadrature_from_points(
    points: ArrayLike,
    *,
    radius: float = 0.0,
    point_count: int = 4000,
    surface_count: int = 400,
    resolution: int = 64,
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
        resolution: Voxels along the longest edge of the occupancy grid.
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
    solid = fill_splats(x, np.zeros_like(x), quats, np.ones(len(x)), resolution=resolution, outset=radius)
    found = quadrature_from_implicit(
        solid.level, solid.bounds, point_count=point_count, surface_count=surface_count, seed=seed
    )
    return replace(found, report={**found.report, **solid.report, "source": "points"}, members=solid.members)


def _check_counts(point_count: int, surface_count: int) -> None:
    if point_count < 32:
        raise ConfigError(f"point_count: expected at least 32, got {point_count}")
    if surface_count < 8:
        raise ConfigError(f"surface_count: expected at least 8, got {surface_count}")


def _load_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    """Merge duplicate vertices and check that the mesh is a closed, oriented surface."""
    import trimesh

    vertex = np.asarray(vertices, dtype=np.float64)
    face = np.asarray(faces)
    if vertex.ndim != 2 or vertex.shape[1] != 3 or not np.isfinite(vertex).all():
        raise AssetError(f"vertices: expected finite positions of shape (V, 3), got shape {vertex.shape}")
    if face.ndim != 2 or face.shape[1] != 3 or len(face) < 4 or not np.issubdtype(face.dtype, np.integer):
        raise AssetError(f"faces: expected at least 4 integer triangles of shape (T, 3), got {face.shape} {face.dtype}")
    if face.min() < 0 or face.max() >= len(vertex):
        raise AssetError(f"faces: indices must lie in 0..{len(vertex) - 1}, got {face.min()}..{face.max()}")
    mesh = trimesh.Trimesh(vertex, face, process=True)
    if not mesh.is_watertight:
        raise AssetError(
            f"mesh: not watertight ({len(face)} triangles), so its interior is not defined",
            hint="Close its holes, for instance with trimesh.repair.fill_holes.",
        )
    if not mesh.is_winding_consistent:
        raise AssetError(
            "mesh: neighbouring triangles are oriented differently", hint="Mend it with trimesh.repair.fix_normals."
        )
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _grid_shape(extent: Array, volume: float, area: float, point_count: int) -> NDArray[np.int64]:
    """Choose cells per axis so that interior plus boundary cells, V / h^3 + 0.7 A / h^2, meet the target."""
    inverse = (point_count / volume) ** (1.0 / 3.0)
    for _ in range(20):  # Newton on x -> V x^3 + 0.7 A x^2; half of the boundary's cells lie outside the volume count.
        value = volume * inverse**3 + 0.35 * area * inverse**2 - point_count
        inverse -= value / (3.0 * volume * inverse**2 + 0.7 * area * inverse)
    return np.maximum(np.round(extent * inverse), 2).astype(np.int64)


def _integrate_columns(
    corner: Array, normal_z: Array, lower: Array, upper: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return volume (cells,) and first moment (cells, 3) of a closed mesh in every grid cell."""
    fine = shape[:2] * SUBDIVISION
    width = (upper - lower)[:2] / fine
    # Columns stand at sub-cell centres. Triangle-column pairs from each triangle's bounding box, then three edge tests.
    flat = (corner[:, :, :2] - lower[:2]) / width - 0.5
    begin = np.clip(np.ceil(flat.min(axis=1)), 0, fine).astype(np.int64)
    end = np.clip(np.floor(flat.max(axis=1)) + 1, 0, fine).astype(np.int64)
    span = np.maximum(end - begin, 0)
    count = span[:, 0] * span[:, 1]
    triangle = np.repeat(np.arange(len(corner)), count)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    column = begin[triangle] + np.stack([within // span[triangle, 1], within % span[triangle, 1]], axis=1)
    inside = np.ones(len(triangle), dtype=bool)
    bary = np.empty((len(triangle), 3))
    for k in range(3):
        a, b = flat[triangle, (k + 1) % 3], flat[triangle, (k + 2) % 3]
        swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
        a, b = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
        side = (b[:, 0] - a[:, 0]) * (column[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (column[:, 0] - a[:, 0])
        # A column exactly on an edge belongs to its left side, whichever triangle asks.
        left = np.where(side >= 0.0, 1.0, -1.0) * np.where(swap, -1.0, 1.0)
        inside &= left * normal_z[triangle] > 0.0
        bary[:, k] = np.where(swap, -side, side)
    triangle, column, bary = triangle[inside], column[inside], bary[inside]
    height = np.einsum("pk,pk->p", bary / bary.sum(axis=1, keepdims=True), corner[triangle, :, 2])
    key = column[:, 0] * fine[1] + column[:, 1]
    order = np.lexsort((height, key))
    key, height, column = key[order], height[order], column[order]
    # Going up, a downward facing triangle enters the object. Columns balance, so one running sum serves all.
    winding = np.cumsum(np.where(normal_z[triangle[order]] < 0.0, 1, -1))
    open_ = np.flatnonzero((winding[:-1] > 0) & (key[:-1] == key[1:]))
    bottom, top, column = height[open_], height[open_ + 1], column[open_]

    # Cut each chord at the cell borders.
    step = (upper[2] - lower[2]) / shape[2]
    k0 = np.clip(np.floor((bottom - lower[2]) / step), 0, shape[2] - 1).astype(np.int64)
    k1 = np.clip(np.floor((top - lower[2]) / step), 0, shape[2] - 1).astype(np.int64)
    count = k1 - k0 + 1
    chord = np.repeat(np.arange(len(bottom)), count)
    k = np.arange(len(chord)) - np.repeat(np.cumsum(count) - count, count) + k0[chord]
    low = np.maximum(bottom[chord], lower[2] + k * step)
    high = np.minimum(top[chord], lower[2] + (k + 1) * step)
    volume = np.maximum(high - low, 0.0) * width.prod()
    fine_xy = column[chord]
    index = np.ravel_multi_index((fine_xy[:, 0] // SUBDIVISION, fine_xy[:, 1] // SUBDIVISION, k), tuple(shape))
    position = np.column_stack([lower[:2] + (fine_xy + 0.5) * width, 0.5 * (low + high)])
    return _sum_by(index, volume, position, int(shape.prod()))


def _sum_by(index: ArrayLike, weight: Array, position: Array, count: int) -> tuple[Array, Array]:
    """Return per group the sum of weights (count,) and of weighted positions (count, D)."""
    index = np.asarray(index)
    total = np.bincount(index, weight, minlength=count).astype(np.float64)
    first = [np.bincount(index, weight * column, minlength=count).astype(np.float64) for column in position.T]
    return total, np.stack(first, axis=1)


def _assemble_cells(
    cell: Array, first: Array, lower: Array, upper: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array, float]:
    """Drop near-empty cells; return centroids, volumes, and the volume counted before the drop."""
    keep = cell > SMALLEST_CELL * float(((upper - lower) / shape).prod())
    return first[keep] / cell[keep, None], cell[keep], float(cell.sum())


def _finish(
    points: Array,
    weights: Array,
    counted: float,
    volume: float,
    cell: Array,
    surface: tuple[Array, Array, Array],
    bounds: Array,
    report: dict[str, Any],
) -> Quadrature:
    """Scale the weights to the volume and pack the result."""
    if not len(points) or not volume > 0.0:
        raise AssetError("the object has no volume", hint="Give a closed object of positive volume.")
    return Quadrature(
        points=points,
        weights=weights * (volume / weights.sum()),
        spacing=float(cell.prod() ** (1.0 / 3.0)),
        surface_points=surface[0],
        surface_normals=surface[1],
        surface_areas=surface[2],
        volume=float(volume),
        bounds=bounds,
        report={
            **report,
            "points": len(points),
            "counted_volume": counted,
            "weight_scaling": float(volume / weights.sum()),
            "box_fill": float(volume / np.prod(bounds[1] - bounds[0])),
        },
    )


def _sample_grid(
    level: Callable[[Array], Array], box: Array, shape: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Return first-order distances (cells,), level values (cells,), cell centres (cells, 3) and cell edges (3,)."""
    width = (box[1] - box[0]) / shape
    axes = [box[0, d] + (np.arange(shape[d]) + 0.5) * width[d] for d in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    value = level(nodes).reshape(tuple(shape))
    slope = np.sqrt(sum(g * g for g in np.gradient(value, *width)))
    distance = (value / np.maximum(slope, 1e-3 * slope.max() + 1e-300)).ravel()
    return distance, value.ravel(), nodes, width


def _gradient(level: Callable[[Array], Array], points: Array, step: float) -> Array:
    """Return central differences of the level function (N, 3)."""
    shifted = (points[:, None] + np.concatenate([np.eye(3), -np.eye(3)]) * step).reshape(-1, 3)
    value = level(shifted).reshape(-1, 2, 3)
    return (value[:, 0] - value[:, 1]) / (2.0 * step)


def _surface_area(level: Callable[[Array], Array], distance: Array, value: Array, nodes: Array, width: Array) -> float:
    """Return the area [m^2] by the co-area formula, int delta(f) |grad f| dX, with a hat for delta."""
    near = np.flatnonzero(np.abs(distance) < 3.0 * width.max())
    slope = np.linalg.norm(_gradient(level, nodes[near], 0.25 * float(width.min())), axis=1)
    reach = 1.5 * float(width.max() * np.median(slope[np.abs(distance[near]) < 0.5 * width.max()]))
    hat = np.maximum(1.0 - np.abs(value[near]) / reach, 0.0) / reach
    return float((hat * slope).sum() * width.prod())


def _filled(distance: Array, width: Array) -> Array:
    """Return the filled fraction of cells at first-order distances from a plane."""
    return np.clip(0.5 - distance / width.prod() ** (1.0 / 3.0), 0.0, 1.0)


def _project_surface(
    level: Callable[[Array], Array], nodes: Array, distance: Array, width: Array, surface_count: int, seed: int
) -> tuple[Array, Array]:
    """Draw points in a thin layer around the zero level, which makes their density uniform, and project them on it."""
    rng = np.random.default_rng(seed)
    layer = 0.5 * float(width.max())
    near = np.flatnonzero(np.abs(distance) < layer + 0.5 * float(np.linalg.norm(width)))
    wanted = 3 * _CANDIDATES_PER_SAMPLE * surface_count
    pick = near[rng.permutation(len(near) * max(1, -(-wanted // max(len(near), 1))))[:wanted] % len(near)]
    x = nodes[pick] + (rng.random((len(pick), 3)) - 0.5) * width
    step = 0.25 * float(width.min())

    value, slope = level(x), _gradient(level, x, step)
    length = np.linalg.norm(slope, axis=1)
    keep = np.abs(value) < layer * length
    x, value, slope = x[keep], value[keep], slope[keep]
    for _ in range(3):
        x = x - slope * (value / np.maximum((slope * slope).sum(axis=1), 1e-300))[:, None]
        value, slope = level(x), _gradient(level, x, step)
    length = np.linalg.norm(slope, axis=1)
    keep = (length > 0.0) & (np.abs(value) < 0.05 * layer * np.maximum(length, np.median(length)))
    if keep.sum() < surface_count:
        raise AssetError("signed_distance: the zero level cannot be sampled", hint="Use a continuous function.")
    return x[keep], slope[keep] / length[keep, None]


def _select_surface(
    candidates: Array, normals: Array, area: float, count: int, seed: int
) -> tuple[Array, Array, Array]:
    """Choose near-uniform samples among uniform candidates, and give each the area of its cell.

    Farthest points in position and (weakly) normal, so that both sides of a thin sheet are sampled, then two Lloyd
    steps.
    """
    pitch = 0.35 * np.sqrt(area / count)
    space = np.concatenate([candidates, pitch * normals], axis=1)
    chosen = sample_farthest(space, count, seed=seed)
    tree = KDTree(space)
    for _ in range(2):
        size, total = _sum_by(KDTree(space[chosen]).query(space)[1], np.ones(len(space)), space, len(chosen))
        chosen = np.unique(tree.query(total[size > 0] / size[size > 0, None])[1])
    size = np.bincount(KDTree(space[chosen]).query(space)[1], minlength=len(chosen))
    return candidates[chosen], normals[chosen], np.asarray(size * (area / len(candidates)), dtype=np.float64)
