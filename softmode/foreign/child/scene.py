"""Read everything about deformables of a stage, and write what is left of it as one crate for Newton's importer."""

from __future__ import annotations

import importlib
from typing import Any

from .. import tokens
from ..openusd import Prim, Stage, Value, pxr
from .answer import Arrays, prims_of
from .appearance import Pictures, look_of
from .deformables import applied, find_bodies, find_ties, uninstance, visible
from .instancers import expand
from .limits import Refused
from .splats import flat, read_prim
from .unread import other_units, unread


def read(stage: Stage, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return what the stage says and each of its deformables.

    Args:
        stage: The stage.
        request: `most`, the largest number of splats; `copy`: where the rest of the stage goes, None for nowhere;
            `only` and `skip`, patterns of paths of deformables.
        arrays: Takes the arrays.
    """
    Usd, UsdGeom, UsdPhysics = pxr("Usd", "UsdGeom", "UsdPhysics")
    meters, kilograms = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    copies = expand(stage)
    uninstance(stage, every=request["copy"] is not None and (meters != 1.0 or kilograms != 1.0))
    prims = list(prims_of(stage))
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    bodies, left = find_bodies(prims, request["only"], request["skip"])
    ignored = find_ties(prims, left)
    described = []
    used: list[str] = []
    most, pictures = request["most"], Pictures(arrays, request["budget"])

    def read_splats(prim: Prim) -> dict[str, Any]:
        nonlocal most
        found, count = read_prim(prim, time, arrays, most)
        most -= count
        return {**found, "matrix": flat(transforms.GetLocalToWorldTransform(prim))}

    for body in bodies:
        geometry = body.geometry
        described.append(
            {
                "path": str(body.prim.GetPath()),
                "geometry": str(geometry.GetPath()),
                "kind": str(geometry.GetTypeName()),
                "surface": any(name in tokens.SURFACE_SIM_APIS for name in applied(geometry)),
                "matrix": flat(transforms.GetLocalToWorldTransform(geometry)),
                "body_matrix": flat(transforms.GetLocalToWorldTransform(body.prim)),
                "shape": geometry_of(geometry, time, arrays, pictures),
                "meshes": [
                    {
                        "matrix": flat(transforms.GetLocalToWorldTransform(mesh)),
                        **geometry_of(mesh, time, arrays, pictures),
                    }
                    for mesh in body.meshes
                ],
                "splats": [read_splats(prim) for prim in body.splats],
                "mass": _scalar(body.prim, geometry, "mass"),
                "density": _scalar(body.prim, geometry, "density"),
                "material": _material(geometry, body.prim),
                "bundle": bundle_of(body.prim, arrays),
                "notes": body.notes,
            }
        )
        used += [str(prim.GetPath()) for prim in (geometry, *body.splats, *body.meshes)]
        beneath = [prim for prim in prims if prim.GetPath().HasPrefix(body.prim.GetPath())]
        described[-1]["notes"] += unread(beneath, used)
    kinematic = [f"{body.prim.GetPath()}: {body.kinematic}" for body in bodies if body.kinematic]
    if request["copy"] is not None:
        copy = importlib.import_module(".copy", __package__)
        copy.write_rest(stage, prims, request["copy"], used, [str(body.prim.GetPath()) for body in bodies], ignored)
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": meters,
        "kilograms": kilograms,
        "bodies": described,
        "scenery": [
            read_splats(prim)
            for prim in prims
            if prim.GetTypeName() == tokens.SPLATS and str(prim.GetPath()) not in used and visible(prim)
        ],
        "warnings": other_units(stage, prims) + kinematic,
        "notes": [
            *(f"{one.path}: {one.reason}; left to Newton's importer" for one in left),
            *(f"{path}: {kind} between deformables is not read" for path, kind in ignored),
            *copies,
            *unread([prim for prim in prims if prim.GetTypeName() not in _NEWTON], used),
        ],
    }


_NEWTON = ("Capsule", "Cone", "Cube", "Cylinder", "Mesh", "Plane", "Points", "Sphere", tokens.SPLATS, tokens.TET_MESH)
"""Types of geometry that Newton's importer or softmode itself reads where it belongs to no body of softmode."""


def geometry_of(prim: Prim, time: Value, arrays: Arrays, pictures: Pictures) -> dict[str, Any]:
    """Return the numbers of the arrays of a Mesh, TetMesh or Points prim, by attribute, and its `look`."""
    found: dict[str, Any] = {"path": str(prim.GetPath())}
    names = {
        "points": ("physics:restShapePoints", "omniphysics:restShapePoints", "points"),
        "counts": ("faceVertexCounts",),
        "indices": ("faceVertexIndices",),
        "tets": ("tetVertexIndices",),
        "widths": ("widths",),
        "masses": (tokens.MASSES, "omniphysics:masses"),
    }
    for name, candidates in names.items():
        for candidate in candidates:
            attribute = prim.GetAttribute(candidate)
            value = attribute.Get(time) if attribute else None
            if value is not None and len(value):
                found[name] = arrays.add(value)
                break
    orientation = prim.GetAttribute("orientation")
    found["left_handed"] = bool(orientation) and orientation.Get(time) == "leftHanded"
    if prim.GetTypeName() != tokens.POINTS:
        found["look"] = look_of(prim, time, arrays, pictures)
    return found


def _scalar(prim: Prim, other: Prim, name: str) -> float | None:
    """Return an authored number of a body or its geometry that is not zero, the value that says "not given"."""
    return next((value for value, _ in (_authored(owner, name) for owner in (prim, other)) if value), None)


def _authored(prim: Prim, name: str) -> tuple[float | None, str]:
    """Return the value of `<namespace>:<name>` under the first namespace that has one, and the attribute's name."""
    for namespace in tokens.NAMESPACES:
        attribute = prim.GetAttribute(f"{namespace}:{name}")
        value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
        if value is not None:
            return float(value), f"{namespace}:{name}"
    return None, ""


def _material(geometry: Prim, body: Prim) -> dict[str, Any] | None:
    """Return what the material says that is bound to the geometry, else to the body: for physics, else for all."""
    (UsdShade,) = pxr("UsdShade")
    for prim in (geometry, body):
        for purpose in (tokens.MATERIAL_PURPOSE, UsdShade.Tokens.allPurpose):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
            if not material:
                continue
            found: dict[str, Any] = {"path": str(material.GetPath())}
            for key, names in {
                "youngs_modulus": ("youngsModulus",),
                "poissons_ratio": ("poissonsRatio",),
                "density": ("density",),
                "friction": ("dynamicFriction", "staticFriction"),
            }.items():
                for name in names:
                    value, source = _authored(material.GetPrim(), name)
                    if value is not None:
                        found[key] = value
                        found[f"{key}_from"] = source
                        break
            if len(found) > 1:  # a material that is only for rendering says nothing
                return found
    return None


def bundle_of(prim: Prim, arrays: Arrays) -> dict[str, Any] | None:
    """Return softmode's own attributes of a body: strings, numbers, and the numbers of arrays."""
    marker = prim.GetAttribute(tokens.FORMAT)
    if not marker or not marker.HasAuthoredValue():
        return None
    found: dict[str, Any] = {"values": {}, "arrays": {}}
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if not name.startswith(tokens.PREFIX) or name == tokens.HANDLES:
            continue
        value = attribute.Get()
        if value is None or isinstance(value, str | bool | int | float):
            found["values"][name] = value
        else:
            try:
                found["arrays"][name] = arrays.add(value)
            except TypeError as error:
                raise Refused(f"{prim.GetPath()}: {name} is no array of numbers", "Export the body again") from error
    return found
