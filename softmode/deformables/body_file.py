"""Files of reduced bodies: one .npz without pickle, arrays by name and everything else in a JSON header."""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softmode.atomic import atomic_write
from softmode.errors import AssetError, BasisError

if TYPE_CHECKING:
    from softmode.deformables.reduced_body import ReducedBody

FORMAT = "softmode.ReducedBody"
FORMAT_VERSION = 2


def write_body(body: ReducedBody, path: str | os.PathLike[str]) -> None:
    """Write a body; the file appears complete or not at all."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    header: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION}
    arrays: dict[str, Any] = {}
    for f in dataclasses.fields(body):
        value = getattr(body, f.name)
        if isinstance(value, np.ndarray):
            arrays[f.name] = value
        else:
            header[f.name] = value
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with atomic_write(target) as file:
        np.savez(file, **arrays)


def read_body(cls: type[ReducedBody], path: str | os.PathLike[str]) -> ReducedBody:
    """Read a file written by `write_body`.

    Raises:
        AssetError: If the file is missing, damaged, foreign, or of another version.
    """
    hint = "Build the body again."
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {key: file[key] for key in file.files}
    except FileNotFoundError as error:
        raise AssetError(f"body file {path}: does not exist", hint=hint) from error
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError, MemoryError) as error:
        raise AssetError(f"body file {path}: damaged or not an .npz ({error})", hint=hint) from error
    except Exception as error:  # zlib and struct errors of a damaged archive have no common base.
        raise AssetError(f"body file {path}: damaged ({type(error).__name__}: {error})", hint=hint) from error
    try:
        header = json.loads(stored.pop("header").tobytes().decode())
    except (KeyError, ValueError) as error:
        raise AssetError(f"body file {path}: not a softmode body", hint=hint) from error
    if not isinstance(header, dict) or header.pop("format", None) != FORMAT:
        raise AssetError(f"body file {path}: not a softmode body", hint=hint)
    version = header.pop("version", None)
    if version != FORMAT_VERSION:
        raise AssetError(f"body file {path}: format version {version}, this softmode reads {FORMAT_VERSION}", hint=hint)
    names = {f.name for f in dataclasses.fields(cls)}
    if set(header) | set(stored) != names:
        raise AssetError(
            f"body file {path}: fields {sorted(names ^ (set(header) | set(stored)))} do not match", hint=hint
        )
    try:
        body = cls(**{**header, "region_names": tuple(header["region_names"])}, **stored)
        body.check()
    except BasisError as error:
        raise AssetError(f"body file {path}: {error.message}", hint=hint) from error
    except (TypeError, IndexError, AttributeError, KeyError, ValueError) as error:
        raise AssetError(f"body file {path}: a field has another type or shape ({error})", hint=hint) from error
    return body
