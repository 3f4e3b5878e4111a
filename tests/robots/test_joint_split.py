"""Links with several joints and floating bases become links of one joint each, and move as MuJoCo moves them."""

import importlib
from typing import Any

import newton
import numpy as np
import pytest

from softmode import robots
from tests.robots.files import MJCF, write_mjcf

mujoco: Any = importlib.import_module("mujoco")

SIX = """<mujoco><compiler angle="radian"/><worldbody><body name="wrist" pos="0.1 0.2 0.3" euler="0.3 0.1 0">
  <joint name="a" axis="1 0 0" pos="0.01 0 0"/><joint name="b" axis="0 1 0" pos="0 0.02 0" armature="0.1"/>
  <joint name="c" axis="0 0 1" range="-1 1"/><joint name="d" axis="1 1 0" pos="0 0 0.03"/>
  <joint name="e" type="slide" axis="0 1 1"/><joint name="f" axis="0 1 2"/>
  <geom type="box" size="0.1 0.02 0.03" pos="0.05 0 0" mass="0.7"/>
  <body name="tip" pos="0.2 0 0"><joint name="g" axis="0 1 0"/><geom size="0.02" mass="0.1"/></body>
</body></worldbody></mujoco>"""

FLOATING = """<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.5"><freejoint name="root"/>
  <geom type="box" size="0.1 0.1 0.05" mass="2"/>
  <body name="leg" pos="0.1 0 0"><joint name="hip" axis="0 1 0" range="-1 1"/><geom size="0.03" mass="0.2"/></body>
</body></worldbody><keyframe><key name="home" qpos="0.2 0.1 0.4 0.8 0 0.6 0 0.3"/></keyframe></mujoco>"""


def test_six_joints_in_one_link(tmp_path) -> None:
    """Place and mass of every link are those of the file as MuJoCo reads it, at random coordinates."""
    robot = robots.load(write_mjcf(tmp_path, SIX), end_effector="tip")
    assert robot.joint_names == tuple("abcdefg")
    assert any("'wrist'" in note for note in robot.notes)
    whole, split = mujoco.MjModel.from_xml_string(SIX), mujoco.MjModel.from_xml_string(robot.mjcf)
    assert split.body_jntnum.max() == 1
    one, other = mujoco.MjData(whole), mujoco.MjData(split)
    one.qpos[:] = other.qpos[:] = np.random.default_rng(0).uniform(-1.0, 1.0, 7)
    mass = [np.zeros((7, 7)), np.zeros((7, 7))]
    for model, data, full in ((whole, one, mass[0]), (split, other, mass[1])):
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
    for name in ("wrist", "tip"):
        np.testing.assert_allclose(other.body(name).xpos, one.body(name).xpos, atol=1e-6)  # digits of the written file
        np.testing.assert_allclose(other.body(name).xmat, one.body(name).xmat, atol=1e-6)
    # Five more links of 1e-6 kg and 1e-9 kg m^2, within 0.5 m of the axes.
    np.testing.assert_allclose(mass[1], mass[0], atol=5 * (1e-6 * 0.5**2 + 1e-9) + 1e-6)


def test_split_links_in_newton(tmp_path) -> None:
    """Newton has a joint per link, and holds the links where the description says."""
    robot = robots.load(write_mjcf(tmp_path, SIX), end_effector="tip", home=(0.1, 0.2, 0.3, 0.4, 0.05, 0.6, 0.7))
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    indices = robot.add_to(builder)
    model = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    place = state.body_q.numpy()[indices.hand_body]
    np.testing.assert_allclose(place[:3], robot.tool_pose()[:3], atol=1e-5)


def test_links_that_follow_keep_their_classes(tmp_path) -> None:
    """A joint before another one in a link of an arm with defaults, servos and a key frame."""
    text = MJCF.replace('<joint name="elbow"', '<joint name="roll" class="arm" axis="1 0 0"/><joint name="elbow"')
    text = text.replace('qpos="0 0 0 0"', 'qpos="0 0 0 0 0"').replace('qpos="-0.4 ', 'qpos="-0.4 0.2 ')
    robot = robots.load(write_mjcf(tmp_path, text))
    assert robot.joint_names == ("shoulder", "roll", "elbow", "left", "right")
    assert robot.home == pytest.approx((-0.4, 0.2, 0.9, 0.02, 0.02))
    assert robot.gripper is not None and robot.drives[2] is not None and robot.drives[1] is None


def test_base_is_held_at_home(tmp_path) -> None:
    """A free joint is left out, the base stands where the key frame has it, and a note says so."""
    robot = robots.load(write_mjcf(tmp_path, FLOATING), end_effector="trunk")
    assert robot.joint_names == ("hip",)
    assert robot.tool_pose() == pytest.approx((0.2, 0.1, 0.4, 0.0, 0.6, 0.0, 0.8), abs=1e-6)
    assert any("floating=True" in note for note in robot.notes)


def test_floating_base_falls(tmp_path) -> None:
    """With floating=True six joints without drives carry it: in free fall it drops by g t^2 / 2, without turning."""
    robot = robots.load(write_mjcf(tmp_path, FLOATING), end_effector="trunk", floating=True)
    assert robot.passive_joints == ("root_x", "root_y", "root_z", "root_yaw", "root_pitch", "root_roll")
    assert robot.tool_pose() == pytest.approx((0.2, 0.1, 0.4, 0.0, 0.6, 0.0, 0.8), abs=1e-6)
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    model.opt.timestep = 1e-3
    data = mujoco.MjData(model)
    data.qpos[:] = np.array(robot.home) + model.qpos0
    mujoco.mj_forward(model, data)
    start = data.body("trunk").xpos.copy(), data.body("trunk").xmat.copy()
    for _ in range(100):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    drop = start[0] - data.body("trunk").xpos
    # The Euler step falls by n (n + 1) / 2 g dt^2.
    np.testing.assert_allclose(drop, [0.0, 0.0, 9.81 * 1e-6 * 100 * 101 / 2], atol=1e-5)
    np.testing.assert_allclose(data.body("trunk").xmat, start[1], atol=1e-4)
