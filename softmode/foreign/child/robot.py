"""Write the rigid part of a stage as one crate for Newton's importer, with what that does not read of robots."""

from __future__ import annotations

import math
from typing import Any

from ..openusd import Prim, Stage, pxr
from .answer import Arrays, prims_of
from .copy import write_rest
from .deformables import find_bodies, find_ties, uninstance

_NUMBERS = ("ctrlRange:min", "ctrlRange:max", "forceRange:min", "forceRange:max")
_LISTS = ("gear", "gainPrm", "biasPrm")


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Write the crate; return MuJoCo's actuators and tendons, the joints driven by accelerations, and what is there.

    Args:
        stage: The stage.
        request: `copy`: where the crate goes.
        arrays: Takes nothing.
    """
    UsdGeom, UsdPhysics = pxr("UsdGeom", "UsdPhysics")
    meters, kilograms = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    uninstance(stage, every=meters != 1.0 or kilograms != 1.0)
    prims = list(prims_of(stage))
    bodies, left = find_bodies(prims, None, [])
    geometry = [str(prim.GetPath()) for body in bodies for prim in (body.geometry, *body.splats, *body.meshes)]
    paths = [str(body.prim.GetPath()) for body in bodies]
    write_rest(stage, prims, request["copy"], geometry, paths, find_ties(prims, left))
    return {
        "actuators": [_actuator(prim) for prim in prims if prim.GetTypeName() == "MjcActuator"],
        "tendons": [_tendon(prim) for prim in prims if prim.GetTypeName() == "MjcTendon"],
        "accelerations": [str(prim.GetPath()) for prim in prims if _by_acceleration(prim)],
        "articulations": sum(prim.HasAPI(UsdPhysics.ArticulationRootAPI) for prim in prims),
        "mimics": [found for prim in prims for found in _mimics(prim, meters)],
        "kinematic": [str(prim.GetPath()) for prim in prims if prim.GetAttribute("physics:kinematicEnabled").Get()],
        "deformables": [*paths, *(str(one.path) for one in left)],
    }


def _mimics(prim: Prim, meters: float) -> list[dict[str, Any]]:
    """Return the joints that one follows, and of PhysX's schema what it adds to the coordinate [rad or m]."""
    found = []
    for schema in map(str, prim.GetPrimTypeInfo().GetAppliedAPISchemas()):
        kind, _, axis = schema.partition(":")
        name = {"NewtonMimicAPI": "newton:mimicJoint", "PhysxMimicJointAPI": f"physxMimicJoint:{axis}:referenceJoint"}
        if kind in name:
            targets = [str(path) for path in prim.GetRelationship(name[kind]).GetTargets()]
            added = float(prim.GetAttribute(f"physxMimicJoint:{axis}:offset").Get() or 0.0) if axis else 0.0
            added *= math.pi / 180.0 if axis.startswith("rot") else meters
            found.append({"path": str(prim.GetPath()), "leader": targets, "offset": -added if axis else None})
    return found


def _by_acceleration(prim: Prim) -> bool:
    """Return whether a joint has a drive whose gains are accelerations, not forces."""
    named = (a for a in prim.GetAuthoredAttributes() if a.GetName().startswith("drive:"))
    return any(a.GetName().endswith(":physics:type") and str(a.Get()) == "acceleration" for a in named)


def _targets(prim: Prim, name: str) -> list[str]:
    """Return the paths that a relationship of MuJoCo's schema names."""
    return [str(path) for path in prim.GetRelationship(f"mjc:{name}").GetTargets()]


def _actuator(prim: Prim) -> dict[str, Any]:
    """Return what an MjcActuator says."""
    found: dict[str, Any] = {"path": str(prim.GetPath()), "target": _targets(prim, "target")}
    for name in _NUMBERS:
        found[name] = float(prim.GetAttribute(f"mjc:{name}").Get() or 0.0)
    for name in _LISTS:
        found[name] = [float(value) for value in prim.GetAttribute(f"mjc:{name}").Get() or ()]
    for name in ("biasType", "ctrlLimited", "forceLimited"):
        found[name] = str(prim.GetAttribute(f"mjc:{name}").Get() or "")
    return found


def _tendon(prim: Prim) -> dict[str, Any]:
    """Return the joints and coefficients of an MjcTendon."""
    joints, order = _targets(prim, "path"), prim.GetAttribute("mjc:path:indices").Get() or ()
    return {
        "path": str(prim.GetPath()),
        "kind": str(prim.GetAttribute("mjc:type").Get() or ""),
        "joints": [joints[k] for k in order] if len(order) else joints,
        "coefficients": [float(value) for value in prim.GetAttribute("mjc:path:coef").Get() or ()],
    }
