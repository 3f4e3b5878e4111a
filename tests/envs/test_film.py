"""The film of a task: what is in the pictures, and that pictures for policies stay what they are."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.envs import LiftSoftConfig
from softmode.learning.players import policy_factory
from tests.envs.conftest import MakeEnv

EDGE = 128


@pytest.fixture(scope="module")
def lift() -> Iterator[gym.Env]:
    """LiftSoft with film cameras."""
    made = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array", config=LiftSoftConfig(render_size=EDGE))
    yield made
    made.close()


def pixel(camera: int, film, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a point is in the picture of a camera of a film, 0..1 to the right and down."""
    matrix, lens = film._matrices[camera], film.cameras[camera]
    seen = matrix[:3, :3] @ point + matrix[:3, 3]
    return np.array([lens.fx * seen[0] / seen[2] + lens.cx, lens.fy * seen[1] / seen[2] + lens.cy]) / EDGE


@pytest.mark.slow
def test_what_a_film_shows(lift: gym.Env) -> None:
    """While the arm lifts the bear, the following camera has bear and hand in view, and the bear is large in it.

    The overview has the whole arm; the goal is in both pictures, and seen unless it is behind the bear or the hand.
    """
    observation, _ = lift.reset(seed=0)
    policy = policy_factory("scripted", lift, None)(0)
    task = lift.unwrapped.task  # type: ignore[attr-defined]
    film, shares, before = task.scene.film, [], None
    arm = np.flatnonzero(film._meshes._triangles.body.numpy() >= 0)
    for step in range(100):
        observation, *_ = lift.step(policy(observation))
        if step % 5:
            continue
        frame = lift.render()
        assert isinstance(frame, np.ndarray) and frame.shape == (EDGE, 2 * EDGE, 3)
        bear, tool = task.scene.object_position.numpy()[0, 0], task.scene.controller.tool_pose.numpy()[0, :3]
        goal = task.scene.marker_place.numpy()[0, :3]
        for camera, points in ((0, (bear, tool, goal)), (1, (bear, tool, goal))):
            for point in points:
                where = pixel(camera, film, point.astype(float))
                assert (where > 0.02).all() and (where < 0.98).all()
        corners = film._meshes._corner.numpy()[0][arm[::50]]
        for corner in corners:
            where = pixel(1, film, corner.astype(float))
            assert (where > 0.0).all() and (where < 1.0).all()
        shares.append((film._splats.alpha.numpy()[0] > 0.5).mean())
        place = film._matrices[0][:3, 3].copy()
        if before is not None:  # 0.17 s later: slower than 0.5 m/s
            assert np.linalg.norm(place - before) < 0.09
        before = place
    assert 0.02 < min(shares) and max(shares) < 0.4


def test_films_leave_observations_as_they_are(make_env: MakeEnv) -> None:
    """Pictures for a policy are the same, bit for bit, with film cameras and without, before and after a frame."""
    pictures = []
    for env in (gym.make("softmode/PushSoft-v0", obs_type="pixels"), make_env("PushSoft", "pixels")):
        first, _ = env.reset(seed=3)
        env.render()
        second, *_ = env.step(np.array([0.3, -0.2, -0.8, 0.1, 1.0], np.float32))
        pictures.append((first, second))
    for without, with_film in zip(*pictures, strict=True):
        np.testing.assert_array_equal(without, with_film)
