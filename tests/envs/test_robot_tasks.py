"""Tasks with robots from files: observation, worlds, the scripted policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softmode import robots
from softmode.envs.robots import with_robot
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv, LiftSoftVectorEnv
from softmode.envs.tasks.press_soft.task import PressSoftConfig, PressSoftEnv
from softmode.envs.tasks.push_soft.task import PushSoftConfig, PushSoftEnv
from softmode.envs.tasks.rope_route.task import RopeRouteEnv
from softmode.errors import ConfigError
from softmode.robots.table_robot import TableRobot, tip_length
from tests.robots.files import ARM5, MJCF, write_arm5, write_mjcf


@pytest.fixture(scope="module")
def arm5(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the arm of five joints."""
    return write_arm5(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def env(arm5: Path) -> LiftSoftEnv:
    """LiftSoft with it, by the path of its file."""
    return LiftSoftEnv(robot=arm5, device="cpu")


def lift(env: LiftSoftEnv, seed: int, **options: Any) -> bool:
    """Play the scripted policy; return whether the object was lifted to the goal and held."""
    env.reset(seed=seed, options=options)
    policy = ScriptedLift(env)
    for _ in range(250):
        _, _, terminated, _, info = env.step(policy())
        if info["is_success"] or terminated:
            return bool(info["is_success"])
    return False


def test_observation_of_five_joints(env: LiftSoftEnv) -> None:
    """The joints' segment has five angles, those of the state; the tool is where the controller measures it."""
    seen, _ = env.reset(seed=3)
    task = env.task
    arm = task.config.scene.arm
    assert isinstance(arm, TableRobot)
    columns, segment = task.segments["joint_angles"]
    assert segment.size == 5 and env.action_space.shape == (5,)
    np.testing.assert_array_equal(seen[columns], env.scene.state.joint_q.numpy()[:5])
    np.testing.assert_allclose(seen[task.segments["tool_position"][0]], arm.home_position, atol=2e-3)
    assert seen[task.segments["opening"][0]][0] == pytest.approx(arm.home_opening, abs=1e-4)
    assert env.observation_space.contains(seen)


@pytest.mark.parametrize("modulus", [2e4, 2e6])
def test_scripted_lift(env: LiftSoftEnv, modulus: float) -> None:
    """The arm lifts a soft and a stiff object to the goal and holds it with both fingers."""
    assert lift(env, 1, youngs_modulus=np.array([modulus]))


def test_world_equals_the_single_environment(env: LiftSoftEnv, arm5: Path) -> None:
    """World 1 of 2 gives the observations of the single environment, bit for bit, with the same draws."""
    worlds = LiftSoftVectorEnv(2, robot=arm5, device="cpu")
    many, _ = worlds.reset(seed=[8, 9])
    one, _ = env.reset(seed=9)
    np.testing.assert_array_equal(many[1], one)
    action = np.float32([0.4, -0.3, -1.0, 0.5, -0.2])
    for _ in range(6):
        many = worlds.step(np.tile(action, (2, 1)))[0]
        one = env.step(action)[0]
    np.testing.assert_array_equal(many[1], one)
    worlds.close()


def test_state_of_a_loaded_robot(env: LiftSoftEnv) -> None:
    """A state goes on with the same bits."""
    env.reset(seed=4)
    state = env.get_state()
    action = np.float32([0.2, 0.1, -1.0, 0.3, -1.0])
    first = [env.step(action)[0] for _ in range(4)]
    env.set_state(state)
    second = [env.step(action)[0] for _ in range(4)]
    np.testing.assert_array_equal(first, second)


def test_wrist_camera(arm5: Path) -> None:
    """The camera hangs on the hand of the robot and sees something."""
    env = PushSoftEnv(robot=arm5, obs_type="pixels", config=PushSoftConfig(camera="wrist"), device="cpu")
    picture, _ = env.reset(seed=0)
    assert picture.std() > 5.0


def test_robots_and_tasks_that_do_not_fit(tmp_path: Path, arm5: Path) -> None:
    """A robot without gripper, what is no robot, and a task with the built-in arm only: typed errors."""
    bare = robots.load(write_mjcf(tmp_path, MJCF), end_effector="jaw_left")
    with pytest.raises(ConfigError, match="no gripper, which this task needs"):
        LiftSoftEnv(robot=bare)
    with pytest.raises(ConfigError, match="robot is a int"):
        LiftSoftEnv(robot=3)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="built-in arm only"):
        RopeRouteEnv(robot=arm5)


