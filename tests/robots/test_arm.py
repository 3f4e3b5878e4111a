"""The arm's description and what its builder makes of it."""

import dataclasses
import math

import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.robots import ArmDescription, GripperDescription, add_arm
from tests.robots.conftest import Rig


def tool_pose(rig, world=0):
    """Return tool position and rotation matrix, from the hand's body pose."""
    pose = wp.transform(*rig.state.body_q.numpy()[9 * world + rig.arm.hand_body])
    point = wp.transform_point(pose, wp.vec3(0.0, 0.0, rig.arm.description.tool_length))
    return np.array(point), np.array(wp.quat_to_matrix(wp.transform_get_rotation(pose))).reshape(3, 3)


def test_builds_bodies_joints_and_pads(rig):
    """Nine bodies and joints in each world; masses are the description's; every inertia is positive definite."""
    arm, model = rig.arm.description, rig.model
    assert model.world_count == 2
    assert model.body_count == model.joint_count == 18
    masses = model.body_mass.numpy()
    expected = [*arm.link_masses, arm.gripper.finger_mass, arm.gripper.finger_mass]
    np.testing.assert_allclose(masses, 2 * expected, rtol=1e-5)
    for inertia in model.body_inertia.numpy():
        moments = np.linalg.eigvalsh(inertia)
        assert moments[0] > 0.0
        assert moments[2] <= moments[0] + moments[1] + 1e-9  # what any mass distribution obeys
    types = model.shape_type.numpy()
    assert all(types[shape] == newton.GeoType.BOX for shape in rig.arm.pad_shapes)


def test_home_pose_looks_down_at_the_described_point(rig):
    """The tool point is where home_position says, its z axis points down, and the fingers close along y."""
    arm = rig.arm.description
    for world in range(2):
        position, rotation = tool_pose(rig, world)
        np.testing.assert_allclose(position, arm.home_position, atol=1e-6)
        np.testing.assert_allclose(rotation @ (0, 0, 1), (0, 0, -1), atol=1e-6)
    body_q = rig.state.body_q.numpy()
    left, right = (body_q[finger][:3] for finger in rig.arm.finger_bodies)
    np.testing.assert_allclose(left - right, (0.0, arm.home_opening, 0.0), atol=1e-6)


@pytest.mark.parametrize("yaw", [-1.2, 0.0, 0.7])
@pytest.mark.parametrize("position", [(0.35, -0.2, 0.05), (0.55, 0.25, 0.2), (0.4, 0.0, 0.4)])
def test_closed_form_reaches_the_pose(rig, position, yaw):
    """FK(joint_q_over(x, yaw)) = (x, Rz(yaw) Ry(pi))."""
    rig.set_joint_q(np.append(rig.arm.description.joint_q_over(position, yaw), (0.01, 0.01)))
    found, rotation = tool_pose(rig)
    c, s = math.cos(yaw), math.sin(yaw)
    np.testing.assert_allclose(found, position, atol=2e-6)
    np.testing.assert_allclose(rotation, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([-1, 1, -1]), atol=2e-6)


def test_base_pose_moves_the_arm():
    """A base turned by 90 degrees and lifted carries the home pose with it."""
    half = math.sqrt(0.5)
    builder = newton.ModelBuilder()
    arm = add_arm(builder, xform=(0.1, 0.2, 0.3, 0.0, 0.0, half, half))
    model = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    pose = wp.transform(*state.body_q.numpy()[arm.hand_body])
    point = np.array(wp.transform_point(pose, wp.vec3(0.0, 0.0, arm.description.tool_length)))
    x, y, z = arm.description.home_position
    np.testing.assert_allclose(point, (0.1 - y, 0.2 + x, 0.3 + z), atol=2e-6)


