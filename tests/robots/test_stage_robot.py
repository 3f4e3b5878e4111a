"""Robots of OpenUSD stages: the same robot as the MJCF that they were written from, and what is refused."""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode import robots
from softmode.errors import AssetError
from softmode.robots import RobotDescription
from tests.robots.files import write_arm5, write_mjcf
from tests.robots.stages import JOINTS, ROOT, StageRobot
from tests.usd.stages import Gf, Sdf, UsdPhysics

mujoco: Any = importlib.import_module("mujoco")
SINGLE = 2e-6
"""Relative error of numbers that went through single precision and a product or two."""


def mass_and_points(robot: RobotDescription, joint_q: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the mass matrix, and of every link its mass and the place and axes of its inertia."""
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    data = mujoco.MjData(model)
    data.qpos[:] = joint_q
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    places = {}
    for name in robot.link_names:
        k = model.body(name).id
        axes = data.ximat[k].reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[k]) @ axes.T
        places[name] = np.concatenate([[model.body_mass[k]], data.xipos[k], inertia.ravel()])
    return mass, places


@pytest.mark.parametrize(("up", "meters", "kilograms"), [("Z", 1.0, 1.0), ("Y", 0.01, 0.001)])
@pytest.mark.parametrize("kind", ["arm5", "small"])
def test_is_the_robot_of_the_mjcf(kind: str, up: str, meters: float, kilograms: float, tmp_path: Path) -> None:
    """Joints, limits, drives, losses, masses, kinematics, home pose and shapes are those of the MJCF, in any unit."""
    write = write_arm5 if kind == "arm5" else write_mjcf
    expected = robots.load(write(tmp_path), end_effector={"arm5": None, "small": "fore"}[kind])
    stage = StageRobot(tmp_path / "robot.usda", expected, up, meters, kilograms).save()
    found = robots.load(stage, end_effector={"arm5": None, "small": "fore"}[kind])
    assert (found.joint_names, found.link_names) == (expected.joint_names, expected.link_names)
    assert (found.end_effector, found.hand_links) == (expected.end_effector, expected.hand_links)
    for name in ("joint_lower", "joint_upper", "home"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=SINGLE, err_msg=name)
    for one, other in zip(found.drives, expected.drives, strict=True):
        assert one is not None and other is not None
        for name in ("stiffness", "damping", "effort_limit"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=SINGLE), name
    assert found.gripper is not None and expected.gripper is not None
    assert found.gripper.joints == expected.gripper.joints
    np.testing.assert_allclose(found.gripper.open, expected.gripper.open, atol=SINGLE)
    models = [mujoco.MjModel.from_xml_string(robot.mjcf) for robot in (found, expected)]
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(*(getattr(model, name) for model in models), rtol=SINGLE, atol=1e-9, err_msg=name)
    random = np.random.default_rng(0)
    for _ in range(5):
        joint_q = random.uniform(np.maximum(expected.joint_lower, -3.0), np.minimum(expected.joint_upper, 3.0))
        (mass, places), (mass_other, places_other) = (mass_and_points(robot, joint_q) for robot in (found, expected))
        np.testing.assert_allclose(mass, mass_other, atol=10 * SINGLE * np.abs(mass_other).max())
        for name, place in places.items():
            np.testing.assert_allclose(place, places_other[name], atol=5 * SINGLE, err_msg=name)


def outlines(robot: RobotDescription) -> np.ndarray:
    """Return whether each shape collides, and its least and greatest corner in the home pose [m], rows in order."""
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    rows = []
    for geom in range(model.ngeom):
        mesh = int(model.geom_dataid[geom])
        if mesh >= 0:
            first = int(model.mesh_vertadr[mesh])
            points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
        else:
            points = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) * model.geom_size[geom]
        points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        rows.append([float(model.geom_contype[geom]), *points.min(axis=0), *points.max(axis=0)])
    return np.array(sorted(rows, key=lambda row: [round(value, 4) for value in row]))


def test_shapes_lie_where_they_were(tmp_path: Path) -> None:
    """Meshes and primitives lie where those of the MJCF lie, and Newton gets as many that collide and that are seen."""
    expected = robots.load(write_mjcf(tmp_path), end_effector="fore")
    found = robots.load(StageRobot(tmp_path / "robot.usdc", expected, "Y", 0.01).save(), end_effector="fore")
    np.testing.assert_allclose(outlines(found), outlines(expected), atol=5 * SINGLE)
    counts = []
    for robot in (expected, found):
        world = newton.ModelBuilder()
        robot.add_to(world)
        colliding = [bool(flags & newton.ShapeFlags.COLLIDE_SHAPES) for flags in world.shape_flags]
        counts.append((sum(colliding), len(colliding)))
    assert counts[0] == counts[1] == (5, 10)  # four links without visible shapes show what collides


def arm(folder: Path, name: str = "arm.usda") -> StageRobot:
    """Return the arm of five joints as a stage that is not yet saved."""
    return StageRobot(folder / name, robots.load(write_arm5(folder)))


def test_drives_by_acceleration_count_inertia(tmp_path: Path) -> None:
    """A drive of type acceleration with gains k, d is a drive with k M_jj, d M_jj; a force limit stays."""
    stage = arm(tmp_path)
    UsdPhysics.DriveAPI(stage.joint("elbow"), "angular").CreateTypeAttr("acceleration")
    found = robots.load(stage.save())
    plain = stage.robot.drives[2]
    drive = found.drives[2]
    inertia = dataclasses.replace(found, home=(0.0,) * len(found.home)).joint_inertias()[2]
    assert drive is not None and plain is not None
    assert drive.stiffness == pytest.approx(plain.stiffness * inertia, rel=10 * SINGLE)
    assert drive.damping == pytest.approx(plain.damping * inertia, rel=10 * SINGLE)
    assert drive.effort_limit == pytest.approx(90.0)
    assert any("by acceleration" in note for note in found.notes)


def mujoco_prim(stage: StageRobot, name: str, kind: str, target: str, joints: list[str], **values: Any) -> None:
    """Author a prim of MuJoCo's schema; its attributes are lists of numbers, numbers and words."""
    prim = stage.stage.DefinePrim(f"{JOINTS}/{name}", kind)
    prim.CreateRelationship(f"mjc:{target}").SetTargets([f"{JOINTS}/{joint}" for joint in joints])
    for attribute, value in values.items():
        types = {list: Sdf.ValueTypeNames.DoubleArray, float: Sdf.ValueTypeNames.Double, str: Sdf.ValueTypeNames.Token}
        prim.CreateAttribute(f"mjc:{attribute.replace('_', ':')}", types[type(value)]).Set(value)


def ten(*values: float) -> list[float]:
    """Return parameters of an actuator, of which MuJoCo's schema has ten."""
    return [*values, *[0.0] * (10 - len(values))]


def test_actuators_of_mujoco_s_schema(tmp_path: Path) -> None:
    """MjcActuator on a joint and on a fixed tendon give the drives that MuJoCo's compiler reads of the MJCF."""
    stage = arm(tmp_path)
    for name in stage.robot.joint_names:
        stage.joint(name).RemoveAppliedSchema("PhysicsDriveAPI:linear" if "jaw" in name else "PhysicsDriveAPI:angular")
    for name in ("turn", "shoulder", "elbow", "wrist", "roll"):
        gains: dict[str, Any] = {"gainPrm": ten(4000.0), "biasPrm": ten(0.0, -4000.0, -200.0), "biasType": "affine"}
        limits = {"forceRange_min": -90.0, "forceRange_max": 90.0}
        mujoco_prim(stage, f"servo_{name}", "MjcActuator", "target", [name], **gains, **limits)
    jaws = ["jaw_a", "jaw_b"]
    mujoco_prim(stage, "both", "MjcTendon", "path", jaws, type="fixed", path_coef=[0.5, 0.5])
    gains = {"gainPrm": ten(100.0), "biasPrm": ten(0.0, -100.0, -10.0), "biasType": "affine"}
    ranges = {"forceRange_min": -80.0, "forceRange_max": 80.0, "ctrlRange_min": 0.0, "ctrlRange_max": 0.045}
    mujoco_prim(stage, "servo_jaws", "MjcActuator", "target", ["both"], **gains, **ranges)
    found = robots.load(stage.save())
    for one, other in zip(found.drives, stage.robot.drives, strict=True):
        assert one is not None and other is not None
        expected = dataclasses.astuple(dataclasses.replace(other, lower=0.0, upper=0.0))
        assert dataclasses.astuple(dataclasses.replace(one, lower=0.0, upper=0.0)) == pytest.approx(expected)
        assert (one.lower, one.upper) == pytest.approx((other.lower, other.upper), abs=SINGLE)


def test_joint_that_follows_another(tmp_path: Path) -> None:
    """With q_b = q_a (NewtonMimicAPI) and a drive on a alone each jaw has half of it, as where a file ties them."""
    stage = arm(tmp_path)
    follower = stage.joint("jaw_b")
    follower.RemoveAppliedSchema("PhysicsDriveAPI:linear")
    follower.AddAppliedSchema("NewtonMimicAPI")
    follower.CreateRelationship("newton:mimicJoint").SetTargets([f"{JOINTS}/jaw_a"])
    found = robots.load(stage.save())
    whole = stage.robot.drives[-1]
    assert whole is not None
    for drive in found.drives[-2:]:
        assert drive is not None and drive.stiffness == pytest.approx(0.5 * whole.stiffness, rel=SINGLE)
    assert "equality" not in found.mjcf


def test_joint_with_two_axes(tmp_path: Path) -> None:
    """A joint that may turn about y and z becomes two links of a hinge each, with limits and drives in radians."""
    stage = arm(tmp_path)
    joint = UsdPhysics.Joint.Define(stage.stage, f"{JOINTS}/universal")
    old = stage.joint("roll")
    for side in ("0", "1"):
        body = old.GetRelationship(f"physics:body{side}").GetTargets()
        joint.GetPrim().CreateRelationship(f"physics:body{side}").SetTargets(body)
    joint.CreateLocalPos0Attr(old.GetAttribute("physics:localPos0").Get())
    stage.stage.RemovePrim(old.GetPath())
    for axis in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ"):
        limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), axis)
        limit.CreateLowAttr(-30.0 if axis in ("rotY", "rotZ") else 1.0)
        limit.CreateHighAttr(60.0 if axis in ("rotY", "rotZ") else -1.0)
    drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "rotZ")
    drive.CreateStiffnessAttr(10.0)
    drive.CreateDampingAttr(1.0)
    drive.CreateMaxForceAttr(25.0)
    found = robots.load(stage.save())
    assert found.drives[4] is None
    servo = found.drives[5]
    assert servo is not None
    gains = (servo.stiffness, servo.damping, servo.effort_limit)
    assert gains == pytest.approx((math.degrees(10.0), math.degrees(1.0), 25.0), rel=5e-6)  # per radian
    assert found.joint_names[4:6] == ("universal_rotY", "universal_rotZ")
    # Splitting a link goes through MJCF, which has six digits.
    np.testing.assert_allclose(found.joint_lower[4:6], math.radians(-30.0), rtol=5e-6)
    np.testing.assert_allclose(found.joint_upper[4:6], math.radians(60.0), rtol=5e-6)


