"""The visible rigid shapes of a model as triangle meshes, for viewers and files that know nothing of Newton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
from newton import GeoType, ShapeFlags
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.scenes.host import host
from softmode.splats.splats import rotations_from_quats

PLANE_EXTENT = 4.0
"""Edge of the quad that stands for an infinite plane [m]."""
SEGMENTS = 24
"""Facets around a sphere, capsule, cylinder or cone."""
CREASE = 0.8
"""Cosine of the angle between triangles above which a mesh without normals is smooth there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneMesh:
    """The triangle mesh of one shape."""

    label: str
    """Label of the carrier and the shape, "hand/shape_2", or "world/table"; no two of a scene are alike."""
    shape: int
    """Index of the shape in the model."""
    body: int
    """Index of the rigid body in the model that carries it, -1 for the world."""
    vertices: NDArray[np.float32]
    """Corners in the frame of the body [m], shape (V, 3)."""
    faces: NDArray[np.int32]
    """Triangles, counter-clockwise from outside, shape (F, 3)."""
    normals: NDArray[np.float32]
    """Unit normals per corner, shape (V, 3)."""
    color: tuple[float, float, float]
    """Display colour, sRGB in 0..1."""
    opacity: float = 1.0
    """1 for opaque."""

    @property
    def volume(self) -> float:
        """Volume that the triangles enclose [m^3]; positive for a closed mesh that faces outwards."""
        a, b, c = self.vertices[self.faces].astype(np.float64).transpose(1, 0, 2)
        return float((a * np.cross(b, c)).sum() / 6.0)

    @property
    def area(self) -> float:
        """Area of the triangles [m^2]."""
        a, b, c = self.vertices[self.faces].astype(np.float64).transpose(1, 0, 2)
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def scene_meshes(
    model: newton.Model, *, world: int = 0, plane_extent: float = PLANE_EXTENT, segments: int = SEGMENTS
) -> tuple[SceneMesh, ...]:
    """Return the meshes of the shapes that cameras see in a world, its own and those that all worlds share.

    What counts is ``ShapeFlags.VISIBLE``, as for cameras and Newton's viewers: importers clear it for the colliders of
    a link that has pictures. Splats and shapes without extent have no mesh. Not for captured graphs.

    Args:
        model: The model.
        world: Which world.
        plane_extent: Edge of the quad that stands for an infinite plane [m].
        segments: Facets around a sphere, capsule, cylinder or cone.

    Raises:
        ConfigError: If there is no such world, or ``plane_extent`` is not positive.
    """
    worlds = max(int(model.world_count), 1)
    require_number("world", world, at_least=0, at_most=worlds - 1)
    require_number("plane_extent", plane_extent, above=0.0, unit="m", hint="give metres, like 4.0")
    if model.shape_count == 0:
        return ()
    names = ("world", "flags", "body", "type", "scale", "transform")
    owner, flags, bodies, kinds, scales, poses = (getattr(model, f"shape_{name}").numpy() for name in names)
    colors = None if model.shape_color is None else model.shape_color.numpy()
    opacities = None if model.shape_opacity is None else model.shape_opacity.numpy()
    seen: set[str] = set()
    meshes = []
    shown = np.isin(owner, [-1, world]) & ((flags & int(ShapeFlags.VISIBLE)) != 0)
    for s in np.flatnonzero(shown).tolist():
        found = _triangles(GeoType(int(kinds[s])), scales[s].tolist(), model.shape_source[s], plane_extent, segments)
        if found is None:
            continue
        vertices, faces, normals = found
        rotation = rotations_from_quats(poses[s : s + 1, 3:])[0]
        carrier = "world" if bodies[s] < 0 else str(model.body_label[bodies[s]])
        label = str(model.shape_label[s])
        label = distinct(label if label.startswith(f"{carrier}/") else f"{carrier}/{label}", seen)
        meshes.append(
            SceneMesh(
                label=label,
                shape=s,
                body=int(bodies[s]),
                vertices=(vertices @ rotation.T + poses[s, :3]).astype(np.float32),
                faces=faces,
                normals=(normals @ rotation.T).astype(np.float32),
                color=_color(model.shape_source[s], None if colors is None else colors[s]),
                opacity=1.0 if opacities is None else float(np.clip(opacities[s], 0.0, 1.0)),
            )
        )
    return tuple(meshes)


def scene_poses(meshes: Sequence[SceneMesh], state: newton.State) -> NDArray[np.float32]:
    """Return where the bodies of the meshes are: position [m] and quaternion xyzw, shape (len(meshes), 7).

    Meshes of the world stay at the origin. Reads from the device.

    Args:
        meshes: What :func:`scene_meshes` returned.
        state: A state of the same model.
    """
    poses = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (len(meshes), 1))
    body = np.array([mesh.body for mesh in meshes], dtype=np.int64)
    if (body >= 0).any():
        poses[body >= 0] = host(state.body_q)[body[body >= 0]]
    return poses


