"""The snippets of docs/splat_files.md run, one after the other."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from softmode.splats import read_splats


def test_snippets_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They write the files they name; the twist about z keeps the distance of every splat from the axis."""
    pytest.importorskip("pxr", reason="needs the extra [usd]")
    page = Path(__file__).parents[2] / "docs/splat_files.md"
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    snippets = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    assert len(snippets) == 3
    for snippet in snippets:
        exec(compile(snippet, str(page), "exec"), names)
    assert {path.name for path in tmp_path.iterdir()} == {"toy.ply", "toy.spz", "twisted.ply", "twist.usdc"}
    rest, twisted = read_splats("toy.ply"), read_splats("twisted.ply")
    radius, turned = (np.linalg.norm(splats.means[:, :2], axis=1) for splats in (rest, twisted))
    np.testing.assert_allclose(turned, radius, atol=4 * np.finfo(np.float32).eps * radius.max())
    assert abs(rest.means - twisted.means).max() > 0.1 * radius.max()
    assert read_splats("twist.usdc").count == rest.count
