"""`build_object`: objects built with regions and stiffer parts, and what was left out on the way."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.objects.loader import Progress, object_config
from softmode.objects.pipeline import build_standing, dressed
from softmode.objects.soft_object import SoftObject
from softmode.objects.source import object_source

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
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`.
        options: Fields of `ObjectConfig`, such as ``size=0.08``.

    Returns:
        The object, and the quadrature that it was built from, in the coordinates of the standing object.

    Raises:
        AssetError: If the file cannot be read or encloses no volume.
        ConfigError: If the configuration names a body, or a box holds nothing.
        BasisError: If the basis cannot be built, or a region holds too little.
    """
    config = object_config(source, **options)
    parts = object_source(config)
    material = material or config.material
    body, quadrature = build_standing(config.for_material(material), parts, regions=regions, progress=progress)
    return dressed(body, config, parts, material), quadrature
