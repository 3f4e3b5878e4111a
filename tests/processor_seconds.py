"""Processor seconds of every test: recorded in the repository, so that the longest files start first.

``make test ARGS=--record-seconds`` writes what the tests of a run took, children included, into `FILE`: run it twice,
and keep the second, in which no kernel is compiled and no body is built. Tests that did not run keep their figures.
"""

from __future__ import annotations

import json
import math
import os
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).with_suffix(".json")
"""Seconds by file and test function, of all cases together. Functions below `LEAST` are one entry of their file."""
LEAST = 0.5
"""Seconds below which a test function has no entry of its own."""
REST = "others"
"""Name of the entry of all functions below `LEAST`."""

Seconds = dict[str, dict[str, float]]
_SPENT = pytest.StashKey[dict[str, float]]()


def recorded() -> Seconds:
    """Return the recorded seconds by file and function."""
    return json.loads(FILE.read_text()) if FILE.is_file() else {}


def expected(nodeids: list[str], seconds: Seconds) -> dict[str, float]:
    """Return what the files of some tests will take [s]; a function counts once, whole, where one of its cases runs."""
    wanted: defaultdict[str, set[str]] = defaultdict(set)
    for nodeid in nodeids:
        file, function = split(nodeid)
        wanted[file].add(function if function in seconds.get(file, {}) else REST)
    # fsum, as sums of a set's members come in another order in every process
    return {file: math.fsum(seconds.get(file, {}).get(name, 0.0) for name in names) for file, names in wanted.items()}


def split(nodeid: str) -> tuple[str, str]:
    """Return file and function of a test's id, without its parameters."""
    file, _, rest = nodeid.partition("::")
    return file.removeprefix("tests/"), rest.partition("[")[0]


def merged(before: Seconds, spent: dict[str, float]) -> Seconds:
    """Return the record with the seconds of a run in it, rounded, its files and functions in order."""
    found: defaultdict[str, defaultdict[str, float]] = defaultdict(lambda: defaultdict(float))
    for nodeid, seconds in spent.items():
        file, function = split(nodeid)
        found[file][function] += seconds
    after = {file: dict(functions) for file, functions in before.items()}
    for file, functions in found.items():
        long = {name: round(s, 1) for name, s in functions.items() if s >= LEAST}
        kept = {name: s for name, s in after.get(file, {}).items() if name not in functions and name != REST}
        after[file] = dict(sorted((kept | long).items()))
        after[file][REST] = round(sum(s for s in functions.values() if s < LEAST), 1)
    return dict(sorted(after.items()))


def _now() -> float:
    """Return the processor time of this process and of its children that have ended [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.addoption("--record-seconds", action="store_true", help=f"write processor seconds of tests into {FILE.name}")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with no seconds."""
    config.stash[_SPENT] = {}


@pytest.hookimpl(tryfirst=True)  # before a worker tells the order of its tests
def pytest_collection_finish(session: pytest.Session) -> None:
    """Start the longest files first."""
    seconds = expected([item.nodeid for item in session.items], recorded())
    session.items.sort(key=lambda item: -seconds[split(item.nodeid)[0]])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Time a test with its fixtures."""
    start = _now()
    try:
        return (yield)
    finally:
        item.config.stash[_SPENT][item.nodeid] = _now() - start


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand the seconds of a worker to the process that started it; that one, or the only one, writes them."""
    config = session.config
    if (output := getattr(config, "workeroutput", None)) is not None:
        output["seconds"] = config.stash[_SPENT]
    elif config.option.record_seconds:
        FILE.write_text(json.dumps(merged(recorded(), config.stash[_SPENT]), indent=1) + "\n")


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the seconds of a worker that has ended."""
    node.config.stash[_SPENT].update(getattr(node, "workeroutput", {}).get("seconds", {}))
