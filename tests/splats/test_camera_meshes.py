"""Meshes in the pictures of the camera: rasterised against traced, worlds that differ, what is read anew, CUDA."""

from __future__ import annotations

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from softmode.splats import make_plush
from softmode.splats.cameras.camera import CameraOptions, CameraRandomization, SplatCamera
from softmode.splats.raster.rasterizer import SplatArrays
from tests.splats.camera_scene import arrays, camera, scene
from tests.splats.traced import trace

LABELLED = CameraOptions(segmentation=True, splat_shadow=None)
SEGMENTS = 24
"""Facets around what is round in pictures of up to 160 px."""
RADIUS = 0.06
"""Largest radius of what is round [m]."""


def tilted(*position: float) -> wp.transform:
    """Return a place with a turn about an axis that is none of the shape's own."""
    return wp.transform(wp.vec3(*position), wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.3, 0.2)), 0.7))


def bumpy_ball(rings: int) -> newton.Mesh:
    """Return a closed mesh without normals, of about 4 rings^2 triangles."""
    ball = newton.Mesh.create_sphere(RADIUS, num_latitudes=rings, num_longitudes=2 * rings, compute_inertia=False)
    vertices = np.asarray(ball.vertices).reshape(-1, 3)
    bumps = 1.0 + 0.1 * np.sin(60.0 * vertices).sum(axis=1, keepdims=True)
    return newton.Mesh(vertices * bumps, np.asarray(ball.indices), compute_inertia=False)


def shapes(worlds: int = 1, device: str = "cpu", rings: int = 8) -> newton.Model:
    """Return one of each kind of shape over a plane without end, some on a body, in each world."""
    world = newton.ModelBuilder()
    body = world.add_body(xform=wp.transform((0.0, 0.0, 0.05), wp.quat_identity()), label="body")
    world.add_shape_box(body, xform=tilted(0.0, 0.0, 0.1), hx=0.05, hy=0.08, hz=0.03, color=(0.8, 0.6, 0.2))
    world.add_shape_sphere(body, xform=tilted(0.0, 0.22, 0.0), radius=RADIUS, color=(0.9, 0.2, 0.2))
    world.add_shape_capsule(-1, xform=tilted(-0.1, -0.25, 0.1), radius=0.03, half_height=0.06, color=(0.2, 0.3, 0.9))
    world.add_shape_cylinder(-1, xform=tilted(0.15, -0.2, 0.08), radius=0.04, half_height=0.05, color=(0.3, 0.7, 0.7))
    world.add_shape_cone(-1, xform=tilted(0.2, 0.12, 0.07), radius=0.05, half_height=0.06, color=(0.2, 0.7, 0.3))
    world.add_shape_ellipsoid(-1, xform=tilted(0.22, -0.03, 0.06), rx=0.02, ry=0.04, rz=0.05, color=(0.8, 0.8, 0.1))
    world.add_shape_mesh(-1, xform=tilted(-0.25, 0.02, 0.12), mesh=bumpy_ball(rings), color=(0.7, 0.3, 0.8))
    world.add_shape_plane(
        xform=wp.transform((-0.4, 0.3, 0.1), wp.quat_identity()), width=0.2, length=0.3, color=(0.5, 0.5, 0.9)
    )
    builder = newton.ModelBuilder()
    builder.add_ground_plane(color=(0.5, 0.55, 0.5))
    builder.replicate(world, worlds)
    return builder.finalize(device=device)


def view(edge: int, **kwargs) -> dict:
    """Return the description of a camera that sees all shapes."""
    place = {"position": (0.9, -0.5, 0.6), "target": (0.0, 0.0, 0.06), "fov_y": 0.75}
    return {"width": edge, "height": edge} | place | kwargs


