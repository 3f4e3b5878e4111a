"""SolverReduced as an entry of Newton's SolverCoupledProxy: contact force, squeeze, energy, worlds, restarts."""

from typing import Any

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverMuJoCo
from newton.solvers.experimental.coupled import SolverCoupledProxy  # pyright: ignore[reportMissingImports]

from benchmarks.coupling import HELD, gripper_world, impact, squeeze
from benchmarks.coupling_schemes import Coupled, Cube, World
from softmode.deformables.coupling.proxy import SolverReducedProxy
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError
from tests.bodies import cube
from tests.scenes import GRAVITY, add_free_box, rotation, rotation_of

EDGE = 0.1
BOX = (0.05, 0.05, 0.02)


def box_on_cube(mass=1.0, *, scheme="proxy x3", world_count=1, youngs_modulus=5.0e5):
    """Return a rigid box on a soft cube on the ground, as many times as there are worlds."""

    def rigid(builder):
        add_free_box(builder, BOX, mass, (0.0, 0.0, EDGE + BOX[2] + 2e-4))

    soft = Cube(edge=EDGE, material=Material(youngs_modulus=youngs_modulus), position=(0.0, 0.0, 0.5 * EDGE + 1e-4))
    world = World(soft=soft, add_rigid=rigid, touching=(0,))
    return Coupled(scheme, [world] * world_count, dt=0.004, gravity=GRAVITY, ground=0.8)


@pytest.mark.parametrize("mass", [0.1, 10.0])
def test_box_on_cube_on_ground(mass):
    """Three lagged passes, captured: the cube carries the box with m g and the ground both, within 0.5 %."""
    run = box_on_cube(mass)
    soft = run.solver.solver("soft")
    on_box, net = [], []
    for _ in range(125):
        run.replay()
        on_box.append(run.contact_force()[0, 0, 2])
        net.append(soft.instance_force.numpy()[0, 2])
    weight = mass * GRAVITY
    assert np.mean(on_box[-25:]) == pytest.approx(weight, rel=5e-3)
    assert np.std(on_box[-25:]) <= 5e-3 * weight
    material = run.worlds[0].soft.material
    cube_weight = material.density * run.body.volume * GRAVITY
    assert np.mean(net[-25:]) + np.mean(on_box[-25:]) == pytest.approx(weight + cube_weight, rel=5e-3)


def test_pivots_of_the_inertia():
    """The free bodies' part of the linear system is bounded below by the Cholesky pivots of their inertia / dt^2."""
    run = box_on_cube()
    run.replay()
    rigid = run.solver.solver("soft").tables.rigid.table
    pivots = np.diag(np.linalg.cholesky(rigid.inertia.numpy()[0])) ** 2
    np.testing.assert_allclose(rigid.pivot_floor.numpy()[0], pivots, rtol=1e-12)
    assert pivots.min() > 0.0


def test_squeeze_equals_drive():
    """A PD gripper's fingers press with k (target - q) within 1 %, deviation under 1 %, E 5e5, 4 ms, three passes."""
    ratio, deviation = squeeze("proxy x3", 5.0e5, 0.004)
    assert ratio == pytest.approx(1.0, abs=1e-2)
    assert deviation <= 1e-2


def test_impact_keeps_energy():
    """A rigid cube of a tenth of the mass hits a free soft one: energy never exceeds the first by 0.1 %, p is kept.

    One pass is the coupler's own lag, not an error of the entry: it must not reach what three passes do.
    """
    error, gain = impact("proxy x3", 0.1)
    assert gain <= 1e-3
    assert error <= 1e-4
    assert impact("proxy x1", 0.1)[1] > 0.1


def test_passes_agree_with_joint_solve():
    """At rest the lag vanishes: one pass, three passes and the joint solve carry the box with the same force."""
    force = []
    for scheme in ("joint", "proxy x1", "proxy x3"):
        run = box_on_cube(scheme=scheme, youngs_modulus=1.0e5)
        for _ in range(200):
            run.replay()
        force.append(run.contact_force()[0, 0, 2])
    np.testing.assert_allclose(force, GRAVITY, rtol=2e-3)


