"""LiftSoft: seeding, copies, reward, errors, the ends of episodes, pictures; what no checker of all tasks asks."""

from __future__ import annotations

import functools
import pickle
import weakref
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import warp as wp
from gymnasium.utils.env_checker import data_equivalence

import softmode
from softmode.deformables.model.status import status_reasons
from softmode.envs.task import plan_of
from softmode.envs.task_kernels import bound_observation
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.envs.tasks.press_soft import kernels as press_kernels
from softmode.errors import ConfigError, MaterialError
from softmode.pause import collector_paused
from tests.envs.conftest import MakeEnv


def actions(env: gym.Env, count: int, seed: int = 0) -> np.ndarray:
    """Return random actions."""
    assert env.action_space.shape is not None
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def rollout(env: gym.Env, count: int, **reset: Any) -> list[Any]:
    """Return the results of a reset and of `count` steps with random actions."""
    return [env.reset(**reset), *(env.step(action) for action in actions(env, count))]


def test_id_is_listed() -> None:
    """The package registers exactly the environments that it documents."""
    assert set(softmode.ENVIRONMENTS) == {name for name in gym.registry if name.startswith("softmode/")}


# -- seeds and copies --------------------------------------------------------------------------------------------------


def test_two_environments_in_turn_are_each_as_alone(lift: LiftSoftEnv) -> None:
    """Stepped in turn, this one and one of the factory that worker processes get return what each returns alone.

    Observations, rewards and infos, bit for bit: also Gymnasium's own rule that equal seeds and actions of a registered
    id give equal results. Closing twice does no harm.
    """
    other = pickle.loads(pickle.dumps(functools.partial(gym.make, "softmode/LiftSoft-v0")))()
    try:
        first, second = [lift.reset(seed=4)], [other.reset(seed=9)]
        for action in actions(lift, 6):
            first.append(lift.step(action))
            second.append(other.step(action))
        assert data_equivalence(first, rollout(other, 6, seed=4), exact=True)
        assert data_equivalence(second, rollout(lift, 6, seed=9), exact=True)
    finally:
        other.close()
        other.close()


def test_seed_decides_the_draw_and_the_stream_goes_on(lift: LiftSoftEnv) -> None:
    """A seed repeats its draw; without one the next episode is another."""
    first = lift.reset(seed=5)[0]
    second = lift.reset()[0]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(lift.reset(seed=5)[0], first)
    np.testing.assert_array_equal(lift.reset()[0], second)
    assert not np.array_equal(lift.reset(seed=6)[0], first)


def test_a_seeded_reset_leaves_nothing_of_before(lift: LiftSoftEnv) -> None:
    """All that a step reads has the same bits after it, MuJoCo's clock included.

    Where the body was before, and its Hessian, are not read in the first step: `dt_before` and `cached` say so. A step
    writes actions and reward first.
    """
    assert isinstance(lift.action_space, gym.spaces.Box)
    lift.reset(seed=5)
    first = lift.get_state()
    for _ in range(3):
        lift.step(lift.action_space.high)
    lift.reset()
    lift.step(lift.action_space.low)
    lift.reset(seed=5)
    second = lift.get_state()
    assert first.arrays.keys() == second.arrays.keys() and "mujoco.time" in first.arrays
    different = [name for name in first.arrays if first.arrays[name].tobytes() != second.arrays[name].tobytes()]
    unread = ("_before", "stick_point", "hessian.", "scene.actions", "task.reward")
    assert not [name for name in different if not any(part in name for part in unread)]
    assert not {"state.softmode.dt_before", "hessian.cached"} & set(different) and first.random == second.random


def test_a_closed_environment_needs_no_collector() -> None:
    """Task, scene and model of an environment that was used and closed are freed by counting references alone."""
    with collector_paused():
        env: Any = gym.make("softmode/LiftSoft-v0", obs_type="state")
        env.reset(seed=0)
        env.step(env.action_space.sample())
        task = env.unwrapped.task
        left = [weakref.ref(owner) for owner in (task, task.scene, task.scene.model)]
        del task
        env.close()
        del env
        assert [owner() for owner in left] == [None] * 3


def test_materials_in_which_sound_is_too_fast_are_refused(lift: LiftSoftEnv) -> None:
    """The speed sqrt(E (1 - nu) / ((1 + nu) (1 - 2 nu) rho)) is at most 1 km/s: beyond steps have diverged."""
    light = {"density": 100.0, "poissons_ratio": 0.45}
    modulus = 1.0e6 * 100.0 * 1.45 * 0.1 / 0.55
    assert lift.reset(options={**light, "youngs_modulus": 0.99 * modulus})[1]["parameters"]["density"] == 100.0
    for refused in ({**light, "youngs_modulus": 1.01 * modulus}, {"youngs_modulus": 1.0e11}):
        with pytest.raises(ConfigError, match="sound"):
            lift.reset(options=refused)


