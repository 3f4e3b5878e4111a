"""MuJoCo's contacts inside the joint solve: light boxes on the ground, stacks, mass ratios, joints of every kind."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.errors import ConfigError
from tests.bodies import cube
from tests.deformables.test_coupling import Potential
from tests.scenes import GRAVITY, GRIPPER, Scene, add_free_box, add_gripper

EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
MASS = 1000.0 * EDGE**3 * 0.3
"""What a soft cube of these tests weighs [kg]."""


def deepest(scene):
    """Return how deep surface samples were inside shapes at the start of the last step [m]."""
    samples = scene.reduced.view.samples
    gap = samples.gap.numpy()[samples.shape.numpy() >= 0]
    return -min(0.0, gap.min(initial=0.0))


# -- the rows ----------------------------------------------------------------------------------------------------------


def turned_box(world):
    """Add a light free box that slides on the ground, turned and with its centre of mass off its origin."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.7)
    body = world.add_body(
        xform=wp.transform(wp.vec3(0.01, 0.0, 0.02), turn),
        mass=0.05,
        com=wp.vec3(0.01, 0.005, 0.0),
        inertia=wp.mat33(np.diag([3e-5, 4e-5, 6e-5])),
        lock_inertia=True,
    )
    world.joint_qd[-6] = 0.3
    return body, 0.02