def test_worlds_of_a_batch():
    """Each of three worlds behaves, bit for bit, as the world alone does."""
    batch, alone = (box_on_cube(world_count=count) for count in (3, 1))
    for _ in range(40):
        batch.replay()
        alone.replay()
    q, one = (run.solver.entry_state("soft").softmode.q.numpy() for run in (batch, alone))
    for k in range(3):
        np.testing.assert_array_equal(q[k * len(one) : (k + 1) * len(one)], one)
        np.testing.assert_array_equal(batch.state.body_q.numpy()[k], alone.state.body_q.numpy()[0])


def test_reset_of_one_world():
    """A masked reset through the coupler returns one world to its start and leaves the other."""
    run = box_on_cube(world_count=2)
    state = run.solver.entry_state("soft").softmode
    first = state.q.numpy().copy()
    for _ in range(20):
        run.replay()
    moved = state.q.numpy().copy()
    n = len(first) // 2
    assert np.abs(moved - first).max() > 1e-5
    run.solver.reset(run.state, wp.array([False, True, False], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(state.q.numpy()[n:], first[n:])
    np.testing.assert_array_equal(state.q.numpy()[:n], moved[:n])


def test_parameters_reach_the_entry():
    """Young's modulus and density changed in the model act after notify_model_changed, without a rebuild."""
    run = box_on_cube()
    soft = run.solver.solver("soft")
    volume = run.body.volume
    run.model.softmode.youngs_modulus.fill_(2.0e4)
    run.model.softmode.density.fill_(700.0)
    run.solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    assert soft.view.instances.mass.numpy()[0] == pytest.approx(700.0 * volume)
    for _ in range(125):
        run.replay()
    soft_height = run.state.body_q.numpy()[0, 2]
    stiff = box_on_cube()
    for _ in range(125):
        stiff.replay()
    # 9.81 N on 0.01 m^2 at 2e4 Pa are 5 % of the edge; the cube's own weight adds to it
    assert stiff.state.body_q.numpy()[0, 2] - soft_height > 0.03 * EDGE


def test_without_rigid_bodies():
    """With no rigid body the entry is the plain solver, bit for bit."""

    def populate() -> Any:
        builder = newton.ModelBuilder()
        instance = add_reduced_body(builder, cube(), position=(0.0, 0.0, 0.06))
        corners = 0.5 * EDGE * np.array([[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)])
        add_pins(builder, instance, corners, stiffness=200.0, targets=corners + np.array([0.0, 0.0, 0.07]))
        builder.add_ground_plane()
        return builder.finalize(device="cpu")

    results = []
    for kind in (SolverReduced, SolverReducedProxy):
        model = populate()
        solver, state = kind(model, [cube()]), model.state()
        for _ in range(20):
            solver.step(state, state, None, None, 0.004)
        results.append(state.softmode.q.numpy())
    np.testing.assert_array_equal(*results)


def test_free_body_alone():
    """Without contact a proxy moves by its twist and by body_f, with gyroscopic terms left to its own solver."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    add_reduced_body(builder, cube())
    body = add_free_box(builder, BOX, 2.0, (0.0, 0.0, 1.0), velocity=(0.1, 0.0, 0.0))
    model = builder.finalize(device="cpu")
    solver, state, out = SolverReducedProxy(model, [cube()]), model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    state.body_f.assign(np.array([[0.0, 4.0, 0.0, 0.0, 0.0, 0.01]], np.float32))
    solver.step(state, out, None, None, 0.01)
    inertia = model.body_inertia.numpy()[body]
    twist = out.body_qd.numpy()[body]
    np.testing.assert_allclose(twist, [0.1, 0.02, 0.0, 0.0, 0.0, 1e-4 / inertia[2, 2]], atol=1e-6)
    np.testing.assert_allclose(out.body_q.numpy()[body, :3], [1e-3, 2e-4, 1.0], atol=1e-6)
    half, spin, dt = np.sqrt(0.5), 3.0, 0.01  # lying on its side it turns about the world's axis, not its own
    state.body_q.assign(np.array([[0.0, 0.0, 1.0, half, 0.0, 0.0, half]], np.float32))
    state.body_qd.assign(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, spin]], np.float32))
    state.body_f.zero_()
    solver.step(state, out, None, None, dt)
    turned = rotation((0, 0, 1), spin * dt) @ rotation((1, 0, 0), np.pi / 2)
    np.testing.assert_allclose(rotation_of(out.body_q.numpy()[body, 3:]), turned, atol=(spin * dt) ** 3)


def test_effective_mass_of_a_sample():
    """3 / tr(J M^-1 J^T) of a surface sample: the inertia that one force on it meets, against the dense formula."""
    builder = newton.ModelBuilder()
    add_reduced_body(builder, cube())
    model: Any = builder.finalize(device="cpu")
    solver = SolverReducedProxy(model, [cube()])
    index = np.array([0, 7, 149])
    kinds = np.full(3, int(SolverReducedProxy.EndpointKind.PARTICLE))
    out = wp.zeros(3, dtype=float, device="cpu")
    solver.coupling_eval_effective_mass(
        wp.array(kinds, dtype=int), wp.array(index, dtype=int), wp.zeros(3, dtype=wp.vec3), out
    )
    b = cube().surface_basis[index]
    mass = float(model.softmode.density.numpy()[0]) * cube().volume
    np.testing.assert_allclose(out.numpy(), mass / (b**2).sum(axis=1), rtol=1e-5)
    assert (out.numpy() < mass).all()


def couple(**entry) -> tuple[Any, Any]:
    """Return the model of a box that rests on a cube on the ground, and a coupler of three passes around both."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    register_custom_attributes(builder)
    SolverMuJoCo.register_custom_attributes(builder)
    add_free_box(builder, BOX, 1.0, (0.0, 0.0, EDGE + BOX[2]))
    add_reduced_body(builder, cube(), material=Material(youngs_modulus=5.0e5), position=(0.0, 0.0, 0.5 * EDGE))
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    Entry, Proxy = SolverCoupledProxy.Entry, SolverCoupledProxy.Proxy
    soft = Entry(
        "soft", lambda view: SolverReducedProxy(view, [cube()]), particles=range(model.particle_count), **entry
    )
    rigid = Entry("rigid", lambda view: SolverMuJoCo(view, njmax=64, nconmax=32), bodies=[0], joints=[0])
    config = SolverCoupledProxy.Config(proxies=[Proxy("rigid", "soft", bodies=[0])], iterations=3)
    return model, SolverCoupledProxy(model, [rigid, soft], config)


def test_substeps_of_the_entry():
    """Two soft steps per step of the coupler: it receives their mean wrench, the box's weight at rest."""
    model, coupled = couple(in_place=True, substeps=2)
    states, control = [model.state(), model.state()], model.control()
    del control.softmode
    for state in states:
        newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    with wp.ScopedCapture(device="cpu") as capture:
        for a, b in ((0, 1), (1, 0)):
            coupled.step(states[a], states[b], control, None, 0.008)
    soft, height = coupled.solver("soft"), []
    for _ in range(100):
        wp.capture_launch(capture.graph)
        height.append(states[0].body_q.numpy()[0, 2])
    assert soft.impulse.numpy()[0, 2] / 0.008 == pytest.approx(GRAVITY, rel=5e-3)
    assert np.ptp(height[-20:]) < 1e-5  # what the box received is its weight: it stays


def test_out_of_place_entry():
    """An entry that is not in place would lose its coordinates: the message says what to pass."""
    model, coupled = couple()
    state, out = model.state(), model.state()
    with pytest.raises(ConfigError, match="in_place"):
        coupled.step(state, out, None, None, 0.004)


def test_palm_without_shapes_is_no_proxy():
    """Only the listed bodies are unknowns: two fingers make twelve."""
    run = Coupled("proxy x1", [gripper_world(Material())], dt=0.004, gravity=GRAVITY, ground=0.8)
    assert run.solver.solver("soft").tables.rigid.table.count.numpy().tolist() == [12]
    assert run.points().shape[2] == 3 and HELD == run.worlds[0].soft.edge
