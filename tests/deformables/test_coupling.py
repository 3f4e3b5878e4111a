"""Two-way contact with MuJoCo: derivatives of the joint potential, momentum, squeeze force, batching, faults."""

import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.model.lane_kernels import from_blocks, to_blocks
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient
from softmode.deformables.solver.minimise import check_convergence
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.deformables.system import assembly_kernels
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import cube
from tests.scenes import GRAVITY, GRIPPER, RIGID_GAP, Scene, add_free_box, add_gripper

FLOAT32 = float(np.finfo(np.float32).eps)
EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)


def impact(ratio, *, offset=(0.0, 0.0), speed=0.5, friction=0.5, dt=0.001, pins=False, **kw):
    """Return a scene of a free rigid cube, ``ratio`` times as heavy, that falls on a free soft one without gravity."""
    body = cube()
    material = Material(friction=friction)
    half = 0.5 * EDGE

    def populate(world):
        position = (*offset, EDGE + RIGID_GAP)
        mass = ratio * material.density * body.volume
        add_free_box(world, (half,) * 3, mass, position, velocity=(0.0, 0.0, -speed))
        instance = add_reduced_body(world, body, material=material)
        if pins:
            corners = half * np.array([[x, y, -1.0] for x in (-1, 1) for y in (-1, 1)])
            add_pins(world, instance, corners, stiffness=200.0, targets=corners + 0.003)

    scene = Scene(populate, [body], coupled=True, dt=dt, **kw)
    return scene, reference.FreeBody(body=body, material=reference.with_float32(material), dt=dt)


def totals(scene, twin):
    """Return linear and angular momentum and energy of the soft and the rigid body together, that of dents included."""
    p, L = scene.momentum()
    P, spin, kinetic = scene.rigid_momentum()
    return p + P, L + spin, scene.kinetic_energy() + kinetic + twin.elastic_energy(scene.q()) + scene.dents()[1]


# -- derivatives -------------------------------------------------------------------------------------------------------


class Potential:
    """The incremental potential of a step in contact as a function of u = (q, r), through the solver's own kernels."""

    def __init__(self, scene):
        """Take steps until the bodies touch, then linearise the next one about its start."""
        self.scene, self.solver = scene, scene.reduced
        while np.abs(self.solver.instance_force.numpy()).max() < 1.0:
            scene.step()
        scene.step()  # reads the contacts of a step that starts in contact
        self.n = scene.body().function_count
        self.q = from_blocks(self.solver.tables.arrays.q.numpy()[0], self.n)
        self.r = self.solver.tables.rigid.table.r.numpy()[0].copy()

    def put(self, u):
        """Write u into the solver and ask for a fresh elastic Hessian."""
        solver = self.solver
        solver.tables.newton.refresh.fill_(1)
        q = u[: 3 * self.n].reshape(1, -1, 3)
        solver.tables.arrays.q.assign(to_blocks(q, solver.view.layout.block_count))
        solver.tables.rigid.table.r.assign(u[None, 3 * self.n :])

    @property
    def u(self):
        """The minimum that the step found."""
        return np.concatenate([self.q.ravel(), self.r])

    def value(self, u):
        """Return E(u) with the normal forces of friction as they were last renewed."""
        solver, dt = self.solver, self.scene.dt
        self.put(u)
        solver.tables.newton.active.fill_(1)
        evaluate(solver.tables, dt, derivatives=False)
        solver.tables.newton.iteration.zero_()
        check_convergence(solver.tables, dt)
        return float(solver.tables.newton.potential.numpy()[0])

    def gradient(self, u):
        """Return dE/du; renews the normal forces of friction."""
        solver, dt = self.solver, self.scene.dt
        self.put(u)
        solver.tables.newton.active.fill_(1)
        evaluate(solver.tables, dt, derivatives=True)
        gather_gradient(solver.tables, dt)
        assemble(solver.tables, dt)
        return np.concatenate(
            [
                from_blocks(solver.tables.arrays.gradient.numpy()[0], self.n).ravel(),
                solver.tables.rigid.table.gradient.numpy()[0],
            ]
        )

    def matrix(self):
        """Return the assembled d2E/du2, unknowns in the order of u."""
        solver, n = self.solver, self.n
        system = solver.tables.system.matrix.numpy()[0]
        system = system.reshape(len(system), -1).astype(float)
        index = (
            np.arange(3)[None, :] * solver.view.layout.stride + np.arange(n)[:, None]
        ).ravel()  # component- to point-major
        size = 3 * solver.view.layout.stride
        upper = np.triu(system[:, :size])
        K = (upper + np.triu(upper, 1).T)[np.ix_(index, index)]
        C = system[index, size : size + len(self.r)]
        return np.block([[K, C], [C.T, solver.tables.rigid.table.matrix.numpy()[0]]])


