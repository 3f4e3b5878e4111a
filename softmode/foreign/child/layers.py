"""Which files a stage is made of: all of them must lie inside the asset root, before OpenUSD composes anything."""

from __future__ import annotations

import os
import re
from typing import Any

from ..openusd import Layer, Value, pxr
from .limits import Budget, Refused, check_nesting

MAX_LAYERS = 1024
"""Most files that a stage may consist of."""
_HINT = "Keep everything that the stage needs inside its folder, or pass the folder that holds it as asset_root"


def inside(path: str, root: str) -> bool:
    """Return whether a path, links followed, lies inside a folder."""
    real, folder = os.path.realpath(path), os.path.realpath(root)
    return real == folder or real.startswith(folder.rstrip(os.sep) + os.sep)


def split_package(path: str) -> tuple[str, str]:
    """Return the file of a path, and what follows its bracket if it names a member of a package, "a.usdz[b.usda]"."""
    if not path.endswith("]"):  # brackets are letters like others
        return path, ""
    found = re.match(r"(.*?\.usdz)\[(.*)$", path, re.IGNORECASE | re.DOTALL)
    outer, _, inner = path.partition("[")
    return (found.group(1), found.group(2)) if found else (outer, inner)


def open_layers(path: str, root: str, budget: Budget) -> Any:
    """Open the layer of a file and all that it refers to; return the first.

    Sublayers, references, payloads and asset-valued attributes (textures) are looked at in every layer, those of unused
    variants included, before the next is opened: none may be absolute, a URL, an expression, or lead out of the root by
    `..` or a link. Value clips, whose files are named by patterns, are refused.

    Args:
        path: The file.
        root: Folder that holds whatever the stage may read.
        budget: Allowed for each file before it is opened.

    Raises:
        Refused: If a path leads out of the root, or a layer does not exist or cannot be opened.
    """
    (Sdf,) = pxr("Sdf")
    first = None
    queue, seen = [path], {path}
    while queue:
        identifier = queue.pop()
        outer, _ = split_package(identifier)
        if not os.path.isfile(outer):
            raise Refused(f"refers to {identifier}, which does not exist", "Restore the file")
        if identifier == outer:
            if identifier != path:
                budget.add(os.stat(outer).st_size)
            check_nesting(outer)
        layer = Sdf.Layer.FindOrOpen(identifier)
        if layer is None:
            raise Refused(f"cannot open {identifier}", "The file is damaged: copy or export it again")
        first = first or layer
        for asset, is_layer in _assets(layer):
            target = _resolved(asset, layer.identifier, root)
            known = is_layer and Sdf.FileFormat.FindByExtension(asset.rstrip("]")) is not None
            if known and target not in seen:
                seen.add(target)
                queue.append(target)
        if len(seen) > MAX_LAYERS:
            raise Refused(f"consists of more than {MAX_LAYERS} files", "Flatten the stage")
    return first


def _assets(layer: Layer) -> list[tuple[str, bool]]:
    """Return every asset path of a layer and whether it names a layer."""
    (Sdf,) = pxr("Sdf")
    found = [(str(name), True) for name in layer.GetCompositionAssetDependencies() if name]  # "": the layer itself
    single, several = Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray

    def visit(path: Value) -> None:
        if path.IsPropertyPath():
            spec = layer.GetAttributeAtPath(path)
            if spec is None or spec.typeName not in (single, several):
                return
            values = [spec.default, *(layer.QueryTimeSample(path, t) for t in layer.ListTimeSamplesForPath(path))]
            for value in values:
                items = [value] if isinstance(value, Sdf.AssetPath) else (value or [])
                found.extend((item.path, False) for item in items)
        elif path.IsPrimPath() or path.IsPrimVariantSelectionPath():  # a variant speaks of its prim, too
            prim = layer.GetPrimAtPath(path)
            if prim is not None and prim.HasInfo("clips"):
                raise Refused(f"{path} has value clips, which softmode does not read", "Flatten the stage")

    layer.Traverse("/", visit)
    return found


def _resolved(asset: str, anchor: str, root: str) -> str:
    """Return the path of an asset that a layer names; refuse what lies outside the root."""
    shown = asset[:200]
    if not asset:
        return ""
    if asset.startswith("`"):
        raise Refused(f"refers to the expression {shown}", "Write the path out")
    if ":SDF_FORMAT_ARGS:" in asset:
        raise Refused(f"refers to {shown}, with arguments", "Name the file alone")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", asset):
        raise Refused(f"refers to the address {shown}", _HINT)
    outer, inner = split_package(asset)
    parts = inner.rstrip("]").split("/")
    if os.path.isabs(outer) or outer.startswith(("/", "\\", "~")) or re.match(r"[A-Za-z]:", outer) or parts[0] == "~":
        raise Refused(f"refers to the absolute path {shown}", _HINT)
    if inner and (".." in parts or inner.startswith("/")):
        raise Refused(f"refers to {shown}, outside its package", _HINT)
    package, member = split_package(anchor)
    if member:  # a layer of a package names members of the same package
        target = os.path.normpath(os.path.join(os.path.dirname(member.rstrip("]")), outer))
        if target.startswith(".."):
            raise Refused(f"refers to {shown}, outside its package", _HINT)
        return f"{package}[{target}]"
    if package.lower().endswith(".usdz"):
        return f"{package}[{os.path.normpath(outer)}]"
    target = os.path.normpath(os.path.join(os.path.dirname(anchor), outer))
    if not inside(target, root):
        raise Refused(f"refers to {shown}, outside {root}", _HINT)
    return f"{target}[{inner}" if inner else target
