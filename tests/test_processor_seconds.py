"""The record of processor seconds: what a run adds to it, and what it says of the tests of the next."""

from __future__ import annotations

from tests.processor_seconds import expected, merged

BEFORE = {"a.py": {"test_gone": 9.0, "test_kept": 2.0, "others": 0.3}, "b.py": {"test_b": 1.0, "others": 0.0}}


def test_a_run_replaces_the_seconds_of_its_tests() -> None:
    """Cases of a function add up, short functions are one entry, and what did not run keeps its figures."""
    spent = {"tests/a.py::test_long[1]": 1.25, "tests/a.py::test_long[2]": 1.0, "tests/a.py::test_short": 0.1}
    after = merged(BEFORE, spent)
    assert after["a.py"] == {"test_gone": 9.0, "test_kept": 2.0, "test_long": 2.2, "others": 0.1}
    assert after["b.py"] == BEFORE["b.py"]


def test_files_are_expected_to_take_what_their_tests_took() -> None:
    """A function counts once, with all its cases; one without a figure is among the others; a new file takes 0."""
    wanted = ["tests/a.py::test_kept[x]", "tests/a.py::test_kept[y]", "tests/a.py::test_new", "tests/c.py::test_c"]
    assert expected(wanted, BEFORE) == {"a.py": 2.3, "c.py": 0.0}
