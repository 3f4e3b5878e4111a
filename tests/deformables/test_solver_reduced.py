"""The reduced step of bodies without contact: identities, order, closed forms, a dense reference, batching, errors."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.model.lane_kernels import from_blocks, to_blocks
from softmode.deformables.model.velocities import set_velocity
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import ball, bar, cube
from tests.marks import rest_but
from tests.scenes import GRAVITY, Scene, random_rotation, rotation

FLOAT32 = float(np.finfo(np.float32).eps)
FLOAT64 = float(np.finfo(np.float64).eps)
EDGE = 0.1
SIZE = EDGE * np.sqrt(3.0)
DOWN = (0.0, 0.0, -GRAVITY)
FINE = SolverReducedOptions(tolerance=1.0e-8, iteration_max=50)
"""Solved so far that only the rounding of the model's data remains."""
G32 = float(np.float32(GRAVITY))
"""Gravity as a Newton model stores it."""


def single(material=None, *, body=None, position=(0, 0, 0), rotation=None, velocity=(0, 0, 0), spin=(0, 0, 0), **kw):
    """Return a scene with one free cube."""
    body = body or cube()

    def populate(world):
        add_reduced_body(
            world,
            body,
            material=material,
            position=position,
            rotation=rotation,
            velocity=velocity,
            angular_velocity=spin,
        )

    return Scene(populate, [body], **kw)


def deformed(body, amplitude=0.01, seed=0):
    """Return coordinates of a moderate random deformation (amplitude in units of the size)."""
    q = np.random.default_rng(seed).normal(size=(body.function_count, 3))
    return amplitude * SIZE * q / np.linalg.norm(q)


def evaluate_at(scene, q):
    """Return elastic energy [J] and gradient of the incremental potential [N] of the first instance at q."""
    solver = scene.reduced
    scene.set(q=q, qd=np.zeros_like(q))
    solver.begin(scene.state, scene.control, scene.dt)
    solver.detect(scene.state, scene.control, scene.dt, prescribed=True)
    solver.tables.newton.active.fill_(1)
    evaluate(solver.tables, scene.dt, derivatives=True)
    gather_gradient(solver.tables, scene.dt)
    assemble(solver.tables, scene.dt)
    return solver.view.points.energy.numpy()[0].sum(), from_blocks(solver.tables.arrays.gradient.numpy()[0], len(q))


# -- identities --------------------------------------------------------------------------------------------------------


def test_affine_closure():
    """The coordinates affine(A, t) move every surface sample to A X + t, and F = A at every cubature point."""
    scene, body = single(), cube()
    rng = np.random.default_rng(0)
    twin = reference.FreeBody(body=body, material=Material(), dt=scene.dt)
    for _ in range(10):
        A, t = np.eye(3) + 0.5 * rng.normal(size=(3, 3)), rng.normal(size=3)
        q = body.affine(A, t)
        scene.set(q=q)
        expected = body.surface.points @ A.T + t
        # Basis values and positions are float32.
        np.testing.assert_allclose(scene.state.particle_q.numpy(), expected, atol=8 * FLOAT32 * (1.0 + np.abs(t).max()))
        np.testing.assert_allclose(twin.deformation_gradient(q), np.broadcast_to(A, (128, 3, 3)), atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 5.0, 100.0])
def test_rigid_motion_costs_no_energy(offset):
    """U(R X + t) <= 1e-7 E V and |dU/dq| <= 2e-5 E A: the float32 gradients do not see the offset."""
    material, body = Material(youngs_modulus=1.0e5), cube()
    scene = single(material)
    rng = np.random.default_rng(1)
    for _ in range(10):
        q = body.affine(random_rotation(rng), offset * rng.normal(size=3))
        energy, gradient = evaluate_at(scene, q)
        assert abs(energy) <= 1e-7 * material.youngs_modulus * body.volume
        assert np.abs(gradient).max() <= 2e-5 * material.youngs_modulus * EDGE**2


@pytest.mark.parametrize("offset", [0.0, 5.0, 100.0])
def test_no_drift_at_rest(offset):
    """An unloaded body, turned and far from the origin, stays where it is for 300 steps, to 1e-6 of its size."""
    R = rotation((1, 2, 3), 0.7)
    scene = single(position=(offset, -offset, offset), rotation=R)
    q = scene.q()
    scene.step(300)
    assert np.abs(scene.q() - q).max() <= 1e-6 * SIZE
    assert np.abs(scene.qd()).max() <= 1e-6 * SIZE / scene.dt