def test_reset_draws_within_its_ranges(lift: LiftSoftEnv) -> None:
    """Position and Young's modulus stay inside the configured ranges and use them."""
    config = lift.config
    centre, modulus = [], []
    for seed in range(40):
        info = lift.reset(seed=seed)[1]
        centre.append(lift.scene.object_position.numpy()[0, 0, :2].copy())
        modulus.append(info["parameters"]["youngs_modulus"])
    offset = (np.array(centre) - config.scene.object_position) / config.position_range
    low, high = np.log(config.youngs_modulus_range)
    share = (np.log(modulus) - low) / (high - low)
    assert np.abs(offset).max() < 1.1  # the centre of mass lies a little beside the middle of the object
    assert np.ptp(offset, axis=0).min() > 1.5
    assert share.min() > 0.0 and share.max() < 1.0 and np.ptp(share) > 0.8


def test_pickled_environment_plays_the_same_episode(joints: LiftSoftEnv) -> None:
    """A copy through pickle is made from the same arguments."""
    env = joints
    copy = pickle.loads(pickle.dumps(env))
    assert copy.config == env.config and copy.action_space == env.action_space
    assert data_equivalence(rollout(env, 3, seed=1), rollout(copy, 3, seed=1), exact=True)


# -- options and errors -----------------------------------------------------------------------------------------------


def test_reset_options_place_the_object(lift: LiftSoftEnv) -> None:
    """Position [m], yaw [rad] and Young's modulus [Pa] are taken as given, in numbers or arrays."""
    given = {"position": [0.42, -0.05], "yaw": 0.5, "youngs_modulus": 1.0e5, "goal": [0.4, 0.0, 0.1]}
    _, info = lift.reset(seed=0, options=given)
    assert info["parameters"]["youngs_modulus"] == 1.0e5
    np.testing.assert_allclose(lift.scene.object_position.numpy()[0, 0, :2], given["position"], atol=1e-6)
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
    rest = lift.scene.soft.body.surface.points
    placed = lift.scene.state.particle_q.numpy()[: len(rest)]
    np.testing.assert_allclose(placed - placed[0], (rest - rest[0]) @ turn.T, atol=1e-5)
    again, _ = lift.reset(options={**given, "position": np.array(given["position"]), "yaw": np.array(0.5)})
    np.testing.assert_array_equal(again, lift.reset(seed=3, options=given)[0])


@pytest.mark.parametrize(
    "options",
    [
        {"colour": "red"},
        {"position": [0.45]},
        {"position": [0.45, np.nan]},
        {"position": [2.0, 0.0]},
        {"position": None},
        {"yaw": np.inf},
        {"yaw": "left"},
        {"youngs_modulus": 0.0},
        {"youngs_modulus": -1.0e5},
        {"youngs_modulus": np.nan},
    ],
)
def test_bad_reset_options_change_nothing(lift: LiftSoftEnv, options: dict[str, Any]) -> None:
    """A refused reset names the option, and neither the scene nor the random stream has moved."""
    lift.reset(seed=2)
    before, stream = lift.scene.state.softmode.q.numpy().copy(), lift.np_random.bit_generator.state
    with pytest.raises((ConfigError, MaterialError), match=next(iter(options))):
        lift.reset(seed=3, options=options)
    np.testing.assert_array_equal(lift.scene.state.softmode.q.numpy(), before)
    assert lift.np_random.bit_generator.state == stream


@pytest.mark.parametrize(
    "action",
    [np.zeros(4), np.zeros((1, 5)), 0.0, [0, 0, np.nan, 0, 0], [np.inf, 0, 0, 0, 0], ["a"] * 5, [[1], [1, 2]], None],
)
def test_bad_actions_are_refused_before_anything_moves(lift: LiftSoftEnv, action: Any) -> None:
    """Wrong shapes, NaN, infinity and things that are no numbers raise ConfigError; the state keeps its bits."""
    lift.reset(seed=0)
    before = [lift.scene.state.softmode.q.numpy().copy(), lift.scene.state.joint_q.numpy().copy()]
    with pytest.raises(ConfigError, match="action"):
        lift.step(action)
    np.testing.assert_array_equal(lift.scene.state.softmode.q.numpy(), before[0])
    np.testing.assert_array_equal(lift.scene.state.joint_q.numpy(), before[1])


def test_large_actions_are_clamped(lift: LiftSoftEnv) -> None:
    """An action beyond 1 does what 1 does."""
    results = []
    for size in (1.0, 50.0):
        lift.reset(seed=0)
        results.append(lift.step(np.full(5, size, np.float32))[0])
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize(
    "given",
    [
        {"obs_type": "depth"},
        {"render_mode": "ansi"},
        {"control_mode": "torque"},
        {"size": 0.0},
        {"config": {"image_size": 128}},
    ],
)
def test_unknown_arguments_are_refused(given: dict[str, Any]) -> None:
    """The constructor checks its arguments before it builds."""
    with pytest.raises(ConfigError, match=next(iter(given)).split("_")[-1]):
        LiftSoftEnv(**given)


