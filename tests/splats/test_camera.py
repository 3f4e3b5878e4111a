"""The camera: geometry, compositing with the meshes of a Newton model, worlds, mounts and capture."""

from __future__ import annotations

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.splats import make_plush
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.cameras.shadow import ShadowOptions
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.splats import rotations_from_quats
from tests.splats.camera_scene import PLAIN, SIZE, arrays, camera, marker, scene


def is_green(rgb: np.ndarray) -> np.ndarray:
    """Return where the picture is green."""
    c = rgb.astype(int)
    return (c[..., 1] > c[..., 0] + 60) & (c[..., 1] > c[..., 2] + 60)


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


def test_splats_and_meshes_cast_the_same_shadow() -> None:
    """Under a plush the table is as dark as under a slab, and no darker where both keep the sun off."""
    pictures = {}
    for slab in (False, True):
        builder = newton.ModelBuilder()
        builder.add_shape_plane(width=2.0, length=2.0, color=(0.7, 0.6, 0.5))
        if slab:
            builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, 0.5), wp.quat_identity()), hx=0.3, hy=0.3, hz=0.01)
        model = builder.finalize(device="cpu")
        for plush in (False, True):
            # Lifted off the ground, between the ground and the slab, and seen from below the slab.
            toy = arrays(make_plush(1500).transformed(translation=(0.0, 0.0, 0.15)))
            shadow = ShadowOptions() if plush else None
            options = CameraOptions(light_direction=(0.0, 0.0, -1.0), splat_shadow=shadow)
            view = camera(position=(0.5, 0.0, 0.1), target=(0.0, 0.0, 0.0), fov_y=0.25)
            sensor = SplatCamera(model, toy, [view], options=options)
            sensor.render(model.state())
            pictures[slab, plush] = sensor.rgb.numpy()[0].astype(int)
            alpha = sensor.alpha.numpy()[0]  # type: ignore[union-attr]
    ground = alpha == 0.0
    lit, under_slab = pictures[False, False][ground], pictures[True, False][ground]
    assert np.median(lit - under_slab) > 20
    np.testing.assert_allclose(pictures[True, True][ground], under_slab, atol=2)
    under_plush = pictures[False, True][ground]
    deepest = (lit - under_plush).sum(axis=1) > 0.95 * np.median((lit - under_slab).sum(axis=1))
    assert deepest.sum() > 10
    assert (under_plush >= under_slab - 3).all(), "never darker than the shadow of a mesh"


def test_a_composited_frame_is_drawn_and_differentiated_from_its_parts() -> None:
    """What the camera shows of meshes and views is all that the rasteriser and its adjoint need."""
    eye = camera()
    sensor = SplatCamera(scene(), arrays(make_plush(600)), [eye], options=CameraOptions(splat_shadow=None))
    sensor.render(sensor.model.state())
    assert sensor.rasterizer is not None and sensor.splats is not None
    again = SplatRasterizer(600, 1, eye.width, eye.height, device="cpu")
    meshes = {"mesh_rgb": sensor.mesh_rgb, "mesh_depth": sensor.mesh_depth}
    again.render(sensor.splats, ViewArrays.from_cameras([eye], device="cpu"), **meshes)
    np.testing.assert_allclose(again.rgb.numpy(), sensor.rasterizer.rgb.numpy(), atol=1e-4)
    adjoint = AdjointRasterizer(sensor.rasterizer, sensor.splats, sensor.views)
    ones = wp.ones(sensor.rasterizer.rgb.shape, dtype=wp.vec3, device="cpu")
    found = adjoint.backward(sensor.splats, sensor.views, loss_rgb=ones, **meshes)
    assert np.linalg.norm(found.twist.numpy()) > 0.0
    with pytest.raises(ConfigError, match="on bodies"):
        ViewArrays.from_cameras([camera(body="hand")])


