"""Python's garbage collector pauses in a block, and goes on after it only where it was on before."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from softmode.pause import collector_paused


@pytest.fixture(autouse=True)
def collector() -> Iterator[None]:
    """Leave the collector on."""
    yield
    gc.enable()


def test_paused_in_the_block() -> None:
    """It is off in the block, also in one inside of it, and on after an error."""
    gc.enable()
    with pytest.raises(ValueError, match="no"), collector_paused():
        with collector_paused():
            assert not gc.isenabled()
        assert not gc.isenabled()
        raise ValueError("no")
    assert gc.isenabled()


def test_left_off() -> None:
    """A collector that was off stays off."""
    gc.disable()
    with collector_paused():
        assert not gc.isenabled()
    assert not gc.isenabled()
