"""Radiance fields that deform: grids of density and colour, their files, rays through them, and splats baked of them.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.radiance.bake import splats_from_radiance
    from softmode.radiance.formats import read_radiance, write_radiance
    from softmode.radiance.grid import RadianceGrid
    from softmode.radiance.march import MarchOptions, RadianceMarch, render_radiance

__all__ = [
    "MarchOptions",
    "RadianceGrid",
    "RadianceMarch",
    "read_radiance",
    "render_radiance",
    "splats_from_radiance",
    "write_radiance",
]

__getattr__, __dir__ = lazy_names(__name__)
