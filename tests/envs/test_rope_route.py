"""RopeRoute: the rope is one, friction is Coulomb's, winding, reward, success, options, and the scripted policy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.rope_route.scripted import ScriptedRope
from softmode.envs.tasks.rope_route.task import (
    GRASP,
    LENGTH,
    PEG_SIZE,
    RopeRouteConfig,
    RopeRouteEnv,
    pegs_at,
    rope_scene,
)
from softmode.errors import ConfigError
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv

ENV_ID = "softmode/RopeRoute-v0"


@pytest.fixture(scope="module")
def rope(make_env: MakeEnv) -> RopeRouteEnv:
    """Return the bare environment."""
    env = make_env("RopeRoute").unwrapped
    assert isinstance(env, RopeRouteEnv)
    return env


def lay(env: RopeRouteEnv, x: float, y: float, turn: float = 0.5 * np.pi, height: float = 0.009) -> None:
    """Lay the rope straight, its middle at (x, y), its end in the direction `turn` from x, and observe it."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    env.scene.state.softmode.q.assign(env.scene.soft.body.affine(rotation, (x, y, height)))
    env.task.write_observation()


def seen(env: RopeRouteEnv, name: str) -> np.ndarray:
    """Return a segment of the observation."""
    return env.task.observation.numpy()[0, env.task.segments[name][0]].astype(float)


def judge(env: RopeRouteEnv, winding: tuple[float, float], distance: float = 0.01, top: float = 0.02) -> Any:
    """Return reward terms and success of a step with given figures."""
    task = env.task
    observation = task.observation.numpy().copy()
    observation[0, task.segments["winding"][0]] = winding
    task.observation.assign(observation)
    task.metrics.assign(np.array([[distance, min(winding), top, 0.0]], np.float32))
    task.evaluate()
    return dict(zip(task.term_names, task.terms.numpy()[0].tolist(), strict=True)), bool(task.success.numpy()[0])


# -- physics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("route", "modulus"), [(-1.0, 6.0e5), (1.0, 1.5e5)])
def test_scripted_policy_leads_the_rope_around_the_pegs(rope: RopeRouteEnv, route: float, modulus: float) -> None:
    """Both routes succeed and last; the rope keeps its length, and nothing sinks in by more than 1.1 mm.

    Friction alone pulls on the axis, some 0.3 N: f / (E A) = 0.3 N / (1.5e5 Pa 2e-4 m^2) = 1 %. The table's 1.5 mm are
    for a soft rope that is squeezed just above it. The reward, the sum of its terms, each within its bounds, grows from
    stage to stage.
    """
    bounds = {"reach": (0.0, 1.0), "grasp": (0.0, 0.5), "route": (-2.0, 2.0), "goal": (0.0, 2.0), "hold": (0.0, 2.0)}
    observation, info = rope.reset(seed=1, options={"route": route, "youngs_modulus": modulus})
    policy, depth, floor, success, rewards = scripted_policy(rope), 0.0, 0.0, [], []
    soft = rope.scene.soft.body
    for _ in range(130):
        observation, reward, terminated, _, info = rope.step(policy(observation))
        assert not terminated and not info["solver_status"]
        success.append(info["is_success"])
        terms = info["reward_terms"]
        assert reward == pytest.approx(sum(terms.values()), abs=1e-5)
        assert all(low <= terms[name] <= high for name, (low, high) in bounds.items())
        rewards.append(reward)
        points = rope.scene.state.particle_q.numpy()[: soft.surface_count].astype(float)
        low = points[points[:, 2] < PEG_SIZE[1]]
        for peg in rope.config.pegs:
            depth = max(depth, PEG_SIZE[0] - np.linalg.norm(low[:, :2] - peg.position[:2], axis=1).min())
        floor = max(floor, -points[:, 2].min())
    assert success[-1] and all(success[success.index(True) :])
    assert rewards[0] < rewards[35] < rewards[60] < rewards[75] < rewards[-1] and rewards[-1] > 7.0
    assert depth < 1.1e-3 and floor < 1.5e-3
    axis = rope.task.axis.numpy()[0].astype(float)
    assert np.linalg.norm(np.diff(axis, axis=0), axis=1).sum() == pytest.approx(LENGTH, rel=0.03)
    assert (seen(rope, "winding") > rope.config.winding).all() and info["goal_distance"] < 0.002