def plate_on_ball(world):
    """Add a plate on a ball joint, with turned frames, whose corners stand on the ground."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.3)
    pose = wp.transform(wp.vec3(0.0, 0.0, 0.02), wp.quat_identity())
    body = world.add_link(xform=pose, mass=0.2, inertia=wp.mat33(np.diag([3e-4, 4e-4, 6e-4])), lock_inertia=True)
    joint = world.add_joint_ball(
        parent=-1,
        child=body,
        parent_xform=wp.transform(wp.vec3(0.0, 0.0, 0.02), turn),
        child_xform=wp.transform(wp.vec3(0.0, 0.0, 0.0), turn),
    )
    world.add_articulation([joint])
    return body, 0.0199


def slide_at_limit(world):
    """Add a plate on a vertical slide with friction loss, at its lower limit above the ground."""
    pose = wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity())
    body = world.add_link(xform=pose, mass=0.05, inertia=wp.mat33(np.eye(3) * 1e-4), lock_inertia=True)
    joint = world.add_joint_prismatic(
        parent=-1, child=body, axis=(0, 0, 1), parent_xform=pose, limit_lower=0.0, limit_upper=1.0, friction=0.2
    )
    world.add_articulation([joint])
    return body, 0.02


def standing(rigid, height, **mujoco):
    """Return a soft cube that falls half a millimetre onto a rigid body, off its centre."""

    def populate(world):
        link, half = rigid(world)
        config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=0.5)
        world.add_shape_box(link, hx=0.05, hy=0.05, hz=half, cfg=config)
        material = Material(youngs_modulus=5.0e5, friction=0.4)
        add_reduced_body(world, cube(), material=material, position=(0.02, 0.01, height + half + 0.0505))

    mujoco = {"tolerance": 1e-10, "iterations": 100} | mujoco
    return Scene(populate, [cube()], coupled=True, gravity=DOWN, ground=0.3, mujoco=mujoco)


@pytest.mark.parametrize(
    ("rigid", "height", "cone", "jacobian"),
    [
        (turned_box, 0.02, "pyramidal", "dense"),
        (turned_box, 0.02, "elliptic", "sparse"),
        (plate_on_ball, 0.02, "elliptic", "dense"),
        (slide_at_limit, 0.1, "pyramidal", "dense"),
    ],
)
def test_solve_foresees_what_mujoco_does(rigid, height, cone, jacobian):
    """The joint velocities of the solve, r / dt, are those that MuJoCo's second step ends with: the rows are exact.

    Contacts that slide, stick and open, limits and friction loss; to 1e-3 of what the soft body changes (MuJoCo's
    iteration is float32).
    """
    scene = standing(rigid, height, cone=cone, jacobian=jacobian)
    solver = scene.solver
    error, change, rows = 0.0, 0.0, 0
    for _ in range(30):
        scene.step()
        if solver._any_pushed.numpy()[0]:
            velocity = scene.state.joint_qd.numpy()
            error = max(error, np.abs(solver.reduced.tables.rigid.table.r.numpy()[0] / scene.dt - velocity).max())
            change = max(change, np.abs(velocity - solver.predicted_state.joint_qd.numpy()).max())
            rows = max(rows, int(solver.reduced.tables.rigid.table.row_count.numpy()[0]))
    assert rows > 0
    assert change > 0.01
    assert error <= 1e-3 * change


@pytest.mark.parametrize(
    ("rigid", "height", "cone"),
    [(turned_box, 0.02, "pyramidal"), (turned_box, 0.02, "elliptic"), (slide_at_limit, 0.1, "pyramidal")],
)
def test_derivatives_of_the_rows(rigid, height, cone):
    """The gradient over r is a central difference of the potential; the rows' matrix one of their gradient, and PSD."""
    potential = Potential(standing(rigid, height, cone=cone))
    assert potential.solver.tables.rigid.table.row_count.numpy()[0] > 0
    n, m, dt = 3 * potential.n, len(potential.r), potential.scene.dt
    rng = np.random.default_rng(0)
    u = potential.u.copy()
    u[n:] += 1e-3 * dt * rng.normal(size=m)  # away from the prediction: contacts open, slip and stick
    step = 1e-7 * dt
    for d in np.eye(m):
        d = np.concatenate([np.zeros(n), d])
        # the normal force of friction lags: the potential takes that of the last gradient
        gradient = potential.gradient(u)
        slope = (potential.value(u + step * d) - potential.value(u - step * d)) / (2 * step)
        noise = 16 * np.finfo(float).eps * max(abs(potential.value(u)), 1e-3) / step
        assert slope == pytest.approx(gradient @ d, rel=1e-4, abs=noise + 1e-4 * np.linalg.norm(gradient[n:]))
    potential.gradient(u)
    rigid = potential.solver.tables.rigid.table
    count = rigid.row_count.numpy()[0]
    rows = rigid.row_jacobian.numpy()[0, :count].T @ rigid.row_coupling.numpy()[0, :count]
    np.testing.assert_allclose(rows, rows.T, atol=1e-6 * np.abs(rows).max())
    assert np.linalg.eigvalsh(rows).min() >= -1e-6 * np.abs(rows).max()
    difference = np.array([row_gradient(potential, u, step, j) for j in range(m)])
    np.testing.assert_allclose(rows, difference, atol=1e-4 * np.abs(rows).max())


def row_gradient(potential, u, step, j):
    """Return the central difference over r_j of the rows' share of the gradient."""
    rigid, n = potential.solver.tables.rigid.table, 3 * potential.n
    shares = []
    for sign in (1.0, -1.0):
        moved = u.copy()
        moved[n + j] += sign * step
        potential.value(moved)
        count = rigid.row_count.numpy()[0]
        shares.append(rigid.row_force.numpy()[0, :count] @ rigid.row_jacobian.numpy()[0, :count].astype(float))
    return (shares[0] - shares[1])[: len(potential.r)] / (2 * step)


