"""Files that appear whole or not at all, archives of arrays, and one error for what cannot be written."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, SoftmodeError, StorageError, memory_errors
from softmode.leftovers import Claim

PLACE_HINT = "check the folder, its permissions and the free space"
"""The remedy for a file that cannot be written."""
MAX_HEADER = 1 << 20
"""Largest header of an archive that is read [bytes]."""


@contextlib.contextmanager
def storage_errors(
    target: object, *, hint: str = PLACE_HINT, error: type[StorageError] = StorageError
) -> Iterator[None]:
    """Turn what the file system raises in a block into one typed error.

    Args:
        target: What is written, for the message.
        hint: The remedy.
        error: What is raised.

    Raises:
        StorageError: Or ``error``, if the block raises OSError.
    """
    try:
        yield
    except OSError as caught:
        if isinstance(caught, error):
            raise
        known = caught.message if isinstance(caught, StorageError) else None
        raise error(known or f"{target} cannot be written ({caught.strerror or caught})", hint=hint) from caught


def sync(path: Path) -> None:
    """Make sure that a file's bytes are on the disk before it is renamed."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


class PendingFile:
    """A file that is written under a temporary name beside it, and that appears whole or not at all.

    As a context it takes its place when the block ends without an error. Readers see the old content or the new, never
    a part. It has the permissions that the umask asks for. What a process that was killed left in the folder is
    removed.

    Args:
        path: The file to be.
        what: What it is, for messages.
        make_folders: Make missing folders; they are removed again if the file does not come to be.

    Raises:
        StorageError: If it cannot be written there.
    """

    def __init__(self, path: str | os.PathLike[str], what: str = "file", *, make_folders: bool = True) -> None:
        """Claim the temporary file."""
        self.path = Path(path)
        self._claim: Claim | None = None
        self._what = f"{what} {self.path}"
        try:
            with storage_errors(self._what):
                if self.path.is_dir():
                    raise IsADirectoryError("it is a folder")
                self._claim = Claim(self.path, make_folders=make_folders)
                self.temporary = self._claim.name(self.path.suffix)
                """Where to write."""
                self.temporary.open("xb").close()
        except BaseException:
            self.discard()
            raise

    def publish(self) -> None:
        """Put the file in its place."""
        with storage_errors(self._what):
            sync(self.temporary)
            os.replace(self.temporary, self.path)
        self.discard()

    def discard(self) -> None:
        """Remove what was not published."""
        if self._claim is not None:
            self._claim.release()

    def __enter__(self) -> PendingFile:
        """Return the file."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Publish after a block without an error, discard otherwise."""
        try:
            with storage_errors(self._what):
                if isinstance(error, OSError):
                    raise error
                if error is None:
                    self.publish()
        finally:
            self.discard()


def check_place(path: str | os.PathLike[str], what: str = "file", *, make_folders: bool = True) -> None:
    """Refuse a place that cannot be written to, before any work is done.

    Args:
        path: The file to be.
        what: What it is, for messages.
        make_folders: Missing folders will be made.

    Raises:
        StorageError: If it cannot be written there.
    """
    folder = Path(path).absolute().parent
    while make_folders and not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise StorageError(
            f"{what} {path} cannot be written: there is no folder {folder}", hint="make the folder first"
        )
    if Path(path).is_dir() or not os.access(folder, os.W_OK):
        raise StorageError(f"{what} {path} cannot be written there", hint="choose another name or folder")


def free_name(path: Path) -> Path:
    """Return the path, or one with a number behind its stem, that is not there and that nobody is writing."""
    found, k = path, 0
    while found.exists() or any(found.parent.glob(f".{found.stem}-*.lock")):
        k += 1
        found = path.with_stem(f"{path.stem}-{k}")
    return found


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str], what: str = "file", *, make_folders: bool = True) -> Iterator[BinaryIO]:
    """Yield a binary file that takes the place of ``path`` when the block ends without an error.

    Args:
        path: The file to write.
        what: What it is, for messages.
        make_folders: Make missing folders.

    Raises:
        StorageError: If the file cannot be written; nothing is left behind.
    """
    pending = PendingFile(path, what, make_folders=make_folders)
    with pending, pending.temporary.open("wb") as file:
        yield file


# -- archives ---------------------------------------------------------------------------------------------------------


def require_content(path: Path, name: str) -> None:
    """Raise if a file holds nothing, or is a .ply by its name alone.

    Args:
        path: A file that exists.
        name: What messages call it.

    Raises:
        AssetError: If it is empty or mislabelled.
    """
    with path.open("rb") as file:
        head = file.read(80)
    if not head:
        raise AssetError(f"{name}: the file is empty", hint="Copy or export it again")
    if path.suffix.lower() == ".ply" and not head.startswith(b"ply"):
        raise AssetError(
            f"{name}: no .ply, it does not begin with 'ply'", hint="Name the file after its kind (.obj, .stl, ...)"
        )