@pytest.mark.parametrize("viscosity", [0.0, 0.01])
def test_step_equals_dense_reference(viscosity):
    """One step from a deformed, moving state under gravity equals the dense float64 step to the solver's tolerance.

    Newton stops once it moves less than the tolerance; where it converges linearly (a projected or Gauss-Newton part
    acts), what is left is a multiple of that.
    """
    body = cube()
    material = Material(youngs_modulus=1.0e5, viscosity=viscosity, mass_damping=2.0)
    scene = single(material, gravity=DOWN, options=FINE)
    gravity = (0.0, 0.0, -G32)
    stored = reference.with_float32(material)
    twin = reference.FreeBody(body=body, material=stored, dt=scene.dt, gravity=gravity)
    rng = np.random.default_rng(2)
    q, qd = deformed(body), rng.normal(size=(body.function_count, 3)) * 0.1
    scene.set(q=q, qd=qd)
    scene.step()
    expected, velocity = twin.step(q, qd)
    tolerance = 10 * FINE.tolerance * SIZE
    assert np.linalg.norm(scene.q() - expected) <= tolerance
    assert np.linalg.norm(scene.qd() - velocity) <= tolerance / scene.dt
    assert scene.reduced.status.numpy()[0] == 0


def test_material_models_differ_in_the_solver():
    """Each instance is stepped with its own energy density."""
    ends = []
    for model in (MaterialModel.STABLE_NEO_HOOKEAN_LOG, MaterialModel.STABLE_NEO_HOOKEAN):
        scene = single(Material(model=model), options=FINE)
        scene.set(q=deformed(cube(), 0.05))
        scene.step()
        ends.append(scene.q())
        material = reference.with_float32(Material(model=model))
        twin = reference.FreeBody(body=cube(), material=material, dt=scene.dt)
        expected, _ = twin.step(deformed(cube(), 0.05), np.zeros_like(ends[0]))
        assert np.linalg.norm(ends[-1] - expected) <= 10 * FINE.tolerance * SIZE
    assert np.linalg.norm(ends[0] - ends[1]) > 1e-4 * SIZE


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.02])
def test_free_fall(dt):
    """Implicit Euler falls z_N = z_0 - g dt^2 N (N + 1) / 2, to 1e-9."""
    count = 50
    scene = single(position=(0.3, 0.2, 1.0), gravity=DOWN, dt=dt)
    start = scene.centre()
    scene.step(count)
    expected = -G32 * dt**2 * count * (count + 1) / 2
    moved = scene.centre() - start
    assert moved[2] == pytest.approx(expected, rel=1e-9)
    assert np.abs(moved[:2]).max() <= 1e-9 * abs(expected)
    assert scene.momentum()[0][2] == pytest.approx(-scene.mass() * G32 * dt * count, rel=1e-9)


def test_constant_velocity():
    """Without forces the centre moves by v t and the shape stays, to 1e-9."""
    v = np.array([1.0, -2.0, 0.5])
    scene = single(rotation=rotation((0, 1, 1), 0.4), velocity=v)
    start = scene.q()
    scene.step(50)
    moved = scene.q() - start
    np.testing.assert_allclose(moved[0], 50 * scene.dt * v, rtol=1e-9)
    assert np.abs(moved[1:]).max() <= 1e-9 * SIZE


def spin_left(omega, dt, time):
    """Return the share of angular momentum a rigid body keeps under implicit Euler.

    The unknowns are the coordinates themselves, so a step takes 2 R_n - R_(n-1), rotated by 2 - e^(-i theta), to the
    nearest rotation: theta_(n+1) = atan2(sin theta_n, 2 - cos theta_n), theta_1 = atan(omega dt), L ~ sin(theta) / dt.
    """
    theta = np.arctan(omega * dt)
    for _ in range(round(time / dt) - 1):
        theta = np.arctan2(np.sin(theta), 2.0 - np.cos(theta))
    return np.sin(theta) / (omega * dt)


