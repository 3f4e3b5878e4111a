"""Read what a stage shows by meshes, and tell what else it holds."""

from __future__ import annotations

from typing import Any

from .. import tokens
from ..openusd import Stage, pxr
from .answer import Arrays, prims_of
from .appearance import Pictures
from .deformables import visible
from .instancers import expand
from .scene import geometry_of
from .splats import flat
from .unread import other_units, unread


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return the visible Mesh prims, or the TetMesh prims where there is none; guides and proxies are not looked at.

    Args:
        stage: The stage.
        request: `geometry`: whether to send the meshes, or only to count.
        arrays: Takes the arrays.
    """
    Usd, UsdGeom, UsdPhysics = pxr("Usd", "UsdGeom", "UsdPhysics")
    copies = expand(stage)
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    prims = list(prims_of(stage))
    shown = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    meshes = [
        prim
        for prim in prims
        if prim.GetTypeName() == tokens.MESH and visible(prim) and UsdGeom.Imageable(prim).ComputePurpose() in shown
    ] or [prim for prim in prims if prim.GetTypeName() == tokens.TET_MESH]
    pictures = Pictures(arrays, request["budget"])
    sent = [
        {
            "kind": str(prim.GetTypeName()),
            "matrix": flat(transforms.GetLocalToWorldTransform(prim)),
            **geometry_of(prim, time, arrays, pictures),
        }
        for prim in (meshes if request["geometry"] else ())
    ]
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "kilograms": UsdPhysics.GetStageKilogramsPerUnit(stage),
        "meshes": sent,
        "warnings": other_units(stage, prims),
        "notes": [*copies, *unread(prims, [str(prim.GetPath()) for prim in meshes])],
        "splat_count": sum(prim.GetTypeName() == tokens.SPLATS and visible(prim) for prim in prims),
        "body_count": sum(bool(prim.GetAttribute(tokens.FORMAT)) for prim in prims),
    }
