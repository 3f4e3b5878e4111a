"""Names to write under until a file is whole; what the dead left under theirs is removed at the next write."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import secrets
import shutil
import sys
import time
from pathlib import Path

_LOCK = re.compile(r"(\..*-[0-9a-f]{12})\.lock")
_PATIENCE = 86400.0
"""Time for which what another system may still write is left alone after its last change [s]: on some shared folders a
lock holds on one system only."""
_FLAGS = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class Claim:
    """Hidden names beside a file, or folder, that all begin with a prefix of this claim's own.

    A lock file says that whoever writes there lives: the system lets go of it when its process ends, however that is.
    A later claim in the folder removes what has no such lock any more; where there are no locks, nothing.

    Args:
        path: The file that is to be.
        make_folders: Make missing folders; they are removed again if nothing is put there.

    Raises:
        OSError: If nothing can be written there.
    """

    def __init__(self, path: Path, *, make_folders: bool = True) -> None:
        """Remove what the dead have left, then take the prefix."""
        self._folder, self._prefix = path.parent, f".{path.stem[:40]}-{secrets.token_hex(6)}"
        self._made = [folder for folder in path.absolute().parents if make_folders and not folder.exists()]
        self._file: int | None = None
        try:
            if make_folders:
                self._folder.mkdir(parents=True, exist_ok=True)
            _remove_leftovers(self._folder)
            self._file = os.open(self.name(".lock"), _FLAGS | os.O_CREAT | os.O_EXCL, 0o666)
            with contextlib.suppress(OSError):
                while not lock(self._file):  # a claim that looks for leftovers has it for a moment
                    time.sleep(0.001)
            os.write(self._file, _system())
        except BaseException:
            self.release()
            raise

    def name(self, suffix: str = "") -> Path:
        """Return the claimed name with a suffix."""
        return self._folder / (self._prefix + suffix)

    def release(self) -> None:
        """Remove what is left under the prefix; harmless twice."""
        if self._file is not None:
            file, self._file = self._file, None
            _remove(self._folder, self._prefix)
            os.close(file)
            self.name(".lock").unlink(missing_ok=True)  # which Windows keeps while it is open
        for folder in self._made:
            with contextlib.suppress(OSError):  # where something was put
                folder.rmdir()


def lock(file: int) -> bool:
    """Take the exclusive lock on an open file, unless another has it; the system drops it with the process.

    Raises:
        OSError: If the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # the latter on Windows
        return False
    return True


def _system() -> bytes:
    """Return what names the running system; among its own processes locks hold."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_bytes()
    return platform.node().encode()


def _remove_leftovers(folder: Path) -> None:
    """Remove what ended processes left in a folder."""
    for prefix in [found[1] for name in os.listdir(folder) if (found := _LOCK.fullmatch(name))]:
        with contextlib.suppress(OSError):  # of one that has gone, or is another user's
            file = os.open(folder / f"{prefix}.lock", _FLAGS)
            try:
                if lock(file) and (os.read(file, 256) in (b"", _system()) or _age(folder, prefix) > _PATIENCE):
                    _remove(folder, prefix)
            finally:
                os.close(file)


def _under(folder: Path, prefix: str) -> list[Path]:
    """Return what lies under a prefix, its lock file last."""
    found = [folder / name for name in os.listdir(folder) if name.startswith(prefix)]
    return sorted(found, key=lambda path: path.suffix == ".lock")


def _age(folder: Path, prefix: str) -> float:
    """Return for how long nothing under a prefix has changed [s]."""
    return time.time() - max(path.lstat().st_mtime for path in _under(folder, prefix))


def _remove(folder: Path, prefix: str) -> None:
    """Remove what lies under a prefix."""
    for path in _under(folder, prefix):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
