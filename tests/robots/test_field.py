"""Robot files that nobody here wrote: tied joints, fingers that are only seen, what is left out, bad input.

Builds no body.
"""

from __future__ import annotations

from pathlib import Path

import newton
import numpy as np
import pytest

from softmode import robots
from softmode.envs.robots import with_robot
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig
from softmode.envs.tasks.rope_route.task import RopeRouteConfig
from softmode.errors import AssetError, ConfigError
from softmode.robots import ParallelJaw
from softmode.robots.chain import serial_chain
from softmode.robots.hand import colliding
from tests.robots.files import ARM5, write_arm5

INERTIA = '<inertial><mass value="0.3"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
BOX = '<geometry><box size="0.05 0.008 0.02"/></geometry>'


def write(
    folder: Path, *, mimic: str = "", limit: str = 'lower="0" upper="0.03"', solid: bool = True, arm: str = ""
) -> Path:
    """Write a URDF with two arm joints and two sliding fingers, the second of which may follow; return its path."""
    shape = f"<visual>{BOX}</visual>" + (f"<collision>{BOX}</collision>" if solid else "")
    links = "".join(f'<link name="{name}">{INERTIA}{shape}</link>' for name in ("base", "l1", "hand", "f1", "f2"))
    spec = (
        ("j1", "revolute", "base", "l1", "0 0 0.1", "0 0 1", '<limit lower="-1" upper="1" effort="20" velocity="1"/>'),
        (
            "j2",
            "revolute",
            "l1",
            "hand",
            "0 0 0.2",
            "0 1 0",
            f'<limit lower="-1" upper="1" effort="20" velocity="1"/>{arm}',
        ),
        (
            "g1",
            "prismatic",
            "hand",
            "f1",
            "0.02 0.04 0",
            "0 -1 0",
            '<limit lower="0" upper="0.03" effort="9" velocity="1"/>',
        ),
        ("g2", "prismatic", "hand", "f2", "0.02 -0.04 0", "0 1 0", f'<limit {limit} effort="9" velocity="1"/>{mimic}'),
    )
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/>{rest}</joint>'
        for name, kind, parent, child, at, axis, rest in spec
    )
    path = folder / "field.urdf"
    path.write_text(f'<robot name="field">{links}{joints}</robot>')
    return path


@pytest.mark.parametrize(
    ("tie", "limit", "ends"),
    [
        ((0.5, 0.0), 'lower="0" upper="0.03"', ((0.03, 0.015), (0.0, 0.0))),
        ((1.0, 0.005), 'lower="0" upper="0.03"', ((0.025, 0.03), (0.0, 0.005))),
        ((1.0, 0.0), 'lower="0" upper="0"', ((0.03, 0.03), (0.0, 0.0))),  # no range of its own
        ((2.0, 0.0), 'lower="0.01" upper="0.04"', ((0.02, 0.04), (0.005, 0.01))),
    ],
)
def test_followers_follow_at_every_opening(tie, limit, ends, tmp_path: Path) -> None:
    """q_2 = offset + ratio q_1 in limits, drives, home, openings and in the simulation, within both ranges."""
    ratio, offset = tie
    path = write(tmp_path, mimic=f'<mimic joint="g1" multiplier="{ratio}" offset="{offset}"/>', limit=limit)
    robot = robots.load(path)
    assert robot.gripper is not None
    assert (robot.gripper.closed, robot.gripper.open) == (pytest.approx(ends[0]), pytest.approx(ends[1]))
    for opening in (-0.2, 0.0, 0.37, 1.0):
        q = robot.with_opening(opening)
        assert q[3] == pytest.approx(offset + ratio * q[2])
    assert robot.home[3] == pytest.approx(offset + ratio * robot.home[2])
    drive = robot.drives[3]
    assert drive is not None
    assert sorted((drive.lower, drive.upper)) == pytest.approx(sorted((ends[0][1], ends[1][1])))
    world = newton.ModelBuilder()
    at = robot.add_to(world)
    model = world.finalize(device="cpu")
    solver = newton.solvers.SolverMuJoCo(model, disable_contacts=True)
    state, after, control = model.state(), model.state(), model.control()
    targets = model.joint_target_q.numpy()
    targets[at.coord_start :][:4] = robot.with_opening(0.25)
    control.joint_target_q.assign(targets)
    for _ in range(400):
        solver.step(state, after, control, None, 0.005)
        state, after = after, state
    q = state.joint_q.numpy()[at.coord_start :][:4]
    assert q == pytest.approx(robot.with_opening(0.25), abs=1e-4)


def test_ties_of_an_arm_chains_and_circles(tmp_path: Path) -> None:
    """The inverse kinematics keeps q_2 = -0.5 q_1; a chain of ties has one leader; circles are refused."""
    robot = robots.load(write(tmp_path, arm='<mimic joint="j1" multiplier="-0.5"/>'))
    assert robot.joint_lower[:2] == pytest.approx((-1.0, -0.5))
    chain = serial_chain(robot)
    wanted, turned = chain.forward(np.array([[0.6, -0.3]]))
    q, error = chain.inverse(wanted, turned, chain.home)
    assert q[0] == pytest.approx((0.6, -0.3), abs=1e-6) and error[0] < 1e-6
    text = write(tmp_path, mimic='<mimic joint="g1" multiplier="-1" offset="0.03"/>').read_text()
    chained = text.replace(
        'effort="9" velocity="1"/></joint>', 'effort="9" velocity="1"/><mimic joint="j2"/></joint>', 1
    )
    path = tmp_path / "chained.urdf"
    path.write_text(chained)
    ties = {tie.joint: tie for tie in robots.load(path).ties}
    assert {tie.leader for tie in ties.values()} == {"j2"} and ties["g2"].ratio == -1.0
    for follow, words in (("g2", "circle"), ("nothing", "no other joint")):
        path.write_text(
            text.replace('effort="9" velocity="1"/></joint>', f'effort="9"/><mimic joint="{follow}"/></joint>', 1)
        )
        with pytest.raises(AssetError, match=words):
            robots.load(path)
    with pytest.raises(AssetError, match="no pose in common"):
        robots.load(write(tmp_path, mimic='<mimic joint="g1"/>', limit='lower="0.1" upper="0.2"'))
    with pytest.raises(AssetError, match="above the upper"):
        robots.load(write(tmp_path, limit='lower="0.03" upper="0"'))


