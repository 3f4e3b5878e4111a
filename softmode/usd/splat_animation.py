"""Splats or points that move, as an OpenUSD stage: what is no reduced body, such as a morph."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from softmode.checks import require_choice
from softmode.errors import ConfigError
from softmode.objects.shapes.level_sets import marching_cubes
from softmode.splats.formats.usd import define_splats, set_splat_column, splat_columns
from softmode.splats.splats import Splats
from softmode.usd.openusd import check_stage, openusd, whole_stage
from softmode.usd.staging import author_cameras, author_lights, overview
from softmode.usd.writer import float_array, new_layer, new_stage, prim_name, save, set_points, vectors

_SAVE_BYTES = 64e6
"""After so many bytes of samples the layer is saved, which takes them out of memory."""
Shown = Literal["splats", "points", "mesh"]
MOST_NODES = 3.0e8
"""Of the grid that a mesh is found on: some 5 GB."""


def write_splat_animation(
    path: str | os.PathLike[str],
    frames: Iterable[Splats],
    *,
    fps: float = 30.0,
    name: str = "splats",
    shown: Shown = "splats",
) -> int:
    """Write splats that move, change and take other colours as a stage; it appears complete or not at all.

    Args:
        path: A `.usdc` or `.usd` (binary) or `.usda` (text) file; folders are made.
        frames: The splats of each frame, as many in all of them [m].
        fps: Frames per second [1/s]; a frame is a time code.
        name: Name of the prim under /World.
        shown: What is written: the splats; `UsdGeom.Points` with colours and the widths of the first frame, which every
            viewer draws; or a `UsdGeom.Mesh`, the surface of a body that the splats fill evenly, by marching cubes
            over half as wide cells as they are apart in the first frame, each vertex in the colour of the nearest.

    Returns:
        The number of frames.

    Raises:
        ConfigError: If there is no frame, the number of splats changes, the file's name does not end like a stage, or
            `shown` is no choice, or a mesh is wanted of splats that do not fill a body.
        StorageError: If the file cannot be written.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    require_choice("shown", shown, get_args(Shown))
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
        prim, count, first, near, waiting, cell = f"/World/{prim_name(name, set())}", 0, None, None, 0, 0.0
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for splats in frames:
            if first is None:
                first = splats
                if shown == "mesh":
                    UsdGeom.Mesh.Define(stage, prim).CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
                    cell = 0.5 * float(np.median(KDTree(splats.means).query(splats.means, k=2)[0][:, 1]))
                    if not 0.0 < cell < np.inf:
                        hint = 'give evenly spread ones, such as particles, or write shown="points"'
                        raise ConfigError("frames: a mesh needs splats at different places", hint=hint)
                elif shown == "points":
                    points = UsdGeom.Points.Define(stage, prim)
                    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
                    points.CreateWidthsAttr(float_array(2.0 * splats.scales[:, 0]))
                else:
                    define_splats(stage, prim, splats.sh_degree)
            if splats.count != first.count:
                raise ConfigError(f"frames: frame {count} has {splats.count} splats, the first one {first.count}")
            if shown == "mesh":
                waiting += _set_surface(UsdGeom.Mesh(stage.GetPrimAtPath(prim)), splats, cell, count)
            elif shown == "points":
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


def _set_surface(mesh: Any, splats: Splats, cell: float, time: int) -> int:
    """Author the surface of what splats fill, two cells apart from each other, at a time code; return its bytes."""
    UsdGeom, Vt = openusd("UsdGeom", "Vt")
    low = splats.means.min(axis=0) - 5.0 * cell
    node: NDArray[np.int64] = np.floor((splats.means - low) / cell).astype(np.int64)
    shape = node.max(axis=0) + 6
    if np.prod(shape.astype(float)) > MOST_NODES:
        hint = 'leave out what has flown away, or write shown="points"'
        raise ConfigError(f"frames: frame {time} spans {' x '.join(map(str, shape))} cells of a mesh", hint=hint)
    full = np.bincount(np.ravel_multi_index(tuple(node.T), shape), minlength=int(np.prod(shape))).reshape(shape)
    found, faces = marching_cubes(0.5 / 8.0 - gaussian_filter(full.astype(np.float64), 1.5))
    points = low + cell * (found + 0.5)
    colors = splats.colors()[KDTree(splats.means).query(points)[1]]
    places = vectors(points)
    mesh.CreatePointsAttr().Set(places, time)
    mesh.CreateExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(places), time)
    mesh.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)), time)
    mesh.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(faces.ravel()), time)
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vectors(colors), time)
    return 24 * len(points) + 16 * len(faces)
