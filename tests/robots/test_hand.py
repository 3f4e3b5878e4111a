"""End effector and gripper of robots whose files name neither."""

from __future__ import annotations

from pathlib import Path

import pytest

from softmode import robots
from softmode.errors import ConfigError
from tests.robots.files import ARM5, MJCF, write_arm5, write_mjcf


def test_a_robot_without_any_hint(tmp_path: Path) -> None:
    """The end effector is the link in which the jaws meet; they close where they are near; a tendon drives both."""
    robot = robots.load(write_arm5(tmp_path))
    assert robot.end_effector == "roll" and robot.hand_links == ("roll", "jaw_a", "jaw_b")
    assert robot.gripper is not None and robot.gripper.joints == ("jaw_a", "jaw_b")
    assert robot.gripper.closed == (0.0, 0.0) and robot.gripper.open == (0.045, 0.045)
    # A servo of 100 N/m on the mean of both: moving together they answer with 100 N/m in all, 50 N/m each.
    assert [drive.stiffness for drive in robot.drives[-2:] if drive] == pytest.approx([50.0, 50.0])
    assert any("two fingers" in note or "2 fingers" in note for note in robot.notes)
    assert any("key frame 'home'" in note for note in robot.notes)


@pytest.mark.parametrize(
    ("name", "found"),
    [("my_tcp", "my_tcp"), ("Left_Pinch", "pinch"), ("panda_hand", "_hand"), ("x/gripper_frame_link", "gripper_frame")],
)
def test_patterns_of_names(name: str, found: str, tmp_path: Path) -> None:
    """A site whose name ends as tools are called is taken, and the note says which pattern it fits."""
    robot = robots.load(write_mjcf(tmp_path, MJCF.replace('site name="pinch"', f'site name="{name}"')))
    assert robot.end_effector == "fore"
    note = next(note for note in robot.notes if note.startswith("end effector"))
    assert name in note and found in note


def test_a_tool_beside_the_fingers(tmp_path: Path) -> None:
    """A tool link that is fixed to the hand carries no fingers itself: those of the hand are found."""
    text = ARM5.replace('<body name="jaw_a"', '<body name="hand_tcp" pos="0 0 0.06"/><body name="jaw_a"')
    robot = robots.load(write_arm5(tmp_path, text))
    assert robot.end_effector == "hand_tcp"
    assert robot.gripper is not None and robot.gripper.joints == ("jaw_a", "jaw_b")
    assert set(robot.hand_links) == {"roll", "hand_tcp", "jaw_a", "jaw_b"}


def test_a_joint_that_closes_nothing(tmp_path: Path) -> None:
    """A wheel behind the hand that turns about its own axis is left out of the gripper, and a note says so."""
    wheel = '<body name="wheel" pos="0 0 0.09"><joint name="spin" axis="0 0 1" range="-3 3"/>'
    wheel += '<geom type="box" size="0.02 0.02 0.01" mass="0.1"/></body>'
    text = ARM5.replace('<body name="jaw_a"', wheel + '<body name="jaw_a"').replace(
        '<position joint="roll"/>', '<position joint="roll"/><position joint="spin"/>'
    )
    text = text.replace("1.34 0 0.045 0.045", "1.34 0 0 0.045 0.045")
    robot = robots.load(write_arm5(tmp_path, text), end_effector="roll")
    assert robot.gripper is not None and "spin" not in robot.gripper.joints
    assert any("'spin'" in note and "left out" in note for note in robot.notes)


def test_joints_swapped_ends(tmp_path: Path) -> None:
    """Where the axes point the other way, the upper end closes."""
    text = ARM5.replace('axis="0 1 0" range="0 0.045"', 'axis="0 -1 0" range="-0.045 0"')
    text = text.replace("0.045 0.045", "-0.045 0.045").replace('"jaw_a" coef="0.5"', '"jaw_a" coef="-0.5"')
    robot = robots.load(write_arm5(tmp_path, text))
    assert robot.gripper is not None
    assert dict(zip(robot.gripper.joints, robot.gripper.open, strict=True)) == {"jaw_a": -0.045, "jaw_b": 0.045}


def test_bandwidth_of_the_drives(tmp_path: Path) -> None:
    """Drives of joints without a servo have the natural frequency that is asked for."""
    text = ARM5[: ARM5.index("  <actuator>")] + ARM5[ARM5.index("</actuator>") + len("</actuator>") :]
    robot = robots.load(write_arm5(tmp_path, text), drive_bandwidth=5.0)
    assert robot.drive_frequencies() == pytest.approx(5.0, rel=1e-6)
    with pytest.raises(ConfigError, match=r"drive_bandwidth.*Hz"):
        robots.load(tmp_path / "arm5.xml", drive_bandwidth=0.0)
