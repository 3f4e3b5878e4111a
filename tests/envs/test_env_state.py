"""States that are taken and given back: the same bits afterwards, single worlds of many, files, refusals."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softmode.envs import EnvState, PushSoftConfig, SoftEnv, SoftVectorEnv, scripted_policy
from softmode.envs.catalogue import config_class
from softmode.errors import ConfigError, StateError
from softmode.files import archive_bytes
from softmode.splats.cameras.camera_randomization import CameraRandomization
from tests.envs.conftest import MakeEnv
from tests.task_ids import IDS

TASKS = ("LiftSoft", "PushSoft", "PressSoft", "ShapeSoft", "RopeRoute", "PlaceInBin")
WORLDS = 3


def make(task: str, **options: Any) -> SoftEnv:
    """Return a bare environment of a task, of its own: of other options, or beside the one that tests share."""
    return bare(gym.make(IDS[task], **options))


def bare(env: gym.Env) -> SoftEnv:
    """Return the environment inside its wrappers."""
    assert isinstance(env.unwrapped, SoftEnv)
    return env.unwrapped


def make_vec(task: str = "PushSoft", **options: Any) -> SoftVectorEnv:
    """Return a task's vector environment of three worlds."""
    env = gym.make_vec(IDS[task], num_envs=WORLDS, **options)
    assert isinstance(env, SoftVectorEnv)
    return env


def same(a: Any, b: Any) -> None:
    """Assert that two trees hold the same bits."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for name in a:
            same(a[name], b[name])
    elif isinstance(a, (tuple, list)):
        for one, other in zip(a, b, strict=True):
            same(one, other)
    else:
        np.testing.assert_array_equal(a, b)


def play(env: SoftEnv | SoftVectorEnv, actions: np.ndarray) -> list[Any]:
    """Return what an environment makes of actions."""
    return [env.step(action) for action in actions]


def noise(count: int, shape: tuple[int, ...], seed: int = 1) -> np.ndarray:
    """Return random actions."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, *shape)).astype(np.float32)


def play_until_held(env: SoftEnv) -> None:
    """Play the scripted policy until the fingers have pressed for three steps, both where the task is to grasp."""
    observation, _ = env.reset(seed=4)
    policy, steps = scripted_policy(env), 0
    for _ in range(200):
        observation = env.step(policy(observation))[0]
        pressed = np.linalg.norm(env.task.scene.finger_force.numpy()[0], axis=1) > 0.02
        steps = steps + 1 if pressed.sum() > env.task.grasps else 0
        if steps == 3:
            return
    raise AssertionError("the fingers never pressed")


def with_pictures(task: str, drawn: bool) -> Any:
    """Return parameters; of each task one case is tested in every run, that of PushSoft with pictures."""
    marks = () if drawn == (task == "PushSoft") else pytest.mark.rest
    return pytest.param(task, drawn, marks=marks, id=f"{task}-{'pictures' if drawn else 'state'}")


@pytest.mark.parametrize(("task", "drawn"), [with_pictures(task, drawn) for drawn in (False, True) for task in TASKS])
def test_a_run_goes_on_with_the_same_bits(make_env: MakeEnv, task: str, drawn: bool) -> None:
    """Amid contact, in the same environment after another episode, and in a new one; the draws after it too.

    With pictures, materials, sizes and cameras are drawn as well.
    """
    options: dict[str, Any] = {}
    if drawn:
        cameras = CameraRandomization(translation=0.02, light=0.2, splat_tint=0.1)
        ranges = {"density_range": (200.0, 300.0), "friction_range": (0.5, 0.9), "scale_range": (0.95, 1.05)}
        if task == "ShapeSoft":  # its object is clamped, and keeps its scale
            del ranges["scale_range"]
        varied = replace(config_class(IDS[task])(), camera_randomization=cameras, image_size=48, **ranges)
        options = {"obs_type": "pixels_agent_pos", "config": varied}
    env = make(task, **options) if drawn else bare(make_env(task))
    play_until_held(env)
    state, after = env.get_state(), noise(12, env.action_space.shape or ())
    clean = [*play(env, after), env.reset(), *play(env, after[:2])]
    env.reset(seed=9)
    play(env, noise(7, env.action_space.shape or (), seed=2))
    other = make(task, **options)
    for one in (env, other):
        one.set_state(EnvState.load(state.to_bytes()))
        same(clean, [*play(one, after), one.reset(), *play(one, after[:2])])


@pytest.mark.parametrize("mode", ["NextStep", pytest.param("SameStep", marks=pytest.mark.rest)])
def test_masked_worlds_go_back_and_the_others_go_on(mode: str) -> None:
    """World 1 goes back, worlds 0 and 2 keep every bit; ends of episodes and the draws after them are the state's."""
    env, after = make_vec(autoreset_mode=mode, max_episode_steps=12), noise(10, (WORLDS, 5))
    env.reset(seed=2)
    play(env, noise(8, (WORLDS, 5), seed=5))
    state = env.get_state()
    clean = play(env, after)
    assert any(result[3].any() for result in clean)
    mask = np.array([False, True, False])
    env.set_state(state)
    play(env, noise(3, (WORLDS, 5), seed=6))
    there = env.get_state()
    env.set_state(state, mask)
    mixed = env.get_state()
    for name, values in mixed.arrays.items():
        np.testing.assert_array_equal(values[mask], state.arrays[name][mask], err_msg=name)
        np.testing.assert_array_equal(values[~mask], there.arrays[name][~mask], err_msg=name)
    played = play(env, after)
    for one, other in zip(clean, played, strict=True):
        same([one[k][1] for k in range(4)], [other[k][1] for k in range(4)])
    env.close()


