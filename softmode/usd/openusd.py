"""OpenUSD's own modules, loaded when needed, and files of it that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from softmode.errors import ConfigError, MissingExtraError
from softmode.files import PendingFile, check_place
from softmode.foreign.openusd import pxr

SUFFIXES = (".usdc", ".usd", ".usda")
"""What can be written: binary, binary, text."""


def openusd(*names: str) -> list[Any]:
    """Return modules of OpenUSD, such as "Usd" and "Gf".

    Raises:
        MissingExtraError: If usd-core is not installed, or too old for splats.
    """
    try:
        return pxr(*names)
    except ImportError as error:
        raise MissingExtraError(
            "OpenUSD stages need usd-core", hint="install it with: pip install 'softmode[usd]'"
        ) from error


def checked_target(path: str | os.PathLike[str]) -> Path:
    """Return the path of a stage to write.

    Raises:
        ConfigError: If the name has another suffix, or is that of a folder.
    """
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"stage {target}: cannot write {target.suffix!r}", hint="name it .usdc, .usd or .usda")
    if target.is_dir():
        raise ConfigError(f"stage {target} is a folder", hint="name a file in it, like scene.usdc")
    return target


def check_stage(path: str | os.PathLike[str]) -> Path:
    """Return the path of a stage that can be written where its name says, before anything is worth writing.

    Raises:
        ConfigError: As by `checked_target`.
        MissingExtraError: If the extra `[usd]` is not installed.
        StorageError: If the folder, or the nearest one above that exists, cannot be written to.
    """
    openusd("Usd")
    target = checked_target(path)
    check_place(target, "stage")
    return target


@contextlib.contextmanager
def whole_stage(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the name of a file beside `path` that takes its place when the block ends without an error.

    OpenUSD opens files by name, and what a name says is how it writes: the yielded one has the suffix of `path`.

    Raises:
        ConfigError: If the suffix is none of OpenUSD's.
        StorageError: If the file cannot be written; nothing is left behind.
    """
    with PendingFile(checked_target(path), "stage", make_folders=False) as file:
        yield file.temporary
