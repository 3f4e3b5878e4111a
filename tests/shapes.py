"""Objects of very different form, as meshes, level-set functions, splats and point clouds; none is loaded from a file.

Every shape has its longest edge near one metre. `SHAPES` maps names to shapes; `bunny` and `bear` come from the assets
that newton installs and are present only with the extra `[usd]`.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.deformables.quadrature.quadrature import quadrature_from_points, quadrature_from_splats
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.splats import Splats

Array = NDArray[np.float64]
Mesh = tuple[Array, NDArray[np.int64]]
Source = Literal["mesh", "implicit", "splats", "points"]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One object and the trial it suits."""

    name: str
    """Key in `SHAPES`."""
    source: Source
    """What the quadrature is made from."""
    geometry: Callable[[], Any]
    """Gives a mesh (vertices, faces), or a level-set function with its bounds."""
    axis: int = 2
    """The lowest tenth along this axis is held, the highest tenth pulled."""
    connected: bool = True
    """Whether the object is in one piece."""
    overlapping: bool = False
    """Whether parts of the mesh intersect, so that its signed volume counts them twice."""
    smooth: bool = True
    """Whether a grid of quadrature points resolves its walls at the default count."""

    def quadrature(self, point_count: int = 4000, surface_count: int = 400) -> Quadrature:
        """Integrate the object from its source."""
        counts = {"point_count": point_count, "surface_count": surface_count}
        if self.source == "implicit":
            level, bounds = self.geometry()
            return quadrature_from_implicit(level, bounds, **counts)
        vertices, faces = self.geometry()
        if self.source == "mesh":
            return quadrature_from_mesh(vertices, faces, **counts)
        if self.source == "points":
            return quadrature_from_points(sample_surface(vertices, faces, 20_000)[0], **counts)
        splats = cover_with_splats(vertices, faces, 12_000)
        return quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities, **counts)

    def moments(self) -> tuple[float, Array, Array]:
        """Return volume [m^3], centroid [m] (3,) and central second moments [m^5] (3, 3), independently of softmode.

        Meshes by the divergence theorem; level sets and overlapping meshes by counting points of a fine grid, which is
        good to some 1e-4.
        """
        if self.source == "implicit" or self.overlapping:
            return _count_moments(self.name)
        vertices, faces = self.geometry()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        properties = mesh.mass_properties
        inertia = np.asarray(properties["inertia"])
        second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        return float(properties["volume"]), np.asarray(properties["center_mass"]), second


@functools.cache
def _count_moments(name: str) -> tuple[float, Array, Array]:
    """Count random points, one per cell of 200 along the longest edge, inside a level set or a union of parts."""
    shape = SHAPES[name]
    level, bounds = shape.geometry() if shape.source == "implicit" else (_UNIONS[name], None)
    if bounds is None:
        vertices = shape.geometry()[0]
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    lower, upper = np.asarray(bounds, dtype=np.float64)
    count = np.ceil((upper - lower) / (upper - lower).max() * 200).astype(int)
    width = (upper - lower) / count
    axes = [lower[d] + (np.arange(count[d]) + 0.5) * width[d] for d in range(3)]
    total, first, second, rng = 0, np.zeros(3), np.zeros((3, 3)), np.random.default_rng(0)
    for z in axes[2]:
        x = np.stack(np.meshgrid(axes[0], axes[1], [z], indexing="ij"), axis=-1).reshape(-1, 3)
        x = x + (rng.random(x.shape) - 0.5) * width  # One random point per cell: no bias where faces follow the grid.
        x = x[np.asarray(level(x)) < 0.0]
        total, first, second = total + len(x), first + x.sum(axis=0), second + x.T @ x
    volume = total * float(width.prod())
    centre = first / total
    return volume, centre, volume * (second / total - np.outer(centre, centre))


# -- meshes -----------------------------------------------------------------------------------------------------------


def box(size: Any) -> Mesh:
    """Return a box with edges `size` [m]."""
    return _mesh(trimesh.creation.box(extents=size))