def test_gradient_of_the_incremental_potential():
    """dE/du equals central differences of E, u = (q, r), with contact, friction, pins, viscosity and rigid dofs."""
    potential = Potential(impact(1.0, offset=(0.02, 0.01), pins=True)[0])
    assert potential.solver.view.constraints.count.numpy()[0] > 4 + 5
    rng = np.random.default_rng(0)
    u = potential.u + 1e-5 * rng.normal(size=potential.u.size)
    gradient = potential.gradient(u)
    # Random directions and some single unknowns, the rigid ones all.
    directions = [rng.normal(size=u.size) for _ in range(10)]
    directions += list(np.eye(u.size)[-6:]) + list(np.eye(u.size)[:6])
    step = 1.0e-9  # well inside the stick range, stick_velocity dt = 1e-7 m
    noise = 16 * np.finfo(float).eps * max(abs(potential.value(u)), 1.0) / step
    for d in directions:
        d = d / np.linalg.norm(d)
        difference = (potential.value(u + step * d) - potential.value(u - step * d)) / (2 * step)
        # The third derivative of friction, mu f_n / eps^2 per contact, bounds the error of the difference.
        assert difference == pytest.approx(gradient @ d, rel=1e-5, abs=noise + 1e-5 * np.linalg.norm(gradient))


def test_matrix_of_the_incremental_potential():
    """Columns of the assembled matrix equal gradient differences, (g(u + eps d) - g(u - eps d)) / (2 eps).

    Without friction (its curvature is majorised) and viscosity (Gauss-Newton), and stretched by 2 %, so that no
    negative eigenvalue of the material is projected away.
    """
    scene, _ = impact(1.0, offset=(0.02, 0.01), friction=0.0, pins=True)
    scene.set_parameter("viscosity", 0.0)
    potential = Potential(scene)
    u = potential.u
    n = potential.n
    u[: 3 * n] += scene.body().affine(1.02 * np.eye(3)).ravel()
    potential.gradient(u)
    matrix = potential.matrix()
    assert np.abs(matrix[: 3 * n, 3 * n :]).max() > 0.0  # soft and rigid dofs meet
    rng = np.random.default_rng(0)
    size = np.abs(matrix).max()
    step = 1.0e-8  # far inside the range of the contact's onset, 1.7e-4 m
    for d in [rng.normal(size=u.size) for _ in range(10)] + list(np.eye(u.size)[-6:]):
        d = d / np.linalg.norm(d)
        difference = (potential.gradient(u + step * d) - potential.gradient(u - step * d)) / (2 * step)
        # float32 assembly; the onset p / eps of a contact changes by step / eps of its stiffness.
        np.testing.assert_allclose(matrix @ d, difference, atol=1e-4 * size)


def test_jacobians_move_the_shape():
    """The rigid part of d is the motion of the shape: the gradient over r of a free box is minus (f, arm cross f)."""
    potential = Potential(impact(1.0, offset=(0.02, 0.01))[0])
    solver, scene = potential.solver, potential.scene
    u = potential.u
    gradient = potential.gradient(u)[3 * potential.n :]
    inertia = solver.tables.rigid.table.inertia.numpy()[0]
    contact = gradient - inertia @ (potential.r - solver.tables.rigid.table.predicted.numpy()[0])
    count = solver.view.constraints.count.numpy()[0]
    force, arm = solver.view.constraints.force.numpy()[0, :count], solver.view.constraints.arm.numpy()[0, :count]
    expected = np.concatenate([force.sum(axis=0), np.cross(arm, force).sum(axis=0)])
    # arms are float32 differences of world positions near 0.1 m
    np.testing.assert_allclose(contact, expected, atol=1e-5 * np.abs(force).sum() * EDGE + 1e-6 * np.abs(force).sum())
    assert scene.model.joint_dof_count == 6


