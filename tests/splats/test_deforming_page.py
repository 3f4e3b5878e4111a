"""docs/deforming_splats.md runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softmode.splats import read_splats

PAGE = Path(__file__).resolve().parents[2] / "docs" / "deforming_splats.md"


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The object falls as s = g n (n + 1) dt^2 / 2 says until it lands, is in the picture, and is saved as it lies."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    snippets = [part.split("```")[0] for part in PAGE.read_text().split("```python")[1:]]
    assert len(snippets) == 1
    exec(snippets[0], names)
    camera, rest, now = names["camera"], names["rest"], names["now"]
    fall = 9.81 * 30 * 31 / 2 / 240.0**2  # [m], further than it has room for
    drop = rest.bounds()[0, 2] + names["soft"].height + 0.02
    assert fall > drop
    assert abs(now.bounds()[0, 2]) < 2e-3  # [m], on the ground
    assert camera.images("front", "alpha").numpy()[0].max() > 0.9
    saved = read_splats(tmp_path / "landed.ply")
    np.testing.assert_array_equal(saved.means, now.means)
    np.testing.assert_array_equal(saved.means, names["splats"].means.numpy()[0])
