"""ShapeSoft: recorded targets, goals and rewards that learners compute again, the clamp, scripted bends, worlds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import warp as wp

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.shape_soft.config import POST, ShapeSoftConfig, shape_scene
from softmode.envs.tasks.shape_soft.targets import record_press
from softmode.envs.tasks.shape_soft.task import ShapeSoftEnv, ShapeSoftVectorEnv
from softmode.errors import ConfigError
from softmode.mpm import Grid, MassLoss, ParticleBody
from softmode.objects import ObjectConfig
from softmode.scenes.table_scene import GAP
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv

ENV_ID = "softmode/ShapeSoft-v0"
IDLE = np.array([0.0, 0.0, 0.0, 0.0, 2.0 * 0.08 / 0.09 - 1.0], np.float32)


@pytest.fixture(scope="module")
def shape(make_env: MakeEnv) -> ShapeSoftEnv:
    """Return the default environment."""
    env = make_env("ShapeSoft").unwrapped
    assert isinstance(env, ShapeSoftEnv)
    return env


def points(goal: np.ndarray) -> np.ndarray:
    """Return a goal as points [m], shape (12, 3)."""
    return goal.reshape(-1, 3).astype(float)


def turned(x: np.ndarray, angle: float) -> np.ndarray:
    """Rotate points about z."""
    c, s = np.cos(angle), np.sin(angle)
    return x @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def play(env: ShapeSoftEnv, seed: int, **options: Any) -> dict[str, Any]:
    """Play an episode with the scripted policy and return its last info."""
    observation, info = env.reset(seed=seed, options=options)
    policy = scripted_policy(env)
    for _ in range(100):
        action = policy(observation)
        assert np.abs(action).max() <= 1.0
        observation, reward, terminated, _, info = env.step(action)
        assert not terminated
        assert reward == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
    return info


# -- goals ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("obs_type", ["pixels_agent_pos", pytest.param("pixels", marks=pytest.mark.rest)])
def test_pictures_have_no_goals(make_env: MakeEnv, obs_type: str) -> None:
    """Stable-Baselines3's checker takes an environment of pictures for what it is: one without goals."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = make_env("ShapeSoft", obs_type).unwrapped
    checker.check_env(env, warn=True, skip_render_check=True)
    assert not hasattr(env, "compute_reward")


def test_goals_are_surface_points_seen_from_the_foot(shape: ShapeSoftEnv) -> None:
    """`achieved_goal` are the samples relative to the foot; a target of no displacement is the post at rest."""
    given = {"position": (0.455, -0.005), "yaw": 0.9, "goal": (0.0, 0.4)}
    observation, info = shape.reset(seed=0, options=given)
    samples = shape.scene.state.particle_q.numpy()[shape.task.points]
    np.testing.assert_allclose(points(observation["achieved_goal"]), samples - [0.455, -0.005, 0.0], atol=1e-6)
    rest = turned(shape.scene.soft.body.surface.points[shape.task.points], 0.9)
    rest[:, 2] += shape.scene.soft.height
    # between two of 24 directions a point of radius r is off its circle by r (1 - cos(pi / 24))
    np.testing.assert_allclose(points(observation["desired_goal"]), rest, atol=0.015 * (1 - np.cos(np.pi / 24)) + 3e-4)
    assert info["shape_error"] < 5e-4
    assert shape.observation_space.contains(observation)


def test_observation_does_not_depend_on_the_goal(shape: ShapeSoftEnv) -> None:
    """Goals can be exchanged afterwards: `observation` and `achieved_goal` know nothing of the target."""
    given = {"position": (0.45, 0.0), "yaw": 0.0, "youngs_modulus": 2e5}
    first, _ = shape.reset(seed=0, options={**given, "goal": (0.03, 0.0)})
    second, _ = shape.reset(seed=0, options={**given, "goal": (0.05, 2.0)})
    np.testing.assert_array_equal(first["observation"], second["observation"])
    np.testing.assert_array_equal(first["achieved_goal"], second["achieved_goal"])
    assert np.abs(first["desired_goal"] - second["desired_goal"]).max() > 0.02


