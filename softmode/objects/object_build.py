"""`build_object`: objects built with regions and stiffer parts, and what was left out on the way."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softmode.deformables.body.regions import Region
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.materials.material import Material
from softmode.errors import ConfigError
from softmode.objects.loader import Progress, object_config
from softmode.objects.soft_object import SoftObject
from softmode.objects.source import (
    field_of_body,
    object_source,
    splats_of_body,
    standing_quadrature,
    stiffness_scale,
    with_origin,
)

if TYPE_CHECKING:
    from softmode.objects.loader import Source


def build_object(
    source: Source | str | os.PathLike[str],
    *,
    regions: Sequence[Region] = (),
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
    material = material or config.material
    if config.body is not None:
        raise ConfigError(f"{config.body} is a body already", hint="give the file that it was built from")
    parts = object_source(config)
    quadrature, turn = standing_quadrature(config, parts)
    low, high = quadrature.bounds
    seat = np.array([*(0.5 * (low + high))[:2], low[2]])
    body = build_body(
        quadrature,
        config.for_material(material).build,
        name=parts.name,
        regions=[region.moved(-seat, quadrature.bounds) for region in regions],
        stiffness_scale=stiffness_scale(config, quadrature, parts, turn),
        progress=progress,
    )
    splats = splats_of_body(parts.splats, body, turn)
    frame = {"turn": json.dumps(turn.tolist()), "seat": json.dumps(seat.tolist())}
    body = with_origin(replace(body, provenance={**body.provenance, **frame}), config, parts, splats)
    found = SoftObject(
        body=body,
        splats=splats,
        material=material,
        contact_radius=config.contact_radius,
        config=config,
        radiance=field_of_body(parts, body, turn),
    )
    return found, quadrature
