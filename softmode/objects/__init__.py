"""Soft objects: a body, its splats and its material, from files, stages, presets and primitive shapes.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.config import ObjectConfig, StifferBox
    from softmode.objects.cut import cut_object
    from softmode.objects.loader import load
    from softmode.objects.mesh_file import read_mesh
    from softmode.objects.mesh_fit import FitOptions, MeshFit, splats_from_mesh
    from softmode.objects.object_build import build_object
    from softmode.objects.object_file import surface_cover, write_object
    from softmode.objects.object_set import ObjectSet
    from softmode.objects.paint import StifferColor, color_field, nearest_field, read_field
    from softmode.objects.placed import Placed
    from softmode.objects.shapes.presets import PRESETS, Preset
    from softmode.objects.soft_object import SoftObject
    from softmode.objects.solids import Solid, filled, solid_names, solid_of
    from softmode.objects.task_objects import (
        BEAM,
        BEAM_MATERIAL,
        CUBE,
        CUBE_MATERIAL,
        PAD,
        PAD_MATERIAL,
        ROPE,
        ROPE_MATERIAL,
    )

__all__ = [
    "BEAM",
    "BEAM_MATERIAL",
    "CUBE",
    "CUBE_MATERIAL",
    "PAD",
    "PAD_MATERIAL",
    "PRESETS",
    "ROPE",
    "ROPE_MATERIAL",
    "FitOptions",
    "MeshFit",
    "ObjectConfig",
    "ObjectSet",
    "Placed",
    "Preset",
    "SoftObject",
    "Solid",
    "StifferBox",
    "StifferColor",
    "build_object",
    "color_field",
    "cut_object",
    "filled",
    "load",
    "nearest_field",
    "read_field",
    "read_mesh",
    "solid_names",
    "solid_of",
    "splats_from_mesh",
    "surface_cover",
    "write_object",
]

__getattr__, __dir__ = lazy_names(__name__)
