"""Several objects of a set per world, of a number that resets change: those that are not there are inert."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

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
    scripted_policy,
)
from softmode.envs.tasks.place_in_bin.task import BALL, TOY, Bin, bin_scene
from softmode.errors import ConfigError, StateError
from softmode.learning.config_values import config_of, values_of
from softmode.objects import ObjectSet
from tests.envs.object_kinds import CUBE, KINDS, MATERIALS, PLACE, ROD, actions, lift, lift_alone

SLOTS = 4
SET = ObjectSet(KINDS, materials=MATERIALS, resample=True, per_world=(1, SLOTS))
NONE = [-1] * (SLOTS - 1)


def others(env: Any, name: str) -> np.ndarray:
    """Return a segment of the observation of world 0."""
    return env.task.observation.numpy()[0, env.task.segments[name][0]]


def test_absent_objects_are_inert() -> None:
    """With one of four objects there a world has the bits of the scene of that object, and its picture."""
    config = lift(SET, image_outputs=("segmentation",))
    env = LiftSoftEnv(config=config, obs_type="pixels", device="cpu")
    graph, place = env.task.graph, {**PLACE, "yaw": 0.3, "goal": (0.45, 0.0, 0.15)}
    for k in (1, 0):
        env.reset(seed=1, options={"object": [k, 2, 0, 1]})  # all there before, and moved
        for step in range(4):
            env.step(actions(1, step)[0])
        single = lift_alone(k)
        _, info = env.reset(seed=1, options={**place, "object": [k, *NONE]})
        assert info["object"].tolist() == [k, *NONE] and info["object_name"] == (SET.names[k],)
        single.reset(seed=1, options=place)
        touched = 0.0
        for step in range(22):
            pictures, reward, *_, info = env.step(actions(1, step)[0])
            mine, own_reward, *_, own = single.step(actions(1, step)[0])
            assert reward == own_reward and info["solver_status"] == own["solver_status"] == 0
            for name, (columns, _) in single.task.segments.items():
                np.testing.assert_array_equal(others(env, name), single.task.observation.numpy()[0, columns])
            # the map of the shadow spans other splats: a few pixels at its rim differ by a few of 255
            away = np.abs(pictures["pixels"].astype(int) - mine["pixels"])
            assert away.max() <= 24 and (away > 0).mean() < 0.02
            np.testing.assert_array_equal(pictures["segmentation"] == 0, mine["segmentation"] == 0)
            touched = max(touched, info["finger_force"].max())
            assert not others(env, "other_present").any() and not others(env, "other_offsets").any()
        np.testing.assert_array_equal(env.scene.solver.iteration.numpy(), single.scene.solver.iteration.numpy())
        assert touched > 0.1
    assert env.task.graph is graph


def test_labels_of_those_that_are_there() -> None:
    """A picture shows as many objects as there are, by their labels; the marker is the last."""
    env = LiftSoftEnv(config=lift(SET, image_outputs=("segmentation",), image_size=96), obs_type="pixels", device="cpu")
    labels = env.task.scene.cameras[96, 96].labels
    names = [labels.index(f"splats/{slot}") for slot in range(SLOTS)]
    for objects in ([0, 1, -1, -1], [2, 2, 1, 0], [0, -1, -1, -1]):
        pictures, _ = env.reset(seed=4, options={**PLACE, "object": objects})
        seen = [name in pictures["segmentation"] for name in names]
        assert seen == [k >= 0 for k in objects]


def test_worlds_are_the_single_environment() -> None:
    """World i draws number, objects and places of the single environment with its seed, and has its bits."""
    config = lift(SET, objects_one_hot=True)
    many = LiftSoftVectorEnv(3, config=config, device="cpu", max_episode_steps=4, autoreset_mode="SameStep")
    first, infos = many.reset(seed=11)
    rows, moves = [infos["object"].copy()], []
    seen = [first]
    for _ in range(5):
        for step in range(4):
            observation, *_, infos = many.step(actions(3, step))
            moves.append(actions(3, step))
            seen.append(observation)
        rows.append(infos["object"].copy())
    numbers = (np.array(rows) >= 0).sum(axis=2)
    assert numbers.min() == 1 and numbers.max() == SLOTS
    code = many.task_columns("object_one_hot")
    expected = np.where(rows[-1][:, :, None] >= 0, np.eye(3)[rows[-1]], 0.0)
    np.testing.assert_array_equal(seen[-1][:, code], expected.reshape(3, -1))
    single = LiftSoftEnv(config=config, device="cpu")
    for w in range(3):
        observation, info = single.reset(seed=11 + w)
        for at, row in enumerate(seen):
            np.testing.assert_array_equal(observation, row[w])
            if at < len(moves):
                observation, *_, info = single.step(moves[at][w])
                if (at + 1) % 4 == 0:
                    observation, info = single.reset()
                    assert info["object"].tolist() == rows[(at + 1) // 4][w].tolist()


def test_numbers_are_drawn_equally_often() -> None:
    """Every number from the least to the most comes as often, and objects fill the first slots."""
    objects = replace(SET, per_world=(2, SLOTS))
    env = LiftSoftVectorEnv(6, config=lift(objects), device="cpu")
    counts = np.zeros(SLOTS + 1)
    for seed in range(30):
        _, infos = env.reset(seed=6 * seed)
        there = infos["object"] >= 0
        assert (np.sort(there, axis=1)[:, ::-1] == there).all()
        counts += np.bincount(there.sum(axis=1), minlength=SLOTS + 1)
        assert [len(names) for names in infos["object_name"]] == there.sum(axis=1).tolist()
    # 180 draws of three numbers: each share has a standard deviation of sqrt(2/9/180) = 0.035
    np.testing.assert_allclose(counts / counts.sum(), [0.0, 0.0, 1 / 3, 1 / 3, 1 / 3], atol=0.14)


@pytest.mark.parametrize(("kind", "config"), [(LiftSoftEnv, LiftSoftConfig), (PushSoftEnv, PushSoftConfig)])
def test_objects_begin_apart_and_stay(kind: Any, config: Any) -> None:
    """All eight lie beside each other, at rest on the table, none in another; offsets and materials are theirs."""
    objects = ObjectSet((CUBE, ROD), materials=MATERIALS[:2], resample=True, per_world=8)
    env = kind(config=config(objects=objects, youngs_modulus_range=None), device="cpu")
    for seed in range(3):
        _, info = env.reset(seed=seed)
        centres = env.scene.object_position.numpy()[0]
        np.testing.assert_array_equal(others(env, "other_offsets").reshape(-1, 3), centres[1:] - centres[0])
        assert others(env, "other_present").tolist() == [1.0] * 7
        apart = np.linalg.norm(centres[:, None, :2] - centres[None, :, :2], axis=2) + np.eye(8)
        width = max(np.linalg.norm(x.body.surface.points[:, :2], axis=1).max() for x in env.scene.occupancy.choices)
        assert apart.min() > 2.0 * width + env.config.others_clearance - 1e-6
        modulus = env.scene.model.softmode.youngs_modulus.numpy()
        np.testing.assert_array_equal(modulus, [np.float32(MATERIALS[k].youngs_modulus) for k in info["object"]])
        for _ in range(4):
            *_, info = env.step(np.zeros(5, np.float32))
        assert info["solver_status"] == 0
        np.testing.assert_allclose(env.scene.object_position.numpy()[0], centres, atol=1.5e-3)


def test_objects_touch_each_other() -> None:
    """A cube that is pushed against another one moves it, and one that is not there does not stand in the way."""
    objects = ObjectSet((CUBE,), materials=MATERIALS[:1], resample=True, per_world=(1, 2))
    env = PushSoftEnv(config=PushSoftConfig(objects=objects, youngs_modulus_range=None), device="cpu")
    place = {"position": (0.41, 0.0), "yaw": 0.0, "other_place_1": (0.0, 0.056), "other_yaw_1": 0.0}
    moved = []
    for other in (0, -1):
        env.reset(seed=2, options={**place, "object": [0, other]})
        start = env.scene.object_position.numpy()[0].copy()
        for _ in range(25):
            env.step(np.array([0.8, 0.0, 0.0, 0.0, 0.0], np.float32))
        moved.append(env.scene.object_position.numpy()[0] - start)
    assert moved[0][0, 0] > 0.02 and moved[0][1, 0] > 0.01
    assert moved[1][0, 0] > 0.02 and not moved[1][1].any()


def test_state_brings_number_and_objects() -> None:
    """A state taken with three objects goes on with the same bits in a world that had one, and as bytes."""
    env = LiftSoftVectorEnv(2, config=lift(SET), device="cpu")
    env.reset(seed=3, options={**PLACE, "object": [[0, 1, 2, -1], [1, -1, -1, -1]]})
    for step in range(8, 14):
        env.step(actions(2, step))
    kept = env.get_state().to_bytes()
    after = [env.step(actions(2, step))[0] for step in range(14, 18)]
    env.reset(seed=5, options={**PLACE, "object": [[2, *NONE], [2, 2, 2, 2]]})
    env.step(actions(2, 0))
    env.set_state(kept)
    for step, row in zip(range(14, 18), after, strict=True):
        observation, *_, infos = env.step(actions(2, step))
        np.testing.assert_array_equal(observation, row)
    assert infos["object"].tolist() == [[0, 1, 2, -1], [1, -1, -1, -1]]
    fewer = LiftSoftVectorEnv(2, config=lift(replace(SET, per_world=(1, 2))), device="cpu")
    with pytest.raises(StateError):
        fewer.set_state(kept)


def test_distractors_are_not_the_object() -> None:
    """Fingers that hold another object have not grasped the one of the task."""
    env = LiftSoftEnv(config=lift(SET), device="cpu")
    place = {"position": (0.45, 0.1), "others_turn": 0.0, "other_place_1": (-np.pi / 2, 0.1), "other_yaw_1": 0.0}
    env.reset(seed=0, options={**place, "object": [0, 0, -1, -1]})
    felt = 0.0
    for step in range(70):
        down = np.array([0.0, 0.0, -1.0, 0.0, 1.0 if step < 18 else -1.0], np.float32)
        *_, info = env.step(down)
        felt = max(felt, info["finger_force"].min())
        assert info["reward_terms"]["grasp"] == 0.0
    assert felt > 0.1


def test_toys_are_placed_one_after_another() -> None:
    """The scripted policy puts three toys into the bin; success is all of them, the reward counts those that are in."""
    env = PlaceInBinEnv(config=bin_of((TOY, BALL), per_world=(1, 4)), device="cpu")
    policy: Any = scripted_policy(env)
    env.reset(seed=1, options={"object": [0, 0, 1, -1]})
    policy.reset()
    placed = {0: 0.0}
    for _ in range(700):
        _, reward, terminated, _, info = env.step(policy())
        assert not terminated
        inside = int(info["others_inside"])
        terms = info["reward_terms"]
        assert inside / 3 <= terms["reach"] <= 1.0 and terms["carry"] >= inside - 1e-6
        placed[inside] = reward
        if info["is_success"]:
            break
    assert info["is_success"] and list(placed) == [0, 1, 2]
    assert reward == pytest.approx(sum(terms.values()))
    assert terms["rest"] == 2.0 and terms["release"] == pytest.approx(2.0)


def test_one_toy_of_several_is_placed_as_alone() -> None:
    """Where one toy is there PlaceInBin has the bits of the task of that toy, reward and figures included."""
    config = bin_of((TOY, BALL), per_world=(1, 3))
    env = PlaceInBinEnv(config=config, device="cpu")
    single = PlaceInBinEnv(config=replace(config, objects=None, scene=replace(config.scene, object=BALL)), device="cpu")
    place = {"position": (0.43, -0.12), "yaw": 0.2, "youngs_modulus": 1e5}
    env.reset(seed=0, options={**place, "object": [1, -1, -1]})
    single.reset(seed=0, options=place)
    policies = [scripted_policy(one) for one in (env, single)]
    for _ in range(60):
        move = policies[0]()
        np.testing.assert_array_equal(move, policies[1]())
        _, reward, _, _, info = env.step(move)
        _, own_reward, _, _, own = single.step(move)
        assert reward == own_reward and str(info["reward_terms"]) == str(own["reward_terms"])
        assert [info[name] for name in env.task.metric_names] == [own[name] for name in env.task.metric_names]
    assert info["object_height"] > 0.05


def test_a_toy_that_falls_ends_the_episode() -> None:
    """Any toy that leaves the table is dropped."""
    env = PlaceInBinEnv(config=bin_of((TOY,), per_world=2), device="cpu")
    env.reset(seed=0, options={"other_place_1": (-np.pi / 2, 0.5)})
    for _ in range(20):
        *_, terminated, _, info = env.step(np.zeros(5, np.float32))
        if terminated:
            break
    assert terminated and info["failure"] == "dropped"


def bin_of(toys: Any, **number: Any) -> PlaceInBinConfig:
    """Return PlaceInBin with toys of a set on the table and an empty bin."""
    return PlaceInBinConfig(
        objects=ObjectSet(toys, resample=True, **number),
        scene=replace(bin_scene(), others=()),
        position_range=(0.02, 0.02),
        others_clearance=0.05,
    )


def test_configuration_is_kept_in_files() -> None:
    """Training files hold the number of objects."""
    config = lift(SET)
    assert config_of(LiftSoftConfig, values_of(config)).objects.per_world == (1, SLOTS)


def test_what_cannot_be_says_so() -> None:
    """Numbers outside 1..8, worlds that keep their objects, tasks of one object, tables too small."""
    for number in (0, 9, (0, 3), (3, 9), 2.5, "3", (1, 2, 3), (4, 2)):
        with pytest.raises(ConfigError, match="per_world"):
            replace(SET, per_world=number)
    with pytest.raises(ConfigError, match="resample"):
        ObjectSet(KINDS, per_world=2)
    with pytest.raises(ConfigError, match="one object per world"):
        PressSoftEnv(config=PressSoftConfig(objects=SET), device="cpu")
    with pytest.raises(ConfigError, match="do not fit on the table"):
        LiftSoftEnv(config=lift(replace(SET, per_world=8), others_clearance=0.2), device="cpu")
    with pytest.raises(ConfigError, match="others exclude each other"):
        PlaceInBinEnv(config=replace(bin_of((TOY,), per_world=2), scene=bin_scene()), device="cpu")
    with pytest.raises(ConfigError, match="do not fit within"):
        PlaceInBinEnv(config=bin_of((TOY,), per_world=8), device="cpu")
    small = replace(bin_of((TOY,), per_world=4), bin=Bin(inner=(0.06, 0.06)))
    with pytest.raises(ConfigError, match="do not fit a bin"):
        PlaceInBinEnv(config=small, device="cpu")
    env = LiftSoftEnv(config=lift(SET), device="cpu")
    for wrong in ([-1, 0, -1, -1], [0, 3, -1, -1], [0, 1]):
        with pytest.raises(ConfigError, match="object"):
            env.reset(options={"object": wrong})