def distinct(label: str, seen: set[str]) -> str:
    """Return the label with a number behind it if it was seen before, and note it as seen."""
    chosen, number = label, 2
    while chosen in seen:
        chosen, number = f"{label}_{number}", number + 1
    seen.add(chosen)
    return chosen


def _triangles(
    kind: GeoType, scale: list[float], source: Any, plane_extent: float, segments: int
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]] | None:
    """Return corners, triangles and normals in the shape's own frame, None for what has no surface."""
    x, y, z = scale
    z_axis: Any = newton.Axis.Z
    plain: dict[str, Any] = {"compute_inertia": False, "compute_uvs": False}
    rings = {"num_latitudes": segments, "num_longitudes": segments}
    tube = {"up_axis": z_axis, "segments": segments}
    width, depth = (edge if edge > 0.0 else plane_extent for edge in (x, y))
    made = {
        GeoType.PLANE: (newton.Mesh.create_plane, (width, depth), {}),
        GeoType.SPHERE: (newton.Mesh.create_sphere, (x,), rings),
        GeoType.ELLIPSOID: (newton.Mesh.create_ellipsoid, (x, y, z), rings),
        GeoType.BOX: (newton.Mesh.create_box, (x, y, z), {"duplicate_vertices": True}),
        GeoType.CAPSULE: (newton.Mesh.create_capsule, (x, y), tube),
        GeoType.CYLINDER: (newton.Mesh.create_cylinder, (x, y), tube | {"barrel_radius": z}),
        GeoType.CONE: (newton.Mesh.create_cone, (x, y), tube),
    }
    if kind in made:
        create, size, options = made[kind]
        mesh = create(*size, **options, **plain)
    elif kind == GeoType.HFIELD and source is not None:
        heights = source.min_z + source.data * (source.max_z - source.min_z)
        mesh = newton.Mesh.create_heightfield(  # x runs along its rows, along the columns of a Heightfield
            heights.T, 2.0 * source.hx, 2.0 * source.hy, ground_z=source.min_z, compute_inertia=False
        )
    elif kind in (GeoType.MESH, GeoType.CONVEX_MESH) and source is not None:
        return _scaled(source, np.array(scale))
    else:
        return None
    return _scaled(mesh, np.ones(3))


def _scaled(mesh: newton.Mesh, scale: NDArray[np.float64]) -> Any:
    """Return corners, triangles and normals of a mesh under a scale; a mirroring one turns its triangles round."""
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3) * scale
    faces = np.array(mesh.indices, np.int32).reshape(-1, 3)
    if np.prod(scale) < 0.0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    normals = None if mesh.normals is None else np.asarray(mesh.normals, np.float64).reshape(-1, 3)
    if normals is None or len(normals) != len(vertices):
        return _creased(vertices, faces)
    normals = normals / np.where(scale == 0.0, 1.0, scale)  # the gradient of f(S^-1 x) points out, mirrored or not
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return vertices, faces, normals / np.where(length > 0.0, length, 1.0)


def _creased(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> Any:
    """Return corners, triangles and normals with the mesh cut along its creases, so that it is smooth between them.

    A corner of a triangle gets the sum of the area vectors of the triangles around it that face about as this one does.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.cross(b - a, c - a)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    real = size[:, 0] > 1e-12 * size.max(initial=0.0)  # triangles without area face nowhere and show nothing
    faces, area, unit = faces[real], area[real], area[real] / size[real]
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    at = place.reshape(-1)[faces.reshape(-1)]
    order = np.argsort(at, kind="stable")
    count = np.bincount(at)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    mine = np.repeat(np.arange(len(at)), count[at])  # every pair of triangle corners at one place
    step = np.arange(len(mine)) - np.repeat(np.cumsum(count[at]) - count[at], count[at])
    other = order[first[at[mine]] + step]
    near = np.einsum("ij,ij->i", unit[mine // 3], unit[other // 3]) > CREASE
    normals = np.zeros((len(at), 3))
    np.add.at(normals, mine[near], area[other[near] // 3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    key = np.concatenate([at[:, None], np.round(normals * 1e4)], axis=1)
    _, kept, corner = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return vertices[faces.reshape(-1)[kept]], corner.reshape(-1, 3).astype(np.int32), normals[kept]


def _color(source: Any, color: Any) -> tuple[float, float, float]:
    """Return the colour of a shape, or of its mesh where the model has none."""
    if color is None:
        color = getattr(source, "color", None) or (0.5, 0.5, 0.5)
    r, g, b = (float(min(max(v, 0.0), 1.0)) for v in color)
    return r, g, b
