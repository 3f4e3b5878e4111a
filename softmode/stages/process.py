"""Open OpenUSD files in a process of its own with limited memory and time; the parent receives plain arrays.

OpenUSD does not withstand damaged files: its parsers crash on deep nesting, and a few hundred bytes make it allocate
gigabytes or run for minutes. All of that ends the child and becomes an AssetError here.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, MissingExtraError

REEXPORT = "The file is damaged or incomplete: copy or export it again"
"""The remedy for a file that contradicts itself."""
_LIGHTEN = "If the file is damaged, copy or export it again; if it is merely large, import a part of it"
_CHILD = Path(__file__).with_name("child") / "__main__.py"
_KINDS = tuple("fediIlqLQB?")
"""Types of numbers that an answer may hold, as `memoryview.format` and numpy call them."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the process may take, beside what loading OpenUSD takes."""

    memory: float = 2.0**30
    """Memory [bytes]."""
    memory_per_byte: float = 32.0
    """Memory for each byte of the files that are read [bytes]."""
    seconds: float = 10.0
    """Processor time [s]; the wall clock ends the process after twelve times as long."""
    seconds_per_byte: float = 1.0e-6
    """Processor time for each byte of the files that are read [s]."""


@dataclass(frozen=True)
class Answer:
    """What the process sent."""

    described: Any
    """Nested dicts and lists; integers under the names of arrays number them."""
    arrays: list[NDArray[Any]]
    """The arrays, each with the shape that OpenUSD gave it."""


@contextlib.contextmanager
def invalid_data(name: str) -> Iterator[None]:
    """Turn what contradictory data leads Python and numpy to into an AssetError that names the file.

    Args:
        name: The file as messages call it.
    """
    try:
        yield
    except AssetError:
        raise
    except (TypeError, IndexError, KeyError, ValueError, OverflowError) as error:
        raise AssetError(f"{name}: holds invalid data ({error})", hint=REEXPORT) from error


def pxr_folder() -> str:
    """Return the folder that holds `pxr` without importing it.

    Raises:
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    spec = importlib.util.find_spec("pxr")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError("OpenUSD files need usd-core", hint="install it with: pip install 'softmode[usd]'")
    return str(Path(next(iter(spec.submodule_search_locations))).parent)


def make_request(
    what: str, path: str | os.PathLike[str], answer: str, *, asset_root: str | os.PathLike[str] | None, limits: Limits
) -> dict[str, Any]:
    """Return a request as the process takes it; readers add what they need.

    Args:
        what: Name of the reader: a module of `softmode.stages.child`.
        path: The file.
        answer: Where the answer goes.
        asset_root: Folder that holds whatever the stage may read; None for the file's own.
        limits: What the process may take.

    Raises:
        AssetError: If the file is missing or lies outside the root.
    """
    file = os.path.abspath(path)
    root = os.path.dirname(file) if asset_root is None else os.path.abspath(asset_root)
    if not os.path.isfile(file):
        raise AssetError(f"OpenUSD file {path}: cannot be read (no such file)", hint="Check the path")
    if asset_root is not None and not Path(os.path.realpath(file)).is_relative_to(os.path.realpath(root)):
        raise AssetError(
            f"OpenUSD file {path}: lies outside asset_root {asset_root}", hint="Pass a folder that holds it"
        )
    return {
        "pxr": pxr_folder(),
        "what": what,
        "file": file,
        "root": root,
        "answer": answer,
        "limits": asdict(limits),
        "strict": False,
    }


def ask(request: dict[str, Any], *, name: str) -> Answer:
    """Send a request to a process of its own and return what it answers.

    Args:
        request: From `make_request`, with what the reader needs added.
        name: The file as messages call it.

    Raises:
        AssetError: If the file is damaged, breaks a rule, or makes OpenUSD exceed its memory or time.
    """
    limits = request["limits"]
    wall = 12.0 * (limits["seconds"] + limits["seconds_per_byte"] * os.stat(request["file"]).st_size)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PXR", "USD", "PYTHON"))}
    environment |= {"PXR_WORK_THREAD_LIMIT": "1", "USD_SHADE_MATERIAL_BINDING_API_CHECK": "allowMissingAPI"}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch:
        report = os.path.join(scratch, "errors")
        try:
            with open(report, "wb") as errors:  # a file, which the limits bound, and no pipe
                code = subprocess.run(
                    [sys.executable, "-I", str(_CHILD), json.dumps(request)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    timeout=wall,
                    cwd=scratch,  # empty: OpenUSD looks there for what it does not find beside a layer
                    env=environment,
                    check=False,
                ).returncode
        except subprocess.TimeoutExpired as error:
            raise AssetError(f"{name}: OpenUSD does not come to an end with it", hint=_LIGHTEN) from error
        if code:
            raise refusal(code, _tail(report), name)
    return read_answer(request["answer"], name)


def refusal(code: int, report: str, name: str) -> AssetError:
    """Return the error for an exit code and what the process wrote to its standard error."""
    reason, hint = "OpenUSD crashes with it, or takes more memory than is given", _LIGHTEN
    if code == -getattr(signal, "SIGPROF", 0):
        reason = "OpenUSD takes more processor time than is given"
    if code == 3:  # an error of OpenUSD: where in its sources : 'what'
        said, hint = json.loads(report.rpartition("\nanswer: ")[2]), REEXPORT
        reason = (re.findall(r" : '(.+?)(?:' Error in|'?$)", said["reason"]) or [said["reason"]])[0].strip()
        hint = said["hint"] or hint
        if said["hint"]:
            return AssetError(f"{name}: {reason[:400]}", hint=hint)
    elif code == 1:  # an error of Python, before OpenUSD saw the file
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
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{name}: cannot be read (the answer is incomplete: {error})", hint=REEXPORT) from error
    return Answer(described, arrays)


def _tail(path: str) -> str:
    """Return the last kilobytes of a file of messages."""
    with open(path, "rb") as file:
        file.seek(max(0, os.stat(path).st_size - 16384))
        return file.read().decode("utf-8", "replace")