def test_loop_stays_closed(tmp_path: Path) -> None:
    """A hinge that is excluded from the tree holds two points of its axis together, which at the start they are."""
    stage = arm(tmp_path)
    loop = UsdPhysics.RevoluteJoint.Define(stage.stage, f"{ROOT}/loop")
    loop.CreateBody0Rel().SetTargets([f"{ROOT}/jaw_a"])
    loop.CreateBody1Rel().SetTargets([f"{ROOT}/jaw_b"])
    loop.CreateAxisAttr("Z")
    loop.CreateExcludeFromArticulationAttr(True)
    found = robots.load(stage.save(), end_effector="roll")
    model = mujoco.MjModel.from_xml_string(found.mjcf)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    connect = int(mujoco.mjtEq.mjEQ_CONNECT)
    assert model.eq_type.tolist() == [connect, connect]
    np.testing.assert_allclose(model.eq_data[:, :3], [[0.0, 0.0, -0.01], [0.0, 0.0, 0.01]], atol=1e-9)
    assert np.abs(data.efc_pos[: data.ne]).max() < SINGLE
    data.qpos[5] += 0.02
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).max() == pytest.approx(0.02, rel=1e-5)


def test_base_without_a_joint(tmp_path: Path) -> None:
    """A base that nothing holds is held where the stage has it, or floats by six joints."""
    stage = arm(tmp_path)
    stage.stage.RemovePrim(f"{JOINTS}/base_mount")
    path = stage.save()
    held = robots.load(path)
    assert held.joint_names == stage.robot.joint_names
    assert any("base held" in note for note in held.notes)
    assert robots.load(path, floating=True).joint_names[6:] == stage.robot.joint_names


