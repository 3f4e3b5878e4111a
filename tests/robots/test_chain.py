"""The serial chain on the host, and the controller of loaded robots on the device."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode import robots
from softmode.errors import ConfigError
from softmode.robots.chain import serial_chain
from softmode.robots.control import ArmControlOptions
from softmode.robots.robot_control import RobotController
from softmode.robots.table_robot import TableRobot, finger_links
from tests.robots.files import ARM5, one_jaw, write_arm5, write_mjcf


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> TableRobot:
    """The arm of five joints at the table."""
    return robots.place_robot(robots.load(write_arm5(tmp_path_factory.mktemp("arm"))))


def test_forward_is_the_compiler_s(tmp_path: Path) -> None:
    """The product of exponentials gives MuJoCo's tool pose, at any coordinates, also of a frame in a turned tool."""
    half = np.sqrt(0.5)
    robot = robots.load(write_arm5(tmp_path))
    robot = dataclasses.replace(robot, tool=(*robot.tool[:3], half, 0.0, 0.0, half))
    frame = (0.01, -0.02, 0.03, 0.0, half, 0.0, half)
    chain, framed = serial_chain(robot), serial_chain(robot, frame)
    random = np.random.default_rng(1)
    q = random.uniform(*chain.span, (5, 5))
    position, rotation = chain.forward(q)
    place, turn = framed.forward(q)
    for k in range(5):
        pose = robot.tool_pose([*q[k], 0.0, 0.0])
        np.testing.assert_allclose(position[k], pose[:3], atol=1e-9)
        tool = Rotation.from_quat(pose[3:])
        np.testing.assert_allclose(rotation[k], tool.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(place[k], pose[:3] + tool.apply(frame[:3]), atol=1e-9)
        np.testing.assert_allclose(turn[k], (tool * Rotation.from_quat(frame[3:])).as_matrix(), atol=1e-9)


def test_jacobian_by_differences(tmp_path: Path) -> None:
    """dx/dq of the tool by central differences, whose error is h^2."""
    chain = serial_chain(robots.load(write_arm5(tmp_path)))
    q, h = np.array([[0.3, 0.4, 1.1, 0.9, -0.5]]), 1e-5
    jacobian = chain.jacobian(q)[0]
    for k in range(5):
        step = h * np.eye(5)[k]
        (ahead, turned), (back, before) = chain.forward(q + step), chain.forward(q - step)
        np.testing.assert_allclose(jacobian[:3, k], (ahead - back)[0] / (2 * h), atol=10 * h**2)
        spin = (turned - before)[0] / (2 * h) @ chain.forward(q)[1][0].T
        np.testing.assert_allclose(jacobian[3:, k], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=10 * h**2)


def test_inverse_of_each_pose_is_its_own(tmp_path: Path) -> None:
    """Poses that the arm has are found; one out of reach keeps its error and leaves the others' bits as they are."""
    chain = serial_chain(robots.load(write_arm5(tmp_path)))
    start = np.array([0.3, 0.4, 1.1, 0.9, -0.5])
    position, rotation = chain.forward(start + 0.2 * np.random.default_rng(2).uniform(-1.0, 1.0, (6, 5)))
    position[3] += [3.0, 0.0, 0.0]
    found, error = chain.inverse(position, rotation, start)
    there = np.arange(6) != 3
    assert error[there].max() < 1e-9 and error[3] > 2.0
    np.testing.assert_allclose(chain.forward(found)[0][there], position[there], atol=1e-9)
    for k in range(6):
        alone, _ = chain.inverse(position[k, None], rotation[k, None], start)
        np.testing.assert_array_equal(alone[0], found[k])


def test_reach_is_the_straight_arm_s(tmp_path: Path) -> None:
    """From the first joint, half the turn column up, to the tool of the straight arm: sums of lengths."""
    chain = serial_chain(robots.load(write_arm5(tmp_path)))
    # All lengths lie on one line when the arm stands straight up: 0.15 + 0.35 + 0.35 + 0.09 m.
    assert chain.reach == pytest.approx(0.94, abs=1e-3)


def test_place_at_the_table(placed: TableRobot) -> None:
    """The tool stands over the table, pointing down, where it was asked for; drives of the jaws press 40 N."""
    chain, (x, y, z, turn) = placed.chain, placed.base
    position, rotation = chain.forward(np.array(placed.robot.home)[None, list(chain.joints)])
    c, s = np.cos(turn), np.sin(turn)
    world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(world @ position[0] + [x, y, z], placed.home_position, atol=2e-3)
    np.testing.assert_allclose(world @ rotation[0], np.diag([-1.0, 1.0, -1.0]), atol=2e-2)
    assert placed.share == 1.0 and placed.jaw.opening == pytest.approx(0.09, abs=1e-3)
    # The gaps are made ascending by steps of 0.1 um, of 90 mm.
    assert placed.gripper.force_limit == pytest.approx(40.0, rel=16 * 1e-7 / 0.09 * 2)
    assert placed.gripper.drive_stiffness == pytest.approx(4000.0, rel=16 * 1e-7 / 0.09 * 2)
    low, high = placed.robot.joint_lower, placed.robot.joint_upper
    assert all(a - 1e-9 <= q <= b + 1e-9 for a, q, b in zip(low, placed.robot.home, high, strict=True))
    again = placed.joint_q_over((0.4, 0.1, 0.1), yaw=0.5)
    assert np.all(np.isfinite(again))
    with pytest.raises(ConfigError, match="pointing down"):
        placed.joint_q_over((3.0, 0.0, 0.1))


def test_drives_overcome_dry_friction_of_the_fingers(tmp_path: Path) -> None:
    """5 N of friction per slide leave 35 of 40 N, and the drive holds a finger within 0.5 mm: 10 kN/m. 50 N stop it."""
    stiff = ARM5.replace(' range="0 0.045"', ' range="0 0.045" frictionloss="5"')
    placed = robots.place_robot(robots.load(write_arm5(tmp_path, stiff)))
    # The gaps are made ascending by steps of 0.1 um, of 90 mm.
    near = 16 * 1e-7 / 0.09 * 2
    assert placed.grip_friction == pytest.approx(5.0, rel=near)
    assert placed.grip_force == pytest.approx(35.0, rel=2 * near)
    assert placed.gripper.force_limit == pytest.approx(40.0, rel=2 * near)
    assert placed.grip_stiffness == pytest.approx(1.0e4, rel=2 * near)
    drive = placed.robot.drives[-1]
    assert drive is not None and drive.effort_limit == pytest.approx(40.0, rel=2 * near)
    with pytest.raises(ConfigError, match="dry friction of its joints takes 50"):
        robots.place_robot(robots.load(write_arm5(tmp_path, stiff.replace('"5"', '"50"'))))


def test_fingers_of_the_scene(placed: TableRobot) -> None:
    """Each finger's links are bodies of the builder."""
    builder = newton.ModelBuilder()
    arm = placed.add_to(builder)
    names = [[builder.body_label[k].rpartition("/")[2] for k in side] for side in finger_links(placed, arm)]
    assert sorted(names) == [["jaw_a"], ["jaw_b"]]


class Driven:
    """The arm alone with its controller; the joints go where they are told."""

    def __init__(self, placed: TableRobot, mode: str = "pose_delta") -> None:
        world = newton.ModelBuilder()
        arm = placed.add_to(world)
        builder = newton.ModelBuilder()
        builder.replicate(world, 2)
        self.model = builder.finalize(device="cpu")
        self.state, self.control = self.model.state(), self.model.control()
        options = ArmControlOptions(mode=mode)  # type: ignore[arg-type]
        self.controller = RobotController(self.model, placed, arm, options)

    def act(self, row: list[float], count: int = 1) -> None:
        """Apply one action in both worlds; the joints follow at once."""
        action = wp.array(np.tile(np.float32(row), (2, 1)), dtype=float, device="cpu")
        for _ in range(count):
            self.controller.command(action, self.state)
            self.controller.write_targets(self.control)
            self.state.joint_q.assign(self.control.joint_target_q)
            self.controller.measure(self.state)


def test_steps_of_the_tool(placed: TableRobot) -> None:
    """A step moves the tool by its scale and keeps it vertical; all worlds alike; float32 and six iterations: 1 mm."""
    rig = Driven(placed)
    before = rig.controller.tool_pose.numpy().copy()
    np.testing.assert_allclose(before[0, :3], placed.home_position, atol=2e-3)
    rig.act([1.0, -1.0, -1.0, 1.0, 1.0], count=4)
    pose = rig.controller.tool_pose.numpy()
    np.testing.assert_allclose(pose[0, :3] - before[0, :3], 4 * 0.015 * np.array([1.0, -1.0, -1.0]), atol=1e-3)
    assert rig.controller.target_yaw.numpy()[0] == pytest.approx(4 * 0.08, abs=1e-2)
    down = np.array(wp.quat_rotate(wp.quat(*pose[0, 3:]), wp.vec3(0.0, 0.0, 1.0)))
    assert down[2] < -0.9999
    np.testing.assert_array_equal(pose[0], pose[1])


def test_opening_follows_the_command(placed: TableRobot) -> None:
    """The measured opening is what was commanded; full squeeze aims past closed by what saturates the drives."""
    rig = Driven(placed)
    assert rig.controller.opening.numpy()[0] == pytest.approx(placed.home_opening, abs=1e-5)
    rig.act([0.0, 0.0, 0.0, 0.0, -1.0], count=5)
    assert rig.controller.opening.numpy()[0] == pytest.approx(placed.home_opening - 5 * 0.006, abs=1e-5)
    rig.act([0.0, 0.0, 0.0, 0.0, -1.0], count=40)
    assert rig.controller.opening.numpy()[0] == pytest.approx(-1.05 * 2.0 * 0.01, rel=0.02)


def test_tool_stays_between_a_jaw_and_the_fixed_one(tmp_path: Path) -> None:
    """As the jaw closes by 30 mm the tool stays, and the link with the fixed jaw comes nearer by half of that."""
    placed = robots.place_robot(robots.load(write_arm5(tmp_path, one_jaw())))
    assert placed.jaw.follow in (0.5, -0.5)
    rig, chain = Driven(placed), serial_chain(placed.robot)
    before = rig.controller.tool_pose.numpy()[0, :3]
    hand = chain.forward(rig.controller.commanded_q.numpy()[:1, :5])[0]
    rig.act([0.0, 0.0, 0.0, 0.0, -1.0], count=5)
    np.testing.assert_allclose(rig.controller.tool_pose.numpy()[0, :3], before, atol=1e-3)
    moved = chain.forward(rig.controller.commanded_q.numpy()[:1, :5])[0] - hand
    assert np.linalg.norm(moved) == pytest.approx(0.5 * 5 * 0.006, abs=1e-3)


def test_steps_of_the_joints(placed: TableRobot) -> None:
    """Joint steps move every joint by the scale, within limits; the action has a number per joint and the gripper."""
    rig = Driven(placed, "joint_delta")
    assert rig.controller.action_size == 6
    before = rig.controller.commanded_q.numpy()[0].copy()
    rig.act([0.5, 0.0, -0.5, 0.0, 1.0, 1.0])
    after = rig.controller.commanded_q.numpy()[0]
    np.testing.assert_allclose(after[:5] - before[:5], 0.04 * np.array([0.5, 0.0, -0.5, 0.0, 1.0]), atol=1e-6)
    with pytest.raises(ConfigError, match=r"Expected \(2, 6\)"):
        rig.controller.command(wp.zeros((2, 5), dtype=float, device="cpu"), rig.state)


def test_robots_that_do_not_fit(tmp_path: Path) -> None:
    """No gripper, too few joints, too short: typed errors that name the remedy."""
    with pytest.raises(ConfigError, match=r"no gripper.*gripper="):
        robots.place_robot(robots.load(write_mjcf(tmp_path), end_effector="jaw_left"))
    with pytest.raises(ConfigError, match="2 joints between base and tool"):
        robots.place_robot(robots.load(write_mjcf(tmp_path)))
    short = write_arm5(tmp_path, ARM5.replace("0.35", "0.04"))
    with pytest.raises(ConfigError, match="finds no place"):
        robots.place_robot(robots.load(short))


def test_the_search_for_a_base_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It counts the poses that it tries, the same on every machine; the error says when they are spent."""
    robot = robots.load(write_arm5(tmp_path))
    assert 0.0 < robots.place_robot(robot, ranges=(0.4, 0.5)).share < 1.0
    monkeypatch.setattr("softmode.robots.table_robot._POSES", 10)
    with pytest.raises(ConfigError, match="in the 10 poses that are tried"):
        robots.place_robot(robot, ranges=(0.4, 0.5))
