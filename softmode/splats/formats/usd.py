"""OpenUSD `ParticleField3DGaussianSplat` prims (read, write, animate); needs the extra `[usd]`.

The schema, new in usd-core 26.3, keeps linear scales, linear opacities and coefficients splat by splat. The stage says
which axis points up and how long its unit is; prims may lie under transforms. Splats are read into metres with z up,
and written so.

Reference:
    OpenUSD 26.03, UsdVol: `ParticleField3DGaussianSplat` and its applied schemas.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.errors import AssetError, ConfigError, MissingExtraError
from softmode.files import whole_file
from softmode.foreign import process
from softmode.foreign.openusd import pxr
from softmode.splats.formats.common import REEXPORT, near_zero, offset_note, sound_splats, typed_errors, unreadable
from softmode.splats.splats import MAX_SPLATS, Splats, UpAxis, joined, rotate_sh, up_rotation

_LIMITS = process.Limits(memory=128 * 2.0**20, memory_per_byte=16.0, seconds=1.0)
"""Splats alone need little: 16 bytes for each of the file is generous."""
_SH = "radiance:sphericalHarmonicsCoefficients"
_WIDTHS = {"positions": 3, "orientations": 4, "scales": 3, "opacities": 1, _SH: 3}
UP_AXES: dict[str, UpAxis] = {"X": "+x", "Y": "+y", "Z": "+z"}
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def read_usd(path: str | os.PathLike[str], *, time_code: float | None = None) -> Splats:
    """Read all visible `ParticleField3DGaussianSplat` prims of an OpenUSD file as one set of splats.

    Transforms, shear and mirroring included, the stage's up axis and its unit are applied: the result is in metres with
    z up. Prims of lower degree get zero coefficients above it. The file is opened in a process of its own with limited
    memory and time, since OpenUSD itself does not withstand damaged files; what it refers to must lie in its folder.

    Args:
        path: A `.usd`, `.usda`, `.usdc` or `.usdz` file.
        time_code: Frame of an animation; None for the first.

    Raises:
        AssetError: If the file is damaged, holds no splat prims, or their arrays contradict each other.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    file = Path(path)
    with typed_errors(str(file)):
        return _read_stage(file, time_code)


def _read_stage(file: Path, time_code: float | None) -> Splats:
    """Open the stage in a process of its own and join what that sends back."""
    time = None if time_code is None else float(time_code)
    answer = process.read("splats", file, name=f"splat file {file}", limits=_LIMITS, time=time, most=MAX_SPLATS)
    stage = answer.described
    if not stage["prims"]:
        raise unreadable(
            file,
            "holds no visible ParticleField3DGaussianSplat prim",
            hint="Export the splats as such, or check that the prim is not invisible or in an unloaded payload",
        )
    parts: list[Splats] = []
    for prim in stage["prims"]:
        splats = splats_from_prim(prim, answer.arrays, f"splat file {file}: {prim['path']}")
        parts.append(placed(splats, np.array(prim["matrix"]).reshape(4, 4).T, center=True))
    if stage["up"] not in UP_AXES:
        raise unreadable(file, f"upAxis is {stage['up'][:20]!r}", hint="Set it to X, Y or Z")
    up = up_rotation(UP_AXES[stage["up"]])
    meters = float(stage["meters"])
    if not (np.isfinite(meters) and meters > 0.0):
        raise unreadable(file, f"metersPerUnit is {meters}", hint="Set it to the length of the unit in m")
    found = joined(parts, f"splat file {file}").transformed(rotation=up, scale=meters)
    for text in stage["warnings"]:
        warnings.warn(f"splat file {file}: {text}", stacklevel=4)
    return replace(found, notes=(*found.notes, *stage["warnings"], *stage["notes"]))


def splats_from_prim(prim: dict[str, Any], sent: list[NDArray[Any]], name: str) -> Splats:
    """Build the splats of one prim in its own frame from what the process of its own sent.

    Raises:
        AssetError: If arrays are missing, contradict each other, or the radiance is linear.
    """
    arrays: dict[str, NDArray[np.float32]] = {}
    for key, number in prim["splats"].items():
        value, width = sent[number], _WIDTHS[key]
        if value.dtype.kind != "f" or list(value.shape[1:]) not in ([], [width]):
            raise AssetError(f"{name}: {key} is of type {value.dtype} and shape {value.shape}", hint=REEXPORT)
        arrays[key] = value.astype(np.float32).reshape(len(value), -1)
        if arrays[key].shape[1] != width:
            raise AssetError(f"{name}: {key} has rows of {arrays[key].shape[1]} numbers, not {width}", hint=REEXPORT)
    return _from_arrays(prim, arrays, name)


