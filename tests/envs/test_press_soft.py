"""PressSoft: the contact force is the arm's, the scripted policy, the reward's terms, success, options."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.press_soft.task import START_HEIGHT, THICKNESS, PressSoftConfig, PressSoftEnv
from softmode.errors import ConfigError
from softmode.robots import ArmDescription
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv

IDLE = np.zeros(5, np.float32)


@pytest.fixture(scope="module")
def press(make_env: MakeEnv) -> PressSoftEnv:
    """Return the bare environment."""
    env = make_env("PressSoft").unwrapped
    assert isinstance(env, PressSoftEnv)
    return env


def play(env: PressSoftEnv, seed: int, **options: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Play one scripted episode; return the last info and all of them."""
    observation, info = env.reset(seed=seed, options=options)
    policy = scripted_policy(env)
    infos = []
    for _ in range(120):
        action = policy(observation)
        assert env.action_space.contains(action)
        observation, _, terminated, _, info = env.step(action)
        infos.append(info)
        assert not terminated
    return info, infos


def judge(
    env: PressSoftEnv, force: float, *, indentation: float = 2.0e-3, aside: float = 0.0, goal: float = 5.0
) -> Any:
    """Return reward terms and success of a step with given figures."""
    task = env.task
    table = task.table.values.numpy()
    table[:, task.table.columns("goal_force")] = goal
    task.table.values.assign(table)
    task.metrics.assign(np.array([[force, force - goal, indentation, aside]], np.float32))
    task.evaluate()
    return dict(zip(task.term_names, task.terms.numpy()[0].tolist(), strict=True)), bool(task.success.numpy()[0])


# -- physics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("modulus", "goal"), [(2.0e4, 10.0), (2.0e6, 3.0)])
def test_contact_force_is_what_the_drives_push_with(press: PressSoftEnv, modulus: float, goal: float) -> None:
    """At rest J^T f = -tau: the drives' torques k (q_target - q), of a weightless arm, balance the pad's force.

    J by differences of the forward kinematics in float32: (1e-7 m) / (1e-3 rad), so some 1e-3 of f. The scripted policy
    holds the force within 2 % of the goal, the solver without a complaint; success lasts to the end.
    """
    info, infos = play(press, 0, youngs_modulus=modulus, goal_force=goal)
    success = [info["is_success"] for info in infos]
    first = success.index(True)
    assert first >= 14 and all(success[first:])
    assert abs(info["force_error"]) < 0.02 * goal
    assert not any(info["solver_status"] for info in infos)
    scene, arm = press.scene, press.scene.config.arm
    assert isinstance(arm, ArmDescription)
    assert abs(infos[-20]["contact_force"] - info["contact_force"]) < 0.01 * goal  # at rest
    start, count = scene.arm.coord_start, 7
    q, target = (
        a.numpy()[start : start + count].astype(float) for a in (scene.state.joint_q, scene.control.joint_target_q)
    )
    torque = np.array(arm.drive_stiffnesses) * (target - q)
    moved, jacobian = scene.model.state(), np.zeros((3, count))
    for j in range(count):
        ends = []
        for step in (1.0e-3, -1.0e-3):
            values = scene.state.joint_q.numpy().copy()
            values[start + j] += step
            moved.joint_q.assign(values)
            scene.controller.measure(moved)
            ends.append(scene.controller.tool_pose.numpy()[0][:3].astype(float))
        jacobian[:, j] = (ends[0] - ends[1]) / 2.0e-3
    force = -np.linalg.lstsq(jacobian.T, torque, rcond=None)[0]
    assert force[2] == pytest.approx(info["contact_force"], rel=0.02)


def test_softer_pads_give_way_further_but_not_by_half(press: PressSoftEnv) -> None:
    """Indentation grows with the goal force and falls with E; the most asked for stays below half the thickness."""
    depth = {
        (modulus, goal): play(press, 1, youngs_modulus=modulus, goal_force=goal)[0]["indentation"]
        for modulus, goal in ((2.0e4, 10.0), (2.0e4, 5.0), (2.0e5, 10.0))
    }
    assert 0.5 * THICKNESS > depth[2.0e4, 10.0] > depth[2.0e4, 5.0] > depth[2.0e5, 10.0] > 0.0


# -- reward and success -----------------------------------------------------------------------------------------------


def test_terms_are_bounded_and_sum_to_the_reward(press: PressSoftEnv) -> None:
    """The reward is the sum of its terms, each within its bounds, under random actions."""
    random = np.random.default_rng(0)
    press.reset(seed=0)
    for _ in range(60):
        action = random.uniform(-1.0, 1.0, 5) - [0.0, 0.0, 0.7, 0.0, 0.0]
        _, reward, _, _, info = press.step(np.clip(action, -1.0, 1.0))
        terms = info["reward_terms"]
        assert reward == pytest.approx(sum(terms.values()), abs=1e-6)
        assert 0.0 <= terms["reach"] <= 1.0 and 0.0 <= terms["force"] <= 1.5
        assert terms["hold"] in (0.0, 2.0) and -1.0 <= terms["overshoot"] <= 0.0


def test_success_needs_the_force_in_the_middle_for_a_while(press: PressSoftEnv) -> None:
    """Within 10 % (or 0.3 N) of the goal, over the middle, 15 steps in a row; one step aside starts the count anew."""
    press.reset(seed=0)
    for _ in range(14):
        terms, success = judge(press, 5.4)
        assert terms["hold"] == 2.0 and not success
    assert judge(press, 4.6)[1]
    for wrong in ({"force": 5.6}, {"force": 4.4}, {"force": 5.0, "aside": 0.013}, {"force": 2.4, "goal": 2.0}):
        terms, success = judge(press, **wrong)
        assert terms["hold"] == 0.0 and not success
        assert not judge(press, 5.0)[1]
    assert judge(press, 2.29, goal=2.0)[0]["hold"] == 2.0


