"""Make the copies of PointInstancers ordinary prims, in the session."""

from __future__ import annotations

from ..openusd import Prim, Stage, Value, pxr
from .limits import MAX_DEPTH, Refused

MAX_COPIES = 4096
"""Most copies that instancers may make of what is simulated or shown."""
_HINT = "Give every instance a position and the number of a prototype"


def expand(stage: Stage) -> list[str]:
    """Put each instance beneath its instancer, where it is, and take prototypes off the stage; return notes.

    Inner instancers go first, so that copies of a prototype hold theirs. Masked instances (inactive, invisible) are
    left out. A prototype is none of the copies, wherever it lies.

    Args:
        stage: The stage; its session layer is changed.

    Raises:
        Refused: If indices, positions and prototypes do not fit, an instancer copies itself, or there are too many.
    """
    Usd, UsdGeom = pxr("Usd", "UsdGeom")
    from .answer import prims_of

    notes: list[str] = []
    total = 0
    prototypes: set[str] = set()
    stage.SetEditTarget(stage.GetSessionLayer())
    time = Usd.TimeCode.EarliestTime()
    for _ in range(MAX_DEPTH):
        found = [prim for prim in prims_of(stage) if prim.GetTypeName() == "PointInstancer"]
        if not found:
            break
        proxies = [prim for prim in found if prim.IsInstanceProxy()]
        for prim in proxies:
            while prim.IsInstanceProxy():
                prim = prim.GetParent()
            prim.SetInstanceable(False)
        if proxies:
            continue
        paths = [prim.GetPath() for prim in found]
        for prim in found:
            instancer = UsdGeom.PointInstancer(prim)
            targets = list(instancer.GetPrototypesRel().GetForwardedTargets())
            if any(prim.GetPath().HasPrefix(target) for target in targets):
                raise Refused(f"{prim.GetPath()}: copies itself", "Take the instancer out of its prototype")
            if any(path.HasPrefix(target) for path in paths for target in targets):
                continue  # later, when the inner one has been replaced
            total += _copy(prim, targets, time, total)
            prototypes.update(str(target) for target in targets)
            beside = [t for t in targets if not t.HasPrefix(prim.GetPath()) and _drawn(stage.GetPrimAtPath(t))]
            notes += [
                f"{target}: a prototype of {prim.GetPath()}, which is simulated and shown as copies only"
                for target in beside
            ]
            break
        else:
            raise Refused(f"{paths[0]}: copies itself", "Take the instancer out of its prototype")
    for path in prototypes:
        stage.GetPrimAtPath(path).SetActive(False)
    return notes


def _copy(prim: Prim, targets: list[Value], time: Value, before: int) -> int:
    """Replace an instancer by its copies; return their number."""
    (UsdGeom,) = pxr("UsdGeom")
    stage, instancer = prim.GetStage(), UsdGeom.PointInstancer(prim)
    indices, positions = instancer.GetProtoIndicesAttr().Get(time) or (), instancer.GetPositionsAttr().Get(time) or ()
    where = f"{prim.GetPath()}:"
    if len(indices) != len(positions):
        raise Refused(f"{where} {len(indices)} protoIndices for {len(positions)} positions", _HINT)
    if len(indices) and not (0 <= min(indices) and max(indices) < len(targets)):
        raise Refused(f"{where} protoIndices {min(indices)}..{max(indices)} for {len(targets)} prototypes", _HINT)
    if missing := [target for target in targets if not stage.GetPrimAtPath(target)]:
        raise Refused(f"{where} its prototype {missing[0]} does not exist", "Name prims in its prototypes")
    if before + len(indices) > MAX_COPIES:
        raise Refused(f"{where} more than {MAX_COPIES} copies with those of others", "Import a part of them")
    for name in ("orientations", "orientationsf", "scales"):
        given = prim.GetAttribute(name).Get(time) if prim.GetAttribute(name) else None
        if given is not None and len(given) not in (0, len(indices)):
            raise Refused(f"{where} {len(given)} {name} for {len(indices)} instances", _HINT)
    kind = UsdGeom.PointInstancer
    transforms = instancer.ComputeInstanceTransformsAtTime(time, time, kind.IncludeProtoXform, kind.IgnoreMask)
    mask = list(instancer.ComputeMaskAtTime(time)) or [True] * len(indices)
    prim.SetTypeName("Xform")
    count = 0
    for number, (index, matrix, shown) in enumerate(zip(indices, transforms, mask, strict=True)):
        if not shown:
            continue
        target = targets[index]
        copy = stage.DefinePrim(prim.GetPath().AppendChild(f"{target.name}_{number}"))
        copy.GetReferences().AddInternalReference(target)
        copy.SetActive(True)
        if not UsdGeom.Xformable(copy):  # a scope, or no type at all
            copy.SetTypeName("Xform")
        UsdGeom.Xformable(copy).MakeMatrixXform().Set(matrix)
        count += 1
    return count


def _drawn(prim: Prim) -> bool:
    """Return whether a prim would be drawn by itself."""
    (UsdGeom,) = pxr("UsdGeom")
    plain = prim.IsDefined() and not prim.IsAbstract()
    return plain and UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible
