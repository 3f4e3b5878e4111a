"""The arm's controller: kinematics against Newton's, tracking, limits, anti-windup, capture."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.robots import ArmController, ArmControlOptions
from tests.robots.conftest import Rig, as_action

HOLD = (0.0, 0.0, 0.0, 0.0, 1.0)


def run(rig, controller, action, count):
    """Repeat one action."""
    array = as_action(action)
    for _ in range(count):
        rig.frame(controller, array)


def test_measured_pose_is_newtons(rig):
    """The kernel's forward kinematics equals newton.eval_fk at random configurations."""
    controller = ArmController(rig.model, rig.arm)
    rng = np.random.default_rng(0)
    length = rig.arm.description.tool_length
    for _ in range(5):
        rig.set_joint_q(np.append(rng.uniform(-1.5, 1.5, 7), (0.01, 0.03)))
        controller.measure(rig.state)
        for world in range(2):
            hand = wp.transform(*rig.state.body_q.numpy()[9 * world + rig.arm.hand_body])
            expected = hand * wp.transform(wp.vec3(0.0, 0.0, length), wp.quat_identity())
            found = controller.tool_pose.numpy()[world]
            np.testing.assert_allclose(found[:3], np.array(expected.p), atol=2e-6)
            assert abs(float(np.dot(found[3:], np.array(expected.q)))) == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(controller.opening.numpy(), 0.04, atol=1e-7)


def test_zero_action_holds_the_command(rig):
    """At home a zero action changes nothing: command, target and arm stay to float32 accuracy."""
    controller = ArmController(rig.model, rig.arm)
    before = controller.commanded_q.numpy()
    run(rig, controller, (0.0, 0.0, 0.0, 0.0, 0.6), 30)
    np.testing.assert_allclose(controller.commanded_q.numpy()[:, :7], before[:, :7], atol=2e-6)
    np.testing.assert_allclose(rig.state.joint_q.numpy()[:7], before[0, :7], atol=5e-6)


def test_pose_steps_are_tracked(rig):
    """Ten steps along x, y, z and yaw end at ten times the scales, to 0.05 mm, with the tool still vertical."""
    options = ArmControlOptions()
    controller = ArmController(rig.model, rig.arm, options)
    start = np.array(rig.arm.description.home_position)
    run(rig, controller, (0.8, 0.5, -1.0, 0.6, 1.0), 10)
    run(rig, controller, HOLD, 30)
    expected = start + 10 * options.translation_scale * np.array([0.8, 0.5, -1.0])
    pose = controller.tool_pose.numpy()[0]
    np.testing.assert_allclose(pose[:3], expected, atol=5e-5)  # the elbow still drifts home
    rotation = np.array(wp.quat_to_matrix(wp.quat(*pose[3:].tolist()))).reshape(3, 3)
    np.testing.assert_allclose(rotation[:, 2], (0.0, 0.0, -1.0), atol=1e-4)
    yaw = np.arctan2(-rotation[1, 0], -rotation[0, 0])
    assert yaw == pytest.approx(10 * options.rotation_scale * 0.6, abs=1e-4)
    np.testing.assert_allclose(controller.opening.numpy(), rig.arm.description.gripper.stroke, atol=1e-5)


def test_joint_steps_are_tracked(rig):
    """In joint_delta each joint moves by its action times joint_scale."""
    options = ArmControlOptions(mode="joint_delta")
    controller = ArmController(rig.model, rig.arm, options)
    action = np.array([0.5, -0.3, 0.4, 0.2, -0.5, 0.3, 1.0, 1.0])
    run(rig, controller, action, 5)
    run(rig, controller, (0.0,) * 7 + (1.0,), 30)
    expected = rig.arm.description.home_joint_q[:7] + 5 * options.joint_scale * action[:7]
    np.testing.assert_allclose(rig.state.joint_q.numpy()[:7], expected, atol=1e-4)


