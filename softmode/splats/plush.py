"""A procedural plush bear: the default soft object, as splats and as a signed distance function."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.splats.splats import SH_DC, Splats, quats_from_rotations

_FUR = np.array([0.80, 0.53, 0.27])
_CREAM = np.array([0.97, 0.88, 0.70])
_DARK = np.array([0.10, 0.07, 0.07])
_SCARF = np.array([0.12, 0.55, 0.60])
_STRIPE = np.array([0.96, 0.78, 0.28])
_CHEEK = np.array([0.93, 0.50, 0.42])

# All shapes below are in units of the bear's height: x to the front, y to its left, z up, standing on z = 0.
_BOX = np.array([[-0.30, -0.37, 0.0], [0.50, 0.37, 1.0]])
_BLEND = 0.045


def plush_bounds(height: float = 0.08) -> NDArray[np.float64]:
    """Return a box that holds the plush [m], shape (2, 3)."""
    return _BOX * _checked_height(height)


def plush_signed_distance(points: ArrayLike, height: float = 0.08) -> NDArray[np.float64]:
    """Return the signed distance to the plush, negative inside [m], shape (N,).

    A smooth union of ellipsoids and capsules cut by the plane it sits on: exact on the surface in sign, a lower
    estimate of the distance elsewhere (gradient length 0.5 to 1.1).

    Args:
        points: Positions in the plush's frame (x front, z up, sitting on z = 0) [m], shape (N, 3).
        height: Height of the plush [m], > 0.
    """
    scale = _checked_height(height)
    return scale * _unit_distance(np.asarray(points, dtype=np.float64) / scale)


@functools.lru_cache(maxsize=4)
def make_plush(count: int = 4000, seed: int = 0, *, height: float = 0.08) -> Splats:
    """Make the plush bear as a closed shell of flat splats.

    It sits on z = 0, looks along +x and is about 0.72 heights wide and 0.78 deep. Splats are spread evenly over the
    surface (Lloyd's relaxation); shading and occlusion are baked into their colours, since splats are not lit.
    Deterministic for a seed.

    Args:
        count: Number of splats, at least 200.
        seed: Seed of the sampling and of the fur.
        height: Height of the plush [m].

    Raises:
        ConfigError: If the count is below 200 or the height is not positive.
    """
    scale = _checked_height(height)
    require_number("count", count, at_least=200)
    rng = np.random.default_rng(seed)
    points, area = _even_surface_points(count, rng)
    normals = _unit_normals(points)
    spacing = np.sqrt(area)[:, None]

    # Fur: every splat leans a little out of the tangent plane, in a random direction.
    leaning = normals + 0.12 * rng.normal(size=normals.shape)
    leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
    helper = np.where(np.abs(leaning[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, leaning)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = rng.uniform(0.0, 2.0 * np.pi, size=(count, 1))
    first = np.cos(angle) * first + np.sin(angle) * np.cross(leaning, first)
    frames = np.stack([first, np.cross(leaning, first), leaning], axis=-1)

    tangent = 0.64 * spacing * rng.uniform(0.9, 1.15, size=(count, 2))
    scales = np.concatenate([tangent, 0.12 * spacing], axis=1)
    color = _paint(points, normals, rng)
    return Splats(
        means=scale * points,
        quats=quats_from_rotations(frames),
        scales=scale * scales,
        opacities=np.full(count, 0.99),
        sh=((color - 0.5) / SH_DC)[:, None],
        name="plush",
    )


def _checked_height(height: float) -> float:
    """Return the height if it is positive and finite."""
    require_number("height", height, above=0.0, unit="m")
    return float(height)


def _ellipsoid(p: NDArray[np.float64], center: ArrayLike, radii: ArrayLike) -> NDArray[np.float64]:
    """Return an estimate of the distance to an ellipsoid, exact to first order at its surface."""
    r = np.asarray(radii)
    local = p - np.asarray(center)
    k0 = np.linalg.norm(local / r, axis=1)
    k1 = np.linalg.norm(local / r**2, axis=1)
    return np.where(k1 > 1e-9, k0 * (k0 - 1.0) / np.maximum(k1, 1e-9), -r.min())


def _capsule(p: NDArray[np.float64], a: ArrayLike, b: ArrayLike, radius: float) -> NDArray[np.float64]:
    """Return the distance to a capsule between a and b."""
    start, axis = np.asarray(a), np.asarray(b) - np.asarray(a)
    t = np.clip((p - start) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(p - start - t[:, None] * axis, axis=1) - radius


def _smooth_min(a: NDArray[np.float64], b: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Return the polynomial smooth minimum; the union of two bodies with a fillet of about `width`."""
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - 0.25 * h * h * width


def _scarf_distance(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance to the scarf: a flattened ring around the neck with one loose end."""
    ring = np.hypot(np.hypot(p[:, 0] - 0.01, p[:, 1]) - 0.205, 1.1 * (p[:, 2] - 0.52)) - 0.055
    end = _ellipsoid(p, (0.235, -0.10, 0.42), (0.035, 0.062, 0.11))
    return _smooth_min(ring, end, 0.02)


def _unit_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the signed distance of the bear of height one."""
    half = np.column_stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]])
    body = _ellipsoid(half, (0.0, 0.0, 0.27), (0.265, 0.29, 0.33))
    head = _ellipsoid(half, (0.02, 0.0, 0.71), (0.225, 0.265, 0.225))
    ears = _ellipsoid(half, (-0.01, 0.195, 0.895), (0.065, 0.105, 0.105))
    snout = _ellipsoid(half, (0.21, 0.0, 0.655), (0.095, 0.115, 0.085))
    arms = _capsule(half, (0.03, 0.245, 0.42), (0.17, 0.262, 0.24), 0.082)
    legs = _capsule(half, (0.10, 0.175, 0.105), (0.345, 0.205, 0.115), 0.115)
    toys = _ellipsoid(half, (0.305, 0.0, 0.69), (0.025, 0.036, 0.026))
    distance = _smooth_min(body, head, _BLEND)
    for part in (ears, snout, arms, legs):
        distance = _smooth_min(distance, part, _BLEND)
    distance = _smooth_min(distance, toys, 0.012)
    distance = _smooth_min(distance, _scarf_distance(points), 0.015)
    # The seat: a rounded cut, so that the bear stands on a flat base.
    return -_smooth_min(-distance, points[:, 2], 0.03)


