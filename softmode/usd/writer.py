"""Soft bodies as OpenUSD: `write_usd`, and how one body is authored on a stage.

What a stage holds::

    /World                        Xform, default prim; metres, z up
      /World/<body>               Xform, PhysicsDeformableBodyAPI: place, mass, the ReducedBody as softmode:body:*
        PhysicsMaterial           Material: Young's modulus, Poisson's ratio, density, friction
        Simulation                Points, NewtonPointsDeformableSimAPI: the cubature points with their masses
        Splats                    ParticleField3DGaussianSplat with the skinning weights of the splats

All names are standard, proposed or plain attributes: any OpenUSD opens the stage without a plug-in.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_choice
from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.foreign import tokens
from softmode.foreign.openusd import Layer, Prim, Stage, Value
from softmode.objects.placed import Placed
from softmode.objects.stage.bundle import DTYPES, encode_body
from softmode.splats.formats.usd import define_splats, set_splat_column, splat_columns
from softmode.splats.splats import quats_from_rotations
from softmode.usd import kaolin
from softmode.usd.handles import handle_weights
from softmode.usd.openusd import openusd, whole_stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class UsdExportOptions:
    """What a stage holds, beside what is needed to read it back exactly.

    Raises:
        ConfigError: If a value is none of those that there are.
    """

    weights: Literal["float", "half", "none"] = "float"
    """Skinning weights of the splats as a primvar, for other tools: float, half precision, or none."""
    kaolin: bool = True
    """Kaolin's attributes, on bodies without quadratic handles."""
    splats: Literal["float", "half"] = "float"
    """Precision of the splats: float, equal to the bit when read back; or half, half as large, off by 2^-11 at most of
    each number (positions count from the body's centre: of its size)."""

    def __post_init__(self) -> None:
        """Check the names."""
        require_choice("weights", self.weights, ("float", "half", "none"))
        require_choice("splats", self.splats, ("float", "half"))


