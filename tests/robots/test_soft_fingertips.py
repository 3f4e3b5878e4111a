"""Soft fingertips: where they are put, and the arm holding a rigid cube with them."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.model.authoring import register_custom_attributes
from softmode.deformables.tools.sensing import ContactSensor, ForceTorqueSensor
from softmode.errors import AssetError
from softmode.robots import add_arm, add_soft_fingertips
from tests.scenes import GRAVITY, add_free_box, add_gripper

RADIUS = 0.010
HALF = 0.02
MASS = 0.1


def test_fingertips_stand_out_of_the_pads():
    """Half of each capsule stands out of its pad's face, at the height of the tool, held by the half behind."""
    builder = newton.ModelBuilder()
    arm = add_arm(builder)
    tips = add_soft_fingertips(builder, arm, radius=RADIUS)
    opening, tool = arm.description.home_opening, np.array(arm.description.home_position)
    x = np.array([list(p) for p in builder.particle_q]).reshape(2, -1, 3)
    assert len(x[0]) == tips.body.surface_count
    for samples, side, attachment in zip(x, (1.0, -1.0), tips.attachments, strict=True):
        y = side * samples[:, 1]
        # extreme samples lie within half a spacing of the apex, which is s^2 / (2 r) behind it there
        flat = 0.5 * tips.body.surface.areas.max() / RADIUS
        assert y.min() == pytest.approx(0.5 * opening - RADIUS, abs=flat)
        assert y.max() == pytest.approx(0.5 * opening + RADIUS, abs=flat)
        middle = np.average(samples, axis=0, weights=tips.body.surface.areas)
        np.testing.assert_allclose(middle[[0, 2]], tool[[0, 2]], atol=0.05 * RADIUS)
        behind = (y >= 0.5 * opening).sum()
        assert attachment.count == behind


def test_fingertips_on_any_gripper():
    """Mounts given by hand: z along the finger, y out of its face."""
    builder = newton.ModelBuilder()
    _, left, right = add_gripper(builder, 0.03)
    turn = wp.quat(0.0, 0.0, 1.0, 0.0)
    mounts = [
        (left, wp.transform((0.0, -0.015, 0.0), turn)),
        (right, wp.transform((0.0, 0.015, 0.0), wp.quat_identity())),
    ]
    add_soft_fingertips(builder, mounts, radius=0.005)
    y = np.array([list(p) for p in builder.particle_q]).reshape(2, -1, 3)[..., 1]
    assert y[0].min() == pytest.approx(0.025, abs=1e-3)
    assert y[1].max() == pytest.approx(-0.025, abs=1e-3)
    with pytest.raises(AssetError, match="radius"):
        add_soft_fingertips(builder, mounts, radius=0.0)


def test_arm_holds_a_rigid_cube():
    """In the air: each pad presses with its drive, friction carries m g, the glue feels it; two worlds bit for bit.

    The pads start 0.5 mm into the cube; it slips while the drives come up, then creeps with stick_velocity at most.
    """
    world = newton.ModelBuilder()
    for register in (register_custom_attributes, SolverMuJoCo.register_custom_attributes):
        register(world)
    arm = add_arm(world)
    gripper, place = arm.description.gripper, arm.description.home_position
    finger = HALF + RADIUS - 5.0e-4
    world.joint_q[7:9] = [finger, finger]
    tips = add_soft_fingertips(world, arm, radius=RADIUS)
    box = add_free_box(world, (HALF,) * 3, MASS, place, friction=1.0)
    builder = newton.ModelBuilder()
    for register in (register_custom_attributes, SolverMuJoCo.register_custom_attributes):
        register(builder)
    builder.replicate(world, 2)
    model = builder.finalize(device="cpu")
    solver = SolverCoupledReduced(model, [tips.body], rigid=SolverMuJoCo(model, njmax=128, nconmax=128))
    touch, glue = ContactSensor(solver, [box]), ForceTorqueSensor(solver, tips.attachments)
    state, scratch, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    squeeze, dt = 12.0, 0.004
    targets = control.joint_target_q.numpy().reshape(2, -1)
    with wp.ScopedCapture(device="cpu") as capture:
        solver.step(state, scratch, control, None, dt)
        solver.step(scratch, state, control, None, dt)
        touch.update()
        glue.update()
    solver.reset(state)
    heights = []
    for _ in range(60):
        targets[:, 7:9] = state.joint_q.numpy().reshape(2, -1)[:, 7:9] - squeeze / gripper.drive_stiffness
        control.joint_target_q.assign(targets.ravel())
        wp.capture_launch(capture.graph)
        heights.append(float(state.body_q.numpy()[box, 2]))
    force = touch.force_matrix.numpy()[:, 0].astype(float)
    np.testing.assert_array_equal(force[0], force[1])
    np.testing.assert_allclose(force[0, :, 1], [-squeeze, squeeze], rtol=1e-2)
    assert force[0, :, 2].sum() == pytest.approx(MASS * GRAVITY, rel=1e-2)
    pads = 2.0 * tips.body.volume * 1100.0
    assert -glue.force.numpy()[0, :, 2].sum() == pytest.approx((MASS + pads) * GRAVITY, rel=1e-2)
    assert abs(heights[-1] - place[2]) <= 2.0e-3
    assert abs(heights[-1] - heights[-11]) <= 20 * dt * solver.reduced.options.stick_velocity + 1e-5
    assert not solver.reduced.status.numpy().any()
