"""Gradients through contact: against central differences, by everything that a contact follows, and what is refused."""

import dataclasses
import functools
import itertools

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.gradients.adjoint import AdjointOptions, AdjointReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.namespaces import soft
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.errors import ConfigError, SolverDiverged
from tests.bodies import cube, default_cube, smooth_ball
from tests.scenes import GRAVITY, Scene

EXACT = SolverReducedOptions(tolerance=1.0e-12, force_tolerance=1.0e-12, iteration_max=100, friction_lag=100)
"""Solved to rounding, the normal force of friction too: central differences divide what is left by their step."""
SMOOTHED = dataclasses.replace(EXACT, stick_ratio=0.0)
STEPS, DT = 12, 0.004
SPIN = 20.0
"""Of the turntable [rad/s]."""


class Landing:
    """A cube that lands askew on the ground or on a turntable, and a loss of where it ends up.

    Args:
        youngs_modulus: E of every world [Pa].
        friction: Of the cube and of what it lands on.
        options: How the steps are solved.
        turntable: Half width in x and y of a box that turns, on which it lands instead of on the ground; None for none.
        below: How a box is turned whose edge or corner it lands on, which is in it by 2 mm then; None for no such box.
        height: Of its centre at the start [m].
        stiffness: Contact stiffness per area [Pa/m]; None for the one that follows the body.
        body: What lands, 5 cm from its centre; None for the cube.
    """

    def __init__(
        self,
        *youngs_modulus: float,
        friction: float = 0.0,
        options: SolverReducedOptions = EXACT,
        turntable: tuple[float, float] | None = None,
        below: Rotation | None = None,
        height: float = 0.0505,
        stiffness: float | None = None,
        body: ReducedBody | None = None,
    ) -> None:
        """Build the scene and random weights of the loss."""
        self.friction, self.least = friction, 10 if body is None else 3
        body, worlds = body or cube(), len(youngs_modulus)

        def populate(world: newton.ModelBuilder) -> None:
            material = Material(viscosity=0.005, density=500.0, friction=friction)
            add_reduced_body(
                world,
                body,
                material=material,
                position=(0.0, 0.0, height),
                velocity=(0.3, 0.1, -1.0 if below is None else -0.6),
                angular_velocity=(2.0, 1.0, 0.5),
                contact_stiffness_per_area=stiffness,
            )
            if below is not None:
                corners = 0.1 * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
                top = height - 0.05 + 0.002 - below.apply(corners)[:, 2].max()
                frame = wp.transform(wp.vec3(0.002, 0.001, top), wp.quat(*map(float, below.as_quat())))
                config = newton.ModelBuilder.ShapeConfig(mu=friction)
                world.add_shape_box(-1, xform=frame, hx=0.1, hy=0.1, hz=0.1, cfg=config)
            if turntable:
                table = world.add_body(
                    xform=wp.transform(wp.vec3(0.02, 0.0, -0.05), wp.quat_identity()), is_kinematic=True
                )
                config = newton.ModelBuilder.ShapeConfig(mu=friction)
                world.add_shape_box(table, hx=turntable[0], hy=turntable[1], hz=0.05, cfg=config)

        self.scene = Scene(
            populate,
            [body],
            world_count=worlds,
            gravity=(0.0, 0.0, -GRAVITY),
            ground=None if turntable or below is not None else friction,
            options=options,
            dt=DT,
        )
        self.scene.set_parameter("youngs_modulus", youngs_modulus)
        options = AdjointOptions(fixed_normals=below is not None)
        self.adjoint = AdjointReduced(self.scene.reduced, STEPS, options=options)
        rng, n = np.random.default_rng(0), body.function_count
        self.weight = np.zeros((STEPS + 1, n * worlds, 3))
        self.weight[-1] = np.tile(rng.normal(size=(n, 3)), (worlds, 1))
        self.path = {name: size * rng.normal(size=(n, 3)) for name, size in (("q", 1.0e-3), ("qd", 1.0))}
        self.turntable = turntable

    def run(self, **change: float) -> float:
        """Return the loss after moving the initial state along random paths."""
        scene = self.scene
        scene.restart()
        for name, amount in change.items():
            array = getattr(scene.state.softmode, name)
            array.assign(array.numpy() + amount * np.tile(self.path[name], (scene.reduced.world_count, 1)))
        self.adjoint.start(scene.state)
        for t in range(STEPS):
            if self.turntable:
                pose = wp.transform(wp.vec3(0.02, 0.0, -0.05), wp.quat_rpy(0.0, 0.0, SPIN * t * DT))
                scene.state.body_q.fill_(pose)
                scene.state.body_qd.fill_(wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, SPIN))
            self.adjoint.step(scene.state, scene.next_state, scene.control, DT)
            scene.state, scene.next_state = scene.next_state, scene.state
        return float((self.weight * self.adjoint.q.numpy()).sum())

    def gradients(self) -> dict[str, np.ndarray]:
        """Return the gradients of the unchanged run, which must touch something."""
        self.run()
        assert self.scene.reduced.view.constraints.count.numpy().min() > self.least
        return self.adjoint.backward(loss_q=self.weight).numpy()

    def difference(self, name: str, relative: float) -> float:
        """Return the central difference by a parameter, or along a path; the model stores float32, read back."""
        if name in self.path:
            return (self.run(**{name: relative}) - self.run(**{name: -relative})) / (2.0 * relative)
        array = getattr(self.scene.model.softmode, name)
        before, x, losses = float(array.numpy()[0]), [], []
        for factor in (1.0 - relative, 1.0 + relative):
            self.scene.set_parameter(name, before * factor)
            x.append(float(array.numpy()[0]))
            losses.append(self.run())
        self.scene.set_parameter(name, before)
        return (losses[1] - losses[0]) / (x[1] - x[0])

    def gradient(self, gradients: dict[str, np.ndarray], name: str) -> float:
        """Return what ``difference`` approximates."""
        return float((gradients[name] * self.path[name]).sum()) if name in self.path else float(gradients[name][0])


