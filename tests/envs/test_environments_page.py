"""docs/environments.md runs, and names every observation segment, reward term and parameter."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).resolve().parents[2] / "docs" / "environments.md"


def test_the_page_runs() -> None:
    """Its snippets run one after the other; the computed rewards are those of the comment."""
    names: dict[str, Any] = {}
    for snippet in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(snippet, str(PAGE), "exec"), names)
    np.testing.assert_array_equal(
        names["env"].unwrapped.compute_reward(names["desired"], names["desired"], {}), np.float32(0.0)
    )
