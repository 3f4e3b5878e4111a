"""Steps that follow a body's rotation: free spins and tumbles, rolling, impacts, what falls back, gradients."""

import numpy as np
import pytest

from softmode.deformables.gradients.adjoint import AdjointReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference
from tests.bodies import ball, bar, brick, cube, smooth_ball
from tests.scenes import GRAVITY, Scene, rotation

DT = 1.0 / 60.0
STIFF = Material(youngs_modulus=1.0e7, viscosity=0.0)
FLOAT32 = float(np.finfo(np.float32).eps)


def scene_of(body, *, spin, material=STIFF, dt=DT, options=None, **given):
    """Return a free body that spins."""

    def populate(world):
        add_reduced_body(world, body, material=material, angular_velocity=spin, **given)

    return Scene(populate, [body], dt=dt, options=options)


def energy(scene, material):
    """Return kinetic and elastic energy [J], and that of gravity where the model has any."""
    twin = reference.FreeBody(body=scene.body(), material=material, dt=scene.dt)
    weight = -scene.mass() * scene.model.gravity.numpy()[0] @ scene.centre()
    return scene.kinetic_energy() + twin.elastic_energy(scene.q()) + weight


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("body", [ball, bar], ids=["ball", "bar"])
def test_free_spin(body, axis):
    """10 rad/s at 60 Hz for a second: L as it was to 1e-7, energy within 1e-4 and never above its start."""
    spin = 10.0 * np.eye(3)[axis]
    scene = scene_of(body(), spin=tuple(spin))
    momentum, start = scene.momentum()[1], energy(scene, STIFF)
    found = []
    for _ in range(60):
        scene.step()
        found.append(energy(scene, STIFF) / start)
    assert np.linalg.norm(scene.momentum()[1] - momentum) <= 1e-7 * np.linalg.norm(momentum)
    assert 1.0 - 1e-4 <= min(found) and max(found) <= 1.0 + 1e-7
    assert not scene.reduced.status.numpy().any()


def test_intermediate_axis():
    """Spun about its intermediate axis a brick turns over and over; L keeps to 1e-7, energy to 1e-4 in 5 s at 60 Hz."""
    scene = scene_of(brick(), spin=(0.3, 8.0, 0.3))
    momentum, start = scene.momentum()[1], energy(scene, STIFF)
    along, energies = [], []
    for _ in range(300):
        scene.step()
        F = reference.FreeBody(body=brick(), material=STIFF, dt=DT).deformation_gradient(scene.q()).mean(axis=0)
        along.append(momentum @ F[:, 1] / np.linalg.norm(momentum))  # the body's own axis along L
        energies.append(energy(scene, STIFF) / start)
    assert np.linalg.norm(scene.momentum()[1] - momentum) <= 1e-7 * np.linalg.norm(momentum)
    assert min(along) < -0.9 and np.sum(np.diff(np.sign(along)) != 0) >= 2
    assert 1.0 - 1e-4 <= min(energies) and max(energies) <= 1.0


@pytest.mark.parametrize("modulus", [2.0e4, 1.0e6])
def test_step_is_its_twin(modulus):
    """Target, coordinates and velocity after a step from a deformed, moving state are those of `reference.Spin`."""
    options = SolverReducedOptions(tolerance=1e-9)
    body, material = brick(), Material(youngs_modulus=modulus, viscosity=0.01, mass_damping=2.0)
    scene = scene_of(body, spin=(0.0, 0.0, 0.0), material=material, options=options)
    rng = np.random.default_rng(0)
    q = body.affine(rotation([1.0, 2.0, 3.0], 0.7) @ np.diag([1.05, 0.98, 1.0]), (0.3, -0.1, 2.0))
    y = q + body.linear_coordinates[:, :3]
    qd = np.cross([3.0, -5.0, 4.0], y) + 0.01 * rng.normal(size=q.shape)
    scene.set(q=q, qd=qd)
    scene.step()
    twin = reference.FreeBody(body=body, material=reference.with_float32(material), dt=scene.dt)
    expected, velocity = twin.step(q, qd)
    assert scene.reduced.tables.spin.turns.numpy()[0] == 1
    size = np.linalg.norm([0.2, 0.12, 0.06])
    assert np.linalg.norm(scene.q() - expected) <= 1e-7 * size
    assert np.linalg.norm(scene.qd() - velocity) <= 1e-7 * size / scene.dt


