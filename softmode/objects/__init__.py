"""Soft objects: a body, its splats and its material, from files, stages, presets and primitive shapes.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.objects.config import ObjectConfig as ObjectConfig
    from softmode.objects.config import StifferBox as StifferBox
    from softmode.objects.cut import cut_object as cut_object
    from softmode.objects.frame import file_frame as file_frame
    from softmode.objects.loader import build_object as build_object
    from softmode.objects.loader import load as load
    from softmode.objects.mesh_file import read_mesh as read_mesh
    from softmode.objects.mesh_fit import FitOptions as FitOptions
    from softmode.objects.mesh_fit import MeshFit as MeshFit
    from softmode.objects.mesh_fit import splats_from_mesh as splats_from_mesh
    from softmode.objects.models import EXCAVATOR_BUCKET as EXCAVATOR_BUCKET
    from softmode.objects.models import EXCAVATOR_HINGES as EXCAVATOR_HINGES
    from softmode.objects.models import MODELS as MODELS
    from softmode.objects.models import load_model as load_model
    from softmode.objects.object_file import surface_cover as surface_cover
    from softmode.objects.object_file import write_object as write_object
    from softmode.objects.object_set import ObjectSet as ObjectSet
    from softmode.objects.paint import StifferColor as StifferColor
    from softmode.objects.paint import color_field as color_field
    from softmode.objects.paint import nearest_field as nearest_field
    from softmode.objects.paint import read_field as read_field
    from softmode.objects.placed import Placed as Placed
    from softmode.objects.shapes.presets import PRESETS as PRESETS
    from softmode.objects.shapes.presets import Preset as Preset
    from softmode.objects.soft_object import SoftObject as SoftObject
    from softmode.objects.solids import Solid as Solid
    from softmode.objects.solids import filled as filled
    from softmode.objects.solids import solid_names as solid_names
    from softmode.objects.solids import solid_of as solid_of
    from softmode.objects.task_objects import BEAM as BEAM
    from softmode.objects.task_objects import BEAM_MATERIAL as BEAM_MATERIAL
    from softmode.objects.task_objects import CUBE as CUBE
    from softmode.objects.task_objects import CUBE_MATERIAL as CUBE_MATERIAL
    from softmode.objects.task_objects import PAD as PAD
    from softmode.objects.task_objects import PAD_MATERIAL as PAD_MATERIAL
    from softmode.objects.task_objects import ROPE as ROPE
    from softmode.objects.task_objects import ROPE_MATERIAL as ROPE_MATERIAL

__getattr__, __dir__ = lazy_names(__name__)