def ellipsoid(radii: Any, subdivisions: int = 4) -> Mesh:
    """Return an ellipsoid with half-axes `radii` [m]."""
    vertices, faces = _mesh(trimesh.creation.icosphere(subdivisions=subdivisions))
    return vertices * np.asarray(radii), faces


def revolve(profile: Any) -> Mesh:
    """Turn a profile of (r, z) [m] about z; a profile off the axis must be closed."""
    return _mesh(trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=64))


def hollow_sphere(radius: float, thickness: float) -> Mesh:
    """Return a ball with a concentric cavity."""
    vertices, faces = ellipsoid([1.0] * 3)
    return np.concatenate([radius * vertices, (radius - thickness) * vertices]), np.concatenate(
        [faces, faces[:, ::-1] + len(vertices)]
    )


def sweep(curve: Array, section: Array, *, closed: bool = False, twist: Array | None = None) -> Mesh:
    """Sweep a convex polygon (M, 2) [m] along a curve (N, 3) [m] with frames that do not spin about it.

    Args:
        curve: Points of the axis.
        section: Corners, counter-clockwise.
        closed: Whether the last point joins the first (for plane curves, whose frame closes too).
        twist: Turn of the section about the axis at every point [rad], shape (N,).
    """
    count, corners = len(curve), len(section)
    tangent = np.roll(curve, -1, 0) - np.roll(curve, 1, 0) if closed else np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()])
    rings = []
    for k in range(count):
        normal = normal - tangent[k] * (normal @ tangent[k])
        normal /= np.linalg.norm(normal)
        angle = 0.0 if twist is None else twist[k]
        side = np.cross(tangent[k], normal)
        u, v = np.cos(angle) * normal + np.sin(angle) * side, np.cos(angle) * side - np.sin(angle) * normal
        rings.append(curve[k] + section[:, :1] * u + section[:, 1:] * v)
    vertices = np.concatenate(rings)
    faces = []
    for k in range(count if closed else count - 1):
        a, b = k * corners, (k + 1) % count * corners
        for i in range(corners):
            j = (i + 1) % corners
            faces += [[a + i, a + j, b + j], [a + i, b + j, b + i]]
    if not closed:
        last = (count - 1) * corners
        faces += [[0, i + 1, i] for i in range(1, corners - 1)]
        faces += [[last, last + i, last + i + 1] for i in range(1, corners - 1)]
    return vertices, np.array(faces)


def polygon(corners: int, radius: float) -> Array:
    """Return a regular polygon of the area of a circle of `radius` [m]."""
    angle = 2.0 * np.pi * (np.arange(corners) + 0.5) / corners
    radius = radius * np.sqrt(2.0 * np.pi / corners / np.sin(2.0 * np.pi / corners))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def torus(major: float, minor: float, centre: Any = (0.0, 0.0, 0.0), plane: tuple[int, int] = (0, 1)) -> Mesh:
    """Return a ring in the plane of two axes."""
    angle = 2.0 * np.pi * np.arange(64) / 64
    curve = np.zeros((64, 3))
    curve[:, plane[0]], curve[:, plane[1]] = major * np.cos(angle), major * np.sin(angle)
    vertices, faces = _scaled(sweep(curve, polygon(24, minor), closed=True), 2.0 * np.pi**2 * major * minor**2)
    return vertices + np.asarray(centre), faces


def helix(radius: float, wire: float, height: float, turns: float) -> Mesh:
    """Return a coil spring."""
    t = np.linspace(0.0, 1.0, int(48 * turns))
    angle = 2.0 * np.pi * turns * t
    return sweep(np.stack([radius * np.cos(angle), radius * np.sin(angle), height * t], axis=1), polygon(16, wire))


def twisted_bar(edge: float, length: float, turn: float) -> Mesh:
    """Return a square bar along z that turns by `turn` [rad] over its length."""
    t = np.linspace(0.0, 1.0, 81)
    curve = np.stack([np.zeros(81), np.zeros(81), length * t], axis=1)
    return sweep(curve, edge * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]), twist=turn * t)


