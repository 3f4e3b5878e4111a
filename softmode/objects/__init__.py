"""Soft objects: a body, its splats and its material, from files, stages and primitive shapes.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.config import ObjectConfig
    from softmode.objects.loader import load
    from softmode.objects.mesh_file import read_mesh
    from softmode.objects.mesh_fit import FitOptions, MeshFit, splats_from_mesh
    from softmode.objects.object_build import StifferBox, build_object
    from softmode.objects.object_file import surface_cover, write_object
    from softmode.objects.placed import Placed
    from softmode.objects.presets import (
        BEAM,
        BEAM_MATERIAL,
        CUBE,
        CUBE_MATERIAL,
        PAD,
        PAD_MATERIAL,
        ROPE,
        ROPE_MATERIAL,
    )
    from softmode.objects.soft_object import SoftObject

__all__ = [
    "BEAM",
    "BEAM_MATERIAL",
    "CUBE",
    "CUBE_MATERIAL",
    "PAD",
    "PAD_MATERIAL",
    "ROPE",
    "ROPE_MATERIAL",
    "FitOptions",
    "MeshFit",
    "ObjectConfig",
    "Placed",
    "SoftObject",
    "StifferBox",
    "build_object",
    "load",
    "read_mesh",
    "splats_from_mesh",
    "surface_cover",
    "write_object",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "BEAM": ".presets",
        "BEAM_MATERIAL": ".presets",
        "CUBE": ".presets",
        "CUBE_MATERIAL": ".presets",
        "FitOptions": ".mesh_fit",
        "MeshFit": ".mesh_fit",
        "ObjectConfig": ".config",
        "PAD": ".presets",
        "PAD_MATERIAL": ".presets",
        "Placed": ".placed",
        "ROPE": ".presets",
        "ROPE_MATERIAL": ".presets",
        "SoftObject": ".soft_object",
        "StifferBox": ".object_build",
        "build_object": ".object_build",
        "load": ".loader",
        "read_mesh": ".mesh_file",
        "splats_from_mesh": ".mesh_fit",
        "surface_cover": ".object_file",
        "write_object": ".object_file",
    },
)
