"""What SolverMuJoCo does with drives and wrenches: the facts that a joint solve with soft bodies builds on."""

import newton
import numpy as np
import pytest

from tests.robots.conftest import Rig

DT = 0.004


def velocity_change(rig, joint_q, joint_qd, target, wrench):
    """Return (change of joint velocity in one step through a wrench on both fingers, its prediction)."""
    model, (left, right) = rig.model, rig.arm.finger_bodies
    velocities = []
    for scale in (0.0, 1.0):
        rig.restart()
        rig.set_joint_q(joint_q, joint_qd)
        rig.control.joint_target_q.assign(np.asarray(target, dtype=np.float32))
        body_f = np.zeros((model.body_count, 6), dtype=np.float32)
        body_f[left] = scale * np.asarray(wrench)
        body_f[right] = -0.4 * scale * np.asarray(wrench)
        rig.state.body_f.assign(body_f)
        mass = newton.eval_mass_matrix(model, rig.state).numpy()[0].astype(float)
        jacobian = newton.eval_jacobian(model, rig.state).numpy()[0].astype(float)
        rig.step(dt=DT)
        velocities.append(rig.state.joint_qd.numpy().astype(float))
    effort = sum(jacobian[6 * b : 6 * b + 6].T @ body_f[b] for b in (left, right))
    resistance = model.joint_target_kd.numpy() + model.joint_damping.numpy()
    predicted = np.linalg.solve(mass + DT * np.diag(resistance), DT * effort)
    return velocities[1] - velocities[0], predicted


@pytest.fixture(scope="module")
def single():
    """One world."""
    return Rig(world_count=1)


@pytest.mark.parametrize("closing", [0.0, 0.005, 0.04], ids=["idle", "driving", "saturated"])
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_effective_mass(single, closing, speed):
    """Delta qd = (M + dt diag(kd + damping))^-1 dt J^T f, whether the effort limit clamps the drive or not."""
    home = single.arm.description.home_joint_q
    target = home - np.append(np.zeros(7), (closing, closing))
    joint_qd = np.append(np.full(7, speed), (-0.1 * speed, -0.1 * speed))
    change, predicted = velocity_change(single, home, joint_qd, target, (0.6, 2.0, -1.0, 0.01, 0.02, 0.03))
    # Velocities are float32 near 0.3: one rounding is 3e-8, the changes reach 1e-2.
    np.testing.assert_allclose(change, predicted, rtol=1e-3, atol=2e-7)


def test_effort_limit_bounds_the_drive(single):
    """A drive with a far target gives a constant force: qdd (M + dt D) = limit for a finger from rest."""
    single.restart()
    arm, gripper = single.arm.description, single.arm.description.gripper
    home = arm.home_joint_q
    single.control.joint_target_q.assign(np.append(home[:7], (-1.0, -1.0)).astype(np.float32))
    mass = gripper.finger_mass + gripper.armature + DT * (gripper.drive_damping + gripper.damping)
    single.step(dt=DT)
    expected = -DT * gripper.force_limit / mass
    np.testing.assert_allclose(single.state.joint_qd.numpy()[7:], expected, rtol=1e-4)


def test_squeeze_force_is_the_drive_limit(single):
    """Two fingers closing on a stiff elastic block press it with the force limit to 0.1 %, without chatter."""
    single.restart()
    gripper = single.arm.description.gripper
    single.control.joint_target_q.assign(np.append(single.arm.description.home_joint_q[:7], (0.0, 0.0)).astype("f4"))
    half_width, stiffness, dt = 0.02, 4.0e3, 0.002
    forces = []
    for _ in range(500):
        depth = np.maximum(half_width - single.state.joint_q.numpy()[7:], 0.0)
        rate = single.state.joint_qd.numpy()[7:] * (depth > 0.0)
        force = np.maximum(stiffness * depth - 20.0 * rate, 0.0)
        body_f = np.zeros((9, 6), dtype=np.float32)
        body_f[single.arm.finger_bodies[0], 1] = force[0]
        body_f[single.arm.finger_bodies[1], 1] = -force[1]
        single.state.body_f.assign(body_f)
        single.step(dt=dt)
        forces.append(force)
    held = np.array(forces[-100:])
    np.testing.assert_allclose(held, gripper.force_limit, rtol=1e-3)


def test_end_stops_hold_a_closed_gripper(single):
    """The full drive force moves an empty gripper less than a millimetre past its end stops, and it stays there."""
    single.restart()
    single.control.joint_target_q.assign(
        np.append(single.arm.description.home_joint_q[:7], (-0.02, -0.02)).astype("f4")
    )
    single.step(200, dt=DT)
    fingers = single.state.joint_q.numpy()[7:]
    assert np.all(fingers > -1.0e-3)
    assert np.all(np.abs(single.state.joint_qd.numpy()[7:]) < 1.0e-4)