def test_what_is_only_seen_touches_where_nothing_else_does(tmp_path: Path) -> None:
    """Planner and contact take the same shapes; notes name the links. Where something collides nothing is added."""
    robot = robots.load(write(tmp_path, mimic='<mimic joint="g1"/>', solid=False))
    assert sum("no collision geometry" in note for note in robot.notes) == 3
    world = newton.ModelBuilder()
    at = robot.add_to(world)
    soft = int(newton.ShapeFlags.COLLIDE_PARTICLES)
    touched = {world.shape_body[shape] for shape in at.shapes if world.shape_flags[shape] & soft}
    assert touched == {at.link_bodies[robot.link_names.index(name)] for name in ("hand", "f1", "f2")}
    model = robot.model
    hand = [model.body(name).id for name in robot.hand_links]
    assert {int(model.geom_bodyid[geom]) for geom in colliding(model, hand)} == set(hand)
    assert ParallelJaw.of(robot).opening == pytest.approx(0.072, abs=1e-6)
    assert not any("collision" in note for note in robots.load(write(tmp_path)).notes)


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    """Adhesion, activation, empty ranges, effort 0, scenery and mocap: a note each."""
    path = write_arm5(tmp_path)
    text = path.read_text().replace(
        "</actuator>",
        '<adhesion name="cup" body="jaw_a" ctrlrange="0 1" gain="3"/><general name="slow" joint="turn" '
        'dyntype="filter" dynprm="0.1" gainprm="9" biastype="affine" biasprm="0 -9 -1"/></actuator>',
    )
    path.write_text(text.replace("<worldbody>", '<worldbody><geom size="1 1 0.1" type="plane"/>', 1))
    said = "\n".join(robots.load(path).notes)
    for words in ("'cup' is left out: adhesion", "'slow': its activation (filter", "1 shapes of the world"):
        assert words in said
    urdf = write(tmp_path, limit='lower="0" upper="0"')
    urdf.write_text(urdf.read_text().replace('effort="20"', 'effort="0"'))
    said = "\n".join(robots.load(urdf).notes)
    assert "empty range" in said and "effort 0" in said


def test_limits_upside_down_are_refused(tmp_path: Path) -> None:
    """MuJoCo takes them for none; a URDF with an attribute of another program is read."""
    with pytest.raises(AssetError, match="lower limit 2 above the upper one -2"):
        robots.load(write_arm5(tmp_path, ARM5.replace('range="-2 2"', 'range="2 -2"')))
    urdf = write(tmp_path)
    urdf.write_text(urdf.read_text().replace("<limit", '<limit drake:acceleration="2"'))
    assert robots.load(urdf).gripper is not None


def test_low_arms_stand_on_a_pedestal(tmp_path: Path) -> None:
    """An arm whose shoulder cannot bend down is placed higher, above a box that is only seen."""
    robot = robots.load(write_arm5(tmp_path))
    placed = robots.place_robot(robot, home_position=(0.45, 0.0, 0.17), base=(-0.1, 0.0, 0.15, 0.0), ranges=(0.0, 0.0))
    world = newton.ModelBuilder()
    placed.add_to(world)
    shape = world.shape_label.index("arm/pedestal")
    assert not world.shape_flags[shape] & int(newton.ShapeFlags.COLLIDE_PARTICLES | newton.ShapeFlags.COLLIDE_SHAPES)


def test_robots_that_no_task_takes_say_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An arm of two joints, a hand without an arm, a frame that is none; `robots check` ends with a line per task."""
    pytest.importorskip("tyro")
    from softmode.cli.main import main
    from softmode.envs.arguments import Shortcuts, checked_config

    path = write(tmp_path)
    with pytest.raises(ConfigError, match="2 joints between base and tool"):
        with_robot(LiftSoftConfig(), {"source": str(path)})
    with pytest.raises(ConfigError, match="no site or body 'nowhere'"):
        with_robot(LiftSoftConfig(), {"source": str(path), "end_effector": "nowhere"})
    with pytest.raises(ConfigError, match="sauce"):
        with_robot(LiftSoftConfig(), {"source": str(path), "sauce": 1})
    with pytest.raises(ConfigError, match=r"reach of 0\.7"):
        checked_config(RopeRouteConfig, None, Shortcuts(robot=str(path)), any_robot=False)
    assert main(["robots", "check", str(path), "-o", str(tmp_path / "a.png")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("guessed, left out:")
    assert "LiftSoft:        no, because" in said and said.rstrip().splitlines()[-1].startswith("LiftSoftGoal:")
    assert main(["play", "softmode/LiftSoft-v0", "--end-effector", "tcp"]) == 2
    assert "--end-effector without a robot" in capsys.readouterr().err