@pytest.mark.parametrize("omega", [1.0, 5.0, 10.0, 30.0])
def test_free_spin_loses_what_implicit_euler_loses(omega):
    """Flying straight, a stiff cube spun for 1 s at dt = 1/60 keeps 0.984, 0.740, 0.481, 0.180: as in `spin_left`."""
    dt = 1.0 / 60.0
    options = dataclasses.replace(FINE, keep_spin=False)
    scene = single(Material(youngs_modulus=1.0e7), spin=(0.0, 0.0, omega), dt=dt, options=options)
    before = scene.momentum()[1][2]
    scene.step(60)
    kept = scene.momentum()[1][2] / before
    # A body of finite stiffness widens by rho omega^2 L^2 / E and swings about that.
    widening = 300.0 * omega**2 * EDGE**2 / 1.0e7
    # Each of the 60 steps is solved to the tolerance, of the motion omega dt SIZE.
    solve = 60 * 1e-2 * scene.reduced.options.tolerance / (omega * dt)
    assert kept == pytest.approx(spin_left(omega, dt, 1.0), abs=widening + solve)


def test_spin_loss_is_of_first_order():
    """Flying straight, the loss of spin halves with dt: slope of log loss over log dt within 0.1 of 1."""
    steps = np.array([0.004, 0.002, 0.001])
    losses = []
    for dt in steps:
        options = SolverReducedOptions(keep_spin=False)
        scene = single(Material(youngs_modulus=1.0e6), spin=(0.0, 0.0, 5.0), dt=dt, options=options)
        before = scene.momentum()[1][2]
        scene.step(round(0.1 / dt))
        losses.append(1.0 - scene.momentum()[1][2] / before)
    slopes = np.diff(np.log(losses)) / np.diff(np.log(steps))
    assert (np.abs(slopes - 1.0) <= 0.1).all()


def test_mass_damping():
    """Translation decays as v_N = v_0 / (1 + alpha dt)^N."""
    alpha = 3.0
    scene = single(Material(mass_damping=alpha), velocity=(1.0, 0.0, 0.0))
    scene.step(40)
    assert scene.qd()[0, 0] == pytest.approx((1.0 + alpha * scene.dt) ** -40, rel=1e-9)


def test_viscosity_dissipates():
    """A stretched cube let go keeps less energy after 20 ms with a relaxation time of 2 ms than without, by half."""
    energies = []
    for viscosity in (0.0, 0.002):
        material = Material(viscosity=viscosity)
        scene = single(material, dt=0.00025)
        twin = reference.FreeBody(body=cube(), material=material, dt=scene.dt)
        scene.set(q=cube().affine(np.diag([1.05, 1.0, 1.0])))
        scene.step(80)
        energies.append(scene.kinetic_energy() + twin.elastic_energy(scene.q()))
    assert energies[1] < 0.5 * energies[0]


def test_inner_forces_have_no_resultant():
    """Elastic and viscous forces sum to zero and have no moment: sum_k b_k(0) f_k = 0, sum_k y_k cross f_k = 0."""
    body = cube()
    scene = single(Material(viscosity=0.05))
    solver, n = scene.reduced, body.function_count
    start, q = deformed(body, 0.01), deformed(body, 0.02, seed=1)
    evaluate_at(scene, start)  # sets q_n
    solver.tables.arrays.q.assign(to_blocks(q[None], solver.view.layout.block_count))
    evaluate(solver.tables, scene.dt, derivatives=True)
    gather_gradient(solver.tables, scene.dt)
    assemble(solver.tables, scene.dt)
    inertia = scene.mass() / scene.dt**2 * (q - start)
    forces = from_blocks(solver.tables.arrays.gradient.numpy()[0], n) - inertia
    size = np.abs(forces).max()
    assert np.abs(body.mean_basis @ forces).max() <= 1e-6 * size  # gradients of a constant, float32
    y = q + body.linear_coordinates[:, :3]
    # The linear functions reproduce X to float32, and F from them I to float32.
    assert np.abs(np.cross(y, forces).sum(axis=0)).max() <= 1e-6 * size * np.abs(y).sum()