def test_dragging_the_rope_takes_mu_times_its_weight(rope: RopeRouteEnv) -> None:
    """Pulled along the table at constant speed: f_t = mu (m g - f_z), with mu = sqrt(mu_rope mu_table).

    Whether the fingers carry the rope's end or press it onto the table is decided by half a millimetre at the start.
    """
    rope.reset(seed=0, options={"position": (0.36, -0.15), "yaw": 0.0, "youngs_modulus": 6.0e5})
    policy = ScriptedRope(rope)
    while policy._phase != "lead":
        rope.step(policy())
    scene, forces = rope.scene, []
    for step in range(45):
        lift = 0.05 if step < 8 else 0.0
        rope.step(np.array([0.0, 0.25, lift, 0.0, policy._grip], np.float32))
        if step >= 20:
            forces.append(scene.finger_force.numpy()[0].sum(axis=0).astype(float))
    sideways, along, down = np.mean(forces, axis=0)
    weight = scene.config.material.density * scene.soft.body.volume * 9.81
    mu = np.sqrt(scene.config.material.friction * scene.config.table_friction)
    assert abs(sideways) < 0.2 * weight
    assert -along == pytest.approx(mu * (weight + down), rel=0.1)


# -- winding, reward, success -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("x", "y", "turn"), [(0.50, 0.0, 0.5 * np.pi), (0.38, 0.05, 1.7), (0.45, -0.30, 1.4)])
def test_winding_is_the_angle_that_the_rope_sweeps(rope: RopeRouteEnv, x: float, y: float, turn: float) -> None:
    """A straight rope sweeps the angle between its ends as seen from the peg, positive beyond it from the robot."""
    rope.reset(seed=0, options={"route": 1.0})
    lay(rope, x, y, turn)
    direction = np.array([np.cos(turn), np.sin(turn)])
    tail, end = (np.array([x, y]) + sign * 0.5 * LENGTH * direction for sign in (-1.0, 1.0))
    for peg, side, found in zip(rope.config.pegs, (1.0, -1.0), seen(rope, "winding"), strict=True):
        a, b = tail - peg.position[:2], end - peg.position[:2]
        angle = np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
        assert found == pytest.approx(side * angle, abs=1e-3)
    np.testing.assert_array_equal(seen(rope, "side"), [1.0, -1.0])


def test_observation_names_grasp_end_and_goal(rope: RopeRouteEnv) -> None:
    """`grasp_offset`, `end_offset` and `end_goal` add up to the goal from the tool, beside the last peg."""
    rope.reset(seed=3, options={"route": -1.0, "goal": (0.03, 0.08), "yaw": 0.1, "position": (0.44, -0.11)})
    np.testing.assert_allclose(seen(rope, "goal"), np.add(rope.config.pegs[-1].position[:2], (0.03, 0.08)), atol=1e-6)
    total = seen(rope, "grasp_offset")[:2] + seen(rope, "end_offset")[:2] + seen(rope, "end_goal")
    np.testing.assert_allclose(total, seen(rope, "goal_offset"), atol=1e-5)
    end = seen(rope, "tool_position")[:2] + seen(rope, "goal_offset") - seen(rope, "end_goal")
    np.testing.assert_allclose(end, (0.44, -0.11), atol=1e-4)
    assert np.linalg.norm(seen(rope, "end_offset")) == pytest.approx(GRASP, abs=0.5 * LENGTH / 24)


