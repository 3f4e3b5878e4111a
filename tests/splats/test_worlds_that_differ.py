"""Splats that differ from world to world: columns, and the same picture as alone."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.splats import make_plush
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays

EDGE = 40


def draw(arrays: SplatArrays, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return colours and object ids of one camera in every world."""
    camera = PinholeCamera.look_at(
        "front", position=(0.25, 0.05, 0.1), target=(0.0, 0.0, 0.03), width=EDGE, height=EDGE, fov_y=0.6
    )
    views = ViewArrays.from_cameras([camera] * worlds, world=range(worlds), device="cpu")
    options = RasterizerOptions(object_ids=True)
    rasterizer = SplatRasterizer(arrays.means.shape[1], worlds, EDGE, EDGE, options=options, device="cpu")
    rasterizer.render(arrays, views)
    return rasterizer.rgb.numpy(), rasterizer.object_id.numpy()


def test_a_world_looks_as_alone() -> None:
    """Worlds with 250 and 400 splats before 220 common ones have the pictures of each alone, bit for bit."""
    small, large = make_plush(250), make_plush(400, 1, height=0.06)
    common = make_plush(220, 2, height=0.03).transformed(translation=(0.05, 0.03, 0.0))
    arrays = SplatArrays.from_splats([[small, large, small], common], world_count=3, device="cpu")
    assert arrays.means.shape == arrays.opacities.shape == (3, 620)
    assert (arrays.opacities.numpy()[0, 250:400] == 0.0).all()
    np.testing.assert_array_equal(arrays.object_index.numpy(), [0] * 400 + [1] * 220)
    rgb, ids = draw(arrays, 3)
    assert {*ids.ravel().tolist()} == {-1, 0, 1}
    for world, first in enumerate((small, large, small)):
        alone = draw(SplatArrays.from_splats([first, common], device="cpu"), 1)
        np.testing.assert_array_equal(rgb[world], alone[0][0])
        np.testing.assert_array_equal(ids[world], alone[1][0])


def test_a_list_has_one_for_each_world() -> None:
    """Two for three worlds, or none, are refused."""
    toy = make_plush(250)
    for given in ([toy, toy], []):
        with pytest.raises(ConfigError, match="worlds"):
            SplatArrays.from_splats([given, toy], world_count=3, device="cpu")
