"""What Warp says while softmode works: nothing in a library's use, and what a command makes of it in a command's.

Warp tells of every module that it loads, some eighty lines for an environment. Its logger is where softmode leaves out
the lines of its own use: those whose call comes from softmode, unless they name a module of the user's. All other lines
go on to the logger that was there, and ``wp.config.log_level = wp.LOG_DEBUG`` brings back all of them.
``wp.set_logger(None)`` puts Warp's own logger back. One line on stderr is not Warp's to silence: that of its native
code where a machine has no CUDA driver.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator

import warp as wp

from softmode.stages import compiled

_LIBRARIES = ("softmode", "newton", "mujoco_warp", "warp")


class QuietLogger:
    """Warp's logger without the lines of softmode's own use.

    Args:
        inner: The logger that takes all others.
        listener: Takes all lines while it is set.
    """

    def __init__(self, inner: wp.Logger, listener: Callable[[str], None] | None = None) -> None:
        """Remember the logger that was there."""
        self.inner, self.listener = inner, listener

    def info(self, message: str) -> None:
        """Pass a line on that is not of softmode's use."""
        if "(compiled)" in message:
            compiled()
        if self.listener is not None:
            self.listener(message)
        elif wp.config.log_level <= wp.LOG_DEBUG or not _is_own(message):
            self.inner.info(message)

    def debug(self, message: str) -> None:
        """Pass it on."""
        self.inner.debug(message)

    def warning(self, message: str, category: type[Warning] | None = None, stacklevel: int = 1) -> None:
        """Pass it on."""
        self.inner.warning(message, category, stacklevel + 1)

    def error(self, message: str) -> None:
        """Pass it on."""
        self.inner.error(message)


def quieten_warp() -> QuietLogger:
    """Make Warp's logger leave out what softmode's own use says; return it. Later calls change nothing."""
    logger = wp.get_logger()
    if not isinstance(logger, QuietLogger):
        logger = QuietLogger(logger)
        wp.set_logger(logger)
    return logger


@contextlib.contextmanager
def listening(listener: Callable[[str], None]) -> Iterator[None]:
    """Pass all of Warp's lines in a block to a listener alone."""
    logger = quieten_warp()
    before, logger.listener = logger.listener, listener
    try:
        yield
    finally:
        logger.listener = before


def _is_own(message: str) -> bool:
    """Return whether a line comes from a call of softmode and names no module of the user's."""
    named = re.match(r"\s*Module ([\w.]+) ", message)
    if named and named[1] in sys.modules and named[1].partition(".")[0] not in _LIBRARIES:
        return False
    frame = sys._getframe(2)
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] == "softmode":
            return True
        frame = frame.f_back
    return False