def _from_arrays(prim: dict[str, Any], arrays: dict[str, NDArray[np.float32]], name: str) -> Splats:
    """Build the splats of one prim in its own frame; orientation, opacity and colour may be absent."""
    missing = [key for key in ("positions", "scales") if key not in arrays]
    if missing:
        raise AssetError(f"{name}: {' and '.join(missing)} have no value", hint="Export the splats again")
    if prim["color_space"].lower().startswith(("lin", "raw", "acescg")):
        raise AssetError(
            f"{name}: its radiance is linear ({prim['color_space']}), softmode keeps display-referred colours",
            hint="Export the splats with sRGB radiance, as trained",
        )
    count = len(arrays["positions"])
    coefficients, notes = np.zeros((count, 1, 3), dtype=np.float32), []
    if _SH in arrays:
        degree = prim["degree"]
        if type(degree) is not int or not 0 <= degree <= 4 or len(arrays[_SH]) != count * (degree + 1) ** 2:
            raise AssetError(
                f"{name}: {len(arrays[_SH])} spherical-harmonic coefficients for {count} splats of degree {degree}, "
                "expected degree 0 to 4 with (degree + 1)^2 for each splat",
                hint=REEXPORT,
            )
        coefficients = arrays[_SH].reshape(count, -1, 3)
    else:
        notes.append("has no colours: grey")
    for key in ("orientations", "scales", "opacities"):
        if key in arrays and len(arrays[key]) != count:
            raise AssetError(f"{name}: {len(arrays[key])} {key} for {count} splats", hint=REEXPORT)
    return sound_splats(
        name,
        means=arrays["positions"],
        quats=arrays.get("orientations", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        scales=arrays["scales"],
        opacities=arrays["opacities"][:, 0] if "opacities" in arrays else np.ones(count),
        sh=coefficients,
        notes=notes,
    )


def placed(splats: Splats, matrix: NDArray[np.float64], *, center: bool = False) -> Splats:
    """Return the splats under the affine map of a prim (column vectors, shape (4, 4)).

    An offset that the splats have becomes part of the map; a new one is taken off only if `center` asks for it.
    """
    linear, shift = matrix[:3, :3], matrix[:3, 3]
    determinant = np.linalg.det(linear)
    if not (np.isfinite(matrix).all() and abs(determinant) > 0.0):
        raise AssetError(f"{splats.name}: its transform is singular", hint="Give the prim scales other than zero")
    if any(splats.offset):
        shift = shift + linear @ splats.offset
    away = near_zero(splats.means @ linear.T + shift)[1] if center else (0.0, 0.0, 0.0)
    told = tuple(note for note in splats.notes if note not in offset_note(splats.offset))
    splats = replace(splats, offset=(0.0, 0.0, 0.0), notes=told)
    if determinant < 0.0:  # mirrored: a reflection of x first, then a map that keeps handedness
        means, quats = splats.means * np.array([-1.0, 1.0, 1.0]), splats.quats * np.array([1.0, -1.0, -1.0, 1.0])
        splats = replace(splats, means=means, quats=quats, sh=rotate_sh(splats.sh, _MIRROR))
        linear = linear @ _MIRROR
    scale, shift = abs(determinant) ** (1.0 / 3.0), shift - away
    if np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=1e-6 * scale**2):
        moved = splats.transformed(rotation=linear / scale, translation=shift, scale=scale)
    else:
        moved = splats.deformed(splats.means.astype(np.float64) @ linear.T + shift, linear)
    return replace(moved, offset=away, notes=(*told, *offset_note(away))) if any(away) else moved


