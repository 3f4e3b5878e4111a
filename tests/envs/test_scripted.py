"""The scripted policy lifts the object, whatever its stiffness, and a user's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import trimesh

from softmode.cli.play import _why
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.lift_soft.log import LiftLog
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv, lift_scene
from softmode.envs.tasks.place_in_bin.scripted import ScriptedPlace
from softmode.envs.tasks.press_soft.scripted import ScriptedPress
from softmode.envs.tasks.push_soft.scripted import ScriptedPush
from softmode.envs.tasks.rope_route.scripted import ScriptedRope
from softmode.envs.tasks.shape_soft.scripted import ScriptedShape
from softmode.errors import ConfigError, GraspError
from softmode.objects.config import ObjectConfig
from softmode.splats.colored_mesh import ColoredMesh
from softmode.testing import assert_success
from tests.envs.conftest import Episodes, MakeEnv
from tests.shapes import SHAPES


def play(env: gym.Env, seed: int, **options: float) -> tuple[dict[str, Any], list[bool]]:
    """Play one episode; return the last info and whether each step counted as success."""
    observation, info = env.reset(seed=seed, options=options)
    policy = ScriptedLift(env)
    success = []
    for _ in range(150):
        observation, _, terminated, _, info = env.step(policy(observation))
        success.append(info["is_success"])
        if terminated:
            break
    return info, success


@pytest.mark.parametrize(
    ("seed", "modulus"),
    [(0, 2.0e4), *(pytest.param(*other, marks=pytest.mark.rest) for other in ((1, 2.0e5), (2, 2.0e6)))],
)
def test_lifts_soft_and_stiff_objects(lift: LiftSoftEnv, seed: int, modulus: float) -> None:
    """The object ends at the goal within the tolerance, in both fingers, the solver without a complaint.

    Success begins after `hold_steps` steps at the goal and lasts to the end.
    """
    info, success = play(lift, seed, youngs_modulus=modulus)
    assert info["is_success"]
    assert info["goal_distance"] < lift.config.goal_tolerance
    assert (info["finger_force"] > 0.5).all()
    assert info["reward_terms"]["hold"] == 2.0
    first = success.index(True)
    assert first >= lift.config.hold_steps and all(success[first:])
    assert not info["solver_status"] & 8  # WORLD_NOT_FINITE


@pytest.mark.slow
@pytest.mark.episodes(20)
@pytest.mark.parametrize("modulus", [None, 2.0e4, 2.0e6])
def test_succeeds_on_twenty_of_twenty_seeds(soft_env: MakeEnv, episode: Episodes, modulus: float | None) -> None:
    """20 of 20 seeds with random stiffness in 2e4..2e6 Pa, and at either end."""
    options = {} if modulus is None else {"youngs_modulus": modulus}
    assert_success(episode(soft_env("softmode/LiftSoft-v0"), options=options))


def test_tries_again_after_a_loss(lift: LiftSoftEnv) -> None:
    """Knocked out of the gripper and put elsewhere, the object is found and lifted again."""
    observation, _ = lift.reset(seed=0, options={"youngs_modulus": 2.0e5, "position": (0.45, 0.0)})
    policy = ScriptedLift(lift)
    info: dict[str, Any] = {}
    for _ in range(75):
        observation, *_, info = lift.step(policy(observation))
    assert info["object_height"] > 0.02
    q, qd = lift.scene.state.softmode.q, lift.scene.state.softmode.qd
    body = lift.scene.soft.body
    q.assign(body.affine(np.eye(3), (0.47, 0.09, lift.scene.soft.height + 1e-3)))
    qd.zero_()
    for _ in range(125):
        observation, _, terminated, _, info = lift.step(policy(observation))
        assert not terminated
    assert info["is_success"]


@pytest.mark.rest
def test_lifts_a_trained_capture(playbot: Path) -> None:
    """A robot from a trained splat, which cannot stand on its pointed foot, is lifted from where it lies."""
    env = LiftSoftEnv(splat=playbot)
    assert play(env, 0, youngs_modulus=3.0e4)[0]["is_success"]


@pytest.mark.slow
def test_lifts_a_trained_capture_on_ten_seeds(playbot: Path) -> None:
    """10 of 10 seeds with random stiffness."""
    env = LiftSoftEnv(splat=playbot, size=0.08)
    results = [play(env, seed)[0]["is_success"] for seed in range(10)]
    assert sum(results) == 10, [seed for seed, won in enumerate(results) if not won]


def test_what_does_not_fit_is_told_before_anything_moves() -> None:
    """A box of 12 cm: the width, the opening and a size that fits; the state keeps its bits."""
    cube = ObjectConfig(shape="box", extents=(0.12, 0.12, 0.12), build=lift_scene().object.build)
    env = LiftSoftEnv(config=LiftSoftConfig(scene=replace(lift_scene(), object=cube)))
    env.reset(seed=0)
    before = env.scene.state.joint_q.numpy().copy()
    with pytest.raises(GraspError, match=r"mm wide.*gripper takes 84 mm.*--size times 0\.[67]"):
        ScriptedLift(env)()
    np.testing.assert_array_equal(env.scene.state.joint_q.numpy(), before)


def test_a_grasp_that_is_gone_is_told(lift: LiftSoftEnv) -> None:
    """A gripper that opens less once the object has moved: no error, but the planner's reason, until one fits again."""
    observation, info = lift.reset(seed=0)
    policy = ScriptedLift(lift)
    policy(observation)
    assert policy.trouble == "" and _why(None, policy, info) == ""
    grasp = policy._grasp
    whole, grasp._jaw = grasp._jaw, replace(grasp._jaw, opening=0.02)
    grasp._planned_at = np.add(grasp.centre, [0.01, 0.0, 0.0])  # as if it had been planned a centimetre beside
    action = policy(observation)
    np.testing.assert_array_equal(action[:4], 0.0)  # it waits
    assert "the gripper takes 14 mm" in policy.trouble
    told = _why(LiftLog(lift.config), policy, {**info, "end_reason": 0})
    assert told == f", never touched, no grasp fits where it lies now: {policy.trouble}"
    grasp._jaw, grasp._planned_at = whole, grasp._planned_at + 0.01
    policy(observation)
    assert policy.trouble == ""
    grasp._attempts, policy._grasp.trouble = 1, "left over"
    policy.reset()
    assert policy.trouble == ""