@pytest.mark.parametrize("mode", ["pose_delta", "joint_delta"])
def test_workspace_and_limits_bound_the_command(rig, mode):
    """Random full actions never command a joint beyond its limits or the tool out of the workspace by over 5 mm."""
    options = ArmControlOptions(mode=mode)
    controller = ArmController(rig.model, rig.arm, options)
    rng = np.random.default_rng(1)
    low = np.array(rig.arm.description.joint_lower, dtype=np.float32)
    high = np.array(rig.arm.description.joint_upper, dtype=np.float32)
    for _ in range(60):
        direction = rng.choice([-1.0, 1.0], controller.action_size)
        for _ in range(8):
            # The arm follows the command at once: this is about the command alone.
            controller.command(as_action(direction), rig.state)
            command = controller.commanded_q.numpy()[0]
            assert np.all(command[:7] >= low - 1e-6)
            assert np.all(command[:7] <= high + 1e-6)
            rig.set_joint_q(command)
        controller.measure(rig.state)
        position = controller.tool_pose.numpy()[0][:3]
        assert np.all(position > np.array(options.workspace_lower) - 0.005)
        assert np.all(position < np.array(options.workspace_upper) + 0.005)


def test_a_load_does_not_move_the_command(rig):
    """A steady force on the hand bends the arm by force / stiffness; the command stays and the arm returns."""
    controller = ArmController(rig.model, rig.arm)
    body_f = np.zeros((18, 6), dtype=np.float32)
    body_f[[rig.arm.hand_body, 9 + rig.arm.hand_body], 2] = -20.0
    command = controller.commanded_q.numpy()
    rig.state.body_f.assign(body_f)
    rig.step(480)
    controller.command(as_action(HOLD), rig.state)
    np.testing.assert_allclose(controller.commanded_q.numpy()[:, :7], command[:, :7], atol=2e-6)
    sag = rig.arm.description.home_position[2] - controller.tool_pose.numpy()[0][2]
    assert 2.0e-4 < sag < 5.0e-3
    rig.state.body_f.zero_()
    rig.step(480)
    controller.measure(rig.state)
    assert controller.tool_pose.numpy()[0][2] == pytest.approx(rig.arm.description.home_position[2], abs=1e-5)


def test_command_leads_a_blocked_arm_by_a_bounded_distance(rig):
    """While the arm does not move at all, the command stops at max_lead in front of it, in every direction."""
    options = ArmControlOptions()
    controller = ArmController(rig.model, rig.arm, options)
    for _ in range(40):
        controller.command(as_action((1.0, 1.0, -1.0, 1.0, -1.0)), rig.state)
    target = controller.target_position.numpy()[0]
    assert np.linalg.norm(target - rig.arm.description.home_position) == pytest.approx(options.max_lead, rel=1e-3)
    assert controller.target_yaw.numpy()[0] == pytest.approx(options.max_lead_angle, rel=1e-3)
    gripper = rig.arm.description.gripper
    lead = 0.5 * rig.arm.description.home_opening - controller.commanded_q.numpy()[0, 7]
    assert lead == pytest.approx(options.squeeze_lead * gripper.force_limit / gripper.drive_stiffness, rel=1e-4)


def test_gripper_reaches_its_force_on_any_width(rig):
    """Squeezing (-1) saturates both drives even on an object of zero width."""
    controller = ArmController(rig.model, rig.arm)
    home = rig.arm.description.home_joint_q
    gripper = rig.arm.description.gripper
    for finger in (0.0, 0.002, 0.03):
        rig.set_joint_q(np.append(home[:7], (finger, finger)))
        controller.reset(rig.state)
        for _ in range(20):
            controller.command(as_action((0.0, 0.0, 0.0, 0.0, -1.0)), rig.state)
        error = finger - controller.commanded_q.numpy()[:, 7:]
        assert np.all(gripper.drive_stiffness * error > gripper.force_limit)


