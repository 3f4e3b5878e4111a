"""PushSoft: observation, reward and success in constructed states, forces of pushing, scripted pushes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.push_soft.task import PushSoftConfig, PushSoftEnv, push_scene
from softmode.errors import ConfigError
from softmode.objects import ObjectConfig
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv

IDLE = np.zeros(5, np.float32)


@pytest.fixture(scope="module")
def push(make_env: MakeEnv) -> PushSoftEnv:
    """Return the default environment."""
    env = make_env("PushSoft").unwrapped
    assert isinstance(env, PushSoftEnv)
    return env


def seen(env: PushSoftEnv, observation: np.ndarray, segment: str) -> np.ndarray:
    """Return a segment of an observation."""
    return observation[env.task.segments[segment][0]]


def put(env: PushSoftEnv, place: tuple[float, float], yaw: float = 0.0) -> None:
    """Put the object somewhere without starting an episode."""
    env.scene.reset(position=np.array([place]), yaw=np.array([yaw]))


def play(env: PushSoftEnv, seed: int, limit: int = 120, **options: Any) -> dict[str, Any]:
    """Play an episode with the scripted policy and return its last info."""
    observation, info = env.reset(seed=seed, options=options)
    policy = scripted_policy(env)
    for _ in range(limit):
        action = policy(observation)
        assert np.abs(action).max() <= 1.0
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            break
    return info


def test_observation_says_where_to_go(push: PushSoftEnv) -> None:
    """The goal lies at the drawn distance and direction; what is relative is relative, and yaw is measured."""
    given = {"position": (0.42, 0.01), "yaw": 0.7, "goal": (0.12, 0.5), "goal_yaw": 0.3}
    observation, info = push.reset(seed=0, options=given)
    goal = np.array([0.42 + 0.12 * np.cos(0.5), 0.01 + 0.12 * np.sin(0.5)])
    tool, centre = seen(push, observation, "tool_position"), seen(push, observation, "object_position")
    np.testing.assert_allclose(seen(push, observation, "goal"), goal, atol=1e-6)
    np.testing.assert_allclose(seen(push, observation, "goal_heading"), [np.cos(1.0), np.sin(1.0)], atol=1e-6)
    np.testing.assert_allclose(seen(push, observation, "goal_offset"), goal - tool[:2], atol=1e-6)
    np.testing.assert_allclose(seen(push, observation, "object_goal"), goal - centre[:2], atol=1e-6)
    np.testing.assert_allclose(seen(push, observation, "object_heading"), [np.cos(0.3), -np.sin(0.3)], atol=1e-5)
    towards = (goal - centre[:2]) / np.linalg.norm(goal - centre[:2])
    behind = np.array([*(centre[:2] - push.task.push_distance * towards), push.task.push_height])
    np.testing.assert_allclose(seen(push, observation, "push_offset"), behind - tool, atol=1e-6)
    assert info["goal_distance"] == pytest.approx(0.12, abs=1e-3) and info["yaw_error"] == pytest.approx(0.3, abs=1e-5)
    ahead = push.task.layout.agent_size
    assert (
        push.task.layout.column("object_position") == ahead and push.task.layout.column("goal") < ahead
    )  # pixels see no object


def test_goals_stay_within_their_range(push: PushSoftEnv) -> None:
    """Distance and direction use their ranges; no goal leaves the workspace by more than the object's radius."""
    goals = []
    for seed in range(30):
        observation, info = push.reset(seed=seed)
        goals.append(info["parameters"]["goal"])
        x, y = seen(push, observation, "goal")
        assert 0.25 < x < 0.70 and abs(y) < 0.30
    low, high = np.transpose((push.config.goal_distance, push.config.goal_direction))
    share = (np.array(goals) - low) / (high - low)
    assert share.min() > -1e-6 and share.max() < 1.0 + 1e-6 and np.ptp(share, axis=0).min() > 0.8


def test_reward_is_the_sum_of_its_terms(push: PushSoftEnv) -> None:
    """The reward equals the sum of its terms, each within its bounds; an idle arm is only rewarded for being near."""
    push.reset(seed=3)
    random = np.random.default_rng(0)
    for k in range(12):
        action = IDLE if k < 3 else random.uniform(-1.0, 1.0, 5).astype(np.float32)
        _, reward, _, _, info = push.step(action)
        terms = info["reward_terms"]
        assert reward == pytest.approx(sum(terms.values()), rel=1e-6)
        assert tuple(terms) == push.task.term_names
        assert 0.0 < terms["reach"] <= 0.5 and -1.0 <= terms["progress"] <= 1.0 and 0.0 < terms["goal"] <= 1.0
        assert terms["rest"] == 0.0
        assert info["is_success"] is False
        if k < 3:
            assert abs(terms["progress"]) < 1e-3


def test_success_needs_rest_at_the_goal(push: PushSoftEnv) -> None:
    """Put at the goal, the object counts after `hold_steps` steps, not before; outside the tolerance never."""
    given = {"position": (0.42, 0.0), "goal": (0.15, 0.0)}
    for offset, inside in ((0.018, True), (0.023, False)):
        push.reset(seed=0, options=given)
        put(push, (0.57 - offset, 0.0))
        won = []
        for _ in range(push.config.hold_steps + 3):
            info = push.step(IDLE)[-1]
            won.append(info["is_success"])
        assert info["goal_distance"] == pytest.approx(offset, abs=1e-3)
        assert won[-1] == inside
        assert won.index(True) >= push.config.hold_steps - 1 if inside else not any(won)


