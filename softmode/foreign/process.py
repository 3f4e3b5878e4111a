"""Read files with libraries of others in a process with limited memory and time; the parent receives plain arrays.

Such libraries do not withstand damaged files: OpenUSD crashes on deep nesting, and of each a few hundred bytes make it
allocate gigabytes or run for minutes. All of that ends a child and becomes an AssetError here. One process is kept for
all files of a command; a fork of it reads each, on Linux. Elsewhere a process is started for each, and where there are
no resource limits (Windows) the parent's clock alone ends it.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, MissingExtraError
from softmode.files import REEXPORT
from softmode.foreign.child.layers import inside

_LIGHTEN = "If the file is damaged, copy or export it again; if it is merely large, import a part of it"
_CHILD = Path(__file__).with_name("child") / "__main__.py"
_KINDS = tuple("fediIlqLQB?")
"""Types of numbers that an answer may hold, as `memoryview.format` and numpy call them."""
_LIBRARIES = {"mesh": "trimesh", "model": "mujoco", "table": "pyarrow"}
"""Package that a reader needs; the others read stages."""
_SHOWN = {"pxr": "OpenUSD", "mujoco": "MuJoCo"}
_lock = threading.RLock()
_kept: tuple[int, subprocess.Popen[str]] | None = None
"""The process that is kept, and the process that it belongs to: a fork starts one of its own."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What reading may take, beside what loading the library takes."""

    memory: float = 256 * 2.0**20
    """Memory [bytes]."""
    memory_per_byte: float = 8.0
    """Memory for each byte of the files that are read [bytes]."""
    seconds: float = 2.0
    """Processor time [s]; the wall clock ends the process after twelve times as long."""
    seconds_per_byte: float = 1.0e-6
    """Processor time for each byte of the files that are read [s]."""


@dataclass(frozen=True)
class Answer:
    """What the process sent."""

    described: Any
    """Nested dicts and lists; integers under the names of arrays number them."""
    arrays: list[NDArray[Any]]
    """The arrays."""


def library_folder(library: str = "pxr") -> str:
    """Return the folder that holds a package without importing it.

    Raises:
        MissingExtraError: If OpenUSD is asked for and the extra `[usd]` is not installed.
    """
    spec = importlib.util.find_spec(library)
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError("OpenUSD files need usd-core", hint="install it with: pip install 'softmode[usd]'")
    return str(Path(next(iter(spec.submodule_search_locations))).parent)


def read(
    what: str,
    path: str | os.PathLike[str],
    *,
    name: str,
    asset_root: str | os.PathLike[str] | None = None,
    limits: Limits | None = None,
    **options: Any,
) -> Answer:
    """Have a file read by the process, which is started if there is none, and return what it answers.

    Args:
        what: Name of the reader: a module of `softmode.foreign.child`.
        path: The file.
        name: The file as messages call it.
        asset_root: Folder that holds whatever the file may refer to; None for the file's own.
        limits: What the process may take; those of `Limits` if None.
        **options: What the reader needs beside.

    Raises:
        AssetError: If the file is missing, damaged, lies outside the root, breaks a rule, or makes the library exceed
            its memory or time.
        MissingExtraError: If the file is a stage and the extra `[usd]` is not installed.
    """
    library = _LIBRARIES.get(what, "pxr")
    shown = _SHOWN.get(library, library)
    file = os.path.abspath(path)
    root = os.path.dirname(file) if asset_root is None else os.path.abspath(asset_root)
    if not os.path.isfile(file):
        raise AssetError(f"{name}: cannot be read (no such file)", hint="Check the path")
    if asset_root is not None and not inside(file, root):
        raise AssetError(f"{name}: lies outside asset_root {asset_root}", hint="Pass a folder that holds it")
    limits = Limits() if limits is None else limits
    wall = 12.0 * (limits.seconds + limits.seconds_per_byte * (os.stat(file).st_size + options.get("size", 0)))
    request = {"library": library, "place": library_folder(library), "what": what, "file": file, "root": root}
    with tempfile.TemporaryDirectory() as folder:
        answer, report = os.path.join(folder, "answer"), os.path.join(folder, "errors")
        request |= {"answer": answer, "errors": report, "folder": folder, "limits": asdict(limits), "strict": False}
        code = _run(json.dumps(request | options), wall)
        if code is None:
            raise AssetError(f"{name}: {shown} does not come to an end with it", hint=_LIGHTEN)
        if code:
            raise refusal(code, _tail(report), name, shown)
        return read_answer(answer, name)


