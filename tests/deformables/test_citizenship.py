"""Newton's contract for third-party solvers: attributes, notifications, masked resets, observables, model building.

The checks of notifications, masks and observables follow Newton's own of a custom solver,
newton/tests/test_custom_solver.py.
"""

from typing import Any

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverBase, SolverMuJoCo
from newton.solvers.experimental.coupled import ModelView

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError
from tests.bodies import cube
from tests.scenes import GRAVITY, add_free_box

DT = 0.004
EDGE = 0.1
OWN_FLAG = 1 << 20
"""A bit outside Newton's flags, as third-party solvers may define."""


def world_builder(material=None):
    """Return one world: a box that comes down on a soft cube and slides, and pins that hold the cube up."""
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    position = (0.0, 0.0, 0.5 * EDGE + 0.0195)
    add_free_box(builder, (0.05, 0.05, 0.02), 0.5, position, velocity=(0.2, 0.0, -0.5))
    instance = add_reduced_body(builder, cube(), material=material)
    corners = 0.5 * EDGE * np.array([[x, y, -1.0] for x in (-1, 1) for y in (-1, 1)])
    add_pins(builder, instance, corners, stiffness=5000.0, targets=corners)
    return builder


def finish(builder) -> Any:
    """Return the model of a builder, with ground and gravity."""
    builder.add_ground_plane(height=-0.06)
    model = builder.finalize(device="cpu")
    model.set_gravity((0.0, 0.0, -GRAVITY))
    return model


def batch(world_count, **kw):
    """Return a model of equal worlds by replicate."""
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    builder.replicate(world_builder(**kw), world_count)
    return finish(builder)


def solver_of(kind, model):
    """Build a solver of a kind."""
    if kind is SolverCoupledReduced:
        return kind(model, [cube()], rigid=SolverMuJoCo(model, njmax=64, nconmax=32))
    return kind(model, [cube()])


class Run:
    """A solver with a pair of states."""

    def __init__(self, kind, model):
        """Build the solver and the states."""
        self.model: Any = model
        self.solver: Any = solver_of(kind, model)
        self.states: list[Any] = [model.state(), model.state()]
        self.control: Any = model.control()
        for state in self.states:
            newton.eval_fk(model, model.joint_q, model.joint_qd, state)

    def step(self, count=1, **kw):
        """Take steps."""
        for _ in range(count):
            self.solver.step(self.states[0], self.states[1], self.control, None, DT, **kw)
            self.states.reverse()

    def capture(self, before=None, **kw):
        """Record two steps, after what ``before`` does, and return what replays them."""
        with wp.ScopedCapture(device="cpu") as capture:
            if before is not None:
                before()
            for a, b in ((0, 1), (1, 0)):
                self.solver.step(self.states[a], self.states[b], self.control, None, DT, **kw)
        return lambda: wp.capture_launch(capture.graph)

    def q(self):
        """Return the coordinates."""
        return self.states[0].softmode.q.numpy().copy()


KINDS = pytest.mark.parametrize("kind", [SolverReduced, SolverCoupledReduced])


# -- notifications -----------------------------------------------------------------------------------------------------


@KINDS
def test_every_flag_is_accepted(kind):
    """Single flags, unions and bits of one's own are taken, and change nothing where nothing changed."""
    told, quiet = Run(kind, batch(1)), Run(kind, batch(1))
    flags = [int(flag) for flag in newton.ModelFlags] + [int(newton.ModelFlags.BODY_PROPERTIES) | OWN_FLAG, OWN_FLAG]
    for flag in flags:
        told.solver.notify_model_changed(flag)
    for run in (told, quiet):
        run.step(5)
    np.testing.assert_array_equal(told.q(), quiet.q())


@pytest.mark.parametrize("flag", [0, int(newton.ModelFlags.BODY_INERTIAL_PROPERTIES), OWN_FLAG])
def test_any_flag_renews_masses(flag):
    """Newton has no flag for a soft body's density, so each will do."""
    run = Run(SolverReduced, batch(2))
    run.model.softmode.density.assign(np.array([200.0, 400.0], np.float32))
    run.solver.notify_model_changed(flag)
    np.testing.assert_allclose(run.solver.view.instances.mass.numpy(), np.array([200.0, 400.0]) * cube().volume)


