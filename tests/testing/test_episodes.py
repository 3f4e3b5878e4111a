"""Episodes that tests play: what is measured in them, what assertions say, and what is kept of a failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from softmode.envs import EnvState
from softmode.errors import ConfigError
from softmode.learning.intervals import wilson_interval
from softmode.testing import (
    Episode,
    assert_golden,
    assert_max_force,
    assert_max_penetration,
    assert_no_flag,
    assert_replays,
    assert_success,
    play_episode,
)
from softmode.testing.failure import BEFORE, save_failure
from softmode.testing.golden import write_golden

PRESS = "softmode/PressSoft-v0"


@pytest.fixture(scope="module")
def played(soft_env: Callable[..., gym.Env]) -> Episode:
    """Return a scripted press, in an environment of its own for small films."""
    return play_episode(soft_env(PRESS, obs_type="state", render_size=64), "scripted", 3)


@pytest.fixture
def press(played: Episode) -> Episode:
    """Return the press with steps that a test may exchange."""
    return replace(played, steps=list(played.steps))


def test_figures_are_those_of_the_scene(press: Episode) -> None:
    """Held for 15 steps, the force is the task's own, shared by two fingers, and the depth that of the samples.

    By then nothing moves, so that start and end of the last substep differ by less than 2 %.
    """
    assert_success(press)
    assert_no_flag(press)
    last, scene = press.steps[-1], press.base.scene
    for _ in press.replayed(press.base):  # to its end, where another test may have left it
        pass
    fingers = np.linalg.norm(scene.finger_force.numpy()[0], axis=1)
    assert last.force == pytest.approx(fingers.max(), rel=1.0e-5)
    assert fingers.sum() == pytest.approx(last.info["contact_force"], rel=0.1)
    samples = scene.state.particle_q.numpy()[:, 2]
    assert samples.min() < 0.0
    assert last.depth >= -0.98 * samples.min()
    assert_max_force(press, 1.001 * max(step.force for step in press.steps))
    assert_max_penetration(press, 1.001e3 * max(step.depth for step in press.steps))


def test_a_failure_names_seed_step_and_figure(press: Episode) -> None:
    """The first step beyond a bound is named, and kept for the report."""
    forces = np.array([step.force for step in press.steps])
    bound = 0.5 * float(forces.max())
    first = int(np.argmax(forces > bound))
    with pytest.raises(AssertionError, match=rf"seed 3, step {first} of 120: .* N on a rigid body, allowed"):
        assert_max_force(press, bound)
    assert press.failed_at == first
    with pytest.raises(AssertionError, match="mm deep in a rigid shape"):
        assert_max_penetration(press, 0.0)
    idle = play_episode(press.env, "zero", 3, max_steps=5)
    with pytest.raises(AssertionError, match=r"seed 3, step 4 of 5: no success \(running\): contact_force 0, "):
        assert_success(idle)
    idle.steps[2] = replace(idle.steps[2], info={**idle.steps[2].info, "solver_status": 5})
    with pytest.raises(AssertionError, match=r"step 2 of 5: the solver reports contact_overflow \(raise contact_max\)"):
        assert_no_flag(idle, allow=["iteration_limit"])
    assert_no_flag(idle, allow=["iteration_limit", "contact_overflow"])
    with pytest.raises(ConfigError, match="Choose from iteration_limit"):
        assert_no_flag(idle, allow=["iterations"])


def test_an_episode_replays_and_another_does_not(press: Episode) -> None:
    """The same bits from the start; a changed action is found at its step."""
    assert_replays(press)
    press.steps[60] = replace(press.steps[60], action=-press.steps[60].action)
    with pytest.raises(AssertionError, match="seed 3, step 60 of 120: played again, it is off by"):
        assert_replays(press)


def test_golden_episodes(press: Episode, tmp_path: Path) -> None:
    """The same episode passes; another seed, a change, and a missing file are told apart, with the remedy."""
    path = tmp_path / "golden" / "press.npz"
    with pytest.raises(AssertionError, match=r"there is no golden episode .*--softmode-golden update"):
        assert_golden(press, path)
    write_golden(press, path)
    assert_golden(press, path)
    with pytest.raises(AssertionError, match="has seed 3, this one 4"):
        assert_golden(play_episode(press.env, "scripted", 4, max_steps=3), path)
    with pytest.raises(AssertionError, match=r"step 2 of 3: press.npz has 120 steps"):
        assert_golden(play_episode(press.env, "scripted", 3, max_steps=3), path)
    columns = press.base.task.segments["contact_force"][0]
    changed = press.steps[80].observation.copy()
    changed[columns] += 1.0e-3
    press.steps[80] = replace(press.steps[80], observation=changed)
    with pytest.raises(AssertionError, match=r"step 80 of 120: contact_force off by 0.001 from press.npz"):
        assert_golden(press, path)
    assert_golden(press, path, atol=2.0e-3)


def test_what_is_kept_of_a_failure(press: Episode, tmp_path: Path) -> None:
    """Film, sheet and recording; the state ten steps before goes on to the failure with the same bits."""
    press.failed_at = 40
    lines = save_failure(press, tmp_path / "kept")
    assert {file.name for file in (tmp_path / "kept").iterdir()} >= {
        "film.mp4",
        "film.png",
        "episode.rrd",
        "before.npz",
    }
    assert len(lines) == 3 and f"state before step {41 - BEFORE}" in lines[0]
    base = press.base
    base.set_state(EnvState.load(tmp_path / "kept" / "before.npz"))
    for step in press.steps[41 - BEFORE : 41]:
        base.step(step.action)
    np.testing.assert_array_equal(base.task.observation.numpy()[0], press.steps[40].observation)


def test_policies_and_refusals(soft_env: Callable[..., gym.Env]) -> None:
    """A callable with a reset is reset; options reach the environment; what no episode can be of is refused."""

    class Still:
        """A policy that counts."""

        calls = resets = 0

        def reset(self) -> None:
            """Count."""
            self.resets += 1

        def __call__(self, observation: np.ndarray) -> np.ndarray:
            """Stand still."""
            self.calls += 1
            return np.zeros(5, np.float32)

    policy = Still()
    env = soft_env(PRESS, render_size=64, obs_type="state")
    assert env is soft_env(PRESS, obs_type="state", render_size=64) is not soft_env(PRESS, obs_type="state")
    played = play_episode(env, policy, 1, options={"youngs_modulus": 5.0e4}, max_steps=4)
    assert (policy.resets, policy.calls, len(played.steps)) == (1, 4, 4)
    assert played.base.config.render_size == 64
    assert played.steps[-1].info["parameters"]["youngs_modulus"] == pytest.approx(5.0e4)
    with pytest.raises(ConfigError, match=r"unexpected keyword argument 'forse_tolerance'.*Nearest: force_tolerance"):
        soft_env(PRESS, forse_tolerance=0.2)
    with pytest.raises(ConfigError, match="nothing ends the episode"):
        play_episode(env.unwrapped, "zero")
    with pytest.raises(ConfigError, match="not made of a softmode task"):
        play_episode(gym.make("CartPole-v1"), "zero")


def test_the_interval_solves_wilsons_equation() -> None:
    """Both ends p solve (k/n - p)^2 = z^2 p (1 - p) / n; none and all include 0 and 1."""
    for successes, count in ((7, 20), (1, 9), (0, 5), (5, 5)):
        for p in wilson_interval(successes, count):
            assert (successes / count - p) ** 2 == pytest.approx(1.96**2 * p * (1.0 - p) / count, abs=1.0e-12)
    assert wilson_interval(0, 5)[0] == 0.0 and wilson_interval(5, 5)[1] == 1.0
