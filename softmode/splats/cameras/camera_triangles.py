"""The triangles of a model's visible shapes, once for all worlds with equal shapes: what `camera_meshes` draws."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
from newton import GeoType, ShapeFlags
from numpy.typing import NDArray

from softmode.splats.cameras.shape_triangles import shape_triangles

PLANE_EXTENT = 2000.0
"""Edge of the quad that stands for an infinite plane [m]."""
LARGE = 0.005
"""Area of a triangle from which many threads share it on CUDA [m^2]."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles in the frames of their shapes."""

    plane: NDArray[np.float32]
    corner: NDArray[np.float32]
    normal: NDArray[np.float32]
    slot: NDArray[np.int32]
    large: NDArray[np.bool_]


class Kind:
    """The triangles of a world: small ones, large ones, and those of meshes that rays meet, in the mesh's own order."""

    def __init__(
        self, model: newton.Model, shapes: NDArray[np.int64], types: Any, scales: Any, segments: int, most: int
    ) -> None:
        """Take them from the shapes."""
        scanned, met = [_no_triangles()], [_no_triangles()]
        self.center, self.half = np.zeros((2, len(shapes), 3))
        self.rays: list[tuple[int, int]] = []
        """Slot of each shape that rays meet, and where its triangles begin."""
        for slot, shape in enumerate(shapes.tolist()):
            kind, scale = GeoType(int(types[shape])), scales[shape]
            source: Any = model.shape_source[shape]
            many = kind == GeoType.MESH and len(source.indices) > 3 * most and bool((scale > 0.0).all())
            corner, normal = _corners(kind, source, scale, segments, many)
            if not len(corner):
                continue
            self.center[slot] = 0.5 * (corner.min(axis=(0, 1)) + corner.max(axis=(0, 1)))
            self.half[slot] = 0.5 * np.ptp(corner, axis=(0, 1))
            if kind != GeoType.PLANE:  # a sheet casts from one side only
                self.half[slot] = np.maximum(self.half[slot], 1e-6)
            if many:
                self.rays.append((slot, sum(len(part.slot) for part in met)))
            (met if many else scanned).append(_triangles(corner, normal, slot, every=many))
        small = _join(scanned)
        order = np.argsort(small.large, kind="stable")
        small = Triangles(*(x[order] for x in vars(small).values()))
        self.large = int(small.large.sum())
        self.small = len(order) - self.large
        self.rays = [(slot, first + len(order)) for slot, first in self.rays]
        self.triangles = _join([small, *met])


class WorldKinds:
    """The kinds of worlds that a model has: which shapes there are, and their triangles, kind after kind."""

    def __init__(self, kinds: list[Kind], of_world: NDArray[np.int32], shape: NDArray[np.int32]) -> None:
        """Join the kinds."""
        self.of_world, self.shape = of_world, shape
        self.triangles = _join([kind.triangles for kind in kinds])
        counts = np.array([len(kind.triangles.slot) for kind in kinds])
        first = np.cumsum(counts) - counts
        small, large = (np.array([getattr(kind, name) for kind in kinds]) for name in ("small", "large"))
        self.small, self.large = (np.stack(part, axis=1) for part in ((first, small), (first + small, large)))
        self.both = np.stack([first, small + large], axis=1)
        """First of the triangles that are scanned, and how many, of each kind; those above are its parts."""
        self.center, self.half = np.zeros((2, len(kinds), shape.shape[1], 3))
        self.ray_count = np.array([len(kind.rays) for kind in kinds])
        self.ray_slot, self.ray_first = np.zeros((2, len(kinds), max(1, *self.ray_count, 1)), np.int32)
        for k, kind in enumerate(kinds):
            self.center[k, : len(kind.center)], self.half[k, : len(kind.half)] = kind.center, kind.half
            for h, (slot, begin) in enumerate(kind.rays):
                self.ray_slot[k, h], self.ray_first[k, h] = slot, begin + first[k]


