"""Files that appear whole or not at all, files of strangers read within bounds, and archives of arrays."""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
import json
import math
import os
import stat
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, BasisError, ConfigError, SoftmodeError, StorageError, memory_errors
from softmode.leftovers import Claim

REEXPORT = "The file is damaged or incomplete: copy or export it again"
"""The remedy for a file that contradicts itself."""
PLACE_HINT = "check the folder, its permissions and the free space"
"""The remedy for a file that cannot be written."""
MAX_HEADER = 1 << 20
"""Largest header, and largest table of contents, of an archive that is read [bytes]."""
MAX_JSON = 16 << 20
"""Largest JSON file that is read [bytes]; the values that it becomes may take 24 times as much."""
UNPACKED_FREE, UNPACKED_RATIO = 64 << 20, 2
"""Bytes that the arrays of an archive may unpack to: so many, or so many for each byte of the file."""
_PACKED_FREE = 32 << 20
_CHUNK = 1 << 22
_P = ParamSpec("_P")
_T = TypeVar("_T")


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


# -- files of strangers -----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def damage_errors(
    what: str, *, hint: str = REEXPORT, error: type[SoftmodeError] = AssetError, arguments: bool = False
) -> Iterator[None]:
    """Turn whatever reading a file in a block raises into one typed error; typed errors pass, but those of arguments.

    What is raised with a `hint` of its own, as by `softmode.foreign.child`, keeps its text and hint.

    Args:
        what: The file, for the message.
        hint: The remedy.
        error: What is raised.
        arguments: Whether the block takes arguments of its caller, whose errors pass too.

    Raises:
        AssetError: Or ``error``, if the block raises anything that is not typed.
    """
    try:
        yield
    except (ConfigError, BasisError) as caught:  # what the file said was no good argument
        if arguments or isinstance(caught, error):
            raise
        raise error(f"{what}: {caught.message}", hint=caught.hint or hint) from caught
    except (SoftmodeError, Warning):
        raise
    except FileNotFoundError as caught:
        raise error(f"{what}: does not exist", hint=hint) from caught
    except MemoryError as caught:
        raise error(f"{what}: takes more memory than there is ({caught})", hint=hint) from caught
    except Exception as caught:  # zlib, struct and zipfile errors of a damaged file have no common base
        if isinstance(caught, OSError) and caught.strerror:
            raise error(f"{what}: cannot be read ({caught.strerror})", hint=hint) from caught
        said = str(caught)[:300]
        if own := getattr(caught, "hint", None):
            raise error(f"{what}: {said}", hint=own) from caught
        raise error(f"{what}: damaged or no such thing ({type(caught).__name__}: {said})", hint=hint) from caught


def reader(what: str) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorate a reader: whatever it raises, once called rightly, becomes an AssetError that names its first argument.

    Args:
        what: What is read, as messages call it.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def wrapped(*args: _P.args, **options: _P.kwargs) -> _T:
            given = signature.bind(*args, **options).arguments
            with damage_errors(f"{what} {next(iter(given.values()))}", arguments=True):
                return function(*args, **options)

        return wrapped

    return decorate


def open_file(
    path: str | os.PathLike[str],
    what: str = "file",
    *,
    hint: str = "check the path",
    error: type[SoftmodeError] = AssetError,
) -> io.BufferedReader:
    """Open a regular file for reading; a folder, pipe, socket or device is refused, never waited for.

    Args:
        path: The file.
        what: What it is, for messages.
        hint: The remedy if it cannot be opened.
        error: What is raised then.

    Raises:
        AssetError: Or ``error``, if there is no such file, or no file may have such a name.
    """
    with damage_errors(f"{what} {path}", hint=hint, error=error):
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise error(f"{what} {path}: is no regular file", hint=hint)
    return file


