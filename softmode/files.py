"""Writing files that appear complete or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from softmode.errors import ConfigError


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a binary file beside ``path`` that takes its place when the block ends without an error.

    The file has the permissions that the umask asks for. Readers see the old content or the new, never a part.

    Args:
        path: The file to write; its folder must exist.

    Raises:
        OSError: If the file cannot be written; nothing is left behind.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


class PendingFile:
    """A file that something else writes under a temporary name beside it, and that appears whole or not at all.

    Args:
        path: The file to be; missing folders are made, and removed again if it does not come to be.
        what: What it is, for messages.

    Raises:
        ConfigError: If it cannot be written there.
    """

    def __init__(self, path: str | os.PathLike[str], what: str) -> None:
        """Claim the temporary file."""
        self.path = Path(path)
        self._made = [folder for folder in self.path.absolute().parents if not folder.exists()]
        self.temporary = self.path.with_name(f".{self.path.stem}-{secrets.token_hex(6)}{self.path.suffix}")
        """Where to write."""
        try:
            if self.path.is_dir():
                raise IsADirectoryError(f"{self.path} is a folder")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.temporary.open("xb").close()  # with the permissions that the umask asks for
        except OSError as error:
            self.discard()
            raise ConfigError(
                f"{what} {self.path} cannot be written: {error.strerror or error}", hint="choose another folder"
            ) from error

    def publish(self) -> None:
        """Put the file in its place."""
        os.replace(self.temporary, self.path)
        self._made = []

    def discard(self) -> None:
        """Remove what was not published."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            self.temporary.unlink()
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        self._made = []
