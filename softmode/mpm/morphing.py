"""`morph`: one body turned into another, or into several in a row, with a file that can be gone on with."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from softmode.mpm.particles import ParticleBody
from softmode.mpm.planner import MorphOptions, MorphPlanner
from softmode.mpm.run import MorphRun


def morph(
    source: ParticleBody,
    target: ParticleBody | Sequence[ParticleBody],
    options: MorphOptions | None = None,
    *,
    file: str | os.PathLike[str] | None = None,
    names: Sequence[str] = (),
    device: wp.DeviceLike = None,
    progress: Callable[[int, float], None] | None = None,
) -> MorphRun:
    """Turn a body into another.

    All are moved so that their centres of mass lie in the middle of the grid: aligned boxes nearly double the loss at
    the start.

    Args:
        source: The body that is turned.
        target: What it becomes; several are become one after another, with ``frame_count`` steps each.
        options: How the morph is planned; by default a grid of 32^3 nodes of 1 m, which suits bodies 14 to 20 m long.
        file: Where to keep the run while it goes on (.npz); one that was cut off is gone on with.
        names: What source and targets were made from, for the file.
        device: Where to compute; Warp's preferred device when None.
        progress: Called after each segment with its number and its loss.

    Raises:
        AssetError: If the file is no morph, or that of another source, target or options.
        ConfigError: If a body does not fit into the grid or a step is not stable.
        SolverDiverged: If no control keeps the particles of the first segment on the grid and finite.
        StorageError: If the file cannot be written.
    """
    chosen = options or MorphOptions()
    grid = chosen.mpm.grid
    bodies = [source, *((target,) if isinstance(target, ParticleBody) else target)]
    offsets = np.array([grid.middle - body.centre for body in bodies])
    first, *goals = (body.moved(offset) for body, offset in zip(bodies, offsets, strict=True))
    planner = MorphPlanner(first, goals, chosen, device=device)
    return planner.run(progress, file=file, names=names, offsets=offsets)[0]
