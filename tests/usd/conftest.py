"""A reader of stages that forks, for tests in which its process is not what is tested."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softmode.stages import process

ROOT = Path(__file__).resolve().parents[2]


class ForkServer:
    """What `softmode.stages.process` takes for the module `subprocess`: a process that has loaded OpenUSD answers."""

    DEVNULL = subprocess.DEVNULL
    TimeoutExpired = subprocess.TimeoutExpired

    def __init__(self) -> None:
        """Start nothing yet."""
        self.process: subprocess.Popen[str] | None = None

    def run(self, command: list[str], *, stderr: Any, timeout: float, cwd: str, **_: Any) -> Any:
        """Have the request at the end of a command answered by a fork in a folder; return its exit code."""
        if self.process is None:
            server = [sys.executable, "-m", "tests.usd.fork_server"]
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self.process = subprocess.Popen(server, cwd=ROOT, **pipes)
        assert self.process.stdin and self.process.stdout
        asked = {"request": json.loads(command[-1]), "errors": stderr.name, "folder": cwd, "wall": timeout}
        print(json.dumps(asked), file=self.process.stdin, flush=True)
        code = json.loads(self.process.stdout.readline())
        if code == -9:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, code)


@pytest.fixture(scope="session")
def fork_server() -> Iterator[ForkServer]:
    """Return what answers; it ends with the tests."""
    server = ForkServer()
    yield server
    if server.process is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            server.process.communicate(timeout=60.0)


@pytest.fixture
def forked(fork_server: ForkServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have stages read by forks: most of the time of reading a small one goes into Python and OpenUSD that start."""
    monkeypatch.setattr(process, "subprocess", fork_server)