def world_kinds(model: newton.Model, segments: int, most: int) -> WorldKinds:
    """Return the triangles of a model; worlds with equal shapes share theirs.

    Args:
        model: The model.
        segments: Facets around what is round.
        most: Number of triangles from which a mesh is met by rays.
    """
    worlds = max(int(model.world_count), 1)
    shown = _shown(model)
    given: Any = (model.shape_type, model.shape_scale)
    types, scales = (x.numpy() if model.shape_count else np.zeros(0) for x in given)
    sources = np.array([id(source) for source in model.shape_source], np.int64)
    owner = np.zeros(0, np.int64) if model.shape_world is None else model.shape_world.numpy()[shown]
    starts = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[starts], np.arange(-1, worlds + 1))
    shared = shown[starts[: ends[1]]]
    known: dict[bytes, int] = {}
    of_world, shapes, made = np.zeros(worlds, np.int32), [], []
    for world in range(worlds):
        own = np.concatenate([shared, shown[starts[ends[world + 1] : ends[world + 2]]]])
        key = b"".join(x[own].tobytes() for x in (types, scales, sources))
        if key not in known:
            known[key] = len(made)
            made.append(Kind(model, own, types, scales, segments, most))
        of_world[world] = known[key]
        shapes.append(own)
    slots = max([1, *(len(own) for own in shapes)])
    table = np.full((worlds, slots), -1, np.int32)
    for world, own in enumerate(shapes):
        table[world, : len(own)] = own
    return WorldKinds(made, of_world, table)


def _shown(model: newton.Model) -> NDArray[np.int64]:
    """Return the shapes that are visible and not fully transparent."""
    if model.shape_count == 0 or model.shape_flags is None:
        return np.zeros(0, np.int64)
    visible = (model.shape_flags.numpy() & int(ShapeFlags.VISIBLE)) != 0
    if model.shape_opacity is not None:
        visible &= model.shape_opacity.numpy() > 0.0
    return np.flatnonzero(visible)


def _no_triangles() -> Triangles:
    """Return none."""
    corner = np.zeros((0, 3, 3), np.float32)
    return Triangles(np.zeros((0, 4), np.float32), corner, corner, np.zeros(0, np.int32), np.zeros(0, bool))


def _join(parts: list[Triangles]) -> Triangles:
    """Return the triangles of all parts."""
    return Triangles(*(np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])))


def _triangles(corner: NDArray[Any], normal: NDArray[Any] | None, slot: int, *, every: bool) -> Triangles:
    """Return the triangles of a shape; without normals each is lit as it faces.

    Those without area are left out and neighbours look the same way, so that the threads of a warp see them or do not;
    unless every one is wanted, in the order given.
    """
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(across, axis=1)
    unit = across / np.maximum(size, 1e-300)[:, None]
    normal = np.repeat(unit[:, None], 3, axis=1) if normal is None else normal
    middle = corner.mean(axis=1)
    plane = np.concatenate([unit, (unit * middle).sum(axis=1)[:, None]], axis=1)
    made = Triangles(plane, corner, normal, np.full(len(size), slot, np.int32), size > 2.0 * LARGE)
    if every:
        return made
    order = np.lexsort([*middle.T, *np.round(1.4 * unit).T])
    order = order[size[order] > 1e-12 * size.max()]
    return Triangles(*(x[order] for x in vars(made).values()))


def _corners(
    kind: GeoType, source: Any, scale: NDArray[Any], segments: int, every: bool
) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return corners of the triangles of a shape, shape (F, 3, 3), and their normals; none if it brings none."""
    normals = None
    if kind == GeoType.MESH and source.normals is not None and len(source.normals) == len(source.vertices):
        normals = np.asarray(source.normals, np.float64).reshape(-1, 3) / np.where(scale == 0.0, 1.0, scale)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    if every:
        faces = np.asarray(source.indices).reshape(-1, 3)
        corner = (np.asarray(source.vertices, np.float64).reshape(-1, 3) * scale)[faces]
        return corner, None if normals is None else normals[faces]
    found = shape_triangles(kind, scale.tolist(), source, PLANE_EXTENT, segments)
    if found is None:
        return np.zeros((0, 3, 3)), None
    vertices, faces, smooth = found
    flat = kind in (GeoType.CONVEX_MESH, GeoType.HFIELD) or (kind == GeoType.MESH and normals is None)
    if kind == GeoType.CONE:
        return vertices[faces], _cone_normals(vertices[faces], scale)
    return vertices[faces], None if flat else smooth[faces]


def _cone_normals(corner: NDArray[Any], scale: NDArray[Any]) -> NDArray[Any]:
    """Return the normals of a cone about z with its radius and half of its height, those of its apex per triangle."""
    middle = corner.mean(axis=1, keepdims=True)
    base = np.ptp(corner[..., 2], axis=1) < 1e-6 * scale[1]
    out = np.where(np.hypot(corner[..., :1], corner[..., 1:2]) > 1e-6 * scale[0], corner, middle)[..., :2]
    out = out / np.linalg.norm(out, axis=-1, keepdims=True)
    side = np.concatenate([2.0 * scale[1] * out, np.full((*out.shape[:2], 1), scale[0])], axis=-1)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return np.where(base[:, None, None], np.array([0.0, 0.0, -1.0]), side)
