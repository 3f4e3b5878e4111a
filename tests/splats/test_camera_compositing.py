"""Splats and meshes in one picture, against the standard splat formula over the exact depth of the meshes."""

from __future__ import annotations

import dataclasses

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.splats import Splats
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays
from softmode.splats.splats import SH_DC, rotations_from_quats
from tests.splats.camera_scene import PLAIN, camera, scene
from tests.splats.dense_reference import DenseImage, render_dense

BLACK = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
AMBIENT = CameraOptions(
    sky=BLACK, light_color=(0.0, 0.0, 0.0), ambient=((0.25,) * 3, (0.25,) * 3), shadows=False, splat_shadow=None
)
"""Every mesh has one colour: that of its albedo a quarter as bright in linear light."""
TILTED = camera("tilted", position=(0.25, -0.05, 0.3), target=(0.05, 0.03, 0.0), width=72, height=60, fov_y=1.1)


def table(worlds: int) -> newton.Model:
    """Return nothing but a large gray table with its top at z = 0."""
    world = newton.ModelBuilder()
    below = wp.transform(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity())
    world.add_shape_box(-1, xform=below, hx=9.0, hy=9.0, hz=0.05, color=(0.8, 0.8, 0.8))
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder.finalize(device="cpu")


def blob(x: float, y: float, z: float, opacity: float, sigma: tuple[float, float, float] = (0.03,) * 3) -> Splats:
    """Return one red splat."""
    color = (np.array([0.9, 0.2, 0.1]) - 0.5) / SH_DC
    return Splats(means=[[x, y, z]], quats=[[0, 0, 0, 1]], scales=[sigma], opacities=[opacity], sh=color[None, None])


def in_worlds(splats: list[Splats]) -> SplatArrays:
    """Upload one set of splats per world."""
    arrays = SplatArrays.from_splats(splats[:1], world_count=len(splats), device="cpu")
    six = [np.stack([s.covariances()[:, i, j] for i, j in np.argwhere(np.triu(np.ones((3, 3))))], -1) for s in splats]
    arrays.means.assign(np.stack([s.means for s in splats]))
    arrays.covariances.assign(np.stack(six))
    opacities = wp.array(np.stack([s.opacities for s in splats]), dtype=float, device="cpu")
    return dataclasses.replace(arrays, opacities=opacities)


