"""`build_object`: objects built with regions and stiffer parts, and what was left out on the way."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.deformables.body.regions import Region
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.objects.loader import Progress, object_config
from softmode.objects.soft_object import SoftObject
from softmode.objects.source import object_source, splats_of_body, standing_quadrature

if TYPE_CHECKING:
    from softmode.objects.loader import Source

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
        require_number("stiffness: factor", self.factor, above=0.0)


def build_object(
    source: Source | str | os.PathLike[str],
    *,
    regions: Sequence[Region] = (),
    stiffness: Sequence[StifferBox] = (),
    material: Material | None = None,
    progress: Progress = None,
    **options: Any,
) -> tuple[SoftObject, Quadrature]:
    """Build an object anew and not in the cache, with regions and parts of other stiffness.

    Regions and boxes are given in the coordinates of the standing object: metres, z up, its bounding box centred over
    the origin and standing on z = 0. The body's `provenance` tells the kind of the asset and how much of it was left
    out.

    Args:
        source: Which object, as for `load`; not a body.
        regions: Parts that a scene holds, moves or grasps.
        stiffness: Parts of another stiffness; where they overlap, the last one counts.
        material: What the object is made of, as for `load`.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.
        options: Fields of `ObjectConfig`, such as ``size=0.08``.

    Returns:
        The object, and the quadrature that it was built from, in the coordinates of the standing object.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
        ConfigError: If the configuration names a body, or a box holds nothing.
        BasisError: If the basis cannot be built, or a region holds too little.
    """
    config = object_config(source, **options)
    if config.body is not None:
        raise ConfigError(f"{config.body} is a body already", hint="give the file that it was built from")
    parts = object_source(config)
    quadrature, turn = standing_quadrature(config, parts)
    low, high = quadrature.bounds
    seat = np.array([*(0.5 * (low + high))[:2], low[2]])
    scale = _stiffness(stiffness, quadrature.points - seat)
    body = build_body(
        quadrature,
        config.for_material(material).build,
        name=parts.name,
        regions=[region.moved(-seat, quadrature.bounds) for region in regions],
        stiffness_scale=scale,
        progress=progress,
    )
    splats = splats_of_body(parts.splats, body, turn)
    left_out = parts.asset_splats - splats.count
    kind = "mesh" if config.mesh is not None else "splat" if config.splat is not None else config.shape
    origin = {"asset": parts.name, "asset_kind": kind}
    counts = {"asset_splats": parts.asset_splats, "asset_left_out": left_out}
    frame = {"turn": json.dumps(turn.tolist()), "seat": json.dumps(seat.tolist())}
    body = replace(body, provenance={**body.provenance, **origin, **counts, **frame})
    found = SoftObject(body=body, splats=splats, material=material, contact_radius=config.contact_radius, config=config)
    return found, quadrature


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
