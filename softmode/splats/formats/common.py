"""What the readers and writers of splat files share: typed errors, bounded reads, quaternion and colour codes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import AssetError
from softmode.files import REEXPORT as REEXPORT
from softmode.files import damage_errors
from softmode.foreign.child.surface import near_zero
from softmode.splats.splats import MAX_SPLATS, SH_DC, Splats

FREE_BYTES = 8 * 2**20
"""Bytes that anything may unpack to however small it is: Zstandard and WebP pack what is all the same without limit."""
MAX_RATIO = 32
"""Largest ratio of unpacked to packed bytes that a reader accepts beyond that: real splats pack by less than ten."""

DROPPED_SHARE = 0.01
"""Share of rows dropped from which on a warning says so."""
ANTIALIASED = "trained with the filter of Mip-Splatting: draw it with antialiased=True, the default"
"""Said of files that say so of themselves."""


def unreadable(path: object, problem: str, hint: str = REEXPORT) -> AssetError:
    """Return the error of a splat file that cannot be read.

    Args:
        path: The file.
        problem: What is wrong.
        hint: The remedy.
    """
    return AssetError(f"splat file {path}: {problem}", hint=hint)


def typed_errors(name: str) -> AbstractContextManager[None]:
    """Return the context in which whatever reading a splat file raises becomes AssetError."""
    return damage_errors(f"splat file {name}")


def check_count(count: int, name: str) -> int:
    """Return the declared number of splats if a reader may allocate for it."""
    if not 0 < count <= MAX_SPLATS:
        raise unreadable(name, f"{count} splats, expected 1 to {MAX_SPLATS}", hint="Export the asset again, decimated")
    return count


def read_exactly(file: BinaryIO, size: int, path: Path) -> bytes:
    """Return the next `size` bytes of a file whose size has been checked."""
    data = file.read(size)
    if len(data) != size:
        raise unreadable(path, "shrank while it was read", hint="Read it again when nothing writes to it")
    return data


def exp_scales(log_scales: NDArray[Any]) -> NDArray[np.float32]:
    """Return exp(log_scales), kept above float32 underflow; zero of -infinity, NaN and infinity pass through."""
    with np.errstate(over="ignore", invalid="ignore"):
        finite = np.exp(np.maximum(log_scales, -40.0)).astype(np.float32)
    return np.where(np.isneginf(log_scales), np.float32(0.0), finite)


def sigmoid(logits: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return 1 / (1 + exp(-x)), NaN preserved."""
    return (1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0)))).astype(np.float32)


