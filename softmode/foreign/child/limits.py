"""Limits that the process sets for itself before it opens a file, and nesting that it refuses."""

from __future__ import annotations

import os
import re
import signal
import time
import zipfile
from typing import Any

MAX_DEPTH = 256
"""Deepest nesting of a text layer, and of prims. OpenUSD's recursive parser and composition overflow the stack at some
thousands (20,000 nested prims, 180 kB, end the process); no stage of people's making comes near."""
_MEMORY_CAP = 16 * 2**30
_TOKEN = re.compile(
    rb'"""(?:[^\\]|\\.)*?"""|\'\'\'(?:[^\\]|\\.)*?\'\'\'|"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\''
    rb"|@@@.*?@@@|@[^@\n]*@|#[^\n]*|[{}()\[\]]",
    re.DOTALL,
)


class Refused(Exception):
    """A file that breaks a rule of softmode; carries the remedy.

    Args:
        message: What is wrong with it.
        hint: The remedy.
    """

    def __init__(self, message: str, hint: str) -> None:
        """Store both."""
        super().__init__(message)
        self.hint = hint


class Budget:
    """Memory and processor time of this process: a base and so much for each byte of the files that it reads.

    Where the platform has no `resource` (Windows), memory is not limited and the parent's clock alone ends the process.

    Args:
        memory: Base of the memory taken from now on [bytes].
        memory_per_byte: Memory for each byte of file [bytes].
        seconds: Base of the processor time from now on [s].
        seconds_per_byte: Processor time for each byte of file [s].
    """

    def __init__(self, *, memory: float, memory_per_byte: float, seconds: float, seconds_per_byte: float) -> None:
        """Start the clock; nothing is allowed for files yet."""
        self._memory, self._memory_per_byte = memory, memory_per_byte
        self._seconds, self._seconds_per_byte = seconds, seconds_per_byte
        self._size = 0
        self._begun = time.process_time()
        self._resource: Any = None
        try:
            import resource

            self._resource = resource
            with open("/proc/self/statm") as file:  # what the interpreter and OpenUSD's libraries have taken already
                self._memory += int(file.read().split()[5]) * os.sysconf("SC_PAGE_SIZE")
        except (ImportError, OSError):
            pass
        self.add(0)

    def add(self, size: int) -> None:
        """Allow for a file of this size [bytes]."""
        self._size += size
        if self._resource is not None:
            limits = self._resource
            memory = int(min(self._memory + self._memory_per_byte * self._size, _MEMORY_CAP))
            # Writable memory, not address space: mapped libraries do not count. Files that it writes likewise.
            limits.setrlimit(limits.RLIMIT_DATA, (memory, _MEMORY_CAP))
            limits.setrlimit(limits.RLIMIT_FSIZE, (min(2 * memory, _MEMORY_CAP), _MEMORY_CAP))
            limits.setrlimit(limits.RLIMIT_CORE, (0, 0))
        if hasattr(signal, "setitimer"):
            left = self._seconds + self._seconds_per_byte * self._size - (time.process_time() - self._begun)
            signal.setitimer(signal.ITIMER_PROF, max(left, 1e-3))


def check_nesting(path: str) -> None:
    """Refuse a text layer, or a package that holds one, that is nested deeper than `MAX_DEPTH`."""
    with open(path, "rb") as file:
        head = file.read(8)
        if head.startswith(b"PXR-USDC"):
            return
        if not head.startswith(b"PK"):
            file.seek(0)
            _scan(file.read())
            return
    try:
        with zipfile.ZipFile(path) as package:
            for member in package.infolist():
                stored = member.compress_type == zipfile.ZIP_STORED and member.file_size <= os.stat(path).st_size
                if member.filename.lower().endswith((".usd", ".usda")) and stored:
                    _scan(package.read(member))
    except (zipfile.BadZipFile, NotImplementedError, EOFError, RuntimeError) as error:
        raise Refused(f"is no usable package ({error})", "The file is damaged: copy or export it again") from error


def _scan(text: bytes) -> None:
    """Count brackets outside strings, comments and asset paths."""
    if text.startswith(b"PXR-USDC"):
        return
    depth = 0
    for match in _TOKEN.finditer(text):
        found = match.group()
        if found in (b"{", b"(", b"["):
            depth += 1
            if depth > 2 * MAX_DEPTH:  # a prim may bring brackets of metadata and variants beside its own
                raise Refused(f"is nested deeper than {MAX_DEPTH} levels", "Flatten its hierarchy")
        elif found in (b"}", b")", b"]"):
            depth -= 1