@pytest.mark.parametrize("name", ["cup", pytest.param("ring chain", marks=pytest.mark.rest)])
def test_lifts_what_the_middle_does_not_hold(name: str) -> None:
    """A cup with a wall of 3 mm, and three linked rings, both of 80 mm: lifted on three seeds."""
    mesh = ColoredMesh.from_trimesh(trimesh.Trimesh(*SHAPES[name].geometry(), process=False), name=name)
    scene = replace(lift_scene(), object=replace(lift_scene().object, mesh=mesh))
    env = LiftSoftEnv(config=LiftSoftConfig(scene=scene))
    results = [play(env, seed)[0]["is_success"] for seed in range(3)]
    assert all(results), results


POLICIES = {
    "LiftSoft": ScriptedLift,
    "PushSoft": ScriptedPush,
    "PressSoft": ScriptedPress,
    "PlaceInBin": ScriptedPlace,
    "RopeRoute": ScriptedRope,
    "ShapeSoft": ScriptedShape,
}


@pytest.mark.parametrize("task", POLICIES)
def test_needs_its_own_environment(make_env: MakeEnv, task: str) -> None:
    """A foreign environment and one of another task are refused."""
    for env in (gym.make("CartPole-v1"), make_env("PressSoft" if task == "LiftSoft" else "LiftSoft")):
        with pytest.raises(ConfigError, match=f"this scripted policy plays {task} in"):
            POLICIES[task](env)


def test_needs_steps_of_the_tool(joints: LiftSoftEnv) -> None:
    """Other actions are refused; what has no policy is told by the entry point."""
    with pytest.raises(ConfigError, match="pose_delta"):
        ScriptedLift(joints)
    with pytest.raises(ConfigError, match="no scripted policy"):
        scripted_policy(gym.make("CartPole-v1"))
