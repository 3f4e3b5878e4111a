"""The cache of built bodies: a folder of files named by the fingerprint of what went in."""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import hashlib
import math
import os
import shutil
import stat
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from softmode.deformables.body.reduced_body import FORMAT_VERSION, ReducedBody
from softmode.errors import AssetError, ConfigError
from softmode.files import PendingFile, damage_errors, storage_errors
from softmode.leftovers import lock

Product = TypeVar("Product")
_SILENCE = 5.0
"""Time after which it is said that a lock is waited for [s]."""


def cached_body(
    key: tuple[Any, ...], build: Callable[[], ReducedBody], *, directory: str | os.PathLike[str] | None = None
) -> ReducedBody:
    """Return the body stored under a key, building it once when it is absent, damaged or not to be trusted.

    Processes that ask for one key at a time wait for the first: a lock file guards the build, an atomic rename
    publishes it. An entry holds its key. It is read only if that is what is asked for, and if it is a file, no link, of
    this user, of root or of whom the folder belongs to.

    Args:
        key: Everything the result depends on; see `fingerprint_of` for what can be hashed.
        build: Called without arguments when the cache has no usable entry.
        directory: Cache folder; default is `cache_directory()` / "bodies", or a temporary folder with a warning where
            that cannot be made or written to.

    Returns:
        The body.

    Raises:
        StorageError: If it cannot be kept there.
    """
    key = (FORMAT_VERSION, *key)
    return cached("bodies", key, build, ReducedBody.load, ReducedBody.save, directory=directory)


def cached(
    folder: str,
    key: tuple[Any, ...],
    make: Callable[[], Product],
    read: Callable[[Path], Product],
    write: Callable[[Product, Path], None],
    *,
    directory: str | os.PathLike[str] | None = None,
) -> Product:
    """Return what is stored under a key, making it once when it is absent or damaged; see `cached_body`.

    Args:
        folder: Folder in the cache.
        key: Everything that it depends on.
        make: Called when the cache has no usable entry.
        read: Reads it from a file, and raises `AssetError` where it cannot.
        write: Writes it to a file, which appears complete or not at all.
        directory: Folder in place of the one in the cache.
    """
    place = Path(directory) if directory is not None else cache_directory() / folder
    name = fingerprint_of(*key)
    path = place / f"{name}.npz"
    with contextlib.suppress(AssetError):
        return _checked(path, name, read)
    if directory is None:
        path = writable_cache(place) / path.name
    with _locked(path.with_suffix(".lock")):
        with contextlib.suppress(AssetError):
            return _checked(path, name, read)
        made = make()
        with PendingFile(path, "cache entry") as pending:
            write(made, pending.temporary)
            with zipfile.ZipFile(pending.temporary, "a") as archive:
                archive.comment = name.encode()
    return made


def _checked(path: Path, name: str, read: Callable[[Path], Product]) -> Product:
    """Return what an entry holds.

    Raises:
        AssetError: If it is not there, damaged, not of this key or not to be trusted.
    """
    with damage_errors(f"cache entry {path}", hint="remove it"):
        if not is_trusted(path):
            raise FileNotFoundError
        with zipfile.ZipFile(path) as archive:
            if archive.comment != name.encode():
                raise ValueError("it has another key")
    return read(path)


def is_trusted(path: Path) -> bool:
    """Return whether an entry is a file, no link, of this user, of root or of whom its folder belongs to."""
    try:
        found, owners = path.lstat(), {0, path.parent.stat().st_uid}
    except OSError:
        return False
    return stat.S_ISREG(found.st_mode) and found.st_uid in owners | ({os.getuid()} if hasattr(os, "getuid") else set())


def cache_directory() -> Path:
    """Return the user's cache folder: the environment variable SOFTMODE_CACHE, or ~/.cache/softmode."""
    override = os.environ.get("SOFTMODE_CACHE")
    return Path(override).expanduser() if override else Path.home() / ".cache" / "softmode"


def writable_cache(folder: Path) -> Path:
    """Return a cache folder, or one in a temporary folder where it cannot be made or written to.

    The temporary folder becomes SOFTMODE_CACHE of this process, so that its children share it, and ends with it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
        reason = "not writable"
    except OSError as error:
        reason = error.strerror or str(error)
    with storage_errors(f"cache folder {folder}"):
        temporary = tempfile.mkdtemp(prefix="softmode-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    os.environ["SOFTMODE_CACHE"] = temporary
    warnings.warn(
        f"the cache folder {folder} cannot be used ({reason}): bodies are kept in {temporary} until this process ends."
        " Set SOFTMODE_CACHE to a folder that can be written to",
        stacklevel=4,
    )
    return Path(temporary, folder.name)


def fingerprint_of(*values: object) -> str:
    """Return the sha256 of nested scalars, strings, bytes, files (paths), arrays, dataclasses, sequences, mappings."""
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, value: object) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape};".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Path):
        digest.update(f"file {value.stat().st_size};".encode())
        digest.update(value.read_bytes())
    elif isinstance(value, bytes):
        digest.update(f"bytes {len(value)};".encode() + value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__};".encode())
        for f in dataclasses.fields(value):
            _feed(digest, f.name)
            _feed(digest, getattr(value, f.name))
    elif isinstance(value, dict):
        digest.update(f"dict {len(value)};".encode())
        for key in sorted(value, key=str):
            _feed(digest, str(key))
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"sequence {len(value)};".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        item = value.item() if isinstance(value, np.generic) else value
        digest.update(f"{type(item).__name__} {item!r};".encode())
    else:
        raise ConfigError(f"key: cannot take the fingerprint of a {type(value).__name__}")


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file; the system releases it if the process dies."""
    with storage_errors(f"cache folder {path.parent}", hint="set SOFTMODE_CACHE to a folder that can be written to"):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        with storage_errors(f"lock {path}"):
            end = time.monotonic() + _SILENCE
            while not lock(file):
                if time.monotonic() > end:
                    print(f"softmode: waiting for another process, which holds {path}", file=sys.stderr, flush=True)
                    end = math.inf
                time.sleep(0.02)
        yield
    finally:
        os.close(file)
