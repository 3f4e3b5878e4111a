"""Python's garbage collector pauses in a block, and goes on after it only where it was on before."""

from __future__ import annotations

import gc
import subprocess
import sys
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


def test_exit_leaves_the_objects_out() -> None:
    """At exit all objects are set apart, so that the last collections do not go through them: 3 s of a script."""
    script = (
        "import atexit, gc\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 0))\n"  # runs last: the first that is registered
        "from softmode.pause import collector_paused\n"
        "with collector_paused():\n"
        "    print(gc.get_freeze_count() > 0)\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True"]