def test_ground_does_not_pull():
    """A soft cube that hits a standing table from below lifts it: P_(n+1) - P_n + dt M g >= 0 in every step."""
    body = cube()

    def populate(world):
        table = add_free_box(world, (0.12, 0.12, 0.01), 0.2, (0.0, 0.0, 0.17))
        config = newton.ModelBuilder.ShapeConfig(density=0.0)
        for side in (-1.0, 1.0):
            leg = wp.transform(wp.vec3(0.1 * side, 0.0, -0.09), wp.quat_identity())
            world.add_shape_box(table, xform=leg, hx=0.01, hy=0.1, hz=0.08, cfg=config)
        add_reduced_body(world, body, position=(0.0, 0.0, 0.09), velocity=(0.0, 0.0, 2.0))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8, dt=0.002)
    mass = scene.mass() + 0.2
    before, least, highest = None, np.inf, 0.0
    for _ in range(60):
        scene.step()
        p = scene.momentum()[0][2] + scene.rigid_momentum()[0][2]
        if before is not None:
            least = min(least, p - before + scene.dt * mass * GRAVITY)
        before = p
        highest = max(highest, scene.state.body_q.numpy()[0, 2])
    assert highest > 0.17 + 0.01
    assert least >= -1e-4 * scene.dt * mass * GRAVITY - 1e-6 * mass * 2.0


# -- statics -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.01, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_cube_on_light_box_on_ground(mass, dt):
    """A soft cube of 0.3 kg on a free box on the ground: at rest it feels its weight to 1 %, the box sinks < 1 mm."""
    body = cube()

    def populate(world):
        add_free_box(world, (0.05, 0.05, 0.02), mass, (0.0, 0.0, 0.02))
        add_reduced_body(world, body, material=Material(youngs_modulus=5.0e5), position=(0.0, 0.0, 0.0901))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8, dt=dt)
    replay = scene.capture()
    count = round(0.5 / dt)
    rows = []
    for _ in range(count):
        replay()
        rows.append([scene.reduced.instance_force.numpy()[0, 2], scene.state.body_q.numpy()[0, 2]])
    force, height = np.array(rows[-count // 4 :]).T
    weight = scene.mass() * GRAVITY
    np.testing.assert_allclose(force, weight, rtol=1e-2)
    assert 0.02 - height.min() < 1e-3
    assert np.ptp(height) < 1e-5
    assert scene.reduced.status.numpy()[0] == 0


def rest(populate, bodies, time=3.0):
    """Return a scene after ``time``, the path of its rigid body, its drift in the last half second, and the depth."""
    scene = Scene(populate, bodies, coupled=True, gravity=DOWN, ground=0.8)
    replay = scene.capture()
    path, depth = [], 0.0
    for _ in range(round(time / scene.dt / 2)):
        replay()
        path.append(scene.state.body_q.numpy()[0, :3].copy())
        depth = max(depth, deepest(scene))
    return scene, np.array(path), np.ptp(path[-round(0.25 / scene.dt) :], axis=0).max(), depth


@pytest.mark.parametrize(("ratio", "youngs_modulus"), [(1.0, 5.0e5), (100.0, 5.0e6), (1000.0, 5.0e7)])
def test_heavy_rigid_on_soft(ratio, youngs_modulus):
    """A rigid cube 1, 100, 1000 times as heavy as the soft one below rests within 1 mm, contact within 1 % of the edge.

    E such that the soft cube is compressed by less than 1 %.
    """
    body = cube()

    def populate(world):
        add_free_box(world, (0.5 * EDGE,) * 3, 0.3 * ratio, (0.0, 0.0, 1.5 * EDGE + 2e-4))
        material = Material(youngs_modulus=youngs_modulus)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.5 * EDGE + 1e-4))

    scene, path, drift, depth = rest(populate, [body])
    assert drift < 1e-5
    assert np.abs(path[-1] - [0.0, 0.0, 1.5 * EDGE]).max() < 1e-3
    assert depth <= 0.01 * EDGE
    force = scene.solver.body_wrench.numpy()[0, 2]
    assert force == pytest.approx(0.3 * ratio * GRAVITY, rel=1e-3)


