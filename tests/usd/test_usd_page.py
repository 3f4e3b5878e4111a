"""docs/usd.md runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "usd.md"


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its snippets run one after the other in an empty folder; what they play is what they simulated."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for snippet in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(snippet, str(PAGE), "exec"), names)
    assert names["q"].shape == (10, names["toy"].body.function_count, 3)
    fallen = names["splats"].means[:, 2].mean() - names["played"].splats_at(0).means[:, 2].mean()
    assert -0.08 < fallen < -0.03  # from 0.1 m to the ground, on which its centre is some 4 cm high
    assert np.isfinite(names["q"]).all()
