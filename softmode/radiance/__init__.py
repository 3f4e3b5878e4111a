"""Radiance fields that deform: grids of density and colour, their files, rays through them, and splats baked of them.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.radiance.bake import splats_from_radiance as splats_from_radiance
    from softmode.radiance.formats import read_radiance as read_radiance
    from softmode.radiance.formats import write_radiance as write_radiance
    from softmode.radiance.grid import RadianceGrid as RadianceGrid
    from softmode.radiance.march import MarchOptions as MarchOptions
    from softmode.radiance.march import RadianceMarch as RadianceMarch
    from softmode.radiance.march import render_radiance as render_radiance
    from softmode.radiance.sample import sampled_field as sampled_field

__getattr__, __dir__ = lazy_names(__name__)