@functools.cache
def stiff_landing() -> Landing:
    """Return a landing whose contact stiffness follows E, built once."""
    return Landing(2.0e6)


@pytest.mark.parametrize("youngs_modulus", [1.0e4, 1.0e5, 2.0e6, 1.0e7])
def test_frictionless_contact(youngs_modulus: float) -> None:
    """DL/d(E, nu, rho, scale, v_0) within 1e-3 of differences at the default contact stiffness.

    It follows the mass for E up to 1e5 here, and E and nu for the two others. Over steps of 1e-3 a contact may come or
    go between the two runs. So the step of v_0 is smaller: at 1e4 Pa the difference itself is off by 1e-3 at 3e-4, by
    4e-4 at 1.5e-4 and by 1e-6 at 1e-5. By E and rho it is off by 1e-2 at 1e-4 and
    above of 1e5 Pa, as a contact comes, and by 3e-4 at 3e-5.
    """
    case = stiff_landing() if youngs_modulus == 2.0e6 else Landing(youngs_modulus)
    gradients = case.gradients()
    for name in ("youngs_modulus", "poissons_ratio", "density", "scale", "qd"):
        found = case.gradient(gradients, name)
        leaps = youngs_modulus == 1.0e5 and name in ("youngs_modulus", "density")
        step = 3.0e-5 if leaps else 1.0e-4 if name == "qd" else 3.0e-4
        assert found == pytest.approx(case.difference(name, step), rel=1.0e-3), name
    assert gradients["grad_residual"].max() < 1.0e-10


def test_given_contact_stiffness() -> None:
    """The same of a stiffness that is given, which still grows with the samples' area: dL/d(E, rho, scale)."""
    case = Landing(2.0e6, stiffness=3.0e8)
    gradients = case.gradients()
    for name in ("youngs_modulus", "density", "scale"):
        assert case.gradient(gradients, name) == pytest.approx(case.difference(name, 1.0e-3), rel=1.0e-3), name


def test_scale_of_a_body_that_is_placed_anew() -> None:
    """DL/ds of a run that ``reset`` begins: the gradient at the same state and what reset moves, linear in s."""
    case, s = stiff_landing(), 1.0e-3
    scene, gradients = case.scene, case.gradients()
    start = {name: getattr(scene.model.softmode, name) for name in ("q", "qd")}
    before = {name: array.numpy().copy() for name, array in start.items()}
    placed, losses = [], []
    try:
        for scale in (1.0 - s, 1.0 + s):
            scene.set_parameter("scale", scale)
            state = scene.model.state()
            scene.reduced.reset(state)
            placed.append({name: getattr(state.softmode, name).numpy() for name in start})
            for name, array in start.items():
                array.assign(placed[-1][name])
            losses.append(case.run())
            for name, array in start.items():
                array.assign(before[name])
    finally:
        scene.set_parameter("scale", 1.0)
    moved = sum(float((gradients[name] * (placed[1][name] - placed[0][name])).sum()) for name in start) / (2.0 * s)
    assert gradients["scale"][0] + moved == pytest.approx((losses[1] - losses[0]) / (2.0 * s), rel=1.0e-3)


