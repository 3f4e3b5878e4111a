"""PlaceInBin: where things start, observation, reward and ends in constructed states, forces, scripted play, worlds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import softmode  # noqa: F401  (registers the environments)
from softmode.deformables.model.status import WORLD_COLLAPSED, WORLD_ITERATION_LIMIT, WORLD_PENETRATION
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.reward_kernels import EndReason
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.place_in_bin.scripted import ScriptedPlace
from softmode.envs.tasks.place_in_bin.task import Bin, PlaceInBinConfig, PlaceInBinEnv, bin_scene
from softmode.errors import ConfigError
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv

ENV_ID = "softmode/PlaceInBin-v1"
IDLE = np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
BESIDE, FIRST, SECOND = (0.42, -0.12), (0.43, 0.10), (0.47, 0.18)
"""Places of toy, ball and disc."""


@pytest.fixture(scope="module")
def env(make_env: MakeEnv) -> PlaceInBinEnv:
    """Return the default environment."""
    made = make_env("PlaceInBin").unwrapped
    assert isinstance(made, PlaceInBinEnv)
    return made


def seen(env: PlaceInBinEnv, observation: np.ndarray, segment: str) -> np.ndarray:
    """Return a segment of an observation."""
    return observation[env.task.segments[segment][0]]


def put(env: PlaceInBinEnv, *places: tuple[float, float, float]) -> None:
    """Start an episode with the objects standing `z` over the table at (x, y, z)."""
    env.reset(seed=0, options={"youngs_modulus": 1.0e5})
    scene = env.scene
    centres = np.array(places) + [[0.0, 0.0, thing.height] for thing in scene.objects]
    scene.place_position.assign(centres)
    scene.place_yaw.zero_()
    scene.world_mask.fill_(True)
    scene.reset_worlds()


def surfaces(env: PlaceInBinEnv) -> list[np.ndarray]:
    """Return the surface samples of every object [m]."""
    counts = np.cumsum([thing.body.surface_count for thing in env.scene.objects])
    return np.split(env.scene.state.particle_q.numpy()[: counts[-1]], counts[:-1])


def play(env: PlaceInBinEnv, seed: int, limit: int = 180, **options: Any) -> tuple[dict[str, Any], list[bool]]:
    """Play an episode with the scripted policy; return its last info and whether each step counted as success."""
    observation, info = env.reset(seed=seed, options=options)
    policy, won = scripted_policy(env), []
    for _ in range(limit):
        action = policy(observation)
        assert np.abs(action).max() <= 1.0
        observation, _, terminated, _, info = env.step(action)
        assert set(info.get("solver_reasons", ())) <= {"iteration_limit"}  # the coarse solver's, in 0.4 % of the steps
        won.append(info["is_success"])
        if terminated:
            break
    return info, won


def test_everything_starts_at_rest_where_it_belongs(env: PlaceInBinEnv) -> None:
    """The toy stands on the table, the others on the bin's floor at the drawn places, and nothing moves."""
    floor = env.config.bin.floor
    for seed in range(3):
        _, info = env.reset(seed=seed)
        start = env.scene.object_position.numpy()[0].copy()
        drawn = info["parameters"]
        names = ("position", "other_position_1", "other_position_2")
        np.testing.assert_allclose(start[:, :2], [drawn[name] for name in names], atol=1e-6)
        np.testing.assert_allclose(
            start[:, 2] - [thing.height for thing in env.scene.objects], [2e-4, floor + 2e-4, floor + 2e-4], atol=1e-6
        )
        for _ in range(6):
            info = env.step(IDLE)[-1]
        drift = env.scene.object_position.numpy()[0] - start
        assert np.abs(drift[:, :2]).max() < 4e-3 and np.abs(drift[:, 2]).max() < 2e-3
        assert np.abs(env.scene.object_velocity.numpy()).max() < 0.05
        assert info["others_inside"] == 2.0 and not info["is_success"]


