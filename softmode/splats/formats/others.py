"""Kinds of files that softmode does not read, and the command that turns each into one that it does."""

from __future__ import annotations

from pathlib import Path

from softmode.errors import AssetError

_TRANSFORM = "npx @playcanvas/splat-transform {file} {stem}.ply"
_NERFSTUDIO = "ns-export gaussian-splat --load-config CONFIG.yml --output-dir ."
_FIELD = "; or sample its field: softmode radiance sample MODULE:FUNCTION {stem}.npz"
_OPEN3D = "python -c \"import open3d as o; o.io.write_point_cloud('{stem}.ply', o.io.read_point_cloud('{file}'))\""
_BLENDER = "blender -b --python-expr \"import bpy; bpy.ops.{load}; bpy.ops.export_scene.gltf(filepath='{{stem}}.glb')\""
_GMSH = "gmsh -2 {file} -o {stem}.stl"
OTHERS: dict[str, tuple[str, str]] = {
    ".ksplat": ("splats of mkkellogg's viewer", _TRANSFORM),
    ".lcc": ("splats of XGRIDS", _TRANSFORM),
    **dict.fromkeys((".ckpt", ".pt", ".pth"), ("a checkpoint of a training", _NERFSTUDIO + _FIELD)),
    **dict.fromkeys((".yml", ".yaml"), ("a configuration of nerfstudio", _NERFSTUDIO.replace("CONFIG.yml", "{file}"))),
    **dict.fromkeys(
        (".ingp", ".msgpack"),
        ("a snapshot of instant-ngp", "python scripts/run.py --load_snapshot {file} --save_mesh {stem}.obj" + _FIELD),
    ),
    ".th": ("a checkpoint of TensoRF", "python train.py --ckpt {file} --export_mesh 1 --render_only 1" + _FIELD),
    ".vdb": ("a volume of OpenVDB", "nanovdb_convert {file} {stem}.nvdb"),
    ".npy": (
        "an array without a name",
        "python -c \"import numpy as np; np.savez('{stem}.npz', points=np.load('{file}')[:, :3])\"",
    ),
    **dict.fromkeys((".pcd", ".pts"), ("a point cloud", _OPEN3D)),
    **dict.fromkeys((".las", ".laz", ".e57"), ("a scan", "pdal translate {file} {stem}.ply")),
    ".fbx": ("a scene", _BLENDER.format(load="import_scene.fbx(filepath='{file}')")),
    ".blend": ("a scene of Blender", _BLENDER.format(load="wm.open_mainfile(filepath='{file}')")),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), ("solids of a CAD program", _GMSH)),
    ".msh": ("a volume mesh", _GMSH),
}
"""What a file of each suffix is, and what turns it into a kind that is read."""


def refuse_others(path: Path) -> None:
    """Refuse a kind that is known and not read.

    Raises:
        AssetError: If it is one; the hint is the command that converts it.
    """
    if (known := OTHERS.get(path.suffix.lower())) is not None:
        hint = f"convert it: {known[1].format(file=path, stem=path.stem)}"
        raise AssetError(f"file {path}: {known[0]}, which softmode does not read", hint=hint)
