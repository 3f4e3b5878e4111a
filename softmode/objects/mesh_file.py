"""Mesh files of any kind as coloured meshes."""

from __future__ import annotations

import os
from pathlib import Path

from softmode.errors import AssetError
from softmode.files import require_content
from softmode.splats.colored_mesh import ColoredMesh
from softmode.stages import tokens


def read_mesh(path: str | os.PathLike[str]) -> ColoredMesh:
    """Read a mesh file of any kind that trimesh reads (.obj, .glb, .gltf, .ply, .stl, .off, ...), with its textures.

    Of OpenUSD stages the visible meshes are read, with their display colours.

    Args:
        path: The file. The result keeps its frame and unit; that of a stage is in metres with z up.

    Raises:
        AssetError: If the file is missing, of an unknown kind, damaged, or holds no surface.
    """
    import trimesh

    file = Path(path)
    if file.suffix.lower() in tokens.SUFFIXES:
        from softmode.objects.stage_asset import read_usd_mesh

        return read_usd_mesh(file)
    name = f"mesh file {file}"
    if not file.is_file():
        raise AssetError(f"{name}: no such file", hint="Check the path")
    known = sorted(set(trimesh.available_formats()))
    if file.suffix.lower().lstrip(".") not in known:
        hint = f"Readable here are {', '.join('.' + kind for kind in known)}; convert others to .glb"
        raise AssetError(f"{name}: unknown kind {file.suffix or '(no suffix)'!r}", hint=hint)
    require_content(file, name)
    try:
        scene = trimesh.load_scene(file)
    except Exception as error:  # its readers raise whatever a damaged file leads them to
        hint = "The file is damaged or incomplete: copy or export it again"
        raise AssetError(f"{name}: cannot be read ({type(error).__name__}: {error})", hint=hint) from error
    return ColoredMesh.from_trimesh(scene, name=name)
