"""What the readers and writers of splat files share: typed errors, bounded reads, quaternion and colour codes."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError
from softmode.files import REEXPORT as REEXPORT
from softmode.files import damage_errors
from softmode.splats.splats import MAX_SPLATS, SH_DC

FREE_BYTES = 8 * 2**20
"""Bytes that anything may unpack to however small it is: Zstandard and WebP pack what is all the same without limit."""
MAX_RATIO = 32
"""Largest ratio of unpacked to packed bytes that a reader accepts beyond that: real splats pack by less than ten."""


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
    """Return exp(log_scales), kept above float32 underflow; NaN and infinity pass through, `Splats` refuses them."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.exp(np.where(log_scales < -40.0, np.where(np.isinf(log_scales), np.nan, -40.0), log_scales)).astype(
            np.float32
        )


def sigmoid(logits: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return 1 / (1 + exp(-x)), NaN preserved."""
    return (1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0)))).astype(np.float32)


def sh_from_colors(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients of degree 0, shape (N, 1, 3), of colours 0..1, shape (N, 3)."""
    return ((colors - 0.5) / SH_DC)[:, None]


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
