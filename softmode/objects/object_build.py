"""Bodies built from files, with regions and stiffer parts, and what was left out on the way."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.errors import AssetError, ConfigError
from softmode.files import read_arrays
from softmode.objects.soft_object import ObjectConfig, object_source, read_cropped, shown_splats, standing_quadrature
from softmode.splats.formats import READABLE
from softmode.splats.point_cloud import ply_kind
from softmode.splats.splats import Splats
from softmode.stages import tokens

FileKind = Literal["splat", "points", "mesh", "body"]
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class StifferBox:
    """A part of an object of another stiffness: a core, a bone, a soft belly."""

    box: Box
    """Corners x0, y0, z0, x1, y1, z1 [m]; may be infinite."""
    factor: float
    """Young's modulus inside over that of the body, > 0."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise ConfigError(
                f"stiffness: box {self.box} is empty", hint="give x0,y0,z0,x1,y1,z1 with every 0 below its 1"
            )
        if not 0.0 < self.factor < np.inf:
            raise ConfigError(f"stiffness: factor must be a finite number > 0, got {self.factor}")


@dataclass(frozen=True, kw_only=True)
class BuiltObject:
    """A body built from a file, with what it was built from."""

    body: ReducedBody
    """The body."""
    splats: Splats
    """The splats that show it, in the body frame."""
    quadrature: Quadrature
    """What it was built from, in the coordinates of the standing object."""


def file_kind(path: str | Path) -> FileKind:
    """Return what a file is, by its suffix and, for .ply, .npz and OpenUSD, its contents.

    Raises:
        AssetError: If it is missing or cannot be read.
    """
    file = Path(path)
    if not file.exists():
        raise AssetError(f"file {file}: no such file", hint="check the path")
    suffix = file.suffix.lower()
    if suffix == ".npz":
        found = read_arrays(file, ("points", "header"), hint="build or write it again")
        return "points" if set(found) == {"points"} else "body"
    if suffix == ".ply":
        found = ply_kind(file)
        return "splat" if found == "splats" else "mesh" if found == "mesh" else "points"
    if suffix in tokens.SUFFIXES:
        from softmode.objects.stage_asset import asset_kind

        return asset_kind(file)
    return "splat" if file.is_dir() or suffix in READABLE else "mesh"


def config_of_file(path: str | Path, **options: Any) -> ObjectConfig:
    """Return the configuration of the object in a file of any kind that softmode reads.

    Args:
        path: Splats, a mesh, a point cloud or a body.
        options: Further fields of `ObjectConfig`.
    """
    kind = file_kind(path)
    return ObjectConfig(**{"splat" if kind == "points" else kind: path}, **options)


def build_object(
    config: ObjectConfig,
    *,
    regions: Sequence[Region] = (),
    stiffness: Sequence[StifferBox] = (),
    progress: Callable[[str, float], None] | bool | None = None,
) -> BuiltObject:
    """Build the body of a file, anew and not in the cache, and keep what it was built from.

    Regions and boxes are given in the coordinates of the standing object: metres, z up, its bounding box centred over
    the origin and standing on z = 0. The body's `provenance` tells the kind of the asset and how much of it was left
    out.

    Args:
        config: Which object; not a body.
        regions: Parts that a scene holds, moves or grasps.
        stiffness: Parts of another stiffness; where they overlap, the last one counts.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
        ConfigError: If the configuration names a body, or a box holds nothing.
        BasisError: If the basis cannot be built, or a region holds too little.
    """
    if config.body is not None:
        raise ConfigError(f"{config.body} is a body already", hint="give the file that it was built from")
    cropped = None if config.splat is None else read_cropped(config)
    splats, solid, name, _ = object_source(config, cropped)
    quadrature, turn = standing_quadrature(config, solid, splats.name)
    low, high = quadrature.bounds
    seat = np.array([*(0.5 * (low + high))[:2], low[2]])
    scale = _stiffness(stiffness, quadrature.points - seat)
    body = build_body(
        quadrature,
        config.build,
        name=name,
        regions=[region.moved(-seat, quadrature.bounds) for region in regions],
        stiffness_scale=scale,
        progress=progress,
    )
    shown = shown_splats(splats, body, turn)
    kind = "mesh" if config.mesh is not None else "splat" if config.splat is not None else config.shape
    given = splats.count if cropped is None else cropped.count
    told = {"asset": name, "asset_kind": kind, "asset_splats": given, "asset_left_out": given - shown.count}
    rows = {"turn": json.dumps(turn.tolist()), "seat": json.dumps(seat.tolist())}
    return BuiltObject(
        body=replace(body, provenance={**body.provenance, **told, **rows}), splats=shown, quadrature=quadrature
    )


def _stiffness(boxes: Sequence[StifferBox], points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the relative stiffness per quadrature point (P,), None if it is the same everywhere."""
    if not boxes:
        return None
    found = np.ones(len(points))
    for part in boxes:
        inside = (points >= part.box[:3]).all(axis=1) & (points <= part.box[3:]).all(axis=1)
        if not inside.any():
            low, high = np.round([points.min(axis=0), points.max(axis=0)], 4).tolist()
            raise ConfigError(
                f"stiffness: box {part.box} holds no point of the object", hint=f"the object fills {low} to {high} m"
            )
        found[inside] = part.factor
    return found
