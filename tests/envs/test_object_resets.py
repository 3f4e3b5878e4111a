"""Another object at a reset: a world that drew object k is the single environment with object k, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.envs import (
    LiftSoftConfig,
    LiftSoftEnv,
    LiftSoftVectorEnv,
    PlaceInBinConfig,
    PlaceInBinEnv,
    PressSoftConfig,
    PressSoftEnv,
    PushSoftConfig,
    PushSoftEnv,
    RopeRouteConfig,
    RopeRouteEnv,
    ShapeSoftConfig,
    ShapeSoftEnv,
)
from softmode.errors import ConfigError
from softmode.objects import ObjectSet
from tests.envs.test_object_sets import CUBE, KINDS, MATERIALS, PLACE, ROD, actions, alone, alone_in, posts, ropes

SET = ObjectSet(KINDS, materials=MATERIALS, resample=True)
STEPS = 22


def lift(**changes: Any) -> LiftSoftConfig:
    """Return LiftSoft with a set whose objects change, every object of its own material."""
    return LiftSoftConfig(**{"objects": SET, "youngs_modulus_range": None, "image_size": 48, **changes})


def test_each_reset_lifts_as_alone() -> None:
    """After resets from small to large and back, with contact before each: the bits of the single environment."""
    config = lift(image_outputs=("segmentation",))
    env = LiftSoftEnv(config=config, obs_type="pixels", device="cpu")
    singles = [LiftSoftEnv(config=alone(config, k), obs_type="pixels", device="cpu") for k in range(len(KINDS))]
    graph = env.task.graph
    for seed, k in enumerate((0, 1, 2, 1, 0)):
        pictures, info = env.reset(seed=seed, options={**PLACE, "object": k})
        others, own = singles[k].reset(seed=seed, options=PLACE)
        assert info["object"] == k and info["object_name"] == env.config.objects.names[k]
        assert str(info["parameters"]) == str(own["parameters"])
        touched = 0.0
        for step in range(STEPS):
            seen = [one.task.observation.numpy() for one in (env, singles[k])]
            np.testing.assert_array_equal(*seen)
            for name, image in pictures.items():
                np.testing.assert_array_equal(image, others[name])
            action = actions(1, step)[0]
            pictures, reward, *_, info = env.step(action)
            others, own_reward, *_, own = singles[k].step(action)
            assert reward == own_reward and info["object_height"] == own["object_height"]
            touched = max(touched, info["finger_force"].max())
        assert touched > 0.1
    assert env.task.graph is graph


@pytest.mark.parametrize(("kind", "config"), [(PushSoftEnv, PushSoftConfig), (PressSoftEnv, PressSoftConfig)])
def test_each_reset_is_pushed_and_pressed_as_alone(kind: Any, config: Any) -> None:
    """The same for PushSoft, whose reward knows the shape, and PressSoft, whose gauge knows the height."""
    pads = (CUBE, replace(ROD, extents=(0.06, 0.06, 0.03)))
    made = config(objects=ObjectSet(pads, resample=True), youngs_modulus_range=None, render_size=64)
    film = {"render_mode": "rgb_array", "device": "cpu"}
    env = kind(config=made, **film)
    singles = [kind(config=replace(made, objects=None, scene=replace(made.scene, object=pad)), **film) for pad in pads]
    move = np.array([0.6 if kind is PushSoftEnv else 0.0, 0.0, 0.0 if kind is PushSoftEnv else -1.0, 0.0, 0.0])
    for seed, k in enumerate((0, 1, 0)):
        observation, _ = env.reset(seed=seed, options={"object": k})
        mine, _ = singles[k].reset(seed=seed)
        for _ in range(10):
            np.testing.assert_array_equal(observation, mine)
            observation, reward, *_ = env.step(move)
            mine, own_reward, *_ = singles[k].step(move)
            assert reward == own_reward
        for one in (env, singles[k]):
            one.task.forget_film(np.ones(1, bool))  # the camera follows from where it was
        np.testing.assert_array_equal(env.render(), singles[k].render())


def follow_resets(env: Any, singles: list[Any], actions: np.ndarray) -> None:
    """Reset to the objects 0, 1, 0, play actions each time, and compare with the single environments by their bits."""
    for seed, k in enumerate((0, 1, 0)):
        _, info = env.reset(seed=seed, options={"object": k})
        _, own = singles[k].reset(seed=seed)
        assert info["object"] == k
        for action in actions:
            np.testing.assert_array_equal(*(one.task.observation.numpy() for one in (env, singles[k])))
            _, reward, *_, info = env.step(action)
            _, own_reward, *_, own = singles[k].step(action)
            assert reward == own_reward
            assert [info[name] for name in env.task.metric_names] == [own[name] for name in env.task.metric_names]
        if env.render_mode is not None:
            for one in (env, singles[k]):
                one.task.forget_film(np.ones(1, bool))  # the camera follows from where it was
            np.testing.assert_array_equal(env.render(), singles[k].render())


def test_each_reset_is_placed_as_alone() -> None:
    """The same for PlaceInBin, whose reward knows size and height of the toy; its bin is empty."""
    toys = (CUBE, ROD)
    config = PlaceInBinConfig(youngs_modulus_range=None, render_size=64, position_range=(0.01, 0.01))
    film = {"render_mode": "rgb_array", "device": "cpu"}
    scene = replace(config.scene, others=())
    env = PlaceInBinEnv(config=replace(config, objects=ObjectSet(toys, resample=True), scene=scene), **film)
    singles = [PlaceInBinEnv(config=replace(config, scene=replace(scene, object=toy)), **film) for toy in toys]
    down = np.tile([0.0, -1.0, -1.0, 0.0, 1.0], (14, 1))
    down[8:, 4] = -1.0
    follow_resets(env, singles, down.astype(np.float32))


def test_each_reset_is_bent_as_alone() -> None:
    """The same for ShapeSoft: targets, marker and clamped foot follow the post."""
    config = ShapeSoftConfig(objects=posts(resample=True), youngs_modulus_range=None, render_size=64)
    film = {"render_mode": "rgb_array", "device": "cpu"}
    env = ShapeSoftEnv(config=config, **film)
    singles = [ShapeSoftEnv(config=alone_in(config, k), **film) for k in range(2)]
    follow_resets(env, singles, np.tile([0.3, 0.6, 0.0, 0.1, 0.7], (12, 1)).astype(np.float32))


def test_a_clamped_post_that_may_invert_is_refused() -> None:
    """A post of the set that no world has yet is refused for its material, like one that stands there."""
    given = (MATERIALS[0], replace(MATERIALS[0], model=MaterialModel.NEO_HOOKEAN))
    objects = replace(posts(resample=True), materials=given, weights=(1.0, 0.0))
    with pytest.raises(ConfigError, match="exact regions has the material NEO_HOOKEAN"):
        ShapeSoftEnv(config=ShapeSoftConfig(objects=objects), device="cpu")


def test_each_reset_is_led_as_alone() -> None:
    """The same for RopeRoute: the end lies where it is drawn, whatever the length; the axis follows."""
    config = RopeRouteConfig(objects=ropes(resample=True), youngs_modulus_range=None, render_size=64)
    film = {"render_mode": "rgb_array", "device": "cpu"}
    env = RopeRouteEnv(config=config, **film)
    singles = [RopeRouteEnv(config=alone_in(config, k), **film) for k in range(2)]
    follow_resets(env, singles, np.tile([0.1, -0.1, -1.0, 0.0, 0.0], (10, 1)).astype(np.float32))


def test_worlds_draw_as_the_single_environment() -> None:
    """World i of many draws what the single environment with its seed draws; resets within the step draw again."""
    config = lift(objects_one_hot=True)
    many = LiftSoftVectorEnv(3, config=config, device="cpu", max_episode_steps=3, autoreset_mode="SameStep")
    single = LiftSoftEnv(config=config, device="cpu")
    first, infos = many.reset(seed=11)
    drawn = [infos["object"].copy()]
    for _ in range(4):
        for step in range(3):
            seen, *_, infos = many.step(actions(3, step))
        assert infos["final_info"]["object"].tolist() == drawn[-1].tolist()
        drawn.append(infos["object"].copy())
    rows = np.array(drawn)
    assert all(len(set(rows[:, w])) > 1 for w in range(3))
    code = many.task_columns("object_one_hot")
    np.testing.assert_array_equal(seen[:, code], np.eye(3)[rows[-1]])
    for w in range(3):
        observation, info = single.reset(seed=11 + w)
        assert info["object"] == rows[0, w]
        np.testing.assert_array_equal(observation, first[w])
        for row in rows[1:]:
            _, info = single.reset()
            assert info["object"] == row[w]


def test_weights_of_draws() -> None:
    """Over many resets each object comes as often as its weight says; one of weight zero never does."""
    env = LiftSoftVectorEnv(8, config=lift(objects=replace(SET, weights=(3.0, 0.0, 1.0))), device="cpu")
    counts = np.zeros(3)
    for seed in range(25):
        _, infos = env.reset(seed=8 * seed)
        counts += np.bincount(infos["object"], minlength=3)
    assert counts[1] == 0.0
    # 200 draws: the share of the first is 3/4 with a standard deviation of sqrt(3 / 16 / 200).
    assert counts[0] / counts.sum() == pytest.approx(0.75, abs=4.0 * np.sqrt(3.0 / 16.0 / 200.0))


def test_state_brings_its_object() -> None:
    """A world takes the state of a world with another object, and goes on with the same bits."""
    env = LiftSoftVectorEnv(2, config=lift(), device="cpu")
    env.reset(seed=3, options={**PLACE, "object": [0, 1]})
    for step in range(8, 14):
        env.step(actions(2, step))
    kept = env.get_state().to_bytes()
    after = [env.step(actions(2, step))[0] for step in range(14, 18)]
    env.reset(seed=5, options={**PLACE, "object": [2, 2]})
    env.step(actions(2, 0))
    env.set_state(kept)
    for step, row in zip(range(14, 18), after, strict=True):
        observation, *_, infos = env.step(actions(2, step))
        np.testing.assert_array_equal(observation, row)
    assert infos["object"].tolist() == [0, 1]


def test_what_cannot_be_drawn_says_so() -> None:
    """An object that the set has not, a set dealt out in turn, other soft bodies beside it."""
    env = LiftSoftEnv(config=lift(), device="cpu")
    with pytest.raises(ConfigError, match="object"):
        env.reset(options={"object": 3})
    with pytest.raises(ConfigError, match="in turn"):
        replace(SET, order="in_turn")
    scene = replace(LiftSoftConfig().scene, others=(CUBE,))
    with pytest.raises(ConfigError, match="others exclude each other"):
        LiftSoftEnv(config=lift(scene=scene), device="cpu")