def test_reset_touches_the_masked_worlds_only(rig):
    """Reset with a mask sets the command of those worlds to the measured configuration and leaves the others."""
    controller = ArmController(rig.model, rig.arm)
    for _ in range(5):
        controller.command(as_action((1.0, 0.0, 0.0, 0.0, 1.0)), rig.state)
    moved = controller.commanded_q.numpy()
    controller.reset(rig.state, wp.array([False, True], dtype=wp.bool, device="cpu"))
    after = controller.commanded_q.numpy()
    np.testing.assert_array_equal(after[0], moved[0])
    np.testing.assert_allclose(after[1], rig.arm.description.home_joint_q, atol=1e-6)


def test_bad_actions(rig):
    """A wrong shape raises; values that are not finite count as zero; larger ones are clamped."""
    controller = ArmController(rig.model, rig.arm)
    with pytest.raises(ConfigError, match="shape"):
        controller.command(wp.zeros((2, 8), dtype=wp.float32, device="cpu"), rig.state)
    controller.command(as_action((np.nan, np.inf, -np.inf, 0.0, 1.0)), rig.state)
    np.testing.assert_allclose(controller.target_position.numpy()[0], rig.arm.description.home_position, atol=1e-6)
    controller.command(as_action((100.0, 0.0, 0.0, 0.0, 1.0)), rig.state)
    moved = controller.target_position.numpy()[0][0] - rig.arm.description.home_position[0]
    assert moved == pytest.approx(controller.options.translation_scale, abs=1e-6)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"mode": "torque"}, "mode"),
        ({"translation_scale": 0.0}, "translation_scale"),
        ({"opening_rate": float("nan")}, "opening_rate"),
        ({"iterations": 0}, "iterations"),
        ({"posture_gain": 2.0}, "posture_gain"),
        ({"workspace_lower": (0.0, 0.0, 1.0)}, "workspace_lower"),
        ({"workspace_upper": (0.0, 0.0)}, "workspace_upper"),
    ],
)
def test_bad_options_name_the_field(values, name):
    """An option out of range raises ConfigError, which names it."""
    with pytest.raises(ConfigError, match=name):
        ArmControlOptions(**values)


def test_captured_graph_equals_eager(rig):
    """Replaying a captured control step gives bitwise the states of eager steps."""
    actions = [(1.0, -0.5, -1.0, 0.4, -1.0), (0.0, 1.0, 0.3, -1.0, 1.0), HOLD]
    action = as_action(HOLD)
    results = []
    for captured in (False, True):
        rig.restart()
        controller = ArmController(rig.model, rig.arm)
        graph = None
        if captured:
            rig.frame(controller, action)  # loads every module before the capture
            with wp.ScopedCapture(device="cpu") as capture:
                rig.frame(controller, action)
            graph = capture.graph
            rig.state.assign(rig.model.state())
            newton.eval_fk(rig.model, rig.model.joint_q, rig.model.joint_qd, rig.state)
            controller.reset(rig.state)
        for row in actions:
            action.assign(np.tile(np.asarray(row, dtype=np.float32), (2, 1)))
            for _ in range(4):
                if graph is None:
                    rig.frame(controller, action)
                else:
                    wp.capture_launch(graph)
        results.append((rig.state.joint_q.numpy(), rig.state.joint_qd.numpy(), controller.tool_pose.numpy()))
    for eager, replayed in zip(*results, strict=True):
        np.testing.assert_array_equal(eager, replayed)


def test_world_of_many_equals_the_single_world(rig):
    """World i of two, and a model without worlds, get the command of a single world."""
    rows = np.array([[1.0, 0.2, -0.7, 0.5, -1.0], [-0.3, 1.0, 0.4, -1.0, 1.0]], dtype=np.float32)
    both = ArmController(rig.model, rig.arm)
    for _ in range(4):
        both.command(wp.array(rows, dtype=wp.float32, device="cpu"), rig.state)
    single = Rig(world_count=1)
    for world in range(2):
        alone = ArmController(single.model, single.arm)
        for _ in range(4):
            alone.command(wp.array(rows[world : world + 1], dtype=wp.float32, device="cpu"), single.state)
        np.testing.assert_array_equal(alone.commanded_q.numpy()[0], both.commanded_q.numpy()[world])
