"""The film of a task: what is in the pictures, and that pictures for policies stay what they are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.cli.object_options import ObjectOptions
from softmode.envs import LiftSoftConfig
from softmode.envs.scripted import scripted_policy
from tests.envs.conftest import MakeEnv

EDGE = 128


@pytest.fixture(scope="module")
def lift() -> Iterator[gym.Env]:
    """LiftSoft with film cameras and the glove of `make demo`."""
    scene = ObjectOptions(object=Path("glove"), youngs_modulus=3e4, density=400.0).configured(LiftSoftConfig())
    made = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array", render_size=EDGE, config=scene)
    yield made
    made.close()


def pixel(camera: int, film, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a point is in the picture of a camera of a film, 0..1 to the right and down."""
    matrix, lens = film._matrices[camera], film.cameras[camera]
    seen = matrix[:3, :3] @ point + matrix[:3, 3]
    return np.array([lens.fx * seen[0] / seen[2] + lens.cx, lens.fy * seen[1] / seen[2] + lens.cy]) / lens.width


def masks(film) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where object 0 would be in the first camera's picture, and where it is seen, of the last frame."""
    seen = film._splats.alpha.numpy()[0] > 0.5
    film._splats.render(film._objects, film.views, mesh_rgb=film._meshes.rgb, mesh_depth=film._no_depth)
    return film._splats.alpha.numpy()[0] > 0.5, seen


@pytest.mark.rest
def test_what_a_film_shows(lift: Any) -> None:
    """Of the lifted glove nine tenths are free of fingers, it fills over 15 % of the first picture and gives way.

    Strain at the grasp is over 8 %, some point of it swings by over 4 mm under the hand. The second picture has the
    whole arm. The first camera moves by less than 11 cm in 0.17 s.
    """
    task = lift.unwrapped.task
    scene, film = task.scene, task.scene.film
    policy: Any = scripted_policy(lift)
    body = scene.soft.body
    for seed in range(10):
        observation, _ = lift.reset(seed=seed)
        policy.reset()
        free, share, swing, strain, before = [], [], [], 0.0, None
        for step in range(150):
            observation, *_ = lift.step(policy(observation))
            if step % 5:
                continue
            frame = lift.render()
            assert isinstance(frame, np.ndarray) and frame.shape == (EDGE, 2 * EDGE, 3)
            for corner in film.corners(scene.state)[0]:
                where = pixel(1, film, corner)
                assert (where > -0.02).all() and (where < 1.02).all()
            place = -film._matrices[0][:3, :3].T @ film._matrices[0][:3, 3]
            if before is not None and step > 60:  # the turn to the fingers is over
                assert np.linalg.norm(place - before) < 0.11
            before = place
            if not policy._grasp.holds:
                continue
            if not free:
                q = scene.state.softmode.q.numpy()[: body.function_count]
                F = np.eye(3) + np.einsum("kd,pke->pde", q, body.cubature.grad_basis)
                strain = np.abs(np.linalg.svd(F, compute_uv=False) - 1.0).max()
            whole, seen = masks(film)
            free.append((whole & seen).sum() / whole.sum())
            share.append(seen.mean())
            tool = scene.controller.tool_pose.numpy()[0, :3]
            swing.append(scene.state.particle_q.numpy()[: body.surface_count] - tool)
        swung = np.linalg.norm(np.ptp(swing, axis=0), axis=1).max()
        print(
            f"seed {seed}: free {np.mean(free):.3f}, share {np.mean(share):.3f}, strain {strain:.3f}, swing {swung:.4f}"
        )
        assert np.mean(free) > 0.9 and np.mean(share) > 0.15
        assert strain > 0.08 and swung > 0.004


def test_the_goal_is_a_ring_about_the_object(make_env: MakeEnv) -> None:
    """Green pixels of the first picture lie on a circle around the goal, none of them where the object is solid."""
    lift: Any = make_env("LiftSoft", "pixels_agent_pos").unwrapped
    lift.reset(seed=0, options={"goal": (0.45, 0.0, 0.05), "position": (0.45, 0.0)})
    film, frame = lift.task.scene.film, lift.render().astype(float)
    edge = len(frame)
    frame = frame[:, :edge]
    green = (frame[..., 1] > frame[..., 0] + 60) & (frame[..., 1] > frame[..., 2] + 40)
    assert green.sum() > 40 and not (green & (film._splats.alpha.numpy()[0] > 0.9)).any()
    goal = lift.task.scene.marker_place.numpy()[0, :3].astype(float)
    off = np.argwhere(green)[:, ::-1] + 0.5 - edge * pixel(0, film, goal)
    assert np.ptp(np.linalg.norm(off, axis=1)) < 8.0


def test_record_video(make_env: MakeEnv, tmp_path: Path) -> None:
    """Gymnasium's own recorder writes a film, where moviepy is there."""
    pytest.importorskip("moviepy")
    env = gym.wrappers.RecordVideo(
        make_env("LiftSoft", "pixels_agent_pos"), str(tmp_path), name_prefix="lift", step_trigger=lambda step: step == 0
    )
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    env.stop_recording()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("lift*.mp4")] == [True]


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