def test_one_world_is_the_model_of_many(make_env: MakeEnv) -> None:
    """Every world of a vector environment, in one process or two, goes on from a single environment's state alike."""
    single = bare(make_env("PushSoft"))
    play_until_held(single)
    state, after = single.get_state(), noise(5, (5,))
    clean = play(single, after)
    for processes in (1, 2):
        many = make_vec(processes=processes)
        observation, _ = many.reset(options={"state": state})
        np.testing.assert_array_equal(observation, np.tile(state.arrays["task.observation"], (WORLDS, 1)))
        for one, all_of_them in zip(clean, play(many, np.tile(after[:, None], (1, WORLDS, 1))), strict=True):
            for world in range(WORLDS):
                np.testing.assert_array_equal(one[0], all_of_them[0][world])
                assert np.float32(one[1]) == all_of_them[1][world]
        back = many.get_state().worlds([2])
        single.set_state(back)
        same(single.get_state().arrays, back.arrays)
        many.close()


def test_the_picture_of_a_reset_is_of_the_state(make_env: MakeEnv) -> None:
    """A reset to a state returns its picture; an environment without cameras takes the state too."""
    config = PushSoftConfig(camera_randomization=CameraRandomization(translation=0.02, light=0.2), image_size=48)
    env = make("PushSoft", obs_type="pixels", config=config)
    env.reset(seed=1)
    shown = play(env, noise(2, (5,)))[-1][0]
    state, after = env.get_state(), noise(2, (5,), seed=3)
    clean = [*play(env, after), env.reset()]
    env.reset(seed=8)
    observation, _ = env.reset(options={"state": state})
    np.testing.assert_array_equal(observation, shown)
    same(clean, [*play(env, after), env.reset()])
    blind = bare(make_env("PushSoft"))
    blind.set_state(state)
    same(clean[0][1:], blind.step(after[0])[1:])


def test_a_copy_goes_on_alike_and_alone(make_env: MakeEnv) -> None:
    """copy.deepcopy, through Gymnasium's wrappers, and of many worlds."""
    for env, shape in ((make_env("PushSoft"), (5,)), (make_vec(), (WORLDS, 5))):
        env.reset(seed=3)
        for action in noise(5, shape, seed=4):
            env.step(action)
        twin, actions = copy.deepcopy(env), noise(4, shape)
        assert twin.spec == env.spec
        clean = [env.step(action) for action in actions]
        same(clean, [twin.step(action) for action in actions])
        same(env.reset(), twin.reset())
        twin.close()


def test_a_finished_episode_begins_again_from_its_state() -> None:
    """A reset to a state whose episode had ended goes on from there instead of drawing a new one."""
    env = make_vec(max_episode_steps=3)
    env.reset(seed=0)
    play(env, noise(3, (WORLDS, 5)))
    state = env.get_state()
    assert state.arrays["task.done"].all()
    env.reset(options={"state": state})
    reward = env.step(np.zeros((WORLDS, 5), np.float32))[1]
    assert (reward != 0.0).all()
    env.close()


def test_files_and_refusals(make_env: MakeEnv, tmp_path: Path) -> None:
    """A file is the state; one of another version, task, robot or object is refused, and nothing has moved."""
    env, other = bare(make_env("PushSoft")), bare(make_env("LiftSoft"))
    env.reset(seed=0)
    other.reset(seed=0)
    state = env.get_state()
    state.save(tmp_path / "state.npz")
    loaded = EnvState.load(tmp_path / "state.npz")
    same(state.arrays, loaded.arrays)
    assert (loaded.owner, loaded.random) == (state.owner, state.random)
    play(env, noise(2, (5,)))
    before = env.get_state().arrays
    config = PushSoftConfig()
    scene = config.scene
    wide = replace(scene.object, extents=(0.08, 0.08, 0.04))
    arm = replace(scene.arm, home_position=(0.42, 0.0, 0.17))
    newer = archive_bytes({"format": "softmode-env-state", "version": 2}, {})
    short = EnvState(owner=state.owner, arrays={**state.arrays, "state.joint_q": np.zeros((1, 2))}, random=(None,))
    undented = EnvState(owner=state.owner, arrays=dict(state.arrays), random=(None,))
    undented.arrays.pop("state.softmode.dent")
    for bad, message in (
        (other.get_state(), "task is LiftSoft"),
        (make("PushSoft", config=replace(config, scene=replace(scene, object=wide))).get_state(), "objects"),
        (
            make("PushSoft", config=replace(config, scene=replace(scene, arm=arm))).get_state(),
            "robot",
        ),
        (short, "state.joint_q is of 2 numbers"),
        (undented, "state.softmode.dent is absent in the state"),
        (newer, "version 2"),
        (state.to_bytes()[:200], "damaged"),
        ("state.npz", "state is a str"),
    ):
        with pytest.raises(StateError, match=message):
            env.set_state(bad)
    for options in ({"state": state, "yaw": 0.1}, {"state": state.worlds([0, 0])}):
        with pytest.raises(ConfigError, match=r"excludes|2 worlds"):
            env.reset(options=options)
    with pytest.raises(ConfigError, match="excludes"):
        env.reset(seed=1, options={"state": state})
    same(before, env.get_state().arrays)
