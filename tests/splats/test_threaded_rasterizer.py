"""Slices of the views drawn by threads are bitwise the images of one thread."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.splats.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer
from softmode.splats.threaded_rasterizer import OUTPUTS, ThreadedRasterizer
from tests.splats.test_rasterizer import EYES, ball, mesh_images, views_of

WIDTH, HEIGHT = 48, 40
OPTIONS = RasterizerOptions(object_ids=True, median_depth=True)


def images(rasterizer: Any) -> dict[str, np.ndarray]:
    """Return copies of all outputs."""
    return {name: getattr(rasterizer, name).numpy().copy() for name in OUTPUTS}


def spoil(rasterizer: Any) -> None:
    """Overwrite all outputs."""
    for name in OUTPUTS:
        getattr(rasterizer, name).fill_(-7)


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("mesh", [False, True])
def test_equals_one_thread(threads: int, mesh: bool) -> None:
    """Five views in any number of slices, called, captured per slice and captured as a whole: the same bits."""
    splats = ball()
    eyes = [EYES[i % 3] + 0.1 * np.arange(3) * i for i in range(5)]
    arrays, views = SplatArrays.from_splats([splats], device="cpu"), views_of(eyes, WIDTH, HEIGHT, "cpu")
    behind = {}
    if mesh:
        rgb, depth = mesh_images(WIDTH, HEIGHT)
        behind["mesh_rgb"] = wp.array(np.tile(rgb, (5, 1, 1, 1)), dtype=wp.vec3, device="cpu")
        behind["mesh_depth"] = wp.array(
            depth + 0.1 * np.arange(5)[:, None, None] * (depth > 0), dtype=float, device="cpu"
        )
    single = SplatRasterizer(splats.count, 5, WIDTH, HEIGHT, options=OPTIONS, device="cpu")
    single.render(arrays, views, **behind)
    expected = images(single)
    assert np.ptp(expected["rgb"], axis=0).max() > 0.1, "the views differ"
    threaded = ThreadedRasterizer(splats.count, 5, WIDTH, HEIGHT, threads=threads, options=OPTIONS)
    assert threaded.thread_count == min(threads, 5)
    replay = threaded.capture(arrays, views, **behind)
    with wp.ScopedCapture(device="cpu") as capture:
        threaded.render(arrays, views, **behind)
    for way in (
        lambda: threaded.render(arrays, views, **behind),
        replay,
        lambda: wp.capture_launch(capture.graph),
    ):
        spoil(threaded)
        way()
        for name, image in images(threaded).items():
            np.testing.assert_array_equal(image, expected[name], err_msg=name)


def test_own_background_per_view() -> None:
    """A background per view goes with its view; one for all serves every slice."""
    splats = ball(20)
    colors = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    views = views_of(EYES, WIDTH, HEIGHT, "cpu")
    views = replace(views, background=wp.array(colors, dtype=wp.vec3, device="cpu"))
    threaded = ThreadedRasterizer(splats.count, 3, WIDTH, HEIGHT, threads=3)
    threaded.render(SplatArrays.from_splats([splats], device="cpu"), views)
    empty = threaded.alpha.numpy() == 0.0
    for view, color in enumerate(colors):
        assert empty[view].any()
        assert (threaded.rgb.numpy()[view][empty[view]] == color).all()


def test_own_gain_per_view() -> None:
    """The gain of a view goes with its view."""
    splats = ball(20)
    gain = wp.array([(1, 0, 0, 1), (0, 1, 0, 0.5), (0, 0, 1, 0)], dtype=wp.vec4, device="cpu")
    black = wp.zeros(1, dtype=wp.vec3, device="cpu")
    views = replace(views_of(EYES, WIDTH, HEIGHT, "cpu"), splat_gain=gain, background=black)
    arrays = SplatArrays.from_splats([splats], device="cpu")
    pictures = []
    for kind in (SplatRasterizer, ThreadedRasterizer):
        rasterizer = kind(splats.count, 3, WIDTH, HEIGHT)
        rasterizer.render(arrays, views)
        pictures.append(rasterizer.rgb.numpy())
    np.testing.assert_array_equal(*pictures)
    assert [image.reshape(-1, 3).any(axis=0).tolist() for image in pictures[0]] == [
        [True, False, False],
        [False, True, False],
        [False, False, False],
    ]


def test_errors_of_a_thread_reach_the_caller() -> None:
    """Arrays of another size are refused, by whichever thread sees them; sizes out of range at once."""
    threaded = ThreadedRasterizer(100, 2, WIDTH, HEIGHT, threads=2)
    with pytest.raises(ConfigError, match=r"splats\.means"):
        threaded.render(
            SplatArrays.from_splats([ball(99)], device="cpu"), views_of(EYES[:2], WIDTH, HEIGHT, "cpu")
        )  # fmt: skip
    with pytest.raises(ConfigError, match=r"views\.world_to_camera"):
        threaded.render(SplatArrays.from_splats([ball(100)], device="cpu"), views_of(EYES, WIDTH, HEIGHT, "cpu"))
    four = ThreadedRasterizer(100, 4, WIDTH, HEIGHT, threads=2)
    views = views_of([EYES[0]] * 4, WIDTH, HEIGHT, "cpu")
    three = replace(views, background=wp.zeros(3, dtype=wp.vec3, device="cpu"))
    with pytest.raises(ConfigError, match=r"views\.background"):
        four.render(SplatArrays.from_splats([ball(100)], device="cpu"), three)
    with pytest.raises(ConfigError, match="threads must be at least 1, got 0"):
        ThreadedRasterizer(100, 2, WIDTH, HEIGHT, threads=0)
    with pytest.raises(ConfigError, match="view_count must be at least 1, got 0"):
        ThreadedRasterizer(100, 0, WIDTH, HEIGHT)
