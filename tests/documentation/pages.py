"""The Markdown pages: README.md and those of docs/, and what can be taken out of them to be run or looked up.

Two comments right above a fence say how it is run. ``<!-- slow: why -->``: this page is run with the slow tests.
``<!-- not run: why -->``: this fence is skipped, for instance because it reads a file of the reader's own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"^(?:<!-- (?P<mark>slow|not run): (?P<why>[^>]+?) -->\s*\n)?```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.M | re.S,
)


@dataclass(frozen=True)
class Fence:
    """A block of code of a page."""

    page: Path
    line: int
    language: str
    text: str
    mark: str
    """slow, not run, or nothing."""


def fences(page: Path, language: str) -> list[Fence]:
    """Return the blocks of a page in one language, in order."""
    content = page.read_text()
    return [
        Fence(page, content[: match.start("text")].count("\n"), language, match["text"], match["mark"] or "")
        for match in FENCE.finditer(content)
        if match["language"] == language
    ]


def run_python(page: Path, names: dict[str, Any]) -> None:
    """Run the Python blocks of a page one after the other in ``names``; tracebacks show lines of the page."""
    for fence in fences(page, "python"):
        if fence.mark != "not run":
            exec(compile("\n" * fence.line + fence.text, str(page), "exec"), names)


def command_lines(page: Path) -> list[str]:
    """Return the command lines of the bash blocks of a page."""
    lines = []
    for fence in fences(page, "bash"):
        for line in fence.text.replace("\\\n", " ").splitlines():
            line = re.sub(r"(^|\s)#.*", "", line).strip()
            if line and fence.mark != "not run":
                lines.append(line)
    return lines


def prose(page: Path) -> str:
    """Return a page without its blocks."""
    return FENCE.sub("", page.read_text())
