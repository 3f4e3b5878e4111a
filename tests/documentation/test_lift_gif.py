"""The moving picture of the first page: small, in motion, and made by its script."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from tests.documentation.pages import ROOT

iio = pytest.importorskip("imageio.v3", reason="needs the extra [demo]")
pytest.importorskip("imageio_ffmpeg", reason="needs the extra [demo]")
Image = pytest.importorskip("PIL.Image", reason="needs the extra [demo]")


@pytest.mark.parametrize("name", ["lift", "playbot", "presets", "press"])
def test_the_committed_picture(name: str) -> None:
    """It is smaller than 2 MB, loops, and its last frame differs from the first: the object is elsewhere."""
    path = ROOT / "docs" / "images" / f"{name}.gif"
    assert path.stat().st_size < 2e6
    with Image.open(path) as picture:
        assert picture.info["loop"] == 0 and picture.n_frames > 20
        first = np.asarray(picture.convert("RGB"), float)
        picture.seek(picture.n_frames - 1)
        last = np.asarray(picture.convert("RGB"), float)
    assert (np.abs(last - first).max(axis=2) > 40).mean() > 0.05


def test_the_script(tmp_path: Path) -> None:
    """A film of 1 s at 25 frames per second, black that turns white, becomes 13 frames that do the same."""
    script = runpy.run_path(str(ROOT / "docs" / "lift_gif.py"))
    film, target = tmp_path / "film.mp4", tmp_path / "film.gif"
    levels = np.linspace(0, 255, 25).astype(np.uint8)
    pictures = np.broadcast_to(levels[:, None, None, None], (25, 32, 64, 3))
    iio.imwrite(film, pictures, fps=25, plugin="FFMPEG", macro_block_size=1)
    size = script["write_gif"](film, target, width=32, seconds=1.0, colors=32)
    assert size == target.stat().st_size
    with Image.open(target) as gif:
        assert gif.size == (32, 16) and gif.n_frames == 13
        delays, means = [], []
        for k in range(gif.n_frames):
            gif.seek(k)
            delays.append(gif.info["duration"])
            means.append(np.asarray(gif.convert("L"), float).mean())
    assert delays == [80] * 12 + [1200]
    assert means[0] < 20 and means[-1] > 235 and (np.diff(means) > 0).all()
    with pytest.raises(ValueError, match="shorter"):
        script["write_gif"](film, target, width=32, seconds=2.0, colors=32)