def test_of_the_same_order():
    """With and without the turning target a spinning, pulsing soft cube goes the same way as dt falls, with order 1."""
    material = Material(youngs_modulus=2.0e4, viscosity=0.0)

    def path(keep, dt):
        options = SolverReducedOptions(keep_spin=keep, tolerance=1e-9)
        scene = scene_of(cube(), spin=(3.0, 12.0, 5.0), material=material, options=options, dt=dt)
        scene.set(q=scene.q() + cube().affine(np.diag([1.05, 0.97, 1.0])))
        moments = []
        for _ in range(8):
            scene.step(round(0.004 / dt))
            moments.append(scene.q())
        return np.array(moments)

    coarse, fine = (np.linalg.norm(path(True, dt) - path(False, dt)) for dt in (0.5e-3, 0.125e-3))
    assert fine < 0.3 * coarse  # first order: a quarter


@pytest.mark.parametrize(("modulus", "spin"), [(1e7, 70.0), (1e3, 30.0)])
def test_what_turns_too_fast_falls_back(modulus, spin):
    """Beyond 1 rad in a step, or 4 for rho L^2 omega^2 / E, a body takes the plain step, which only loses energy."""
    material = Material(youngs_modulus=modulus, viscosity=0.0)
    scene = scene_of(cube(), spin=(0.0, 0.2 * spin, spin), material=material)
    energies = [energy(scene, material)]
    scene.step()
    assert scene.reduced.tables.spin.turns.numpy()[0] == 0
    for _ in range(40):
        energies.append(energy(scene, material))
        scene.step()
    assert (np.diff(energies) <= 1e-6 * energies[0]).all()
    assert not scene.reduced.status.numpy().any()


@pytest.mark.parametrize(("modulus", "dt"), [(1e5, 1 / 60), (1e5, 1 / 240), (1e7, 1 / 240)])
def test_tumbling_bounce(modulus, dt):
    """A tumbling brick on the ground: energy never above its start; L changes by the moment of the contact forces.

    Both are about the centre of mass, at the places that the functions give the samples at the end of the step, in
    float32. Newton leaves a residual of 1e-8 of the forces.
    """
    material = Material(youngs_modulus=modulus, viscosity=0.0)
    options = SolverReducedOptions(force_tolerance=1e-8, friction_lag=100, iteration_max=100)

    def populate(world):
        turned = rotation([1.0, 2.0, -1.0], 0.8)
        motion = {"velocity": (0.5, 0.0, -2.0), "angular_velocity": (9.0, 5.0, 3.0)}
        add_reduced_body(world, brick(), material=material, position=(0.0, 0.0, 0.16), rotation=turned, **motion)

    scene = Scene(populate, [brick()], gravity=(0.0, 0.0, -GRAVITY), ground=0.5, dt=dt, options=options)
    start, constraints, pressed = energy(scene, material), scene.reduced.view.constraints, 0
    basis = scene.reduced.view.basis

    def spin():
        linear, angular = scene.momentum()
        return angular - np.cross(scene.centre(), linear)

    for _ in range(round(0.4 / dt)):
        before = spin()
        scene.step()
        count = int(constraints.count.numpy()[0])
        force = constraints.force.numpy()[0, :count]
        rows = constraints.row.numpy()[0, :count]  # forces act where the functions are, at centres of pressure
        values = basis.row.numpy().reshape(len(basis.row), -1)[rows, : brick().function_count]
        place = basis.row_point.numpy()[rows] + values @ scene.q()
        moment = np.cross(place - scene.centre(), force).sum(axis=0)
        total = np.linalg.norm(force, axis=1).sum() + scene.mass() * GRAVITY
        pressed += total > 3.0 * scene.mass() * GRAVITY
        assert np.linalg.norm(spin() - before - dt * moment) <= dt * total * (1e-8 + 4.0 * FLOAT32)
        assert energy(scene, material) <= start
    assert pressed > 2