def read_file(
    path: str | os.PathLike[str],
    what: str = "file",
    *,
    limit: int | None = None,
    hint: str = "check the path",
    error: type[SoftmodeError] = AssetError,
) -> bytes:
    """Return the content of a regular file.

    Args:
        path: The file.
        what: What it is, for messages.
        limit: Most bytes that are read; None for any number.
        hint: The remedy if it cannot be read.
        error: What is raised then.

    Raises:
        AssetError: Or ``error``, if it cannot be read or is larger.
    """
    with open_file(path, what, hint=hint, error=error) as file:
        size = os.fstat(file.fileno()).st_size
        if limit is not None and size > limit:
            raise error(f"{what} {path}: has {size} bytes, at most {limit} are read", hint=hint)
        with damage_errors(f"{what} {path}", hint=hint, error=error):
            try:
                return file.read(size)
            except MemoryError as caught:
                raise MemoryError(f"{size} bytes") from caught


def read_json(
    path: str | os.PathLike[str],
    what: str = "file",
    *,
    hint: str = "check the path",
    error: type[SoftmodeError] = AssetError,
) -> Any:
    """Return the value in a JSON file of at most 16 MiB; arguments and errors are those of :func:`read_file`."""
    content = read_file(path, what, limit=MAX_JSON, hint=hint, error=error)
    with damage_errors(f"{what} {path}", hint=hint, error=error):
        return json.loads(content)


def require_content(path: Path, what: str) -> None:
    """Raise if a file holds nothing, is no regular file, or is a .ply by its name alone.

    Args:
        path: The file.
        what: What it is, for messages.

    Raises:
        AssetError: If it is empty or mislabelled, or cannot be opened.
    """
    with open_file(path, what) as file:
        head = file.read(80)
    if not head:
        raise AssetError(f"{what} {path}: the file is empty", hint="Copy or export it again")
    if path.suffix.lower() == ".ply" and not head.startswith(b"ply"):
        raise AssetError(
            f"{what} {path}: no .ply, it does not begin with 'ply'",
            hint="Name the file after its kind (.obj, .stl, ...)",
        )


# -- archives ---------------------------------------------------------------------------------------------------------