def write_usd(
    path: str | os.PathLike[str], bodies: Placed | Sequence[Placed], *, options: UsdExportOptions | None = None
) -> None:
    """Write soft bodies as one OpenUSD stage; the file appears complete or not at all.

    The bodies come back equal to the bit, with materials and splats, from `read_usd_scene` and `add_usd`.

    Args:
        path: A `.usdc` or `.usd` (binary) or `.usda` (text) file; its folder must exist.
        bodies: The bodies.
        options: What is written for other tools.

    Raises:
        ConfigError: If there is no body, or the file has another suffix.
        StorageError: If the file cannot be written.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    placed = [bodies] if isinstance(bodies, Placed) else list(bodies)
    if not placed:
        raise ConfigError("bodies is empty", hint="give at least one Placed")
    openusd("Usd")
    with whole_stage(path) as file:
        layer = new_layer(str(file))
        author_bodies(new_stage(layer), placed, options or UsdExportOptions())
        save(layer)


def new_layer(name: str) -> Any:
    """Return a new layer that will be saved under a name; a file of that name is replaced."""
    (Sdf,) = openusd("Sdf")
    os.unlink(name)
    return Sdf.Layer.CreateNew(name)


def save(layer: Layer) -> None:
    """Save a layer.

    Raises:
        OSError: If OpenUSD cannot.
    """
    (Tf,) = openusd("Tf")
    try:
        if not layer.Save():
            raise OSError("OpenUSD could not write it")
    except Tf.ErrorException as error:
        raise OSError(str(error).strip().splitlines()[-1].strip()) from error


def new_stage(layer: Layer) -> Any:
    """Return a stage on a layer, in metres with z up, with an Xform /World as its default prim."""
    Usd, UsdGeom, UsdPhysics = openusd("Usd", "UsdGeom", "UsdPhysics")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    Usd.ModelAPI(world.GetPrim()).SetKind("assembly")
    stage.SetDefaultPrim(world.GetPrim())
    return stage


def author_bodies(stage: Stage, bodies: Sequence[Placed], options: UsdExportOptions) -> list[str]:
    """Author bodies under /World and return the paths of their prims."""
    seen = {"Cameras", "Lights", "Rigid"}
    return [
        author_body(stage, f"/World/{prim_name(placed.name or placed.body.name, seen)}", placed, options)
        for placed in bodies
    ]


def prim_name(label: str, seen: set[str]) -> str:
    """Return a valid name for a prim, unlike those seen before, and note it as seen."""
    name = re.sub(r"[^0-9A-Za-z_]", "_", label) or "prim"
    if name[0].isdigit():
        name = f"_{name}"
    chosen, number = name, 2
    while chosen in seen:
        chosen, number = f"{name}_{number}", number + 1
    seen.add(chosen)
    return chosen


def author_body(stage: Stage, path: str, placed: Placed, options: UsdExportOptions) -> str:
    """Author one body with all that belongs to it; return its path."""
    Usd, UsdGeom, UsdSemantics = openusd("Usd", "UsdGeom", "UsdSemantics")
    body = placed.body
    root = UsdGeom.Xform.Define(stage, path)
    prim = root.GetPrim()
    Usd.ModelAPI(prim).SetKind("component")
    UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr([placed.name or body.name])
    prim.AddAppliedSchema(tokens.BODY_API)
    attribute(prim, tokens.MASS, "Float", placed.mass)
    set_place(root, placed.position, placed.rotation, placed.scale)
    _author_reduced(prim, placed)
    _author_material(stage, prim, placed.material)
    points = UsdGeom.Points.Define(stage, f"{path}/Simulation")
    _author_points(points, placed)
    carrier, weights = points.GetPrim(), None
    if placed.splats is not None:
        splats = define_splats(stage, f"{path}/Splats", placed.splats.sh_degree)
        for name, values in splat_columns(placed.splats).items():
            set_splat_column(splats, name, values, half=options.splats == "half")
        carrier = splats.GetPrim()
        weights = handle_weights(body, placed.splats.means)[0].astype(np.float32)
        if options.weights != "none":
            _author_weights(carrier, weights, options.weights)
    if options.kaolin and kaolin.exchangeable(body):
        _author_kaolin(carrier, placed, weights)
    return path


def attribute(prim: Prim, name: str, kind: str, value: Value, *, custom: bool = False, uniform: bool = False) -> Any:
    """Author an attribute of a type that `Sdf.ValueTypeNames` names, and return it."""
    (Sdf,) = openusd("Sdf")
    variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
    made = prim.CreateAttribute(name, getattr(Sdf.ValueTypeNames, kind), custom, variability)
    if value is not None:
        made.Set(value)
    return made


def float_array(values: NDArray[Any], *, half: bool = False) -> Any:
    """Return numbers as an array of OpenUSD, flattened."""
    (Vt,) = openusd("Vt")
    dtype, kind = (np.float16, Vt.HalfArray) if half else (np.float32, Vt.FloatArray)
    return kind.FromNumpy(np.ascontiguousarray(values, dtype).reshape(-1))


def vectors(values: NDArray[Any]) -> Any:
    """Return rows of three float numbers as an array of OpenUSD."""
    (Vt,) = openusd("Vt")
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def set_place(
    root: Prim, position: Sequence[float] | NDArray[Any], rotation: NDArray[Any], scale: float, time: Value = None
) -> None:
    """Author translate, orient and scale of an Xform in double precision, as a time sample or for all times."""
    Gf, Usd, UsdGeom = openusd("Gf", "Usd", "UsdGeom")
    when = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    x, y, z, w = quats_from_rotations(rotation).tolist()
    orient, double = Gf.Quatd(w, x, y, z), UsdGeom.XformOp.PrecisionDouble
    ops = {op.GetOpName(): op for op in root.GetOrderedXformOps()}
    if not ops:
        made = (root.AddTranslateOp(double), root.AddOrientOp(double), root.AddScaleOp(double))
        ops = {op.GetOpName(): op for op in made}
    else:  # the nearer of q and -q keeps interpolation on the short way
        before = ops["xformOp:orient"].Get(Usd.TimeCode(float("inf")) if time is not None else when)
        if before is not None and Gf.Dot(before, orient) < 0.0:
            orient = Gf.Quatd(-w, -x, -y, -z)
    ops["xformOp:translate"].Set(Gf.Vec3d(*map(float, position)), when)
    ops["xformOp:orient"].Set(orient, when)
    if time is None:
        ops["xformOp:scale"].Set(Gf.Vec3d(float(scale)), when)


def _author_reduced(prim: Prim, placed: Placed) -> None:
    """Author the ReducedBody, and its material in full precision, as attributes of its prim."""
    (Vt,) = openusd("Vt")
    header, arrays, digest = encode_body(placed.body)
    text: dict[str, Any] = {"custom": True, "uniform": True}
    attribute(prim, tokens.FORMAT, "String", tokens.BUNDLE_FORMAT, **text)
    attribute(prim, tokens.BODY_HEADER, "String", header, **text)
    attribute(prim, tokens.BODY_SHA256, "String", digest, **text)
    kinds = {"double[]": "DoubleArray", "float[]": "FloatArray", "int64[]": "Int64Array"}
    for name, array in arrays.items():
        if array.size:
            kind = kinds[DTYPES[array.dtype.str]]
            attribute(prim, tokens.BODY_PREFIX + name, kind, getattr(Vt, kind).FromNumpy(array), **text)
    for field in dataclasses.fields(Material):
        value = getattr(placed.material, field.name)
        if field.name == "model":
            attribute(prim, tokens.MATERIAL_PREFIX + field.name, "Token", value.name, **text)
        else:
            attribute(prim, tokens.MATERIAL_PREFIX + field.name, "Double", float(value), custom=True)


def _author_material(stage: Stage, prim: Prim, material: Material) -> None:
    """Author the physics material beneath a body, bound to it for physics."""
    UsdPhysics, UsdShade = openusd("UsdPhysics", "UsdShade")
    shader = UsdShade.Material.Define(stage, prim.GetPath().AppendChild("PhysicsMaterial"))
    api = UsdPhysics.MaterialAPI.Apply(shader.GetPrim())
    shader.GetPrim().AddAppliedSchema(tokens.VOLUME_MATERIAL_API)
    api.CreateDensityAttr(material.density)
    api.CreateDynamicFrictionAttr(material.friction)
    api.CreateStaticFrictionAttr(material.friction)
    api.CreateRestitutionAttr(0.0)
    attribute(shader.GetPrim(), tokens.YOUNGS_MODULUS, "Float", material.youngs_modulus)
    attribute(shader.GetPrim(), tokens.POISSONS_RATIO, "Float", material.poissons_ratio)
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(shader, UsdShade.Tokens.weakerThanDescendants, tokens.MATERIAL_PURPOSE)


def _author_points(points: Prim, placed: Placed) -> None:
    """Author the simulation geometry: the cubature points, which fill the body, with widths and masses."""
    UsdGeom, Vt = openusd("UsdGeom", "Vt")
    found = placed.body.cubature
    points.GetPrim().AddAppliedSchema(tokens.POINTS_SIM_API)
    points.CreateWidthsAttr(float_array(np.cbrt(found.weights)))  # edge of a cube of as much volume
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    set_points(points, found.points)
    masses = found.weights * (placed.mass / placed.body.volume)
    attribute(points.GetPrim(), tokens.MASSES, "FloatArray", float_array(masses))
    # What the physics is made of, not what one looks at: viewers hide it by default.
    points.CreatePurposeAttr(UsdGeom.Tokens.guide)
    points.CreateDisplayColorAttr(Vt.Vec3fArray([(0.2, 0.5, 0.9)]))


def set_points(points: Prim, positions: NDArray[Any], time: float | None = None) -> None:
    """Author where points are, and the box around them with their widths, as a time sample or for all times."""
    Usd, UsdGeom = openusd("Usd", "UsdGeom")
    when, places = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time), vectors(positions)
    points.CreatePointsAttr().Set(places, when)
    points.CreateExtentAttr().Set(UsdGeom.Points.ComputeExtent(places, points.GetWidthsAttr().Get()), when)


def _author_weights(prim: Prim, weights: NDArray[np.float32], precision: str) -> None:
    """Author the skinning weights of splats as a primvar."""
    Sdf, UsdGeom = openusd("Sdf", "UsdGeom")
    half = precision == "half"
    kind = Sdf.ValueTypeNames.HalfArray if half else Sdf.ValueTypeNames.FloatArray
    name = tokens.WEIGHTS.removeprefix("primvars:")
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex, weights.shape[1])
    primvar.Set(float_array(weights, half=half))


def _author_kaolin(prim: Prim, placed: Placed, weights: NDArray[np.float32] | None) -> None:
    """Author Kaolin's attributes on the prim whose points are drawn."""
    schemas = {
        tokens.KAOLIN_MATERIAL_API: ("kaolin_physics_material:", kaolin.material_values(placed.body, placed.material)),
        tokens.KAOLIN_SKINNED_API: (tokens.KAOLIN_PREFIX, kaolin.skinned_values(placed.body, placed.material, weights)),
    }
    for schema, (prefix, values) in schemas.items():
        prim.AddAppliedSchema(f"{schema}:default")
        for name, value in values.items():
            if isinstance(value, float):
                attribute(prim, f"{prefix}default:{name}", "Float", value)
            elif name == "pts":
                attribute(prim, f"{prefix}default:{name}", "Point3fArray", vectors(value))
            else:
                attribute(prim, f"{prefix}default:{name}", "FloatArray", float_array(value))