def test_viscosity_leaves_a_free_spin_alone():
    """A rotating body does not deform, so 2 mu tau dE/dt = 0: with and without viscosity it spins alike."""
    ends = []
    for viscosity in (0.0, 0.05):
        material = Material(youngs_modulus=1.0e7, viscosity=viscosity)
        scene = single(material, spin=(0.0, 0.0, 5.0), dt=0.01, options=FINE)
        scene.step(30)
        ends.append(scene.momentum()[1][2])
    widening = 300.0 * 25.0 * EDGE**2 / 1.0e7
    assert ends[1] == pytest.approx(ends[0], rel=2 * widening + 30 * 1e-2 * FINE.tolerance / (5.0 * 0.01))


def test_energy_never_rises():
    """Implicit Euler of a passive body: kinetic + elastic energy does not grow, to 1e-6 of the first."""
    material = Material(viscosity=0.0)
    scene = single(material, spin=(3.0, 2.0, 1.0), dt=0.002)
    twin = reference.FreeBody(body=cube(), material=material, dt=scene.dt)
    scene.set(q=scene.q() + deformed(cube(), 0.02))
    energies = []
    for _ in range(100):
        energies.append(scene.kinetic_energy() + twin.elastic_energy(scene.q()))
        scene.step()
    assert (np.diff(energies) <= 1e-6 * energies[0]).all()
    assert energies[-1] < 0.9 * energies[0]


# -- pins and point forces ---------------------------------------------------------------------------------------------


def pinned_bar(dt, **kw):
    """Return a bar, one end face held by springs, under gravity, and its dense twin."""
    body = bar()
    material = Material(youngs_modulus=2.0e5, poissons_ratio=0.3, mass_damping=8.0, viscosity=0.01)
    y, z = np.meshgrid(*[np.linspace(-0.05, 0.05, 4)] * 2)
    points = np.column_stack([np.full(16, -0.2), y.ravel(), z.ravel()])

    def populate(world):
        add_pins(world, add_reduced_body(world, body, material=material), points, stiffness=500.0)

    scene = Scene(populate, [body], gravity=DOWN, dt=dt, **kw)
    twin = reference.FreeBody(
        body=body,
        material=reference.with_float32(material),
        dt=dt,
        gravity=(0.0, 0.0, -G32),
        pin_points=points,
        pin_stiffness=500.0,
    )
    return scene, twin


def tip(scene_or_q):
    """Return the sag of the middle of the free end [m]."""
    q = scene_or_q.q() if isinstance(scene_or_q, Scene) else scene_or_q
    return float(bar().evaluate([[0.2, 0.0, 0.0]])[0][0] @ q[:, 2])


def test_static_tip_of_a_pinned_bar():
    """At rest the inertia is gone: the tip sags as far as the dense equilibrium, whatever dt, to 1e-4."""
    for dt in (0.02, 0.01):
        scene, twin = pinned_bar(dt)
        expected = tip(twin.equilibrium())
        assert expected < -0.01  # a sag worth the name
        scene.step(round(2.5 / dt))
        assert tip(scene) == pytest.approx(expected, rel=1e-4)


def test_moving_tip_converges_in_dt():
    """The tip at t = 0.08 s approaches its limit with first order: successive differences halve, within a quarter."""
    tips = []
    for dt in (0.008, 0.004, 0.002, 0.001):
        scene, _ = pinned_bar(dt)
        scene.step(round(0.08 / dt))
        tips.append(tip(scene))
    ratios = np.diff(tips)[:-1] / np.diff(tips)[1:]
    assert (np.abs(ratios - 2.0) <= 0.5).all()


def test_pins_follow_their_targets():
    """Equal springs of total stiffness K carry a body: at rest its centre hangs m g / K below the mean target."""
    body, stiffness = cube(), 40.0
    material = Material(youngs_modulus=1.0e6, mass_damping=20.0)
    corners = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

    def populate(world):
        add_pins(world, add_reduced_body(world, body, material=material), corners, stiffness=stiffness)

    scene = Scene(populate, [body], gravity=DOWN, dt=0.01)
    shift = np.array([0.1, -0.05, 0.2])
    scene.control.softmode.pin_target.assign(corners + shift)
    scene.step(300)
    sag = scene.mass() * G32 / (8 * stiffness)
    # The cube strains by m g / (E L^2), which shifts the mean of its corners by less than m g / (E L).
    deformation = scene.mass() * GRAVITY / (material.youngs_modulus * EDGE)
    np.testing.assert_allclose(scene.centre(), shift - [0, 0, sag], atol=deformation + 1e-5 * SIZE)