def test_ball_rolls():
    """A ball of 1,500 samples rolls down 5 degrees with 5/7 g sin to 2 %, at 240 Hz."""
    slope = np.radians(5.0)

    def populate(world):
        material = Material(youngs_modulus=1.0e5, viscosity=0.0)
        add_reduced_body(world, smooth_ball(), material=material, position=(0.0, 0.0, 0.0499))

    gravity = (GRAVITY * np.sin(slope), 0.0, -GRAVITY * np.cos(slope))
    scene = Scene(populate, [smooth_ball()], gravity=gravity, ground=1.0, dt=1.0 / 240.0)
    scene.step(36)
    first = scene.momentum()[0][0]
    scene.step(132)
    found = (scene.momentum()[0][0] - first) / scene.mass() / (132 * scene.dt)
    assert found == pytest.approx(5.0 / 7.0 * GRAVITY * np.sin(slope), rel=0.02)


def test_worlds_and_graph():
    """World i of three that turn each another way is the single world, to the bit, in a captured graph too."""
    options = SolverReducedOptions()

    def scene(worlds):
        def populate(world):
            add_reduced_body(world, cube(), material=Material(), position=(0.0, 0.0, 0.12))

        return Scene(populate, [cube()], gravity=(0.0, 0.0, -GRAVITY), ground=0.5, options=options, world_count=worlds)

    y = cube().linear_coordinates[:, :3]
    ways = [np.cross(spin, y) for spin in ([9.0, 5.0, 3.0], [0.0, 20.0, 1.0], [1.0, -2.0, 0.5])]
    many, again = scene(3), scene(3)
    replay = again.capture()
    for i, qd in enumerate(ways):
        many.set(qd=qd, instance=i)
        again.set(qd=qd, instance=i)
    many.step(20)
    for _ in range(10):
        replay()
    for i, qd in enumerate(ways):
        alone = scene(1)
        alone.set(qd=qd)
        alone.step(20)
        np.testing.assert_array_equal(many.q(i), alone.q())
        np.testing.assert_array_equal(again.q(i), alone.q())


def test_gradients_of_a_tumble():
    """dL/dq_0 and dL/dv_0 of a brick that tumbles and pulses freely, against five-point differences: 1e-7."""
    options = SolverReducedOptions(tolerance=1e-13, force_tolerance=1e-12, iteration_max=100)
    material = Material(youngs_modulus=3.0e4, viscosity=0.003, mass_damping=0.3)
    scene = scene_of(brick(), spin=(4.0, -7.0, 5.0), material=material, options=options)
    adjoint = AdjointReduced(scene.reduced, 6)
    rng = np.random.default_rng(1)
    q, qd = scene.q(), scene.qd() + 0.02 * rng.normal(size=scene.q().shape)
    path = {"q": 0.01 * rng.normal(size=q.shape), "qd": 0.1 * rng.normal(size=q.shape)}
    weight = rng.normal(size=(2, 7, *q.shape))

    def loss(**change):
        scene.set(q=q + change.get("q", 0.0) * path["q"], qd=qd + change.get("qd", 0.0) * path["qd"])
        scene.state.softmode.dt_before.zero_()
        adjoint.start(scene.state)
        for _ in range(6):
            adjoint.step(scene.state, scene.next_state, scene.control, scene.dt)
            scene.state, scene.next_state = scene.next_state, scene.state
        assert scene.reduced.tables.spin.turns.numpy()[0] == 1
        return float((weight[0] * adjoint.q.numpy()).sum() + 0.05 * (weight[1] * adjoint.qd.numpy()).sum())

    loss()
    found = adjoint.backward(loss_q=weight[0], loss_qd=0.05 * weight[1]).numpy()
    for name in ("q", "qd"):
        a, b = (loss(**{name: s * 1e-3}) - loss(**{name: -s * 1e-3}) for s in (1.0, 2.0))
        expected = (8.0 * a - b) / 12.0e-3
        assert (found[name] * path[name]).sum() == pytest.approx(expected, rel=1e-7)