def open_zip(stream: BinaryIO) -> zipfile.ZipFile:
    """Return a zip archive whose table of contents is small and whose members lie side by side, not over each other.

    Raises:
        ValueError: If they do not; zipfile's own errors if it is no archive.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - (1 << 16) - 22))
    tail = stream.read()
    tables = [0]
    for at in (len(tail) - 22, tail.rfind(b"PK\5\6")):  # where zipfile looks for the end of the table
        if tail[at : at + 4] == b"PK\5\6":
            tables.append(int.from_bytes(tail[at + 12 : at + 16], "little"))
            if tail[at - 20 : at - 16] == b"PK\6\7":  # zip64, which stands before it
                tables[-1] = int.from_bytes(tail[at - 36 : at - 28], "little")
    if max(tables) > MAX_HEADER:
        raise ValueError(f"its table of contents has {max(tables)} bytes, at most {MAX_HEADER}")
    archive = zipfile.ZipFile(stream)
    if (packed := sum(member.compress_size for member in archive.infolist())) > size:
        raise ValueError(f"its members overlap: {packed} bytes in a file of {size}")
    return archive


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
    source = io.BytesIO(path) if isinstance(path, bytes) else open_file(path, what, hint=hint, error=error)
    path = "of bytes" if isinstance(path, bytes) else path
    with source, damage_errors(f"{what} {path}", hint=hint, error=error):
        arrays = _arrays(source, None, stored=True)
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
    free: int = UNPACKED_FREE,
) -> dict[str, NDArray[Any]]:
    """Read arrays of an .npz that anybody may have written; no code in it is run.

    Args:
        path: The file.
        names: Which arrays, as far as they are there; all if None.
        what: What it is, for messages.
        hint: The remedy if it cannot be read.
        error: What is raised then.
        free: Bytes that they may unpack to however small the file is; a reader that makes much of them takes few.

    Raises:
        AssetError: Or ``error``, if the file is missing, damaged or no .npz.
    """
    with open_file(path, what, hint=hint, error=error) as file, damage_errors(f"{what} {path}", hint=hint, error=error):
        return _arrays(file, names, free)


def array_names(path: str | os.PathLike[str], what: str = "file", *, hint: str = "write it again") -> set[str]:
    """Return the names of the arrays of an .npz, of which none is read.

    Raises:
        AssetError: If the file is missing, damaged or no .npz.
    """
    with open_file(path, what, hint=hint) as file, damage_errors(f"{what} {path}", hint=hint):
        return {name.removesuffix(".npy") for name in open_zip(file).namelist()}


def write_compressed(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], what: str = "archive") -> None:
    """Write arrays as one .npz, packed if :func:`read_arrays` would unpack it; the file appears whole or not at all.

    Args:
        path: The file.
        arrays: Numbers and texts by name.
        what: What it is, for messages.

    Raises:
        StorageError: If it cannot be written.
    """
    with whole_file(path, what) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
        if sum(array.nbytes for array in arrays.values()) + MAX_HEADER > max(
            _PACKED_FREE, UNPACKED_RATIO * file.tell()
        ):
            file.seek(0)
            np.savez(file, allow_pickle=False, **arrays)
            file.truncate()


def _arrays(
    stream: BinaryIO, names: Collection[str] | None, free: int = UNPACKED_FREE, *, stored: bool = False
) -> dict[str, NDArray[Any]]:
    """Return arrays of an .npz; what they take is known and bounded before any of them is read.

    Args:
        stream: The file.
        names: Which, as far as they are there; all if None.
        free: Bytes that they may unpack to however small the file is.
        stored: Whether it is an archive of :func:`write_archive`: nothing is packed, and all are plain numbers.

    Raises:
        ValueError: If it is anything else; and what zipfile and zlib raise.
    """
    arrays: dict[str, NDArray[Any]] = {}
    with open_zip(stream) as archive:
        room = max(free, UNPACKED_RATIO * stream.seek(0, os.SEEK_END))
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        if len(members) < len(archive.infolist()):
            raise ValueError("a name is there twice")
        members = {name: member for name, member in members.items() if names is None or name in names}
        if (unpacked := sum(member.file_size for member in members.values())) > room:
            raise ValueError(f"it unpacks to {unpacked} bytes, at most {room} do; numpy.savez does not pack")
        for name, member in members.items():
            if member.compress_type not in (zipfile.ZIP_STORED, *(() if stored else (zipfile.ZIP_DEFLATED,))):
                raise ValueError(f"{name} is packed by method {member.compress_type}")
            if name == "header" and member.file_size > MAX_HEADER:
                raise ValueError("the header is too large")
            with archive.open(member) as content:
                arrays[name] = _array(content, member.file_size, name, "fiu" if stored else "fiubU")
    return arrays


def _array(content: IO[bytes], size: int, name: str, kinds: str) -> NDArray[Any]:
    """Return the array in a .npy file of so many bytes, in the order that it was written in."""
    version = np.lib.format.read_magic(content)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{name} has another version of the .npy format")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(content)
    if dtype.kind not in kinds or not dtype.itemsize:
        raise ValueError(f"{name} holds no plain numbers")
    count = math.prod(shape)
    if any(n < 0 for n in shape) or count * dtype.itemsize != size - content.tell():
        raise ValueError(f"{name} has another size than its shape says")
    if math.prod(max(n, 1) for n in shape) > max(size, UNPACKED_FREE):  # what is empty may be long all the same
        raise ValueError(f"{name} has the shape {shape}")
    flat = np.empty(count, dtype)
    octets = flat.view(np.uint8)
    for at in range(0, len(octets), _CHUNK):
        part = content.read(min(_CHUNK, len(octets) - at))
        octets[at : at + len(part)] = np.frombuffer(part, np.uint8)
        if len(part) < min(_CHUNK, len(octets) - at):
            raise EOFError(f"{name} ends too soon")
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
