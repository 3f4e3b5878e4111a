"""How a geometry of a stage looks: display colours, and the diffuse colour of UsdPreviewSurface materials."""

from __future__ import annotations

import io
from typing import Any

from ..openusd import Attribute, Prim, Value, pxr
from .answer import Arrays
from .limits import Budget, Refused
from .surface import MAX_TEXELS, decoded

_FORMATS = ("PNG", "JPEG", "TGA", "BMP", "WEBP", "TIFF")


class Pictures:
    """Textures of a stage, each read once.

    Args:
        arrays: Takes them.
        budget: Allowed for each file.
    """

    def __init__(self, arrays: Arrays, budget: Budget) -> None:
        """Begin with none."""
        self.arrays, self.budget = arrays, budget
        self.known: dict[str, int] = {}
        self.left = MAX_TEXELS

    def number(self, asset: Value) -> int:
        """Return the number of a texture's array.

        Raises:
            Refused: If there is no such file, or it is no picture, or too large.
        """
        import PIL.Image

        (Ar,) = pxr("Ar")
        where = asset.resolvedPath
        source = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(where)) if where else None
        if source is None:
            raise Refused(f"texture {asset.path[:200]} cannot be found", "Restore the file")
        if where not in self.known:
            self.budget.add(source.GetSize())
            try:
                with PIL.Image.open(io.BytesIO(source.GetBuffer()), formats=_FORMATS) as picture:
                    pixels = decoded(picture, self.left)
            except PIL.UnidentifiedImageError as error:
                raise Refused(f"texture {asset.path[:200]} is no picture", "Save it as .png or .jpg") from error
            self.left -= pixels.size // 3
            self.known[where] = self.arrays.add(pixels)
        return self.known[where]


def look_of(prim: Prim, time: Value, arrays: Arrays, pictures: Pictures) -> dict[str, Any]:
    """Return the display colours of a geometry and its materials: the numbers of arrays, and what is not read."""
    (UsdGeom,) = pxr("UsdGeom")
    notes: list[str] = []
    look: dict[str, Any] = {"colors": _primvar(prim, "displayColor", time, arrays, notes), "notes": notes}
    opacity = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity")
    values = opacity.Get(time) if opacity else None
    if values is not None and len(values) and min(values) < 1.0:
        notes.append(f"displayOpacity down to {min(values):g} is not read: opaque")
    look["materials"] = [one for one in _materials(prim, time, arrays, pictures, notes) if one]
    return look


def _primvar(prim: Prim, name: str, time: Value, arrays: Arrays, notes: list[str]) -> dict[str, Any] | None:
    """Return a primvar, its indices resolved, and what its values belong to."""
    (UsdGeom,) = pxr("UsdGeom")
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    values, indices, plain = primvar.ComputeFlattened(time), primvar.GetIndices(time), primvar.Get(time)
    if indices and plain is not None and not (0 <= min(indices) and max(indices) < len(plain)):
        values = None
    if values is None or not len(values):
        notes.append(f"primvar {name} is not read: its indices do not fit its values")
        return None
    return {"name": name, "values": arrays.add(values), "interpolation": str(primvar.GetInterpolation())}


def _materials(prim: Prim, time: Value, arrays: Arrays, pictures: Pictures, notes: list[str]) -> list[Any]:
    """Return the materials of a geometry, then those of its subsets."""
    UsdGeom, UsdShade = pxr("UsdGeom", "UsdShade")
    bound = [(prim, None)]
    for subset in UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), UsdGeom.Tokens.face, "materialBind"):
        bound.append((subset.GetPrim(), subset.GetIndicesAttr().Get(time)))
    found = []
    for owner, faces in bound:
        material, _ = UsdShade.MaterialBindingAPI(owner).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource() if material else (None, None, None)
        if not shader:
            continue
        if shader.GetShaderId() != "UsdPreviewSurface":
            notes.append(f"material {material.GetPath()} is not read: no UsdPreviewSurface")
            continue
        one = _diffuse(prim, shader, time, arrays, pictures, notes)
        if one is not None:
            found.append({**one, "faces": None if faces is None else arrays.add(faces)})
    return found


def _source(shader: Value, name: str) -> tuple[Attribute, Value] | None:
    """Return the attribute that gives an input of a shader its value, and the shader that it is of, if any."""
    (UsdShade,) = pxr("UsdShade")
    given = shader.GetInput(name)
    attributes = given.GetValueProducingAttributes() if given else []
    if not attributes:
        return None
    owner = attributes[0].GetPrim()
    is_output = attributes[0].GetName().startswith("outputs:")
    return attributes[0], UsdShade.Shader(owner) if is_output and owner.IsA(UsdShade.Shader) else None


def _value(shader: Value, name: str, time: Value) -> Any:
    """Return the value of an input that no shader computes, None where there is none."""
    found = _source(shader, name)
    return None if found is None or found[1] else found[0].Get(time)


def _diffuse(
    prim: Prim, shader: Value, time: Value, arrays: Arrays, pictures: Pictures, notes: list[str]
) -> dict[str, Any] | None:
    """Return the diffuse colour of a preview surface: a colour, or a texture and its coordinates; None for neither."""
    path = shader.GetPath()
    opacity = _source(shader, "opacity")
    if opacity is not None and (opacity[1] or opacity[0].Get(time) != 1.0):
        notes.append(f"{path}: its opacity is not read: opaque")
    found = _source(shader, "diffuseColor")
    if found is None:
        return None
    attribute, texture = found
    if not texture:
        value = attribute.Get(time)
        return None if value is None else {"color": [float(x) for x in value]}
    kind = texture.GetShaderId()
    if kind == "UsdPrimvarReader_float3":
        name = _value(texture, "varname", time)
        return {"primvar": _primvar(prim, str(name), time, arrays, notes)} if name else None
    if kind != "UsdUVTexture":
        notes.append(f"{texture.GetPath()}: {kind or 'a shader'} is not read")
        return None
    asset = _value(texture, "file", time)
    try:
        if asset is None or "<UDIM>" in asset.path:
            raise Refused("its texture is none, or one of many tiles", "Bake it into one")
        picture = pictures.number(asset)
    except Refused as error:
        notes.append(f"{texture.GetPath()}: {error}: not read")
        return None
    name, reader = "st", _source(texture, "st")
    if reader is not None and reader[1] and reader[1].GetShaderId() == "UsdTransform2d":
        notes.append(f"{reader[1].GetPath()}: UsdTransform2d is not read")
        reader = _source(reader[1], "in")
    if reader is not None and reader[1]:
        name = str(_value(reader[1], "varname", time) or name)
    for what, usual in (("scale", (1.0, 1.0, 1.0, 1.0)), ("bias", (0.0, 0.0, 0.0, 0.0))):
        given = _value(texture, what, time)
        if given is not None and tuple(given) != usual:
            notes.append(f"{texture.GetPath()}: its {what} is not read")
    return {"texture": picture, "uvs": _primvar(prim, name, time, arrays, notes)}
