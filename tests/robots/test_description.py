"""Robots from files: what the file says arrives in Newton, and the robot holds its pose."""

from __future__ import annotations

import dataclasses
import importlib
import warnings
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from softmode import robots
from softmode.errors import AssetError, ConfigError
from tests.robots.files import MJCF, URDF, write_mjcf, write_urdf

mujoco: Any = importlib.import_module("mujoco")
needs_aloha = pytest.mark.skipif("aloha_arm" not in robots.available(), reason="this mujoco-warp ships no ALOHA arm")
KINDS = [pytest.param("aloha", marks=needs_aloha), "mjcf", "urdf"]


def description(kind: str, folder: Path) -> robots.RobotDescription:
    """Return one of the three robots."""
    if kind == "aloha":
        return dataclasses.replace(robots.load("aloha_arm"), visuals=False)
    if kind == "mjcf":
        return robots.load(write_mjcf(folder))
    return robots.load(write_urdf(folder), asset_root=folder)


class Stand:
    """A robot alone, with SolverMuJoCo."""

    def __init__(self, robot, *, xform=None, dt=0.004, solve=True):
        world = newton.ModelBuilder()
        self.robot = robot
        self.indices = robot.add_to(world, xform=xform)
        self.world = world
        builder = newton.ModelBuilder()
        builder.replicate(world, 1)
        self.model = builder.finalize(device="cpu")
        self.dt = dt
        self.state, self.next_state, self.control = self.model.state(), self.model.state(), self.model.control()
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state)
        if solve:
            self.solver = newton.solvers.SolverMuJoCo(self.model, disable_contacts=True)

    def step(self, count):
        """Take an even number of steps, replayed as a graph."""
        self._pair()
        with wp.ScopedCapture(device=self.model.device) as capture:
            self._pair()
        for _ in range(count // 2 - 1):
            wp.capture_launch(capture.graph)

    def _pair(self):
        """Step there and back."""
        for first, second in ((self.state, self.next_state), (self.next_state, self.state)):
            self.solver.step(first, second, self.control, None, self.dt)

    def put(self, joint_q):
        """Set the pose."""
        self.state.joint_q.assign(np.asarray(joint_q, np.float32))
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    @property
    def tool(self):
        """Position of the tool point [m]."""
        pose = wp.transform(*self.state.body_q.numpy()[self.indices.hand_body]) * wp.transform(*self.robot.tool)
        return np.array(wp.transform_get_translation(pose))


@pytest.mark.parametrize("kind", KINDS)
def test_builder_holds_the_home_pose(kind, tmp_path):
    """Where the builder has the links, for what is attached to them there, is where the home pose puts them."""
    xform = (0.1, -0.2, 0.3, 0.0, 0.0, np.sin(0.35), np.cos(0.35))
    stand = Stand(description(kind, tmp_path), xform=xform, solve=False)
    links = list(stand.indices.link_bodies)
    given, found = np.array(stand.world.body_q)[links], stand.state.body_q.numpy()[links]
    np.testing.assert_allclose(given[:, :3], found[:, :3], atol=1.0e-6)
    np.testing.assert_allclose(np.abs((given[:, 3:] * found[:, 3:]).sum(axis=1)), 1.0, atol=1.0e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_masses_and_kinematics_are_the_compiler_s(kind, tmp_path):
    """Mass, centre of mass, inertia and the pose of every link equal MuJoCo's at random joint angles (float32)."""
    robot = description(kind, tmp_path)
    base = (0.2, -0.1, 0.3, 0.0, 0.0, np.sin(0.4), np.cos(0.4))
    stand = Stand(robot, xform=base, solve=False)
    model = mujoco.MjModel.from_xml_string(robot.mjcf)
    data = mujoco.MjData(model)
    assert [model.body(b).name for b in range(1, model.nbody)] == list(robot.link_names)
    np.testing.assert_allclose(stand.model.body_mass.numpy(), model.body_mass[1:], rtol=1e-4, atol=1e-7)
    rng = np.random.default_rng(2)
    low, high = (np.clip(values, -3.0, 3.0) for values in (robot.joint_lower, robot.joint_upper))
    for _ in range(3):
        joint_q = rng.uniform(low, high)
        data.qpos[:] = joint_q
        mujoco.mj_forward(model, data)
        stand.put(joint_q)
        tool = wp.transform(*base) * wp.transform(*robot.tool_pose(joint_q))
        np.testing.assert_allclose(stand.tool, np.array(tool)[:3], atol=2e-6)
        for pose, body, b in zip(stand.state.body_q.numpy(), stand.indices.link_bodies, range(1, 99), strict=False):
            assert body == b - 1
            expected = wp.transform(*base) * wp.transform(data.xpos[b], np.roll(data.xquat[b], -1))
            np.testing.assert_allclose(pose[:3], np.array(expected)[:3], atol=2e-6)
            assert abs(np.dot(pose[3:], np.array(expected)[3:])) == pytest.approx(1.0, abs=2e-6)
            turn = data.ximat[b].reshape(3, 3)
            world_inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
            base_turn = np.array(wp.quat_to_matrix(wp.quat(*base[3:]))).reshape(3, 3)
            matrix = base_turn.T @ np.array(wp.quat_to_matrix(wp.quat(*pose[3:].tolist()))).reshape(3, 3)
            ours = matrix @ stand.model.body_inertia.numpy()[body] @ matrix.T
            if model.body_mass[b] > 0.0:
                np.testing.assert_allclose(ours, world_inertia, atol=2e-3 * np.abs(world_inertia).max())


@pytest.mark.parametrize("kind", KINDS)
def test_holds_home_under_gravity(kind, tmp_path):
    """After 2 s the tool is within 5 mm of home and at rest; the default carries the weight: within 0.1 mm."""
    stand = Stand(description(kind, tmp_path))
    assert stand.world.custom_attributes["mujoco:gravcomp"].values
    start = stand.tool
    stand.step(500)
    assert np.linalg.norm(stand.tool - start) < 1e-4
    assert np.abs(stand.state.joint_qd.numpy()).max() < 1e-4


def test_drives_of_an_mjcf(tmp_path):
    """A servo, an affine actuator and tied fingers on a tendon: k_i = k (dL/dq)^2 / n, and so damping and limit."""
    robot = description("mjcf", tmp_path)
    assert robot.joint_names == ("shoulder", "elbow", "left", "right")
    shoulder, elbow, left, right = robot.drives
    assert (shoulder.stiffness, shoulder.damping, shoulder.effort_limit) == (300.0, 12.0, 40.0)
    assert (shoulder.lower, shoulder.upper) == (-1.5, 1.5)
    assert (elbow.stiffness, elbow.damping, elbow.effort_limit) == (200.0, 8.0, np.inf)
    # The tendon's length is the mean of both fingers, so dL/dq = 1 when they move together.
    assert left == right
    assert (left.stiffness, left.damping, left.effort_limit) == pytest.approx((400.0, 30.0, 12.0))
    assert (left.lower, left.upper) == pytest.approx((0.0, 0.04))
    assert robot.gripper == robots.RobotGripper(joints=("left", "right"), closed=(0.0, 0.0), open=(0.04, 0.04))
    np.testing.assert_allclose(robot.home, (-0.4, 0.9, 0.02, 0.02))
    assert robot.end_effector == "fore"
    assert robot.hand_links == ("fore", "jaw_left", "jaw_right")
    stand = Stand(robot)
    np.testing.assert_allclose(stand.model.joint_armature.numpy(), (0.05, 0.05, 0.1, 0.1))
    np.testing.assert_allclose(stand.model.joint_damping.numpy(), (0.4, 0.4, 3.0, 3.0))
    np.testing.assert_allclose(stand.model.joint_friction.numpy(), (0.0, 0.1, 0.0, 0.0))
    np.testing.assert_allclose(stand.model.joint_target_q.numpy(), robot.home, rtol=1e-6)


def test_tied_joints_with_a_servo_each(tmp_path):
    """q_left = -2 q_right, 100 N/m on each: on q_right k = 100 (4 + 1); the shares are k / 2 and k / (2 * 4)."""
    tendon = MJCF[MJCF.index("    <general tendon") : MJCF.index("  </actuator>")]
    servos = '<position joint="{}" kp="100" kv="10" forcerange="-6 6"/>'
    text = MJCF.replace(tendon, servos.format("left") + servos.format("right"))
    text = text.replace('range="0 0.04"', 'range="-0.1 0.1"').replace('polycoef="0 1', 'polycoef="0 -2')
    robot = robots.load(write_mjcf(tmp_path, text), home=(0.0, 0.0, 0.0, 0.0))
    left, right = robot.drives[2:]
    assert (left.stiffness, left.damping, left.effort_limit) == pytest.approx((62.5, 6.25, 4.5))
    assert (right.stiffness, right.damping, right.effort_limit) == pytest.approx((250.0, 25.0, 9.0))


def test_drives_of_a_urdf(tmp_path):
    """Critically damped at 8 Hz: k = m w^2, d + damping = 2 m w; the mimic joint shares the range; limits arrive."""
    robot = description("urdf", tmp_path)
    lift, jaw_a, jaw_b = robot.drives
    stand = Stand(robot)
    omega = 2.0 * np.pi * 8.0
    mass = newton.eval_mass_matrix(stand.model, stand.state).numpy()[0]
    for drive, inertia, damping in zip(robot.drives, np.diag(mass), (0.5, 0.0, 0.0), strict=True):
        assert drive.stiffness == pytest.approx(inertia * omega**2, rel=1e-4)
        assert drive.damping + damping == pytest.approx(2.0 * inertia * omega, rel=1e-4)
    assert (lift.effort_limit, jaw_a.effort_limit, jaw_b.effort_limit) == (60.0, 20.0, 20.0)
    assert robot.end_effector == "tool0"
    assert robot.gripper == robots.RobotGripper(joints=("jaw_a", "jaw_b"), closed=(0.0, 0.0), open=(0.03, 0.03))
    assert not stand.solver.mj_model.neq


@pytest.mark.parametrize("kind", [pytest.param("aloha", marks=needs_aloha), "mjcf"])
def test_moves_as_mujoco_moves_the_file(kind, tmp_path):
    """A step of all commands, without gravity compensation: joints follow MuJoCo's own actuators within 1 %."""
    robot = dataclasses.replace(description(kind, tmp_path), gravity_compensation=False)
    spec = mujoco.MjSpec.from_file(str(robot.path))
    model = spec.compile()
    dt = model.opt.timestep = 0.002
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in robot.joint_names]
    address = [int(joint.qposadr[0]) for joint in joints]
    data.qpos[address] = robot.home
    target = robot.with_opening(0.9, np.array(robot.home) + 0.1)
    stand = Stand(robot, dt=dt)
    stand.control.joint_target_q.assign(target.astype(np.float32))
    for a in range(model.nu):
        name = model.joint(model.actuator_trnid[a, 0]).name if model.actuator_trntype[a] == 0 else "left"
        if name in robot.joint_names:
            gain, bias = model.actuator_gainprm[a, 0], model.actuator_biasprm[a, 1]
            data.ctrl[a] = -bias / gain * target[robot.joint_names.index(name)]
    for _ in range(4):
        mujoco.mj_step(model, data, 50)
        stand.step(50)
        travel = np.abs(target - np.array(robot.home))
        error = np.abs(stand.state.joint_q.numpy() - data.qpos[address])
        # MuJoCo's tie between the fingers is soft; by what they differ there, each may differ from ours.
        slack = np.zeros(len(error))
        slack[-2:] = abs(np.diff(data.qpos[address[-2:]])[0])
        assert np.all(error <= 0.01 * travel + slack), error / travel


@pytest.mark.parametrize("collision", ["hull", "mesh"])
def test_collision_meshes(collision, tmp_path):
    """Hulls are closed and convex by default; the file's own meshes stay on request. Only the hand is touched."""
    robot = dataclasses.replace(description("mjcf", tmp_path), collision=collision)
    stand = Stand(robot, solve=False)
    world = stand.world
    solid = [s for s in stand.indices.shapes if world.shape_flags[s] & newton.ShapeFlags.COLLIDE_SHAPES]
    kinds = [newton.GeoType(world.shape_type[s]) for s in solid]
    wanted = newton.GeoType.CONVEX_MESH if collision == "hull" else newton.GeoType.MESH
    assert kinds.count(wanted) == 1
    hand = {world.body_label.index(f"small/{name}") for name in robot.hand_links}
    touched = [s for s in stand.indices.shapes if world.shape_flags[s] & int(newton.ShapeFlags.COLLIDE_PARTICLES)]
    assert len(touched) == 3  # the box of the hand, both jaws; not the sphere that is only seen
    assert {world.shape_body[s] for s in touched} == hand
    everything = Stand(dataclasses.replace(robot, touch="all"), solve=False)
    flags = [
        everything.world.shape_flags[s] & int(newton.ShapeFlags.COLLIDE_PARTICLES) for s in everything.indices.shapes
    ]
    assert sum(map(bool, flags)) == 5


def test_two_robots_in_one_builder(tmp_path):
    """Indices count on; labels carry the prefix; the built-in arm is added by the same method."""
    small, arm = description("mjcf", tmp_path), robots.ArmDescription()
    world = newton.ModelBuilder()
    first = arm.add_to(world)
    second = small.add_to(world, label="left")
    third = small.add_to(world, xform=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), label="right")
    assert (first.coord_start, second.coord_start, third.coord_start) == (0, 9, 13)
    np.testing.assert_allclose(world.joint_q[9:13], small.home)
    assert world.body_label[third.hand_body] == "right/fore"
    assert [world.body_label[b] for b in second.finger_bodies] == ["left/jaw_left", "left/jaw_right"]
    assert world.articulation_label == ["arm", "left", "right"]
    model = world.finalize(device="cpu")
    with pytest.raises(ConfigError, match="joint_target_q"):
        robots.ArmController(model, second)