def test_observation_says_where_bin_and_others_are(env: PlaceInBinEnv) -> None:
    """The goal is the centre of the opening; ways lead from tool and toy; the drawn places are options."""
    options = {"position": BESIDE, "other_position_1": FIRST, "other_position_2": SECOND}
    observation, info = env.reset(seed=0, options=options)
    rim = np.array([*env.config.bin.position, env.config.bin.height])
    tool, toy = seen(env, observation, "tool_position"), seen(env, observation, "object_position")
    others = env.scene.object_position.numpy()[0, 1:]
    np.testing.assert_allclose(others[:, :2], [FIRST, SECOND], atol=1e-6)
    np.testing.assert_allclose(seen(env, observation, "goal"), rim, atol=1e-6)
    np.testing.assert_allclose(seen(env, observation, "goal_offset"), rim - tool, atol=1e-6)
    np.testing.assert_allclose(seen(env, observation, "object_goal"), rim - toy, atol=1e-6)
    np.testing.assert_allclose(seen(env, observation, "other_offsets"), (others - toy).ravel(), atol=1e-6)
    assert info["bin_distance"] == pytest.approx(np.hypot(0.0, 0.14 - 0.08 + 0.12), abs=1e-4)
    layout = env.task.layout
    assert layout.column("goal") < layout.agent_size == layout.column("object_position")


def test_reward_is_the_sum_of_its_terms(env: PlaceInBinEnv) -> None:
    """The reward equals the sum of its terms, each within its bounds; an idle arm is rewarded for being near only."""
    env.reset(seed=3)
    random = np.random.default_rng(0)
    bounds = {"reach": 1.0, "grasp": 0.5, "carry": 3.0, "release": 2.0, "rest": 2.0}
    assert tuple(bounds) == env.task.term_names
    for k in range(10):
        _, reward, _, _, info = env.step(IDLE if k < 3 else random.uniform(-1.0, 1.0, 5).astype(np.float32))
        terms = info["reward_terms"]
        assert reward == pytest.approx(sum(terms.values()), rel=1e-6)
        assert all(0.0 <= terms[name] <= most for name, most in bounds.items())
        if k < 3:
            assert terms.pop("reach") > 0.0 and not any(terms.values())


def test_success_needs_the_toy_at_rest_in_the_bin(env: PlaceInBinEnv) -> None:
    """Standing in the bin, the toy counts after `hold_steps` steps and not before; beside its wall never."""
    floor = env.config.bin.floor + 2e-4
    others = ((*FIRST, floor), (0.41, 0.18, floor))
    for place, inside in (((0.49, 0.16, floor), True), ((0.45, 0.015, 2e-4), False)):
        put(env, place, *others)
        won = []
        for _ in range(env.config.hold_steps + 3):
            _, reward, terminated, _, info = env.step(IDLE)
            won.append(info["is_success"])
        assert not terminated
        assert (info["bin_distance"] == 0.0) == inside == won[-1]
        if inside:
            assert won.index(True) >= env.config.hold_steps - 1
            assert reward == pytest.approx(8.5, abs=0.1)  # every term is full
        else:
            assert not any(won) and reward < 1.0


def test_a_falling_toy_has_not_arrived(env: PlaceInBinEnv) -> None:
    """Over the bin and let go, the toy keeps all but `rest` and what is left of the way; at rest in it, it has all."""
    put(env, (0.49, 0.16, 0.12), (*FIRST, 0.0042), (0.41, 0.18, 0.0042))
    terms = env.step(IDLE)[-1]["reward_terms"]
    assert (terms["reach"], terms["grasp"], terms["release"], terms["rest"]) == (1.0, 0.5, 2.0, 0.0)
    assert 2.0 < terms["carry"] < 2.9
    inside, resting = [], []
    for _ in range(25):
        info = env.step(IDLE)[-1]
        fast = np.linalg.norm(env.scene.object_velocity.numpy()[0, 0]) > env.config.rest_speed
        inside.append(info["reward_terms"]["carry"])
        resting.append(info["reward_terms"]["rest"])
        assert not (fast and resting[-1])
    assert inside.index(3.0) < resting.index(2.0) and info["is_success"]


