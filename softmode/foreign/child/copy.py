"""Write a stage without its soft solids as one crate in metres and kilograms, checked, for Newton's importer."""

from __future__ import annotations

import importlib
from typing import Any

from .. import tokens
from ..openusd import Attribute, Layer, Prim, Stage, Value, pxr
from .limits import Refused

_MEND = "Mend or remove the prim"
_LENGTH, _MASS = (1, 0), (0, 1)
_FORCE, _TORQUE, _PRESSURE = (1, 1), (2, 1), (-1, 1)
_UNITS = {
    "physics:density": (-3, 1),
    "physics:mass": _MASS,
    "physics:diagonalInertia": (2, 1),
    "physics:gravityMagnitude": _LENGTH,
    "physics:velocity": _LENGTH,
    "physics:minDistance": _LENGTH,
    "physics:maxDistance": _LENGTH,
    "physics:breakForce": _FORCE,
    "physics:breakTorque": _TORQUE,
    "physics:masses": _MASS,
    "physics:thicknesses": _LENGTH,
    "physics:youngsModulus": _PRESSURE,
    "physics:surfaceThickness": _LENGTH,
    "physics:surfaceStretchStiffness": _MASS,
    "physics:surfaceShearStiffness": _MASS,
    "physics:surfaceBendStiffness": _TORQUE,
    "newton:mpm:youngsModulus": _PRESSURE,
    "newton:mpm:yieldPressure": _PRESSURE,
    "newton:mpm:yieldStress": _PRESSURE,
    "newton:mpm:elasticDamping": _PRESSURE,
    "newton:mpm:viscosity": _PRESSURE,
}
"""Powers of length and mass in the units of attributes; positions in a body's frame scale with the frame."""
_PRISMATIC = {"physics:lowerLimit": _LENGTH, "physics:upperLimit": _LENGTH}
_LINEAR = ("linear", "transX", "transY", "transZ", "distance")
_OF_LINEAR = {
    "physics:low": _LENGTH,
    "physics:high": _LENGTH,
    "physics:targetPosition": _LENGTH,
    "physics:targetVelocity": _LENGTH,
    "physics:stiffness": _MASS,
    "physics:damping": _MASS,
    "physics:maxForce": _FORCE,
}
_OF_ANGULAR = {"physics:stiffness": _TORQUE, "physics:damping": _TORQUE, "physics:maxForce": _TORQUE}


def write_rest(
    stage: Stage, prims: list[Prim], path: str, geometries: list[str], bodies: list[str], between: list[tuple[str, str]]
) -> None:
    """Flatten a stage without its deformables into a crate.

    Newton's importer opens files with OpenUSD in the user's process. What it gets is this crate: composed, with indices
    and numbers checked here, and written by OpenUSD itself: no byte of the original reaches a parser there.

    Args:
        stage: The stage.
        prims: All its prims.
        path: Where the crate goes.
        geometries: Prims that are deformables' geometry, deactivated in the copy.
        bodies: Prims that are deformable bodies; their schemas are taken off.
        between: What ties deformables to others, deactivated too.
    """
    Sdf, Usd, UsdGeom, UsdPhysics = pxr("Sdf", "Usd", "UsdGeom", "UsdPhysics")
    skipped = set(geometries)
    for prim in prims:
        if str(prim.GetPath()) not in skipped:
            _check(prim)
    layer = stage.Flatten(False)
    for name in (*geometries, *(name for name, _ in between)):
        spec = layer.GetPrimAtPath(name)
        if spec is not None:
            spec.active = False
    deformable = {*tokens.BODY_APIS, *tokens.SIM_APIS}
    for name in bodies:
        spec = layer.GetPrimAtPath(name)
        if spec is not None and spec.HasInfo("apiSchemas"):
            left = [item for item in spec.GetInfo("apiSchemas").GetAppliedItems() if item not in deformable]
            spec.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit(left))
    _hold_still(layer)
    meters, kilograms = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    if meters != 1.0 or kilograms != 1.0:
        _convert(Usd.Stage.Open(layer), meters, kilograms)
    if not layer.Export(path):
        raise Refused("cannot be flattened", "Flatten it with usdcat --flatten")


def _hold_still(layer: Layer) -> None:
    """Give what has time samples the value of the first: Newton reads defaults, deformables are read at that time."""

    def visit(path: Value) -> None:
        times = layer.ListTimeSamplesForPath(path) if path.IsPropertyPath() else ()
        if times:
            layer.GetAttributeAtPath(path).default = layer.QueryTimeSample(path, times[0])
            for time in times:
                layer.EraseTimeSample(path, time)

    layer.Traverse("/", visit)


