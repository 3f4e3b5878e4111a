"""The surface of a Newton shape as triangles: what cameras rasterise, viewers show and files hold."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
from newton import GeoType
from numpy.typing import NDArray

CREASE = 0.8
"""Cosine of the angle between triangles above which a mesh without normals is smooth there."""


def shape_triangles(
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
