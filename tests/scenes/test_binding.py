"""Splats bound to bodies: they are where x(X) puts them, in every world, and what is not theirs stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables import BuildOptions, add_reduced_body
from softmode.errors import ConfigError
from softmode.objects import Placed, SoftObject, load
from softmode.scenes import BoundSplats, Fixture, SplatScene, splats_of_states
from softmode.splats import PinholeCamera, make_plush

EDGE = 0.06


@pytest.fixture(scope="module")
def cube() -> SoftObject:
    """Return a cube with a few splats."""
    build = BuildOptions(mode_count=3, kernel_count=150, cubature_count=128)
    return load(shape="box", extents=(EDGE,) * 3, splat_count=600, surface_count=100, build=build)


def two_cubes(cube: SoftObject, worlds: int) -> Any:
    """Return a model with two cubes in each world, and a state with random coordinates."""
    world = newton.ModelBuilder()
    for _ in range(2):
        add_reduced_body(world, cube.body)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    model: Any = builder.finalize(device="cpu")
    state: Any = model.state()
    state.softmode.q.assign(np.random.default_rng(0).normal(scale=0.01, size=(len(state.softmode.q), 3)))
    return model, state


def test_splats_are_where_the_displacement_puts_them(cube: SoftObject) -> None:
    """X = X + sum_k b_k(X) q_k for each object of each chosen world, to float32; other splats are left alone."""
    model, state = two_cubes(cube, 3)
    other = make_plush(200)
    bound = BoundSplats(model, [cube, cube], worlds=[2, 0], others=[other])
    bound.update(state)
    q = state.softmode.q.numpy().reshape(3, 2, -1, 3)
    rest = cube.visible_splats.means.astype(np.float64)
    for (place, o), frame in bound.frames().items():
        np.testing.assert_allclose(frame.means, rest + cube.basis @ q[(2, 0)[place], o], atol=1e-6)
    assert len(bound.frames()) == 4
    np.testing.assert_array_equal(bound.arrays.means.numpy()[:, bound.columns[2]], [other.means] * 2)


def test_a_body_without_splats_is_skipped(cube: SoftObject) -> None:
    """None, and an object without splats, have no columns; the second object still follows its own coordinates."""
    model, state = two_cubes(cube, 1)
    both = BoundSplats(model, [cube, cube])
    both.update(state)
    for absent in (None, replace(cube, splats=None)):
        second = BoundSplats(model, [absent, cube])
        second.update(state)
        assert second.indices == (1,) and list(second.frames()) == [(0, 1)]
        np.testing.assert_array_equal(second.frames()[0, 1].means, both.frames()[0, 1].means)


def test_states_without_a_model_are_the_same(cube: SoftObject) -> None:
    """The splats of a state on its own are, bit for bit, those of the model that has it."""
    model, state = two_cubes(cube, 2)
    bound = BoundSplats(model, [cube, cube])
    bound.update(state)
    states = state.softmode.q.numpy().reshape(4, -1, 3)
    found = list(splats_of_states(cube, states))
    assert len(found) == 4
    for k, splats in enumerate(found):
        np.testing.assert_array_equal(splats.means, bound.frames()[divmod(k, 2)].means)
    alone = BoundSplats(None, [cube], worlds=range(4), device="cpu")
    alone.move(wp.array(states.reshape(-1, 3), dtype=wp.vec3d, device="cpu"))
    np.testing.assert_array_equal(alone.frames()[3, 0].covariances, bound.frames()[1, 1].covariances)


def test_states_without_a_model_have_their_dents(cube: SoftObject) -> None:
    """Dents move them as they move those of the model, bit for bit; they are one vector per state and sample."""
    model, state = two_cubes(cube, 2)
    bound, dents = BoundSplats(model, [cube, cube]), np.zeros((4, cube.body.surface_count, 3), np.float32)
    dents[:, :5] = 1e-3 * np.arange(60, dtype=np.float32).reshape(4, 5, 3)
    state.softmode.dent.assign(dents.reshape(-1, 3))
    bound.update(state)
    states = state.softmode.q.numpy().reshape(4, -1, 3)
    bare = list(splats_of_states(cube, states))
    for k, splats in enumerate(splats_of_states(cube, states, dents)):
        np.testing.assert_array_equal(splats.means, bound.frames()[divmod(k, 2)].means)
        assert np.abs(splats.means - bare[k].means).max() > 1e-4
    with pytest.raises(ConfigError, match=r"dents has shape \(3, "):
        next(splats_of_states(cube, states, dents[:3]))


def test_other_bodies_are_refused(cube: SoftObject) -> None:
    """As many objects as the model has soft bodies in a world; one where there is no model."""
    with pytest.raises(ConfigError, match="objects names 1 soft bodies, the model has 4 in 2 worlds"):
        BoundSplats(two_cubes(cube, 2)[0], [cube])
    with pytest.raises(ConfigError, match="2 objects and no model"):
        BoundSplats(None, [cube, cube])


def test_a_scene_of_fixtures_with_cameras_of_two_sizes(cube: SoftObject) -> None:
    """Fixtures alone make a scene: the cube rests on the box; each camera draws in its own size; a reset lifts it."""
    eye = {"position": (0.3, -0.2, 0.2), "target": (0.0, 0.0, 0.03)}
    cameras = [PinholeCamera.look_at(name, width=n, height=n, **eye) for name, n in (("small", 32), ("large", 64))]
    floor = Fixture(label="floor", size=(0.2, 0.2, 0.05), position=(0.0, 0.0, -0.05))
    scene = SplatScene([floor], [Placed(object=cube, position=(0.0, 0.0, 0.5 * EDGE + 0.01))], cameras=cameras)
    for _ in range(15):
        scene.step()
    assert abs(scene.surface(0)[:, 2].min()) < 1e-3
    assert scene.draw("small").shape == (32, 32, 3) and scene.draw("large").shape == (64, 64, 3)
    with pytest.raises(ConfigError, match="no camera 'other'"):
        scene.draw("other")
    scene.reset()
    assert scene.state.softmode.q.numpy() == pytest.approx(scene.model.state().softmode.q.numpy(), abs=0.0)