def test_smooth_mesh_edges_mix_object_and_sky() -> None:
    """With four samples per pixel, edges hold colours between those on either side."""
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
    sensor = SplatCamera(model, splats, [camera()])
    with pytest.raises(ConfigError, match="no camera 'top'"):
        sensor.images("top")
    for output in ("segmentation", "object_id", "median_depth", "sepia"):
        with pytest.raises(ConfigError, match=f"does not write '{output}'.*Turn it on"):
            sensor.images("front", output)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="of 3 worlds, the model has 2"):
        SplatCamera(scene(2), SplatArrays.from_splats([make_plush(300)], world_count=3, device="cpu"), [camera()])
    point = wp.zeros(1, dtype=wp.vec3, device="cpu")
    for wrong in ((0.0, 0.0, 1.0), np.zeros((1, 3)), wp.zeros(5, dtype=wp.vec3, device="cpu")):
        with pytest.raises(ConfigError, match=r"target must be .* shape \(1,\)") as caught:
            sensor.look_at("front", point, wrong)  # type: ignore[arg-type]
        assert "poses" in caught.value.hint
    with pytest.raises(ConfigError, match="cells"):
        ShadowOptions(cells=0)


def test_free_camera_moves_in_each_world() -> None:
    """Poses written on the device place the camera per world as descriptions do, inside a captured graph too."""
    model = scene(2)
    free = SplatCamera(model, None, [camera(), camera("free")], options=PLAIN)
    state = model.state()
    places = np.float32([[0.4, 0.3, 0.3], [-0.3, 0.4, 0.5]])
    target = wp.array([(0.1, 0.1, 0.05)], dtype=wp.vec3, device="cpu")
    position = wp.zeros(2, dtype=wp.vec3, device="cpu")
    free.look_at("free", position, target)
    free.render(state)
    with wp.ScopedCapture(device="cpu") as capture:
        free.look_at("free", position, target)
        free.render(state)
    position.assign(places)
    wp.capture_launch(capture.graph)
    assert free.images("free").shape == (2, SIZE, SIZE, 3) and free.images("free", "depth").shape == (2, SIZE, SIZE)
    for world, place in enumerate(places.tolist()):
        fixed = camera("free", position=tuple(place), target=(0.1, 0.1, 0.05))
        np.testing.assert_allclose(free.poses("free").numpy()[world], (*fixed.position, *fixed.quat), atol=2e-6)
        alone = SplatCamera(scene(), None, [fixed], options=PLAIN)
        alone.render(alone.model.state())
        difference = np.abs(free.images("free", "depth").numpy()[world] - alone.depth.numpy()[0])
        assert (difference > 1e-5).mean() < 0.005, "but for a pixel on an edge"
    held = free.poses("free").numpy()
    free.look_at("free", position, target, up=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(free.poses("free").numpy(), held)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (100, 75), (128, 96), (320, 200), (640, 480)])
def test_every_pixel_has_the_depth_of_the_pinhole(width: int, height: int) -> None:
    """A tilted camera sees the table at z = 0 in forward depth -c_z / r_z, r the ray (x, y, 1) of the pixel centre."""
    base = camera(position=(0.3, -0.1, 0.35), target=(0.0, -0.2, 0.0), width=width, height=height, fov_y=0.6)
    view = dataclasses.replace(base, fx=1.1 * base.fx, cx=0.45 * width, cy=0.56 * height)
    for described in (view, dataclasses.replace(base, position=view.position)):
        sensor = SplatCamera(scene(), None, [described], options=dataclasses.replace(PLAIN, segmentation=True))
        sensor.intrinsics("front").assign([(view.fx, view.fy, view.cx, view.cy)])
        sensor.render(sensor.model.state())
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1)
        falls = rays @ rotations_from_quats([view.quat])[0][2]
        table = sensor.images("front", "segmentation").numpy()[0] == sensor.segmentation_ids("world/shape_0")[0]
        inside = table & (sensor.depth.numpy()[0] > 0.0)
        assert inside.mean() > 0.5
        hit = np.array(view.position) + (-view.position[2] / falls)[..., None] * (
            rays @ rotations_from_quats([view.quat])[0].T
        )
        on_top = inside & (np.abs(hit[..., :2]) < 0.499).all(axis=-1)
        assert on_top.sum() > 0.9 * inside.sum()
        np.testing.assert_allclose(sensor.depth.numpy()[0][on_top], -view.position[2] / falls[on_top], rtol=1e-5)
