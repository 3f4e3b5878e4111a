"""Every page's Python runs, in a folder of its own, snippet after snippet."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.documentation.pages import PAGES, ROOT, fences, run_python
from tests.documentation.results import RESULTS
from tests.documentation.setups import SETUPS

WITH_PYTHON = [page for page in PAGES if any(fence.mark != "not run" for fence in fences(page, "python"))]


def _name(page: Path) -> str:
    """Return the path of a page below the checkout."""
    return page.relative_to(ROOT).as_posix()


def _cases() -> list[Any]:
    """Return the pages; those with a slow snippet are marked."""
    return [
        pytest.param(
            page,
            id=_name(page),
            marks=[pytest.mark.slow] if any(fence.mark == "slow" for fence in fences(page, "python")) else [],
        )
        for page in WITH_PYTHON
    ]


@pytest.mark.parametrize("page", _cases())
def test_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its snippets run one after the other, and what the text says of them holds."""
    monkeypatch.chdir(tmp_path)
    setup, result = SETUPS.get(_name(page)), RESULTS.get(_name(page))
    module = ModuleType("page")  # a module that can be found, as dataclasses and kernels expect of theirs
    monkeypatch.setitem(sys.modules, "page", module)
    names: dict[str, Any] = module.__dict__
    names.update(setup(tmp_path) if setup else {})
    run_python(page, names)
    if result:
        result(names, tmp_path)


def test_set_ups_and_results_have_pages() -> None:
    """No set-up and no result is left of a page that is gone or no longer runs."""
    assert {_name(page) for page in WITH_PYTHON} >= {*SETUPS, *RESULTS}


def test_every_fence_names_its_language() -> None:
    """A block that is neither Python nor bash, and would be skipped, says what it is."""
    for page in PAGES:
        assert not fences(page, ""), f"{_name(page)}: name the language of the block: python, bash or text"
