"""Write the page "Figures" from ``docs/data/*.json``, and fill in the marked places of README and pages.

Run: ``python docs/figures.py``. A place is marked by two comments: ``<!-- =FILE.NAME -->VALUE<!-- / -->``. What
stands between them is the figure's value with its unit. `benchmarks.record` writes the values.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / "figures.md"
MARKED = re.compile(r"<!-- =(?P<name>[\w.]+) -->(?P<value>[^<]*)<!-- / -->")
PREAMBLE = """# Figures

These are the headline figures of speed and of what belongs to it. Each has the date of its measurement, the machine,
the commit and the command that repeats it. Machines differ, so no test asserts a figure. "One core" is a core of a
shared two-core AVX-512 machine, unless a processor is named; "H200" is one NVIDIA H200. "By" a date: the row
was written then, with that commit; when the run was, and of which commit, is not known.

Figures are medians of many repetitions. On a shared machine they are processor time. Ratios are taken within one
run. Where softmode stands beside something else, both run in the same script, on the same machine, with the same
steps. A figure that came out badly stays. `benchmarks/JOURNAL.md` has all tables, and what was tried.

This page is written by `python docs/figures.py` from `docs/data/*.json`.
"""


def figures() -> dict[str, dict[str, Any]]:
    """Return all figures by file and name."""
    found = {}
    for path in sorted((DOCS / "data").glob("*.json")):
        for name, figure in json.loads(path.read_text()).items():
            found[f"{path.stem}.{name}"] = figure
    return found


def written(figure: dict[str, Any]) -> str:
    """Return a value with its unit: three or four digits, thousands with commas."""
    value, unit = figure["value"], figure["unit"]
    if isinstance(value, int | float):
        value = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value} {unit}".strip()


def filled(text: str, known: dict[str, dict[str, Any]]) -> str:
    """Return a page with its marked places filled in.

    Raises:
        KeyError: A place names a figure that ``docs/data`` does not have.
    """
    return MARKED.sub(lambda match: f"<!-- ={match['name']} -->{written(known[match['name']])}<!-- / -->", text)


def page(known: dict[str, dict[str, Any]]) -> str:
    """Return the page "Figures": a table for each file."""
    text = PREAMBLE
    for file in dict.fromkeys(name.partition(".")[0] for name in known):
        text += f"\n## {file.replace('_', ' ').capitalize()}\n\n| what | figure | machine | date, commit | command |\n"
        text += "|---|---|---|---|---|\n"
        for name, figure in known.items():
            if name.startswith(f"{file}."):
                told = f"{'' if figure['of'] == 'run' else 'by '}{figure['date']}, {figure['commit']}"
                cells = (figure["what"], written(figure), figure["machine"], told)
                text += f"| {' | '.join(cells)} | `{figure['command']}` |\n"
    return text


def pages() -> list[Path]:
    """Return README and the pages that are not generated."""
    return [DOCS.parent / "README.md", *(path for path in sorted(DOCS.rglob("*.md")) if path != PAGE)]


if __name__ == "__main__":
    everything = figures()
    PAGE.write_text(page(everything))
    for path in pages():
        path.write_text(filled(path.read_text(), everything))