# -- momentum and energy -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.01])
@pytest.mark.parametrize("ratio", [1e-3, 1e-2, 1.0, 1e2, 1e3])
def test_central_impact(ratio, dt):
    """Free bodies without gravity: p is kept to 1e-5 in every step and energy never grows, rigid : soft 1e-3 to 1e3.

    To 1e-4 where the rigid body, whose p it is, is a thousandth of the soft one: Newton stops at a residual of 1e-5 of
    all forces, the soft body's own among them. Measured: 6e-8, and 6e-5 on another processor.
    """
    kept = 1e-4 if ratio < 1e-2 else 1e-5
    scene, twin = impact(ratio, dt=dt)
    p0, _, last = totals(scene, twin)
    touched = 0.0
    for _ in range(max(round(0.05 / dt), 8)):
        scene.step()
        p, _, e = totals(scene, twin)
        touched = max(touched, np.abs(scene.reduced.instance_force.numpy()).max())
        assert np.abs(p - p0).max() <= kept * np.abs(p0).max()
        assert e <= (1.0 + 1e-6) * last
        last = e
    assert touched > 0.0
    assert scene.reduced.status.numpy()[0] == 0


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e3])
def test_eccentric_impact(ratio):
    """Off centre: p to 1e-5, and angular momentum about the origin to 1e-4 plus what implicit Euler loses of the spin.

    L_(n+1) - L_n = -dt^2 sum_k v_k cross f_k(q_(n+1)) in a step, of first order in dt, as in the decay of a free spin:
    bounded by omega dt of the angular momentum passed on. The levers of a step are those of its start, the shape moves
    on by less than v dt: another v dt of the momentum passed on.
    """
    scene, twin = impact(ratio, offset=(0.03, 0.02))
    p0, L0, e0 = totals(scene, twin)
    soft = []
    for _ in range(60):
        scene.step()
        p, L, e = totals(scene, twin)
        soft.append(np.linalg.norm(scene.momentum()[1]))
        assert np.abs(p - p0).max() <= 1e-5 * np.abs(p0).max()
        assert e <= (1.0 + 1e-6) * e0
    omega = max(soft) / (scene.mass() * EDGE**2 / 6.0)
    assert max(soft) > 0.05 * np.linalg.norm(L0) or ratio != 1.0
    lever = 0.5 * scene.dt * np.linalg.norm(scene.momentum()[0])
    assert np.linalg.norm(L - L0) <= 1e-4 * np.linalg.norm(L0) + omega * scene.dt * max(soft) + lever


def test_reactions_are_equal_and_opposite():
    """In every step: soft dp = dt F, rigid dp = -dt F and dL = dt M of the reported wrench, to 1e-4 of the peak."""
    scene, _ = impact(1.0, offset=(0.03, 0.02))
    rows = []
    for _ in range(40):
        p, P = scene.momentum()[0], scene.rigid_momentum()[:2]
        scene.step()
        force = scene.reduced.instance_force.numpy()[0].copy()
        wrench = scene.solver.body_wrench.numpy()[0].astype(float)
        Q = scene.rigid_momentum()[:2]
        arm = np.cross(scene.state.body_q.numpy()[0, :3].astype(float), wrench[:3])
        rows.append(
            [
                (scene.momentum()[0] - p) / scene.dt - force,
                (Q[0] - P[0]) / scene.dt - wrench[:3],
                ((Q[1] - P[1]) / scene.dt - wrench[3:] - arm) / EDGE,
                wrench[:3] + force,
                force,
            ]
        )
    soft, rigid, moment, sum_, force = np.abs(np.array(rows)).max(axis=(0, 2))
    assert force > 1.0
    assert sum_ <= 8 * FLOAT32 * force
    assert rigid <= 1e-4 * force
    assert moment <= 1e-3 * force  # the box turns during the step, by omega dt
    assert soft <= 1e-4 * force