def test_targets_turn_with_their_direction(shape: ShapeSoftEnv) -> None:
    """Turning post and direction together turns the target; its free end moves as far as was asked for."""
    body = shape.scene.soft.body
    top = np.argmax(body.surface.points[shape.task.points, 2])
    for displacement in (0.03, 0.05):
        goals = []
        for angle in (0.0, 1.0):
            given = {"yaw": 0.3 + angle, "goal": (displacement, 0.5 + angle)}
            goals.append(points(shape.reset(seed=0, options=given)[0]["desired_goal"]))
        np.testing.assert_allclose(goals[1], turned(goals[0], 1.0), atol=1e-6)
        rest = points(shape.reset(seed=0, options={"yaw": 0.3, "goal": (0.0, 0.5)})[0]["desired_goal"])
        moved = goals[0][top] - rest[top]
        # a point beside the axis of the top moves a little less or more, as the top tilts
        assert np.hypot(*moved[:2]) == pytest.approx(displacement, abs=0.25 * displacement)
        assert np.arctan2(moved[1], moved[0]) == pytest.approx(0.5, abs=0.1)


def test_targets_are_shapes_that_the_arm_made(shape: ShapeSoftEnv) -> None:
    """The recorded press, played again at another stiffness, passes within 1.5 mm of its own target."""
    shape.reset(seed=0, options={"position": (0.45, 0.0), "yaw": 0.0, "goal": (0.05, np.pi / 2), "youngs_modulus": 4e5})
    errors = []
    action = IDLE.copy()
    action[1] = 0.1
    for _ in range(60):
        errors.append(shape.step(action)[-1]["shape_error"])
    assert min(errors) < 1.5e-3 and errors[0] > 0.01


def test_a_press_that_cannot_reach_is_refused(shape: ShapeSoftEnv) -> None:
    """A displacement that the workspace does not allow raises, and names the remedy."""
    with pytest.raises(ConfigError, match="goal_displacement"):
        record_press(shape.scene, 0.3)


# -- reward -----------------------------------------------------------------------------------------------------------


def test_reward_is_the_sum_of_its_terms(shape: ShapeSoftEnv) -> None:
    """1 - tanh(e / L) + [e <= tolerance], e the rms distance of the points."""
    shape.reset(seed=1)
    shape.action_space.seed(1)
    config = shape.config
    for _ in range(5):
        observation, reward, _, _, info = shape.step(shape.action_space.sample())
        apart = points(observation["achieved_goal"]) - points(observation["desired_goal"])
        error = np.sqrt((apart**2).sum(axis=1).mean())
        terms = info["reward_terms"]
        assert info["shape_error"] == pytest.approx(error, rel=1e-5)
        assert terms["shape"] == pytest.approx(1.0 - np.tanh(error / config.reward_length), rel=1e-4)
        assert terms["there"] == float(error <= config.goal_tolerance)
        assert reward == pytest.approx(sum(terms.values()), rel=1e-6)


def test_reward_is_computed_again_for_any_goals(shape: ShapeSoftEnv) -> None:
    """Any leading shape, either precision, arrays or tensors; achieving the goal earns 2; bad shapes are refused."""
    random = np.random.default_rng(0)
    achieved, desired = random.uniform(0.0, 0.05, (2, 3, 4, 36))
    rewards = shape.compute_reward(achieved, desired, None)
    assert rewards.shape == (3, 4) and rewards.dtype == np.float32
    assert rewards[1, 2] == shape.compute_reward(achieved[1, 2].astype(np.float32), desired[1, 2], {})
    np.testing.assert_array_equal(shape.compute_reward(desired, desired), np.full((3, 4), 2.0))
    assert (
        not shape.compute_terminated(achieved, desired).any() and not shape.compute_truncated(achieved, desired).any()
    )
    assert shape.compute_terminated(achieved[0, 0], desired[0, 0], {"end_reason": 2}) is True
    ends = shape.compute_terminated(achieved[0, :2], desired[0, :2], [{"end_reason": 1}, {"end_reason": 3}])
    assert ends.tolist() == [False, True]
    with pytest.raises(ConfigError, match="shape"):
        shape.compute_reward(achieved[..., :30], desired[..., :30])
    torch = pytest.importorskip("torch")
    tensors = shape.compute_reward(torch.tensor(achieved), torch.tensor(desired))
    np.testing.assert_array_equal(tensors.numpy(), rewards)


def test_sparse_reward() -> None:
    """-1 away from the target and 0 at it."""
    env = ShapeSoftEnv(config=ShapeSoftConfig(reward_mode="sparse"))
    env.reset(seed=0)
    observation, reward, _, _, info = env.step(IDLE)
    assert reward == -1.0 == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
    env.reset(seed=0, options={"goal": (0.0, 0.0)})
    assert env.step(IDLE)[1] == 0.0


