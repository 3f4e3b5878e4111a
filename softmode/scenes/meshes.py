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
from softmode.splats.cameras.shape_triangles import shape_triangles
from softmode.splats.splats import rotations_from_quats

PLANE_EXTENT = 4.0
"""Edge of the quad that stands for an infinite plane [m]."""
SEGMENTS = 24
"""Facets around a sphere, capsule, cylinder or cone."""


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
        found = shape_triangles(
            GeoType(int(kinds[s])), scales[s].tolist(), model.shape_source[s], plane_extent, segments
        )
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


def _color(source: Any, color: Any) -> tuple[float, float, float]:
    """Return the colour of a shape, or of its mesh where the model has none."""
    if color is None:
        color = getattr(source, "color", None) or (0.5, 0.5, 0.5)
    r, g, b = (float(min(max(v, 0.0), 1.0)) for v in color)
    return r, g, b
