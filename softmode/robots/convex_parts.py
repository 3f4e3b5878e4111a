"""Meshes of a hand whose hull would fill the room between its jaws, cut into slabs that are nearly convex."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]

_SLABS = 8
"""Into how many slabs a mesh is cut across its longest axis."""
_FILLED = 0.9
"""Share of its hull's volume that the hulls of the slabs fill at most where a mesh is cut."""


def cut_meshes(spec: Any, model: Any, geoms: list[int]) -> list[str]:
    """Put slabs in place of meshes that collide; the links keep their mass. Return notes.

    Args:
        spec: The specification, which is changed.
        model: What it compiles to.
        geoms: The shapes.
    """
    notes = []
    meshes = {geom: model.body(int(model.geom_bodyid[geom])) for geom in geoms if model.geom_dataid[geom] >= 0}
    given = [spec.body(link.name).geoms[geom - int(link.geomadr[0])] for geom, link in meshes.items()]
    for (geom, link), old in zip(meshes.items(), given, strict=True):
        slabs = _slabs(model, int(model.geom_dataid[geom]))
        if not slabs:
            continue
        body = spec.body(link.name)
        if not body.explicitinertial:
            body.mass, body.inertia = link.mass[0], link.inertia
            body.ipos, body.iquat, body.explicitinertial = link.ipos, link.iquat, True
        for k, points in enumerate(slabs):
            mesh = spec.add_mesh(name=f"{body.name}_{geom}_{k}", uservert=points.ravel().tolist())
            copied = {name: getattr(old, name) for name in ("contype", "conaffinity", "friction", "group", "rgba")}
            place = {"pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
            body.add_geom(type=model.geom_type[geom], meshname=mesh.name, mass=0.0, **place, **copied)
        if any(not one.contype | one.conaffinity for one in body.geoms):
            spec.delete(old)
        else:
            old.contype = old.conaffinity = 0  # it is what is seen
        notes.append(f"link {body.name!r} of the hand is cut into {len(slabs)} hulls, as one would fill the jaw")
    return notes


def edge_ends(corners: Array) -> Array:
    """Return both ends of the edges of triangles (F, 3, 3), one after the other, shape (6 F, 3)."""
    return corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 3)


def slab_corners(ends: Array, axis: int, low: float, high: float) -> Array:
    """Return the corners of what lies of a surface between two planes across an axis, by the ends of its edges."""
    first, last = ends.reshape(-1, 2, 3).swapaxes(0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.array([[low], [high]]) - first[:, axis]) / (last - first)[:, axis]
    points = first + np.nan_to_num(np.clip(share, 0.0, 1.0))[..., None] * (last - first)
    return points[(points[..., axis] >= low - 1e-9) & (points[..., axis] <= high + 1e-9)]


def _slabs(model: Any, mesh: int) -> list[Array]:
    """Return the corners of the hulls of slabs of a mesh, (N, 3) [m] each; none where they fill its own hull."""
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = np.asarray(model.mesh_vert[start : start + count], float)
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    edges = edge_ends(points[np.asarray(model.mesh_face[first : first + faces])])
    k = int(np.ptp(points, axis=0).argmax())
    ends = np.linspace(points[:, k].min(), points[:, k].max(), _SLABS + 1)
    found, volume = [], 0.0
    for low, high in itertools.pairwise(ends):
        try:
            hull = ConvexHull(slab_corners(edges, k, low, high))
        except (QhullError, ValueError):
            continue  # a slab that is flat, or empty
        found.append(hull.points[hull.vertices])
        volume += hull.volume
    return found if found and volume < _FILLED * ConvexHull(points).volume else []