def rims(ids: NDArray[np.integer], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the pixels at the edge of something, or beside one."""
    return (maximum_filter(ids, 3) != minimum_filter(ids, 3)) | (
        maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.1 * depth
    )


@pytest.mark.parametrize("edge", [64, 96, 160])
@pytest.mark.parametrize("rings", [8, 80])
@pytest.mark.parametrize("shadows", [False, True])
def test_rasterised_meshes_are_those_of_rays(edge: int, rings: int, shadows: bool) -> None:
    """Apart from edges: the same shape; depth within the depth of a facet; colour within what a facet's normal turns.

    A facet of what is round is up to r (1 - cos(pi / n)) below it. With 80 rings the mesh itself is met by rays, with 8
    it is scanned; either way its triangles are the tracer's, and depth agrees to rounding. A shadow's edge moves with
    the facets that cast it.
    """
    model, options = shapes(rings=rings), dataclasses.replace(LABELLED, shadows=shadows)
    state, seen = model.state(), camera(**view(edge))
    rays = trace(model, state, seen, options)
    sensor = SplatCamera(model, None, [seen], options=options)
    sensor.render(state)
    assert (sensor._meshes._rays is not None) == (rings == 80)
    ids, depth, rgb = (getattr(sensor, name).numpy()[0] for name in ("segmentation", "depth", "rgb"))
    inside = ~rims(rays.shape, rays.depth)
    assert inside.mean() > 0.7 and len(np.unique(rays.shape[inside])) == 9
    np.testing.assert_array_equal(ids[inside], rays.shape[inside])
    assert (ids != rays.shape).mean() < 0.004, "edges lie in the same pixels but for a facet's depth"
    error = np.abs(depth - rays.depth)
    sagitta = RADIUS * (1.0 - np.cos(np.pi / SEGMENTS))
    flat = inside & np.isin(rays.shape, [0, 1, 7, 8])
    np.testing.assert_allclose(depth[flat], rays.depth[flat], rtol=2e-5)
    assert error[inside].max() < 4.0 * sagitta, "the surface is seen under 60 degrees and more from its normal"
    assert error[inside].mean() < 0.1 * sagitta
    lit = inside & (rays.shape >= 0)
    difference = np.abs(rgb.astype(int) - rays.rgb).max(axis=-1)[lit]
    assert np.median(difference) <= 1 and (difference > 4).mean() < 0.01
    psnr = 10.0 * np.log10(255.0**2 / ((rgb.astype(float) - rays.rgb)[rays.shape >= 0] ** 2).mean())
    assert psnr > 32.0


def test_four_samples_lie_where_rays_did() -> None:
    """A picture of four samples is the mean, in linear light, of the pictures of four cameras shifted that far."""
    model = shapes()
    state, options = model.state(), dataclasses.replace(LABELLED, shadows=False)
    lens = camera(**view(64))
    total = np.zeros((64, 64, 3))
    for x, y in ((0.5, 0.5), (0.17, 0.33), (0.67, 0.17), (0.83, 0.72)):
        shifted = dataclasses.replace(lens, cx=lens.cx + 0.5 - x, cy=lens.cy + 0.5 - y)
        one = SplatCamera(model, None, [shifted], options=options)
        one.render(state)
        total += one.mesh_rgb.numpy()[0].astype(float) ** 2.4 / 4.0
    sensor = SplatCamera(model, None, [lens], options=dataclasses.replace(options, mesh_samples=4))
    sensor.render(state)
    difference = np.abs(sensor.mesh_rgb.numpy()[0] - total ** (1.0 / 2.4)).max(axis=-1)
    # A shape is lit once in a pixel, at the first of its samples, where the four cameras light it four times.
    assert np.median(difference) < 1e-3 and (difference > 0.02).mean() < 0.03
    plain = SplatCamera(model, None, [lens], options=options)
    plain.render(state)
    coarse = np.abs(plain.mesh_rgb.numpy()[0] - total ** (1.0 / 2.4)).max(axis=-1)
    assert (coarse > 0.02).mean() > 2.5 * (difference > 0.02).mean()


def move(model: newton.Model, seed: int) -> newton.State:
    """Return a state whose bodies are turned and shifted, each world by its own."""
    state = model.state()
    poses = state.body_q.numpy()
    for world in range(len(poses)):
        rng = np.random.default_rng(seed + world)
        quat = rng.normal(size=4)
        poses[world] = [*(poses[world, :3] + 0.05 * rng.normal(size=3)), *(quat / np.linalg.norm(quat))]
    state.body_q.assign(poses)
    return state


def pictures(sensor: SplatCamera) -> list[NDArray]:
    """Return all that a camera of meshes writes."""
    return [getattr(sensor, name).numpy().copy() for name in ("rgb", "depth", "segmentation", "mesh_rgb")]


def check_worlds(device: str) -> None:
    """Compare the pictures of worlds of many with those of single worlds, bit for bit."""
    drawn = CameraRandomization(rotation=0.05, translation=0.02, focal=0.1, light=0.3, sky=0.1)
    views = [camera(**view(64)), camera("side", **view(64, position=(0.1, -0.7, 0.3)))]
    model = shapes(3, device, rings=80)
    many = SplatCamera(model, None, views, options=LABELLED, randomization=drawn)
    many.seed(5)
    many.randomize()
    many.render(move(model, 7))
    for world in range(3):
        single = shapes(1, device, rings=80)
        alone = SplatCamera(single, None, views, options=LABELLED, randomization=drawn)
        alone.seed(5 + world)
        alone.randomize()
        alone.render(move(single, 7 + world))
        for all_of_them, one in zip(pictures(many), pictures(alone), strict=True):
            np.testing.assert_array_equal(all_of_them[world::3], one)


def test_a_world_of_many_is_drawn_as_the_single_world() -> None:
    """Scan, rays, shadows and draws: what world i shows is bitwise what it shows alone."""
    check_worlds("cpu")


def test_worlds_may_hold_different_shapes() -> None:
    """Each world shows its own shapes and the shared ones, as if alone; labels are those of the model."""
    builder, alone = newton.ModelBuilder(), []
    for index in range(3):
        world = newton.ModelBuilder()
        if index != 1:
            world.add_shape_box(-1, hx=0.1, hy=0.05, hz=0.1 + 0.05 * index, label="box")
        world.add_shape_sphere(-1, xform=tilted(0.0, 0.3, 0.05), radius=0.05, label="ball")
        single = newton.ModelBuilder()
        for model in (builder, single):
            if model is single or index == 0:
                model.add_ground_plane()
            model.add_world(world)
        alone.append(single.finalize(device="cpu"))
    model = builder.finalize(device="cpu")
    sensor = SplatCamera(model, None, [camera(**view(64))], options=LABELLED)
    sensor.render(model.state())
    for world, single in enumerate(alone):
        expected = SplatCamera(single, None, [camera(**view(64))], options=LABELLED)
        expected.render(single.state())
        for name in ("rgb", "depth"):
            np.testing.assert_array_equal(getattr(sensor, name).numpy()[world], getattr(expected, name).numpy()[0])
        named = [sensor.labels[i] for i in np.unique(sensor.segmentation.numpy()[world])[1:]]  # type: ignore[union-attr]
        assert named == [expected.labels[i] for i in np.unique(expected.segmentation.numpy()[0])[1:]]  # type: ignore[union-attr]


def check_capture(device: str) -> None:
    """Compare a replayed frame with an eager one after poses, colours, flags and lens have changed."""
    model = shapes(2, device, rings=80)
    plush = SplatArrays.from_splats([make_plush(500)], world_count=2, device=device)
    options = dataclasses.replace(LABELLED, splat_shadow=CameraOptions().splat_shadow)
    sensor = SplatCamera(model, plush, [camera(**view(64))], options=options)
    state = model.state()
    sensor.render(state)
    before = pictures(sensor)
    with wp.ScopedCapture(device=device) as capture:
        sensor.render(state)
    places, colors, flags = model.shape_transform.numpy(), model.shape_color.numpy(), model.shape_flags.numpy()
    body = model.shape_body.numpy()
    places[body < 0, 0] += 0.04
    colors[:, 1] *= 0.5
    flags[-1] = 0
    model.shape_transform.assign(places)
    model.shape_color.assign(colors)
    model.shape_flags.assign(flags)
    state.body_q.assign(move(model, 3).body_q)
    sensor.intrinsics("front").assign(0.9 * sensor.intrinsics("front").numpy())
    wp.capture_launch(capture.graph)
    replayed = pictures(sensor)
    sensor.render(state)
    for was, now, eager in zip(before, replayed, pictures(sensor), strict=True):
        np.testing.assert_array_equal(now, eager)
        assert (was != now).mean() > 0.05
    last = sensor.labels.index("world/shape_7")
    assert last in before[2][1] and last not in replayed[2][1] and last in replayed[2][0]


def test_captured_frames_follow_poses_colours_flags_and_lenses() -> None:
    """A graph reads anew what moves; a shape that loses VISIBLE is gone from the next frame."""
    check_capture("cpu")


def test_a_camera_among_the_shapes_sees_what_is_before_it() -> None:
    """With triangles behind, before and through the plane of the camera, shapes and depths are those of rays."""
    model = shapes()
    state = model.state()
    for place, target in (((0.05, 0.1, 0.08), (0.0, 0.22, 0.05)), ((0.0, 0.0, 0.02), (1.0, 0.1, 0.0))):
        seen = camera(**view(64, position=place, target=target, fov_y=1.4))
        rays = trace(model, state, seen, LABELLED)
        sensor = SplatCamera(model, None, [seen], options=LABELLED)
        sensor.render(state)
        inside = ~rims(rays.shape, rays.depth)
        assert inside.mean() > 0.5
        np.testing.assert_array_equal(sensor.segmentation.numpy()[0][inside], rays.shape[inside])  # type: ignore[union-attr]
        np.testing.assert_allclose(sensor.depth.numpy()[0][inside], rays.depth[inside], rtol=1e-2, atol=1e-3)


@pytest.mark.gpu
@pytest.mark.parametrize("samples", [1, 4])
def test_cuda_draws_what_the_cpu_draws(samples: int) -> None:
    """The same shapes, depths and colours but for pixels at edges, where rounding decides."""
    drawn = {}
    for device in ("cpu", "cuda:0"):
        model = shapes(2, device, rings=80)
        options = dataclasses.replace(LABELLED, mesh_samples=samples)
        sensor = SplatCamera(model, None, [camera(**view(64))], options=options)
        sensor.render(move(model, 11))
        drawn[device] = pictures(sensor)
    rgb, depth, ids, _ = (np.asarray(there) for there in drawn["cuda:0"])
    same = ids == drawn["cpu"][2]
    assert same.mean() > 0.998
    close = np.abs(depth - drawn["cpu"][1]) <= 1e-4 * depth
    assert close.mean() > 0.995
    assert (np.abs(rgb.astype(int) - drawn["cpu"][0]).max(axis=-1) <= 1).mean() > 0.99


@pytest.mark.gpu
def test_cuda_draws_a_world_of_many_as_the_single_world() -> None:
    """Atomics settle every sample alike, whatever the order of the threads: bit for bit."""
    check_worlds("cuda:0")


@pytest.mark.gpu
def test_cuda_graph_equals_eager() -> None:
    """A replayed frame is an eager one, bit for bit."""
    check_capture("cuda:0")


def test_splats_stand_in_the_shadow_map_of_every_world() -> None:
    """A splat shadow darkens meshes of its own world only, and not what a mesh darkens already."""
    model = scene(2)
    both = SplatCamera(model, arrays(make_plush(900), 2), [camera(target=(0, 0, 0), fov_y=0.3)])
    means = both.splats.means.numpy()  # type: ignore[union-attr]
    means[1] += [0.0, 0.0, 50.0]
    both.splats.means.assign(means)  # type: ignore[union-attr]
    both.render(model.state())
    with_plush, without = both.mesh_rgb.numpy().sum(axis=-1)
    assert (with_plush <= without + 1e-6).all() and (with_plush < without - 0.1).sum() > 10
