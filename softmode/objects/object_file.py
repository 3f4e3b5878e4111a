"""Files of soft objects: a body with its splats, one .npz that `ReducedBody.load` reads too; what a file holds."""

from __future__ import annotations

import difflib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.errors import AssetError
from softmode.files import array_names, damage_errors
from softmode.foreign import tokens
from softmode.objects.captures import CAPTURES
from softmode.objects.shapes.presets import PRESETS
from softmode.objects.soft_object import SoftObject
from softmode.radiance.formats import is_radiance
from softmode.radiance.grid import RadianceGrid
from softmode.splats.formats import READABLE
from softmode.splats.formats.others import refuse_others
from softmode.splats.point_cloud import ply_kind, splats_from_points
from softmode.splats.splats import Splats

FileKind = Literal["splat", "points", "mesh", "radiance", "body"]
_PARTS = {
    "splats": ("means", "quats", "scales", "opacities", "sh"),
    "radiance": ("density", "sh", "origin", "axes"),
}
"""What a file may hold beside the body, and the names of its arrays."""
_LIGHT = np.array([0.37, 0.29, 0.88])


def write_object(
    path: str | os.PathLike[str],
    body: ReducedBody,
    splats: Splats | None = None,
    radiance: RadianceGrid | None = None,
) -> None:
    """Write a body with its splats and its radiance field; the file appears complete or not at all.

    Args:
        path: The .npz to write.
        body: The body.
        splats: Its splats in the body frame, if it has any.
        radiance: The radiance field that it was made from, in the body frame, if there is one.
    """
    given = {"splats": splats, "radiance": radiance}
    held = {kind: part for kind, part in given.items() if part is not None}
    body.save(path, beside={f"{kind}.{n}": getattr(part, n) for kind, part in held.items() for n in _PARTS[kind]})


def read_object(path: str | os.PathLike[str]) -> SoftObject:
    """Read a file written by `write_object` or `ReducedBody.save`, or a stage with one body from `usd.write_usd`.

    Returns:
        The body, with its splats and its radiance field in the body frame if the file has any.

    Raises:
        AssetError: If the file is missing, damaged, foreign, or of another version.
    """
    if os.fspath(path).lower().endswith(tokens.SUFFIXES):
        from softmode.objects.stage_asset import read_usd_body

        return read_usd_body(path)
    body, stored = ReducedBody.load_with(path)
    with damage_errors(f"body file {path}: its material", hint="build the body again"):
        told = stored_material(body)
        material = replace(Material(), **told) if told else None  # type: ignore[arg-type]  # its fields are numbers
    held = {kind for kind in _PARTS if any(name.startswith(f"{kind}.") for name in stored)}
    missing = {f"{kind}.{name}" for kind in held for name in _PARTS[kind]} ^ set(stored)
    if missing:
        raise AssetError(f"body file {path}: {sorted(missing)} do not match", hint="Build the body again.")
    parts: dict[str, dict[str, Any]] = {kind: {n: stored[f"{kind}.{n}"] for n in _PARTS[kind]} for kind in held}
    return SoftObject(
        body=body,
        splats=Splats(**parts["splats"], name=f"body file {path}") if "splats" in held else None,
        material=material,
        radiance=RadianceGrid(**parts["radiance"], name=f"body file {path}") if "radiance" in held else None,
    )


def stored_material(body: ReducedBody) -> dict[str, float]:
    """Return the properties of the material that a body was given when it was built, as fields of `Material`."""
    return json.loads(str(body.provenance.get("material", "{}")))


def stored_bars(body: ReducedBody) -> dict[str, tuple[float, float, float]]:
    """Return low, value and high of what `softmode fit` found of a body by fields of `Material`; none if it did not."""
    told = json.loads(str(body.provenance.get("fit", "{}")))
    return {name: tuple(bars) for name, bars in told.get("parameters", {}).items()}


def file_kind(path: str | os.PathLike[str]) -> FileKind:
    """Return what a file is, by its suffix and, for .ply, .npz and OpenUSD, its contents.

    Raises:
        AssetError: If it is missing or cannot be read.
    """
    file = Path(path)
    with damage_errors(f"file {file}", hint="check the path"):
        exists = file.exists()
    if not exists:
        names = (*PRESETS, *CAPTURES)
        like = difflib.get_close_matches(file.name, names, n=len(names), cutoff=0.5)
        presets = ", ".join([*like, *(name for name in names if name not in like)])
        named = len(file.parts) == 1 and not file.suffix
        hint = f"check the path, or name a preset: {presets}" if named else "check the path"
        raise AssetError(f"file {file}: no such file", hint=hint)
    suffix = file.suffix.lower()
    if is_radiance(file):
        return "radiance"
    refuse_others(file)
    if suffix == ".npz":
        names = array_names(file, hint="build or write it again")
        return "points" if "points" in names and "header" not in names else "body"
    if suffix == ".ply":
        found = ply_kind(file)
        return "splat" if found == "splats" else "mesh" if found == "mesh" else "points"
    if suffix == ".xyz":
        return "points"
    if not suffix and file.is_file():
        raise AssetError(f"file {file}: has no suffix", hint="name it after its kind: .ply, .splat, .glb, .obj, ...")
    if suffix in tokens.SUFFIXES:
        from softmode.objects.stage_asset import asset_kind

        return asset_kind(file)
    return "splat" if file.is_dir() or suffix in READABLE else "mesh"


def surface_cover(body: ReducedBody, color: tuple[float, float, float] = (0.55, 0.63, 0.75)) -> Splats:
    """Return splats on the surface samples of a body, lit from above, for a body that has none of its own."""
    light = 0.7 + 0.3 * np.clip(body.surface.normals @ _LIGHT, -1.0, 1.0)
    return splats_from_points(
        body.surface.points, body.surface.normals, light[:, None] * np.asarray(color), name=body.name
    )