def test_other_objects_have_to_stay(env: PlaceInBinEnv) -> None:
    """One out of the bin ends the episode as a failure; one high over it forbids success until it is back."""
    put(env, (0.49, 0.16, 0.0042), (*FIRST, 0.0042), (0.45, 0.27, 2e-4))
    _, _, terminated, _, info = env.step(IDLE)
    assert terminated and info["failure"] == "spilled" and info["end_reason"] == EndReason.SPILLED
    assert info["others_inside"] == 1.0
    put(env, (0.49, 0.16, 0.0042), (*FIRST, 0.0042), (0.41, 0.18, 0.25))
    states = []
    for _ in range(30):
        _, _, terminated, _, info = env.step(IDLE)
        states.append((info["others_inside"], info["reward_terms"]["rest"]))
        assert not terminated
    assert states[0] == (1.0, 0.0) and states[-1] == (2.0, 2.0)
    assert all(rest == 0.0 for inside, rest in states if inside < 2.0)


def test_fingers_carry_the_weight_of_the_toy(env: PlaceInBinEnv) -> None:
    """Held still in the air, the toy loads the fingers with m g, and they squeeze no more than they need."""
    observation, _ = env.reset(seed=0, options={"youngs_modulus": 1.0e5, "position": BESIDE})
    policy = ScriptedPlace(env)
    while env.scene.object_position.numpy()[0, 0, 2] < 0.08:
        observation, *_, info = env.step(policy(observation))
        assert info["reward_terms"]["release"] == 0.0  # not over the bin yet
    hold = np.array([0.0, 0.0, 0.0, 0.0, policy(observation)[-1]], np.float32)
    for _ in range(30):
        info = env.step(hold)[-1]
    weight = env.scene.soft.body.volume * env.config.scene.material.density * 9.81
    force = env.scene.finger_force.numpy()[0]
    assert -force[:, 2].sum() == pytest.approx(weight, rel=0.02)
    assert (np.abs(force[:, 2]) <= np.sqrt(0.8) * np.linalg.norm(force[:, :2], axis=1)).all()
    assert info["reward_terms"]["grasp"] == 0.5 and info["reward_terms"]["carry"] > 1.0


@pytest.mark.parametrize(("seed", "modulus"), [(0, 2.0e4), (12, 2.0e6)])
def test_script_places_soft_and_stiff_toys(env: PlaceInBinEnv, seed: int, modulus: float) -> None:
    """The toy ends in the bin, let go without a drop, all within the walls to a millimetre; success lasts."""
    info, won = play(env, seed, youngs_modulus=modulus)
    assert info["is_success"] and all(won[won.index(True) :]) and info["drops"] == 0.0
    assert (info["finger_force"] == 0.0).all()
    rim, half = np.array(env.task.rim), np.array(env.task.half)
    for points in surfaces(env):
        assert (np.abs(points[:, :2] - rim[:2]) < half + 1e-3).all()
        assert points[:, 2].min() > env.config.bin.floor - 1e-3


def test_script_grasps_again_what_it_lost(env: PlaceInBinEnv) -> None:
    """A toy that falls out of the gripper on the way is found on the table and brought in."""
    observation, info = env.reset(seed=1)
    policy = scripted_policy(env)
    while env.scene.object_position.numpy()[0, 0, 2] < 0.08:
        observation, *_ = env.step(policy(observation))
    data, body = env.scene.state.softmode, env.scene.soft.body
    q = data.q.numpy()
    q[: body.function_count] = body.affine(np.eye(3), (0.40, -0.15, env.scene.soft.height + 1e-3))
    data.q.assign(q)
    data.qd.zero_()
    for _ in range(180):
        observation, _, terminated, _, info = env.step(policy(observation))
        assert not terminated
    assert info["is_success"] and info["drops"] == 1.0