def test_point_forces_act_in_full():
    """particle_f at surface samples gives the body sum f of linear and sum x cross f of angular momentum per time."""
    scene = single(position=(0.5, 0.0, 0.0), dt=0.001)
    rng = np.random.default_rng(7)
    f = rng.normal(size=(scene.body().surface_count, 3)).astype(np.float32)
    x = scene.state.particle_q.numpy().astype(float)
    scene.state.particle_f.assign(f)
    scene.step()
    linear, angular = scene.momentum()
    np.testing.assert_allclose(linear, scene.dt * f.sum(axis=0, dtype=float), rtol=1e-6)
    # y_n cross qd_(n+1) = y_(n+1) cross qd_(n+1); the elastic forces act at the end of the step and so turn by O(dt^2)
    speed = np.abs(scene.qd()).max()
    slack = scene.dt * np.abs(f).sum() * scene.dt * speed
    np.testing.assert_allclose(angular, scene.dt * np.cross(x, f).sum(axis=0), rtol=1e-5, atol=slack)
    before = scene.momentum()[0]
    scene.step()  # the force was taken off the state: no more than the momentum it gave
    np.testing.assert_allclose(scene.momentum()[0], before, rtol=1e-7)


# -- robustness --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["flat", "mirrored"])
def test_flat_and_mirrored_bodies_recover(start):
    """J = 0 or -1 along one axis, with 1e-3 of noise: back to F a rotation, |F^T F - I| small, after 4 s.

    With 8 functions. With 20 a mirrored cube ends inside out, J > 0 everywhere, for 2 to 5 of 16 seeds of the noise.
    """
    body = cube(mode_count=1)
    A = np.diag([1.0, 1.0, 0.0 if start == "flat" else -1.0])
    noise = 1e-3 * SIZE * np.random.default_rng(0).normal(size=(body.function_count, 3))
    scene = single(Material(mass_damping=4.0), body=body, dt=0.01)
    twin = reference.FreeBody(body=body, material=Material(), dt=0.01)
    scene.set(q=body.affine(A) + noise)
    scene.step(400)
    F = twin.deformation_gradient(scene.q())
    np.testing.assert_allclose(np.linalg.det(F), 1.0, atol=1e-2)
    np.testing.assert_allclose(np.swapaxes(F, 1, 2) @ F, np.broadcast_to(np.eye(3), F.shape), atol=1e-2)


@pytest.mark.parametrize(("edge", "omega"), rest_but([(0.01, 10.0)], [(0.03, 2.0), (0.01, 10.0)]))
def test_small_stiff_bodies_spin(edge, omega):
    """A cube far stiffer than a step resolves keeps its spin to 1e-7, mostly in an iteration a step, without a flag.

    Rounding is as large as what is left to do: some steps look for more in ten iterations, other ones on other bodies.
    """
    scene = single(Material(youngs_modulus=1.0e9), body=cube(edge), spin=(0.0, 0.0, omega), dt=1.0 / 60.0)
    before = scene.momentum()[1][2]
    iterations = []
    for _ in range(15):
        scene.step()
        iterations.append(scene.reduced.iteration.numpy()[0])
    assert np.median(iterations) == 1
    assert scene.momentum()[1][2] == pytest.approx(before, rel=1e-7)
    assert not scene.reduced.status.numpy().any()


@pytest.mark.parametrize("omega", [1.0, 5.0])
def test_no_false_alarm(omega):
    """A body that simply spins converges in every step: no status bit is raised."""
    scene = single(Material(youngs_modulus=1.0e7), spin=(0.0, 0.0, omega), dt=1.0 / 60.0)
    seen = 0
    for _ in range(60):
        scene.step()
        seen |= int(scene.reduced.status.numpy()[0])
    assert seen == 0


# -- worlds, graphs, changes -------------------------------------------------------------------------------------------


def scatter(scene, seed=0):
    """Give every instance a state of its own; return (q, qd) of all."""
    rng = np.random.default_rng(seed)
    states = []
    for i in range(scene.reduced.instance_count):
        q = scene.q(i) + deformed(scene.body(i), 0.02, seed=seed + i)
        qd = 0.2 * rng.normal(size=q.shape)
        scene.set(q=q, qd=qd, instance=i)
        states.append((q, qd))
    return states


