"""A matplotlib figure that becomes a .png file."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softmode.errors import ConfigError, needs_extra
from softmode.files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextlib.contextmanager
def figure_file(
    path: str | os.PathLike[str],
    size: tuple[float, float],
    *,
    what: str,
    whole: str,
    like: str,
    few_colors: bool = False,
) -> Iterator[Figure]:
    """Give a white figure to draw on, and write it at the end; the file appears complete or not at all.

    Args:
        path: The .png to write.
        size: Width and height [in], at 100 dots per inch.
        what: What it is, "picture" or "sheet", for messages.
        whole: The same with what it shows.
        like: Name that such a file may have.
        few_colors: Write 256 colours, dithered, which makes half the size.

    Raises:
        MissingExtraError: If matplotlib is not installed.
        ConfigError: If the name is not that of a .png.
        StorageError: If it cannot be written.
    """
    with needs_extra("viz", f"{whole} needs matplotlib"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    from PIL import Image

    target = Path(path)
    if target.suffix.lower() != ".png":
        raise ConfigError(f"{what} {target} is no .png file", hint=f"name it like {like}")
    figure = Figure(figsize=size, dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    yield figure
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
    if few_colors:
        picture = picture.quantize(palette=picture.quantize(256), dither=Image.Dither.FLOYDSTEINBERG)
    with whole_file(target, what) as file:
        picture.save(file, format="png", optimize=True)
