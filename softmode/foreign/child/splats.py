"""Read the visible `ParticleField3DGaussianSplat` prims of a stage."""

from __future__ import annotations

from typing import Any

from ..openusd import Prim, Stage, Value, pxr
from .answer import Arrays, prims_of
from .instancers import expand
from .unread import other_units, unread

_ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return what the stage and each splat prim say.

    Args:
        stage: The stage.
        request: `time` (a time code, None for the earliest) and `most`, the largest number of splats.
        arrays: Takes the arrays.
    """
    Usd, UsdGeom = pxr("Usd", "UsdGeom")
    code = request["time"]
    time = Usd.TimeCode.EarliestTime() if code is None else Usd.TimeCode(code)
    copies = expand(stage)
    transforms = UsdGeom.XformCache(time)
    prims: list[dict[str, Any]] = []
    total = 0
    for prim in prims_of(stage):
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        found, count = read_prim(prim, time, arrays, request["most"] - total)
        total += count
        prims.append({**found, "matrix": flat(transforms.GetLocalToWorldTransform(prim))})
    everything = list(prims_of(stage))
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "prims": prims,
        "warnings": other_units(stage, everything),
        "notes": [*copies, *unread(everything, [prim["path"] for prim in prims])],
    }


def read_prim(prim: Prim, time: Value, arrays: Arrays, most: int) -> tuple[dict[str, Any], int]:
    """Return what a splat prim says, and its number of splats."""
    found: dict[str, int] = {}
    spaces: list[str] = []
    count = 0
    for name in _ARRAYS:
        for candidate in (name, name + "h"):  # the half variant counts where the float one has no value
            attribute = prim.GetAttribute(candidate)
            value = attribute.Get(time) if attribute else None
            if value is not None and len(value):
                if name == "positions":
                    count = len(value)
                if count > most:
                    raise ValueError("holds more splats than softmode takes")
                found[name] = arrays.add(value)
                spaces += [attribute.GetColorSpace()] if name.startswith("radiance") else []
                break
    return {
        "path": str(prim.GetPath()),
        "degree": prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(),
        "color_space": "".join(spaces),
        "splats": found,
    }, count


def flat(matrix: Value) -> list[float]:
    """Return the rows of a matrix one after the other."""
    return [x for row in matrix for x in row]