@contextlib.contextmanager
def damage_errors(what: str, *, hint: str, error: type[SoftmodeError] = AssetError) -> Iterator[None]:
    """Turn whatever reading an .npz in a block raises into one typed error.

    Args:
        what: The file, for the message.
        hint: The remedy.
        error: What is raised.

    Raises:
        AssetError: Or ``error``, if the block raises anything.
    """
    try:
        yield
    except FileNotFoundError as caught:
        raise error(f"{what}: does not exist", hint=hint) from caught
    except Exception as caught:  # zlib, struct and zipfile errors of a damaged archive have no common base
        raise error(f"{what}: damaged or no .npz ({type(caught).__name__}: {caught})", hint=hint) from caught


def write_archive(
    path: str | os.PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], what: str = "archive"
) -> None:
    """Write arrays and a header as one .npz without pickle; the file appears complete or not at all.

    Args:
        path: The file.
        header: What is no array, as JSON can hold it, with `format`, the kind of the archive, and its `version`.
        arrays: Numbers by name; "header" is taken.
        what: What it is, for messages.

    Raises:
        StorageError: If it cannot be written; what was there before stays.
    """
    content = archive_bytes(header, arrays)
    with whole_file(path, what) as file:
        file.write(content)


def archive_bytes(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the bytes of the file that :func:`write_archive` writes."""
    stored = {**arrays, "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}
    stream = io.BytesIO()
    with memory_errors("an archive", size=2 * sum(array.nbytes for array in stored.values())):
        np.savez(stream, allow_pickle=False, **stored)
        return stream.getvalue()


def read_archive(
    path: str | os.PathLike[str] | bytes,
    kind: str,
    version: int | Collection[int],
    *,
    what: str = "archive",
    hint: str = "write it again",
    error: type[SoftmodeError] = AssetError,
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read a file that :func:`write_archive` wrote; no code in it is run, nothing larger than the file is allocated.

    Args:
        path: The file, or its bytes.
        kind: Its `format`.
        version: Its `version`, or all that are read.
        what: What it is, for messages.
        hint: The remedy if it cannot be read.
        error: What is raised then.

    Returns:
        The header without format and version, and the arrays by name.

    Raises:
        AssetError: Or ``error``, if the file is missing, damaged, of another kind or of another version.
    """
    source, path = (io.BytesIO(path), "of bytes") if isinstance(path, bytes) else (Path(path), path)
    with damage_errors(f"{what} {path}", hint=hint, error=error):
        arrays = _stored_arrays(source)
        header = json.loads(arrays.pop("header").tobytes()) if "header" in arrays else None
    if not isinstance(header, dict) or header.pop("format", None) != kind:
        raise error(f"{what} {path}: not a {kind}", hint=hint)
    read = (version,) if isinstance(version, int) else tuple(version)
    if (found := header.pop("version", None)) not in read:
        raise error(
            f"{what} {path}: format version {found}, this softmode reads {' and '.join(map(str, read))}", hint=hint
        )
    return header, arrays


def read_arrays(
    path: str | os.PathLike[str],
    names: Collection[str] | None = None,
    *,
    what: str = "file",
    hint: str = "write it again",
    error: type[SoftmodeError] = AssetError,
) -> dict[str, NDArray[Any]]:
    """Read arrays of an .npz that anybody may have written; no code in it is run.

    Args:
        path: The file.
        names: Which arrays, as far as they are there; all if None.
        what: What it is, for messages.
        hint: The remedy if it cannot be read.
        error: What is raised then.

    Raises:
        AssetError: Or ``error``, if the file is missing, damaged or no .npz.
    """
    with damage_errors(f"{what} {path}", hint=hint, error=error), np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files if names is None or name in names}


def _stored_arrays(source: Path | io.BytesIO) -> dict[str, NDArray[Any]]:
    """Return the arrays of an uncompressed .npz."""
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(source) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
                raise ValueError(f"{name} is compressed")
            if name == "header" and member.file_size > MAX_HEADER:
                raise ValueError("the header is too large")
            if name in arrays:
                raise ValueError(f"{name} is there twice")
            arrays[name] = _parsed_array(archive.read(member), name)
    return arrays


def _parsed_array(content: bytes, name: str) -> NDArray[Any]:
    """Return the array in the bytes of a .npy file of numbers, in the order that it was written in."""
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} has another version of the .npy format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in "fiu" or dtype.hasobject:
        raise ValueError(f"{name} holds no plain numbers")
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(f"{name} has another size than its shape says")
    flat = np.frombuffer(content, dtype, offset=stream.tell()).copy()
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
