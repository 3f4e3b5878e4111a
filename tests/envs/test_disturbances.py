"""Delays, noise and bias, and drives that differ, beside an environment without them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.disturbances import SIM_TO_REAL
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.errors import ConfigError

ID = "softmode/LiftSoft-v0"


def worlds_of(count: int = 1, **fields: Any) -> Any:
    """Return a vector environment."""
    return gym.make_vec(ID, num_envs=count, **{"autoreset_mode": "SameStep", **fields})


def played(env: Any, actions: np.ndarray, drawn: dict[str, Any], limit: int = 1000) -> list[np.ndarray]:
    """Return the first observation and those after each action."""
    seen = [env.reset(seed=0, options=drawn)[0][0].copy()]
    for action in actions[:limit]:
        seen.append(env.step(action[None])[0][0].copy())
    return seen


def test_what_is_late_is_what_was(lift: LiftSoftEnv) -> None:
    """Actions two steps late and observations one: those of the plain environment whose actions were moved by two.

    The last three actions are in the observation, the newest first; a state goes on with the same bits; what is between
    two steps is their mean.
    """
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 5)).astype(np.float32)
    lift.reset(seed=0)
    drawn = {name: value for name, value in lift.reset(seed=0)[1]["parameters"].items()}
    first = lift.reset(seed=0, options=drawn)[0].copy()
    plain = [first] + [lift.step(a)[0].copy() for a in np.concatenate([np.zeros((2, 5), np.float32), actions])]
    env = worlds_of(action_delay_range=(0.0, 2.0), observation_delay_range=(0.0, 1.0))
    names, columns = env.unwrapped.task.segments, env.unwrapped.task.segments["last_actions"][0]
    assert set(names) - {"last_actions"} == set(lift.task.segments)
    both = [np.delete(np.arange(len(first) + 15), np.r_[columns])]
    seen = played(env, actions, {**drawn, "action_delay": 2.0, "observation_delay": 1.0})
    for k, row in enumerate(seen):
        np.testing.assert_array_equal(row[both[0]], plain[max(k - 1, 0)], err_msg=str(k))
        sent = [actions[k - 1 - i] if k > i else np.zeros(5) for i in range(3)]
        np.testing.assert_array_equal(row[columns], np.concatenate(sent))

    played(env, actions, {**drawn, "action_delay": 2.0, "observation_delay": 1.0}, 6)
    state = env.get_state()
    ahead = [env.step(a[None])[0].copy() for a in actions[6:]]
    env.reset(seed=5)
    env.set_state(state)
    np.testing.assert_array_equal([env.step(a[None])[0] for a in actions[6:]], ahead)

    half = played(env, actions, {**drawn, "action_delay": 0.0, "observation_delay": 0.5})[2][both[0]]
    whole = played(env, actions, {**drawn, "action_delay": 0.0, "observation_delay": 0.0})
    np.testing.assert_allclose(half, 0.5 * (whole[1] + whole[2])[both[0]], atol=1e-6)
    env.close()


def test_noise_and_bias_have_their_size_and_repeat() -> None:
    """Noise is new in every step, a bias stays for an episode; what is known exactly has neither; seeds repeat both."""
    env = worlds_of(2, observation_noise_range=(0.0, 1.0), observation_bias_range=(0.0, 1.0))
    zero = np.zeros((2, 5), np.float32)
    where = {name: columns for name, (columns, _) in env.unwrapped.task.segments.items()}

    def far(noise: float, bias: float, seed: int = 3) -> np.ndarray:
        """Return how far off every number is in 40 steps, shape (40, worlds, D)."""
        rows = []
        for sizes in ((noise, bias), (0.0, 0.0)):
            given = dict(zip(NAMES, sizes, strict=True))
            env.reset(seed=seed, options={"position": (0.45, 0.0), "yaw": 0.0, **given})
            rows.append([env.step(zero)[0].copy() for _ in range(40)])
        return np.subtract(*rows)

    noise = far(1.0, 0.0)
    assert np.std(noise[..., where["object_position"]]) == pytest.approx(2e-3, rel=0.2)
    assert np.std(noise[..., where["tool_position"]]) == pytest.approx(1e-3, rel=0.2)
    assert (noise[..., where["goal"]] == 0.0).all() and (noise[..., where["command_lead"]] == 0.0).all()
    np.testing.assert_array_equal(noise, far(1.0, 0.0))
    assert np.std(noise[:, 0] - noise[:, 1]) > 0.5 * np.std(noise)
    bias = far(0.0, 1.0)[..., where["object_points"]]
    assert np.ptp(bias, axis=0).max() < 1e-5 and np.std(bias[0]) == pytest.approx(2e-3, rel=0.3)
    assert not np.allclose(bias, far(0.0, 1.0, seed=4)[..., where["object_points"]], atol=1e-4)
    env.close()


NAMES = ("observation_noise", "observation_bias")


def test_drives_follow_their_parameters() -> None:
    """Half the effort presses with half the force; gain and dry friction are those of MuJoCo's drives; per world."""
    env = worlds_of(2, gain_range=(0.5, 1.0), drive_friction_range=(0.0, 0.1), effort_range=(0.5, 1.0))
    given = {
        "position": (0.45, 0.0),
        "yaw": 0.0,
        "youngs_modulus": 1e6,
        "gain": (1.0, 0.5),
        "drive_friction": (0.0, 0.1),
    }
    env.reset(seed=0, options={**given, "effort": (1.0, 1.0)})
    model = env.unwrapped.task.scene.solver.rigid.mjw_model
    gains, friction = model.actuator_gainprm.numpy()[:, :, 0], model.dof_frictionloss.numpy()
    np.testing.assert_allclose(gains[1], 0.5 * gains[0])
    limits = env.unwrapped.task.scene.model.joint_effort_limit.numpy().reshape(2, -1)
    np.testing.assert_allclose(np.sort(friction[1] - friction[0]), np.sort(0.1 * limits[0]), rtol=1e-5)
    given |= {"gain": (1.0, 1.0), "drive_friction": (0.0, 0.0)}
    env.reset(seed=0, options={**given, "effort": (1.0, 0.5)})
    down, close = (
        np.tile(np.array([0, 0, -1, 0, 1], np.float32), (2, 1)),
        np.tile(np.eye(5, dtype=np.float32)[4] * -1, (2, 1)),
    )
    for _ in range(9):
        env.step(down)
    for _ in range(30):
        *_, infos = env.step(close)
    force = infos["finger_force"].mean(axis=1)
    assert force[1] == pytest.approx(0.5 * force[0], rel=0.1) and force[0] > 20.0
    env.close()


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"action_delay_range": (0.0, 8.0), "max_episode_steps": 8}, "as long as the episode"),
        ({"action_delay_range": (-1.0, 1.0)}, "action_delay_range"),
        ({"observation_noise_range": (1.0, 0.5)}, "observation_noise_range"),
        ({"effort_range": (0.0, 1.0)}, "effort_range"),
    ],
)
def test_disturbances_that_cannot_be_are_refused(fields: dict[str, Any], named: str) -> None:
    """The message names the field, or the episode's length."""
    with pytest.raises(ConfigError, match=named):
        worlds_of(**fields)


def test_the_preset_has_them_all_and_nothing_is_on_without_it() -> None:
    """`sim_to_real` is one of every task; a plain task draws none of them."""
    config = LiftSoftConfig.preset("sim_to_real")
    assert all(getattr(config, name) == limits for name, limits in SIM_TO_REAL.items())
    assert all(getattr(LiftSoftConfig(), name) is None for name in SIM_TO_REAL)
