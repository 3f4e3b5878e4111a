"""Faults and ends that tests bring about: errors at the n-th call, kills, signals, a disk that is full."""

from __future__ import annotations

import contextlib
import itertools
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]

FULL_DISK = """
import resource, signal, sys
sys.dont_write_bytecode = True  # Python 3.11 leaves a cut file of compiled code, which breaks the programs that follow
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
"""
"""How a program begins whose files may have so many bytes only, as on a full disk."""


def at_every_call(
    monkeypatch: pytest.MonkeyPatch, owner: object, name: str, fault: Callable[[], object]
) -> Iterator[int]:
    """Yield 0, 1, ...: in this round the fault happens at the call of that number, here or in a fork of this process.

    The rounds end after one without a fault. Only forks die, and only their calls are counted then.

    Args:
        monkeypatch: Replaces the function.
        owner: Whose function it is, such as os.
        name: Its name.
        fault: Raises an error, or ends the process.
    """
    real, spared = getattr(owner, name), os.getpid() if fault is die else 0
    for number in itertools.count():
        calls, happened = itertools.count(), mmap.mmap(-1, 1)  # the latter shared with forks

        def call(
            *arguments: Any, calls: Iterator[int] = calls, number: int = number, happened: Any = happened, **given: Any
        ) -> Any:
            if os.getpid() != spared and next(calls) == number:
                happened[0] = 1
                fault()
            return real(*arguments, **given)

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, call)
            yield number
        if not happened[0]:
            return


def interrupt() -> None:
    """Raise what Ctrl-C raises."""
    raise KeyboardInterrupt


def die() -> None:
    """End this process as SIGKILL does."""
    os.kill(os.getpid(), signal.SIGKILL)


def in_child(work: Callable[[], object]) -> int:
    """Do something in a fork of this process; return its exit code, negative for a signal, 1 for an exception."""
    pid = os.fork()
    if not pid:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@contextlib.contextmanager
def signalled(number: signal.Signals, when: Callable[[], object]) -> Iterator[None]:
    """Send this process a signal in a block, once a condition holds; Ctrl-C is handled though jobs may ignore it."""
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            if when():
                os.kill(os.getpid(), number)
                return
            time.sleep(0.01)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        signal.signal(signal.SIGINT, before)


def start(
    code: str,
    *arguments: object,
    disk: int | None = None,
    environment: Mapping[str, str] | None = None,
    session: bool = False,
) -> subprocess.Popen[str]:
    """Start Python with code that sees the package and the tests.

    Args:
        code: The code.
        arguments: Its arguments.
        disk: Largest size of its files [bytes].
        environment: Further variables of its environment.
        session: Give it a session of its own, whose number is its own.
    """
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **(environment or {})}
    text = code if disk is None else FULL_DISK.format(size=disk) + code
    return subprocess.Popen(
        [sys.executable, "-c", text, *map(str, arguments)],
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=session,
    )


def run(code: str, *arguments: object, disk: int | None = None) -> tuple[int, str]:
    """Run code as `start` does; return its exit code and what it wrote."""
    process = start(code, *arguments, disk=disk)
    written = process.communicate()[0]
    return process.returncode, written


def end_at(
    process: subprocess.Popen[str], line: Callable[[str], bool], number: signal.Signals, *, read: bool = True
) -> tuple[int, str]:
    """Send a process a signal, when it writes such a line or at once; return its exit code and what it wrote after."""
    assert process.stdout is not None
    try:
        for written in process.stdout if read else ():
            if line(written):
                break
        process.send_signal(number)
        after = process.communicate(timeout=60.0)[0]
    finally:
        process.kill()
    return process.returncode, after