def table_depth(view: PinholeCamera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward depth of the plane z = 0 and the length of the rays to it [m], shape (height, width)."""
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1)
    falls = rays @ rotations_from_quats([view.quat])[0][2]
    depth = np.where(falls < 0.0, -view.position[2] / falls, 0.0)
    return depth, depth * np.linalg.norm(rays, axis=-1)


def expected(view: PinholeCamera, splats: Splats, depth: NDArray[np.float64], gray: float) -> DenseImage:
    """Return the picture of the splats over a table of one gray."""
    matrix = np.eye(4)
    r = rotations_from_quats([view.quat])[0]
    matrix[:3, :3], matrix[:3, 3] = r.T, -r.T @ view.position
    return render_dense(
        splats.means.astype(float),
        splats.covariances(),
        splats.opacities.astype(float),
        splats.sh.astype(float),
        matrix,
        (view.fx, view.fy, view.cx, view.cy),
        view.width,
        view.height,
        mesh_rgb=np.where(depth > 0.0, gray, 0.0)[..., None] * np.ones(3),
        mesh_depth=depth,
    )


def test_splats_over_a_tilted_table_follow_the_formula_in_every_world() -> None:
    """Splats before, behind and through the table: colour, coverage and depth are those of the dense formula.

    C = sum_i T_i alpha_i c_i + T c_mesh and z = sum_i T_i alpha_i z_i + T z_mesh over the splats whose centres have
    less forward depth than the mesh in that pixel. Ray lengths differ by up to a fifth here and would fail.
    """
    worlds = [
        blob(0.10, 0.02, 0.08, 0.45),
        blob(0.10, 0.02, -0.10, 0.9),
        blob(-0.10, 0.05, 0.0, 0.8, (0.04, 0.06, 0.01)),
        blob(0.13, -0.18, 0.004, 0.6, (0.05, 0.03, 0.02)),
    ]
    sensor = SplatCamera(
        table(4),
        in_worlds(worlds),
        [TILTED],
        options=AMBIENT,
        rasterizer_options=RasterizerOptions(median_depth=True),
    )
    sensor.render(sensor.model.state())
    depth, length = table_depth(TILTED)
    assert (depth > 0.0).all() and (length / depth).max() > 1.2
    # Colours are taken and given back as sRGB, by IEC 61966-2-1; a quarter of the light falls on albedo.
    gray = _to_srgb(0.25 * _to_linear(0.8))
    fooled = 0
    for world, splats in enumerate(worlds):
        want = expected(TILTED, splats, depth, gray)
        clear = want.margin > 1e-3
        z = rotations_from_quats([TILTED.quat])[0][:, 2] @ (splats.means[0] - TILTED.position)
        near = np.abs(depth / z - 1.0) < 1e-4
        clear &= ~near
        assert clear.mean() > 0.98
        fooled += int(((length > z) & (depth < z) & (want.alpha == 0.0) & clear).sum())
        got = {name: sensor.images("tilted", name).numpy()[world] for name in ("rgb", "depth", "alpha", "median_depth")}
        np.testing.assert_allclose(got["alpha"][clear], want.alpha[clear], atol=1e-5)
        np.testing.assert_allclose(got["depth"][clear], want.depth[clear], rtol=2e-5)
        np.testing.assert_allclose(got["median_depth"][clear], want.median_depth[clear], rtol=2e-5)
        assert np.abs(got["rgb"][clear] - 255.0 * np.clip(want.rgb[clear], 0.0, 1.0)).max() <= 1.0
    alpha = sensor.images("tilted", "alpha").numpy()
    assert 0.3 < alpha[0].max() < 0.46, "a partially transparent splat is blended over the mesh"
    assert alpha[1].max() == 0.0, "one below the table is hidden"
    assert 100 < (alpha[2] > 0.0).sum() < 2000, "one on the tilted table is cut where the table is nearer"
    assert fooled > 50, "there are pixels where the length of the ray would decide otherwise"


def _to_linear(c: float) -> float:
    return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4


def _to_srgb(c: float) -> float:
    return 12.92 * c if c <= 0.0031308 else 1.055 * c ** (1.0 / 2.4) - 0.055


def test_each_hides_the_other_in_its_own_world() -> None:
    """The same opaque splat is before the box, behind it and away from it in three worlds of one frame."""
    options = dataclasses.replace(PLAIN, segmentation=True)
    places = [(0.25, 0.07, 0.146), (0.0, 0.12, 0.036), (0.05, -0.12, 0.04)]
    worlds = [blob(*place, 1.0, (0.008,) * 3) for place in places]
    sensor = SplatCamera(scene(3), in_worlds(worlds), [camera()], options=options)
    bare = SplatCamera(scene(3), None, [camera()], options=options)
    for one in (sensor, bare):
        one.render(one.model.state())
    seen = sensor.images("front", "segmentation").numpy()
    without = bare.images("front", "segmentation").numpy()
    (dot,), (box,) = sensor.segmentation_ids("splats/0"), sensor.segmentation_ids("box/*")
    (bare_box,) = bare.segmentation_ids("box/*")
    assert [int((image == dot).sum()) > 0 for image in seen] == [True, False, True]
    assert ((seen[0] == dot) & (without[0] == bare_box)).sum() >= 3, "it covers pixels of the box"
    np.testing.assert_array_equal(seen[1] == box, without[1] == bare_box)
    np.testing.assert_array_equal(sensor.rgb.numpy()[1], bare.rgb.numpy()[1])


def test_segmentation_names_what_a_pixel_mostly_shows() -> None:
    """Splat objects, shapes and sky have the same ids in every world; a splat counts where it covers more than half."""
    options = dataclasses.replace(PLAIN, segmentation=True)
    first, second = blob(0.25, 0.0, 0.1, 1.0, (0.02,) * 3), blob(0.2, -0.2, 0.1, 0.4, (0.04,) * 3)
    splats = SplatArrays.from_splats([first, second], world_count=2, device="cpu")
    sensor = SplatCamera(scene(2), splats, [camera(target=(0.0, 0.0, 0.25), fov_y=1.2)], options=options)
    sensor.render(sensor.model.state())
    image = sensor.images("front", "segmentation").numpy()
    np.testing.assert_array_equal(image[0], image[1])
    assert sensor.labels == ("splats/0", "splats/1", "world/shape_0", "box/shape_1", "hand/shape_2")
    assert set(np.unique(image)) == {-1, 0, 2, 3, 4}, "the second splat covers no pixel by half"
    assert sensor.segmentation_ids("hand/*") == (4,) and sensor.segmentation_ids("splats/*") == (0, 1)
    depth, alpha = sensor.depth.numpy(), sensor.images("front", "alpha").numpy()
    np.testing.assert_array_equal(image == 0, (alpha > 0.5))
    assert (depth[image == -1] == 0.0)[alpha[image == -1] == 0.0].all() and (depth[image > 0] > 0.0).all()
    assert (sensor.rgb.numpy()[image == 3][:, 0] > 2 * sensor.rgb.numpy()[image == 3][:, 1]).all(), "the box is red"


def test_shapes_of_all_worlds_and_of_one_are_told_apart() -> None:
    """A global ground keeps one id, and shapes of equal label in a world get ids of their own."""
    world = newton.ModelBuilder()
    body = world.add_body(label="link")
    for x in (0.0, 0.2):
        place = wp.transform(wp.vec3(x, 0.0, 0.05), wp.quat_identity())
        world.add_shape_sphere(body, xform=place, radius=0.05, label="ball")
    builder = newton.ModelBuilder()
    builder.add_ground_plane(label="ball")
    builder.replicate(world, 2)
    model = builder.finalize(device="cpu")
    view = camera(position=(0.1, -0.6, 0.3), target=(0.1, 0.0, 0.05))
    sensor = SplatCamera(model, None, [view], options=dataclasses.replace(PLAIN, segmentation=True))
    sensor.render(model.state())
    image = sensor.images("front", "segmentation").numpy()
    assert sensor.labels == ("world/ball", "link/ball", "link/ball") and sensor.segmentation_ids("link/*") == (1, 2)
    np.testing.assert_array_equal(image[0], image[1])
    left, right = (np.argwhere(image[0] == i)[:, 1].mean() for i in (1, 2))
    assert left < right and (image[0] == 0).any()


def test_nothing_shows_the_sky() -> None:
    """Where neither splat nor mesh is, colour is horizon + (zenith - horizon) clamp(2 sin elevation) of its ray."""
    options = dataclasses.replace(PLAIN, sky=((0.9, 0.5, 0.1), (0.1, 0.3, 0.8)))
    view = camera(target=(0.0, 0.1, 0.45), width=80, height=50, fov_y=1.2)
    sensor = SplatCamera(scene(2), in_worlds([blob(0.2, 0.0, 0.3, 0.9)] * 2), [view], options=options)
    sensor.render(sensor.model.state())
    columns, rows = np.meshgrid(np.arange(80) + 0.5, np.arange(50) + 0.5)
    rays = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1)
    sine = (rays @ rotations_from_quats([view.quat])[0][2]) / np.linalg.norm(rays, axis=-1)
    horizon, zenith = np.array(options.sky)
    sky = horizon + np.clip(2.0 * sine, 0.0, 1.0)[..., None] * (zenith - horizon)
    empty = (sensor.depth.numpy() == 0.0) & (sensor.images("front", "alpha").numpy() == 0.0)
    assert empty[0].mean() > 0.3 and (sine[empty[0]] > 0.3).any() and (sine[empty[0]] < 0.0).any()
    for world in range(2):
        assert np.abs(sensor.rgb.numpy()[world][empty[world]] - 255.0 * sky[empty[world]]).max() <= 0.51
