"""Fingertips go where they shall, and a hand of 16 joints squeezes and holds a soft ball with them."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from softmode import robots
from softmode.deformables import Material
from softmode.errors import ConfigError
from softmode.objects import Placed, load
from softmode.scenes import SplatScene
from tests.robots.files import write_hand

TIPS = ("ff_tip", "mf_tip", "rf_tip", "th_tip")
RADIUS, TIP, BELOW = 0.03, 0.012, np.array([0.0, 0.0, -0.055])
"""Radii of ball and tips, and where the ball is under the palm [m]."""


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> robots.RobotDescription:
    """The hand of capsules."""
    return robots.load(write_hand(tmp_path_factory.mktemp("hand")))


@pytest.fixture(scope="module")
def tips(hand: robots.RobotDescription) -> robots.Fingertips:
    """Its four fingertips."""
    return robots.Fingertips(hand, dict.fromkeys(TIPS, (0.0, 0.0, 0.0)))


def around(distance: float) -> dict[str, np.ndarray]:
    """Return points around the ball, a little below its middle, at a distance from it [m]."""
    angles = {"ff_tip": -0.9, "mf_tip": 0.0, "rf_tip": 0.9, "th_tip": np.pi}
    ways = {name: np.array([np.cos(a), np.sin(a), -0.15]) for name, a in angles.items()}
    return {name: BELOW + (RADIUS + TIP + distance) * way / np.linalg.norm(way) for name, way in ways.items()}


def test_tips_reach_points(hand: robots.RobotDescription, tips: robots.Fingertips) -> None:
    """The inverse of the forward kinematics: tips are at the points to what the search says, within the limits."""
    wanted = around(0.0)
    q, left = tips.joint_q(wanted, hand.home)
    assert left < 1e-5
    for name, place in tips.positions(q).items():
        np.testing.assert_allclose(place, wanted[name], atol=1e-5)
    assert np.all(q >= np.array(hand.joint_lower)) and np.all(q <= np.array(hand.joint_upper))
    far, left = tips.joint_q({"mf_tip": (1.0, 0.0, 0.0)}, q)
    assert left > 0.5
    others = [name for name in hand.joint_names if not name.startswith("mf")]
    index = [hand.joint_names.index(name) for name in others]
    np.testing.assert_array_equal(far[index], q[index])


def test_tips_that_are_none(hand: robots.RobotDescription) -> None:
    """An unknown link, and two tips on one finger, are named."""
    with pytest.raises(ConfigError, match="no link 'thumb'"):
        robots.Fingertips(hand, {"thumb": (0.0, 0.0, 0.0)})
    with pytest.raises(ConfigError, match="'ff_medial' and 'ff_tip' share the joint 'ff_0'"):
        robots.Fingertips(hand, {"ff_medial": (0.0, 0.0, 0.0), "ff_tip": (0.0, 0.0, 0.0)})


def test_hand_holds_a_ball(hand: robots.RobotDescription, tips: robots.Fingertips) -> None:
    """Held by four tips, the ball's weight is the sum of their forces, to 1 %; momentum is accounted for to 1e-5.

    No sample is deeper than 1 % of the ball, and every tip presses.
    """
    material = Material(youngs_modulus=5.0e4, density=200.0, friction=0.9)
    ball = load(shape="sphere", extents=(2.0 * RADIUS,) * 3, material=material, surface_count=300)
    toy = Placed(object=ball, position=(*BELOW[:2], 0.2 + BELOW[2]))
    world = newton.ModelBuilder()
    added = hand.add_to(world, xform=(0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0))
    squeezing = tips.joint_q(around(-0.012), tips.joint_q(around(0.0), hand.home)[0])[0]
    world.joint_q[:] = tips.joint_q(around(0.0), hand.home)[0].tolist()

    def rigid(model: Any) -> SolverMuJoCo:
        return SolverMuJoCo(model, disable_contacts=True)

    scene = SplatScene(world, [toy], rigid=rigid)
    scene.control.joint_target_q.assign(squeezing.astype(np.float32))
    weight = 9.81 * toy.mass
    for _ in range(20):
        scene.step()
    wrench = scene.solver.body_wrench.numpy()[list(added.link_bodies), :3]
    press = np.linalg.norm(wrench, axis=1)
    assert (press > 0.05).sum() == len(TIPS)
    np.testing.assert_allclose(-wrench.sum(0), (0.0, 0.0, weight), atol=0.01 * weight)
    assert scene.rigid_gaps().min() > -0.02 * RADIUS
    scene.control.joint_target_q.assign(tips.joint_q(around(0.01), squeezing)[0].astype(np.float32))  # lets go
    assert scene.momentum_error(24) < 2e-5 * weight * scene.dt
    assert not scene.solver.status.numpy().any()
