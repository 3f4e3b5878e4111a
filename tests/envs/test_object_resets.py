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
    PlaceInBinVectorEnv,
    PressSoftConfig,
    PressSoftVectorEnv,
    PushSoftConfig,
    PushSoftVectorEnv,
    RopeRouteConfig,
    RopeRouteVectorEnv,
    ShapeSoftConfig,
    ShapeSoftEnv,
    ShapeSoftVectorEnv,
)
from softmode.envs.catalogue import env_class
from softmode.errors import ConfigError
from softmode.objects import ObjectSet
from tests.envs.object_kinds import (
    CUBE,
    KINDS,
    MATERIALS,
    PLACE,
    ROD,
    actions,
    alone_in,
    lift,
    lift_alone,
    posts,
    ropes,
)

SET = ObjectSet(KINDS, materials=MATERIALS, resample=True)
STEPS = 22


@pytest.mark.parametrize("order", [(1, 0, 1), pytest.param((0, 1, 2, 1, 0), marks=pytest.mark.rest)])
def test_each_reset_lifts_as_alone(order: tuple[int, ...]) -> None:
    """After resets from large to small and back, with contact before each: the bits of the single environment."""
    env = LiftSoftEnv(config=lift(SET, image_outputs=("segmentation",)), obs_type="pixels", device="cpu")
    graph = env.task.graph
    for seed, k in enumerate(order):
        single = lift_alone(k)
        pictures, info = env.reset(seed=seed, options={**PLACE, "object": k})
        others, own = single.reset(seed=seed, options=PLACE)
        assert info["object"] == k and info["object_name"] == env.config.objects.names[k]
        assert str(info["parameters"]) == str(own["parameters"])
        touched = 0.0
        for step in range(STEPS):
            seen = [one.task.observation.numpy() for one in (env, single)]
            np.testing.assert_array_equal(*seen)
            for name, image in pictures.items():
                np.testing.assert_array_equal(image, others[name])
            action = actions(1, step)[0]
            pictures, reward, *_, info = env.step(action)
            others, own_reward, *_, own = single.step(action)
            assert reward == own_reward and info["object_height"] == own["object_height"]
            touched = max(touched, info["finger_force"].max())
        assert touched > 0.1
    assert env.task.graph is graph


PADS = ObjectSet((CUBE, replace(ROD, extents=(0.06, 0.06, 0.03))), materials=MATERIALS[:2], resample=True)
CASES: dict[str, tuple[Any, Any, list[list[float]]]] = {
    "PushSoft": (PushSoftVectorEnv, PushSoftConfig(objects=PADS), [[0.6, 0.0, 0.0, 0.0, 0.0]] * 10),
    "PressSoft": (PressSoftVectorEnv, PressSoftConfig(objects=PADS), [[0.0, 0.0, -1.0, 0.0, 0.0]] * 10),
    "PlaceInBin": (
        PlaceInBinVectorEnv,
        PlaceInBinConfig(
            objects=replace(PADS, objects=(CUBE, ROD)),
            position_range=(0.01, 0.01),
            scene=replace(PlaceInBinConfig().scene, others=()),
        ),
        [*[[0.0, -1.0, -1.0, 0.0, 1.0]] * 8, *[[0.0, -1.0, -1.0, 0.0, -1.0]] * 6],
    ),
    "ShapeSoft": (ShapeSoftVectorEnv, ShapeSoftConfig(objects=posts(resample=True)), [[0.3, 0.6, 0.0, 0.1, 0.7]] * 12),
    "RopeRoute": (
        RopeRouteVectorEnv,
        RopeRouteConfig(objects=ropes(resample=True)),
        [[0.1, -0.1, -1.0, 0.0, 0.0]] * 10,
    ),
}
"""Worlds of a task, a set of two objects, and actions towards them."""


