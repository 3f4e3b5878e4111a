"""Randomised views: ranges, keys of the draws, masks, capture, and pictures that follow them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.splats import make_plush
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.cameras.camera_randomization import CameraRandomization, ViewVariation
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import SplatRasterizer, ViewArrays
from tests.splats.camera_scene import PLAIN, arrays, camera, scene

SKY = ((0.5, 0.5, 0.5), (0.4, 0.5, 0.6))
LENSES = [(80.0, 80.0, 32.0, 32.0), (50.0, 60.0, 30.0, 35.0)]
WIDE = CameraRandomization(
    rotation=0.1,
    translation=0.02,
    focal=0.1,
    principal_point=2.0,
    sky=0.2,
    light=0.3,
    light_tint=0.1,
    splat_opacity=0.4,
    splat_brightness=0.2,
    splat_tint=0.1,
)
FIELDS = ("offset", "intrinsics", "horizon", "zenith", "light_gain", "splat_gain")


def values(variation: ViewVariation) -> dict[str, np.ndarray]:
    """Copy what was drawn."""
    return {name: getattr(variation, name).numpy().copy() for name in FIELDS}


def make(worlds: int, randomization: CameraRandomization = WIDE) -> ViewVariation:
    """Return the variation of two cameras."""
    return ViewVariation(LENSES, SKY, worlds, randomization, device="cpu")


def test_draws_are_uniform_in_their_ranges() -> None:
    """Mean and variance w^2/3 of each draw within five standard errors, extremes within and near the half width w."""
    worlds = 3000
    variation = make(worlds)
    variation.draw()
    v = values(variation)
    turn = v["offset"][:, 3:6]
    angle = 2.0 * np.arcsin(np.linalg.norm(turn, axis=1, keepdims=True))
    lens = v["intrinsics"] / np.repeat(np.float32(LENSES), worlds, axis=0)
    shift = (v["intrinsics"] - np.repeat(np.float32(LENSES), worlds, axis=0))[:, 2:]
    np.testing.assert_allclose(lens[:, 0], lens[:, 1], rtol=1e-6)
    for what, drawn, width in (
        ("rotation", turn / np.sin(0.5 * angle) * angle, WIDE.rotation),
        ("translation", v["offset"][:, :3], WIDE.translation),
        ("focal", lens[:, :1] - 1.0, WIDE.focal),
        ("principal point", shift, WIDE.principal_point),
        ("sky", v["horizon"] - 0.5, WIDE.sky),
        ("sky", v["zenith"] - np.float32(SKY[1]), WIDE.sky),
        ("opacity", v["splat_gain"][:worlds, 3:] - 1.0, WIDE.splat_opacity),
    ):
        n = len(drawn)
        assert np.abs(drawn).max() <= width * (1.0 + 1e-5) and np.abs(drawn).max() > 0.99 * width, what
        assert (np.abs(drawn.mean(axis=0)) < 5.0 * width / np.sqrt(3.0 * n)).all(), what
        # The variance of (x/w)^2 is 4/45.
        assert (np.abs(np.mean((drawn / width) ** 2, axis=0) - 1.0 / 3.0) < 5.0 * np.sqrt(4.0 / 45.0 / n)).all(), what
        assert np.abs(np.corrcoef(drawn.T) - np.eye(drawn.shape[1])).max() < 5.0 / np.sqrt(n), what
    light = v["light_gain"] ** 2.2
    assert light.min() > 0.7 * 0.9 - 1e-4 and light.max() < 1.3 * 1.1 + 1e-4 and light.std() > 0.1
    for first in ("horizon", "light_gain"):
        assert np.abs(np.corrcoef(v["zenith"].T, v[first].T)[:3, 3:]).max() < 5.0 / np.sqrt(worlds)


def test_nothing_to_draw_keeps_the_description() -> None:
    """Half widths of zero change no bit."""
    variation = make(3, CameraRandomization())
    before = values(variation)
    variation.draw()
    for name, array in values(variation).items():
        np.testing.assert_array_equal(array, before[name])


def test_a_draw_depends_on_seed_count_and_camera_alone() -> None:
    """World i of many reads what a single world with its seed reads; a mask holds the others; seeding starts again."""
    many = make(4)
    many.seed([7, 5, 5, 2**31 - 1])
    many.draw()
    first = values(many)
    many.draw(wp.array([True, False, True, False], dtype=wp.bool, device="cpu"))
    second = values(many)
    for name in FIELDS:
        kept = second[name].reshape(-1, 4, second[name].shape[-1]) == first[name].reshape(-1, 4, first[name].shape[-1])
        assert kept[:, [1, 3]].all() and not kept[:, [0, 2]].all(axis=-1).any(), name
    for world, seed in enumerate((7, 5, 5, 2**31 - 1)):
        alone = make(1)
        alone.seed(np.array([seed]))
        alone.draw()
        for name, array in values(alone).items():
            np.testing.assert_array_equal(array, first[name].reshape(-1, 4, array.shape[-1])[:, world], err_msg=name)
    many.seed([7, 5, 5, 2**31 - 1])
    many.draw()
    np.testing.assert_array_equal(many.offset.numpy(), first["offset"])
    base = make(4)
    base.seed(7)
    base.draw()
    np.testing.assert_array_equal(base.horizon.numpy()[0], first["horizon"][0])
    assert not (base.horizon.numpy()[1] == first["horizon"][1]).any()


def test_masked_draws_replay_in_a_captured_graph() -> None:
    """Every replay draws anew where the mask says so, and draws what eager calls would."""
    eager, replayed = make(3), make(3)
    mask = wp.array([True, True, False], dtype=wp.bool, device="cpu")
    with wp.ScopedCapture(device="cpu") as capture:
        replayed.draw(mask)
    replayed.seed(11)
    eager.seed(11)
    for chosen in ([True, False, True], [False, False, False], [True, True, False]):
        mask.assign(np.array(chosen))
        wp.capture_launch(capture.graph)
        eager.draw(wp.array(chosen, dtype=wp.bool, device="cpu"))
        for name, array in values(eager).items():
            np.testing.assert_array_equal(array, getattr(replayed, name).numpy(), err_msg=name)


def test_pictures_follow_the_draws_in_every_world() -> None:
    """A world with drawn pose and lens shows what a camera described there shows: meshes, splats and depth."""
    model, plush = scene(3), make_plush(600)
    drawn = CameraRandomization(rotation=0.08, translation=0.03, focal=0.15, principal_point=4.0)
    many = SplatCamera(model, arrays(plush, 3), [camera()], options=PLAIN, randomization=drawn)
    many.randomize()
    many.render(model.state())
    assert len({many.images("front").numpy()[world].tobytes() for world in range(3)}) == 3
    for world in range(3):
        pose = wp.transform(*many.poses("front").numpy()[world]) * wp.transform(*many.variation.offset.numpy()[world])
        fx, fy, cx, cy = many.intrinsics("front").numpy()[world].tolist()
        k = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        here = PinholeCamera.from_matrix("front", k, width=64, height=64, position=pose.p, quat=pose.q)
        alone = SplatCamera(scene(), arrays(plush), [here], options=PLAIN)
        alone.render(alone.model.state())
        np.testing.assert_allclose(many.variation.intrinsics.numpy()[world], (fx, fy, cx, cy))
        depth, expected = many.depth.numpy()[world], alone.depth.numpy()[0]
        assert (np.abs(depth - expected) > 1e-4).mean() < 0.005, "but for single pixels on edges"
        rgb = np.abs(many.rgb.numpy()[world].astype(int) - alone.rgb.numpy()[0])
        assert (rgb > 1).any(axis=-1).mean() < 0.005


def test_smooth_edges_follow_a_lens_per_world() -> None:
    """With four samples per pixel, a written lens gives the picture of the camera that is described with it."""
    options = CameraOptions(shadows=False, mesh_samples=4)
    described = camera(fov_y=0.5)
    sensor = SplatCamera(scene(2), None, [camera(fov_y=0.9)], options=options)
    lens = (described.fx, described.fy, described.cx, described.cy)
    sensor.intrinsics("front").assign([lens, sensor.intrinsics("front").numpy()[1]])
    expected = SplatCamera(scene(), None, [described], options=options)
    for one in (sensor, expected):
        one.render(one.model.state())
    np.testing.assert_array_equal(sensor.rgb.numpy()[0], expected.rgb.numpy()[0])
    assert (sensor.rgb.numpy()[1] != sensor.rgb.numpy()[0]).mean() > 0.1


def test_sky_and_light_belong_to_the_world() -> None:
    """Cameras of one world, of two sizes, share sky and light; worlds differ; light scales the linear colour."""
    drawn = CameraRandomization(sky=0.2, light=0.5, light_tint=0.1)
    model = scene(2)
    sensors = [
        SplatCamera(model, None, [camera(width=w, height=w)], options=PLAIN, randomization=drawn) for w in (48, 64)
    ]
    plain = SplatCamera(model, None, [camera(width=48, height=48)], options=PLAIN)
    plain.render(model.state())
    for sensor in sensors:
        sensor.seed(3)
        sensor.randomize()
        sensor.render(model.state())
    small, large = (sensor.variation for sensor in sensors)
    for name in ("horizon", "zenith", "light_gain"):
        np.testing.assert_array_equal(getattr(small, name).numpy(), getattr(large, name).numpy())
        assert (getattr(small, name).numpy()[0] != getattr(small, name).numpy()[1]).any()
    table = plain.depth.numpy() > 0.0
    gain = np.broadcast_to(small.light_gain.numpy()[:, None, None], (*table.shape, 3))
    expected = 255.0 * np.clip(plain.mesh_rgb.numpy() * gain, 0.0, 1.0)
    np.testing.assert_allclose(sensors[0].rgb.numpy()[table], expected[table], atol=0.51, err_msg="but for rounding")
    assert (sensors[0].rgb.numpy()[~table] != plain.rgb.numpy()[~table]).any()


def test_gain_scales_colour_and_opacity_of_splats() -> None:
    """A view's gain draws the picture of splats whose opacities and colours were scaled, opacities up to one."""
    plush = make_plush(400)
    worlds = arrays(plush, 2)
    gain = np.array([[1.2, 0.5, 1.0, 0.5], [1.0, 1.0, 0.25, 1.5]], dtype=np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 0.5
    views = ViewArrays(
        world_to_camera=wp.array(np.stack([pose, pose]), dtype=wp.mat44, device="cpu"),
        intrinsics=wp.array([(60.0, 60.0, 24.0, 24.0)] * 2, dtype=wp.vec4, device="cpu"),
        world=wp.array([0, 1], dtype=int, device="cpu"),
        background=wp.zeros(1, dtype=wp.vec3, device="cpu"),
        splat_gain=wp.array(gain, dtype=wp.vec4, device="cpu"),
    )
    gained, scaled = (SplatRasterizer(plush.count, 2, 48, 48, device="cpu") for _ in range(2))
    gained.render(worlds, views)
    opacity = np.minimum(gain[:, 3:] * plush.opacities, 1.0)
    same = dataclasses.replace(worlds, opacities=wp.array(opacity, dtype=float, device="cpu"))
    scaled.render(same, dataclasses.replace(views, splat_gain=None))
    np.testing.assert_array_equal(gained.alpha.numpy(), scaled.alpha.numpy())
    np.testing.assert_allclose(gained.rgb.numpy(), scaled.rgb.numpy() * gain[:, None, None, :3], atol=1e-6)
    assert gained.alpha.numpy().max() > 0.5


def test_refuses_bad_ranges_and_seeds() -> None:
    """Messages name the field or what was given."""
    for name, value in (("rotation", -0.1), ("focal", 1.0), ("sky", float("nan")), ("translation", float("inf"))):
        with pytest.raises(ConfigError, match=name):
            CameraRandomization(**{name: value})
    for seeds in (1.5, [1, 2], np.zeros(3)):
        with pytest.raises(ConfigError, match="seeds"):
            make(3).seed(seeds)
    for mask in (np.ones(3, bool), wp.ones(2, dtype=wp.bool, device="cpu"), wp.ones(3, dtype=wp.int32, device="cpu")):
        with pytest.raises(ConfigError, match="world_mask"):
            make(3).draw(mask)  # type: ignore[arg-type]
