"""What a program that takes long is about: after three seconds without a word, and every three from then on."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

KERNELS = "loading kernels"
"""Stage in which modules are loaded, and compiled where the cache does not hold them."""
PERIOD = 2.5
"""Seconds without a word after which it is said what goes on."""


class _Watch:
    """The stages under way in a process, innermost last, and the thread that says which it is."""

    def __init__(self) -> None:
        """Nothing is under way."""
        self.stages: list[tuple[str, float]] = []
        self.count = 0
        """Modules that were compiled since this stage began."""
        self.moved = 0.0
        self.lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def begin(self, name: str) -> tuple[str, float]:
        """Note a stage, and return the note; the first one starts the thread."""
        with self.lock:
            now = time.monotonic()
            if not self.stages:
                self.moved = now
            if name != KERNELS or not self.stages or self.stages[-1][0] != KERNELS:
                self.count = 0
            self.stages.append((name, now))
            if self._thread is None or not self._thread.is_alive():  # it is not in a process that was forked
                self._thread = threading.Thread(target=self._run, name="stages", daemon=True)
                self._thread.start()
            return self.stages[-1]

    def _run(self) -> None:
        """Speak where nobody else has for a while, until nothing is under way."""
        while True:
            time.sleep(0.2 * PERIOD)
            with self.lock:
                if not self.stages:
                    self._thread = None
                    return
                now = time.monotonic()
                if now - self.moved < PERIOD:
                    continue
                self.moved, (name, begun) = now, self.stages[-1]
                if name == KERNELS and self.count:
                    name = f"compiling kernels (first run only, {self.count} modules so far)"
            with contextlib.suppress(OSError, ValueError):  # a stream that is closed
                _print(name, now - begun)


_WATCH = _Watch()


@contextlib.contextmanager
def stage(name: str) -> Iterator[None]:
    """Say on stderr that `name` goes on, where the block takes longer than three seconds, and again every three.

    Args:
        name: What goes on, such as "building the body".
    """
    noted = _WATCH.begin(name)
    try:
        yield
    finally:
        with _WATCH.lock:
            _WATCH.stages.remove(noted)  # the innermost may be that of another thread


def moved() -> None:
    """Note that something was shown just now, such as a bar."""
    _WATCH.moved = time.monotonic()


def compiled() -> None:
    """Note that a module was compiled."""
    _WATCH.count += 1


def _print(name: str, seconds: float) -> None:
    """Write a line, above the bars that there are.

    It does not wait for their lock: a process that was killed while it held the lock would silence this one for good.
    """
    line = f"softmode: {name}, {seconds:.0f} s"
    bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # the module may be half imported
    if bars is not None and getattr(bars, "_instances", None):
        bars.write(line, file=sys.stderr, nolock=True)
    else:
        print(line, file=sys.stderr, flush=True)
