"""Damaged files of all formats: a valid load or a typed error with a remedy, within bounds of time and memory."""

from __future__ import annotations

import pytest

from tests.fuzz import Tally, run
from tests.fuzz_seeds import DEAR, READERS


def total(tallies: dict[str, Tally], kind: str) -> int:
    """Return a sum over all formats."""
    return sum(getattr(tally, kind) for tally in tallies.values())


def test_damaged_files() -> None:
    """200 damaged files of the formats that are read in this process: nothing is found, and much is refused."""
    tallies, findings = run(200, formats=[name for name in READERS if name not in DEAR])
    assert not findings, "\n".join(findings)
    assert total(tallies, "loaded") + total(tallies, "refused") == 200
    assert total(tallies, "refused") > 80 and total(tallies, "loaded") > 10


@pytest.mark.slow
def test_damaged_files_at_length() -> None:
    """2,000 other damaged files over all formats; each refuses some, and those without checksums load some."""
    tallies, findings = run(2000, seed=1)
    assert not findings, "\n".join(findings)
    assert total(tallies, "loaded") + total(tallies, "refused") == 2000
    for name, tally in tallies.items():
        assert tally.refused, name
        assert tally.loaded or name in ("spz packed", "stage packed"), name