def test_joint_states_are_the_home_pose(tmp_path: Path) -> None:
    """Where the stage has joint states (PhysX), they are the home pose, in radians, and no targets of drives."""
    stage = arm(tmp_path)
    elbow = stage.joint("elbow")
    elbow.AddAppliedSchema("PhysicsJointStateAPI:angular")
    elbow.CreateAttribute("state:angular:physics:position", Sdf.ValueTypeNames.Float).Set(30.0)
    found = robots.load(stage.save())
    np.testing.assert_allclose(found.home, [0.0, 0.0, math.radians(30.0), 0.0, 0.0, 0.0, 0.0], atol=SINGLE)


def test_soft_bodies_and_planes_are_left_out(tmp_path: Path) -> None:
    """A deformable beside the robot, and a plane on a link, are left out with notes."""
    from tests.usd.stages import UsdGeom

    stage = arm(tmp_path)
    stage.author.body("/World/soft")
    plane = UsdGeom.Plane.Define(stage.stage, f"{ROOT}/base/plane")
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    found = robots.load(stage.save())
    assert found.joint_names == stage.robot.joint_names
    assert any("/World/soft" in note for note in found.notes)
    assert any("plane" in note and "left out" in note for note in found.notes)


def spherical(stage: StageRobot) -> None:
    """Replace a hinge by a ball joint."""
    stage.joint("roll").SetTypeName("PhysicsSphericalJoint")