def test_only_the_gripper_touches_soft_bodies_by_default():
    """touch="gripper" lets pads, fingers and palm collide with particles; touch="all" every shape."""
    particles = int(newton.ShapeFlags.COLLIDE_PARTICLES)
    for touch in ("gripper", "all"):
        builder = newton.ModelBuilder()
        arm = add_arm(builder, ArmDescription(touch=touch))
        touching = {shape for shape in arm.shapes if builder.shape_flags[shape] & particles}
        assert set(arm.pad_shapes) <= touching
        assert len(touching) == (5 if touch == "gripper" else len(arm.shapes))


def test_indices_count_from_the_builder_it_was_added_to():
    """An arm added after another body starts behind it."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(builder.add_body(), hx=0.1, hy=0.1, hz=0.1)
    arm = add_arm(builder)
    assert (arm.joint_start, arm.coord_start, arm.dof_start) == (1, 7, 6)
    assert builder.joint_label[arm.joint_start] == "arm/joint1"
    assert builder.body_label[arm.hand_body] == "arm/link7"
    np.testing.assert_allclose(builder.joint_q[7:16], arm.description.home_joint_q)


def test_description_is_a_value():
    """Descriptions are frozen, compare by value and vary by dataclasses.replace."""
    weak = dataclasses.replace(ArmDescription(), gripper=GripperDescription(force_limit=10.0))
    assert weak != ArmDescription()
    assert dataclasses.replace(weak, gripper=GripperDescription()) == ArmDescription()
    with pytest.raises(dataclasses.FrozenInstanceError):
        weak.reach = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: ArmDescription(link_masses=(1.0, 2.0)), "link_masses"),
        (lambda: ArmDescription(link_masses=(1.0,) * 6 + (0.0,)), "link_masses"),
        (lambda: ArmDescription(effort_limits=(math.nan,) * 7), "effort_limits"),
        (lambda: ArmDescription(armatures=(-0.1,) * 7), "armatures"),
        (lambda: ArmDescription(upper_arm_length=0.0), "upper_arm_length"),
        (lambda: ArmDescription(joint_lower=(3.0,) * 7), "joint_lower"),
        (lambda: ArmDescription(touch="nothing"), "touch"),  # type: ignore[arg-type]
        (lambda: ArmDescription(home_position=(1.5, 0.0, 0.2)), "1.500"),
        (lambda: ArmDescription(home_opening=0.2), "home_opening"),
        (lambda: GripperDescription(stroke=-0.08), "stroke"),
        (lambda: GripperDescription(force_limit=math.inf), "force_limit"),
        (lambda: GripperDescription(pad_size=(0.02, 0.005, 0.5)), "pad_size"),
    ],
)
def test_bad_descriptions_name_the_field(make, name):
    """A value out of range raises ConfigError, which names the field and a remedy."""
    with pytest.raises(ConfigError, match=name) as caught:
        make()
    assert caught.value.hint


def test_joint_limit_is_named():
    """A yaw beyond the last joint's range names the joint."""
    with pytest.raises(ConfigError, match="joint 7"):
        ArmDescription().joint_q_over((0.45, 0.0, 0.25), yaw=3.1)


def test_gravity_compensation_holds_the_arm_without_a_drive_error(rig):
    """With compensation the drives carry nothing: the home pose stays put. Without, it sags by torque / stiffness."""
    home = rig.arm.description.home_joint_q
    rig.step(60)
    np.testing.assert_allclose(rig.state.joint_q.numpy()[:9], home, atol=1e-6)
    heavy = Rig(ArmDescription(gravity_compensation=False), world_count=1)
    heavy.step(240)
    sag = heavy.state.joint_q.numpy()[:7] - home[:7]
    weight = np.zeros(7)
    jacobian = newton.eval_jacobian(heavy.model, heavy.state).numpy()[0]
    for body, mass in enumerate(heavy.model.body_mass.numpy()):
        weight -= 9.81 * mass * jacobian[6 * body + 2, :7]
    np.testing.assert_allclose(sag, weight / np.array(heavy.arm.description.drive_stiffnesses), atol=2e-5)
