"""The camera: geometry, compositing with the meshes of a Newton model, worlds, mounts and capture."""

from __future__ import annotations

import math

import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.splats import Splats, make_plush
from softmode.splats.camera import CameraOptions, PinholeCamera, SplatCamera
from softmode.splats.rasterizer import RasterizerOptions, SplatArrays
from softmode.splats.shadow import ShadowOptions
from softmode.splats.splats import SH_DC, rotations_from_quats

SIZE = 64
PLAIN = CameraOptions(shadows=False, splat_shadow=None)


def scene(worlds: int = 1) -> newton.Model:
    """Return a table with its top at z = 0, a red box standing on it, and a hand above, in each world."""
    world = newton.ModelBuilder()
    pose = wp.transform
    world.add_shape_box(-1, xform=pose(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity()), hx=0.5, hy=0.5, hz=0.05)
    box = world.add_body(xform=pose(wp.vec3(0.1, 0.1, 0.05), wp.quat_identity()), label="box")
    world.add_shape_box(box, hx=0.03, hy=0.03, hz=0.05, color=(0.9, 0.1, 0.1))
    hand = world.add_body(xform=pose(wp.vec3(0.0, 0.0, 0.4), wp.quat_identity()), label="hand")
    world.add_shape_box(hand, xform=pose(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity()), hx=0.02, hy=0.02, hz=0.02)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder.finalize(device="cpu")


def camera(name: str = "front", **kwargs) -> PinholeCamera:
    """Return a camera that looks along -x over the table."""
    arguments = {"position": (0.6, 0.0, 0.3), "target": (0.0, 0.0, 0.05), "width": SIZE, "height": SIZE} | kwargs
    return PinholeCamera.look_at(name, **arguments)


def marker(position: tuple[float, float, float], sigma: float = 0.01) -> Splats:
    """Return one opaque green dot."""
    color = (np.array([0.1, 0.9, 0.1]) - 0.5) / SH_DC
    return Splats(
        means=[position], quats=[[0, 0, 0, 1]], scales=[[sigma] * 3], opacities=[1.0], sh=color[None, None]
    )  # fmt: skip


def arrays(splats: Splats, worlds: int = 1) -> SplatArrays:
    """Upload the splats."""
    return SplatArrays.from_splats([splats], world_count=worlds, device="cpu")


def is_green(rgb: np.ndarray) -> np.ndarray:
    """Return where the picture is green."""
    c = rgb.astype(int)
    return (c[..., 1] > c[..., 0] + 60) & (c[..., 1] > c[..., 2] + 60)


