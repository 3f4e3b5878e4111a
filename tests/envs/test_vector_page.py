"""docs/vector_envs.md runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "vector_envs.md"


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its snippets run one after the other, and do what the text around them says."""
    for library in ("torch", "stable_baselines3", "rsl_rl", "skrl"):
        pytest.importorskip(library)
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    for snippet in snippets:
        exec(compile(snippet, str(PAGE), "exec"), names)
    assert names["model"].num_timesteps == 64
    assert names["last"].shape == names["envs"].observation_space.shape
    assert names["runner"].current_learning_iteration == 0 and names["observation"].shape[0] == 2
    assert set(names["report"].checked) >= {"autoreset", "time limit", "nan action", "close"}
    names["envs"].close()


def test_the_page_names_every_rule() -> None:
    """The table of rules has those that errors name."""
    from softmode.envs.check import VALUES

    rows = re.search(r"\| rule \|.*?\n\n", PAGE.read_text(), re.DOTALL)
    assert rows is not None
    for rule in (*VALUES, "seeding", "autoreset", "time limit", "isolation", "bad actions", "no shared buffers"):
        assert rule in rows.group(), rule