def _unit_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit outward normals by central differences."""
    step = 1e-4
    offsets = step * np.concatenate([np.eye(3), -np.eye(3)])
    values = _unit_distance((points[:, None] + offsets).reshape(-1, 3)).reshape(-1, 2, 3)
    gradient = (values[:, 0] - values[:, 1]) / (2.0 * step)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)


def _project(points: NDArray[np.float64], iterations: int) -> NDArray[np.float64]:
    """Move points along the gradient onto the surface."""
    for _ in range(iterations):
        points = points - _unit_distance(points)[:, None] * _unit_normals(points)
    return points


def _detail(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the wanted density of splats: the eyes and the nose need finer ones."""
    half = np.abs(points[:, 1])[:, None]
    face = np.concatenate([points[:, :1], half, points[:, 2:]], axis=1)
    eye = np.linalg.norm(face - [0.215, 0.098, 0.755], axis=1) < 0.065
    nose = np.linalg.norm(face - [0.315, 0.0, 0.695], axis=1) < 0.065
    return np.where(eye | nose, 6.0, 1.0)


def _even_surface_points(count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return evenly spread surface points and the surface area of each one's cell (height one).

    Points drawn uniformly in a thin band around the surface have uniform density per area; Lloyd's relaxation of a
    subset spreads it evenly, or by `_detail` where that asks for more.
    """
    band = 0.02
    low, high = _BOX[0] - 2 * band, _BOX[1] + 2 * band
    wanted, found, tries = 12 * count, [], 0
    while sum(map(len, found)) < wanted:
        trial = rng.uniform(low, high, size=(20 * count, 3))
        found.append(trial[np.abs(_unit_distance(trial)) < band])
        tries += len(trial)
    cloud = np.concatenate(found)
    area = len(cloud) / tries * np.prod(high - low) / (2.0 * band)
    cloud = _project(cloud, 3)
    cloud = cloud[np.abs(_unit_distance(cloud)) < 1e-3]
    density = _detail(cloud)
    points = cloud[rng.choice(len(cloud), count, replace=False, p=density / density.sum())]
    size = np.ones(count)
    for _ in range(12):
        nearest = KDTree(points).query(cloud)[1]
        size = np.bincount(nearest, weights=density, minlength=count)
        total = np.stack([np.bincount(nearest, weights=density * x, minlength=count) for x in cloud.T], axis=1)
        points = np.where(size[:, None] > 0.0, total / np.maximum(size, 1.0)[:, None], points)
        points = _project(points, 2)
    points = _project(points, 3)
    cells = np.bincount(KDTree(points).query(cloud)[1], minlength=count) * (area / len(cloud))
    mean = area * np.mean(1.0 / density) * density.sum() / len(density) / count
    return points, np.clip(cells, 0.1 * mean, 2.0 * mean)


def plush_colors(points: ArrayLike, height: float = 0.08) -> NDArray[np.float64]:
    """Return the colours of the plush at points of its surface, without light and fur, 0..1, shape (N, 3).

    Args:
        points: Positions as for :func:`plush_signed_distance` [m], shape (N, 3).
        height: Height of the plush [m], > 0.
    """
    unit = np.asarray(points, dtype=np.float64) / _checked_height(height)
    return _with_face(unit, _pattern(unit))


def _mix(base: NDArray[np.float64], top: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return colours between two, shape (N, 3)."""
    return base + weight * (top - base)


def _blot(points: NDArray[np.float64], center: ArrayLike, radii: ArrayLike, soft: float = 0.15) -> NDArray[np.float64]:
    """Return how far points are inside an ellipsoid or its mirror image, 0..1, shape (N, 1)."""
    half = np.column_stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]])
    inside = 1.0 - np.linalg.norm((half - np.asarray(center)) / np.asarray(radii), axis=1)
    return np.clip(inside / soft, 0.0, 1.0)[:, None]


