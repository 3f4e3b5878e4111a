"""Another object in every world: each world is the single environment with its object, bit for bit.

Of the tasks but LiftSoft that is tested in every run where objects change, in test_object_resets, and here over whole
episodes.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import softmode  # noqa: F401  (registers the environments)
from softmode.deformables import Material
from softmode.envs import (
    LiftSoftConfig,
    LiftSoftEnv,
    LiftSoftVectorEnv,
    PlaceInBinConfig,
    PlaceInBinEnv,
    PlaceInBinVectorEnv,
    PressSoftConfig,
    PressSoftEnv,
    PressSoftVectorEnv,
    PushSoftConfig,
    PushSoftEnv,
    PushSoftVectorEnv,
    RopeRouteConfig,
    RopeRouteEnv,
    RopeRouteVectorEnv,
    ShapeSoftConfig,
    ShapeSoftEnv,
    ShapeSoftVectorEnv,
    scripted_policy,
)
from softmode.envs.tasks.place_in_bin.task import PlaceInBin
from softmode.envs.tasks.rope_route.task import RopeRoute, rope_scene
from softmode.envs.tasks.shape_soft.config import POST
from softmode.errors import ConfigError, GraspError, StateError
from softmode.fitting.estimates import Estimate, Fitted
from softmode.fitting.tables import ForceLog
from softmode.learning.config_values import config_of, pinned_options, values_of
from softmode.objects import ObjectConfig, ObjectSet, load
from softmode.scenes import BoundSplats
from softmode.splats import make_plush, write_splats
from tests.envs.object_kinds import (
    BALL,
    CUBE,
    KINDS,
    MATERIALS,
    PLACE,
    ROD,
    actions,
    alone,
    alone_in,
    lift,
    lift_alone,
    posts,
    ropes,
)

STEPS = 26
SET = ObjectSet(KINDS, materials=MATERIALS, order="in_turn")


def test_each_world_lifts_as_alone() -> None:
    """Observation, reward, ends, info and picture of world i have the bits of the single environment, with contact."""
    count, seed = len(KINDS), 3
    config = lift(SET, objects_one_hot=True, image_outputs=("segmentation",))
    many = LiftSoftVectorEnv(count, config=config, obs_type="pixels", device="cpu")
    pictures, infos = many.reset(seed=seed, options=PLACE)
    assert infos["object"].tolist() == [0, 1, 2]
    assert infos["object_name"].tolist() == ["box", "sphere", "cylinder"]
    seen, frames, results = [many.state_observation], [pictures], []
    for step in range(STEPS):
        picture, *result, infos = many.step(actions(count, step))
        seen.append(many.state_observation)
        frames.append(picture)
        results.append((*result, infos["object_height"], infos["solver_status"], infos["finger_force"]))
    code = many.task_columns("object_one_hot")
    np.testing.assert_array_equal(seen[-1][:, code], np.eye(count))
    assert all(max(result[5][k].max() for result in results) > 0.1 for k in range(count))  # fingers touch
    for k in range(count):
        single = lift_alone(k)
        picture, info = single.reset(seed=seed + k, options=PLACE)
        assert info["parameters"]["density"] == np.float32(MATERIALS[k].density)
        for step in range(STEPS + 1):
            np.testing.assert_array_equal(single.task.observation.numpy()[0], np.delete(seen[step][k], code))
            for name, image in picture.items():
                np.testing.assert_array_equal(image, frames[step][name][k])
            if step < STEPS:
                picture, reward, terminated, truncated, info = single.step(actions(count, step)[k])
                mine = (reward, terminated, truncated, info["object_height"], info["solver_status"])
                assert mine == tuple(part[k] for part in results[step][:5])


@pytest.mark.rest
def test_each_world_is_pushed_as_alone() -> None:
    """The same for PushSoft, whose reward knows the shape; the film has the outline of each object as its goal."""
    count = len(KINDS)
    config = PushSoftConfig(objects=SET, youngs_modulus_range=None, yaw_tolerance=0.2, render_size=64)
    many = PushSoftVectorEnv(count, config=config, render_mode="rgb_array", device="cpu")
    observation, _ = many.reset(seed=9)
    seen, rewards = [observation], []
    ahead = np.array([1.0, 0.0, 0.0, 0.0, 0.0], np.float32)
    for step in range(12):
        observation, reward, *_ = many.step(np.tile(ahead, (count, 1)) + 0.2 * actions(count, step))
        seen.append(observation)
        rewards.append(reward)
    film = many.render()
    assert film is not None
    for k in range(count):
        single = PushSoftEnv(config=alone(config, k), render_mode="rgb_array", device="cpu")
        observation, _ = single.reset(seed=9 + k)
        for step in range(12):
            np.testing.assert_array_equal(observation, seen[step][k])
            observation, reward, *_ = single.step(ahead + 0.2 * actions(count, step)[k])
            assert reward == rewards[step][k]
        picture = single.render()
        assert picture is not None
        np.testing.assert_array_equal(picture, film[k])


@pytest.mark.rest
def test_each_world_is_pressed_as_alone() -> None:
    """The same for PressSoft, whose gauge knows how high a pad is."""
    pads, foam = (CUBE, replace(ROD, extents=(0.06, 0.06, 0.03))), Material(youngs_modulus=1.0e5, poissons_ratio=0.4)
    config = PressSoftConfig(objects=ObjectSet(pads, order="in_turn"))
    config = replace(config, scene=replace(config.scene, material=foam))
    many = PressSoftVectorEnv(2, config=config, device="cpu")
    first, _ = many.reset(seed=5)
    down = np.array([0.0, 0.0, -1.0, 0.0, 0.0], np.float32)
    seen = [many.step(np.tile(down, (2, 1)))[:2] for _ in range(10)]
    for k, pad in enumerate(pads):
        own = replace(config, objects=None, scene=replace(config.scene, object=pad))
        single = PressSoftEnv(config=own, device="cpu")
        observation, _ = single.reset(seed=5 + k)
        np.testing.assert_array_equal(observation, first[k])
        for observation, reward in seen:
            mine, own_reward, *_ = single.step(down)
            np.testing.assert_array_equal(mine, observation[k])
            assert own_reward == reward[k]


def follow(many: Any, singles: list[Any], seed: int, limit: int, done: str | None = "is_success") -> None:
    """Play the scripted policy in worlds, the same actions in single environments, and compare all that comes of it.

    Args:
        many: Worlds of a set.
        singles: The environment of each world on its own.
        seed: Seed of world 0.
        limit: Most steps.
        done: Figure that every world is to reach within them; None for none.
    """
    seen, infos = many.reset(seed=seed)
    rows, worlds = [(many.task.observation.numpy().copy(), None, infos)], len(singles)
    policy, solved = scripted_policy(many), np.zeros(worlds, bool)
    played = []
    while len(played) < limit and not (done and solved.all()):
        played.append(policy(seen))
        seen, reward, *_, infos = many.step(played[-1])
        rows.append((many.task.observation.numpy().copy(), reward, infos))
        solved |= infos.get(done, solved)
    assert done is None or solved.all()
    figures = [name for name in infos if name in singles[0].task.metric_names]
    assert figures
    touched = np.zeros(worlds)
    for k, single in enumerate(singles):
        single.reset(seed=seed + k)
        np.testing.assert_array_equal(single.task.observation.numpy()[0], rows[0][0][k])
        for action, (observation, reward, infos) in zip(played, rows[1:], strict=True):
            _, own_reward, *_, info = single.step(action[k])
            np.testing.assert_array_equal(single.task.observation.numpy()[0], observation[k])
            assert reward is not None and own_reward == reward[k]
            assert info["solver_status"] == infos["solver_status"][k]
            assert [info[name] for name in figures] == [infos[name][k] for name in figures]
            touched[k] = max(touched[k], info["finger_force"].max())
    assert (touched > 0.1).all()


def place_in_bin(**changes: Any) -> PlaceInBinConfig:
    """Return PlaceInBin with a toy of the set in every world, each of its own stiffness and density."""
    materials = [replace(one, poissons_ratio=0.3) for one in MATERIALS]
    toys = ObjectSet((*KINDS[:1], KINDS[2]), materials=(materials[0], materials[2]), order="in_turn")
    return PlaceInBinConfig(**{"objects": toys, "youngs_modulus_range": None, **changes})


@pytest.mark.rest
def test_each_toy_is_placed_as_alone() -> None:
    """World i of PlaceInBin, whose reward knows size and height, has the bits of the single environment; both win."""
    config = place_in_bin()
    many = PlaceInBinVectorEnv(2, config=config, device="cpu", autoreset_mode="Disabled")
    singles = [PlaceInBinEnv(config=alone_in(config, k), device="cpu") for k in range(2)]
    follow(many, singles, seed=2, limit=180)


def test_toys_fit_the_bin() -> None:
    """A toy wider than the bin is refused by name."""
    bar = replace(CUBE, extents=(0.17, 0.04, 0.04))
    with pytest.raises(ConfigError, match=r"objects: box#2 is 0.170 m by 0.040 m wide and does not fit the bin"):
        PlaceInBinEnv(config=place_in_bin(objects=ObjectSet([CUBE, bar], order="in_turn", first_world=1)), device="cpu")


@pytest.mark.rest
def test_each_post_is_bent_as_alone() -> None:
    """World i of ShapeSoft, whose targets are bends of its own post, has the bits of the single environment."""
    config = ShapeSoftConfig(objects=posts(order="in_turn"), youngs_modulus_range=None, render_size=64)
    many = ShapeSoftVectorEnv(2, config=config, device="cpu", autoreset_mode="Disabled", render_mode="rgb_array")
    film = {"device": "cpu", "render_mode": "rgb_array"}
    singles = [ShapeSoftEnv(config=alone_in(config, k), **film) for k in range(2)]
    follow(many, singles, seed=6, limit=100)
    pictures = many.render()
    assert pictures is not None
    for k, single in enumerate(singles):
        np.testing.assert_array_equal(single.render(), pictures[k])


def test_posts_are_posts() -> None:
    """A set with anything else is refused by name; the lowest post bounds the goal; a goal object fits all."""
    with pytest.raises(ConfigError, match=r"objects: mug is a .*, clamped 0.0 m high"):
        ShapeSoftConfig(objects=ObjectSet([POST, "mug"]))
    low = replace(POST, extents=(0.03, 0.03, 0.09))
    with pytest.raises(ConfigError, match="goal_displacement"):
        ShapeSoftConfig(objects=ObjectSet([POST, low]))
    with pytest.raises(ConfigError, match="goal_object: expected extents of the same height"):
        ShapeSoftConfig(
            objects=ObjectSet([POST, replace(POST, extents=(0.03, 0.03, 0.13))]),
            goal_object=POST,
            reward_mode="log_mass",
        )


@pytest.mark.rest
def test_each_rope_is_led_as_alone() -> None:
    """World i of RopeRoute, whose axis, end and point to grasp are those of its rope, has the bits of it alone."""
    config = replace(
        RopeRouteConfig.preset("one_peg"), objects=ropes(order="in_turn"), youngs_modulus_range=None, render_size=64
    )
    many = RopeRouteVectorEnv(2, config=config, device="cpu", autoreset_mode="Disabled")
    assert isinstance(many.task, RopeRoute)
    lengths = np.linalg.norm(np.diff(many.task.axis.numpy(), axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(lengths, (0.36, 0.38), rtol=5e-3)
    singles = [RopeRouteEnv(config=alone_in(config, k), device="cpu") for k in range(2)]
    follow(many, singles, seed=1, limit=130)


def test_ropes_are_ropes() -> None:
    """What is not slender, or bent, is refused by name."""
    for other in (CUBE, "rope"):
        given = ObjectSet([rope_scene().object, other], order="in_turn", first_world=1)
        with pytest.raises(ConfigError, match=r"objects: (box|rope) is no rope: 0\.\d+ m along x, and"):
            RopeRouteEnv(config=RopeRouteConfig(objects=given), device="cpu")


def test_states_of_different_objects_go_on_as_they_did(tmp_path: Path) -> None:
    """After a state, in bytes, all goes on with the same bits; a world takes another one's that has its object.

    E of what `softmode fit` made is drawn within its bars, others keep theirs, and what a run keeps tells the fit.
    """
    modulus = Estimate(value=5.0e4, low=4.0e4, high=6.25e4, observable=True, unit="Pa")
    film = ForceLog(way=np.zeros(1), force=np.zeros(1), opening=False, source="press.csv", fingerprint="00ff")
    Fitted.of(film, {"youngs_modulus": modulus}, MATERIALS[0], ()).save(tmp_path / "toy.npz", load(CUBE))
    toy = ObjectConfig(body=tmp_path / "toy.npz").pinned()
    config = lift(replace(SET, objects=(toy, BALL), materials=None))
    told = json.loads(values_of(config)["objects"]["objects"][0]["fitted"])
    assert told["fingerprint"] == "00ff" and told["parameters"]["youngs_modulus"] == [4.0e4, 5.0e4, 6.25e4]
    env = LiftSoftVectorEnv(3, config=config, device="cpu")
    first, other, second = env.reset(seed=4, options=PLACE)[1]["parameters"]["youngs_modulus"]
    assert 4.0e4 <= first <= 6.25e4 and 4.0e4 <= second <= 6.25e4 and first != second
    assert other == np.float32(config.scene.material.youngs_modulus)

    def play(first: int) -> list[tuple[np.ndarray, np.ndarray]]:
        return [env.step(actions(3, step))[:2] for step in range(first, first + 6)]

    play(10)
    kept = env.get_state().to_bytes()
    after = play(16)
    env.set_state(kept)
    for mine, theirs in zip(play(16), after, strict=True):
        np.testing.assert_array_equal(mine[0], theirs[0])
        np.testing.assert_array_equal(mine[1], theirs[1])
    env.set_state(env.get_state().worlds([2, 1, 2]), mask=np.array([True, False, False]))  # worlds 0 and 2: toys
    same = np.tile(actions(1, 30), (3, 1))
    observation = env.step(same)[0]
    np.testing.assert_array_equal(observation[0], observation[2])
    assert not np.array_equal(observation[0], observation[1])


def test_processes_deal_out_the_same_objects() -> None:
    """Two processes hold the objects that one holds; a single environment made for a world has that world's."""
    given = ObjectSet(["ball", "sponge"], seed=2, size=0.06)
    config = LiftSoftConfig(objects=ObjectSet(KINDS, seed=4))
    chosen = ObjectSet(KINDS, seed=4).chosen(4)
    assert pickle.loads(pickle.dumps(given)) == given
    env = gym.make_vec("softmode/LiftSoft-v0", num_envs=4, config=config, processes=2, device="cpu")
    try:
        first, infos = env.reset(seed=1)
        np.testing.assert_array_equal(infos["object"], chosen)
    finally:
        env.close()
    single = LiftSoftEnv(config=config.from_world(3), device="cpu")
    observation, info = single.reset(seed=4)
    assert info["object"] == chosen[3]
    assert info["object_name"] == config.objects.names[chosen[3]] if config.objects else False
    np.testing.assert_array_equal(observation, first[3])