FOUR_BAR = """<mujoco><worldbody><body name="base"><geom size="0.02"/>
  <body name="crank"><joint name="crank" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/>
    <body name="coupler" pos="0 0 0.1"><joint name="coupler" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01"/><site name="tool" pos="0.1 0 0"/></body></body>
  <body name="rocker" pos="0.2 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/></body></body></worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor="0.2 0 0"/></equality>
  <actuator><position joint="crank" kp="20" kv="2"/></actuator></mujoco>"""


def test_closed_loop_stays_closed(tmp_path):
    """A parallelogram driven at its crank: the passive joints follow, rocker = crank = -coupler within 0.01 rad."""
    robot = robots.load(write_mjcf(tmp_path, FOUR_BAR))
    assert robot.passive_joints == ("coupler", "rocker")
    stand = Stand(robot)
    stand.control.joint_target_q.assign(np.array([0.5, 0.0, 0.0], np.float32))
    stand.step(500)
    crank, coupler, rocker = stand.state.joint_q.numpy()
    assert crank == pytest.approx(0.5, abs=0.01)
    assert (coupler, rocker) == pytest.approx((-crank, crank), abs=0.01)


# -- what a caller may get wrong ---------------------------------------------------------------------------------------


TWO_ROBOTS = MJCF.replace('name="base"', 'name="a"/><body name="b"', 1)
BALL = '<mujoco><worldbody><body><joint name="hip" type="ball"/><geom size="0.1"/></body></worldbody></mujoco>'
NO_TOOL = MJCF.replace('name="pinch"', 'name="spot"')


