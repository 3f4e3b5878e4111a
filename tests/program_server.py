"""Run many programs from one start of Python: a fork for each, as `python file arguments` would run it in a folder.

The simulator is imported once, which takes seconds, and not initialised: there is no thread, device or kernel yet when
the process of a program begins. A line of JSON on the standard input asks for a program, one on the standard output
answers.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import runpy
import subprocess
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.compile_once import compile_once

ROOT = Path(__file__).resolve().parents[1]


class ProgramServer:
    """A process that has imported modules and forks a process for every program.

    Args:
        modules: Names of the modules that it imports before the first program; they may start no thread.
    """

    def __init__(self, *modules: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "tests.program_server", *modules]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
        )

    def __enter__(self) -> ProgramServer:
        """Return the server."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the process, which has no program left."""
        self.process.communicate()

    def run(self, file: Path, arguments: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
        """Run a program in a folder, which then holds `stdout` and `stderr`; return its exit code and what it wrote.

        Raises:
            RuntimeError: If the server has ended.
        """
        assert self.process.stdin and self.process.stdout
        request = {"file": str(file), "arguments": list(arguments), "folder": str(folder)}
        print(json.dumps(request), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the server ended with {self.process.wait()}")
        written = [(folder / name).read_text() for name in ("stdout", "stderr")]
        return subprocess.CompletedProcess([str(file), *arguments], json.loads(answer), *written)


def _become(request: dict[str, Any]) -> int:
    """Run a program in this process; return its exit code."""
    os.chdir(request["folder"])
    for number, name in enumerate(("stdout", "stderr"), start=1):
        file = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.argv = [request["file"], *request["arguments"]]
    sys.path[0] = os.path.dirname(request["file"])
    code: Any = 0
    try:
        runpy.run_path(request["file"], run_name="__main__")
    except SystemExit as end:
        code = end.code
        if code is not None and not isinstance(code, int):
            print(code, file=sys.stderr)
            code = 1
    except BaseException:
        traceback.print_exc()
        code = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return code or 0


def main() -> None:
    """Import the modules that the arguments name, then answer until the standard input ends."""
    gc.disable()
    for name in sys.argv[1:]:
        importlib.import_module(name)
    gc.freeze()
    gc.enable()
    compile_once()
    assert threading.active_count() == 1, threading.enumerate()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what an import prints is no answer
    for line in sys.stdin:
        pid = os.fork()
        if not pid:
            os._exit(_become(json.loads(line)))
        print(json.dumps(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])), file=answers, flush=True)


if __name__ == "__main__":
    main()