@pytest.mark.parametrize("options", [EXACT, SMOOTHED], ids=["remembers", "smoothed"])
def test_frictional_contact(options: SolverReducedOptions) -> None:
    """DL/d(E, nu, rho, mu, v_0, q_0) within 1e-2 of differences, samples sticking, sliding and leaving.

    The steps are small: the force has a kink where a sample begins to slide, and a difference may cross it. By friction
    it is off by 1.5e-2 at 1e-3, by 4e-5 at 5e-4 and by 2e-6 at 3e-4.
    """
    case = Landing(1.0e5, friction=0.8, options=options)
    gradients = case.gradients()
    steps = {"youngs_modulus": 1e-3, "poissons_ratio": 1e-4, "density": 1e-3, "friction": 3e-4, "qd": 1e-5, "q": 1e-5}
    for name, relative in steps.items():
        assert case.gradient(gradients, name) == pytest.approx(case.difference(name, relative), rel=1.0e-2), name
    assert gradients["grad_residual"].max() < 1.0e-10
    if options is EXACT:
        constraints = case.scene.reduced.view.constraints
        count = constraints.count.numpy()[0]
        force, slip = (getattr(constraints, name).numpy()[0, :count] for name in ("force", "slip"))
        sticks = np.isclose(np.linalg.norm(force[:, :2], axis=1), force[:, 2] * 0.8, rtol=1e-3)
        assert slip.any() and 0 < sticks.sum() < count


def test_ball_that_rolls() -> None:
    """A ball lands and rolls: its cells' ranges, centres of pressure and neighbourhoods follow the state in every step.

    Held constant they give 1.6 of dL/drho. Within 1e-2 of differences. By E the loss nearly cancels, a five hundredth
    of that by nu, and the step is small, since a difference may cross kinks: there within 1e-12, 7 % of it.
    """
    case = Landing(1.0e5, friction=0.8, body=smooth_ball(8, 400))
    gradients = case.gradients()
    steps = {
        "youngs_modulus": 3e-4,
        "poissons_ratio": 1e-4,
        "density": 1e-4,
        "scale": 1e-4,
        "friction": 1e-3,
        "qd": 1e-5,
    }
    for name, relative in steps.items():
        expected = pytest.approx(case.difference(name, relative), rel=1.0e-2, abs=1.0e-12)
        assert case.gradient(gradients, name) == expected, name


def test_friction_on_a_turntable() -> None:
    """What sticks to a shape that turns is remembered in the shape's frame: dL/d(q_0) within 2e-2.

    The gap is a float32 in the box's frame, 4e-9 m here, which smaller differences drown in; over twice this step a
    cell becomes level, and the loss leaps by 4e-5. Along other paths it was off by 2e-3 to 3e-2.
    """
    case = Landing(1.0e5, friction=0.8, turntable=(0.3, 0.3))
    case.path["q"] = 1.0e-3 * np.random.default_rng(10).normal(size=case.path["q"].shape)
    gradients = case.gradients()
    assert case.gradient(gradients, "q") == pytest.approx(case.difference("q", 1.0e-4), rel=2.0e-2)


@pytest.mark.parametrize("kind", ["edge", pytest.param("corner", marks=pytest.mark.rest)])
def test_edges(kind: str) -> None:
    """On an edge and a corner of a box that press by their own springs: dL/d(E, rho, v_0) within 5e-3, by nu 1e-2.

    How long and deep an edge is in a cell, and how it turns the normal, follow the state at the start of each step:
    held constant they gave .8 of dL/dE. At 45 degrees the law has a kink. Gaps are float32: over smaller steps
    differences by E and nu are off by 1e-2, by friction at any step. Of a single step all agree to 3e-4.
    """
    turn = Rotation.from_euler("y", 38.0, degrees=True)
    if kind == "corner":
        turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [[1.0, 0.8, 0.9]])[0]
    case = Landing(1.0e5, friction=0.3, body=default_cube(), below=turn)
    gradients = case.gradients()
    constraints = case.scene.reduced.view.constraints
    edges = constraints.ridge.numpy()[0] * np.linalg.norm(constraints.force.numpy()[0], axis=1)
    assert np.count_nonzero(edges[: constraints.count.numpy()[0]]) > 5
    for name in ("youngs_modulus", "poissons_ratio", "density", "qd"):
        expected = case.difference(name, 1.0e-4 if name == "qd" else 1.0e-3)
        error = 1.0e-2 if name == "poissons_ratio" else 5.0e-3
        assert case.gradient(gradients, name) == pytest.approx(expected, rel=error), name


