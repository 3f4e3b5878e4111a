"""Pictures for people: meshes as policies see them, soft shadows, a goal that hides nothing, a room by depth."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from softmode.envs.cameras import FollowCamera, square_camera
from softmode.envs.markers import dots
from softmode.scenes.film_camera import FilmCamera
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.raster.rasterizer import SplatArrays

EDGE = 96
CAMERA = square_camera("front", EDGE, (0.5, -0.45, 0.4), (0.0, 0.0, 0.05), 0.6)


@pytest.fixture(scope="module")
def model() -> newton.Model:
    """A box that moves and a ball over a slab that reaches behind the camera."""
    world = newton.ModelBuilder()
    world.add_shape_box(
        -1, xform=wp.transform((0.0, 0.0, -0.02), wp.quat_identity()), hx=2.0, hy=2.0, hz=0.02, color=(0.4, 0.5, 0.6)
    )
    body = world.add_body(xform=wp.transform((0.0, 0.08, 0.12), wp.quat_identity()))
    world.add_shape_box(body, hx=0.05, hy=0.04, hz=0.03, color=(0.8, 0.3, 0.2))
    world.add_shape_sphere(
        body, xform=wp.transform((0.0, -0.16, -0.05), wp.quat_identity()), radius=0.05, color=(0.2, 0.7, 0.3)
    )
    builder = newton.ModelBuilder()
    builder.replicate(world, 1)
    return builder.finalize(device="cpu")


def cloud(x: float, y: float, z: float, color: tuple[float, float, float], spread: float = 0.02) -> SplatArrays:
    """Return a thick ball of splats."""
    points = np.random.default_rng(0).normal(size=(300, 3))
    points *= spread / np.linalg.norm(points, axis=1, keepdims=True)
    return SplatArrays.from_splats(
        [dots(points + np.array([x, y, z]), 0.5 * spread, color=color, opacity=0.9)], device="cpu"
    )


def film(model: newton.Model, objects: SplatArrays, marker: SplatArrays | None = None) -> FilmCamera:
    """Return the film camera of a model at rest."""
    return FilmCamera(model, model.state(), objects, marker, [CAMERA])


FAR_AWAY = (0.0, 0.0, -5.0, (0.5, 0.5, 0.5))


def picture(camera: FilmCamera, model: newton.Model) -> NDArray[np.float64]:
    """Return a frame, 0..1."""
    return camera.render(model.state()).numpy()[0] / 255.0


def test_meshes_look_as_policies_see_them(model: newton.Model) -> None:
    """Away from edges of things and of shadows, colours are within two levels of what policies see, depths within 2 %.

    That much the slab's depth changes in a pixel, somewhere in which either of the two looks.
    """
    camera = film(model, cloud(*FAR_AWAY))
    drawn = picture(camera, model)
    seen = SplatCamera(model, None, [CAMERA], options=CameraOptions(mesh_samples=4))
    seen.render(model.state())
    rgb, depth = seen.rgb.numpy()[0] / 255.0, seen.depth.numpy()[0]
    near = camera._meshes.depth.numpy()[0]
    assert (np.abs(near - depth) <= 0.02 * depth).mean() > 0.95
    difference = np.abs(drawn - rgb).max(axis=2)
    assert np.median(difference) < 2.0 / 255.0
    assert (difference < 6.0 / 255.0).mean() > 0.85


def test_shadows_have_soft_edges(model: newton.Model) -> None:
    """On the slab the light takes many values between sun and shadow; a ray knows two of them (and edges of things)."""
    camera = film(model, cloud(*FAR_AWAY))
    drawn = picture(camera, model)
    slab = np.abs(drawn[..., 2] / np.maximum(drawn[..., 0], 0.01) - 1.35) < 0.15
    levels, counts = np.unique(np.round(255.0 * drawn[slab][:, 2]), return_counts=True)
    sunny, dark = levels[counts.argmax()], levels[0]
    between = (levels > dark + 3) & (levels < sunny - 3)
    assert sunny - dark > 30 and between.sum() > 8


def test_a_marker_covers_no_object(model: newton.Model) -> None:
    """A goal before the object leaves its solid pixels as they are, and is seen beside it."""
    thing = cloud(0.08, -0.05, 0.05, (0.9, 0.6, 0.2))
    alone = picture(film(model, thing), model)
    goal = cloud(0.16, -0.12, 0.08, (0.1, 0.9, 0.3), 0.04)
    marked = film(model, thing, goal)
    both = picture(marked, model)
    changed = np.abs(both - alone).max(axis=2) > 0.02
    solid = marked._splats.alpha.numpy()[0] > 0.999
    assert solid.sum() > 20 and changed.sum() > 50
    assert not (changed & solid).any()


@pytest.mark.parametrize("before", [True, False])
def test_a_room_is_composited_by_depth(model: newton.Model, before: bool) -> None:
    """A wall of splats behind everything shows in place of sky only; one before everything hides box and object."""
    thing = cloud(0.08, -0.05, 0.05, (0.9, 0.6, 0.2))
    camera = film(model, thing)
    alone = picture(camera, model)
    ahead = -np.array(CAMERA.position) + [0.0, 0.0, 0.05]
    middle = np.array(CAMERA.position) + (0.3 if before else 3.0) * ahead
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead) / np.linalg.norm(ahead)
    reach = 0.25 if before else 2.5
    a, b = np.meshgrid(*[np.linspace(-reach, reach, 50)] * 2)
    points = middle + a.reshape(-1, 1) * right + b.reshape(-1, 1) * up
    if not before:
        points = points[points[:, 2] > 0.0]
    camera.surround(dots(points, 0.04 * reach, color=(0.1, 0.1, 0.9), opacity=0.99))
    drawn = picture(camera, model)
    blue = (drawn[..., 2] > 0.8) & (drawn[..., 0] < 0.2)
    sky = camera._meshes.depth.numpy()[0] == 0.0
    if before:
        assert blue.mean() > 0.99
    else:
        solid = camera._splats.alpha.numpy()[0] > 0.999
        np.testing.assert_allclose(drawn[solid], alone[solid], atol=2.0 / 255.0)
        assert not blue[solid].any()
        assert (blue.sum() > 100) == (sky.sum() > 100 or blue.any())


def test_an_edge_before_a_splat_has_no_fringe(model: newton.Model) -> None:
    """Where the box's edge crosses the object, pixels lie between the colours of both: the slab shines through nowhere.

    The object is red and green, the slab blue: blue stays below that of the slab by far.
    """
    camera = film(model, cloud(-0.08, 0.16, 0.08, (0.95, 0.85, 0.0), 0.08))
    drawn = picture(camera, model)
    alpha, near = camera._splats.alpha.numpy()[0], camera._meshes._near.numpy()[0][..., 3]
    edge = (near > 0.2) & (near < 0.8) & (alpha > 0.99)
    assert edge.sum() > 10
    assert (drawn[edge][:, 2] < 0.3).all()


def test_the_following_camera_does_not_jerk() -> None:
    """Balls stay in the picture; where they jump, speed grows by no more than rate^2 offset; a reset jumps."""
    follow, step = FollowCamera(CAMERA, 1), 1.0 / 30.0
    places = []
    for k in range(90):
        x = 0.0 if k < 30 else 0.2
        balls = np.array([[[x, 0.0, 0.05, 0.05], [x, 0.0, 0.2, 0.07]]])
        matrix = follow.matrices(balls, np.array([k * step]))[0]
        places.append(-matrix[:3, :3].T @ matrix[:3, 3])
        if k < 30 or k > 75:
            for *center, radius in balls[0]:
                seen = matrix[:3, :3] @ center + matrix[:3, 3]
                assert (np.abs(seen[:2]) + radius < 0.5 * EDGE / CAMERA.fx * seen[2]).all()
    move = np.diff(places, axis=0)
    assert np.abs(move[:28]).max() == 0.0
    rate = 2.0 / follow.seconds
    assert np.abs(np.diff(move, axis=0)).max() < (rate * step) ** 2 * 0.25
    again = follow.matrices(np.array([[[0.0, 0.0, 0.05, 0.05], [0.0, 0.0, 0.2, 0.07]]]), np.zeros(1))[0]
    np.testing.assert_allclose(-again[:3, :3].T @ again[:3, 3], places[0], atol=1e-12)
