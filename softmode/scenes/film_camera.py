"""`FilmCamera`: pictures for people of a model with soft objects, its goal, and a captured room around it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.scenes.host import host
from softmode.scenes.meshes import SceneMesh, scene_meshes, scene_poses
from softmode.splats.cameras.camera import Overlay
from softmode.splats.cameras.camera_options import CameraOptions
from softmode.splats.cameras.mesh_raster import MeshRaster, TriangleMeshes
from softmode.splats.raster.pinhole import PinholeCamera, Vector
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.splats import Splats, rotations_from_quats

SEGMENTS = 48
"""Facets around a sphere, capsule, cylinder or cone."""

TABLE = "world/table"
"""Label of the shape that is shown as a table of wood."""
WOOD = (0.70, 0.64, 0.57)
"""Colour of its planks, sRGB."""
MARKER_OPACITY = 0.6
"""Factor on the opacities of a marker's splats."""


class FilmCamera:
    """Draws cameras of one image size in all worlds, for people to look at; policies see a `SplatCamera`.

    Meshes are rasterised with smooth edges and soft shadows. The marker of a goal shines through meshes, and is drawn
    behind the objects, so that it never covers them. A background of splats stands still; depth says what is in front.

    Args:
        model: The model; its worlds are copies of each other.
        state: Where everything is at first; its bodies say where shadows are cast.
        objects: The splats of the objects.
        marker: The splats that mark a place.
        cameras: The cameras, fixed in the world until `aim` moves one.
        options: Light and sky.
        room: Whether a second light, a table of wood and a room around all are shown.
        overlay: What else is drawn with the objects, such as radiance fields.
    """

    def __init__(
        self,
        model: newton.Model,
        state: newton.State,
        objects: SplatArrays,
        marker: SplatArrays | None,
        cameras: Sequence[PinholeCamera],
        *,
        options: CameraOptions | None = None,
        room: bool = False,
        overlay: Overlay | None = None,
    ) -> None:
        """Upload the meshes and allocate the images."""
        self.cameras, self._objects, self._marker, self._overlay = tuple(cameras), objects, marker, overlay
        self._drawn = objects if overlay is None else objects.without(overlay.hides)
        self._worlds, device = max(int(model.world_count), 1), model.device
        per_world = [camera for camera in cameras for _ in range(self._worlds)]
        self.views = ViewArrays.from_cameras(per_world, world=[*range(self._worlds)] * len(self.cameras), device=device)
        """The cameras; views are ordered by camera, then by world."""
        self._matrices = np.stack([camera.world_to_camera for camera in per_world])
        width, height, views = cameras[0].width, cameras[0].height, len(per_world)
        size = (views, width, height)
        meshes, starts, low, high = _triangles(model, state, room)
        about = (0.5 * (low + high), 0.75 * float(np.linalg.norm(high - low)))
        self._boxes, self._starts = _boxes(meshes), starts
        light = options if options is not None else CameraOptions()
        self._meshes = MeshRaster(meshes, starts, *about, *size, light=light, room=room, device=device)
        self._splats = SplatRasterizer(objects.means.shape[1], *size, device=device)
        self._marks = None if marker is None else SplatRasterizer(marker.means.shape[1], *size, device=device)
        self._plate: SplatRasterizer | None = None
        # Meshes do not hide the goal: it shines through them.
        gain = wp.array([(1.0, 1.0, 1.0, MARKER_OPACITY)], dtype=wp.vec4, device=device)
        self._mark_views = replace(self.views, splat_gain=gain)
        self._no_depth = wp.zeros((views, height, width), dtype=wp.float32, device=device)
        self._moved = True
        self._ring: tuple[wp.array, wp.array, Vector] | None = None
        self.rgb = wp.zeros((views, height, width, 3), dtype=wp.uint8, device=device)
        """The pictures, shape (view_count, height, width, 3), overwritten by every frame."""

    def surround(self, background: Splats) -> None:
        """Put a captured scene around the model: it stands still, and is drawn anew where a camera has moved.

        Args:
            background: Its splats in the model's frame.
        """
        device, (views, height, width, _) = self.rgb.device, self.rgb.shape
        self._background = SplatArrays.from_splats([background], device=device)
        drawn = RasterizerOptions(median_depth=True)
        self._plate = SplatRasterizer(background.count, views, width, height, options=drawn, device=device)
        self._moved = True

    def circle(self, places: NDArray[np.float64], radii: NDArray[np.float64], color: Vector) -> None:
        """Draw a thin ring around a place of each world, in front of no object, in place of the marker's splats.

        Args:
            places: The places [m], shape (world_count, 3).
            radii: Radii of the rings [m], shape (world_count,).
            color: Their colour, sRGB.
        """
        if self._ring is None:
            device, count = self.rgb.device, self._worlds
            made = (wp.zeros(count, dtype=wp.vec3, device=device), wp.zeros(count, dtype=float, device=device))
            self._ring = (*made, color)
        for array, given in zip(self._ring[:2], (places, radii), strict=True):
            array.assign(given.astype(np.float32))

    def corners(self, state: newton.State) -> NDArray[np.float64]:
        """Return the corners of the boxes around the meshes of all moving bodies [m], shape (world_count, K, 3)."""
        poses = host(state.body_q).astype(np.float64)[self._starts[:, None] + np.array(list(self._boxes))]
        turns = rotations_from_quats(poses[..., 3:].reshape(-1, 4)).reshape(*poses.shape[:2], 3, 3)
        found = np.einsum("wbij,bkj->wbki", turns, np.stack(list(self._boxes.values()))) + poses[:, :, None, :3]
        return found.reshape(self._worlds, -1, 3)

    def aim(self, name: str, matrices: NDArray[np.float64]) -> None:
        """Move a camera.

        Args:
            name: Its name.
            matrices: Rigid transforms from the world to the camera, shape (world_count, 4, 4).
        """
        first = [camera.name for camera in self.cameras].index(name) * self._worlds
        part = slice(first, first + self._worlds)
        self._moved |= not np.array_equal(self._matrices[part], matrices)
        self._matrices[part] = matrices
        self.views.world_to_camera.assign(self._matrices.astype(np.float32))

    def render(self, state: newton.State) -> wp.array:
        """Draw one frame of all cameras and return `rgb`; move the splats first."""
        if self._plate is not None and self._moved:
            self._plate.render(self._background, self.views)
        self._moved = False
        meshes = self._meshes
        meshes.render(state.body_q, self.views, self._objects, self._plate)
        rgb = meshes.rgb
        if self._ring is not None:
            meshes.circle(*self._ring, self.views)
        elif self._marker is not None and self._marks is not None:
            self._marks.render(self._marker, self._mark_views, mesh_rgb=rgb, mesh_depth=self._no_depth)
            rgb = self._marks.rgb
        seen, drawn = {"mesh_rgb": rgb, "mesh_depth": meshes.depth}, self._splats
        drawn.render(self._drawn, self.views, **seen)
        if self._overlay is not None:
            self._overlay.draw(self.views, **seen, rgb=drawn.rgb, depth=drawn.depth, alpha=drawn.alpha)
        meshes.join(self._splats, self.rgb)
        return self.rgb


