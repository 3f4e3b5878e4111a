"""docs/camera.md runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).resolve().parents[2] / "docs" / "camera.md"


def test_the_page_runs() -> None:
    """All snippets, one after the other; the pixels of the block are on the block in the two worlds not drawn anew."""
    names: dict[str, Any] = {}
    snippets = [part.split("```")[0] for part in PAGE.read_text().split("```python")[1:]]
    assert len(snippets) == 5
    for snippet in snippets:
        exec(snippet, names)
    camera = names["camera"]
    assert camera.segmentation_ids("hand/*") == names["hand_ids"] != ()
    assert names["block_pixels"].sum(axis=(1, 2)).min() > 50
    offset = camera.variation.offset.numpy().reshape(2, 4, 7)
    identity = np.float32([0, 0, 0, 0, 0, 0, 1])
    assert (offset[:, [1, 3]] == identity).all() and (offset[:, [0, 2], :3] != 0.0).all()