def solve_condensed(scene, S, M, right):
    """Return the solution of S x = right by the solver's kernels, S being condensed from S + Y^T Y >= M."""
    solver = scene.reduced
    rigid, n = solver.tables.rigid.table, len(S)
    rigid.count.fill_(n)
    rigid.inertia.assign(M[None])
    solver.tables.launch_teams(assembly_kernels.bound_pivots, 1, solver.tables.team, rigid)
    rigid.matrix.assign(S[None])
    rigid.pivot_min.assign(rigid.pivot_floor)
    rigid.direction.assign(right[None])
    solver.tables.newton.active.fill_(1)
    solver.tables.launch_teams(assembly_kernels.solve_rigid, 1, solver.tables.newton.active, solver.tables.team, rigid)
    return rigid.direction.numpy()[0]


def test_rigid_solve():
    """S x = s as NumPy has it; where rounding leaves S indefinite, x stays a descent direction of bounded length.

    No pivot is below those of M, so that x is far from the 1e70 that a clamp at nothing gave.
    """
    scene, _ = impact(1.0)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    M = 1e-2 * (np.eye(6) + 0.1 * root @ root.T)
    pivots = np.diag(np.linalg.cholesky(M)) ** 2
    contact = 1e6 * root[:, :3] @ root[:, :3].T  # three directions without contact
    right = rng.normal(size=6)
    expected = np.linalg.solve(M + contact, right)
    rounding = 8 * np.finfo(float).eps * np.linalg.cond(M + contact) * np.linalg.norm(expected)
    np.testing.assert_allclose(solve_condensed(scene, M + contact, M, right), expected, rtol=0.0, atol=rounding)
    np.testing.assert_allclose(scene.reduced.tables.rigid.table.pivot_floor.numpy()[0], pivots, rtol=1e-12)
    noise = rng.normal(size=(6, 6))
    S = contact + 10.0 * (noise + noise.T)  # float32's rounding of 1e6 and more
    assert np.linalg.eigvalsh(S)[0] < -1.0
    x = solve_condensed(scene, S, M, right)
    assert x @ right > 0.0
    assert np.abs(x).max() <= 1e4 * np.abs(right).max() / pivots.min()


# -- statics -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.1, 1.0, 10.0])
def test_box_on_cube_on_ground(mass):
    """A rigid box rests on a soft cube: it is carried with m g, the ground carries both, within 0.1 %."""
    body = cube()

    def populate(world):
        add_free_box(world, (0.05, 0.05, 0.02), mass, (0.0, 0.0, EDGE + 0.0202))
        add_reduced_body(world, body, material=Material(youngs_modulus=5.0e5), position=(0.0, 0.0, 0.0501))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8)
    replay = scene.capture()
    on_box, net = [], []
    for _ in range(250):
        replay()
        on_box.append(scene.solver.body_wrench.numpy()[0, 2])
        net.append(scene.reduced.instance_force.numpy()[0, 2])
    assert np.mean(on_box[-50:]) == pytest.approx(mass * GRAVITY, rel=1e-3)
    assert np.std(on_box[-50:]) <= 1e-3 * mass * GRAVITY
    ground = np.mean(net[-50:]) + np.mean(on_box[-50:])
    assert ground == pytest.approx((mass + scene.mass()) * GRAVITY, rel=1e-3)


def grasp(youngs_modulus, dt, *, time=1.6, options=None, world_count=1):
    """Return a gripper that closes on a soft cube in 0.4 s, lifts it from 0.6 s to 1.2 s, and what holds it there."""
    body = cube(0.06)
    material = Material(youngs_modulus=youngs_modulus, friction=0.8)

    def populate(world):
        add_gripper(world, 0.03)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.0301))

    scene = Scene(
        populate, [body], coupled=True, gravity=DOWN, ground=0.8, dt=dt, options=options, world_count=world_count
    )
    replay = scene.capture()

    def close(t):
        lift = GRIPPER["lift"] * min(max(t - 0.6, 0.0) / 0.6, 1.0)
        squeeze = GRIPPER["squeeze"] * min(t / 0.4, 1.0)
        scene.control.joint_target_q.assign(np.tile(np.array([lift, squeeze, squeeze], np.float32), world_count))
        replay()

    return scene, close, round(time / dt / 2)