@pytest.mark.parametrize(
    ("text", "options", "error", "words"),
    [
        (NO_TOOL, {"end_effector": "pinch"}, ConfigError, ["'pinch'", "'spot'", "'jaw_left'"]),
        (MJCF, {"end_effector": "finger"}, ConfigError, ["'finger'", "end_effector", "'pinch'"]),
        (MJCF, {"tool_offset": (0.0, 1.0)}, ConfigError, ["tool_offset"]),
        (MJCF, {"home": (0.0, 0.0)}, ConfigError, ["home", "shoulder, elbow, left, right"]),
        (MJCF, {"home": (9.0, 0.0, 0.0, 0.0)}, ConfigError, ["'shoulder'", "9.0"]),
        (MJCF, {"home": (float("nan"), 0.0, 0.0, 0.0)}, ConfigError, ["home", "not finite"]),
        (MJCF, {"gripper": {"thumb": (0.0, 1.0)}}, ConfigError, ["'thumb'", "shoulder, elbow, left, right"]),
        (MJCF, {"root": "torso"}, ConfigError, ["'torso'", "root", "'base'"]),
        (TWO_ROBOTS, {}, ConfigError, ["2 bodies", "root", "'a'", "'b'"]),
        (BALL, {}, AssetError, ["small.xml", "'hip'", "ball"]),
        (BALL.replace("ball", "free"), {}, AssetError, ["small.xml", "no joint"]),
        (MJCF.replace("armature=", "armour=", 1), {}, AssetError, ["small.xml", "armour", "line 5"]),
        (MJCF.replace("</body>", "", 1), {}, AssetError, ["small.xml, line"]),
        (MJCF.replace("mujoco", "sdf"), {}, AssetError, ["<sdf>", "<mujoco>", "<robot>"]),
        ("", {}, AssetError, ["small.xml, line 1"]),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]>" + MJCF, {}, AssetError, ["document type"]),
        ("<mujoco><worldbody/></mujoco>", {}, ConfigError, ["0 bodies"]),
        ("<mujoco><worldbody><body name='rock'/></worldbody></mujoco>", {}, AssetError, ["no joint"]),
    ],
)
def test_bad_files_and_arguments(text, options, error, words, tmp_path):
    """Typed errors that name the argument or the file with its line, and the choices."""
    path = write_mjcf(tmp_path, text)
    with pytest.raises(error) as caught:
        robots.load(path, **options)
    assert caught.value.hint
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("field", [{"collision": "sphere"}, {"touch": "none"}, {"home": (0.0,)}])
def test_bad_variants(field, tmp_path):
    """`replace` checks as well."""
    with pytest.raises(ConfigError, match=next(iter(field))):
        dataclasses.replace(description("mjcf", tmp_path), **field)