def sliding_loop(stage: StageRobot) -> None:
    """Close a loop by a slide."""
    loop = UsdPhysics.PrismaticJoint.Define(stage.stage, f"{ROOT}/loop")
    loop.CreateBody0Rel().SetTargets([f"{ROOT}/jaw_a"])
    loop.CreateBody1Rel().SetTargets([f"{ROOT}/jaw_b"])
    loop.CreateExcludeFromArticulationAttr(True)


def no_root(stage: StageRobot) -> None:
    """Take the articulation's schema away."""
    stage.stage.GetPrimAtPath(ROOT).RemoveAPI(UsdPhysics.ArticulationRootAPI)


def not_finite(stage: StageRobot) -> None:
    """Put a link nowhere."""
    stage.joint("elbow").GetAttribute("physics:localPos0").Set(Gf.Vec3f(math.nan, 0.0, 0.0))


def outside(stage: StageRobot) -> None:
    """Refer to a file of another folder."""
    folder = stage.path.parent.parent / "elsewhere"
    folder.mkdir(exist_ok=True)
    (folder / "part.usda").write_text('#usda 1.0\ndef Xform "part" {}\n')
    stage.stage.DefinePrim("/World/part").GetReferences().AddReference("../elsewhere/part.usda", "/part")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (spherical, "ball joint"),
        (sliding_loop, "cannot close a loop"),
        (no_root, "PhysicsArticulationRootAPI"),
        (not_finite, "NaN"),
        (outside, "outside"),
    ],
)
def test_refused(change: Any, words: str, tmp_path: Path) -> None:
    """What a robot cannot have, and what may not be read, ends with an error that names file and cause."""
    folder = tmp_path / "robot"
    folder.mkdir()
    stage = arm(folder)
    change(stage)
    path = stage.save()
    with pytest.raises(AssetError, match=words) as caught:
        robots.load(path)
    assert "arm.usda" in str(caught.value)


def test_several_robots_and_damaged_files(tmp_path: Path) -> None:
    """A prop beside the robot makes `root=` needed; text that is no stage is refused."""
    from softmode.errors import ConfigError

    stage = arm(tmp_path)
    stage.author.prop("/World/crate", (1.0, 0.0, 0.05))
    path = stage.save()
    with pytest.raises(ConfigError, match="root="):
        robots.load(path)
    assert robots.load(path, root="base").joint_names == stage.robot.joint_names
    broken = tmp_path / "broken.usda"
    broken.write_text("#usda 1.0\ndef Xform {")
    with pytest.raises(AssetError, match=r"broken\.usda"):
        robots.load(broken)


def test_mimic_of_physx_and_a_leader_that_is_not_there(tmp_path: Path) -> None:
    """PhysX: q + gearing q_leader + offset = 0, the offset of a hinge in degrees; a leader that is no joint is refused.

    With gearing 0.5 and offset 10 degrees, roll = -0.5 wrist - pi / 18; both get the range that they reach together.
    """
    stage = arm(tmp_path)
    follower = stage.joint("roll")
    follower.AddAppliedSchema("PhysxMimicJointAPI:rotZ")
    leader = follower.CreateRelationship("physxMimicJoint:rotZ:referenceJoint")
    leader.SetTargets([f"{JOINTS}/wrist"])
    for name, value in (("gearing", 0.5), ("offset", 10.0)):
        follower.CreateAttribute(f"physxMimicJoint:rotZ:{name}", Sdf.ValueTypeNames.Float).Set(value)
    found = robots.load(stage.save())
    (tie,) = found.ties
    assert (tie.joint, tie.leader) == ("roll", "wrist")
    assert (tie.ratio, tie.offset) == pytest.approx((-0.5, -math.pi / 18.0), abs=SINGLE)
    wrist, roll = (found.joint_names.index(name) for name in ("wrist", "roll"))
    ends = [tie.offset + tie.ratio * found.joint_upper[wrist], tie.offset + tie.ratio * found.joint_lower[wrist]]
    assert [found.joint_lower[roll], found.joint_upper[roll]] == pytest.approx(ends)
    leader.SetTargets([f"{JOINTS}/nothing"])
    with pytest.raises(AssetError, match="no joint of it"):
        robots.load(stage.save())