@pytest.mark.parametrize(
    ("youngs_modulus", "dt"), [(5.0e4, 0.01), (5.0e5, 0.004), (5.0e6, 0.004), (5.0e6, 0.01), (5.0e5, 0.001)]
)
def test_squeeze_equals_drive(youngs_modulus, dt):
    """Both fingers press with k (target - q) within 0.5 %, std too; friction carries the weight; the cube is lifted."""
    scene, close, count = grasp(youngs_modulus, dt)
    height, rows, status = scene.centre()[2], [], 0
    for k in range(count):
        close(2 * k * dt)
        wrench, q = scene.solver.body_wrench.numpy()[:, :3], scene.state.joint_q.numpy()
        rows.append([wrench[1, 1], -wrench[2, 1], wrench[1:, 2].sum(), q[1], q[2], scene.centre()[2], q[0]])
        status |= int(scene.reduced.status.numpy()[0])
    hold = np.array(rows[-round(0.1 / dt) :])
    for side in (0, 1):
        drive = GRIPPER["stiffness"] * (GRIPPER["squeeze"] - hold[:, 3 + side])
        np.testing.assert_allclose(hold[:, side].mean(), drive.mean(), rtol=5e-3)
        assert hold[:, side].std() <= 5e-3 * drive.mean()
    # At rest the cube is in equilibrium: no net force along the fingers' axis, its weight across it.
    weight = scene.mass() * GRAVITY
    assert abs(hold[:, 0].mean() - hold[:, 1].mean()) <= 1e-2 * hold[:, 0].mean()
    assert -hold[:, 2].mean() == pytest.approx(weight, rel=1e-2)
    # It rises with the palm.
    assert hold[-1, 5] - height == pytest.approx(hold[-1, 6], abs=1e-3)
    assert not status & (bits.WORLD_NOT_FINITE | bits.WORLD_CONTACT_OVERFLOW)


# -- worlds, graphs, faults --------------------------------------------------------------------------------------------


def fling(scene, i, seed):
    """Give world i an initial velocity of its own."""
    qd = scene.qd(i)
    qd[0] = 0.2 * np.random.default_rng(seed).normal(size=3)
    scene.set(qd=qd, instance=i)


@pytest.mark.parametrize("damping", [0.0, 20.0, 100.0])
def test_damped_finger_at_its_stop(damping):
    """A cube that flies at 2 m/s into a finger at its end stop: MuJoCo moves the finger as the solve did, to 1 %.

    M_eff / M is 1, 1.8 and 5. MuJoCo damps after its constraints are solved; where the solve did not know, the finger
    went 0.4 mm deeper into the cube in the first step than was solved for, with a damping of 100 N s/m.
    """
    body, dt = cube(0.06), 0.004

    def populate(world):
        add_gripper(world, 0.035)
        world.joint_limit_lower[-2:] = [0.0, 0.0]
        world.joint_limit_ke[-2:] = [1.0e5, 1.0e5]
        world.joint_limit_kd[-2:] = [200.0, 200.0]
        world.joint_target_kd[-2:] = [damping, damping]
        material = Material(youngs_modulus=2.0e5)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.04), velocity=(0.0, 2.0, 0.0))

    scene = Scene(populate, [body], coupled=True, dt=dt)
    solved, moved, stopped = [], [], 0
    for _ in range(20):
        scene.step()
        rigid = scene.reduced.tables.rigid.table
        if rigid.count.numpy()[0]:
            solved.append(rigid.r.numpy()[0].copy())
            moved.append(dt * scene.state.joint_qd.numpy())
            stopped += int(rigid.row_count.numpy()[0] > 0)
    assert stopped >= 3 and len(solved) >= 5
    assert np.abs(np.array(solved) - moved).max() <= 0.01 * np.abs(moved).max()