def test_world_of_three_equals_single_world():
    """World i of 3, each in a state of its own, equals the single world in that state, bit for bit."""
    batch = single(gravity=DOWN, world_count=3)
    states = scatter(batch)
    batch.step(10)
    alone = single(gravity=DOWN)
    for i, (q, qd) in enumerate(states):
        alone.restart()
        alone.set(q=q, qd=qd)
        alone.step(10)
        np.testing.assert_array_equal(batch.q(i), alone.q())
        np.testing.assert_array_equal(batch.qd(i), alone.qd())


def test_captured_graph_equals_eager():
    """A recorded graph, replayed, gives the bits of kernel-by-kernel launches."""
    scene = single(gravity=DOWN, world_count=2)
    replay = scene.capture()
    scatter(scene)
    for _ in range(5):
        replay()
    q, qd = scene.state.softmode.q.numpy().copy(), scene.state.softmode.qd.numpy().copy()
    scene.restart()
    scatter(scene)
    scene.step(10)
    np.testing.assert_array_equal(scene.state.softmode.q.numpy(), q)
    np.testing.assert_array_equal(scene.state.softmode.qd.numpy(), qd)


def test_bodies_with_different_function_counts():
    """Two bodies of one world that do not touch move as each does alone."""
    bodies = [cube(), ball(), bar()]
    assert len({body.function_count for body in bodies}) == 3

    def populate(world):
        for i, body in enumerate(bodies):
            add_reduced_body(world, body, position=(0.5 * i, 0.0, 0.0))

    both = Scene(populate, bodies[::-1], gravity=DOWN)
    states = scatter(both)
    both.step(5)
    for i, (q, qd) in enumerate(states):
        alone = single(body=bodies[i], gravity=DOWN)
        alone.set(q=q, qd=qd)
        alone.step(5)
        # Not bitwise: one line search and one stopping test serve all bodies of a world.
        assert np.linalg.norm(both.q(i) - alone.q()) <= 5 * both.reduced.view.instances.tolerance.numpy()[i]