@pytest.mark.slow
@pytest.mark.episodes(20)
@pytest.mark.parametrize("modulus", [None, 2.0e4, 2.0e6])
def test_script_succeeds_on_twenty_of_twenty_seeds(soft_env: MakeEnv, episode: Episodes, modulus: float | None) -> None:
    """20 of 20 seeds with random stiffness, and at either end."""
    options = {} if modulus is None else {"youngs_modulus": modulus}
    assert_success(episode(soft_env("softmode/PlaceInBin-v1"), options=options))


@pytest.mark.slow
@pytest.mark.episodes(10)
def test_script_places_plush_toys(soft_env: MakeEnv, episode: Episodes) -> None:
    """10 of 10 seeds among plush toys."""
    assert_success(episode(soft_env("softmode/PlaceInBin-v1", preset="plush")))


def through_walls(env: Any, points: np.ndarray) -> bool:
    """Return whether walls of the bin stand in an object: samples below the rim lie inside of them and beyond.

    What hangs bent over a rim may do so 5 mm down.
    """
    task = env.task
    over = np.abs(points[:, :2] - task.rim[:2]) - task.half
    low = points[:, 2] < task.rim[2] - 5e-3
    return bool((low & (over < 0.0).all(1)).any() and (low & (over > task.wall).any(1)).any())


@pytest.mark.slow
def test_rough_play_breaks_nothing() -> None:
    """2,000 steps of poking into the bin and at the toy, in four worlds: finite, no overflow, only known ends.

    Fingers of 6 and 9 mm are driven at up to 1 m/s into toys that lie on a table and whose samples stand up to 10 mm
    apart. A toy folds around the tip: one or two samples touch a side of the finger whose other side has their body,
    and are brought back through it. This way, of 4 to 14 mm, is more than 5 % of the toy and sets the bit "penetration"
    in 0.9, 1.3 and 1.2 % of the control steps (0.4, 0.5 and 0.5 % of the world steps; seeds 0, 1, 2), although half of
    the samples are less than 0.7 mm deep in the nearest side. So the bit may come, but seldom, only while a finger
    touches or in the control step after (0.03 s), and toys stay whole and where walls and table keep them.
    """
    envs: Any = gym.make_vec(ENV_ID, num_envs=4)
    envs.reset(seed=0)
    scene, random = envs.task.scene, np.random.default_rng(1)
    rough = WORLD_ITERATION_LIMIT | WORLD_COLLAPSED | WORLD_PENETRATION  # toys are squeezed flat on the table
    rows, deep, let_go = 0, 0, np.zeros(4, int)
    counts = np.cumsum([thing.body.surface_count for _ in range(4) for thing in scene.objects])
    for k in range(2000):
        if k % 15 == 0:
            at_bin = random.random((4, 1)) < 0.8
            goal = np.where(at_bin, envs.task.rim[:2], scene.object_position.numpy()[:, 0, :2])
            goal = np.column_stack([goal + random.uniform(-0.09, 0.09, (4, 2)), random.uniform(0.0, 0.13, 4)])
            turn = random.uniform(-1.0, 1.0, (4, 2))
        move = np.clip((goal - scene.controller.target_position.numpy()) / 0.015, -1.0, 1.0)
        actions = np.clip(np.column_stack([move, turn]) + 0.3 * random.standard_normal((4, 5)), -1.0, 1.0)
        observation, reward, *_, infos = envs.step(actions.astype(np.float32))
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        assert not (infos["solver_status"] & ~rough).any()
        assert set(infos["end_reason"]) <= {EndReason.RUNNING, EndReason.TIME_LIMIT, EndReason.SPILLED}
        rows = max(rows, int(scene.solver.rigid.mjw_data.nefc.numpy().max()))
        penetrates = (infos["solver_status"] & WORLD_PENETRATION) != 0
        deep += int(penetrates.sum())
        let_go = np.where(scene.finger_force.numpy().any((1, 2)), 0, let_go + 1)
        assert not (penetrates & (let_go > 1)).any()
        points = scene.state.particle_q.numpy()
        assert points[:, 2].min() > -5e-3
        assert not any(through_walls(envs, x) for x in np.split(points, counts[:-1]))
    assert rows < scene.config.constraint_max
    assert 0 < deep < 0.02 * 4 * 2000