def test_cells_at_a_rim() -> None:
    """On a box smaller than the face above it, cells are cut at its rim: parts and their middles follow the state.

    Within 1e-2 of differences; with what neighbours count of these parts left out, dL/dv_0 is 1.10 of that and dL/dnu
    0.93. Differences over smaller steps leap by 0.1, as gaps are float32.
    """
    case = Landing(1.0e5, friction=0.8, turntable=(0.0335, 0.0405))
    case.turntable = None
    gradients = case.gradients()
    part = case.scene.reduced.view.samples.part.numpy()
    assert ((part > 0.0) & (part < 1.0)).sum() > 3
    for name, relative in {
        "q": 1e-4,
        "qd": 1e-3,
        "youngs_modulus": 1e-3,
        "density": 1e-3,
        "poissons_ratio": 1e-3,
        "friction": 1e-3,
    }.items():
        assert case.gradient(gradients, name) == pytest.approx(case.difference(name, relative), rel=1.0e-2), name


def test_worlds_in_contact_are_independent() -> None:
    """World i of 2 that land with other E has the gradients of the single world, bit for bit."""
    batch = Landing(1.0e5, 2.0e6, friction=0.8).gradients()
    for world, modulus in enumerate((1.0e5, 2.0e6)):
        single = Landing(modulus, friction=0.8).gradients()
        for name in ("youngs_modulus", "poissons_ratio", "density", "friction", "scale"):
            np.testing.assert_array_equal(batch[name][world], single[name][0], err_msg=name)


def test_frozen_normal_force_is_named() -> None:
    """A frictional landing that freezes the normal force after two iterations is refused, and the error says so."""
    case = Landing(1.0e5, friction=0.8, options=dataclasses.replace(EXACT, friction_lag=2))
    case.adjoint = AdjointReduced(
        case.scene.reduced, STEPS, options=AdjointOptions(residual_warning=1.0e-9, residual_max=1.0e-9)
    )
    case.run()
    with pytest.raises(SolverDiverged, match=r"friction_lag = 2 of \d+ iterations: raise it to iteration_max"):
        case.adjoint.backward(loss_q=case.weight)


def land(shape: str, youngs_modulus: float = 1.0e6, **options: bool) -> tuple[AdjointReduced, np.ndarray]:
    """Return the record of a step of a cube that is in a shape, and where it then is."""
    edge = shape == "edge"
    body = default_cube() if edge else cube()

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=youngs_modulus, friction=0.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.047))
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.25 * np.pi if edge else 0.0)
        below = wp.transform(wp.vec3(0.002, 0.0, -0.2 * (2.0**0.5 if edge else 1.0)), turn)
        if shape == "sphere":
            world.add_shape_sphere(-1, xform=below, radius=0.2)
        else:
            world.add_shape_box(-1, xform=below, hx=0.2, hy=0.2, hz=0.2)

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), options=EXACT)
    exact = AdjointOptions(residual_warning=1.0e-9, residual_max=1.0e-9, **options)
    adjoint = AdjointReduced(scene.reduced, 1, options=exact)
    adjoint.start(scene.state)
    adjoint.step(scene.state, scene.next_state, None, DT)
    assert scene.reduced.instance_force.numpy()[0, 2] > 0.0
    return adjoint, soft(scene.next_state).q.numpy()


def test_a_normal_that_turns_is_refused() -> None:
    """On a sphere or an edge the normal turns: refused unless it is taken for fixed. On the face of a box it does not.

    What the edge of a box presses is restored as it was, centres of pressure too: the recorded step is at its root.
    And it follows E, by differences, where the penalty of the faces has its floor and does not.
    """

    def gradients(shape: str, modulus: float = 1.0e6, **options: bool) -> dict[str, np.ndarray]:
        adjoint, _ = land(shape, modulus, **options)
        weight = np.ones((2, adjoint.total, 3)) * np.array([0.0, 1.0])[:, None, None]
        return adjoint.backward(loss_q=weight).numpy()

    gradients("box")
    for shape in ("sphere", "edge"):
        with pytest.raises(ConfigError, match="fixed_normals=True"):
            gradients(shape)
    gradients("sphere", fixed_normals=True)
    modulus, step = 2.0e4, 1.0e-3
    ends = [land("edge", modulus * (1.0 + side))[1].sum() for side in (-step, step)]
    found = modulus * gradients("edge", modulus, fixed_normals=True)["youngs_modulus"]
    assert found == pytest.approx((ends[1] - ends[0]) / (2.0 * step), rel=1.0e-3)


def test_deep_overlap_is_refused() -> None:
    """What starts deeper than a twentieth of the body's size is pushed out by a rule without derivative."""
    case = Landing(1.0e5, height=0.03)
    case.run()
    with pytest.raises(SolverDiverged, match=r"deeper than 0\.05.*Place bodies apart"):
        case.adjoint.backward(loss_q=case.weight)
    with pytest.raises(ConfigError, match="friction_lag"):
        Landing(1.0e5, options=dataclasses.replace(EXACT, friction_lag=0))