def _run(line: str, wall: float) -> int | None:
    """Return the exit code of a request, or None if the clock ended it [s]."""
    with _lock:
        process = _started()
        assert process.stdin and process.stdout
        ended = threading.Event()
        timer = threading.Timer(wall, lambda: (ended.set(), _end(process)))
        timer.start()
        try:
            process.stdin.write(line + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except OSError:  # it ended before it read the request
            answer = ""
        except BaseException:
            _end(process)
            raise
        finally:
            timer.cancel()
        if answer and sys.platform == "linux":
            return int(answer)
        _stop()
        return None if ended.is_set() else int(answer or process.returncode or 1)


def _started() -> subprocess.Popen[str]:
    """Return the process that reads; start it if there is none that lives and belongs to this process."""
    global _kept
    if _kept is not None and (_kept[0] != os.getpid() or _kept[1].poll() is not None):
        _stop()
    if _kept is None:
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("PXR", "USD", "PYTHON"))}
        environment |= {"PXR_WORK_THREAD_LIMIT": "1", "USD_SHADE_MATERIAL_BINDING_API_CHECK": "allowMissingAPI"}
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
        process = subprocess.Popen(
            [sys.executable, "-I", str(_CHILD)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
            start_new_session=True,
        )
        _kept = os.getpid(), process
    return _kept[1]


def _end(process: subprocess.Popen[str]) -> None:
    """Kill a process and what it has forked."""
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()


@atexit.register
def _stop() -> None:
    """Let the process that is kept end, as it does when its input ends."""
    global _kept
    if _kept is not None and _kept[0] == os.getpid():
        with contextlib.suppress(OSError):
            _kept[1].communicate()
    _kept = None


def refusal(code: int, report: str, name: str, shown: str = "OpenUSD") -> AssetError:
    """Return the error for an exit code and what the process wrote to its standard error."""
    reason, hint = f"{shown} crashes with it, or takes more memory than is given", _LIGHTEN
    if code == -getattr(signal, "SIGPROF", 0):
        reason = f"{shown} takes more processor time than is given"
    if code == 3:  # an error of OpenUSD: where in its sources : 'what'
        said, hint = json.loads(report.rpartition("\nanswer: ")[2]), REEXPORT
        reason = (re.findall(r" : '(.+?)(?:' Error in|'?$)", said["reason"]) or [said["reason"]])[0].strip()
        hint = said["hint"] or hint
        if said["hint"]:
            return AssetError(f"{name}: {reason[:400]}", hint=hint)
    elif code == 1:  # an error of Python, before the library saw the file
        hint = REEXPORT
        reason = (report.strip().splitlines() or ["no message"])[-1]
    return AssetError(f"{name}: cannot be read ({reason[:300]})", hint=hint)


def read_answer(path: str, name: str) -> Answer:
    """Return what the process wrote, checked against the length of the file.

    Raises:
        AssetError: If it contradicts itself.
    """
    arrays: list[NDArray[Any]] = []
    try:
        with open(path, "rb") as file:
            described = json.loads(file.readline())
            left = os.stat(path).st_size - file.tell()
            for kind, shape in described.pop("arrays"):
                if kind not in _KINDS:
                    raise ValueError(f"an array of type {kind!r}")
                dtype = np.dtype(kind)
                count = int(np.prod(shape, dtype=np.int64))
                left -= count * dtype.itemsize
                if count < 0 or left < 0:
                    raise ValueError("an array is longer than the answer")
                arrays.append(np.fromfile(file, dtype, count).reshape(shape))
    except Exception as error:
        raise AssetError(f"{name}: cannot be read (the answer is incomplete: {error})", hint=REEXPORT) from error
    return Answer(described, arrays)


def _tail(path: str) -> str:
    """Return the last kilobytes of a file of messages."""
    with open(path, "rb") as file:
        file.seek(max(0, os.stat(path).st_size - 16384))
        return file.read().decode("utf-8", "replace")