@pytest.mark.parametrize("ratio", [1.0, 100.0, 1000.0])
def test_heavy_soft_on_light_rigid(ratio):
    """A soft cube rests on a box 1, 100, 1000 times lighter, which sinks as far as under a rigid cube of that weight.

    MuJoCo's contact of the box with the ground is as soft as the box is light: it sinks by 0.1, 2.6 and 26 mm, whatever
    stands on it. The contact of the soft body stays within 1 % of the edge.
    """
    body = cube()

    def populate(world, rigid=False):
        add_free_box(world, (0.05, 0.05, 0.02), 0.3 / ratio, (0.0, 0.0, 0.02))
        if rigid:
            add_free_box(world, (0.5 * EDGE,) * 3, 0.3, (0.0, 0.0, 0.0901))
        add_reduced_body(world, body, position=(2.0 if rigid else 0.0, 0.0, 0.0901))

    _, path, drift, depth = rest(populate, [body])
    _, other, _, _ = rest(lambda world: populate(world, rigid=True), [body])
    assert drift < 1e-5
    assert path[-1, 2] == pytest.approx(other[-1, 2], abs=1e-2 * float(0.02 - other[-1, 2]))
    assert np.abs(path[-1, :2]).max() < 1e-3
    assert depth <= 0.01 * EDGE


@pytest.mark.parametrize("time", [5.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_stack_stands(time):
    """A stack of soft, rigid and soft cube stands: after the first second nothing moves by 1 mm, nor trembles."""
    body = cube()

    def populate(world):
        material = Material(youngs_modulus=5.0e5)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.5 * EDGE + 1e-4))
        add_free_box(world, (0.5 * EDGE,) * 3, 0.3, (0.0, 0.0, 1.5 * EDGE + 2e-4))
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 2.5 * EDGE + 3e-4))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8)
    replay = scene.capture()
    path = []
    for _ in range(round(time / scene.dt / 2)):
        replay()
        path.append(np.concatenate([scene.centre(0), scene.state.body_q.numpy()[0, :3], scene.centre(1)]))
    path = np.array(path)
    second = round(1.0 / scene.dt / 2)
    assert np.abs(path[second:] - path[second]).max() < 1e-3
    assert path[-second:].std(axis=0).max() < 1e-6
    assert scene.reduced.status.numpy()[0] == 0


# -- several articulations ---------------------------------------------------------------------------------------------


def workshop(world_count=1):
    """Return a gripper of 3 dofs, a free container, a hinged flap and two soft cubes in every world, and its loop."""
    body = cube(0.06)

    def populate(world):
        add_gripper(world, 0.03)
        tray = add_free_box(world, (0.08, 0.08, 0.005), 0.1, (0.3, 0.0, 0.005))
        config = newton.ModelBuilder.ShapeConfig(density=0.0)
        wall = wp.transform(wp.vec3(0.075, 0.0, 0.03), wp.quat_identity())
        world.add_shape_box(tray, xform=wall, hx=0.005, hy=0.08, hz=0.025, cfg=config)
        inertia = wp.mat33(np.eye(3) * 1e-4)
        flap = world.add_link(
            xform=wp.transform(wp.vec3(-0.3, 0.0, 0.1), wp.quat_identity()), mass=0.1, inertia=inertia
        )
        world.add_shape_box(flap, hx=0.05, hy=0.05, hz=0.005, cfg=config)
        anchor = wp.transform(wp.vec3(-0.3, 0.0, 0.1), wp.quat_identity())
        joint = world.add_joint_revolute(parent=-1, child=flap, axis=(0, 1, 0), parent_xform=anchor)
        world.add_articulation([joint])
        world.add_shape_box(
            -1, hx=0.02, hy=0.02, hz=0.02, xform=wp.transform(wp.vec3(0.0, 0.3, 0.02), wp.quat_identity())
        )
        for x, z in ((0.0, 0.0301), (0.32, 0.0402), (-0.28, 0.1352)):
            add_reduced_body(world, body, material=Material(friction=0.8), position=(x, 0.0, z))

    scene = Scene(
        populate,
        [body],
        coupled=True,
        gravity=DOWN,
        ground=0.8,
        world_count=world_count,
        mujoco={"njmax": 128, "nconmax": 64},
    )
    target = scene.control.joint_target_q.numpy().reshape(world_count, -1)
    target[:, 1:3] = GRIPPER["squeeze"]
    scene.control.joint_target_q.assign(target.ravel())
    return scene