def test_reward_slopes_towards_the_goal(press: PressSoftEnv) -> None:
    """Nearer to the pad, nearer to the force: always more; far too much force costs."""
    press.reset(seed=0)
    heights = [sum(judge(press, 0.0, indentation=-gap)[0].values()) for gap in (0.02, 0.01, 0.005, 0.0)]
    forces = [sum(judge(press, force)[0].values()) for force in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)]
    assert np.all(np.diff(heights) > 0.01) and np.all(np.diff(forces) > 0.01)
    falling = [sum(judge(press, force)[0].values()) for force in (5.0, 6.0, 8.0, 11.0)]
    assert np.all(np.diff(falling) < -0.1)
    assert judge(press, 20.0)[0]["overshoot"] == -1.0


def test_nothing_done_is_no_success(press: PressSoftEnv) -> None:
    """An idle arm feels nothing."""
    press.reset(seed=0)
    for _ in range(20):
        *_, info = press.step(IDLE)
        assert info["contact_force"] == 0.0 and not info["is_success"]


# -- observation and options ------------------------------------------------------------------------------------------


def test_stiffness_is_not_observed(press: PressSoftEnv) -> None:
    """The pad's stiffness is in no column."""
    soft, stiff = (press.reset(seed=3, options={"youngs_modulus": e})[0] for e in (2.0e4, 2.0e6))
    np.testing.assert_array_equal(soft, stiff)


def test_fingers_stay_closed_over_the_pad(press: PressSoftEnv) -> None:
    """The arm starts closed, `START_HEIGHT` over the pad, and an opening action moves nothing to speak of."""
    observation, info = press.reset(seed=0)
    opening = press.task.segments["opening"][0]
    assert info["indentation"] == pytest.approx(-START_HEIGHT, abs=1e-3) and abs(observation[opening][0]) < 1e-4
    for _ in range(30):
        observation, *_ = press.step(np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32))
    assert abs(observation[opening][0]) < 1e-3


def test_the_tool_cannot_crush_the_pad(press: PressSoftEnv) -> None:
    """Pushed down all the time, the tips stay above half the thickness of the softest pad; nothing diverges."""
    press.reset(seed=0, options={"youngs_modulus": 2.0e4, "position": press.config.scene.object_position})
    for _ in range(80):
        *_, terminated, _, info = press.step(np.array([0.0, 0.0, -1.0, 0.0, 0.0], np.float32))
        assert not terminated
    assert 10.0 < info["contact_force"] < 100.0 and 0.3 * THICKNESS < info["indentation"] < 0.51 * THICKNESS


@pytest.mark.parametrize(
    "given",
    [
        {"force_range": (0.0, 5.0)},
        {"force_range": (5.0, 2.0)},
        {"force_tolerance": 0.0},
        {"least_tolerance": 3.0},
        {"centre_tolerance": 0.0},
        {"hold_steps": 0},
    ],
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        PressSoftConfig(**given)


def test_a_pad_must_not_reach_the_fingers(press: PressSoftEnv) -> None:
    """Too large a scale is refused, in the configuration and as a reset option."""
    with pytest.raises(ConfigError, match="finger tips"):
        PressSoftEnv(config=PressSoftConfig(scale_range=(0.8, 1.6)))
    with pytest.raises(ConfigError, match="scale"):
        press.reset(options={"scale": 1.5})
    assert play(press, 0, scale=1.3)[0]["is_success"]


@pytest.mark.slow
@pytest.mark.episodes(20)
def test_scripted_policy_succeeds_on_twenty_of_twenty_seeds(soft_env: MakeEnv, episode: Episodes) -> None:
    """20 of 20 seeds with random stiffness, place and force."""
    assert_success(episode(soft_env("softmode/PressSoft-v0")))


def test_fields_are_keywords_and_success_alone_can_be_paid(soft_env: MakeEnv) -> None:
    """`gym.make` takes fields of the configuration; what it does not know is said, with the nearest names.

    Sparse pays 1 while the task counts as solved, as `success` and `is_success` say, and keeps the terms in the infos.
    """
    env = soft_env("softmode/PressSoft-v0", reward_mode="sparse", image_size=64, youngs_modulus_range=(1.0e5, 1.0e5))
    bare: Any = env.unwrapped
    assert bare.config == PressSoftConfig(reward_mode="sparse", image_size=64, youngs_modulus_range=(1.0e5, 1.0e5))
    with pytest.raises(ConfigError, match="before the first reset"):
        bare.step(IDLE)
    observation, info = env.reset(seed=0)
    assert info["parameters"]["youngs_modulus"] == pytest.approx(1.0e5)
    policy, paid = scripted_policy(bare), []
    for _ in range(120):
        observation, reward, _, _, info = env.step(policy(observation))
        assert reward == info["is_success"] == info["success"]
        paid.append((reward, sum(info["reward_terms"].values())))
    assert paid[0][0] == 0.0 and paid[-1][0] == 1.0 and all(dense > 0.0 for _, dense in paid[-10:])
    with pytest.raises(ConfigError, match=r"unexpected keyword argument 'image_sise'.*Nearest: image_size"):
        gym.make("softmode/PressSoft-v0", image_sise=64)
    with pytest.raises(ConfigError, match="reward_mode is 'shaped'"):
        gym.make("softmode/PressSoft-v0", reward_mode="shaped")
