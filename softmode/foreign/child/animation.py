"""Read the bodies that softmode wrote, with their splats at rest and the time samples of their handles."""

from __future__ import annotations

from typing import Any

from .. import tokens
from ..openusd import Stage, Value, pxr
from .answer import Arrays, prims_of
from .limits import Refused
from .scene import bundle_of
from .splats import read_prim

MAX_FRAMES = 1_000_000
"""Most time samples that a body may have."""


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return each body with its samples.

    Args:
        stage: The stage.
        request: `most`, the largest number of splats.
        arrays: Takes the arrays.
    """
    Usd, UsdGeom, Vt = pxr("Usd", "UsdGeom", "Vt")
    most = request["most"]
    bodies = []
    for prim in prims_of(stage):
        found = bundle_of(prim, arrays)
        handles = prim.GetAttribute(tokens.HANDLES)
        if found is None or not handles or not handles.GetNumTimeSamples():
            continue
        codes = handles.GetTimeSamples()
        if len(codes) > MAX_FRAMES:
            raise Refused(f"{prim.GetPath()}: has more than {MAX_FRAMES} time samples", "Record a shorter animation")
        more = prim.GetAttribute(tokens.HANDLES_QUADRATIC)
        dents = [prim.GetAttribute(name) for name in (tokens.DENT_SAMPLES, tokens.DENTS)]
        transforms = [UsdGeom.XformCache(Usd.TimeCode(code)).GetLocalToWorldTransform(prim) for code in codes]
        splats = None
        for child in prim.GetChildren():
            if child.GetTypeName() == tokens.SPLATS and splats is None:
                splats, count = read_prim(child, Usd.TimeCode.Default(), arrays, most)
                most -= count
        bodies.append(
            {
                "path": str(prim.GetPath()),
                "bundle": found,
                "splats": splats,
                "codes": arrays.add(Vt.DoubleArray(codes)),
                "places": arrays.add(Vt.Matrix4dArray(transforms)),
                "handles": [arrays.add(handles.Get(code)) for code in codes],
                "quadratic": [arrays.add(more.Get(code)) for code in codes] if more else [],
                "dents": [[_some(part.Get(code), arrays) for part in dents] for code in codes] if all(dents) else [],
            }
        )
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "rate": stage.GetTimeCodesPerSecond(),
        "bodies": bodies,
    }


def _some(values: Value, arrays: Arrays) -> int:
    """Add an array; return its number, -1 if it is empty."""
    return arrays.add(values) if len(values) else -1