def test_runs_keep_the_set(tmp_path: Path) -> None:
    """What a checkpoint or a dataset keeps of a configuration, as JSON, makes the same set again, its files pinned."""
    config = lift(replace(SET, objects=("mug", *KINDS[1:]), size=0.07))
    kept = json.loads(json.dumps(values_of(config)))
    assert config_of(LiftSoftConfig, kept) == config
    file = tmp_path / "toy.ply"
    write_splats(file, make_plush(300))
    options = {"config": values_of(LiftSoftConfig(objects=ObjectSet(["mug", file])))}
    pinned = pinned_options("softmode/LiftSoft-v0", options)
    found = config_of(LiftSoftConfig, json.loads(json.dumps(pinned["config"]))).object_set
    assert found is not None and found.config(1).fingerprint == ObjectConfig(splat=file).pinned().fingerprint


def test_scripted_policies_take_each_object() -> None:
    """The scripted policy lifts every object of the set in a vector environment."""
    env = LiftSoftVectorEnv(len(KINDS), config=lift(SET), device="cpu", autoreset_mode="Disabled")
    env.reset(seed=0, options=PLACE)
    policy, solved = scripted_policy(env), np.zeros(len(KINDS), bool)
    for _ in range(200):
        *_, infos = env.step(policy(None))
        solved |= infos["is_success"]
        if solved.all():
            break
    assert solved.all()