def test_masked_reset():
    """A reset puts the chosen world back to its initial pose and velocity and leaves the others, bit for bit."""
    scene = single(velocity=(0.0, 1.0, 0.0), gravity=DOWN, world_count=3)
    first = scene.q(1), scene.qd(1)
    scatter(scene)
    scene.step(3)
    others = [(scene.q(i), scene.qd(i)) for i in (0, 2)]
    particles = scene.state.particle_q.numpy().reshape(3, -1, 3).copy()
    scene.solver.reset(scene.state, wp.array([False, True, False, False], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(scene.q(1), first[0])
    np.testing.assert_array_equal(scene.qd(1), first[1])
    for i, (q, qd) in zip((0, 2), others, strict=True):
        np.testing.assert_array_equal(scene.q(i), q)
        np.testing.assert_array_equal(scene.qd(i), qd)
    after = scene.state.particle_q.numpy().reshape(3, -1, 3)
    np.testing.assert_array_equal(after[[0, 2]], particles[[0, 2]])
    np.testing.assert_allclose(after[1], cube().surface.points, atol=4 * FLOAT32 * SIZE)


def test_parameters_change_at_run_time():
    """A model whose E, density and viscosity are changed after the build steps as one built with them, bit for bit."""
    changes = {"youngs_modulus": 3.0e5, "density": 700.0, "viscosity": 0.02, "poissons_ratio": 0.2, "mass_damping": 1.0}
    built, changed = single(Material(**changes), gravity=DOWN), single(Material(), gravity=DOWN)
    for name, value in changes.items():
        changed.set_parameter(name, value)
    for scene in (built, changed):
        scatter(scene)
        scene.step(5)
    np.testing.assert_array_equal(built.q(), changed.q())


@pytest.mark.parametrize("array", ["q", "qd"])
def test_not_a_number_stays_in_its_world(array):
    """NaN put into one world is flagged there; the other worlds keep their bits and stay unflagged."""
    clean, dirty = (single(gravity=DOWN, world_count=3) for _ in range(2))
    for scene in (clean, dirty):
        scatter(scene)
    value = getattr(dirty, array)(1)
    value[2, 1] = np.nan
    dirty.set(**{array: value}, instance=1)
    for _ in range(3):
        for scene in (clean, dirty):
            scene.step()
        if _ == 0:
            assert dirty.reduced.status.numpy()[1] & bits.WORLD_NOT_FINITE
        assert (dirty.reduced.status.numpy()[[0, 2]] == clean.reduced.status.numpy()[[0, 2]]).all()
        for i in (0, 2):
            np.testing.assert_array_equal(dirty.q(i), clean.q(i))
            np.testing.assert_array_equal(dirty.qd(i), clean.qd(i))
    if array == "qd":  # the pose was sound: the world stands still at it
        assert np.isfinite(dirty.q(1)).all()


# -- velocities --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_a_velocity_field_that_is_affine_is_one_exactly(scale):
    """A rigid motion as a field over rest points is the same velocity; momentum and energy are the closed form.

    Of a field A X + v: momentum m v, energy m/2 (v^2 + tr(A J A^T) / m) with J the second moments of the mass.
    """
    body, R, material = cube(), rotation((1, 2, 3), 0.7), Material()
    v, omega = np.array([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 0.5])
    A = np.random.default_rng(0).normal(size=(3, 3))

    def scene(**given):
        def populate(world):
            add_reduced_body(world, body, rotation=R, position=(0.1, 0.2, 0.3), scale=scale, **given)

        return Scene(populate, [body])

    rigid = scene(velocity=v, angular_velocity=omega)
    field = scene(velocity_field=lambda X: v + np.cross(omega, X @ R.T))
    np.testing.assert_allclose(field.qd(), rigid.qd(), atol=1e-12)
    particles = [s.state.particle_qd.numpy() for s in (field, rigid)]
    np.testing.assert_allclose(*particles, atol=4 * FLOAT32 * np.abs(particles[1]).max())
    sheared = scene(velocity=v, velocity_field=lambda X: X @ A.T)
    mass, linear = material.density * scale**3 * body.volume, body.linear_coordinates
    J = mass * scale**2 * linear[:, :3].T @ linear[:, :3]  # the functions are orthonormal in mass
    np.testing.assert_allclose(sheared.momentum()[0], mass * v, rtol=1e-6)
    np.testing.assert_allclose(sheared.kinetic_energy(), 0.5 * (mass * v @ v + np.trace(A @ J @ A.T)), rtol=1e-6)


def test_set_velocity_turns_a_deformed_body_about_its_centre():
    """Momentum m v, spin I omega of the deformed body, exactly; in free flight it goes on from there."""
    scene = single(world_count=2)
    scatter(scene)
    other = scene.qd(1)
    v, omega = np.array([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 0.5])
    set_velocity(scene.model, scene.state, 0, cube(), velocity=v, angular_velocity=omega)
    y, centre = scene.q(0) + cube().linear_coordinates[:, :3], scene.centre(0)
    moments = scene.mass() * (y.T @ y - np.outer(centre, centre))  # int rho (x - c)(x - c)^T
    p, L = scene.momentum()
    np.testing.assert_allclose(p, scene.mass() * v, rtol=1e-12)
    spin = (np.trace(moments) * np.eye(3) - moments) @ omega
    np.testing.assert_allclose(L - np.cross(centre, p), spin, atol=1e-12 * np.abs(spin).max())
    energy = 0.5 * (scene.mass() * v @ v + omega @ spin)
    np.testing.assert_allclose(scene.kinetic_energy(), energy, rtol=1e-12)
    np.testing.assert_array_equal(scene.qd(1), other)
    moved = cube().surface.basis @ scene.qd(0)
    found = scene.state.particle_qd.numpy()[: cube().surface_count]
    np.testing.assert_allclose(found, moved, atol=4 * FLOAT32 * np.abs(moved).max())
    squeezed = lambda X: -0.1 * X  # noqa: E731
    set_velocity(scene.model, scene.state, 0, cube(), velocity=v, velocity_field=squeezed)
    np.testing.assert_allclose(scene.qd(0), cube().affine(0.9 * np.eye(3), v), atol=1e-12)
    scene.step(3)
    np.testing.assert_allclose(scene.momentum()[0], scene.mass() * v, rtol=1e-9)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"instance": 1}, "1 soft bodies, got 1"),
        ({"body": bar}, "instance 0 is not of body 'bar'"),
        ({"velocity": (0.0, np.nan, 0.0)}, "velocity must be three finite"),
        ({"angular_velocity": (0.0, 0.0)}, "angular_velocity must be three finite"),
        ({"velocity_field": lambda X: X[0]}, "field: expected finite vectors"),
    ],
    ids=["instance", "body", "velocity", "angular_velocity", "velocity_field"],
)
def test_bad_velocities(changes, match):
    """What set_velocity cannot take is refused by name."""
    scene = single()
    arguments = {"model": scene.model, "state": scene.state, "instance": 0, "body": cube} | changes
    arguments["body"] = arguments["body"]()
    with pytest.raises(ConfigError, match=match):
        set_velocity(**arguments)


