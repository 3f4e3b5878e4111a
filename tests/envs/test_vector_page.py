"""docs/vector_envs.md names every rule of the checker."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "vector_envs.md"


def test_the_page_names_every_rule() -> None:
    """The table of rules has those that errors name."""
    from softmode.vector_check import VALUES

    rows = re.search(r"\| rule \|.*?\n\n", PAGE.read_text(), re.DOTALL)
    assert rows is not None
    for rule in (*VALUES, "seeding", "autoreset", "time limit", "isolation", "bad actions", "no shared buffers"):
        assert rule in rows.group(), rule
