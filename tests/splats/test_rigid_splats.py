"""Splats that bodies carry: they move with the body, colours included, in every world."""

from __future__ import annotations

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp
from newton import ShapeFlags

from softmode.errors import ConfigError
from softmode.splats import Splats, make_plush
from softmode.splats.cameras.camera import SplatCamera
from softmode.splats.cameras.camera_randomization import CameraRandomization
from softmode.splats.cameras.rigid_splats import RigidSplats, RigidSplatsSkin
from softmode.splats.raster.rasterizer import SplatArrays
from softmode.splats.splats import rotations_from_quats
from tests.splats.camera_scene import PLAIN, camera, scene

QUAT = (0.5, -0.1, 0.3, float(np.sqrt(1.0 - 0.35)))


def shiny(count: int = 300, seed: int = 3) -> Splats:
    """Return a ball of splats whose colours depend on the direction of view, degree 2."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=0.04 * rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.004, 0.012, size=(count, 3)),
        opacities=rng.uniform(0.3, 1.0, size=count),
        sh=0.5 * rng.normal(size=(count, 9, 3)),
    )


def place(model, state, name: str, poses: list[wp.transform]) -> None:
    """Move a body in every world."""
    values = state.body_q.numpy()
    for body, pose in zip([i for i, label in enumerate(model.body_label) if label == name], poses, strict=True):
        values[body] = [*pose.p, *pose.q]
    state.body_q.assign(values)


def test_carried_splats_are_those_moved_by_hand() -> None:
    """Means, covariances and colours follow the pose: pictures equal those of `Splats.transformed`, in each world."""
    model, soft, link = scene(2), make_plush(300), shiny()
    part = RigidSplats(splats=link, body="hand", position=(0.01, 0.02, 0.03), quat=QUAT, hide_meshes=True)
    skin = RigidSplatsSkin(model, [part])
    arrays = SplatArrays.from_splats([soft, *skin.objects], world_count=2, device="cpu")
    sensor = SplatCamera(model, arrays, [camera(width=48, height=48)], options=PLAIN)
    state = model.state()
    turns = [wp.normalize(wp.quat(0.1, 0.7, -0.3, 0.4)), wp.normalize(wp.quat(-0.6, 0.2, 0.5, 0.3))]
    poses = [wp.transform(wp.vec3(0.1 * i, 0.05, 0.15), turn) for i, turn in enumerate(turns)]
    skin.launch(state, arrays)
    sensor.render(state)
    with wp.ScopedCapture(device="cpu") as capture:
        skin.launch(state, arrays)
        sensor.render(state)
    place(model, state, "hand", poses)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(arrays.means.numpy()[:, : soft.count], np.stack([soft.means] * 2))
    for world, pose in enumerate(poses):
        by_hand = link.transformed(rotations_from_quats([QUAT])[0], translation=part.position)
        by_hand = by_hand.transformed(rotations_from_quats([list(pose.q)])[0], translation=tuple(pose.p))
        alone = scene()
        hidden = RigidSplatsSkin(alone, [part])
        assert hidden.count == link.count
        expected = SplatCamera(
            alone,
            SplatArrays.from_splats([soft, by_hand], device="cpu"),
            [camera(width=48, height=48)],
            options=PLAIN,
        )
        expected.render(alone.state())
        assert expected.alpha is not None and sensor.alpha is not None
        np.testing.assert_allclose(sensor.alpha.numpy()[world], expected.alpha.numpy()[0], atol=2e-4)
        difference = np.abs(sensor.rgb.numpy()[world].astype(int) - expected.rgb.numpy()[0])
        assert difference.max() <= 2
    assert (sensor.rgb.numpy()[0] != sensor.rgb.numpy()[1]).any(axis=-1).sum() > 100


@pytest.mark.gpu
def test_a_drawn_frame_is_the_same_on_cuda() -> None:
    """Views drawn, lenses per world, carried splats and segmentation, replayed: CUDA and CPU agree but for rounding."""
    pictures = []
    options = dataclasses.replace(PLAIN, segmentation=True)
    drawn = CameraRandomization(rotation=0.05, translation=0.02, focal=0.1, sky=0.2, light=0.3, splat_opacity=0.3)
    for device in ("cpu", "cuda:0"):
        model = scene(3, device)
        skin = RigidSplatsSkin(model, [RigidSplats(splats=shiny(), body="box", hide_meshes=True)])
        arrays = SplatArrays.from_splats(skin.objects, world_count=3, device=device)
        sensor = SplatCamera(model, arrays, [camera(), camera("b", fov_y=0.5)], options=options, randomization=drawn)
        state = model.state()

        def frame(sensor=sensor, skin=skin, state=state, arrays=arrays) -> None:
            sensor.randomize()
            skin.launch(state, arrays)
            sensor.render(state)

        frame()
        with wp.ScopedCapture(device=device) as capture:
            frame()
        sensor.seed(5)
        wp.capture_launch(capture.graph)
        pictures.append([sensor.images("b", output).numpy() for output in ("rgb", "depth", "segmentation")])
        np.testing.assert_allclose(sensor.variation.offset.numpy()[:, 6], 1.0, atol=0.01)
    (rgb, depth, seen), (rgb_cuda, depth_cuda, seen_cuda) = pictures
    assert (np.abs(rgb.astype(int) - rgb_cuda) > 2).any(axis=-1).mean() < 0.01
    assert (np.abs(depth - depth_cuda) > 1e-3).mean() < 0.01 and (seen != seen_cuda).mean() < 0.01
    assert set(np.unique(seen)) >= {-1, 0} and len({image.tobytes() for image in rgb}) == 3


def test_world_of_many_equals_the_single_world() -> None:
    """Bitwise."""
    part = RigidSplats(splats=shiny(), body="box")
    states = []
    for worlds in (1, 3):
        model = scene(worlds)
        skin = RigidSplatsSkin(model, [part])
        arrays = SplatArrays.from_splats(skin.objects, world_count=worlds, device="cpu")
        skin.launch(model.state(), arrays)
        states.append([array.numpy() for array in (arrays.means, arrays.covariances, arrays.rotations)])
    for one, many in zip(*states, strict=True):
        for world in range(3):
            np.testing.assert_array_equal(many[world], one[0])


def test_hidden_shapes_are_not_seen_but_collide() -> None:
    """Shapes of the body vanish from pictures in every world, others stay, and only the flag VISIBLE changes."""
    options = dataclasses.replace(PLAIN, segmentation=True)
    before, model = scene(2), scene(2)
    parts = [
        RigidSplats(splats=make_plush(200), body="box", hide_meshes=True),
        RigidSplats(splats=make_plush(200), body="hand"),
    ]
    RigidSplatsSkin(model, parts)
    images = []
    for each in (before, model):
        sensor = SplatCamera(each, None, [camera(target=(0.0, 0.0, 0.25), fov_y=1.2)], options=options)
        sensor.render(each.state())
        images.append(sensor.images("front", "segmentation").numpy())
    (box,), (hand,) = sensor.segmentation_ids("box/*"), sensor.segmentation_ids("hand/*")
    assert (images[0] == box).any(axis=(1, 2)).all() and not (images[1] == box).any()
    np.testing.assert_array_equal(images[0] == hand, images[1] == hand)
    assert (images[1] == hand).any()
    changed = before.shape_flags.numpy() ^ model.shape_flags.numpy()
    visible = int(ShapeFlags.VISIBLE)
    np.testing.assert_array_equal(changed, np.where(model.shape_body.numpy() % 2 == 0, visible, 0) * (
        model.shape_body.numpy() >= 0
    ))  # fmt: skip


def test_all_shapes_hidden_leaves_sky_and_splats() -> None:
    """A model without a visible shape still draws."""
    world = newton.ModelBuilder()
    body = world.add_body(label="ball")
    world.add_shape_sphere(body, radius=0.1)
    model = world.finalize(device="cpu")
    skin = RigidSplatsSkin(model, [RigidSplats(splats=make_plush(300), body="ball", hide_meshes=True)])
    arrays = SplatArrays.from_splats(skin.objects, world_count=1, device="cpu")
    sensor = SplatCamera(model, arrays, [camera()], options=PLAIN)
    skin.launch(model.state(), arrays)
    sensor.render(model.state())
    assert sensor.alpha is not None and sensor.alpha.numpy().max() > 0.9 and (sensor.depth.numpy() == 0.0).any()


def test_refuses_what_does_not_fit() -> None:
    """Messages say which body or which arrays."""
    model, part = scene(2), RigidSplats(splats=make_plush(200), body="hand")
    with pytest.raises(ConfigError, match="parts is empty"):
        RigidSplatsSkin(model, [])
    with pytest.raises(ConfigError, match="parts is empty or no list"):
        RigidSplatsSkin(model, part)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="quat"):
        dataclasses.replace(part, quat=(0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match=r"RigidSplats: 0 bodies are called 'foot'.*box, hand"):
        RigidSplatsSkin(model, [dataclasses.replace(part, body="foot")])
    skin = RigidSplatsSkin(model, [part])
    fitting = SplatArrays.from_splats(skin.objects, world_count=2, device="cpu")
    shared = wp.zeros((1, 200), dtype=wp.quat, device="cpu")
    for arrays in (
        dataclasses.replace(fitting, rotations=shared),
        dataclasses.replace(fitting, covariances=fitting.covariances[:1]),
        SplatArrays.from_splats(skin.objects, world_count=1, device="cpu"),
        SplatArrays.from_splats([make_plush(200).subset(range(50))], world_count=2, device="cpu"),
    ):
        with pytest.raises(ConfigError, match="column"):
            skin.launch(model.state(), arrays)