def write_usd(path: str | os.PathLike[str], splats: Splats | Sequence[Splats], *, fps: float = 24.0) -> None:
    """Write splats as one `ParticleField3DGaussianSplat` prim; the file appears complete or not at all.

    Nothing is lost: all arrays are float32. The stage has z up and metres; `extent` bounds three standard deviations. A
    sequence becomes an animation with one time code per item: what changes is sampled (positions, orientations, scales,
    coefficients, opacities), what does not is stored once.

    Args:
        path: A `.usdc` or `.usd` (binary) or `.usda` (text) file; its folder must exist.
        splats: What to write [m], z up; or the frames of an animation, all with the same number of splats and degree,
            such as `[rest.deformed(means, gradients) for ...]`.
        fps: Frames per second of an animation.

    Raises:
        StorageError: If the file cannot be written.
        ConfigError: If there are no frames, they differ in count or degree, or `fps` is not positive.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    frames = [splats] if isinstance(splats, Splats) else list(splats)
    if not frames or any((f.count, f.sh_degree) != (frames[0].count, frames[0].sh_degree) for f in frames):
        raise ConfigError(
            "an animation needs at least one frame, and the same number of splats and degree in all",
            hint="Deform one set of rest splats",
        )
    require_number("fps", fps, above=0.0)
    suffix = Path(path).suffix.lower()
    if suffix not in (".usd", ".usda", ".usdc"):
        raise unreadable(path, f"cannot write {suffix!r}", hint="Name a .usdc, .usda or .usd file")
    process.library_folder()
    with whole_file(path, "splat file", make_folders=False) as file, tempfile.TemporaryDirectory() as folder:
        scratch = os.path.join(folder, "splats" + suffix)
        if not _build_layer(frames, fps).Export(scratch):
            raise OSError("OpenUSD could not write it")
        with open(scratch, "rb") as source:
            shutil.copyfileobj(source, file)


def _build_layer(frames: list[Splats], fps: float) -> Any:
    """Return an anonymous layer with the prim `/Splats`."""
    Sdf, Usd, UsdGeom = pxr("Sdf", "Usd", "UsdGeom")
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = define_splats(stage, "/Splats", frames[0].sh_degree)
    stage.SetDefaultPrim(prim.GetPrim())
    if len(frames) > 1:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(len(frames) - 1.0)
    rows: list[dict[str, NDArray[Any]]] = []
    for frame in frames:
        rows.append(splat_columns(frame, near=rows[-1]["orientations"] if rows else None))
    for name, first in rows[0].items():
        if all(np.array_equal(row[name], first) for row in rows[1:]):
            set_splat_column(prim, name, first)
            continue
        for code, row in enumerate(rows):
            set_splat_column(prim, name, row[name], float(code))
    return layer


def define_splats(stage: Any, path: str, sh_degree: int) -> Any:
    """Define a `ParticleField3DGaussianSplat` without values on a stage and return it."""
    (UsdVol,) = pxr("UsdVol")
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise MissingExtraError(
            "the installed usd-core has no ParticleField3DGaussianSplat",
            hint="install it with: pip install 'softmode[usd]'",
        )
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(sh_degree)
    return prim


def splat_columns(splats: Splats, *, near: NDArray[Any] | None = None) -> dict[str, NDArray[Any]]:
    """Return what a splat prim is made of, by attribute.

    Args:
        splats: The splats.
        near: Orientations of the frame before, shape (N, 4); q and -q are one rotation, and the nearer of the two keeps
            interpolation on the short way.
    """
    quats = splats.quats
    if near is not None:
        quats = quats * np.where((quats * near).sum(axis=1, keepdims=True) < 0.0, np.float32(-1), np.float32(1))
    return {
        "positions": splats.means,
        "orientations": quats,
        "scales": splats.scales,
        "opacities": splats.opacities,
        _SH: splats.sh.reshape(-1, 3),
        "extent": _extent(splats),
    }


def set_splat_column(
    prim: Any, name: str, values: NDArray[Any], time_code: float | None = None, *, half: bool = False
) -> None:
    """Author one attribute of a splat prim, as a time sample or for all times.

    Args:
        prim: From `define_splats`.
        name: Attribute, as in `splat_columns`.
        values: Its value.
        time_code: When; None for always.
        half: Author the variant of half precision, `positionsh` beside `positions`; an extent has none.
    """
    Usd, Vt = pxr("Usd", "Vt")
    half = half and name != "extent"
    kind = {"orientations": "Quat{}Array", "opacities": "{}Array"}.get(name, "Vec3{}Array")
    number = ("Half" if half else "Float") if name == "opacities" else ("h" if half else "f")
    array = getattr(Vt, kind.format(number)).FromNumpy(np.ascontiguousarray(values, np.float16 if half else np.float32))
    when = Usd.TimeCode.Default() if time_code is None else Usd.TimeCode(time_code)
    prim.GetPrim().GetAttribute(name + ("h" if half else "")).Set(array, when)


def _extent(splats: Splats) -> NDArray[np.float32]:
    """Return the box around three standard deviations of every splat, shape (2, 3)."""
    reach = 3.0 * np.sqrt(np.einsum("nii->ni", splats.covariances()))
    return np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)]).astype(np.float32)