def test_captured_graph_equals_eager():
    """A recorded graph of the coupled step gives the bits of kernel-by-kernel launches, soft and rigid."""
    scene, _ = impact(1.0, offset=(0.02, 0.0))
    replay = scene.capture()
    for _ in range(10):
        replay()
    captured = [array.numpy().copy() for array in (scene.state.softmode.q, scene.state.joint_q, scene.state.body_q)]
    fresh, _ = impact(1.0, offset=(0.02, 0.0))
    fresh.step(20)
    eager = (fresh.state.softmode.q, fresh.state.joint_q, fresh.state.body_q)
    for array, expected in zip(eager, captured, strict=True):
        np.testing.assert_array_equal(array.numpy(), expected)


def test_world_of_three_equals_single_world():
    """World i of 3 coupled worlds, each in a state of its own, equals the single world bit for bit."""
    batch, _ = impact(1.0, world_count=3)
    for i in range(3):
        fling(batch, i, i)
    batch.step(5)
    assert (np.abs(batch.reduced.instance_force.numpy()).max(axis=1) > 0.0).all()
    batch.step(15)
    for i in range(3):
        alone, _ = impact(1.0)
        fling(alone, 0, i)
        alone.step(20)
        np.testing.assert_array_equal(batch.q(i), alone.q())
        np.testing.assert_array_equal(batch.state.body_qd.numpy()[i], alone.state.body_qd.numpy()[0])


def test_not_a_number_stays_out_of_robots_and_other_worlds():
    """NaN in one world's soft body is flagged; its rigid body and the other worlds stay finite, these bit for bit."""
    clean, dirty = (impact(1.0, world_count=3)[0] for _ in range(2))
    for scene in (clean, dirty):
        scene.step(3)  # in contact
    qd = dirty.qd(1)
    qd[2, 1] = np.nan
    dirty.set(qd=qd, instance=1)
    for k in range(3):
        for scene in (clean, dirty):
            scene.step()
        if k == 0:
            assert dirty.reduced.status.numpy()[1] & bits.WORLD_NOT_FINITE
        for i in (0, 2):
            np.testing.assert_array_equal(dirty.q(i), clean.q(i))
            np.testing.assert_array_equal(dirty.state.body_q.numpy()[i], clean.state.body_q.numpy()[i])
            np.testing.assert_array_equal(dirty.state.body_qd.numpy()[i], clean.state.body_qd.numpy()[i])
    assert np.isfinite(dirty.reduced.body_wrench.numpy()).all()
    assert np.isfinite(dirty.state.body_q.numpy()).all()


@pytest.mark.parametrize("pushed", [False, True])
@pytest.mark.parametrize("array", ["joint_q", "joint_qd", "body_q", "body_qd"])
def test_a_rigid_state_that_is_not_finite_is_flagged_in_its_world(array, pushed):
    """NaN in what MuJoCo steps is flagged in a replayed graph, pushed by a soft body or not; a reset mends the world.

    MuJoCo reads joint coordinates and writes poses: a NaN in a pose or a twist is gone after the step, yet flagged.
    """
    scene, _ = impact(1.0, world_count=3)
    replay = scene.capture()
    for _ in range(2 if pushed else 0):
        replay()
    assert (np.abs(scene.reduced.body_wrench.numpy()[1]).max() > 0.0) == pushed
    assert not scene.reduced.status.numpy().any()
    values = getattr(scene.state, array)
    spoilt = values.numpy()
    spoilt.reshape(3, -1)[1, 2] = np.nan
    values.assign(spoilt)
    replay()
    status = scene.reduced.status.numpy()
    assert status[1] & bits.WORLD_RIGID_NOT_FINITE and not status[[0, 2]].any()
    scene.solver.reset(scene.state)
    replay()
    assert not scene.reduced.status.numpy().any()
    assert all(np.isfinite(getattr(scene.state, name).numpy()).all() for name in ("joint_q", "joint_qd", "body_q"))