def test_robot_without_gripper(tmp_path):
    """It loads; asking for an opening says how to name its joints."""
    robot = robots.load(write_mjcf(tmp_path), end_effector="jaw_left")
    assert robot.gripper is None
    with pytest.raises(ConfigError, match="gripper="):
        robot.with_opening(0.5)


def test_urdf_mesh_that_is_missing(tmp_path):
    """The error names file and mesh."""
    path = write_urdf(tmp_path, URDF.replace("wedge.stl", "spoon.stl"))
    with pytest.raises(AssetError, match=r"spoon\.stl.*does not exist.*asset_root"):
        robots.load(path, asset_root=tmp_path)


def test_urdf_whose_meshes_lie_elsewhere_names_the_folder(tmp_path):
    """What stands behind asset_root= in the error loads the file."""
    path = write_urdf(tmp_path, URDF.replace("package://lifter/", "../"))
    path.parent.with_name("models").mkdir()
    path = path.rename(path.parent.with_name("models") / "lifter.urdf")
    with pytest.raises(AssetError, match=r"asset_root=") as caught:
        robots.load(path)
    folder = str(caught.value).split("asset_root=")[1].split()[0]
    assert robots.load(path, asset_root=folder).gripper is not None


SINGULAR = """<mujoco><worldbody>
  <body name="base"><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
  <body name="light"><joint name="first"/><inertial mass="1e-14" pos="0 0 0" diaginertia="2e-15 2e-15 2e-15"/>
    <body name="heavy"><joint name="second"/><inertial mass="100" pos="0 0 0" diaginertia="100 100 100"/></body>
  </body></body>
</worldbody></mujoco>"""
"""Two links on one axis, the first of which weighs next to nothing: MuJoCo warns of a singular inertia matrix."""


