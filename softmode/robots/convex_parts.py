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
    meshes = [geom for geom in geoms if model.geom_dataid[geom] >= 0]
    for geom, old in [(geom, _given(spec, model, geom)) for geom in meshes]:
        slabs = _slabs(model, int(model.geom_dataid[geom]))
        if not slabs:
            continue
        link = int(model.geom_bodyid[geom])
        body = spec.body(model.body(link).name)
        if not body.explicitinertial:
            body.mass, body.inertia = model.body_mass[link], model.body_inertia[link]
            body.ipos, body.iquat, body.explicitinertial = model.body_ipos[link], model.body_iquat[link], True
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


def _given(spec: Any, model: Any, geom: int) -> Any:
    """Return a shape's specification."""
    link = model.body(int(model.geom_bodyid[geom]))
    return spec.body(link.name).geoms[geom - int(link.geomadr[0])]


def _slabs(model: Any, mesh: int) -> list[Array]:
    """Return the corners of the hulls of slabs of a mesh, (N, 3) [m] each; none where they fill its own hull."""
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = np.asarray(model.mesh_vert[start : start + count], float)
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = points[np.asarray(model.mesh_face[first : first + faces])]
    a, b = corners.reshape(-1, 3), np.roll(corners, -1, axis=1).reshape(-1, 3)
    k = int(np.ptp(points, axis=0).argmax())
    ends = np.linspace(points[:, k].min(), points[:, k].max(), _SLABS + 1)
    found, volume = [], 0.0
    for low, high in itertools.pairwise(ends):
        part = [points[(points[:, k] >= low) & (points[:, k] <= high)]]
        for plane in (low, high):
            crossing = (a[:, k] - plane) * (b[:, k] - plane) < 0.0
            share = (plane - a[crossing, k]) / (b[crossing, k] - a[crossing, k])
            part.append(a[crossing] + share[:, None] * (b[crossing] - a[crossing]))
        try:
            hull = ConvexHull(np.concatenate(part))
        except (QhullError, ValueError):
            continue  # a slab that is flat, or empty
        found.append(hull.points[hull.vertices])
        volume += hull.volume
    return found if found and volume < _FILLED * ConvexHull(points).volume else []
