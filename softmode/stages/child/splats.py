"""Read the visible `ParticleField3DGaussianSplat` prims of a stage."""

from __future__ import annotations

import importlib
from typing import Any

_ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")


def read(stage: Any, request: dict[str, Any], arrays: Any) -> dict[str, Any]:
    """Return what the stage and each splat prim say.

    Args:
        stage: The stage.
        request: `time` (a time code, None for the earliest) and `most`, the largest number of splats.
        arrays: Takes the arrays.
    """
    Usd, UsdGeom = (importlib.import_module(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    answer = importlib.import_module(".answer", __package__)
    code = request["time"]
    time = Usd.TimeCode.EarliestTime() if code is None else Usd.TimeCode(code)
    transforms = UsdGeom.XformCache(time)
    prims: list[dict[str, Any]] = []
    total = 0
    for prim in answer.prims_of(stage):
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        found, count = read_prim(prim, time, arrays, request["most"] - total)
        total += count
        prims.append({**found, "matrix": flat(transforms.GetLocalToWorldTransform(prim))})
    return {"up": str(UsdGeom.GetStageUpAxis(stage)), "meters": UsdGeom.GetStageMetersPerUnit(stage), "prims": prims}


def read_prim(prim: Any, time: Any, arrays: Any, most: int) -> tuple[dict[str, Any], int]:
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


def flat(matrix: Any) -> list[float]:
    """Return the rows of a matrix one after the other."""
    return [x for row in matrix for x in row]
