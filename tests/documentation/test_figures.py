"""Figures of speed lie once, in ``docs/data``: pages take them from there, and none is typed by hand a second time."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest

from benchmarks import tasks
from benchmarks.record import record
from tests.documentation.pages import FENCE, ROOT

SOURCE = runpy.run_path(str(ROOT / "docs" / "figures.py"))
FIGURES = SOURCE["figures"]()
SPEED = re.compile(
    r"\d (?:ms|us|µs)\b"
    r"|\d (?:environment |control |world )?steps (?:per|a) second|\d steps/s"
    r"|\d pictures (?:of \d+ px )?(?:per|a) second"
    r"|\d times real time|\d x real time|\d times as (?:fast|many)"
)
"""A time of a step or of a picture, a rate, or a ratio of speeds; durations in seconds are mostly simulated."""
TYPED = {
    "docs/accuracy.md": 6,
    "docs/baselines.md": 2,
    "docs/bodies.md": 1,
    "docs/contact.md": 13,
    "docs/coupling.md": 17,
    "docs/deforming_splats.md": 1,
    "docs/environments.md": 11,
    "docs/faq.md": 1,
    "docs/howto/tune_a_material.md": 1,
    "docs/limits.md": 6,
    "docs/local_handles.md": 10,
    "docs/morphing.md": 1,
    "docs/radiance.md": 3,
    "docs/rendering_gradients.md": 1,
    "docs/rerun.md": 4,
    "docs/robots.md": 1,
    "docs/training.md": 1,
    "docs/usd.md": 2,
    "docs/view.md": 4,
}
"""Pages with tables of their own: how many of their lines have figures of speed, or sizes of steps that read like them.

It only gets less: README and pages that are not here have none."""


def typed_speeds(text: str) -> list[str]:
    """Return the lines of a page that have a figure of speed typed by hand."""
    unmarked = SOURCE["MARKED"].sub("", FENCE.sub("", text))
    return [line for line in unmarked.splitlines() if SPEED.search(line)]


@pytest.mark.parametrize("page", SOURCE["pages"](), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_marked_places_are_up_to_date(page: Path) -> None:
    """A marked place has the value of docs/data; ``python docs/figures.py`` renews it."""
    text = page.read_text()
    assert SOURCE["filled"](text, FIGURES) == text, "run python docs/figures.py"
    assert not re.search(r"^ *<!-- =", text, re.M), "a comment that begins a line ends the paragraph"


def test_page_of_figures_is_up_to_date() -> None:
    """The page "Figures" is what docs/data says."""
    assert SOURCE["PAGE"].read_text() == SOURCE["page"](FIGURES), "run python docs/figures.py"


def test_page_of_tasks_is_up_to_date() -> None:
    """The page on tasks and methods is what docs/data/tasks.csv says; every cell has figures, a command or a reason."""
    text, rows = tasks.PAGE.read_text(), tasks.known()
    assert text == tasks.page(rows), "run python -m benchmarks.tasks"
    filled = {(row["task"], row["method"]) for row in rows}
    assert sum(
        line.count("`") >= 2 or "no " in line or "sparse" in line for line in text.splitlines() if "|" in line
    ) == len(rows) + len(tasks.METHODS) * len(tasks.IDS) - len(filled)


def test_figures_say_where_they_come_from() -> None:
    """A figure has a question, a value, a date, a machine, a commit and a command."""
    for name, figure in FIGURES.items():
        assert set(figure) == {"what", "value", "unit", "date", "machine", "commit", "command", "of"}, name
        assert figure["of"] in ("run", "row"), name
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", figure["date"]), name
        assert figure["what"] and str(figure["value"]) and figure["machine"] and figure["command"], name
        assert re.fullmatch(r"[0-9a-f]{7,}\+?", figure["commit"]), name


@pytest.mark.parametrize("page", SOURCE["pages"](), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_speed_is_typed_by_hand(page: Path) -> None:
    """README and pages have no figure of speed outside marked places; pages of tables no more than they had."""
    found = typed_speeds(page.read_text())
    assert len(found) <= TYPED.get(page.relative_to(ROOT).as_posix(), 0), found


def test_what_counts_as_typed() -> None:
    """A rate or a time of a step counts where it is typed, not where it is marked or in a block of code."""
    marked = "<!-- =scaling.plush_random_4096 -->190,820 steps per second<!-- / -->"
    assert typed_speeds(f"A step takes 1.1 ms.\n{marked}\n\n```bash\nsleep  # 3 ms\n```\n") == ["A step takes 1.1 ms."]
    assert typed_speeds("It makes 159,000 environment steps per second.")


def test_a_record_renews_what_is_public(tmp_path: Path) -> None:
    """Value, date, machine, commit and command are renewed; question and unit stay; other names are left out."""
    old = {"what": "a step", "value": 2.0, "unit": "ms", "date": "", "machine": "", "commit": "", "command": ""}
    (tmp_path / "step.json").write_text(json.dumps({"beam": old}))
    record("step", {"beam": 1.5, "other": 3.0}, folder=tmp_path)
    (name, found), *others = json.loads((tmp_path / "step.json").read_text()).items()
    assert not others and (name, found["value"], found["what"], found["unit"]) == ("beam", 1.5, "a step", "ms")
    assert all(found[key] for key in ("date", "machine", "commit", "command")) and found["of"] == "run"