@pytest.mark.filterwarnings("ignore:Inertia matrix:UserWarning")  # of MuJoCo's compiler, which warns in Python
def test_warnings_of_mujoco_are_pythons(tmp_path, monkeypatch):
    """They write no MUJOCO_LOG.TXT, are errors where warnings are, and leave a handler of the user's in its place."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "singular.xml"
    file.write_text(SINGULAR)
    with pytest.warns(RuntimeWarning, match="MuJoCo: Inertia matrix is too close to singular"):
        robot = robots.load(file, end_effector="heavy")
    with pytest.warns(RuntimeWarning, match="singular"):
        dataclasses.replace(robot, mjcf=SINGULAR).joint_inertias()
    with warnings.catch_warnings(), pytest.raises(RuntimeWarning, match="singular"):
        warnings.simplefilter("error", RuntimeWarning)
        robots.load(file, end_effector="heavy")
    assert mujoco.get_mju_user_warning() is None
    own: list[str] = []
    mujoco.set_mju_user_warning(own.append)
    try:
        robots.load(file, end_effector="heavy")
    finally:
        mujoco.set_mju_user_warning(None)
    assert own and not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_limits_that_leave_something_to_the_defaults(tmp_path: Path) -> None:
    """MuJoCo leaves out what is its default; Newton would take it for zero, which switches a limit off."""
    text = MJCF.replace('name="elbow" class="arm"', 'name="elbow" class="arm" solreflimit="0.005 1" solimplimit="0.8"')
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    indices = robots.load(write_mjcf(tmp_path, text)).add_to(builder)
    dof = indices.dof_start + 1
    values = {
        name: list(builder.custom_attributes[f"mujoco:{name}"].values[dof]) for name in ("solreflimit", "solimplimit")
    }
    np.testing.assert_allclose(values["solreflimit"], (0.005, 1.0), rtol=1e-6)
    np.testing.assert_allclose(values["solimplimit"], (0.8, 0.95, 0.001, 0.5, 2.0), rtol=1e-6)


def test_what_is_seen(tmp_path: Path) -> None:
    """Where one link has a visible shape, those that only collide show it too; white, MuJoCo's default, stays white."""
    material = '<material name="white"/><material name="red" rgba="0.8 0.1 0.1 1"/>'
    text = MJCF.replace("<asset>", f"<asset>{material}").replace('type="cylinder"', 'type="cylinder" material="white"')
    robot = robots.load(write_mjcf(tmp_path, text.replace('mesh="wedge" mass', 'mesh="wedge" material="red" mass')))
    world = newton.ModelBuilder()
    indices = robot.add_to(world)
    bodies = dict(zip(robot.link_names, indices.link_bodies, strict=True))
    seen: dict[int, list[int]] = {body: [] for body in indices.link_bodies}
    for shape in indices.shapes:
        flags = world.shape_flags[shape]
        if flags & newton.ShapeFlags.VISIBLE:
            assert not flags & (newton.ShapeFlags.COLLIDE_SHAPES | newton.ShapeFlags.COLLIDE_PARTICLES)
            seen[world.shape_body[shape]].append(shape)
    assert [len(shapes) for shapes in seen.values()] == [1, 1, 1, 1, 1]
    colors = {name: world.shape_color[seen[body][0]] for name, body in bodies.items()}
    np.testing.assert_allclose(colors["base"], 1.0)
    np.testing.assert_allclose(colors["jaw_left"], (0.8, 0.1, 0.1), atol=1e-6)
    # The fore link has a box that collides beside the ball that is seen, which alone stays to be seen.
    assert newton.GeoType(world.shape_type[seen[bodies["fore"]][0]]) == newton.GeoType.SPHERE
    assert newton.GeoType(world.shape_type[seen[bodies["jaw_left"]][0]]) == newton.GeoType.MESH
    hidden = newton.ModelBuilder()
    dataclasses.replace(robot, visuals=False).add_to(hidden)
    assert hidden.shape_count == 5
