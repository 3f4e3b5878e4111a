"""What of a stage is not read, or taken in another unit than it was meant in."""

from __future__ import annotations

from ..openusd import Prim, Stage, Value, pxr
from .deformables import visible


def unread(prims: list[Prim], used: list[str]) -> list[str]:
    """Return a note on each visible prim that is geometry and not among those used."""
    (UsdGeom,) = pxr("UsdGeom")
    shown = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    left = [prim for prim in prims if prim.IsA(UsdGeom.Gprim) and str(prim.GetPath()) not in used and visible(prim)]
    left = [prim for prim in left if UsdGeom.Imageable(prim).ComputePurpose() in shown]
    return [f"{prim.GetPath()}: a {prim.GetTypeName()}, which is not read" for prim in left]


def other_units(stage: Stage, prims: list[Prim]) -> list[str]:
    """Return a warning for each prim from a layer of another unit or axis: OpenUSD takes its numbers as they are.

    A prim that scales the difference away is in order.
    """
    Gf, UsdGeom = pxr("Gf", "UsdGeom")
    expected = {"metersPerUnit": UsdGeom.GetStageMetersPerUnit(stage), "upAxis": str(UsdGeom.GetStageUpAxis(stage))}
    roots = [layer.pseudoRoot for layer in stage.GetUsedLayers()]
    if all(not root.HasInfo(name) or root.GetInfo(name) == value for root in roots for name, value in expected.items()):
        return []
    said: dict[str, set[Value]] = {}
    found = []
    for prim in prims:
        for spec in prim.GetPrimStack():
            root, layer = spec.layer.pseudoRoot, spec.layer.GetDisplayName()
            inside = said.setdefault(layer, set())
            if any(prim.GetPath().HasPrefix(path) for path in inside):
                continue
            given = {name: root.GetInfo(name) for name in expected if root.HasInfo(name)}
            differ = [name for name, value in given.items() if value != expected[name]]
            if not differ:
                continue
            inside.add(prim.GetPath())
            ratio = float(given.get("metersPerUnit", expected["metersPerUnit"])) / float(expected["metersPerUnit"])
            local = UsdGeom.Xformable(prim).GetLocalTransformation() if prim.IsA(UsdGeom.Xformable) else Gf.Matrix4d(1)
            if abs(abs(local.GetDeterminant3()) - ratio**3) < 1e-3 * ratio**3 and ratio != 1.0:
                differ.remove("metersPerUnit")
            for name in differ:
                remedy = f"scale the prim by {ratio:g}" if name == "metersPerUnit" else "turn the prim"
                found.append(
                    f"{prim.GetPath()}: comes from {layer}, whose {name} is {given[name]}; the stage's is"
                    f" {expected[name]} and nothing converts it: {remedy}, or set {name} of both alike"
                )
    return found
