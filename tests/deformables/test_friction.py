"""Friction that remembers: sticking without creep, sliding at the cone, dissipation, and the life of the memory."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference
from tests.bodies import cube
from tests.deformables.probe_kernels import evaluate_stick
from tests.deformables.test_coupling import grasp
from tests.scenes import GRAVITY, Scene, add_free_box, rotation

EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
MU = 0.5
CREEP = 1.0e-4
"""Most that a body may move in ten seconds while it sticks [m]."""
ShapeConfig = newton.ModelBuilder.ShapeConfig


# -- the potential -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [1.0, 1.0e-3], ids=["soft", "used up"])
def test_stick_potential(depth):
    """A spring up to the limit, linear beyond; slope = secant * y; a continuous force, never above the limit.

    Where the dent along the surface is used up, 0.15 of ``depth``, the spring is five times as stiff.
    """
    limit, stiffness, step = 0.3, 2.0e3, 1.0e-9
    spring = (stiffness, 5.0 * stiffness, depth)
    y = np.linspace(step, 4.0 * limit / stiffness, 400)

    def evaluate(values, limit=limit):
        with wp.ScopedDevice("cpu"):
            out = wp.zeros(len(values), dtype=wp.vec3d)
            inputs = [wp.array(values, dtype=wp.float64), *map(wp.float64, (limit, *spring))]
            wp.launch(evaluate_stick, dim=len(values), inputs=inputs, outputs=[out])
        return out.numpy()

    value = evaluate(y)
    np.testing.assert_allclose(value[:, 0], reference.stick_potential(y, limit, *spring), rtol=1e-12)
    slope = (evaluate(y + step)[:, 0] - evaluate(y - step)[:, 0]) / (2 * step)
    np.testing.assert_allclose(value[:, 1] * y, slope, atol=1e-5 * limit)
    assert (value[:, 1] * y).max() == pytest.approx(limit)
    tangent = np.where(y <= 0.15 * depth, stiffness, 5.0 * stiffness)
    np.testing.assert_array_equal(value[:, 2], np.where(value[:, 1] * y < (1.0 - 1e-12) * limit, tangent, 0.0))
    np.testing.assert_array_equal(evaluate(np.array([0.0, step]), limit=0.0), 0.0)


def test_what_does_not_press_does_not_hold():
    """A body at rest in reach of the ground, but above it, falls along it at its first step: v = g dt to rounding.

    Nothing of friction may be in the matrix of that step either, or Newton needs more than the two iterations.
    """
    position = (0.0, 0.0, 0.5 * EDGE + 5.0e-4)
    scene = Scene(
        lambda world: add_reduced_body(world, cube(), position=position), [cube()], gravity=(GRAVITY, 0, 0), ground=MU
    )
    scene.step()
    assert scene.reduced.view.constraints.count.numpy()[0] > 0
    np.testing.assert_allclose(scene.momentum()[0] / scene.mass(), [GRAVITY * scene.dt, 0.0, 0.0], rtol=1e-6)
    assert scene.reduced.iteration.numpy()[0] <= 2


# -- inclines ----------------------------------------------------------------------------------------------------------


def incline(share, **kw):
    """Return a scene of a cube on a tilted box, tan(angle) = share mu, and the direction down the slope."""
    angle = np.arctan(share * MU)
    material, body, R = Material(youngs_modulus=5.0e5, friction=MU), cube(), rotation((0, 1, 0), angle)
    half = 3.0

    def populate(world):
        tilt = wp.quat_from_axis_angle(wp.vec3(0, 1, 0), float(angle))
        pose = wp.transform(wp.vec3(*(R @ [0.0, 0.0, -half])), tilt)
        world.add_shape_box(-1, xform=pose, hx=half, hy=half, hz=half, cfg=ShapeConfig(mu=MU))
        add_reduced_body(world, body, material=material, position=R @ [0.0, 0.0, 0.5 * EDGE], rotation=R)

    return Scene(populate, [body], gravity=DOWN, **kw), R @ [1.0, 0.0, 0.0]


def track(scene, along, time):
    """Replay for some time; return the times [s] and positions [m] along a direction after every second step."""
    replay, x = scene.capture(), []
    for _ in range(round(time / scene.dt / 2)):
        replay()
        x.append(along @ scene.centre())
    return 2.0 * scene.dt * np.arange(1, len(x) + 1), np.array(x)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_sticks_below_the_cone(share):
    """tan(angle) = share mu: the cube moves less than 1e-4 m in ten seconds, settling under its weight included."""
    time, x = track(*incline(share), 10.0)
    assert np.abs(x).max() <= CREEP
    # once settled it does not creep at all: what is left is the rounding of the sum
    settled = x[time > 1.0]
    assert np.ptp(settled) <= 1.0e-2 * CREEP


@pytest.mark.parametrize("share", [1.05, 1.5])
def test_slides_above_the_cone(share):
    """tan(angle) = share mu: a = g (sin - mu cos) within 2 %."""
    time, x = track(*incline(share), 1.0)
    angle = np.arctan(share * MU)
    acceleration = 2.0 * np.polyfit(time[time > 0.3], x[time > 0.3], 2)[0]
    assert acceleration == pytest.approx(GRAVITY * (np.sin(angle) - MU * np.cos(angle)), rel=0.02)


def test_without_memory_creeps_within_the_stick_velocity():
    """stick_ratio = 0: friction smoothed over the stick velocity holds the cube up to a creep below that velocity."""
    options = SolverReducedOptions(stick_ratio=0.0)
    time, x = track(*incline(0.9, options=options), 2.0)
    creep = (x[-1] - x[time > 1.0][0]) / 1.0
    assert 0.1 * options.stick_velocity < creep <= options.stick_velocity


def test_held_object_does_not_creep():
    """A cube held up by two fingers for ten seconds stays where they hold it, to 1e-4 m."""
    dt = 0.004
    scene, close, _ = grasp(5.0e5, dt)
    place = []
    for k in range(round(11.4 / dt / 2)):
        close(2 * k * dt)
        place.append(scene.centre() - [0.0, 0.0, scene.state.joint_q.numpy()[0]])
    held = np.array(place)[round(1.4 / dt / 2) :]
    assert scene.centre()[2] > 0.1
    assert np.ptp(held, axis=0).max() <= CREEP


def test_carried_on_a_free_body():
    """A cube lies on a rigid box that rests on the tilted ground of MuJoCo: neither moves, 1e-4 m in five seconds.

    MuJoCo's friction holds the box, which the joint solve does not know: only an anchor on the box itself keeps the
    error of its prediction from adding up.
    """
    body, angle = cube(), np.arctan(0.3 * MU)

    def populate(world):
        add_free_box(world, (0.1, 0.1, 0.02), 2.0, (0.0, 0.0, 0.02), friction=MU)
        material = Material(youngs_modulus=5.0e5, friction=MU)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.04 + 0.5 * EDGE))

    gravity = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    scene = Scene(populate, [body], coupled=True, gravity=gravity, ground=MU)
    replay, x = scene.capture(), []
    for _ in range(750):
        replay()
        x.append(scene.centre()[0] - scene.state.body_q.numpy()[0, 0])
    assert np.ptp(x[125:]) <= CREEP


# -- force and energy --------------------------------------------------------------------------------------------------


def test_force_stays_in_the_cone():
    """|f_t| <= mu f_n in every contact of every step, sticking and sliding; and it opposes the slip.

    The f_n of friction is that of the contact to rounding, but in the first two steps, which need nine and ten
    iterations: it is frozen after eight, and then off by 2.8e-4 of the weight.
    """
    scene, along = incline(1.5)
    seen = 0
    for _ in range(60):
        scene.step()
        entries = scene.reduced.view.constraints
        count = int(entries.count.numpy()[0])
        f, n = entries.force.numpy()[0, :count], entries.normal.numpy()[0, :count]
        normal = (f * n).sum(axis=1)
        tangential = np.linalg.norm(f - normal[:, None] * n, axis=1)
        lagged = entries.normal_force.numpy()[0, :count]
        assert (tangential <= MU * lagged * (1 + 1e-9)).all()
        frozen = scene.reduced.iteration.numpy()[0] > SolverReducedOptions().friction_lag
        np.testing.assert_allclose(lagged, normal, atol=(6e-4 if frozen else 1e-6) * scene.mass() * GRAVITY)
        assert (f @ along <= 1e-9).all()
        seen += int((normal > 0).sum())
    assert seen > 100


def mechanical_energy(scene, twin):
    """Return kinetic, elastic and potential energy of the soft body [J]."""
    height = scene.centre()[2]
    return scene.kinetic_energy() + twin.elastic_energy(scene.q()) + scene.mass() * GRAVITY * height


def test_bouncing_and_sliding_never_gains_energy():
    """Thrown onto the ground with slip and spin: kinetic + elastic + potential energy never exceeds the first."""
    body, material, dt = cube(), Material(youngs_modulus=2.0e5, friction=0.8), 0.002

    def populate(world):
        place = {"position": (0.0, 0.0, 0.1), "velocity": (1.0, 0.4, -1.5), "angular_velocity": (3.0, 8.0, -2.0)}
        add_reduced_body(world, body, material=material, **place)

    scene = Scene(populate, [body], gravity=DOWN, ground=0.8, dt=dt)
    twin = reference.FreeBody(body=body, material=reference.with_float32(material), dt=dt)
    first = mechanical_energy(scene, twin)
    touched = 0
    for _ in range(250):
        scene.step()
        touched += np.abs(scene.reduced.instance_force.numpy()).max() > 0
        assert mechanical_energy(scene, twin) <= (1.0 + 1e-4) * first
    assert touched > 20


@pytest.mark.parametrize("amplitude", [1.0e-5, 2.0e-3], ids=["sticks", "slides"])
def test_closed_cycles_dissipate(amplitude):
    """A floor that shakes sideways, u = a sin(omega t), and up and down: it never gets energy back over whole cycles.

    Work of the floor on the cube, sum F . (displacement of the floor in the step); with slip at least a tenth of the
    rigid-plastic 4 a mu m g per cycle.
    """
    body, mu, dt, period = cube(), 0.4, 0.002, 0.1
    material = Material(youngs_modulus=5.0e5, friction=mu, mass_damping=2.0)

    def populate(world):
        link = world.add_body(is_kinematic=True)
        world.add_shape_box(link, hx=1.0, hy=1.0, hz=0.1, cfg=ShapeConfig(density=0.0, mu=mu))
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.1 + 0.5 * EDGE))

    scene = Scene(populate, [body], gravity=DOWN, dt=dt)
    omega = 2.0 * np.pi / period

    def floor(t):
        return np.array([amplitude * np.sin(omega * t), 0.0, 0.2 * amplitude * np.sin(2.0 * omega * t)])

    def work(start, cycles):
        total = 0.0
        for k in range(round(cycles * period / dt)):
            t = (start * round(period / dt) + k) * dt
            u = floor(t + dt) - floor(t)
            pose, twist = scene.state.body_q.numpy(), scene.state.body_qd.numpy()
            pose[0, :3], twist[0, :3] = floor(t), u / dt
            scene.state.body_q.assign(pose)
            scene.state.body_qd.assign(twist)
            scene.step()
            total += scene.reduced.instance_force.numpy()[0] @ u
        return total

    work(0, 4)  # to a steady state
    spent = work(4, 4)
    rigid_plastic = 4 * 4.0 * amplitude * mu * scene.mass() * GRAVITY
    assert spent >= -1e-6 * rigid_plastic
    assert amplitude < 1e-4 or spent >= 0.1 * rigid_plastic


# -- the life of the memory --------------------------------------------------------------------------------------------


def memory(scene):
    """Return the shapes (S, 2) and points (S, 2, 3) that the samples remember."""
    return scene.state.softmode.stick_shape.numpy().copy(), scene.state.softmode.stick_point.numpy().copy()


def test_memory_ends_with_the_contact():
    """Samples in contact remember the shape; once the cube is lifted off, none does."""
    scene, _ = incline(0.5)
    assert (memory(scene)[0] == -1).all()
    scene.step(20)
    shapes, points = memory(scene)
    touching = shapes[:, 0] == 0
    assert 4 <= touching.sum() < len(shapes) and (shapes[:, 1] == -1).all()
    assert np.abs(points[touching, 0]).max() > 0.0
    scene.set(q=scene.q() + scene.body().affine(np.eye(3), (0.0, 0.0, 0.01)))
    scene.step(1)
    assert (memory(scene)[0] == -1).all()


def test_stick_is_the_return_map():
    """After a step in which everything slides, the memory is mu f_n / k_t long, along the slip."""
    scene, along = incline(1.5)
    scene.step(40)
    entries = scene.reduced.view.constraints
    count = int(entries.count.numpy()[0])
    f, k = entries.force.numpy()[0, :count], entries.stick.numpy()[0, :count]
    shapes, points = memory(scene)
    rows = entries.partner_row.numpy()[0, :count]
    held = (f**2).sum(axis=1) > 0.0
    world = points[rows, 0] @ rotation((0, 1, 0), np.arctan(1.5 * MU)).T
    n = entries.normal.numpy()[0, :count]
    tangential = f - (f * n).sum(axis=1)[:, None] * n
    np.testing.assert_allclose((k[:, None] * world)[held], -tangential[held], atol=1e-5 * np.abs(f).max())
    assert (world[held] @ along > 0.0).all() and (shapes[rows[held], 0] == 0).all()


def test_reset_forgets():
    """After reset the samples stick to nothing and the run repeats the first one bit for bit."""
    scene, _ = incline(0.9)
    scene.step(20)
    first = scene.q()
    scene.solver.reset(scene.state)
    assert (memory(scene)[0] == -1).all()
    scene.step(20)
    np.testing.assert_array_equal(scene.q(), first)


def test_reset_of_one_world_leaves_the_memory_of_the_other():
    """A masked reset clears the samples of its world only."""
    scene, _ = incline(0.9, world_count=2)
    scene.step(20)
    before = memory(scene)
    scene.solver.reset(scene.state, wp.array([True, False, False], dtype=bool, device="cpu"))
    shapes, points = memory(scene)
    half = len(shapes) // 2
    assert (before[0][:half, 0] >= 0).any() and (shapes[:half] == -1).all()
    np.testing.assert_array_equal(shapes[half:], before[0][half:])
    np.testing.assert_array_equal(points[half:], before[1][half:])


def test_captured_graph_equals_eager():
    """The memory lives in the state: replays of a graph give the bits of kernel-by-kernel launches."""
    captured, eager = incline(0.9)[0], incline(0.9)[0]
    replay = captured.capture()
    for _ in range(15):
        replay()
    eager.step(30)
    np.testing.assert_array_equal(captured.q(), eager.q())
    for one, other in zip(memory(captured), memory(eager), strict=True):
        np.testing.assert_array_equal(one, other)


def test_world_of_three_equals_single_world():
    """World i of 3, each pushed differently, equals the single world bit for bit, memory included."""
    batch = incline(0.9, world_count=3)[0]
    starts = []
    for i in range(3):
        qd = batch.qd(i)
        qd[0] = [0.1 * i, 0.05, -0.1]
        batch.set(qd=qd, instance=i)
        starts.append((batch.q(i), qd))
    batch.step(30)
    samples = len(batch.body().surface.points)
    for i, (q, qd) in enumerate(starts):
        alone = incline(0.9)[0]
        alone.set(q=q, qd=qd)
        alone.step(30)
        np.testing.assert_array_equal(batch.q(i), alone.q())
        points = memory(batch)[1].reshape(3, samples, 2, 3)[i]
        held = memory(alone)[0] >= 0
        np.testing.assert_array_equal(points[held], memory(alone)[1][held])


def test_memory_turns_with_its_shape():
    """A cube on a slowly turning, tilted table goes round with it: after a full turn it is where it was, to 1e-4 m."""
    body, dt, omega = cube(), 0.004, 2.0 * np.pi
    material = Material(youngs_modulus=5.0e5, friction=MU)
    start = np.array([0.05, 0.0, 0.1 + 0.5 * EDGE])

    def populate(world):
        link = world.add_body(is_kinematic=True)
        world.add_shape_box(link, hx=1.0, hy=1.0, hz=0.1, cfg=ShapeConfig(density=0.0, mu=MU))
        add_reduced_body(world, body, material=material, position=start, velocity=(0.0, 0.05 * omega, 0.0))

    gravity = GRAVITY * np.array([0.1, 0.0, -1.0])
    scene = Scene(populate, [body], gravity=gravity, dt=dt)
    place = []
    for k in range(2 * round(1.0 / dt)):
        angle = omega * k * dt
        R = rotation((0, 0, 1), omega * (k + 1) * dt)
        pose, twist = scene.state.body_q.numpy(), scene.state.body_qd.numpy()
        pose[0, 3:] = [0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)]
        twist[0, 5] = omega
        scene.state.body_q.assign(pose)
        scene.state.body_qd.assign(twist)
        scene.step()
        place.append(R.T @ scene.centre())
    turn = round(1.0 / dt)
    assert np.abs(place[-1] - place[turn - 1]).max() <= CREEP
