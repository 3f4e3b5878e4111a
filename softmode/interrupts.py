"""SIGTERM for a command: what Ctrl-C does, with an end that is sure to come."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator

TERMINATED = 128 + signal.SIGTERM
"""Exit code after SIGTERM."""
GRACE = 10.0
"""Time in which a command has to end after SIGTERM [s]."""
_OWNERS: list[int] = []  # this process, while it handles SIGTERM here


class Terminated(KeyboardInterrupt):
    """The process was asked to end, by SIGTERM."""


@contextlib.contextmanager
def ending_on_sigterm() -> Iterator[list[int]]:
    """Raise `Terminated` in a block at the first SIGTERM; end the process at a second signal, and after `GRACE`.

    The end comes even where Python cannot, within a long call into compiled code. Children made by a fork keep none of
    this. Outside of the main thread, which alone may handle signals, and on Windows it does nothing.

    Yields:
        The exit code in a list, once there was a SIGTERM.
    """
    ended: list[int] = []
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield ended
        return

    def terminate(number: int, frame: object) -> None:
        if not ended:
            ended.append(TERMINATED)
            raise Terminated

    read, write = os.pipe()
    os.set_blocking(write, False)
    watcher = threading.Thread(target=_watch, args=(read,), daemon=True)
    watcher.start()
    before = signal.set_wakeup_fd(write, warn_on_full_buffer=False), signal.signal(signal.SIGTERM, terminate)
    _OWNERS.append(os.getpid())
    try:
        yield ended
    finally:
        _OWNERS.pop()
        signal.set_wakeup_fd(before[0])
        signal.signal(signal.SIGTERM, before[1])
        os.write(write, b"\0")
        watcher.join()
        os.close(read)
        os.close(write)


def _watch(read: int) -> None:
    """End the process some time after SIGTERM, or at the next signal; return when a zero is told."""
    left: float | None = None
    while select.select([read], [], [], left)[0]:
        number = os.read(read, 1)[0]
        if number == 0:
            return
        if left is not None:
            break
        if number == signal.SIGTERM:
            left = GRACE
    os._exit(TERMINATED)


def _forget() -> None:
    """Leave the handling of signals to the process that has set it up."""
    if _OWNERS:
        _OWNERS.clear()
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