def star(core: float, spike: float, sharpness: int = 24) -> Mesh:
    """Return a ball with twelve spikes that point at the corners of an icosahedron."""
    vertices, faces = ellipsoid([1.0] * 3, subdivisions=5)
    tips = np.asarray(trimesh.creation.icosahedron().vertices)
    tips = tips / np.linalg.norm(tips, axis=1, keepdims=True)
    height = (np.maximum(vertices @ tips.T, 0.0) ** sharpness).max(axis=1)
    return vertices * (core + spike * height)[:, None], faces


def voxels(mask: Any, pitch: Any) -> Mesh:
    """Return the surface of the filled cells of a boolean grid (X, Y, Z) with cells of `pitch` [m]."""
    filled = np.pad(np.asarray(mask, dtype=bool), 1)
    corners, quads = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            shown = filled & ~np.roll(filled, 1 - 2 * side, axis)
            for cell in np.argwhere(shown):
                start = cell.copy()
                start[axis] += side
                ring = [start + a * np.eye(3, dtype=int)[u] + b * np.eye(3, dtype=int)[v] for a, b in _SQUARE]
                quads.append(len(corners) + np.arange(4)[:: 1 if side else -1])
                corners += ring
    vertices, inverse = np.unique(np.array(corners), axis=0, return_inverse=True)
    quad = inverse.reshape(-1)[np.array(quads)]
    return (vertices - 1.0) * np.asarray(pitch, dtype=float), np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def together(*meshes: Mesh) -> Mesh:
    """Return several meshes as one, without merging them."""
    starts = np.cumsum([0] + [len(v) for v, _ in meshes])
    return np.concatenate([v for v, _ in meshes]), np.concatenate(
        [f + s for (_, f), s in zip(meshes, starts, strict=False)]
    )


def letters(*, joined: bool) -> Mesh:
    """Return the word SOFT, standing on a rule or as four separate letters."""
    glyphs = {
        "S": ["#####", "#....", "#....", "#####", "....#", "....#", "#####"],
        "O": ["#####", "#...#", "#...#", "#...#", "#...#", "#...#", "#####"],
        "F": ["#####", "#....", "#....", "####.", "#....", "#....", "#...."],
        "T": ["#####", "..#..", "..#..", "..#..", "..#..", "..#..", "..#.."],
    }
    rows = [".".join(glyphs[c][k] for c in "SOFT") for k in range(7)]
    if joined:
        rows.append("#" * len(rows[0]))
    plane = np.array([[c == "#" for c in row] for row in rows[::-1]]).T
    return voxels(np.repeat(plane[:, None, :], 2, axis=1), 1.0 / plane.shape[0])


def l_shape() -> Mesh:
    """Return an L of square section."""
    mask = np.zeros((8, 2, 8), dtype=bool)
    mask[:, :, :2] = mask[:2] = True
    return voxels(mask, 0.125)


def cross() -> Mesh:
    """Return three crossing square bars."""
    mask = np.zeros((7, 7, 7), dtype=bool)
    mask[2:5, 2:5] = mask[2:5, :, 2:5] = mask[:, 2:5, 2:5] = True
    return voxels(mask, 1.0 / 7.0)


def cup() -> Mesh:
    """Return a beaker with a wall and a bottom of 4 cm."""
    return revolve(
        [(0.0, 0.0), (0.28, 0.0), (0.35, 1.0), (0.31, 1.0), (0.24, 0.04), (0.0, 0.04)],
    )


def dumbbell() -> Mesh:
    """Return two balls joined by a thin rod."""
    ball = np.linspace(-0.5 * np.pi, np.arccos(0.05 / 0.2), 24)
    lower = np.stack([0.2 * np.cos(ball), -0.3 + 0.2 * np.sin(ball)], axis=1)
    lower[0, 0] = 0.0
    return revolve(np.concatenate([lower, lower[::-1] * [1.0, -1.0]]))


def cluster() -> Mesh:
    """Return balls that overlap like grapes."""
    return together(*[_ball(centre, 0.16) for centre in _GRAPES])


def scattered() -> Mesh:
    """Return eight balls that do not touch."""
    return together(*[_ball(centre, 0.15) for centre in 0.35 * np.array(_CORNERS)])


def ring_chain() -> Mesh:
    """Return three linked rings, each in contact with the next (they overlap by a tenth of the wire)."""
    return together(*[torus(_RING[0], _RING[1], (x, 0.0, 0.0), (0, 1 + k % 2)) for k, x in enumerate(_RING_X)])


