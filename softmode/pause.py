"""Python's garbage collector held back while very many lasting objects are made."""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache


@contextmanager
def collector_paused() -> Iterator[None]:
    """Hold Python's garbage collector back in a block.

    Kernels, models and captured launches are made of a million objects that stay. The collector goes through all of
    them again and again, and finds next to nothing. It goes on after the block, where it was on before. When Python
    exits it leaves out what is there by then, which would take it three seconds.
    """
    _freeze_at_exit()
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


@cache
def _freeze_at_exit() -> None:
    """Keep the collections at the end of the process from going through all objects: memory is given back anyway."""
    atexit.register(gc.freeze)