def test_success_needs_both_sides_the_goal_and_a_low_rope(rope: RopeRouteEnv) -> None:
    """Ten steps in a row, both pegs passed on their side, end at the goal, rope below the pegs' top."""
    rope.reset(seed=0)
    for _ in range(9):
        terms, success = judge(rope, (2.5, 2.1))
        assert terms["hold"] == 2.0 and not success
    assert judge(rope, (2.5, 2.1))[1]
    wrong: tuple[dict[str, Any], ...] = (
        {"winding": (2.5, 1.9)},
        {"winding": (-2.5, 2.5)},
        {"winding": (2.5, 2.5), "distance": 0.03},
        {"winding": (2.5, 2.5), "top": 0.05},
    )
    for given in wrong:
        terms, success = judge(rope, **given)
        assert terms["hold"] == 0.0 and not success
        assert not judge(rope, (2.5, 2.5))[1]


def test_a_straight_rope_passes_only_one_side(rope: RopeRouteEnv) -> None:
    """Beside both pegs on one side, the end at the goal, it is no success: the sides alternate."""
    rope.reset(seed=0, options={"route": 1.0, "goal": (0.04, 0.09)})
    lay(rope, 0.41, 0.02)
    for _ in range(12):
        rope.task.evaluate()
    assert rope.task.metrics.numpy()[0, 0] < rope.config.goal_tolerance
    winding = seen(rope, "winding")
    assert winding[0] < -2.0 and winding[1] > 2.0 and not rope.task.success.numpy()[0]


# -- options ----------------------------------------------------------------------------------------------------------


def test_one_peg_is_a_preset() -> None:
    """The preset has one peg; the scripted policy plays it."""
    env = RopeRouteEnv(config=RopeRouteConfig.preset("one_peg"))
    assert len(env.config.pegs) == 1 and seen(env, "winding").shape == (1,)
    env.reset(seed=0, options={"route": 1.0})
    policy, won = scripted_policy(env), False
    for _ in range(110):
        won |= env.step(policy())[-1]["is_success"]
        if won:
            break
    assert won


@pytest.mark.parametrize(
    "given",
    [
        {"goal_aside": (0.1, 0.0)},
        {"goal_beyond": (0.0, 0.5)},
        {"goal_tolerance": 0.0},
        {"winding": 3.2},
        {"hold_steps": 0},
    ],
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        RopeRouteConfig(**given)


def test_pegs_are_needed() -> None:
    """A scene without a cylinder is refused."""
    with pytest.raises(ConfigError, match="cylinder"):
        RopeRouteConfig(scene=replace(rope_scene(), fixtures=()))
    assert [
        peg.position[0] for peg in RopeRouteConfig(scene=replace(rope_scene(), fixtures=pegs_at(((0.5, 0.0),)))).pegs
    ] == [0.5]


# -- seeds and vectors ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.episodes(20)
def test_scripted_policy_succeeds_on_twenty_of_twenty_seeds(soft_env: MakeEnv, episode: Episodes) -> None:
    """20 of 20 seeds with random stiffness, place, route and goal."""
    assert_success(episode(soft_env("softmode/RopeRoute-v0")))


@pytest.mark.rest
def test_a_world_of_several_is_the_single_one(rope: RopeRouteEnv) -> None:
    """World 1 of 2 returns the bits of a single environment with its seed, as in other tests, fingers on the rope."""
    envs = gym.make_vec(ENV_ID, num_envs=2)
    many, _ = envs.reset(seed=[4, 9])
    single, _ = rope.reset(seed=9)
    np.testing.assert_array_equal(many[1], single)
    policy, touched = ScriptedRope(rope), 0.0
    for _ in range(55):
        action = policy(single)
        many, rewards, *_ = envs.step(np.stack([-action, action]))
        single, reward, _, _, info = rope.step(action)
        assert data_equivalence(many[1], single, exact=True) and rewards[1] == np.float32(reward)
        touched = max(touched, float(info["finger_force"].min()))
    assert touched > 1.0
    envs.close()