def from_newton(name: str) -> Mesh:
    """Load an asset that newton installs, scaled to a longest edge of one metre."""
    import newton.examples

    Usd, UsdGeom = (importlib.import_module(name) for name in ("pxr.Usd", "pxr.UsdGeom"))  # they have no type stubs
    stage = Usd.Stage.Open(newton.examples.get_asset(f"{name}.usd"))
    mesh = next(UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    vertices = np.asarray(mesh.GetPointsAttr().Get(), dtype=np.float64)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get())
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(), dtype=np.int64)
    starts = np.cumsum(counts) - counts
    faces = [[s, s + k, s + k + 1] for s, n in zip(starts, counts, strict=True) for k in range(1, n - 1)]
    return vertices / np.ptp(vertices, axis=0).max(), index[np.array(faces)]


# -- level sets -------------------------------------------------------------------------------------------------------


def gyroid() -> tuple[Callable[[Array], Array], Array]:
    """Return a cube of gyroid sheet, two periods an edge, and its bounds."""
    wave = 4.0 * np.pi

    def level(x: Array) -> Array:
        s, c = np.sin(wave * x), np.cos(wave * x)
        sheet = np.abs(s[:, 0] * c[:, 1] + s[:, 1] * c[:, 2] + s[:, 2] * c[:, 0]) - 0.5
        return np.maximum(sheet / wave, np.abs(x).max(axis=1) - 0.5)

    return level, np.array([[-0.51] * 3, [0.51] * 3])


def hand() -> tuple[Callable[[Array], Array], Array]:
    """Return a palm with five fingers, smoothly joined, and its bounds."""
    bones = [((-0.12 + 0.08 * k, 0.0, 0.4), (-0.2 + 0.13 * k, 0.03, top), 0.035) for k, top in enumerate(_FINGERS)]
    bones.append(((0.1, 0.0, 0.12), (0.36, 0.06, 0.42), 0.045))

    def level(x: Array) -> Array:
        size = np.array([0.13, 0.025, 0.17])
        outside = np.abs(x - [0.0, 0.0, 0.22]) - size
        parts = [
            np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0) - 0.045,
            *[_capsule(x, np.array(a), np.array(b), r) for a, b, r in bones],
        ]
        return -0.02 * np.log(np.exp(-np.stack(parts) / 0.02).sum(axis=0))

    return level, np.array([[-0.35, -0.15, -0.1], [0.5, 0.2, 1.05]])


def _capsule(x: Array, a: Array, b: Array, radius: float) -> Array:
    """Return the distance to a segment a-b swept by a radius."""
    t = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(x - a - t[:, None] * (b - a), axis=1) - radius


# -- surfaces as splats and points ------------------------------------------------------------------------------------


