"""A robot read from a file grasps a soft cube through the joint solve."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from softmode import robots
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene

EDGE, DT = 0.04, 0.004
LIFT = (0.0, 0.0, -0.12, 0.0, 0.12, 0.0, 0.0, 0.0)
"""Change of the joint targets that raises the hand and keeps it level [rad]."""


@pytest.mark.skipif("aloha_arm" not in robots.available(), reason="this mujoco-warp ships no ALOHA arm")
def test_loaded_arm_lifts_a_soft_cube():
    """Both fingers press with k (q - target); friction is the weight within 2 %; the cube rises with the hand."""
    robot = dataclasses.replace(robots.load("aloha_arm"), visuals=False)
    wide, narrow = robot.with_opening(1.0), robot.with_opening(0.5)
    body = cube(EDGE)
    added = []

    def populate(world):
        indices = robot.add_to(world)
        world.joint_q[:] = world.joint_target_q[:] = wide.tolist()
        # The tips are 4 mm behind the tool point and close 3.5 mm below it.
        x, y, z = wp.transform_point(wp.transform(*robot.tool_pose(wide)), wp.vec3(-0.008, 0.0, -0.0035))
        material = Material(youngs_modulus=5.0e5, density=300.0, friction=0.8)
        add_reduced_body(world, body, material=material, position=(x, y, z))
        pose = wp.transform((x, y, z - 0.5 * EDGE - 0.01), wp.quat_identity())
        world.add_shape_box(-1, xform=pose, hx=0.015, hy=0.015, hz=0.01, label="stand")
        added.append(indices)

    scene = Scene(populate, [body], coupled=True, gravity=(0.0, 0.0, -GRAVITY), dt=DT)
    indices = added[0]
    fingers, coords = list(indices.finger_bodies), slice(indices.coord_start + 6, indices.coord_start + 8)
    replay = scene.capture()
    start, hand = scene.centre(), scene.state.body_q.numpy()[indices.hand_body, 2]
    rows, status = [], 0
    for k in range(round(2.4 / DT / 2)):
        t = 2 * k * DT
        target = wide + min(t / 0.5, 1.0) * (narrow - wide) + np.clip((t - 0.7) / 0.6, 0.0, 1.0) * np.array(LIFT)
        scene.control.joint_target_q.assign(target.astype(np.float32))
        replay()
        status |= int(scene.reduced.status.numpy()[0])
        wrench = scene.solver.body_wrench.numpy()
        pressing = scene.state.joint_q.numpy()[coords] - target[-2:]
        rows.append([wrench[fingers[0], 1], wrench[fingers[1], 1], wrench[:, 2].sum(), *pressing])
    hold = np.array(rows[-25:])
    assert status == 0
    assert -hold[:, 2].mean() == pytest.approx(scene.mass() * GRAVITY, rel=0.02)
    stiffness = [robot.drives[j].stiffness for j in (6, 7)]
    np.testing.assert_allclose(np.abs(hold[:, :2]).mean(0), stiffness * hold[:, 3:].mean(0), rtol=0.01)
    assert hold[:, :2].std(0).max() <= 0.01 * np.abs(hold[:, :2]).mean()
    raised = scene.state.body_q.numpy()[indices.hand_body, 2] - hand
    assert raised > 0.02
    assert np.linalg.norm(scene.centre()[2] - start[2] - raised) < 0.005
