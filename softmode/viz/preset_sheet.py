"""A sheet of pictures of the preset objects."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import numpy as np

from softmode.objects.config import ObjectConfig
from softmode.objects.source import object_source
from softmode.viz.figure_file import figure_file
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
    columns = min(COLUMNS, len(objects))
    rows = math.ceil(len(objects) / columns)
    size = (3.2 * columns, 3.45 * rows)
    with figure_file(path, size, what="sheet", whole="a sheet of objects", like="presets.png") as figure:
        grid = figure.add_gridspec(rows, columns, left=0.01, right=0.99, top=1.0 - 0.1 / rows, bottom=0.01, hspace=0.1)
        for k, config in enumerate(objects):
            source = object_source(config)
            edges = " x ".join(f"{1e3 * edge:.0f}" for edge in np.ptp(source.splats.bounds(), axis=0))
            draw_view(
                figure.add_subplot(grid[divmod(k, columns)]),
                f"{source.name}\n{edges} mm",
                source.splats,
                TOWARD,
                unit="m",
            )