def test_several_articulations_in_a_world():
    """Gripper, container and flap are all pushed by what touches them: weight on the container, torque on the flap."""
    scene = workshop()
    dofs = scene.reduced.tables.rigid.table
    assert sorted(dofs.articulation_dof_count.numpy()) == [1, 3, 6]
    flap = len(scene.model.body_mass.numpy()) - 1
    scene.step(15)
    assert scene.state.joint_q.numpy()[-1] > 0.0  # the cube stands on the far side of the hinge
    assert scene.solver.body_wrench.numpy()[flap, 2] < -0.1
    scene.step(100)
    wrench = scene.solver.body_wrench.numpy()
    tray = flap - 1
    assert wrench[tray, 2] == pytest.approx(-scene.mass() * GRAVITY, rel=0.02)
    friction = 0.8 * scene.mass() * GRAVITY  # of the ground, on which the squeezed cube still stands
    assert wrench[1, 1] == pytest.approx(-wrench[2, 1], abs=friction)
    assert wrench[1, 1] > 10.0
    assert scene.reduced.status.numpy()[0] == 0


def test_worlds_of_several_articulations():
    """World i of 64, a robot and a free container in each, equals the single world bit for bit, captured too."""

    def run(scene, worlds):
        replay = scene.capture()
        for k, i in enumerate(worlds):
            qd = scene.qd(3 * k)
            # in every second world the cube between the fingers leaves before they touch it
            qd[0] = (0.2 * np.random.default_rng(i).normal(size=3)) if i % 2 else [0.0, 0.0, 5.0]
            scene.set(qd=qd, instance=3 * k)
        for _ in range(15):
            replay()
        arrays = scene.state.softmode.q, scene.state.joint_q, scene.state.joint_qd, scene.state.body_q
        return [array.numpy().reshape(len(worlds), -1) for array in arrays], scene.solver._pushed.numpy().copy()

    every, _ = run(workshop(64), range(64))
    for i in (4, 63):
        for batch, alone in zip(every, run(workshop(), [i])[0], strict=True):
            np.testing.assert_array_equal(batch[i], alone[0])


def test_untouched_world_among_touched():
    """A world whose soft body is away from every rigid one takes MuJoCo's own step, bit for bit, whatever others do."""
    body = cube()

    def populate(world):
        add_free_box(world, (0.05, 0.05, 0.02), 0.1, (0.0, 0.0, 0.0199))
        add_reduced_body(world, body, position=(0.0, 0.0, 0.0901))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8, world_count=2)
    q = scene.q(1)
    q[0, 0] += 1.0
    scene.set(q=q, instance=1)
    free = SolverMuJoCo(scene.model, njmax=64, nconmax=32)
    state, following = scene.model.state(), scene.model.state()
    newton.eval_fk(scene.model, scene.model.joint_q, scene.model.joint_qd, state)
    for _ in range(20):
        scene.step()
        free.step(state, following, None, None, scene.dt)
        state, following = following, state
    assert list(scene.solver._pushed.numpy()) == [1, 0]
    np.testing.assert_array_equal(scene.state.body_q.numpy()[1], state.body_q.numpy()[1])
    np.testing.assert_array_equal(scene.state.body_qd.numpy()[1], state.body_qd.numpy()[1])
    assert list(scene.reduced.tables.rigid.table.count.numpy()) == [6, 0]


# -- errors ------------------------------------------------------------------------------------------------------------


def test_joint_without_articulation():
    """A joint that belongs to no articulation is refused, and the message says what to call."""

    def populate(world):
        link = world.add_link(mass=1.0)
        world.add_shape_box(link, hx=0.1, hy=0.1, hz=0.02)
        world.add_joint_prismatic(parent=-1, child=link, axis=(0, 0, 1))
        add_reduced_body(world, cube())

    with pytest.warns(UserWarning), pytest.raises(ConfigError, match="add_articulation"):
        Scene(populate, [cube()], coupled=True)
