"""Write what a benchmark measured into ``docs/data``, where README and pages take their figures of speed from.

A benchmark with the option ``--record`` renews the values that it measured: value, date, machine, commit and command.
``python docs/figures.py`` then renews the page "Figures" and the marked places of README and pages. A new figure is
written by hand once, with its question and unit; "of" says whether date and commit are those of its run or of its row.
"""

from __future__ import annotations

import argparse
import datetime
import json
import shlex
import subprocess
import sys
from pathlib import Path

import warp as wp

from softmode.cluster.ray_tasks import processor

DATA = Path(__file__).resolve().parents[1] / "docs" / "data"


def add_record_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--record`` to the options of a benchmark."""
    parser.add_argument("--record", action="store_true", help="write the figures into docs/data")


def record(benchmark: str, values: dict[str, float | str], device: str = "cpu", folder: Path = DATA) -> None:
    """Renew figures of a benchmark; names that its file does not have are not public, and left out.

    Args:
        benchmark: Name of the file in ``docs/data``.
        values: Values by the figures' names, in the units of the file; a string may have a range.
        device: Warp's name of the device on which they were measured.
        folder: Where the file lies.

    Raises:
        FileNotFoundError: ``docs/data`` has no such file.
    """
    path = folder / f"{benchmark}.json"
    figures = json.loads(path.read_text())
    arguments = [argument for argument in sys.argv[1:] if argument != "--record"]
    told = {
        "date": datetime.date.today().isoformat(),
        "machine": machine(device),
        "commit": commit(),
        "of": "run",
        "command": shlex.join(["python", "-m", f"benchmarks.{Path(sys.argv[0]).stem}", *arguments]),
    }
    for name, value in values.items():
        if name in figures:
            exact = value if isinstance(value, str) or abs(value) >= 1000 else float(f"{value:.3g}")
            figures[name] |= {"value": exact, **told}
    path.write_text(json.dumps(figures, indent=1) + "\n")


def machine(device: str) -> str:
    """Return what a device is called."""
    found = wp.get_device(device)
    if found.is_cuda:
        return f"one {found.name}"
    return f"one core, {processor()}"


def commit() -> str:
    """Return the commit of the checkout, with a plus if files differ from it."""
    folder = Path(__file__).parent
    found = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--exclude=*"], cwd=folder, capture_output=True, text=True
    )
    return found.stdout.strip() or "unknown"
