"""Files of reduced bodies: one .npz without pickle, arrays by name and everything else in a JSON header.

A file may carry arrays of others beside the body, under names with a dot (`splats.means`); readers of bodies skip them.
"""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softmode.errors import AssetError, BasisError
from softmode.files import atomic_write

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody

FORMAT = "softmode.ReducedBody"
FORMAT_VERSION = 2


def write_body(
    body: ReducedBody, path: str | os.PathLike[str], *, beside: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write a body; the file appears complete or not at all.

    Args:
        body: The body.
        path: The file; its folder is made if it is missing.
        beside: Arrays to store beside the body, by names with a dot.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    header, arrays = body_fields(body)
    stored = {**arrays, "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}
    stored |= dict(beside or {})
    with atomic_write(target) as file:
        np.savez(file, **stored)  # type: ignore[arg-type]


def body_fields(body: ReducedBody) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what is no array, with the format and its version, ready for JSON, and the arrays by name."""
    header: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION}
    arrays: dict[str, np.ndarray] = {}
    for f in dataclasses.fields(body):
        value = getattr(body, f.name)
        if isinstance(value, np.ndarray):
            arrays[f.name] = value
        else:
            header[f.name] = value
    return header, arrays


def read_body(cls: type[ReducedBody], path: str | os.PathLike[str]) -> ReducedBody:
    """Read a file written by `write_body`.

    Raises:
        AssetError: If the file is missing, damaged, foreign, or of another version.
    """
    hint = "Build the body again."
    stored = _read_arrays(path, lambda name: "." not in name, hint)
    try:
        header = json.loads(stored.pop("header").tobytes().decode())
    except (KeyError, ValueError) as error:
        raise AssetError(f"body file {path}: not a softmode body", hint=hint) from error
    return body_from_fields(cls, header, stored, f"body file {path}", hint=hint)


def read_beside(path: str | os.PathLike[str], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays that a body's file carries under names that begin with `prefix`, which has a dot.

    Raises:
        AssetError: If the file is missing or damaged.
    """
    return _read_arrays(path, lambda name: name.startswith(prefix), "Build the body again.")


def _read_arrays(path: str | os.PathLike[str], wanted: Callable[[str], bool], hint: str) -> dict[str, np.ndarray]:
    """Return arrays of an .npz by name."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files if wanted(key)}
    except FileNotFoundError as error:
        raise AssetError(f"body file {path}: does not exist", hint=hint) from error
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError, MemoryError) as error:
        raise AssetError(f"body file {path}: damaged or not an .npz ({error})", hint=hint) from error
    except Exception as error:  # zlib and struct errors of a damaged archive have no common base.
        raise AssetError(f"body file {path}: damaged ({type(error).__name__}: {error})", hint=hint) from error


def body_from_fields(
    cls: type[ReducedBody], header: Any, arrays: dict[str, np.ndarray], source: str, *, hint: str = "Build it again."
) -> ReducedBody:
    """Return the body of what `body_fields` returned, checked.

    Args:
        cls: ReducedBody.
        header: What is no array.
        arrays: The arrays by name.
        source: Where they come from, for messages.
        hint: The remedy.

    Raises:
        AssetError: If they are foreign, of another version, or not those of a body.
    """
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise AssetError(f"{source}: not a softmode body", hint=hint)
    fields = {name: value for name, value in header.items() if name not in ("format", "version")}
    version = header.get("version")
    if version != FORMAT_VERSION:
        raise AssetError(f"{source}: format version {version}, this softmode reads {FORMAT_VERSION}", hint=hint)
    names = {f.name for f in dataclasses.fields(cls)}
    if set(fields) | set(arrays) != names or set(fields) & set(arrays):
        raise AssetError(f"{source}: fields {sorted(names ^ (set(fields) | set(arrays)))} do not match", hint=hint)
    try:
        values: dict[str, Any] = {**fields, **arrays, "region_names": tuple(fields["region_names"])}
        body = cls(**values)
        body.check()
    except BasisError as error:
        raise AssetError(f"{source}: {error.message}", hint=hint) from error
    except (TypeError, IndexError, AttributeError, KeyError, ValueError) as error:
        raise AssetError(f"{source}: a field has another type or shape ({error})", hint=hint) from error
    return body
