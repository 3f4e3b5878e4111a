"""A sheet of pictures of the preset objects."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softmode.errors import ConfigError, needs_extra
from softmode.files import whole_file
from softmode.objects.config import ObjectConfig
from softmode.objects.source import object_source
from softmode.viz.splat_sheet import draw_view

COLUMNS = 5
"""Pictures in a row, at most."""
TOWARD = np.array([0.48, -0.72, 0.62])
"""Direction to the cameras."""


def write_preset_sheet(path: str | os.PathLike[str], objects: Sequence[ObjectConfig]) -> None:
    """Draw objects with their names, sizes and a bar each; the file appears complete or not at all.

    Args:
        path: The .png to write.
        objects: What is drawn, as it would stand in a scene.

    Raises:
        MissingExtraError: If matplotlib is not installed.
        ConfigError: If the name is not that of a .png.
        StorageError: If it cannot be written.
    """
    with needs_extra("viz", "a sheet of objects needs matplotlib"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise ConfigError(f"sheet {target} is no .png file", hint="name it like presets.png")
    columns = min(COLUMNS, len(objects))
    rows = math.ceil(len(objects) / columns)
    figure = Figure(figsize=(3.2 * columns, 3.45 * rows), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(rows, columns, left=0.01, right=0.99, top=1.0 - 0.1 / rows, bottom=0.01, hspace=0.1)
    for k, config in enumerate(objects):
        source = object_source(config)
        edges = " x ".join(f"{1e3 * edge:.0f}" for edge in np.ptp(source.splats.bounds(), axis=0))
        draw_view(
            figure.add_subplot(grid[divmod(k, columns)]), f"{source.name}\n{edges} mm", source.splats, TOWARD, unit="m"
        )
    canvas.draw()
    from PIL import Image

    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
    with whole_file(target, "sheet") as file:
        picture.save(file, format="png", optimize=True)