@pytest.mark.parametrize("task", CASES)
def test_each_reset_of_each_world_is_as_alone(task: str) -> None:
    """Objects 0 and 1 in two worlds, then 1 and 0: observation, reward and figures are those of each one alone.

    PushSoft's reward knows the shape, PressSoft's gauge the height, PlaceInBin's reward size and height of the toy;
    ShapeSoft's targets, marker and clamped foot follow the post; the end of RopeRoute's rope lies where it is drawn,
    whatever the length, and its axis follows. So are films of PushSoft and ShapeSoft, whose goal has its shape.
    """
    kind, config, actions = CASES[task]
    config = replace(config, youngs_modulus_range=None, render_size=64)
    filmed = task in ("PushSoft", "ShapeSoft")
    film = {"render_mode": "rgb_array" if filmed else None, "device": "cpu"}
    many = kind(2, config=config, **film)
    single_kind = env_class(f"softmode/{task}-v0")
    singles = [single_kind(config=alone_in(config, k), **film) for k in range(2)]
    for seed, objects in enumerate(((0, 1), (1, 0))):
        _, infos = many.reset(seed=seed, options={"object": list(objects)})
        assert infos["object"].tolist() == list(objects)
        rows = [many.task.observation.numpy().copy()]
        results = []
        for action in np.array(actions, np.float32):
            _, rewards, *_, infos = many.step(np.tile(action, (2, 1)))
            rows.append(many.task.observation.numpy().copy())
            results.append((rewards, *(infos[name] for name in many.task.metric_names)))
        many.task.film.forget(np.ones(2, bool))  # the camera follows from where it was
        pictures = many.render()
        for world, k in enumerate(objects):
            single = singles[k]
            single.reset(seed=seed + world)
            np.testing.assert_array_equal(single.task.observation.numpy()[0], rows[0][world])
            for action, row, result in zip(np.array(actions, np.float32), rows[1:], results, strict=True):
                _, reward, *_, info = single.step(action)
                np.testing.assert_array_equal(single.task.observation.numpy()[0], row[world])
                assert [reward, *(info[name] for name in many.task.metric_names)] == [one[world] for one in result]
            if filmed:
                single.task.film.forget(np.ones(1, bool))
                np.testing.assert_array_equal(single.render(), pictures[world])


def test_a_clamped_post_that_may_invert_is_refused() -> None:
    """A post of the set that no world has yet is refused for its material, like one that stands there."""
    given = (MATERIALS[0], replace(MATERIALS[0], model=MaterialModel.NEO_HOOKEAN))
    objects = replace(posts(resample=True), materials=given, weights=(1.0, 0.0))
    with pytest.raises(ConfigError, match="exact regions has the material NEO_HOOKEAN"):
        ShapeSoftEnv(config=ShapeSoftConfig(objects=objects), device="cpu")


def test_worlds_draw_as_the_single_environment() -> None:
    """World i of many draws what the single environment with its seed draws; resets within the step draw again."""
    config = lift(SET, objects_one_hot=True)
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
    env = LiftSoftVectorEnv(8, config=lift(replace(SET, weights=(3.0, 0.0, 1.0))), device="cpu")
    counts = np.zeros(3)
    for seed in range(25):
        _, infos = env.reset(seed=8 * seed)
        counts += np.bincount(infos["object"], minlength=3)
    assert counts[1] == 0.0
    # 200 draws: the share of the first is 3/4 with a standard deviation of sqrt(3 / 16 / 200).
    assert counts[0] / counts.sum() == pytest.approx(0.75, abs=4.0 * np.sqrt(3.0 / 16.0 / 200.0))


def test_state_brings_its_object() -> None:
    """A world takes the state of a world with another object, and goes on with the same bits."""
    env = LiftSoftVectorEnv(2, config=lift(SET), device="cpu")
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
    env = LiftSoftEnv(config=lift(SET), device="cpu")
    with pytest.raises(ConfigError, match="object"):
        env.reset(options={"object": 3})
    with pytest.raises(ConfigError, match="in turn"):
        replace(SET, order="in_turn")
    scene = replace(LiftSoftConfig().scene, others=(CUBE,))
    with pytest.raises(ConfigError, match="others exclude each other"):
        LiftSoftEnv(config=lift(SET, scene=scene), device="cpu")
