"""Splats or points that move, as an OpenUSD stage: what is no reduced body, such as a morph."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable

import numpy as np

from softmode.errors import ConfigError
from softmode.splats.formats.usd import define_splats, set_splat_column, splat_columns
from softmode.splats.splats import Splats
from softmode.usd.openusd import check_stage, openusd, whole_stage
from softmode.usd.staging import author_cameras, author_lights, overview
from softmode.usd.writer import float_array, new_layer, new_stage, prim_name, save, set_points, vectors

_SAVE_BYTES = 64e6
"""After so many bytes of samples the layer is saved, which takes them out of memory."""


def write_splat_animation(
    path: str | os.PathLike[str],
    frames: Iterable[Splats],
    *,
    fps: float = 30.0,
    name: str = "splats",
    as_points: bool = False,
) -> int:
    """Write splats that move, change and take other colours as a stage; it appears complete or not at all.

    Args:
        path: A `.usdc` or `.usd` (binary) or `.usda` (text) file; folders are made.
        frames: The splats of each frame, as many in all of them [m].
        fps: Frames per second [1/s]; a frame is a time code.
        name: Name of the prim under /World.
        as_points: Write `UsdGeom.Points` with colours and the widths of the first frame, which every viewer draws.

    Returns:
        The number of frames.

    Raises:
        ConfigError: If there is no frame, the number of splats changes, or the file's name does not end like a stage.
        StorageError: If the file cannot be written.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    target = check_stage(path)
    UsdGeom, UsdVol = openusd("UsdGeom", "UsdVol")
    with contextlib.suppress(OSError):  # what is in the way will be told by the next line
        target.parent.mkdir(parents=True, exist_ok=True)
    with whole_stage(target) as file:
        layer = new_layer(str(file))
        stage = new_stage(layer)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0.0)
        prim, count, first, near, waiting = f"/World/{prim_name(name, set())}", 0, None, None, 0
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for splats in frames:
            if first is None:
                first = splats
                if as_points:
                    points = UsdGeom.Points.Define(stage, prim)
                    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
                    points.CreateWidthsAttr(float_array(2.0 * splats.scales[:, 0]))
                else:
                    define_splats(stage, prim, splats.sh_degree)
            if splats.count != first.count:
                raise ConfigError(f"frames: frame {count} has {splats.count} splats, the first one {first.count}")
            if as_points:
                points = UsdGeom.Points(stage.GetPrimAtPath(prim))
                points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vectors(splats.colors()), count)
                set_points(points, splats.means, count)
                waiting += 24 * splats.count
            else:
                columns = splat_columns(splats, near=near)
                near = columns["orientations"]
                for column, values in columns.items():
                    always = column == "opacities"
                    if not always or count == 0:
                        made = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(prim))
                        set_splat_column(made, column, values, None if always else count)
                        waiting += values.nbytes
            low, high = np.minimum(low, splats.means.min(axis=0)), np.maximum(high, splats.means.max(axis=0))
            count += 1
            if waiting > _SAVE_BYTES:
                save(layer)
                waiting = 0
        if first is None:
            raise ConfigError("frames: expected one or more")
        stage.SetEndTimeCode(count - 1)
        author_cameras(stage, [overview(np.stack([low, high]))])
        author_lights(stage)
        save(layer)
    return count