def _pattern(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours of the parts and seams (height one)."""
    z = points[:, 2]
    color = np.tile(_FUR, (len(points), 1))
    color = _mix(color, _CREAM, _blot(points, (0.27, 0.0, 0.27), (0.16, 0.19, 0.20)))
    color = _mix(color, _CREAM, _blot(points, (0.26, 0.0, 0.645), (0.12, 0.13, 0.098)))
    color = _mix(color, _CREAM, _blot(points, (0.07, 0.205, 0.905), (0.08, 0.07, 0.07)))
    color = _mix(color, _CREAM, _blot(points, (0.47, 0.21, 0.115), (0.06, 0.085, 0.085)))
    color = _mix(color, _CHEEK, 0.55 * _blot(points, (0.20, 0.165, 0.655), (0.07, 0.05, 0.045), 0.6))
    color = _mix(color, color * 0.62, _blot(points, (0.0, 0.0, 0.27), (0.40, 0.012, 0.40), 0.5))
    scarf = _scarf_distance(points) < 0.006
    around = np.arctan2(points[:, 1], points[:, 0] - 0.01)
    stripes = np.where((np.sin(9.0 * around) > 0.35)[:, None], _STRIPE, _SCARF)
    end = (_ellipsoid(points, (0.235, -0.10, 0.42), (0.035, 0.062, 0.11)) < 0.01) & (z < 0.47)
    stripes = np.where(end[:, None], np.where((np.sin(70.0 * z) > 0.2)[:, None], _STRIPE, _SCARF), stripes)
    return np.where(scarf[:, None], stripes, color)


def _with_face(points: NDArray[np.float64], color: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours with eyes and nose."""
    color = _mix(color, _DARK, _blot(points, (0.215, 0.098, 0.755), (0.05, 0.038, 0.042), 0.25))
    return _mix(color, _DARK, _blot(points, (0.315, 0.0, 0.695), (0.05, 0.042, 0.032), 0.25))


def _paint(points: NDArray[np.float64], normals: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the colours: parts, seams, fur noise, and baked light and occlusion."""
    color = _pattern(points)
    color *= 1.0 + 0.05 * rng.normal(size=(len(points), 1)) + 0.015 * rng.normal(size=(len(points), 3))

    key = np.array([0.45, 0.35, 0.82])
    light = 0.72 + 0.22 * normals[:, 2] + 0.16 * np.clip(normals @ (key / np.linalg.norm(key)), 0.0, 1.0)
    reach = 0.06
    occlusion = np.clip(_unit_distance(points + reach * normals) / reach, 0.0, 1.0)
    color = color * (light * (0.62 + 0.38 * occlusion))[:, None]
    return np.clip(_with_face(points, color), 0.02, 0.98)