def test_worlds_equal_single_environments(env: PlaceInBinEnv) -> None:
    """World i of two plays bitwise what the single environment plays with its seed, soft bodies touching each other."""
    touching = {"other_position_1": (0.43, 0.14), "other_position_2": (0.477, 0.14)}
    envs: Any = gym.make_vec(ENV_ID, num_envs=2)
    observations, _ = envs.reset(seed=5, options=touching)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 5)).astype(np.float32)
    history, rewards = [observations], []
    for action in actions:
        observations, reward, *_ = envs.step(np.stack([action, action]))
        history.append(observations)
        rewards.append(reward)
    pairs = 0
    for world in range(2):
        np.testing.assert_array_equal(env.reset(seed=5 + world, options=touching)[0], history[0][world])
        for k, action in enumerate(actions):
            observation, reward, *_ = env.step(action)
            np.testing.assert_array_equal(observation, history[k + 1][world])
            assert np.float32(reward) == rewards[k][world]
            pairs += int(env.scene.solver.view.pairs.count.numpy().sum())
    assert pairs > 0
    moved = seen(env, observation, "other_offsets") - seen(env, history[0][1], "other_offsets")
    assert np.abs(moved).max() > 1e-4


@pytest.mark.parametrize(
    "given", [{"other_range": (-0.1, 0.0)}, {"rim_allowance": -0.1}, {"rest_speed": 0.0}, {"hold_steps": 0}]
)
def test_configuration_is_checked(given: dict[str, Any]) -> None:
    """Every range of the configuration is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        PlaceInBinConfig(**given)


@pytest.mark.parametrize("given", [{"inner": (0.01, 0.1)}, {"floor": 0.07}, {"wall": 0.0}, {"height": 0.5}])
def test_bin_is_checked(given: dict[str, Any]) -> None:
    """So are the sizes of the bin."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        Bin(**given)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (PlaceInBinConfig(bin=Bin(inner=(0.16, 0.10))), "no room"),
        (PlaceInBinConfig(scale_range=(0.8, 1.5)), "no room"),
        (PlaceInBinConfig(position_range=(0.06, 0.2)), "wall"),
    ],
)
def test_things_need_room_to_start(config: PlaceInBinConfig, message: str) -> None:
    """Objects that might start in each other or in a wall are refused."""
    with pytest.raises(ConfigError, match=message):
        PlaceInBinEnv(config=config)


@pytest.mark.rest
def test_an_empty_bin_will_do() -> None:
    """Without other objects the task is the same, its observation shorter, as for the sets of test_object_resets."""
    env = PlaceInBinEnv(config=PlaceInBinConfig(scene=replace(bin_scene(), others=())))
    assert "other_offsets" not in env.task.segments
    info, _ = play(env, 0)
    assert info["is_success"] and info["others_inside"] == 0.0


def test_every_object_is_built_for_a_ratio_that_varies() -> None:
    """Where Poisson's ratio is drawn, the toy's functions and the others' are made for several."""
    build = BuildOptions(function_count=12, kernel_count=60, cubature_count=48)
    scene = bin_scene()
    first, *others = (replace(thing, build=build) for thing in (scene.object, *scene.others[:1]))
    scene = replace(scene, object=first, others=tuple(others))
    env = PlaceInBinEnv(config=PlaceInBinConfig(scene=scene, poissons_ratio_range=(0.2, 0.45)))
    assert {thing.body.function_count for thing in env.scene.objects} == {15}
    assert all(thing.body.serves_ratio(0.49) for thing in env.scene.objects)