PARAMETERS = {
    "youngs_modulus": [2.0e4, 3.0e5],
    "poissons_ratio": [0.2, 0.45],
    "density": [150.0, 900.0],
    "friction": [0.1, 0.9],
    "viscosity": [0.0, 0.01],
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_change_inside_a_graph(name):
    """A graph captured before goes on with new values per world as a solver built with them would, bit for bit.

    Density is renewed by notify_model_changed, which may be captured itself; everything else is read in every step.
    """
    run = Run(SolverReduced, batch(2))
    solver, array = run.solver, getattr(run.model.softmode, name)
    replay = run.capture(lambda: solver.notify_model_changed(OWN_FLAG))
    for _ in range(5):
        replay()
    start = {k: v.numpy().copy() for k, v in vars(run.states[0].softmode).items() if isinstance(v, wp.array)}
    assert "dt_before" in start
    unchanged = Run(SolverReduced, batch(2))
    renewed = Run(SolverReduced, _with(batch(2), name))
    for other in (unchanged, renewed):
        for key, value in start.items():
            getattr(other.states[0].softmode, key).assign(value)
    array.assign(np.array(PARAMETERS[name], np.float32))
    for _ in range(5):
        replay()
    for other in (unchanged, renewed):
        other.step(10)
    np.testing.assert_array_equal(run.q(), renewed.q())
    assert np.abs(run.q() - unchanged.q()).max() > 0.0


def _with(model, name):
    """Return the model with other parameters, as if built so."""
    getattr(model.softmode, name).assign(np.array(PARAMETERS[name], np.float32))
    return model


def test_view_of_a_model():
    """A ModelView stands in for the model: same steps, and notifications read the view."""
    model = batch(2)
    views = [Run(SolverReduced, model)]
    view = ModelView(model, "view")
    solver = SolverReduced(view, [cube()])
    state: Any = model.state()
    out: Any = model.state()
    for each in (state, out):
        newton.eval_fk(model, model.joint_q, model.joint_qd, each)
    for flag in newton.ModelFlags:
        solver.notify_model_changed(flag)
    for _ in range(6):
        solver.step(state, out, None, None, DT)
        state, out = out, state
    views[0].step(6)
    np.testing.assert_array_equal(state.softmode.q.numpy(), views[0].q())


# -- resets ------------------------------------------------------------------------------------------------------------


@KINDS
def test_masked_reset(kind):
    """Only the worlds of the mask start again; the last entry stands for what is outside all worlds."""
    run = Run(kind, batch(3))
    first = run.q()
    n = len(first) // 3
    run.step(4)
    moved, particles = run.q(), run.states[0].particle_q.numpy().reshape(3, -1, 3).copy()
    assert all(np.abs(moved - first).reshape(3, n, 3)[w].max() > 0.0 for w in range(3))
    run.solver.reset(run.states[0], wp.array([False, False, False, True], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(run.q(), moved)
    run.solver.reset(run.states[0], wp.array([False, True, False, False], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(run.q()[n : 2 * n], first[n : 2 * n])
    np.testing.assert_array_equal(np.delete(run.q().reshape(3, n, 3), 1, 0), np.delete(moved.reshape(3, n, 3), 1, 0))
    after = run.states[0].particle_q.numpy().reshape(3, -1, 3)
    np.testing.assert_allclose(after[1], cube().surface.points, atol=1e-6)
    np.testing.assert_array_equal(after[[0, 2]], particles[[0, 2]])
    run.solver.reset(run.states[0])
    np.testing.assert_array_equal(run.q(), first)


@KINDS
@pytest.mark.parametrize("size", [1, 2])
def test_mask_of_wrong_shape(kind, size):
    """A mask without the entry for entities outside all worlds is refused before anything is written."""
    run = Run(kind, batch(2))
    run.step(2)
    before = run.q()
    with pytest.raises(ValueError, match="world_count \\+ 1"):
        run.solver.reset(run.states[0], wp.array([True] * size, dtype=bool, device="cpu"))
    np.testing.assert_array_equal(run.q(), before)


def test_bodies_outside_all_worlds():
    """In a model without worlds the last entry of the mask selects the bodies, as it does Newton's own."""
    run = Run(SolverReduced, finish(world_builder()))
    first = run.q()
    run.step(3)
    moved = run.q()
    run.solver.status.fill_(1)
    run.solver.reset(run.states[0], wp.array([True, False], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(run.q(), moved)
    run.solver.reset(run.states[0], wp.array([False, True], dtype=bool, device="cpu"))
    np.testing.assert_array_equal(run.q(), first)
    assert run.solver.status.numpy()[0] == 0


def test_flags_choose_what_is_reset():
    """PARTICLE_Q resets coordinates, PARTICLE_QD velocities, flags of rigid bodies or of one's own neither."""
    run = Run(SolverReduced, batch(1))
    first = run.q()
    run.step(5)
    moved, velocity = run.q(), run.states[0].softmode.qd.numpy().copy()
    assert np.abs(velocity).max() > 0.0
    run.solver.reset(run.states[0], flags=int(newton.StateFlags.BODY) | OWN_FLAG)
    np.testing.assert_array_equal(run.q(), moved)
    run.solver.reset(run.states[0], flags=newton.StateFlags.PARTICLE_QD)
    np.testing.assert_array_equal(run.q(), moved)
    assert not run.states[0].softmode.qd.numpy().any()
    run.solver.reset(run.states[0], flags=newton.StateFlags.PARTICLE_Q)
    np.testing.assert_array_equal(run.q(), first)


def test_reset_inside_a_graph():
    """A captured reset reads the mask when it is replayed."""
    run = Run(SolverReduced, batch(2))
    first, mask = run.q(), wp.zeros(3, dtype=bool, device="cpu")
    with wp.ScopedCapture(device="cpu") as capture:
        run.solver.reset(run.states[0], mask)
    run.step(4)
    moved, n = run.q(), len(first) // 2
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(run.q(), moved)
    mask.assign([True, False, False])
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(run.q()[:n], first[:n])
    np.testing.assert_array_equal(run.q()[n:], moved[n:])


# -- observables -------------------------------------------------------------------------------------------------------


@KINDS
def test_observables_report_contact(kind):
    """The contact wrench on bodies and the force on soft bodies, written in a captured step, equal the solver's own."""
    run = Run(kind, batch(2))
    names = run.solver.ObservableKind
    wanted = {names.BODY_SOFT_CONTACT_F, names.INSTANCE_CONTACT_F}
    assert wanted <= run.solver.supported_observables
    observables = run.solver.observables(kinds=wanted)
    assert observables.kinds == frozenset(wanted) and observables.body_qdd is None
    replay = run.capture(observables=observables)
    replay()
    soft = run.solver.reduced if kind is SolverCoupledReduced else run.solver
    wrench, force = observables.body_soft_contact_f.numpy(), observables.instance_contact_f.numpy()
    np.testing.assert_array_equal(wrench, soft.body_wrench.numpy())
    np.testing.assert_array_equal(force, soft.instance_force.numpy())
    assert (wrench[:, 2] > 0.1).all()


def test_coupled_observables_pass_on_the_rigid_solver():
    """Accelerations of MuJoCo with the soft forces inside: m a = f + m g for a free box."""
    run = Run(SolverCoupledReduced, batch(2))
    names = run.solver.ObservableKind
    observables = run.solver.observables(kinds=run.solver.supported_observables)
    run.step(2, observables=observables)
    mass = run.model.body_mass.numpy()[0]
    force = observables.body_soft_contact_f.numpy()[:, 2].copy()
    assert (force > 0.1).all()
    np.testing.assert_allclose(observables.body_qdd.numpy()[:, 2], force / mass - GRAVITY, atol=1e-3 * GRAVITY)
    few = observables.select({names.BODY_SOFT_CONTACT_F})
    kept = observables.body_qdd.numpy().copy()
    run.step(1, observables=few)
    np.testing.assert_array_equal(observables.body_qdd.numpy(), kept)
    assert np.abs(observables.body_soft_contact_f.numpy()[:, 2] - force).max() > 0.0


@KINDS
def test_observables_reject_what_is_not_theirs(kind):
    """Unknown kinds, bare strings and containers of another solver are refused before the step."""
    run, other = Run(kind, batch(1)), Run(kind, batch(1))
    for kinds, error in (({"contact_f"}, ValueError), ({""}, TypeError), ("body_soft_contact_f", TypeError)):
        with pytest.raises(error):
            run.solver.observables(kinds)
    foreign = other.solver.observables(set())
    before = run.q()
    with pytest.raises(ValueError, match="allocated"):
        run.step(observables=foreign)
    np.testing.assert_array_equal(run.q(), before)


def test_observables_extend_newtons():
    """The containers derive from Newton's and keep its standard names."""
    assert issubclass(SolverReduced.Observables, SolverBase.Observables)
    assert SolverReduced.ObservableKind.BODY_QDD == SolverBase.ObservableKind.BODY_QDD


# -- building models ---------------------------------------------------------------------------------------------------


def test_ways_to_build_worlds():
    """Replicate, add_world and add_builder between begin_world and end_world make the same model and the same steps."""
    results = []
    for way in ("replicate", "add_world", "add_builder"):
        builder = newton.ModelBuilder()
        SolverCoupledReduced.register_custom_attributes(builder)
        SolverMuJoCo.register_custom_attributes(builder)
        if way == "replicate":
            builder.replicate(world_builder(), 2)
        elif way == "add_world":
            for _ in range(2):
                builder.add_world(world_builder())
        else:
            for _ in range(2):
                builder.begin_world()
                builder.add_builder(world_builder())
                builder.end_world()
        model = finish(builder)
        np.testing.assert_array_equal(model.softmode.instance_world.numpy(), [0, 1])
        run = Run(SolverCoupledReduced, model)
        run.step(5)
        results.append((run.q(), run.states[0].body_q.numpy()))
    for q, body_q in results[1:]:
        np.testing.assert_array_equal(q, results[0][0])
        np.testing.assert_array_equal(body_q, results[0][1])


def test_worlds_of_different_materials():
    """add_world with a material each: every world equals the one that stands alone, bit for bit."""
    materials = [Material(youngs_modulus=E, density=rho) for E, rho in ((5e4, 200.0), (5e5, 600.0))]
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    for material in materials:
        builder.add_world(world_builder(material))
    together = Run(SolverReduced, finish(builder))
    together.step(6)
    n = len(together.q()) // 2
    for w, material in enumerate(materials):
        alone = Run(SolverReduced, batch(1, material=material))
        alone.step(6)
        np.testing.assert_array_equal(together.q()[w * n : (w + 1) * n], alone.q())


def test_attributes_are_registered_once():
    """Registering again is harmless, and a model without bodies is refused with the remedy."""
    builder = newton.ModelBuilder()
    for _ in range(2):
        SolverReduced.register_custom_attributes(builder)
        register_custom_attributes(builder)
    names = [name for name in builder.custom_attributes if name.startswith("softmode:")]
    assert len(names) == len(set(names)) and "softmode:q" in names
    plain = newton.ModelBuilder()
    plain.add_ground_plane()
    with pytest.raises(ConfigError, match="add_reduced_body"):
        SolverReduced(plain.finalize(device="cpu"), [cube()])


def test_what_the_solver_does_not_move_is_told():
    """Bodies that could move are named, kinematic ones are not; so are tetrahedra, cloth, particles."""
    builder = world_builder()
    free = builder.add_body(label="free")
    for body in (free, builder.add_body(label="held", is_kinematic=True)):
        builder.add_shape_sphere(body, radius=0.05)
    still = {"rot": wp.quat_identity(), "vel": wp.vec3()}
    cells = {"dim_x": 1, "dim_y": 1, "dim_z": 1, "cell_x": 0.1, "cell_y": 0.1, "cell_z": 0.1}
    builder.add_soft_grid(pos=wp.vec3(1.0, 0.0, 0.0), **still, **cells, density=1e2, k_mu=1e4, k_lambda=1e4, k_damp=0.0)
    weave = {"dim_x": 2, "dim_y": 1, "cell_x": 0.1, "cell_y": 0.1, "mass": 0.01}
    builder.add_cloth_grid(pos=wp.vec3(2.0, 0.0, 0.0), **still, **weave)
    builder.add_particle((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1)
    model = finish(builder)
    with pytest.warns(UserWarning) as told:
        solver_of(SolverReduced, model)
    texts = [str(one.message) for one in told]
    rigid, soft = (next(t for t in texts if word in t) for word in ("could move", "tetrahedra"))
    assert "'free'" in rigid and "'held'" not in rigid and "SolverCoupledReduced" in rigid
    assert "5 tetrahedra" in soft and "4 triangles of cloth" in soft and "1 loose particles" in soft
    with pytest.warns(UserWarning, match="5 tetrahedra") as told:
        solver_of(SolverCoupledReduced, model)
    assert not any("could move" in str(one.message) for one in told)
