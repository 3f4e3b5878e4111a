"""The fingers of a gripper as they are measured: the built-in arm's, and those of robots from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from softmode import robots
from softmode.errors import ConfigError, GraspError
from softmode.robots import ArmDescription, GripperDescription, ParallelJaw, plan_grasps
from softmode.robots.jaws import gap_of, measured
from tests.robots.files import one_jaw, write_arm5, write_arm_and_gripper, write_mjcf, write_urdf
from tests.robots.test_grasp_planner import block, check


def test_jaw_of_the_built_in_arm() -> None:
    """Opening, pads and reach are those of the description; a finger is as thick as pad and finger bar together."""
    gripper = GripperDescription(stroke=0.07, pad_size=(0.02, 0.005, 0.03), finger_length=0.05)
    jaw = ParallelJaw.of(ArmDescription(gripper=gripper, home_opening=0.06))
    assert (jaw.opening, jaw.pad_width, jaw.pad_length, jaw.reach) == (0.07, 0.02, 0.03, 0.05)
    assert jaw.tip == 0.015 and jaw.thickness == pytest.approx(0.014) and jaw.friction == gripper.friction


def test_jaw_of_an_mjcf(tmp_path: Path) -> None:
    """The small robot's fingers meet at y = -5 mm and travel 40 mm each; the box is 60 x 20 mm."""
    jaw = ParallelJaw.of(robots.load(write_mjcf(tmp_path)))
    assert jaw.opening == pytest.approx(0.08, abs=1e-6)
    assert jaw.frame[1] == pytest.approx(-0.005, abs=1e-6)
    assert jaw.finger_width == pytest.approx(0.02, abs=1e-6)
    assert 0.01 <= jaw.thickness <= 0.02 + 1e-6


def test_jaw_of_a_urdf(tmp_path: Path) -> None:
    """Fingers at +-1 cm with a half thickness of 5 mm that travel 3 cm each: 7 cm; they stand out along x."""
    jaw = ParallelJaw.of(robots.load(write_urdf(tmp_path), asset_root=tmp_path))
    assert jaw.opening == pytest.approx(0.07, abs=1e-6)
    assert jaw.pad_length == pytest.approx(0.04, abs=1e-6)
    np.testing.assert_allclose(jaw.frame[:3], 0.0, atol=1e-6)


def test_hand_on_an_arm(tmp_path: Path) -> None:
    """A gripper from a file of its own is put on the flange: joints, tool and jaw are the gripper's.

    Its fingers travel 45 mm each from where they meet. The knuckle that stands out 10 mm is no pad.
    """
    arm, gripper = write_arm_and_gripper(tmp_path)
    robot = robots.load(arm, hand=gripper, end_effector="roll")
    assert robot.joint_names[-2:] == ("hand_jaw_a", "hand_jaw_b") and len(robot.joint_names) == 7
    assert robot.gripper is not None and robot.gripper.joints == ("hand_jaw_a", "hand_jaw_b")
    assert robot.end_effector == "hand_palm" and robot.tool[:3] == (0.0, 0.0, 0.06)
    jaw = ParallelJaw.of(robot)
    assert jaw.opening == pytest.approx(0.09, abs=1e-6)
    assert jaw.pad_length == pytest.approx(0.07, abs=1e-6)
    flange = robots.load(arm, end_effector="roll").tool_pose()
    np.testing.assert_allclose(np.linalg.norm(np.subtract(robot.tool_pose()[:3], flange[:3])), 0.06, atol=1e-6)
    with pytest.raises(ConfigError, match="no site or body 'elbow_joint' for the hand"):
        robots.load(arm, hand=gripper, end_effector="elbow_joint")


@pytest.mark.skipif("aloha_arm" not in robots.available(), reason="this mujoco-warp ships no ALOHA arm")
def test_jaw_of_the_aloha_arm_plans_a_grasp() -> None:
    """Its tips are 4 mm behind the tool point and close 3.5 mm below it; it takes a block of 40 mm, not of 70 mm."""
    robot = robots.load("aloha_arm")
    jaw = ParallelJaw.of(robot)
    assert jaw.frame[2] == pytest.approx(-0.0035, abs=5e-4)
    assert jaw.frame[0] + jaw.tip == pytest.approx(-0.004, abs=5e-4)
    assert 0.05 < jaw.opening < 0.07  # 35 mm of travel each, and the gap between the closed fingers
    points, normals, areas = block((0.04, 0.04, 0.04))
    check(points, normals, areas, plan_grasps(points, normals, areas, jaw)[0], jaw)
    with pytest.raises(GraspError, match="70 mm wide"):
        plan_grasps(*block((0.07, 0.07, 0.07)), jaw)


def test_jaw_that_turns_against_a_fixed_one(tmp_path: Path) -> None:
    """Its gap is that 20 mm behind the tips, 60 mm from the hinge: 60 mm tan q, until the tip has come up by as much.

    The middle of the pads stands off the fixed face by half of the gap.
    """
    robot = robots.load(write_arm5(tmp_path, one_jaw()))
    assert robot.end_effector == "roll" and robot.gripper is not None and robot.gripper.joints == ("jaw",)
    assert any("'jaw' closes" in note for note in robot.notes)
    grasping, jaw = measured(robot)
    assert grasping.gripper is not None
    last = grasping.gripper.open[0]
    assert np.cos(last) * 0.08 >= 0.06 > np.cos(last + 1.0 / 40.0) * 0.08
    for opening in (0.0, 0.4, 1.0):
        assert gap_of(grasping, jaw, opening) == pytest.approx(0.06 * np.tan(opening * last), abs=1e-9)
    np.testing.assert_allclose(jaw.frame[:3], (0.0, 0.0, 0.09), atol=1e-9)
    np.testing.assert_allclose(np.subtract(jaw.frame_at(0.04)[:3], jaw.frame[:3]), (0.0, 0.02, 0.0), atol=1e-9)


def test_mesh_that_fills_the_jaw_is_cut(tmp_path: Path) -> None:
    """A jaw with a foot that reaches over to the fixed one: its hull would leave no opening, that of slabs does.

    The slab of 10 mm that holds the foot ends below the pads, whose gap is that of the jaw alone.
    """
    jaw = trimesh.creation.box((0.02, 0.008, 0.08), trimesh.transformations.translation_matrix((0.0, 0.004, 0.04)))
    foot = trimesh.creation.box((0.02, 0.06, 0.009), trimesh.transformations.translation_matrix((0.0, -0.02, 0.0045)))
    trimesh.util.concatenate([jaw, foot]).export(tmp_path / "jaw.stl")
    text = one_jaw('<geom type="mesh" mesh="jaw" mass="0.05"/>').replace(
        "<worldbody>", '<asset><mesh name="jaw" file="jaw.stl"/></asset><worldbody>'
    )
    robot = robots.load(write_arm5(tmp_path, text))
    assert any("cut into 8 hulls" in note for note in robot.notes)
    assert robot.model.body("jaw").mass[0] == pytest.approx(0.05)
    assert 0.9 * 0.06 * np.tan(0.7) < measured(robot)[1].opening < 1.1 * 0.06 * np.tan(0.75)


@pytest.mark.parametrize(("gripper", "words"), [({}, "0 driven fingers"), ({"left": (0.0, 0.04)}, "opens 0 mm at its")])
def test_other_grippers_are_refused(gripper: dict[str, tuple[float, float]], words: str, tmp_path: Path) -> None:
    """No gripper, or one finger without a fixed one, is no parallel gripper."""
    with pytest.raises(ConfigError, match=words):
        ParallelJaw.of(robots.load(write_mjcf(tmp_path), gripper=gripper))