def _check(prim: Prim) -> None:
    """Refuse numbers that are not finite where geometry or physics needs them, and indices that point nowhere."""
    numpy = importlib.import_module("numpy")
    first = pxr("Usd")[0].TimeCode.EarliestTime()
    kind = str(prim.GetTypeName())
    values: dict[str, Any] = {}
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if not name.startswith(("physics:", "newton:", "xformOp:", "drive:", "limit:")) and name not in _CHECKED:
            continue
        value = attribute.Get(first)
        if value is None or isinstance(value, str | bool | int):
            continue
        if hasattr(value, "GetImaginary"):  # a quaternion, which numpy does not know
            value = (value.GetReal(), *value.GetImaginary())
        try:
            array = numpy.asarray(value, dtype=float) if isinstance(value, float) else numpy.array(value)
        except (TypeError, ValueError):
            continue
        values[name] = array
        if array.dtype.kind == "f":
            bad = (
                numpy.isnan(array).any()
                if name.startswith(("physics:", "newton:", "drive:", "limit:"))
                else not numpy.isfinite(array).all()
            )
            if bad:
                raise Refused(f"{prim.GetPath()}: {name} holds NaN or infinity", _MEND)
    if kind in ("Mesh", tokens.TET_MESH):
        points = len(values.get("points", ()))
        for name in ("faceVertexIndices", "tetVertexIndices", "surfaceFaceVertexIndices"):
            index = values.get(name)
            if index is not None and index.size and not (index.min() >= 0 and index.max() < points):
                raise Refused(f"{prim.GetPath()}: {name} points at vertices that are not there", _MEND)
        counts, index = values.get("faceVertexCounts"), values.get("faceVertexIndices")
        if counts is not None and (counts.min(initial=0) < 0 or counts.sum() != (0 if index is None else index.size)):
            raise Refused(f"{prim.GetPath()}: faceVertexCounts do not match faceVertexIndices", _MEND)


_CHECKED = (
    "points",
    "faceVertexCounts",
    "faceVertexIndices",
    "tetVertexIndices",
    "surfaceFaceVertexIndices",
    "size",
    "radius",
    "height",
    "widths",
    "velocities",
    "normals",
)


def _convert(stage: Stage, meters: float, kilograms: float) -> None:
    """Bring a stage to metres and kilograms: scale its outermost transforms and what UsdPhysics gives in units."""
    Usd, UsdGeom, UsdPhysics = pxr("Usd", "UsdGeom", "UsdPhysics")
    walk = iter(Usd.PrimRange(stage.GetPseudoRoot()))
    inner: set[Value] = set()
    for prim in walk:
        xform = UsdGeom.Xformable(prim)
        outermost = xform and not any(prim.GetPath().HasPrefix(path) for path in inner)
        if xform and (outermost or xform.GetResetXformStack()):
            reset, ops = xform.GetResetXformStack(), xform.GetOrderedXformOps()
            op = xform.AddScaleOp(opSuffix="softmodeUnit", precision=UsdGeom.XformOp.PrecisionDouble)
            op.Set((meters, meters, meters))
            xform.SetXformOpOrder([op, *ops], reset)
            inner.add(prim.GetPath())
        prismatic = prim.GetTypeName() == "PhysicsPrismaticJoint"
        for attribute in prim.GetAuthoredAttributes():
            _convert_attribute(attribute, prismatic, meters, kilograms)
        for side in ("0", "1"):  # the frame of a joint on a body scales with that; on the world nothing does it
            body, frame = prim.GetRelationship(f"physics:body{side}"), prim.GetAttribute(f"physics:localPos{side}")
            if frame and frame.HasAuthoredValue() and not (body and body.GetTargets()):
                frame.Set(frame.Get() * meters)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)


def _convert_attribute(attribute: Attribute, prismatic: bool, meters: float, kilograms: float) -> None:
    """Multiply the value of an attribute by its units."""
    name = attribute.GetName()
    powers = _UNITS.get(name) or (_PRISMATIC.get(name) if prismatic else None)
    if name.startswith(("drive:", "limit:")):
        _, instance, rest = name.split(":", 2)
        powers = (_OF_LINEAR if instance in _LINEAR else _OF_ANGULAR).get(rest)
    if powers is None:
        return
    value = attribute.Get()
    if value is not None:
        attribute.Set(type(value)(value * (meters ** powers[0] * kilograms ** powers[1])))
