"""The pages are easy to read as text: short lines, and headings that name their subject."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.documentation.pages import FENCE, PAGES, ROOT

WIDTH = 120
"""Longest line of prose [characters]."""
LINK = re.compile(r"!?\[[^\]]*\]\([^)]*\)")
"""A link or a picture."""


def _lines(text: str) -> list[tuple[int, str]]:
    """Return the lines of a page outside blocks of code, each with its number."""
    blank = FENCE.sub(lambda match: "\n" * match[0].count("\n"), text)
    return list(enumerate(blank.splitlines(), start=1))


def long_lines(text: str) -> list[int]:
    """Return the numbers of the lines of prose that are too long.

    Code, rows of tables and lines that hold one link or one picture alone may be of any length.
    """
    return [
        number
        for number, line in _lines(text)
        if len(line) > WIDTH and not line.lstrip().startswith("|") and not LINK.fullmatch(line.strip())
    ]


def headings(text: str) -> list[tuple[int, str]]:
    """Return the headings of a page, each with its number of line."""
    return [(number, line.lstrip("# ")) for number, line in _lines(text) if re.match(r"#{1,6} ", line)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_lines_are_short(page: Path) -> None:
    """No line of prose is longer than 120 characters."""
    found = long_lines(page.read_text())
    assert not found, f"{page.relative_to(ROOT)}: lines longer than {WIDTH} characters: {found}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_headings_name_a_subject(page: Path) -> None:
    """A page has a heading, and none has a colon: what follows a colon belongs into the text."""
    found = headings(page.read_text())
    assert found, f"{page.relative_to(ROOT)} has no heading"
    wrong = [f"{number}: {heading}" for number, heading in found if ":" in heading]
    assert not wrong, f"{page.relative_to(ROOT)}: headings with a colon: {wrong}"


def test_what_counts_as_prose() -> None:
    """Long code, rows and pictures are left out, long text and list items are found where they stand."""
    long = "word " * 30
    page = f"# A: b\n\n```python\n# no heading: {long}\n```\n\n| {long} |\n![{long}](x.png)\n{long}\n- {long}\n"
    assert long_lines(page) == [9, 10]
    assert headings(page) == [(1, "A: b")]