def test_look_at_is_an_opencv_frame() -> None:
    """Columns of the rotation are right, down and forward; the target lies in the middle, z up in the picture."""
    view = camera(position=(1.0, 2.0, 3.0), target=(0.2, -0.3, 0.1), fov_y=0.7, height=100, width=160)
    r = rotations_from_quats([view.quat])[0]
    forward = np.subtract((0.2, -0.3, 0.1), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(r[:, 2], forward / np.linalg.norm(forward), atol=1e-12)
    assert r[2, 1] < 0.0 and abs(r[2, 0]) < 1e-12 and np.linalg.det(r) == pytest.approx(1.0)
    assert view.fy * math.tan(0.35) == pytest.approx(50.0) and (view.cx, view.cy) == (80.0, 50.0)


def test_splats_and_meshes_land_on_the_same_pixel_and_depth() -> None:
    """A splat at a corner of the red box appears there, at the depth of the pinhole, off-centre axis included."""
    base = camera()
    view = PinholeCamera(**{**base.__dict__, "cx": 25.5, "cy": 40.25, "fx": 70.0, "fy": 60.0})
    corner = np.array([0.13, 0.13, 0.1])
    sensor = SplatCamera(scene(), arrays(marker((0.132, 0.132, 0.102), 0.02)), [view], options=PLAIN)
    sensor.render(sensor.model.state())
    r = rotations_from_quats([view.quat])[0]
    p = r.T @ (corner - np.array(view.position))
    pixel = np.array([view.fx * p[0] / p[2] + view.cx, view.fy * p[1] / p[2] + view.cy])
    rgb = sensor.images("front").numpy()[0]
    rows, columns = np.nonzero(is_green(rgb))
    assert len(rows) and np.hypot(columns.mean() + 0.5 - pixel[0], rows.mean() + 0.5 - pixel[1]) < 1.0
    assert sensor.depth.numpy()[0, int(pixel[1]), int(pixel[0])] == pytest.approx(p[2], abs=0.02)
    red = (rgb[..., 0] > 100) & (rgb[..., 1] < 80)
    rows, columns = np.nonzero(red)
    assert columns.max() + 1 == pytest.approx(pixel[0], abs=2.0), "the box ends at its corner"


def test_meshes_hide_splats_and_splats_hide_meshes() -> None:
    """A dot behind the box is invisible, the same dot in front of it is drawn over it; empty sky has depth 0."""
    seen = {}
    for name, x in (("behind", 0.0), ("front", 0.25)):
        sensor = SplatCamera(scene(), arrays(marker((x, 0.1, 0.04), 0.006)), [camera()], options=PLAIN)
        sensor.render(sensor.model.state())
        seen[name] = int(is_green(sensor.rgb.numpy()[0]).sum())
        depth = sensor.depth.numpy()[0]
        assert depth[0, 0] == 0.0 and depth[-1, SIZE // 2] > 0.1
    assert seen["behind"] == 0 and seen["front"] >= 3


def test_world_of_many_equals_the_single_world() -> None:
    """Every world sees its own splats; images are bitwise those of a model with that world alone."""
    plush = make_plush(600)
    moved = [plush.transformed(translation=(0.02 * i, -0.03 * i, 0.0)) for i in range(3)]
    views = [camera(), camera("side", position=(0.1, -0.6, 0.2))]
    many = SplatCamera(scene(3), arrays(plush, 3), views)
    many.splats.means.assign(np.stack([splats.means for splats in moved]))  # type: ignore[union-attr]
    many.render(many.model.state())
    assert many.images("side").shape == (3, SIZE, SIZE, 3)
    for world, splats in enumerate(moved):
        alone = SplatCamera(scene(), arrays(splats), views)
        # The shadow map is sized by the splats at rest; theirs have the same extent.
        alone.render(alone.model.state())
        for view in ("front", "side"):
            np.testing.assert_array_equal(many.images(view).numpy()[world], alone.images(view).numpy()[0])


def test_captured_graph_equals_eager() -> None:
    """A replayed frame follows bodies and splats, bitwise like an eager one."""
    down = camera("hand", body="hand", position=(0.0, 0.0, 0.0), target=(0.0, 0.0, -1.0), up=(1.0, 0.0, 0.0))
    sensor = SplatCamera(scene(), arrays(make_plush(600)), [camera(), down])
    state = sensor.model.state()
    sensor.render(state)
    before = sensor.rgb.numpy().copy()
    with wp.ScopedCapture(device="cpu") as capture:
        sensor.render(state)
    poses = state.body_q.numpy()
    poses[:, :2] += [0.03, -0.05]
    state.body_q.assign(poses)
    sensor.splats.means.assign(sensor.splats.means.numpy() + np.float32([0.0, 0.04, 0.01]))  # type: ignore[union-attr]
    wp.capture_launch(capture.graph)
    replayed = sensor.rgb.numpy().copy()
    sensor.render(state)
    np.testing.assert_array_equal(replayed, sensor.rgb.numpy())
    assert (replayed != before).any(axis=(1, 2, 3)).all()


def test_mounted_camera_moves_with_its_body() -> None:
    """The view of a carried camera equals that of a fixed one at the same place, in every world's own pose."""
    model = scene(2)
    local = {"position": (0.05, 0.0, 0.0), "target": (0.05, 0.02, -1.0), "up": (1.0, 0.0, 0.0)}
    mounted = SplatCamera(model, None, [camera("eye", body="hand", **local)])
    state = model.state()
    poses = state.body_q.numpy()
    hands = [i for i, label in enumerate(model.body_label) if label.endswith("hand")]
    poses[hands[1], :3] += [0.1, 0.05, -0.1]
    state.body_q.assign(poses)
    mounted.render(state)
    for world, shift in enumerate(([0.0, 0.0, 0.4], [0.1, 0.05, 0.3])):
        place = {k: tuple(float(x) for x in np.add(local[k], shift)) for k in ("position", "target")}
        fixed = SplatCamera(model, None, [camera("eye", up=(1.0, 0.0, 0.0), **place)])
        fixed.render(state)
        difference = np.abs(mounted.rgb.numpy()[world].astype(int) - fixed.rgb.numpy()[world])
        assert (difference > 2).mean() < 0.01


def test_splats_cast_a_shadow_on_the_table_only() -> None:
    """With the shadow on, table pixels beside the plush get darker, none brighter, and sky and splats stay."""
    images, alpha = [], np.zeros(0)
    for shadow in (None, ShadowOptions()):
        options = CameraOptions(shadows=False, splat_shadow=shadow)
        sensor = SplatCamera(scene(), arrays(make_plush(1500)), [camera(target=(0, 0, 0), fov_y=0.3)], options=options)
        sensor.render(sensor.model.state())
        images.append(sensor.rgb.numpy()[0].astype(int).sum(axis=-1))
        alpha = sensor.alpha.numpy()[0]  # type: ignore[union-attr]
    change = images[1] - images[0]
    assert change.max() <= 0 and (change < -60).sum() > 10
    assert np.abs(change[alpha > 0.995]).max() <= 2


def test_smooth_mesh_edges_mix_object_and_sky() -> None:
    """With four rays per pixel, edges hold colours between those on either side."""
    pictures = []
    for samples in (1, 4):
        options = CameraOptions(shadows=False, mesh_samples=samples, sky=((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
        sensor = SplatCamera(scene(), None, [camera(position=(0.9, 0.0, 0.02), target=(0, 0.03, 0.1))], options=options)
        sensor.render(sensor.model.state())
        pictures.append(sensor.rgb.numpy()[0])
    levels = [len(np.unique(picture.reshape(-1, 3), axis=0)) for picture in pictures]
    assert levels[1] > levels[0] + 5
    same = (np.abs(pictures[0].astype(int) - pictures[1]) <= 3).all(axis=-1)
    assert same.mean() > 0.9


def test_object_ids_and_missing_splats() -> None:
    """Object ids are handed through; without splats the camera has neither alpha nor ids."""
    sensor = SplatCamera(
        scene(), arrays(make_plush(600)), [camera()], rasterizer_options=RasterizerOptions(object_ids=True)
    )  # fmt: skip
    sensor.render(sensor.model.state())
    assert sensor.object_id is not None and set(np.unique(sensor.object_id.numpy())) == {-1, 0}
    bare = SplatCamera(scene(), None, [camera()])
    assert bare.alpha is None and bare.object_id is None


def test_refuses_bad_descriptions() -> None:
    """Each message names the camera and what is wrong."""
    model, splats = scene(), arrays(make_plush(300))
    with pytest.raises(ConfigError, match="do not define a view"):
        camera(position=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="fov_y"):
        camera(fov_y=4.0)
    with pytest.raises(ConfigError, match="'front': 0 x 64"):
        camera(width=0)
    with pytest.raises(ConfigError, match="unit length"):
        PinholeCamera(**{**camera().__dict__, "quat": (0.0, 0.0, 0.0, 2.0)})
    with pytest.raises(ConfigError, match="finite"):
        PinholeCamera(**{**camera().__dict__, "fx": float("nan")})
    with pytest.raises(ConfigError, match="sizes"):
        SplatCamera(model, splats, [camera(), camera("b", width=32)])
    with pytest.raises(ConfigError, match="unique names"):
        SplatCamera(model, splats, [camera(), camera()])
    with pytest.raises(ConfigError, match="sizes"):
        SplatCamera(model, splats, [])
    with pytest.raises(ConfigError, match=r"0 bodies are called 'wrist'.*hand"):
        SplatCamera(model, splats, [camera(body="wrist")])
    with pytest.raises(ConfigError, match="mesh_samples"):
        SplatCamera(model, splats, [camera()], options=CameraOptions(mesh_samples=3))
    with pytest.raises(ConfigError, match="no camera 'top'"):
        SplatCamera(model, splats, [camera()]).images("top")
