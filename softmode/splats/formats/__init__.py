"""Splat files: one entry to read, one to write, by suffix; one module per format.

Readers return the asset as it is stored, in the asset's own frame and unit. Trained assets mostly keep the OpenCV-like
frame of their training cameras (x right, y down, z forward), so `splats.oriented("-y")` sets them upright; assets made
with modelling tools may need `"+y"`. Only OpenUSD says which axis points up and how long its unit is; its reader
returns metres with z up. All readers are bounded: declared sizes are compared with the file before anything is
allocated.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from softmode.errors import ConfigError
from softmode.splats.formats.common import typed_errors, unreadable
from softmode.splats.formats.compressed_ply import write_compressed_ply
from softmode.splats.formats.others import refuse_others
from softmode.splats.formats.ply import read_ply, write_ply
from softmode.splats.formats.sog import read_sog
from softmode.splats.formats.splat import read_splat, write_splat
from softmode.splats.formats.spz import read_spz, write_spz
from softmode.splats.formats.usd import read_usd, write_usd
from softmode.splats.splats import Splats, UpAxis, up_rotation

__all__ = [
    "CONVENTIONS",
    "READABLE",
    "WRITABLE",
    "read_splats",
    "read_usd",
    "write_compressed_ply",
    "write_ply",
    "write_splat",
    "write_splats",
    "write_spz",
    "write_usd",
]

_USD = (".usd", ".usda", ".usdc")
_READERS: dict[str, Callable[[Path], Splats]] = {
    ".ply": read_ply,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".json": read_sog,
    **dict.fromkeys((*_USD, ".usdz"), read_usd),
}
_WRITERS: dict[str, Callable[[Path, Splats], None]] = {
    ".compressed.ply": write_compressed_ply,
    ".ply": write_ply,
    ".splat": write_splat,
    ".spz": write_spz,
    **dict.fromkeys(_USD, write_usd),
}

Convention = Literal["z-up", "spz", "trained"]
CONVENTIONS: dict[Convention, UpAxis] = {"z-up": "+z", "spz": "+y", "trained": "-y"}
"""Which axis is up in a written file, by the name of a convention: softmode's own; that of the SPZ specification, of
glTF and of three.js; that of the cameras which splats are trained with, and of most .ply. docs/splat_files.md says who
expects which."""

READABLE = tuple(_READERS)
"""Suffixes that `read_splats` knows; `.ply` covers `.compressed.ply`, `.json` is the meta.json of a SOG v2 folder."""

WRITABLE = tuple(_WRITERS)
"""Suffixes that `write_splats` knows."""


def read_splats(path: str | os.PathLike[str]) -> Splats:
    """Read a splat file of any kind that softmode knows, told by its suffix.

    Args:
        path: An INRIA `.ply`, a PlayCanvas `.compressed.ply`, a `.splat`, a `.spz` (versions 1 to 4), a SOG v2 folder,
            its `meta.json` or a `.sog` archive, or an OpenUSD file (`.usd`, `.usda`, `.usdc`, `.usdz`) with
            `ParticleField3DGaussianSplat` prims.

    Returns:
        The splats as stored, in the asset's own frame and unit; of OpenUSD in metres with z up.

    Raises:
        AssetError: If the file is missing, of another kind, truncated, damaged, or holds no usable splats.
        MissingExtraError: If the format needs an extra that is not installed: `[usd]` for OpenUSD, `[spz]` for SPZ
            version 4.
    """
    file = Path(path)
    with typed_errors(str(file)):
        if file.is_dir():
            return read_sog(file)
        if not file.exists():
            raise unreadable(file, "no such file", hint="Check the path")
        reader = _READERS.get(file.suffix.lower())
        if reader is None:
            refuse_others(file)
            raise unreadable(
                file,
                f"unknown kind {file.suffix.lower() or '(no suffix)'!r}",
                hint=f"Readable are {', '.join(READABLE)}; convert others with SuperSplat or splat-transform",
            )
        return reader(file)


def write_splats(path: str | os.PathLike[str], splats: Splats, *, up: UpAxis = "+z") -> None:
    """Write a splat file of the kind that the suffix names; the file appears complete or not at all.

    Args:
        path: File to write: `.ply` (exact), `.compressed.ply`, `.spz`, `.splat`, or OpenUSD `.usd`, `.usda`, `.usdc`
            (exact). What each format loses stands in docs/splat_files.md. The folder must exist.
        splats: What to write.
        up: Axis of the file onto which +Z of the splats is turned, such as `CONVENTIONS["spz"]`; see there. "+z" writes
            the splats as they are. OpenUSD files say which axis is up and take "+z" only.

    Raises:
        AssetError: If the suffix names no writable format.
        StorageError: If the file cannot be written.
        ConfigError: If `up` is no axis, or not "+z" for OpenUSD.
        MissingExtraError: If OpenUSD is to be written without the extra `[usd]`.
    """
    file = Path(path)
    suffix = next((known for known in _WRITERS if file.name.lower().endswith(known)), None)
    if suffix is None:
        raise unreadable(
            file, f"cannot write {file.suffix.lower() or '(no suffix)'!r}", hint=f"Writable are {', '.join(WRITABLE)}"
        )
    if up != "+z":
        if suffix in _USD:
            raise ConfigError(
                f"splat file {file}: up is {up!r}, but an OpenUSD stage says itself that z is up",
                hint='Leave up="+z" for OpenUSD; viewers and readers turn the stage',
            )
        splats = splats.transformed(rotation=up_rotation(up).T)
    _WRITERS[suffix](file, splats)