def sample_surface(vertices: Array, faces: Array, count: int, seed: int = 0) -> tuple[Array, Array]:
    """Return points (N, 3) [m] spread over a mesh and their normals (N, 3)."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    return np.asarray(points), np.asarray(mesh.face_normals)[np.asarray(face)]


def cover_with_splats(vertices: Array, faces: Array, count: int, seed: int = 0) -> Splats:
    """Cover a mesh with flat splats that face outward."""
    points, normal = sample_surface(vertices, faces, count, seed)
    spread = KDTree(points).query(points, k=5)[0][:, 1:].mean(axis=1)
    tangent = np.cross(normal, np.random.default_rng(seed).normal(size=normal.shape))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=2)
    return Splats(
        means=points,
        scales=spread[:, None] * [1.0, 1.0, 0.1],
        quats=Rotation.from_matrix(frame).as_quat(),
        opacities=np.full(count, 0.95),
        sh=np.zeros((count, 1, 3)),
    )


# -- the list ---------------------------------------------------------------------------------------------------------


def _mesh(mesh: Any) -> Mesh:
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _ball(centre: Any, radius: float) -> Mesh:
    vertices, faces = _scaled(ellipsoid([radius] * 3, subdivisions=3), 4.0 / 3.0 * np.pi * radius**3)
    return vertices + np.asarray(centre), faces


def _scaled(mesh: Mesh, volume: float) -> Mesh:
    """Scale a mesh about the origin to the volume of the smooth body it stands for [m^3]."""
    return mesh[0] * (volume / trimesh.Trimesh(*mesh, process=False).volume) ** (1.0 / 3.0), mesh[1]


_SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
_CORNERS = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
_FINGERS = (0.72, 0.9, 0.95, 0.88)
_GRAPES = 0.22 * np.array([[i, j, k] for i in range(4) for j in range(2) for k in range(2) if (i + j + k) % 3 != 2])
_RING = (0.16, 0.05)
_RING_X = [k * (2.0 * _RING[0] - 1.9 * _RING[1]) for k in range(4)]


def _union_of_balls(centres: Array, radius: float) -> Callable[[Array], Array]:
    return lambda x: KDTree(centres).query(x)[0] - radius


def _union_of_rings(x: Array) -> Array:
    distance = []
    for k, centre in enumerate(_RING_X):
        local = x - [centre, 0.0, 0.0]
        across = local[:, 2 - k % 2]
        around = np.hypot(local[:, 0], local[:, 1 + k % 2])
        distance.append(np.hypot(around - _RING[0], across) - _RING[1])
    return np.min(distance, axis=0)


_UNIONS: dict[str, Callable[[Array], Array]] = {
    "cluster": _union_of_balls(_GRAPES, 0.16),
    "ring chain": _union_of_rings,
}


def _make(name: str, source: Source, geometry: Callable[[], Any], **options: Any) -> Shape:
    return Shape(name=name, source=source, geometry=functools.cache(geometry), **options)


SHAPES: dict[str, Shape] = {
    shape.name: shape
    for shape in [
        _make("cube", "mesh", lambda: box((0.5, 0.5, 0.5))),
        _make("ellipsoid", "mesh", lambda: ellipsoid((0.25, 0.35, 0.5))),
        _make("plate 40:1", "mesh", lambda: box((1.0, 0.6, 0.025)), axis=0),
        _make("rod 50:1", "mesh", lambda: _mesh(trimesh.creation.cylinder(radius=0.01, height=1.0, sections=32))),
        _make("cone", "mesh", lambda: _mesh(trimesh.creation.cone(radius=0.35, height=1.0, sections=64))),
        _make("torus", "mesh", lambda: torus(0.38, 0.12), axis=0),
        _make("cup", "mesh", cup, smooth=False),
        _make("hollow sphere", "mesh", lambda: hollow_sphere(0.5, 0.04), smooth=False),
        _make("L-shape", "mesh", l_shape),
        _make("cross", "mesh", cross),
        _make("letters on a rule", "mesh", lambda: letters(joined=True)),
        _make("letters apart", "mesh", lambda: letters(joined=False), connected=False),
        _make("dumbbell", "mesh", dumbbell),
        _make("star", "mesh", lambda: star(0.2, 0.3)),
        _make("helix", "mesh", lambda: helix(0.2, 0.04, 0.9, 4.0)),
        _make("twisted bar", "mesh", lambda: twisted_bar(0.2, 1.0, 2.0 * np.pi)),
        _make("ring chain", "mesh", ring_chain, axis=0, overlapping=True),
        _make("cluster", "mesh", cluster, axis=0, overlapping=True),
        _make("scattered balls", "mesh", scattered, connected=False),
        _make("gyroid", "implicit", gyroid, smooth=False),
        _make("hand", "implicit", hand),
        _make("torus, splats", "splats", lambda: torus(0.38, 0.12), axis=0),
        _make("star, splats", "splats", lambda: star(0.2, 0.3)),
        _make("dumbbell, splats", "splats", dumbbell),
        _make("ellipsoid, points", "points", lambda: ellipsoid((0.25, 0.35, 0.5))),
        _make("L-shape, points", "points", l_shape),
    ]
}
if importlib.util.find_spec("pxr") is not None:
    for _name, _axis in (("bunny", 1), ("bear", 2)):
        SHAPES[_name] = _make(_name, "mesh", functools.partial(from_newton, _name), axis=_axis)