def test_success_takes_holding_still(shape: ShapeSoftEnv) -> None:
    """At the target from the first step on, success comes after `hold_steps` steps; a far target gives none."""
    for displacement, expected in ((0.0, True), (0.03, False)):
        shape.reset(seed=0, options={"goal": (displacement, 0.0)})
        won = [shape.step(IDLE)[-1]["is_success"] for _ in range(shape.config.hold_steps + 2)]
        assert won[-1] is expected
        assert (won.index(True) == shape.config.hold_steps - 1) if expected else not any(won)


@pytest.fixture(scope="module")
def square() -> ShapeSoftEnv:
    """Return an environment of masses, whose targets a square post made, with the round one at the table."""
    made = replace(POST, shape="box", extents=(0.024, 0.024, 0.12))
    return ShapeSoftEnv(config=ShapeSoftConfig(reward_mode="log_mass", goal_object=made))


def test_log_mass_is_the_distance_of_masses(shape: ShapeSoftEnv, square: ShapeSoftEnv) -> None:
    """The error is sqrt(L / L_0) of MassLoss on a grid through the foot, L_0 that of nothing; order does not matter."""
    env, config = square, square.config
    observation, info = env.reset(seed=2)
    random = np.random.default_rng(1)
    achieved, desired = points(observation["achieved_goal"]), points(observation["desired_goal"])
    h = config.log_mass_spacing
    grid = Grid(shape=(21, 21, 21), spacing=h, origin=(-10 * h, -10 * h, -10 * h))
    one = np.ones(12)
    loss = MassLoss(grid, ParticleBody(positions=desired, masses=one), mass_scale=0.1, dtype=wp.float64, device="cpu")
    nothing = 0.5 * (np.log(loss.target_mass.numpy() / 0.1 + 1.0) ** 2).sum()
    error = np.sqrt(loss.value_and_gradient(achieved, one)[0] / nothing)
    assert info["shape_error"] == pytest.approx(error, rel=1e-4) and error > 0.2
    shuffled = random.permutation(achieved).ravel()
    reward = env.compute_reward(achieved.ravel(), desired.ravel())
    assert reward == pytest.approx(1.0 - np.tanh(error / config.log_mass_length), rel=1e-4)
    assert env.compute_reward(shuffled, desired.ravel()) == pytest.approx(reward, rel=1e-5)
    assert shape.compute_reward(shuffled, desired.ravel()) < 0.5 * shape.compute_reward(
        achieved.ravel(), desired.ravel()
    )
    assert env.compute_reward(random.permutation(desired).ravel(), desired.ravel()) == pytest.approx(2.0, abs=1e-3)


def test_the_goal_is_another_body(square: ShapeSoftEnv) -> None:
    """A round post is bent like a square one, which made the targets; every reward is that of its goals."""
    env = square
    given = {"position": (0.45, 0.0), "yaw": 0.0}
    observation, info = env.reset(seed=0, options={**given, "goal": (0.0, 0.0)})
    low = points(observation["desired_goal"])
    low[:, 2] -= env.task.targets.points.numpy()[0, 0, 0, :, 2].min()
    assert np.abs(low[:, :2]).max() == pytest.approx(0.012, abs=1e-3)  # the square's side, not the post's radius
    assert np.hypot(*points(observation["achieved_goal"])[:, :2].T).max() > 0.0145
    at_rest = info["shape_error"]
    info = play(env, 0, **given, goal=(0.05, 1.0))
    assert info["is_success"] and info["shape_error"] < at_rest + 0.05 < env.config.log_mass_tolerance
    assert info.get("solver_reasons", ()) == ()


# -- physics ----------------------------------------------------------------------------------------------------------