def sh_from_colors(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients of degree 0, shape (N, 1, 3), of colours 0..1, shape (N, 3)."""
    return ((colors - 0.5) / SH_DC)[:, None]


def unit_colors(colors: NDArray[Any]) -> tuple[NDArray[np.float64], str]:
    """Return colours 0..1 of integers, or of floats of 0..1 or 0..255, and what to say of the latter."""
    values = np.asarray(colors, dtype=np.float64)
    if np.issubdtype(np.asarray(colors).dtype, np.integer):
        return values / (65535.0 if values.size and values.max() > 255.0 else 255.0), ""
    if np.nanmax(np.abs(values), initial=0.0) <= 2.0:
        return np.clip(values, 0.0, 1.0), ""
    return np.clip(values / 255.0, 0.0, 1.0), "colours in floats are taken for 0..255"


def offset_note(offset: Sequence[float]) -> list[str]:
    """Return the note on an offset, none where there is none."""
    return ["coordinates are counted from ({:g}, {:g}, {:g}) on, the offset".format(*offset)] if any(offset) else []


def count_dropped(name: str, good: Mapping[str, Any], what: str = "splats") -> list[str]:
    """Return a note on rows that are dropped; a warning says it too if there are many, an error if none is left.

    Args:
        name: The file as messages call it.
        good: Which rows are sound, shape (N,), by what they would otherwise be.
        what: What a row is.
    """
    kept = np.logical_and.reduce(list(good.values()))
    if (bad := int((~kept).sum())) == 0:
        return []
    why = ", ".join(f"{int((~sound).sum())} {problem}" for problem, sound in good.items() if not sound.all())
    if not kept.any():
        raise AssetError(f"{name}: none of {len(kept)} {what} is sound ({why})", hint=REEXPORT)
    note = f"{bad} of {len(kept)} {what} dropped ({why})"
    if bad > DROPPED_SHARE * len(kept):
        remedy = "`softmode splat convert {} CLEAN.ply --drop-invalid` writes the others"
        path = name.removeprefix("splat file ")
        hint = remedy.format(path) if what == "splats" else "export it again without them"
        warnings.warn(f"{name}: {note}; {hint}", stacklevel=5)
    return [note]


def sound_splats(
    name: str,
    *,
    means: NDArray[Any],
    quats: NDArray[Any],
    scales: NDArray[Any],
    opacities: ArrayLike,
    sh: NDArray[Any],
    notes: Sequence[str] = (),
) -> Splats:
    """Return what a file of any format holds, by one rule; `Splats.notes` say what was done.

    Rows that are not finite, or have no rotation or no size, are dropped and counted. A scale of zero becomes a
    thousandth of the next: a disc. Opacities are clipped to 0..1, coefficients of degree 4 are left out, and centres
    far from zero are counted from an offset on, in float64.

    Args:
        name: The file as messages call it.
        means: Centres, shape (N, 3).
        quats: Rotations xyzw of any length, shape (N, 4).
        scales: Linear scales, shape (N, 3).
        opacities: Opacities, shape (N,).
        sh: Coefficients, shape (N, K, 3).
        notes: What is to be said beside.

    Raises:
        AssetError: If no splat is left.
    """
    told, opacity = list(notes), np.asarray(opacities)
    if sh.shape[1] > 16:
        told.append(f"spherical harmonics of degree {int(np.sqrt(sh.shape[1])) - 1} are cut to degree 3")
        sh = sh[:, :16]
    columns = {"means": means, "scales": scales, "opacities": opacity, "colours": sh}
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quats.astype(np.float64), axis=1)
        sound = {
            f"with {field} not finite": np.isfinite(value.reshape(len(means), -1).astype(np.float32)).all(axis=1)
            for field, value in columns.items()
        }
        sound["without a rotation"] = np.isfinite(length) & (length > 1e-8)
        sound["without a size"] = ~((scales < 0.0).any(axis=1) | (scales.max(axis=1, initial=0.0) <= 0.0))
    count, dropped = len(means), count_dropped(name, sound)
    if dropped:
        good, told = np.logical_and.reduce(list(sound.values())), told + dropped
        means, quats, scales, opacity, sh = (value[good] for value in (means, quats, scales, opacity, sh))
    if (flat := (scales == 0.0).any(axis=1)).any():
        told.append(f"{int(flat.sum())} discs, with a scale of zero, get a thousandth of their next one")
        least = np.where(scales > 0.0, scales, np.inf).min(axis=1, keepdims=True)
        scales = np.where(scales > 0.0, scales, 1e-3 * least)
    if beyond := int(((opacity < 0.0) | (opacity > 1.0)).sum()):
        told.append(f"{beyond} opacities outside 0..1 are clipped")
        opacity = np.clip(opacity, 0.0, 1.0)
    means, offset = near_zero(means)
    return Splats(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacity,
        sh=sh,
        name=name,
        offset=offset,
        notes=(*told, *offset_note(offset)),
        dropped_count=count - len(means),
    )


def quats_from_smallest_three(largest: NDArray[Any], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions, shape (N, 4), from three components and the index of the one left out.

    Args:
        largest: Index 0..3 of the component left out, the largest and positive, shape (N,).
        others: The other three in their order, shape (N, 3).
    """
    quats = np.empty((len(others), 4))
    missing = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    for index in range(4):
        chosen = largest == index
        quats[chosen, index] = missing[chosen]
        quats[np.ix_(chosen, [i for i in range(4) if i != index])] = others[chosen]
    return quats


def smallest_three_from_quats(quats: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the largest component, shape (N,), and the others in their order, shape (N, 3).

    The sign of the quaternion is chosen such that the largest component is positive.
    """
    q = np.asarray(quats, dtype=np.float64)
    rows = np.arange(len(q))
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(q[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    keep = np.arange(4) != largest[:, None]
    return largest, q[keep].reshape(-1, 3)


def to_unsigned(values: NDArray[Any], bits: int) -> NDArray[np.uint32]:
    """Return values of 0..1 rounded to integers of 0..2^bits - 1; values outside are clipped."""
    top = (1 << bits) - 1
    return np.rint(np.clip(values, 0.0, 1.0) * top).astype(np.uint32)
