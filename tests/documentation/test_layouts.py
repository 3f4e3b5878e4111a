"""The tables of what is read, read with a note, and refused are those of the readers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.layouts import BEGIN, DOCS, END, PAGES, rendered


@pytest.mark.parametrize("page", PAGES)
def test_tables_say_what_the_readers_do(tmp_path: Path, page: str) -> None:
    """Every file of the layouts is read right, or refused with a remedy, as the page says."""
    if page == "usd.md":
        pytest.importorskip("pxr", reason="needs the extra [usd]")
    written = BEGIN + (DOCS / page).read_text().partition(BEGIN)[2].partition(END)[0] + END
    assert written == rendered(PAGES[page], tmp_path), "make them anew: python -m tests.layouts"