def test_the_foot_stays_where_it_is_clamped(shape: ShapeSoftEnv) -> None:
    """Bent by the arm, the post keeps its foot to the micrometre, at whatever place and yaw, and springs back."""
    info = play(shape, 3, position=(0.455, 0.005), yaw=1.0, youngs_modulus=1e5)
    rest = shape.scene.soft.body.surface.points
    foot = rest[:, 2] < rest[:, 2].min() + 0.011
    placed = turned(rest, 1.0) + np.array([0.455, 0.005, shape.scene.soft.height + GAP])
    now = shape.scene.state.particle_q.numpy()
    assert info["is_success"] and foot.sum() > 10
    np.testing.assert_allclose(now[foot], placed[foot], atol=2e-6)
    bent = np.abs(now - placed).max()
    shape.scene.controller.reset(shape.scene.state)
    direction = info["parameters"]["goal"][1]
    back = np.array([-np.cos(direction), -np.sin(direction), 0.0, 0.0, IDLE[4]], np.float32)
    for _ in range(8):
        shape.step(back * [0.5, 0.5, 1.0, 1.0, 1.0])
    for _ in range(40):
        shape.step(IDLE)
    assert np.abs(shape.scene.state.particle_q.numpy() - placed).max() < 0.25 * bent


@pytest.mark.parametrize("seed", [0, 13])
def test_script_bends_the_post(shape: ShapeSoftEnv, seed: int) -> None:
    """The shape ends within 3 mm, without a complaint of the solver."""
    info = play(shape, seed)
    assert info["is_success"] and info["shape_error"] < 0.003 and info.get("solver_reasons", ()) == ()


@pytest.mark.slow
@pytest.mark.episodes(20)
def test_script_succeeds_on_twenty_of_twenty_seeds(soft_env: MakeEnv, episode: Episodes) -> None:
    """20 of 20 seeds with random stiffness, place, yaw and target."""
    assert_success(episode(soft_env("softmode/ShapeSoft-v0")))


# -- worlds and pictures ----------------------------------------------------------------------------------------------


@pytest.mark.rest
def test_worlds_equal_single_environments(shape: ShapeSoftEnv) -> None:
    """World i of two plays bitwise what the single environment plays, as in every task; their rewards come at once."""
    envs = gym.make_vec(ENV_ID, num_envs=2).unwrapped
    assert isinstance(envs, ShapeSoftVectorEnv)
    observations, _ = envs.reset(seed=5)
    action = np.array([0.2, 0.4, 0.0, 0.2, 0.3], np.float32)
    history, rewards = [observations], []
    for _ in range(12):
        observations, reward, *_ = envs.step(np.stack([action, action]))
        again = envs.compute_reward(observations["achieved_goal"], observations["desired_goal"], None)
        np.testing.assert_array_equal(again, reward)
        history.append(observations)
        rewards.append(reward)
    for world in range(2):
        shape.reset(seed=5 + world)
        for k in range(12):
            observation, reward, *_ = shape.step(action)
            for name, value in observation.items():
                np.testing.assert_array_equal(value, history[k + 1][name][world])
            assert np.float32(reward) == rewards[k][world]


def test_marker_shows_the_target() -> None:
    """The marker's splats lie where the target's points do, in every world."""
    envs = gym.make_vec(ENV_ID, num_envs=2, obs_type="pixels", config=ShapeSoftConfig(image_size=36)).unwrapped
    assert isinstance(envs, ShapeSoftVectorEnv)
    envs.reset(seed=0)
    task = envs.task
    shown = task.scene.marker_points.numpy()[:, task.points]
    desired = task.observation.numpy()[:, task.segments["desired_goal"][0]].reshape(2, -1, 3)
    np.testing.assert_allclose(shown, desired, atol=1e-6)
    foot = task.table.values.numpy()[:, task.table.columns("position")]
    np.testing.assert_allclose(wp.transform(*task.scene.marker_place.numpy()[1]).p[:2], foot[1], atol=1e-6)
    assert np.abs(shown[0] - shown[1]).max() > 0.01


@pytest.mark.parametrize(
    "given",
    [
        {"goal_displacement": (0.05, 0.02)},
        {"goal_displacement": (0.02, 0.2)},
        {"goal_direction": (-4.0, 1.0)},
        {"reward_mode": "shaped"},
        {"reward_length": 0.0},
        {"goal_tolerance": -1.0},
        {"hold_steps": 0},
        {"log_mass_spacing": 0.0},
        {"log_mass_length": 2.0},
        {"goal_object": POST},
        {"goal_object": replace(POST, extents=(0.03, 0.03, 0.1)), "reward_mode": "log_mass"},
        {"scale_range": (0.9, 1.1)},
    ],
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        ShapeSoftConfig(**given)


def test_only_a_clamped_cylinder_is_a_post() -> None:
    """Another object is refused by name."""
    with pytest.raises(ConfigError, match="cylinder"):
        ShapeSoftConfig(scene=replace(shape_scene(), object=ObjectConfig()))
