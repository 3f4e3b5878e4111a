"""What a reader makes of a file from a stranger, in a process of its own: its error, its memory and its time."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_TICK = os.sysconf("SC_CLK_TCK")
_PARENT_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""
CAP, WALL = 6 * 2**30, 60.0
"""Memory above the start [bytes] and wall clock [s] at which a reader is ended, for the good of the machine."""


@dataclass(frozen=True)
class Outcome:
    """What reading a file came to."""

    error: str
    """Name of the error's type; "" if the file was read, "killed" if the reader was ended or died."""
    typed: bool
    """Whether the error is one of `softmode.errors` with a message and a hint, or there was none."""
    message: str
    """What the error says."""
    memory: int
    """Peak above what the process and its children took before [bytes]."""
    seconds: float
    """Processor time of the process and its children [s]."""

    def within(self, size: int, seconds: float = 2.0) -> bool:
        """Return whether a file of so many bytes took at most 8 bytes for each and 300 MB, and so long, in time."""
        return self.memory <= 8 * size + 300e6 and self.seconds <= seconds


def attack(reader: str, paths: Sequence[str | Path], *, warm: str | Path | None = None) -> list[Outcome]:
    """Return what a reader makes of files, one after the other in one process; after one that killed it in a new one.

    Args:
        reader: What is called with the path alone, "module:function".
        paths: The files or folders.
        warm: A sound one that is read first, so that imports and what is started once do not count.
    """
    outcomes: list[Outcome] = []
    while len(outcomes) < len(paths):
        command = [sys.executable, "-m", "tests.attack", reader, *([str(warm)] if warm else [])]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen(command, cwd=ROOT, start_new_session=True, **pipes) as driver:  # type: ignore[call-overload]
            assert driver.stdin and driver.stdout
            try:
                if not driver.stdout.readline():
                    raise RuntimeError(f"{reader} cannot be started, or not read {warm}")
                for path in paths[len(outcomes) :]:
                    outcomes.append(_watched(driver, path))
                    if outcomes[-1].error == "killed":
                        break
                driver.stdin.close()
                driver.wait(10.0 if outcomes[-1].error != "killed" else 0.1)
            except subprocess.TimeoutExpired:
                pass
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(driver.pid, signal.SIGKILL)
    return outcomes


def _watched(driver: subprocess.Popen[bytes], path: str | Path) -> Outcome:
    """Have the driver read a file and watch it and its children until it answers."""
    assert driver.stdin and driver.stdout
    memory, seconds = _taken(driver.pid)
    most, spent, end = memory, seconds, time.monotonic() + WALL
    driver.stdin.write(os.fsencode(path) + b"\n")
    driver.stdin.flush()
    with selectors.DefaultSelector() as selector:
        selector.register(driver.stdout, selectors.EVENT_READ)
        while not selector.select(0.005) and time.monotonic() < end and most - memory < CAP:
            now, spent = _taken(driver.pid)
            most = max(most, now)
        line = driver.stdout.readline() if selector.select(0.0) else b""
    if not line:
        return Outcome("killed", False, f"{most - memory} bytes", most - memory, spent - seconds)
    said = json.loads(line)
    return Outcome(
        said["error"],
        said["typed"],
        said["message"],
        max(most - memory, said["peak"]),
        _taken(driver.pid)[1] - seconds,
    )


def _taken(root: int) -> tuple[int, float]:
    """Return memory [bytes], shared pages divided among those that have them, and processor time [s] of a tree."""
    memory, seconds, queue = 0, 0.0, [root]
    while queue:
        place = f"/proc/{queue.pop()}"
        with contextlib.suppress(OSError, IndexError, ValueError):  # it may end at any moment
            with open(f"{place}/stat") as file:
                seconds += sum(map(int, file.read().rpartition(")")[2].split()[11:15])) / _TICK
            for task in os.listdir(f"{place}/task"):
                with open(f"{place}/task/{task}/children") as file:
                    queue += map(int, file.read().split())
            with open(f"{place}/smaps_rollup") as file:
                memory += next(int(line.split()[1]) for line in file if line.startswith("Pss:")) * 1024
    return memory, seconds


def _status(name: str) -> int:
    """Return a size of this process [bytes]."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(name)) * 1024


def main() -> None:
    """Read the files that the standard input names with the reader that the first argument names."""
    if sys.platform == "linux":  # a reader that does not come to an end ends with whoever watches it
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    from softmode.errors import SoftmodeError

    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a reader prints is no answer
    module, _, function = sys.argv[1].partition(":")
    read = getattr(importlib.import_module(module), function)
    for path in sys.argv[2:]:
        read(path)
    print("ready", file=out, flush=True)
    for line in sys.stdin.buffer:
        path, error, typed, message = os.fsdecode(line.removesuffix(b"\n")), "", True, ""
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")  # the peak begins anew
        start = _status("VmRSS")
        try:
            read(path)
        except Exception as caught:
            error, typed, message = type(caught).__name__, isinstance(caught, SoftmodeError), str(caught)[:2000]
            typed = typed and bool(caught.message and caught.hint)  # type: ignore[attr-defined]
        answer = {"error": error, "typed": typed, "message": message, "peak": _status("VmHWM") - start}
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    main()
