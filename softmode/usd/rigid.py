"""The rigid shapes of a world, robots and table, on a stage: meshes once, places as time samples."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
from numpy.typing import NDArray

from softmode.foreign.openusd import Stage
from softmode.scenes.meshes import SceneMesh, scene_meshes
from softmode.splats.splats import rotations_from_quats
from softmode.usd.openusd import openusd
from softmode.usd.writer import prim_name, set_place, vectors

ROOT = "/World/Rigid"


class RigidMeshes:
    """The meshes of the visible rigid shapes of a world and where their bodies were.

    Args:
        model: The model.
        world: Which world.
    """

    def __init__(self, model: newton.Model, world: int) -> None:
        """Make the meshes."""
        self._model = model
        self._meshes = scene_meshes(model, world=world)
        self._bodies = sorted({mesh.body for mesh in self._meshes})
        self._poses: list[NDArray[Any]] = []

    def record(self, state: newton.State) -> None:
        """Note where the bodies are in a state."""
        moving = [body for body in self._bodies if body >= 0]
        poses = state.body_q
        self._poses.append(np.zeros((0, 7), np.float32) if poses is None or not moving else poses.numpy()[moving])

    def author(self, stage: Stage, codes: list[float]) -> None:
        """Author one Xform per body with the meshes that it carries, sampled where it moves."""
        if not self._meshes:
            return
        (UsdGeom,) = openusd("UsdGeom")
        UsdGeom.Xform.Define(stage, ROOT)
        poses = np.array(self._poses)
        seen: set[str] = set()
        moving = [body for body in self._bodies if body >= 0]
        for body in self._bodies:
            label = "world" if body < 0 else str(self._model.body_label[body]).rpartition("/")[2]
            path = f"{ROOT}/{prim_name(label, seen)}"
            xform = UsdGeom.Xform.Define(stage, path)
            inner: set[str] = set()
            for mesh in self._meshes:
                if mesh.body == body:
                    _author_mesh(stage, f"{path}/{prim_name(mesh.label.rpartition('/')[2], inner)}", mesh)
            if body < 0:
                continue
            track = poses[:, moving.index(body)].astype(np.float64)
            still = bool((track == track[0]).all())
            rotations = rotations_from_quats(track[:, 3:])
            set_place(xform, track[0, :3], rotations[0], 1.0)
            for f, code in enumerate([] if still else codes):
                set_place(xform, track[f, :3], rotations[f], 1.0, code)


def _author_mesh(stage: Stage, path: str, mesh: SceneMesh) -> None:
    """Author a triangle mesh."""
    UsdGeom, Vt = openusd("UsdGeom", "Vt")
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreatePointsAttr(vectors(mesh.vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).reshape(-1)))
    prim.CreateNormalsAttr(vectors(mesh.normals))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateExtentAttr(vectors(np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])))
    # Display colours are linear in OpenUSD.
    color = np.array([mesh.color], dtype=np.float64)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    prim.CreateDisplayColorAttr(vectors(linear))
    if mesh.opacity < 1.0:
        prim.CreateDisplayOpacityAttr(Vt.FloatArray([mesh.opacity]))