class OneBody(PlaceInBin):
    """A task that knows one body only."""

    takes_sets = False


def test_what_cannot_take_a_set_says_so() -> None:
    """A task that knows one body, an object too wide for the gripper, another's state, one body for all, a shortcut."""
    with pytest.raises(ConfigError, match="OneBody cannot have another object"):
        OneBody(PlaceInBinConfig(objects=SET), device="cpu")
    wide = replace(CUBE, extents=(0.16, 0.16, 0.16))
    with pytest.raises(GraspError, match="box#2 does not fit the gripper"):
        LiftSoftVectorEnv(2, config=lift(ObjectSet([CUBE, wide], order="in_turn")), device="cpu")
    with pytest.raises(ConfigError, match="objects_one_hot"):
        LiftSoftConfig(objects_one_hot=True)
    with pytest.raises(ConfigError, match="size is given beside a set"):
        LiftSoftEnv(config=lift(SET), size=0.05)
    env = LiftSoftVectorEnv(2, config=lift(SET), device="cpu")
    env.reset(seed=0)
    with pytest.raises(StateError, match="world 1 has object 1 of the set, the state object 0"):
        env.set_state(env.get_state().worlds([0]))
    with pytest.raises(ConfigError, match="a world keeps its object"):
        env.reset(options={"object": 1})
    with pytest.raises(ConfigError, match="not the body that world 1 holds"):
        BoundSplats(env.task.scene.model, env.task.scene.objects)
