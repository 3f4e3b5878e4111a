"""The adjoint of the reduced step: against central differences, batched against single, contact, refusals, PyTorch."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp

from softmode.deformables.gradients.adjoint import AdjointOptions, AdjointReduced
from softmode.deformables.gradients.adjoint_torch import rollout
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.deformables.tools.markers import Markers
from softmode.errors import ConfigError, SolverDiverged
from tests.bodies import cube, held_cube
from tests.scenes import GRAVITY, Scene

EXACT = SolverReducedOptions(tolerance=1.0e-13, force_tolerance=1.0e-12, iteration_max=100, stick_ratio=0.0)
"""Solved to rounding: central differences divide what is left by their step."""
BDF2 = dataclasses.replace(EXACT, integrator="bdf2")
STEPS = 8
DT = 0.01
ACCURACY = 1.0e-7
"""Relative error of a gradient against five-point differences: of what they miss and round, not of the gradient."""
FLOAT32 = float(np.finfo(np.float32).eps)
MATERIAL = Material(youngs_modulus=3.0e4, poissons_ratio=0.4, density=500.0, viscosity=0.004, mass_damping=0.5)
PARAMETERS = ("youngs_modulus", "poissons_ratio", "density", "viscosity", "mass_damping")


class Rollout:
    """A cube that hangs by its top, bent by gravity, spin and forces, and a loss of all of its motion."""

    def __init__(
        self,
        *,
        body=cube,
        model=MaterialModel.STABLE_NEO_HOOKEAN_LOG,
        world_count=1,
        options=EXACT,
        **adjoint_options,
    ):
        """Build the scene and random weights of the loss."""
        body = self.body = body()

        def populate(world):
            material = Material(**{name: getattr(MATERIAL, name) for name in PARAMETERS}, model=model)
            index = add_reduced_body(
                world, body, material=material, velocity=(0.3, -0.2, 0.5), angular_velocity=(4.0, -6.0, 3.0)
            )
            if not body.driven_count:
                add_pins(world, index, body.cubature.points[body.cubature.points[:, 2] > 0.03], stiffness=20.0)

        self.scene = Scene(
            populate, [body], gravity=(0.0, 0.0, -GRAVITY), options=options, dt=DT, world_count=world_count
        )
        self.adjoint = AdjointReduced(self.scene.reduced, STEPS, options=AdjointOptions(**adjoint_options))
        attributes = self.scene.model.softmode
        self.target = np.zeros((0, 3)) if body.driven_count else attributes.pin_target.numpy().copy()
        self.driven = attributes.q_driven.numpy().copy()
        rng = np.random.default_rng(0)
        n, total = body.function_count, self.adjoint.total
        self.weight = {name: np.tile(rng.normal(size=(STEPS + 1, n, 3)), (1, world_count, 1)) for name in ("q", "qd")}
        self.weight["qd"] *= 0.01
        self.path = {
            "q": 0.01 * rng.normal(size=(total, 3)),
            "qd": rng.normal(size=(total, 3)),
            "pin_target": 0.02 * rng.normal(size=(STEPS, len(self.target), 3)),
            "force": rng.normal(size=(STEPS, total, 3)),
            "q_driven": 0.01 * rng.normal(size=(STEPS, total, 3)),
            "particle_force": 0.05 * rng.normal(size=(STEPS, self.scene.model.particle_count, 3)).astype(np.float32),
        }

    def run(self, **change) -> float:
        """Return the loss sum(w q + q^2 / 2) + sum(w v) after moving each named input along its random path."""
        scene, adjoint = self.scene, self.adjoint
        scene.restart()
        for name in ("q", "qd"):
            array = getattr(scene.state.softmode, name)
            array.assign(array.numpy() + change.get(name, 0.0) * self.path[name])
        adjoint.start(scene.state)
        for t in range(STEPS):
            target = self.target + change.get("pin_target", 0.0) * self.path["pin_target"][t]
            if len(target):
                scene.control.softmode.pin_target.assign(target)
            scene.control.softmode.q_driven.assign(self.driven + change.get("q_driven", 0.0) * self.path["q_driven"][t])
            force = wp.array(change.get("force", 0.0) * self.path["force"][t], dtype=wp.vec3d)
            scene.state.particle_f.assign(
                np.float32(change.get("particle_force", 0.0)) * self.path["particle_force"][t]
            )
            adjoint.step(scene.state, scene.next_state, scene.control, self.dt(t), force=force)
            scene.state, scene.next_state = scene.next_state, scene.state
        q, qd = adjoint.q.numpy(), adjoint.qd.numpy()
        return float((self.weight["q"] * q + 0.5 * q**2).sum() + (self.weight["qd"] * qd).sum())

    @staticmethod
    def dt(t: int) -> float:
        """Return the step, which changes twice: BDF2 then takes an Euler step."""
        return DT * (1.0 if t < 4 else 1.5 if t < 7 else 0.8)

    def backward(self):
        """Return the gradients of the loss of the last run."""
        q = self.adjoint.q.numpy()
        return self.adjoint.backward(loss_q=self.weight["q"] + q, loss_qd=self.weight["qd"]).numpy()

    def gradients(self):
        """Return the gradients of the unchanged run."""
        self.run()
        return self.backward()

    def difference(self, name: str, step: float) -> float:
        """Return the derivative along a path by the five-point central difference."""
        a, b = (self.run(**{name: s * step}) - self.run(**{name: -s * step}) for s in (1.0, 2.0))
        return (8.0 * a - b) / (12.0 * step)

    def parameter_difference(self, name: str, relative: float | None = None) -> float:
        """Return dL/d(parameter) from the quartic through five values; the model stores float32, which is read back.

        nu moves a quarter as far by default: lambda, which follows 1 / (1 - 2 nu), is bent too much for a quartic.
        """
        relative = relative or (5.0e-4 if name == "poissons_ratio" else 2.0e-3)
        array = getattr(self.scene.model.softmode, name)
        before, x, losses = float(array.numpy()[0]), [], []
        for factor in (-2.0, -1.0, 0.0, 1.0, 2.0):
            self.scene.set_parameter(name, before * (1.0 + factor * relative))
            x.append((float(array.numpy()[0]) - before) / (relative * before))
            losses.append(self.run())
        self.scene.set_parameter(name, before)
        return float(np.polynomial.polynomial.polyfit(x, losses, 4)[1]) / (relative * before)


@functools.cache
def hanging(**options) -> Rollout:
    """Return a single-world rollout, built once."""
    return Rollout(**options)


# -- against central differences -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, EXACT) for name in PARAMETERS), ("density", BDF2), ("viscosity", BDF2)],
    ids=[*PARAMETERS, "density-bdf2", "viscosity-bdf2"],
)
def test_gradient_by_a_parameter(name, options):
    """DL/d(E, nu, rho, tau, alpha) agrees with central differences of the whole trajectory."""
    case = hanging(options=options)
    assert case.gradients()[name][0] == pytest.approx(case.parameter_difference(name), rel=ACCURACY)


@pytest.mark.parametrize("model", [m for m in MaterialModel if m != MaterialModel.STABLE_NEO_HOOKEAN_LOG])
def test_gradient_of_every_material(model):
    """The same by nu, which changes mu and lambda, for the other materials."""
    case = hanging(model=model)
    expected = case.parameter_difference("poissons_ratio")
    assert case.gradients()["poissons_ratio"][0] == pytest.approx(expected, rel=ACCURACY)


@pytest.mark.parametrize("options", [EXACT, BDF2], ids=["euler", "bdf2"])
@pytest.mark.parametrize(("name", "step"), [("q", 0.001), ("qd", 0.005), ("pin_target", 0.05), ("force", 0.05)])
def test_gradient_along_a_path(name, step, options):
    """DL/d(q_0, v_0, pin path, force path) agrees with central differences along a random direction."""
    case = hanging(options=options)
    gradient = float((case.gradients()[name] * case.path[name]).sum())
    assert gradient == pytest.approx(case.difference(name, step), rel=ACCURACY)


@pytest.mark.parametrize("options", [EXACT, BDF2], ids=["euler", "bdf2"])
@pytest.mark.parametrize(("name", "step"), [("q_driven", 0.001), ("youngs_modulus", None)])
def test_gradient_with_driven_functions(name, step, options):
    """The same for a body whose top is held exactly: by the path of the driven functions and E."""
    case = hanging(body=held_cube, options=options)
    gradients = case.gradients()
    if step is None:
        assert gradients[name][0] == pytest.approx(case.parameter_difference(name), rel=ACCURACY)
        return
    assert not gradients["q_driven"][:, case.body.driven_count :].any()
    gradient = float((gradients[name] * case.path[name]).sum())
    assert gradient == pytest.approx(case.difference(name, step), rel=ACCURACY)


def test_gradient_by_point_forces():
    """Markers turn dL/d(generalised force) into dL/d(particle_f), which a state keeps in float32."""
    case = hanging()
    samples = Markers(case.scene.reduced, case.body.surface.points)
    by_particle = samples.interpolate(case.gradients()["force"])
    gradient = float((by_particle * case.path["particle_force"]).sum())
    assert gradient == pytest.approx(case.difference("particle_force", 0.25), rel=100 * FLOAT32)


def test_gradient_by_gravity():
    """Gravity acts as m g mean_basis on each function, so dL/dg follows from dL/df, to rounding."""
    case = hanging()
    gradients = case.gradients()
    expected = case.scene.mass() * np.einsum("k,tkc->c", case.body.mean_basis, gradients["force"])
    np.testing.assert_allclose(gradients["gravity"][0], expected, rtol=1e-12)


def test_gradient_by_pin_stiffness():
    """DL/dk of all pins together agrees with central differences."""
    case = hanging()
    array = case.scene.model.softmode.pin_stiffness
    before, losses, x = array.numpy().copy(), [], []
    for factor in (0.998, 0.999, 1.0, 1.001, 1.002):
        array.assign(before * np.float32(factor))
        case.scene.solver.notify_model_changed(0)
        x.append((float(array.numpy()[0]) / float(before[0]) - 1.0) * 1e3)
        losses.append(case.run())
    array.assign(before)
    case.scene.solver.notify_model_changed(0)
    slope = np.polynomial.polynomial.polyfit(x, losses, 4)[1] * 1e3
    assert float(case.gradients()["pin_stiffness"] @ before) == pytest.approx(slope, rel=ACCURACY)


def test_field_of_moduli():
    """DL/d(ln E_p) sums to E dL/dE and predicts what stiffening half of the body does."""
    case = hanging()
    gradients = case.gradients()
    field = gradients["log_modulus"][0]
    assert field.sum() == pytest.approx(MATERIAL.youngs_modulus * gradients["youngs_modulus"][0], rel=1e-6)
    array = case.scene.reduced.view.basis.stiffness_scale
    half, losses, h = case.body.cubature.points[:, 0] > 0.0, [], 2.0**-9
    for factor in (-1.0, 1.0):
        array.assign(np.where(half, 1.0 + factor * h, 1.0).astype(np.float32))
        losses.append(case.run())
    array.fill_(1.0)
    # (1 + h) - (1 - h) is 2 atanh(h) in ln E; the difference itself is of second order
    slope = (losses[1] - losses[0]) / (2.0 * np.arctanh(h))
    assert field[half].sum() == pytest.approx(slope, rel=10 * h**2)


def test_field_of_ratios():
    """DL/dE and dL/dnu predict what a change does to a body whose lambda / mu varies."""
    case = hanging()
    ratio = case.scene.reduced.view.basis.lame_ratio
    ratio.assign(np.where(case.body.cubature.points[:, 0] > 0.0, 3.0, 0.3))
    gradients = case.gradients()
    found = {name: gradients[name][0] for name in ("youngs_modulus", "poissons_ratio")}
    expected = {name: case.parameter_difference(name) for name in found}
    ratio.fill_(1.0)
    assert found == pytest.approx(expected, rel=ACCURACY)


def test_marker_loss():
    """The loss of tracked points: Markers.spread is the transpose of Markers.positions."""
    case, rng = hanging(), np.random.default_rng(3)
    markers = Markers(case.scene.reduced, case.body.surface.points[::10])
    case.run()
    q, weight = case.adjoint.q.numpy(), rng.normal(size=(STEPS + 1, len(markers.points), 3))
    x, delta = markers.positions(q), rng.normal(size=q.shape)
    np.testing.assert_allclose(x[0], markers.points, atol=1e-12)
    assert (markers.spread(weight) * delta).sum() == pytest.approx(
        (weight * markers.interpolate(delta)).sum(), rel=1e-12
    )


# -- worlds ------------------------------------------------------------------------------------------------------------


def test_batched_equals_single():
    """World i of 3, each with its own E, nu and rho, has the gradients of the single world, bit for bit."""
    own = {
        "youngs_modulus": [2.0e4, 4.0e4, 8.0e4],
        "poissons_ratio": [0.3, 0.4, 0.45],
        "density": [300.0, 500.0, 900.0],
    }
    batch = Rollout(world_count=3)
    for name, values in own.items():
        batch.scene.set_parameter(name, values)
    batched = batch.gradients()
    single, n = hanging(), cube().function_count
    try:
        for world in range(3):
            for name, values in own.items():
                single.scene.set_parameter(name, values[world])
            alone = single.gradients()
            for name in (*PARAMETERS, "gravity", "log_modulus"):
                np.testing.assert_array_equal(batched[name][world], alone[name][0], err_msg=name)
            np.testing.assert_array_equal(batched["qd"][n * world : n * (world + 1)], alone["qd"])
    finally:
        for name in own:
            single.scene.set_parameter(name, getattr(MATERIAL, name))
    assert len(set(batched["youngs_modulus"])) == 3


@pytest.mark.gpu
def test_cuda_agrees_with_cpu():
    """The same rollout on a GPU: both solve to rounding, so the gradients agree to the accuracy asked for."""
    results = []
    for device in ("cpu", "cuda:0"):
        with wp.ScopedDevice(device):
            results.append(gradients_on(device))
    for name in ("youngs_modulus", "poissons_ratio", "density", "qd", "pin_target"):
        scale = np.abs(results[0][name]).max()
        np.testing.assert_allclose(results[1][name], results[0][name], atol=ACCURACY * scale, err_msg=name)


def gradients_on(device):
    """Return the gradients of the sum of all coordinates of two hanging cubes."""
    import newton

    from softmode.deformables.model.authoring import register_custom_attributes
    from softmode.deformables.solver.solver_reduced import SolverReduced

    world, builder = newton.ModelBuilder(), newton.ModelBuilder()
    index = add_reduced_body(world, cube(), material=MATERIAL, angular_velocity=(4.0, -6.0, 3.0))
    add_pins(world, index, cube().cubature.points[cube().cubature.points[:, 2] > 0.03], stiffness=20.0)
    register_custom_attributes(builder)
    builder.replicate(world, 2)
    model = builder.finalize(device=device)
    adjoint = AdjointReduced(SolverReduced(model, [cube()], options=EXACT), STEPS)
    state, after, control = model.state(), model.state(), model.control()
    adjoint.start(state)
    for _ in range(STEPS):
        adjoint.step(state, after, control, DT)
        state, after = after, state
    return adjoint.backward(loss_q=np.ones((STEPS + 1, adjoint.total, 3))).numpy()


# -- contact -----------------------------------------------------------------------------------------------------------


def test_gradient_through_sliding_contact():
    """A cube sliding on the ground: dL/d(v_0) and dL/d(friction) agree with central differences to 1e-4.

    A plane has one normal, so the linearisation is exact; but the friction law's force has a kink where slip begins,
    and the differences may cross it.
    """
    body, steps, dt = cube(), 15, 0.004
    material = Material(youngs_modulus=1.0e5, viscosity=0.01, friction=0.3)

    def populate(world):
        add_reduced_body(
            world,
            body,
            material=material,
            position=(0.0, 0.0, 0.0498),
            velocity=(1.0, 0.3, 0.0),
            contact_stiffness_per_area=3.0e6,
        )

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), ground=0.3, options=EXACT, dt=dt)
    adjoint = AdjointReduced(scene.reduced, steps)
    rng = np.random.default_rng(0)
    q, qd = scene.q(), scene.qd()
    weight, direction = rng.normal(size=(2, *q.shape))

    def run(change=0.0):
        scene.restart()
        scene.set(q=q, qd=qd + change * direction)
        adjoint.start(scene.state)
        for _ in range(steps):
            adjoint.step(scene.state, scene.next_state, scene.control, dt)
            scene.state, scene.next_state = scene.next_state, scene.state
        return float((weight * adjoint.q.numpy()[-1]).sum())

    def central(at, h):
        return (at(h) - at(-h)) / (2.0 * h)

    def rub(change):
        scene.set_parameter("friction", material.friction + change)
        return run()

    loss = np.zeros((steps + 1, *q.shape))
    loss[-1] = weight
    run()
    assert scene.reduced.view.constraints.count.numpy()[0] > 0
    gradients = adjoint.backward(loss_q=loss).numpy()
    assert float((gradients["qd"] * direction).sum()) == pytest.approx(central(run, 1e-4), rel=1e-4)
    assert gradients["friction"][0] == pytest.approx(central(rub, 2.0**-10), rel=1e-3)


# -- the record and its refusals ---------------------------------------------------------------------------------------


def test_record_after_the_solver_step():
    """solver.step followed by record is the same as step."""
    case = hanging()
    loss = case.run()
    scene, adjoint, q = case.scene, case.adjoint, case.adjoint.q.numpy()
    scene.restart()
    adjoint.start(scene.state)
    for t in range(STEPS):
        scene.solver.step(scene.state, scene.next_state, scene.control, None, case.dt(t))
        adjoint.record(scene.next_state, case.dt(t))
        scene.state, scene.next_state = scene.next_state, scene.state
    np.testing.assert_array_equal(adjoint.q.numpy(), q)
    again = case.backward()
    assert case.run() == loss
    np.testing.assert_array_equal(case.backward()["youngs_modulus"], again["youngs_modulus"])


def test_short_cycles_give_the_same():
    """GMRES restarted after every two vectors reaches the same solution."""
    full, short = hanging().gradients(), Rollout(cycle_length=2, cycle_max=20).gradients()
    for name in PARAMETERS:
        np.testing.assert_allclose(short[name], full[name], rtol=1e-8)


def test_reports_steps_that_did_not_converge():
    """A solver that stops early is reported by its residual, above the limits by a warning and an error."""
    loose = SolverReducedOptions(iteration_max=1)
    case = Rollout(options=loose, residual_max=np.inf)
    with pytest.warns(RuntimeWarning, match="residual"):
        found = case.gradients()["grad_residual"].max()
    assert found > 1e-3
    strict = Rollout(options=loose, residual_max=0.5 * found)
    strict.run()
    with pytest.raises(SolverDiverged, match="residual"):
        strict.backward()
    assert hanging().gradients()["grad_residual"].max() < 1e-10


def test_refuses_what_it_cannot_do():
    """More steps than there is room for, no steps, a wrong shape, rigid unknowns: each has its error."""
    case = hanging()
    case.run()
    with pytest.raises(ConfigError, match="step_max"):
        case.adjoint.record(case.scene.state, DT)
    with pytest.raises(ConfigError, match="loss_q"):
        case.adjoint.backward(loss_q=np.zeros((STEPS, 2, 3)))
    case.adjoint.start(case.scene.state)
    with pytest.raises(ConfigError, match="no step"):
        case.adjoint.backward()
    with pytest.raises(ConfigError, match="tolerance"):
        AdjointOptions(tolerance=-1.0)

    def populate(world):
        add_reduced_body(world, cube())

    scene = Scene(populate, [cube()])
    joints = RigidDofs(scene.model, 1, np.ones(1, int), np.zeros(1, int))
    with pytest.raises(ConfigError, match="joint dofs"):
        AdjointReduced(SolverReduced(scene.model, scene.bodies, rigid=joints), 1)


# -- PyTorch -----------------------------------------------------------------------------------------------------------


def test_torch_rollout():
    """Backward through the PyTorch function gives the adjoint's gradients, also through what follows it."""
    torch = pytest.importorskip("torch")
    case = hanging()
    model = case.scene.model
    case.scene.restart()
    inputs = {
        "youngs_modulus": torch.tensor(model.softmode.youngs_modulus.numpy(), dtype=torch.float64),
        "qd": torch.tensor(case.scene.state.softmode.qd.numpy()),
        "pin_target": torch.tensor(np.tile(case.target, (STEPS, 1, 1))),
        "force": torch.zeros((STEPS, case.adjoint.total, 3), dtype=torch.float64),
    }
    for tensor in inputs.values():
        tensor.requires_grad_()
    q, qd = rollout(case.adjoint, STEPS, DT, **inputs)
    (0.5 * (q**2).sum() + qd.sum()).backward()
    expected = case.adjoint.backward(loss_q=case.adjoint.q.numpy(), loss_qd=np.ones(tuple(qd.shape))).numpy()
    for name, tensor in inputs.items():
        np.testing.assert_array_equal(tensor.grad.numpy(), expected[name], err_msg=name)
    first, _ = rollout(case.adjoint, STEPS, DT, **inputs)
    rollout(case.adjoint, STEPS, DT)
    with pytest.raises(ConfigError, match="another rollout"):
        first.sum().backward()
    with pytest.raises(ConfigError, match="mass"):
        rollout(case.adjoint, STEPS, DT, mass=inputs["qd"])


def test_contact_of_soft_bodies_is_refused():
    """Two bodies of one world may touch, which has no derivative: the message names the option."""
    body = cube()

    def populate(world):
        add_reduced_body(world, body)
        add_reduced_body(world, body, position=(0.0, 0.0, 1.0))

    with pytest.raises(ConfigError, match="soft_contact"):
        AdjointReduced(Scene(populate, [body]).reduced, 1)
    AdjointReduced(Scene(populate, [body], options=SolverReducedOptions(soft_contact=False)).reduced, 1)
