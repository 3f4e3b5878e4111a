"""Mesh files of any kind as coloured meshes."""

from __future__ import annotations

import os
from pathlib import Path

from softmode.errors import AssetError
from softmode.files import reader, require_content
from softmode.foreign import process, tokens
from softmode.splats.colored_mesh import ColoredMesh


@reader("mesh file")
def read_mesh(path: str | os.PathLike[str]) -> ColoredMesh:
    """Read a mesh file of any kind that trimesh reads (.obj, .glb, .gltf, .ply, .stl, .off, ...), with its textures.

    Of OpenUSD stages the visible meshes are read, with their display colours.

    Args:
        path: The file. The result keeps its frame and unit; that of a stage is in metres with z up.

    Raises:
        AssetError: If the file is missing, of an unknown kind, damaged, or holds no surface.
    """
    file = Path(path)
    if file.suffix.lower() in tokens.SUFFIXES:
        from softmode.objects.stage_asset import read_usd_mesh

        return read_usd_mesh(file)
    name = f"mesh file {file}"
    if not file.is_file():
        raise AssetError(f"{name}: no such file", hint="Check the path")
    require_content(file, "mesh file")
    answer = process.read("mesh", file, name=name, want="colors")
    textures = tuple(answer.arrays[k] for k in answer.described.pop("textures"))
    x, y, z = answer.described.pop("offset")
    arrays = {key: answer.arrays[k] for key, k in answer.described.items()}
    return ColoredMesh(**arrays, textures=textures, name=name, offset=(x, y, z))