@pytest.mark.parametrize(
    "given",
    [
        {"youngs_modulus_range": (0.0, 1.0e5)},
        {"youngs_modulus_range": (1.0e5, 1.0e4)},
        {"goal_height": 0.0},
        {"goal_tolerance": 0.5},
        {"goal_range": (0.0, 0.0, 0.3)},
        {"density_range": (0.0, 100.0)},
        {"poissons_ratio_range": (0.3, 0.6)},
        {"camera": "back"},
        {"image_outputs": ("normals",)},
        {"hold_steps": 0},
        {"position_range": (-0.1, 0.0)},
        {"image_size": 8},
        {"render_size": 5000},
        {"mesh_samples": 2},
    ],
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        LiftSoftConfig(**given)


# -- step -------------------------------------------------------------------------------------------------------------


def test_results_are_never_reused(make_env: MakeEnv) -> None:
    """What a step returned does not change with the next steps, be it observation, info or picture."""
    env = make_env("LiftSoft", "pixels_agent_pos")
    observation, info = env.reset(seed=0)
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    kept = [observation["pixels"], observation["agent_pos"], info["finger_force"], frame]
    copies = [array.copy() for array in kept]
    for action in actions(env, 5):
        env.step(action)
        env.render()
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_a_captured_step_is_replayed_without_warp(lift: LiftSoftEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU the graph that a step replays holds known operations, and Warp's slower replay takes no part.

    A graph with an operation that softmode does not know is left to Warp in silence: a quarter more per control step.
    """
    if not lift.task.device.is_cpu:
        pytest.skip("Warp replays graphs on CUDA")
    launched = []
    monkeypatch.setattr(wp, "capture_launch", launched.append)
    graph = lift.task.graph
    replay = graph.launch
    monkeypatch.setattr(graph, "launch", lambda: replay() or launched.append("own"))
    before = lift.reset(seed=0)[0]
    after = lift.step(actions(lift, 1)[0])[0]
    assert graph.operation_count > 0
    assert launched == ["own"] and not np.array_equal(before, after)


def test_reward_is_the_sum_of_its_terms(lift: LiftSoftEnv) -> None:
    """The reward equals the sum of info["reward_terms"]; far from the goal only `reach` pays."""
    for _, reward, _, _, info in rollout(lift, 10, seed=0)[1:]:
        terms = info["reward_terms"]
        assert reward == pytest.approx(sum(terms.values()), rel=1e-6)
        assert set(terms) == {"reach", "grasp", "lift", "goal", "hold"}
        assert 0.0 < terms["reach"] < 1.0 and sum(terms.values()) == terms["reach"]
        assert info["is_success"] is False


def test_episode_is_truncated_by_its_limit(make_env: MakeEnv) -> None:
    """`gym.make` ends an idle episode after 150 steps, by truncation."""
    env = make_env("LiftSoft")
    env.reset(seed=0)
    idle = np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    ends = [env.step(idle)[2:4] for _ in range(150)]
    assert ends[-1] == (False, True)
    assert not any(terminated or truncated for terminated, truncated in ends[:-1])


def test_info_names_what_the_solver_reports(lift: LiftSoftEnv) -> None:
    """``solver_reasons`` are the names of the bits of ``solver_status``, of the last control step only."""
    lift.reset(seed=0)
    idle = np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    clean = lift.step(idle)[-1]
    assert clean["solver_status"] == 0 and clean.get("solver_reasons", ()) == ()
    data = lift.scene.state.softmode
    data.qd.assign(np.full((*data.qd.shape, 3), np.nan))
    broken = lift.step(idle)[-1]
    assert "not_finite" in broken["solver_reasons"] and broken["failure"] == "diverged"
    assert broken["solver_reasons"] == status_reasons(broken["solver_status"])
    lift.reset(seed=0)
    assert lift.step(idle)[-1].get("solver_reasons", ()) == ()


def test_an_object_off_the_table_ends_the_episode(lift: LiftSoftEnv) -> None:
    """Falling 5 cm under the place where it rested terminates with failure "dropped"; free fall takes 0.1 s."""
    lift.reset(seed=0)
    idle = np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    lift.step(idle)
    lift.scene.reset(position=np.array([[0.95, 0.0]]))  # beyond the table's edge at x = 0.85 m
    steps, terminated = 0, False
    while not terminated and steps < 10:
        observation, _, terminated, truncated, info = lift.step(idle)
        steps += 1
    fall = np.sqrt(2.0 * 0.05 / 9.81) * lift.config.scene.control_hz
    assert terminated and not truncated and info["failure"] == "dropped" and not info["is_success"]
    assert fall - 1 <= steps <= fall + 2
    assert lift.observation_space.contains(observation)


def test_kernels_ask_for_what_a_task_has(lift: LiftSoftEnv) -> None:
    """A field of a plan that is no parameter, segment or attribute is named."""
    with pytest.raises(ConfigError, match="'drawn_goal_force', which nothing has"):
        plan_of(lift.task, press_kernels.observe)


def test_numbers_beyond_the_bounds_are_clipped(lift: LiftSoftEnv) -> None:
    """Whatever the scene holds, the observation lies in its space; NaN becomes zero."""
    task = lift.task
    wild = np.full(task.observation.shape, np.nan, np.float32)
    wild[0, ::2] = 1.0e30
    wild[0, 1] = -np.inf
    low, high = (wp.array(bound, dtype=float) for bound in (task.layout.low, task.layout.high))
    seen, finite = wp.array(wild, dtype=float), wp.zeros(1, dtype=wp.bool)
    wp.launch(bound_observation, dim=1, inputs=[low, high], outputs=[seen, finite])
    assert lift.observation_space.contains(seen.numpy()[0]) and not finite.numpy()[0]
    np.testing.assert_array_equal(seen.numpy()[0, 1::2], np.clip(0.0, task.layout.low, task.layout.high)[1::2])
    np.testing.assert_array_equal(seen.numpy()[0, ::2], task.layout.high[::2])


@pytest.mark.parametrize("modulus", [2.0e4, 2.0e6])
def test_both_ends_of_the_stiffness_stand_still(lift: LiftSoftEnv, modulus: float) -> None:
    """Left alone for half a second, the softest and the stiffest object sag little and stay where they are."""
    lift.reset(seed=0, options={"youngs_modulus": modulus, "position": (0.45, 0.0)})
    place = lift.scene.object_position.numpy()[0, 0].copy()
    for _ in range(15):
        info = lift.step(np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32))[-1]
    moved = lift.scene.object_position.numpy()[0, 0] - place
    # Its own weight strains an object of height H by at most rho g H / E at the foot.
    config = lift.config.scene
    height = 0.08
    sag = config.material.density * 9.81 * height / modulus * height
    assert np.abs(moved[:2]).max() < 1e-3
    assert -sag - 1e-3 < moved[2] < 1e-4
    assert np.linalg.norm(lift.scene.object_velocity.numpy()[0, 0]) < 5e-3
    assert (info["finger_force"] == 0.0).all()


def test_joint_actions_move_the_joints(joints: LiftSoftEnv) -> None:
    """In joint_delta mode an action of 1 commands `joint_scale` per step; the joint gets there within 10 %."""
    env = joints
    env.reset(seed=0)
    start = env.scene.state.joint_q.numpy()[:9].copy()
    action = np.zeros(8, np.float32)
    action[0] = 1.0
    for _ in range(10):
        env.step(action)
    for _ in range(10):
        env.step(np.zeros(8, np.float32))
    turned = env.scene.state.joint_q.numpy()[:7] - start[:7]
    wanted = 10 * env.config.scene.control.joint_scale
    assert turned[0] == pytest.approx(wanted, rel=0.1)
    assert np.abs(turned[1:]).max() < 0.02 * wanted


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_frame_shows_two_views(make_env: MakeEnv) -> None:
    """A frame is uint8 (edge, 2 edge, 3), neither half blank; without a render mode there is none."""
    lift: Any = make_env("LiftSoft", "pixels_agent_pos").unwrapped
    lift.reset(seed=0)
    frame = lift.render()
    edge = lift.config.render_size
    assert frame is not None and frame.shape == (edge, 2 * edge, 3) and frame.dtype == np.uint8
    for half in (frame[:, :edge], frame[:, edge:]):
        assert len(np.unique(half.reshape(-1, 3), axis=0)) > 50
    lift.render_mode = None
    try:
        assert lift.render() is None
    finally:
        lift.render_mode = "rgb_array"


def test_camera_sees_where_the_object_is(make_env: MakeEnv) -> None:
    """Moved to the side, the object moves in the picture; with equal options the picture has equal bits."""
    env = make_env("LiftSoft", "pixels_agent_pos")
    options = [{"yaw": 0.0, "youngs_modulus": 1.0e5, "position": (0.45, y)} for y in (-0.05, 0.05, -0.05)]
    left, right, again = (env.reset(seed=0, options=given)[0]["pixels"].astype(int) for given in options)
    np.testing.assert_array_equal(left, again)
    changed = np.abs(left - right).sum(axis=2) > 60
    assert 0.005 < changed.mean() < 0.3
