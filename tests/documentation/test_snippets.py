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

DEAR = {
    "docs/examples.md",
    "docs/environments.md",
    "docs/howto/tune_a_material.md",
    "docs/body_tool.md",
    "docs/local_handles.md",
    "README.md",
    *("docs/objects.md", "docs/usd.md", "docs/view.md", "docs/bodies.md", "docs/rerun.md", "docs/radiance.md"),
    *("docs/cutting.md", "docs/robots.md", "docs/howto/own_splat.md", "docs/howto/own_robot.md"),
    *("docs/howto/own_env.md", "docs/gradients.md", "docs/deforming_splats.md"),
}
"""Pages of 2 s and more whose snippets show at length what tests of their rooms show; they run with the rest."""


def _name(page: Path) -> str:
    """Return the path of a page below the checkout."""
    return page.relative_to(ROOT).as_posix()


def _marks(page: Path) -> list[pytest.MarkDecorator]:
    """Return what keeps a page out of a short run: a slow snippet, or that it is dear."""
    slow = any(fence.mark == "slow" for fence in fences(page, "python"))
    return [pytest.mark.slow] if slow else [pytest.mark.rest] if _name(page) in DEAR else []


@pytest.mark.parametrize("page", [pytest.param(page, id=_name(page), marks=_marks(page)) for page in WITH_PYTHON])
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
    """No set-up, result or mark is left of a page that is gone or no longer runs."""
    assert {_name(page) for page in WITH_PYTHON} >= {*SETUPS, *RESULTS, *DEAR}


def test_every_fence_names_its_language() -> None:
    """A block that is neither Python nor bash, and would be skipped, says what it is."""
    for page in PAGES:
        assert not fences(page, ""), f"{_name(page)}: name the language of the block: python, bash or text"
