"""Read fields of material: `Points` prims with primvars."""

from __future__ import annotations

from typing import Any

from .. import tokens
from ..openusd import Stage, pxr
from .answer import Arrays, prims_of
from .splats import flat


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return the arrays of the `Points` prims that have one of the primvars.

    Args:
        stage: The stage.
        request: `primvars`: of each property its names, without "primvars:".
        arrays: Takes the arrays.
    """
    Usd, UsdGeom = pxr("Usd", "UsdGeom")
    time = Usd.TimeCode.EarliestTime()
    transforms, prims = UsdGeom.XformCache(time), []
    for prim in prims_of(stage):
        if prim.GetTypeName() != tokens.POINTS:
            continue
        found = {}
        for name, spelled in request["primvars"].items():
            values = (UsdGeom.Primvar(prim.GetAttribute(f"primvars:{key}")) for key in spelled)
            value = next((v.ComputeFlattened(time) for v in values if v and v.HasValue()), None)
            if value is not None:
                found[name] = arrays.add(value)
        points = prim.GetAttribute("points").Get(time)
        if found and points is not None:
            matrix = flat(transforms.GetLocalToWorldTransform(prim))
            prims.append({"points": arrays.add(points), "values": found, "matrix": matrix})
    up, meters = str(UsdGeom.GetStageUpAxis(stage)), UsdGeom.GetStageMetersPerUnit(stage)
    return {"up": up, "meters": meters, "prims": prims}
