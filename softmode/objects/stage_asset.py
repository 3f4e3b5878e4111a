"""A stage as one object: the body that softmode wrote, its splats, or its meshes."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Literal

import numpy as np

from softmode.errors import AssetError
from softmode.files import damage_errors
from softmode.foreign import process
from softmode.foreign.child.surface import near_zero
from softmode.objects.soft_object import SoftObject
from softmode.objects.stage.bundle import body_of
from softmode.objects.stage.geometry import SurfaceMesh, mesh_surface, tet_surface
from softmode.objects.stage.scene import parts_of, read_usd_scene, stage_frame, warned
from softmode.splats.colored_mesh import ColoredMesh


def asset_kind(path: str | os.PathLike[str]) -> Literal["body", "splat", "mesh"]:
    """Return what the object in a stage is read from: the body that softmode wrote, splats, else meshes.

    Raises:
        AssetError: If the file is damaged, or holds several bodies that softmode wrote.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    stage = _ask(path, geometry=False).described
    if stage["body_count"] > 1:
        raise AssetError(
            f"OpenUSD file {path}: holds {stage['body_count']} bodies", hint="Write one body per file, or use add_usd"
        )
    return "body" if stage["body_count"] else "splat" if stage["splat_count"] else "mesh"


def read_usd_body(path: str | os.PathLike[str]) -> SoftObject:
    """Read the body that softmode wrote into a stage, as it is, with its splats and material.

    Args:
        path: A stage with one such body; its place and scale are not asked for.

    Raises:
        AssetError: If the file is damaged, or holds no or several such bodies.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    found = [body for body in read_usd_scene(path).deformables if body.bundle is not None]
    if len(found) != 1 or found[0].bundle is None:
        raise AssetError(
            f"OpenUSD file {path}: holds {len(found)} bodies of softmode", hint="Write one with softmode.usd.write_usd"
        )
    body = body_of(found[0].bundle, f"OpenUSD file {path}: {found[0].path}")
    material = found[0].material(body.volume * found[0].scale ** 3)
    return SoftObject(body=body, splats=found[0].splats, material=material, notes=found[0].notes)


def read_usd_mesh(path: str | os.PathLike[str]) -> ColoredMesh:
    """Read the visible meshes of a stage, or its tetrahedral ones where there is none, in metres with z up.

    Colours are those of UsdPreviewSurface materials, with their textures, else `primvars:displayColor`.

    Args:
        path: A `.usd`, `.usda`, `.usdc` or `.usdz` file.

    Raises:
        AssetError: If the file is damaged or holds no surface.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    name = f"OpenUSD file {path}"
    answer = _ask(path, geometry=True)
    frame = stage_frame(answer.described, name)
    surfaces = []
    with damage_errors(name):
        for prim in answer.described["meshes"]:
            where, parts = f"{name}: {prim['path']}", parts_of(prim, answer.arrays, frame)
            matrix = frame.matrix(prim["matrix"])
            if not np.isfinite(matrix).all():
                raise AssetError(f"{where}: its transform is not finite", hint="Mend its xformOps")
            if prim["kind"] == "Mesh":
                surfaces.append(mesh_surface(parts, matrix[:3, :3], where, matrix[:3, 3]))
            else:
                surfaces.append(tet_surface(parts, matrix[:3, :3], where, matrix[:3, 3]))
    if not surfaces:
        raise AssetError(f"{name}: holds no visible mesh", hint="Export splats, or a closed Mesh that is visible")
    mesh = colored_mesh(surfaces, name)
    told = (*warned(answer.described["warnings"], name), *answer.described["notes"], *mesh.notes)
    return replace(mesh, notes=told)


def colored_mesh(surfaces: list[SurfaceMesh], name: str) -> ColoredMesh:
    """Return surfaces as one mesh in display colours, which are linear in OpenUSD and gamma-encoded in splats."""
    linear = np.concatenate([mesh.colors for mesh in surfaces])
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055)
    corners, offset = near_zero(np.concatenate([mesh.vertices[mesh.faces] for mesh in surfaces]).reshape(-1, 3))
    starts = np.cumsum([0, *(len(mesh.pictures) for mesh in surfaces)])
    shown = [
        np.where(mesh.picture < 0, -1, mesh.picture + start) for mesh, start in zip(surfaces, starts, strict=False)
    ]
    return ColoredMesh(
        corners=corners.reshape(-1, 3, 3).astype(np.float32),
        corner_colors=encoded.astype(np.float32),
        corner_uvs=np.concatenate([mesh.uvs for mesh in surfaces]).astype(np.float32),
        texture_index=np.concatenate(shown).astype(np.int32),
        textures=tuple(picture for mesh in surfaces for picture in mesh.pictures),
        name=name,
        offset=offset,
        notes=tuple(note for mesh in surfaces for note in mesh.notes),
    )


def _ask(path: str | os.PathLike[str], *, geometry: bool) -> process.Answer:
    """Have the process of its own look at a stage."""
    return process.read("asset", path, name=f"OpenUSD file {path}", strict=True, geometry=geometry)