@pytest.mark.parametrize("limits", [{"njmax": 12}, {"nconmax": 2, "njmax": 64}], ids=["rows", "contacts"])
def test_what_mujoco_drops_is_flagged(limits):
    """Four contacts of a box on the ground in too little room are flagged in a graph; with room nothing is.

    Rows are counted per world; room for contacts is shared, so that a world in flight is flagged with the others.
    """

    def populate(world):
        add_free_box(world, (0.05,) * 3, 1.0, (0.3, 0.0, 0.5))
        add_reduced_body(world, cube(), position=(0.0, 0.0, EDGE))

    def flags(**mujoco):
        scene = Scene(populate, [cube()], coupled=True, world_count=2, gravity=DOWN, ground=0.5, mujoco=mujoco)
        replay, joint_q = scene.capture(), scene.state.joint_q.numpy()
        joint_q[2] = 0.05  # the first world's box stands on the ground
        scene.state.joint_q.assign(joint_q)
        replay()
        return scene.reduced.status.numpy()

    flagged = flags(**limits) & bits.WORLD_RIGID_OVERFLOW
    assert flagged[0] and bool(flagged[1]) == ("nconmax" in limits)
    assert not flags(njmax=64, nconmax=32).any()
    assert "SolverMuJoCo(model, njmax=..., nconmax=...)" in bits.status_reasons(int(flagged[0]), remedies=True)[0]


def test_reset_restores_both():
    """A reset puts soft and rigid bodies back to their initial state; the run that follows repeats the first."""
    scene, _ = impact(1.0)
    scene.step(10)
    first = scene.q(), scene.state.body_q.numpy().copy()
    scene.solver.reset(scene.state)
    scene.step(10)
    np.testing.assert_array_equal(scene.q(), first[0])
    np.testing.assert_array_equal(scene.state.body_q.numpy(), first[1])


def test_external_body_force_is_kept():
    """state.body_f, as the caller set it, acts once and is left as it was: dv = dt f / m."""
    scene, _ = impact(1.0, speed=0.0)
    f = np.zeros((1, 6), np.float32)
    f[0, 2] = 3.0  # away from the cube
    scene.state.body_f.assign(f)
    scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
    np.testing.assert_array_equal(scene.state.body_f.numpy(), f)
    scene.state = scene.next_state
    mass = float(scene.model.body_mass.numpy()[0])
    assert scene.rigid_momentum()[0][2] / mass == pytest.approx(scene.dt * 3.0 / mass, rel=1e-4)


# -- errors ------------------------------------------------------------------------------------------------------------


def test_model_without_joints():
    """Nothing to couple: the message names the solver to use."""
    builder = newton.ModelBuilder()
    add_reduced_body(builder, cube())
    with pytest.raises(ConfigError, match="SolverReduced"):
        SolverCoupledReduced(builder.finalize(device="cpu"), [cube()])


def test_options_reach_the_soft_solve():
    """Options given to the coupled solver rule its soft solve."""
    scene, _ = impact(1.0, options=SolverReducedOptions(iteration_max=1))
    scene.step(3)
    assert scene.reduced.iteration.numpy()[0] == 1


def test_private_names_of_the_rigid_solver_are_checked(monkeypatch):
    """A rigid solver without them gets a warning when the solver is built, and whole steps: the same step to 1e-5."""
    import mujoco_warp

    scene, _ = impact(1.0)
    while np.abs(scene.reduced.instance_force.numpy()).max() < 1.0:
        scene.step()
    rigid = SolverMuJoCo(scene.model, njmax=64, nconmax=32)
    rigid._use_speculative_contacts = None  # type: ignore[assignment]
    with pytest.warns(RuntimeWarning, match="two whole MuJoCo steps"):
        whole = SolverCoupledReduced(scene.model, scene.bodies, rigid=rigid)
    assert callable(scene.solver.rigid._mujoco_warp_step)  # the known names are there, and give the faster path
    taken, step = [], mujoco_warp.step2
    monkeypatch.setattr(mujoco_warp, "step2", lambda *given: (taken.append(1), step(*given))[1])
    out = [scene.model.state() for _ in range(2)]
    whole.step(scene.state, out[0], scene.control, None, scene.dt)
    assert not taken
    scene.solver.step(scene.state, out[1], scene.control, None, scene.dt)
    assert taken
    for name in ("joint_qd", "body_q"):
        one, other = (getattr(state, name).numpy() for state in out)
        np.testing.assert_allclose(one, other, atol=1e-5)
    np.testing.assert_allclose(out[0].softmode.q.numpy(), out[1].softmode.q.numpy(), atol=1e-7)
