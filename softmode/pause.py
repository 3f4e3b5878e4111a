"""Python's garbage collector: held back while very many lasting objects are made, and not needed to free them."""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any


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


def cut_circles(model: Any, *builders: Any) -> None:
    """Cut the circles of references of Newton's that would keep a model, which is megabytes, until a collection.

    Args:
        model: A model; its names of earlier versions of MuJoCo's attributes, each of which holds it, are forgotten.
        builders: What it was built with; each is used up, as its MuJoCo attributes hold it.
    """
    for builder in builders:
        builder.custom_attributes.clear()
    for value in vars(model.mujoco).values() if hasattr(model, "mujoco") else ():
        if isinstance(value, dict):
            value.clear()


@cache
def _freeze_at_exit() -> None:
    """Keep the collections at the end of the process from going through all objects: memory is given back anyway."""
    atexit.register(gc.freeze)