def test_a_moving_object_has_not_arrived(push: PushSoftEnv) -> None:
    """Crossing the goal at 0.3 m/s earns no `rest`; friction stops it after v^2 / (2 mu g) = 11 mm.

    Implicit Euler, which moves with the speed at the end of a step, stops half a step's way earlier: v dt / 2.
    """
    push.reset(seed=0, options={"position": (0.42, 0.0), "goal": (0.15, 0.0), "youngs_modulus": 1.0e6})
    put(push, (0.565, 0.0))
    for _ in range(2):
        push.step(IDLE)
    speed, data = 0.3, push.scene.state.softmode
    before = push.scene.object_position.numpy()[0, 0, 0]
    translation = push.scene.soft.body.linear_coordinates[:, 3]
    data.qd.assign(np.outer(translation, [speed, 0.0, 0.0]))
    info = push.step(IDLE)[-1]
    assert info["goal_distance"] < push.config.goal_tolerance and info["reward_terms"]["rest"] == 0.0
    for _ in range(8):
        info = push.step(IDLE)[-1]
    way = push.scene.object_position.numpy()[0, 0, 0] - before
    assert way == pytest.approx(speed**2 / (2.0 * 0.4 * 9.81) - 0.5 * speed * push.scene.dt, rel=0.02)
    assert info["reward_terms"]["rest"] == 2.0


def test_pushing_takes_the_force_of_friction(push: PushSoftEnv) -> None:
    """Pushed steadily, the object follows the tool; the push is mu (m g - what the fingers carry)."""
    push.reset(seed=0, options={"position": (0.42, 0.0), "goal": (0.15, 0.0), "youngs_modulus": 1.0e5})
    forward = np.array([0.3, 0.0, 0.0, 0.0, 0.0], np.float32)
    force, speed = [], []
    for _ in range(60):
        push.step(forward)
        force.append(push.scene.finger_force.numpy()[0].sum(axis=0))
        speed.append(push.scene.object_velocity.numpy()[0, 0, 0])
    on_fingers = np.mean(force[40:], axis=0)
    weight = push.scene.soft.body.volume * push.config.scene.material.density * 9.81
    assert -on_fingers[0] == pytest.approx(0.4 * (weight + on_fingers[2]), rel=0.02)
    control = push.config.scene
    assert np.mean(speed[40:]) == pytest.approx(0.3 * control.control.translation_scale * control.control_hz, rel=0.02)


def test_yaw_counts_where_it_is_asked_for() -> None:
    """With `yaw_tolerance` a box at the goal but turned too far is not there; `goal` pays less for it.

    The environment is another one: what is turned shows on a box, and the tolerance is configured.
    """
    box = ObjectConfig(
        shape="box", extents=(0.06, 0.05, 0.04), surface_count=80, build=BuildOptions(mode_count=3, cubature_count=48)
    )
    config = PushSoftConfig(scene=replace(push_scene(), object=box), yaw_tolerance=0.35, goal_yaw=(-1.0, 1.0))
    env = PushSoftEnv(config=config)
    rewards = []
    for turn, inside in ((0.3, True), (0.4, False)):
        env.reset(seed=0, options={"position": (0.42, 0.0), "yaw": 0.2, "goal": (0.15, 0.0), "goal_yaw": 0.8})
        put(env, (0.57, 0.0), yaw=1.0 + turn)
        for _ in range(config.hold_steps + 1):
            info = env.step(IDLE)[-1]
        assert info["yaw_error"] == pytest.approx(turn, abs=5e-3)
        assert info["is_success"] is inside
        rewards.append(info["reward_terms"]["goal"])
    assert rewards[0] / rewards[1] == pytest.approx((1.0 + np.cos(0.3)) / (1.0 + np.cos(0.4)), rel=0.01)


@pytest.mark.parametrize(("seed", "modulus"), [(0, 2.0e4), (8, 2.0e6)])
def test_script_pushes_soft_and_stiff_objects(push: PushSoftEnv, seed: int, modulus: float) -> None:
    """The object ends at rest within 1 cm of the goal, nothing to complain about."""
    info = play(push, seed, youngs_modulus=modulus)
    assert info["is_success"] and info["goal_distance"] < 0.01
    assert info.get("solver_reasons", ()) == ()


def test_script_goes_around(push: PushSoftEnv) -> None:
    """A goal on the robot's side: the tool goes over the object and pulls it back."""
    assert play(push, 0, position=(0.48, 0.0), goal=(0.10, 3.0))["is_success"]


@pytest.mark.slow
@pytest.mark.episodes(20)
@pytest.mark.parametrize("directions", [(-1.0, 1.0), (-np.pi, np.pi)])
def test_script_succeeds_on_twenty_of_twenty_seeds(
    soft_env: MakeEnv, episode: Episodes, directions: tuple[float, float]
) -> None:
    """20 of 20 seeds with random stiffness, place and goal."""
    assert_success(episode(soft_env("softmode/PushSoft-v0", goal_direction=directions)))


@pytest.mark.parametrize(
    "given",
    [
        {"goal_distance": (0.2, 0.1)},
        {"goal_direction": (-4.0, 1.0)},
        {"goal_yaw": (1.0, -1.0)},
        {"goal_tolerance": 0.0},
        {"yaw_tolerance": -0.1},
        {"rest_speed": 0.0},
        {"hold_steps": 0},
    ],
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        PushSoftConfig(**given)