def columns_of(arrays: SplatArrays, columns: slice) -> SplatArrays:
    """Return some of the splats; shares memory."""
    turns = arrays.rotations if arrays.rotations.shape[1] == 1 else arrays.rotations[:, columns]
    named = {name: getattr(arrays, name)[:, columns] for name in ("means", "covariances", "opacities", "sh")}
    return replace(arrays, **named, object_index=arrays.object_index[columns], rotations=turns, spanning=None)


def _boxes(meshes: TriangleMeshes) -> dict[int, NDArray[np.float64]]:
    """Return the corners of the box around what each moving body carries, in its frame [m], shape (8, 3), by body."""
    found = {}
    for body in np.unique(meshes.bodies[meshes.bodies >= 0]).tolist():
        own = meshes.corners[meshes.bodies == body]
        found[body] = np.array(list(itertools.product(*zip(own.min(axis=0), own.max(axis=0), strict=True))))
    return found


def _triangles(
    model: newton.Model, state: newton.State, room: bool
) -> tuple[TriangleMeshes, NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
    """Return the meshes of a world, the first body of each world, and the box of what moves, or else of all [m]."""
    worlds = max(int(model.world_count), 1)
    given = host(model.body_world_start)
    starts = given[:worlds].astype(np.int32) if len(given) else np.zeros(worlds, np.int32)
    meshes = [mesh for mesh in scene_meshes(model, segments=SEGMENTS) if mesh.opacity > 0.5 and len(mesh.faces)]
    ends = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    empty = np.zeros((0, 3), np.float32)
    moved = [
        mesh.vertices @ rotations_from_quats(pose[3:]).T + pose[:3]
        for mesh, pose in zip(meshes, scene_poses(meshes, state), strict=True)
    ]
    box = [part for mesh, part in zip(meshes, moved, strict=True) if mesh.body >= 0] or moved or [np.zeros((1, 3))]
    bodies = [mesh.body - int(starts[0]) if mesh.body >= 0 else -1 for mesh in meshes]
    sizes = [len(mesh.faces) for mesh in meshes]
    wooden = [room and mesh.label == TABLE for mesh in meshes]
    tints = [WOOD if wood else mesh.color for mesh, wood in zip(meshes, wooden, strict=True)]
    triangles = TriangleMeshes(
        corners=np.concatenate([empty, *(mesh.vertices for mesh in meshes)]),
        normals=np.concatenate([empty, *(mesh.normals for mesh in meshes)]),
        faces=np.concatenate([empty.astype(np.int32), *(m.faces + e for m, e in zip(meshes, ends, strict=False))]),
        colors=np.repeat(np.array(tints, np.float32).reshape(-1, 3), sizes, axis=0),
        shapes=np.repeat(np.arange(len(meshes), dtype=np.int32), sizes),
        closed=np.repeat([_is_closed(mesh) for mesh in meshes], sizes),
        bodies=np.repeat(np.array(bodies, np.int32), [len(mesh.vertices) for mesh in meshes]),
        wooden=np.repeat(np.array(wooden, bool), sizes),
    )
    return triangles, starts, np.concatenate(box).min(axis=0), np.concatenate(box).max(axis=0)


def _is_closed(mesh: SceneMesh) -> bool:
    """Return whether every edge of a mesh is run through once each way, corners at one place being one corner."""
    _, place = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there, back = (np.unique(pairs, axis=0) for pairs in (edges, edges[:, ::-1]))
    return len(there) == len(edges) and np.array_equal(there, back)