def test_samples_of_the_pad_are_as_near_as_finger_tips_are_wide(arm5: Path, tmp_path: Path) -> None:
    """Jaws of 4 mm take 168 cm2, the surface of the box around the pad, over 16 mm2; those of 12 mm the usual."""
    usual = PressSoftConfig().scene.object.surface_count
    assert with_robot(PressSoftConfig(), arm5).scene.object.surface_count == usual
    narrow = write_arm5(tmp_path, ARM5.replace('size="0.012 0.006 0.035"', 'size="0.012 0.002 0.035"'))
    found = with_robot(PressSoftConfig(), narrow)
    assert isinstance(found.scene.arm, TableRobot)
    width = found.scene.arm.jaw.thickness
    assert width == pytest.approx(0.004, abs=1e-4)
    assert found.scene.object.surface_count == pytest.approx(0.0168 / width**2, abs=1.0)
    assert with_robot(LiftSoftConfig(), narrow).scene.object == LiftSoftConfig().scene.object


@pytest.mark.parametrize("kind", [PressSoftEnv, pytest.param(PushSoftEnv, marks=pytest.mark.rest)])
def test_heights_are_those_of_finger_tips(kind: Any, arm5: Path) -> None:
    """Tips begin as high as the built-in arm's and stay as far off the table; the scripted policy succeeds."""
    env, own = kind(robot=arm5, device="cpu"), kind.task_class.config_class().scene
    arm, control = env.config.scene.arm, env.config.scene.control
    longer = tip_length(arm) - tip_length(own.arm)
    assert arm.home_position[2] - longer == pytest.approx(own.arm.home_position[2])
    assert control.workspace_lower[2] - longer == pytest.approx(own.control.workspace_lower[2])
    if kind is PressSoftEnv:
        assert arm.tool_stiffness == pytest.approx(env.task.arm_stiffness) == pytest.approx(3e3)
    env.reset(seed=1)
    policy = scripted_policy(env)
    for _ in range(150):
        _, _, terminated, _, info = env.step(policy(None))
        if info["is_success"]:
            return
        assert not terminated
    pytest.fail(f"no success: {info}")


def test_tool_stiffness(arm5: Path) -> None:
    """A vertical force at the tool bends the drives by force / stiffness, at first order."""
    arm = robots.place_robot(robots.load(arm5)).with_tool_stiffness(2.0e3)
    chain, force = arm.chain, 1.0
    stiffness = np.array([drive.stiffness for j in chain.joints if (drive := arm.robot.drives[j]) is not None])
    moved = chain.home + chain.jacobian(chain.home[None])[0, 2] * force / stiffness
    rise = chain.forward(moved[None])[0][0, 2] - chain.forward(chain.home[None])[0][0, 2]
    assert rise == pytest.approx(force / 2.0e3, rel=1e-2)  # the second order: 0.5 mm over a lever of 0.1 m


@pytest.mark.slow
@pytest.mark.skipif("aloha_arm" not in robots.available(), reason="this mujoco-warp ships no ALOHA arm")
def test_scripted_lift_of_the_aloha_arm() -> None:
    """An arm of six joints that ships with mujoco-warp lifts the plush."""
    env = LiftSoftEnv(robot="aloha_arm", device="cpu")
    assert lift(env, 2, youngs_modulus=np.array([2e5]))