# -- errors ------------------------------------------------------------------------------------------------------------


def builder_with_cube():
    """Return a builder that holds one cube."""
    builder = newton.ModelBuilder()
    add_reduced_body(builder, cube())
    return builder


@pytest.mark.parametrize(
    "arguments",
    [
        {"rotation": np.ones((3, 3))},
        {"rotation": np.diag([1.0, 1.0, -1.0])},
        {"rotation": np.eye(2)},
        {"rotation": np.full((3, 3), np.nan)},
        {"position": (0.0, np.nan, 0.0)},
        {"position": (0.0, 0.0)},
        {"velocity": (np.nan, 0.0, 0.0)},
        {"angular_velocity": (np.inf, 0.0, 0.0)},
        {"contact_stiffness_per_area": -1.0},
        {"contact_stiffness_per_area": np.inf},
    ],
    ids=str,
)
def test_bad_pose(arguments):
    """A rotation that is none, or a number that is not finite, is refused by name."""
    with pytest.raises(ConfigError, match=next(iter(arguments))):
        add_reduced_body(newton.ModelBuilder(), cube(), **arguments)


@pytest.mark.parametrize(
    ("points", "options"),
    [
        (np.zeros((0, 3)), {"stiffness": 1.0}),
        (np.zeros((2, 2)), {"stiffness": 1.0}),
        (np.zeros((2, 3)), {"stiffness": -1.0}),
        (np.zeros((2, 3)), {"stiffness": np.nan}),
        (np.zeros((2, 3)), {"stiffness": 1.0, "targets": np.zeros((3, 3))}),
        (np.full((2, 3), np.nan), {"stiffness": 1.0}),
    ],
    ids=["empty", "flat", "negative", "nan", "targets", "nan point"],
)
def test_bad_pins(points, options):
    """Pins need points, matching shapes and stiffness >= 0."""
    with pytest.raises(ConfigError):
        add_pins(builder_with_cube(), 0, points, **options)


def test_pins_with_a_stiffness_per_point_of_the_wrong_length():
    """A stiffness per pin must have one value per point."""
    with pytest.raises(ConfigError, match="stiffness"):
        add_pins(builder_with_cube(), 0, np.zeros((2, 3)), stiffness=np.ones(3))


def test_unknown_body():
    """A model whose body is not handed over cannot be solved."""
    with pytest.raises(ConfigError, match="bodies"):
        SolverReduced(builder_with_cube().finalize(device="cpu"), [bar()])


def test_model_without_bodies():
    """A model without a reduced body is refused, whether or not the attributes are registered."""
    with pytest.raises(ConfigError, match="no reduced body"):
        SolverReduced(newton.ModelBuilder().finalize(device="cpu"), [cube()])
    builder = newton.ModelBuilder()
    register_custom_attributes(builder)
    with pytest.raises(ConfigError, match="no reduced body"):
        SolverReduced(builder.finalize(device="cpu"), [cube()])


@pytest.mark.parametrize(
    "options",
    [
        {"iteration_max": 0},
        {"contact_max": 0},
        {"tolerance": 0.0},
        {"tolerance": np.nan},
        {"contact_margin": -1.0},
        {"contact_smoothing": np.inf},
        {"stick_velocity": 0.0},
        {"stick_ratio": -1.0},
        {"step_length_min": 0.0},
    ],
    ids=str,
)
def test_bad_options(options):
    """Every option outside its range is named."""
    with pytest.raises(ConfigError, match=next(iter(options))):
        SolverReducedOptions(**options)
