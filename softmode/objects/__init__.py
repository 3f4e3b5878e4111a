"""Soft objects: a body, its splats and its material, from files, stages and primitive shapes.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.config import ObjectConfig, StifferBox
    from softmode.objects.loader import load
    from softmode.objects.mesh_file import read_mesh
    from softmode.objects.mesh_fit import FitOptions, MeshFit, splats_from_mesh
    from softmode.objects.object_build import build_object
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

__getattr__, __dir__ = lazy_names(__name__)
