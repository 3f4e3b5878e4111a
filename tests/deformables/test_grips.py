"""Grips: momentum, statics against a constant force, release, rotation, other worlds, captured graphs, errors."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.deformables.tools.grips import Grips, add_grip_slots
from softmode.deformables.tools.parameters import set_parameters
from softmode.errors import ConfigError
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene, add_free_box, rotation

DOWN = (0.0, 0.0, -GRAVITY)
EDGE = 0.1
SLOTS = 20
LOSSLESS = Material(youngs_modulus=1.0e5, density=500.0, viscosity=0.0, mass_damping=0.0)
TIGHT = SolverReducedOptions(tolerance=1.0e-9)
DAMPED = Material(youngs_modulus=1.0e5, density=500.0, viscosity=0.02, mass_damping=20.0)


class GripScene(Scene):
    """A soft cube with slots for grips, far from anything."""

    def __init__(self, *, material=LOSSLESS, slots=SLOTS, coupled=False, **kw):
        body = cube()

        def populate(world):
            if coupled:
                add_free_box(world, (0.05, 0.05, 0.02), 0.5, (0.0, 0.0, 3.0))
            instance = add_reduced_body(
                world, body, material=material, position=(0.1, 0.2, 1.0), rotation=rotation((1, 2, 3), 0.4)
            )
            if slots:
                add_grip_slots(world, instance, slots)

        super().__init__(populate, [body], coupled=coupled, **kw)
        count = self.reduced.instance_count
        self.grips = [Grips(self.solver, i, slot_count=slots) for i in range(count if slots else 0)]

    def step(self, count=1):
        """Take steps with the grips."""
        for _ in range(count):
            for grips in self.grips:
                grips.apply(self.state, self.control, self.dt)
            super().step()

    def points(self, side, count=6):
        """Return rest points of the surface on one side of the cube along z."""
        X = cube().surface.points
        return X[np.argsort(-side * X[:, 2])[:count]]


@pytest.mark.parametrize("coupled", [False, True])
def test_a_pull_adds_its_force_times_dt_to_the_momentum(coupled):
    """A free body pulled at a point gains dt (f + m g): to 2e-6 of dt |f|, the rounding of float32 rows."""
    scene = GripScene(coupled=coupled, gravity=DOWN, options=TIGHT)
    grips = scene.grips[0]
    number = grips.take(cube().surface.points[3:4], scene.state, pulls=True)
    grips.aim(number, grips.pose(number)[0] + np.array([0.03, -0.02, 0.05]))
    weight = scene.mass() * np.array(DOWN)
    for _ in range(20):
        before = scene.momentum()[0]
        scene.step()
        force = grips.force(number)
        assert np.linalg.norm(force) > 0.1
        change = scene.momentum()[0] - before
        np.testing.assert_allclose(change, scene.dt * (force + weight), atol=2e-6 * scene.dt * np.linalg.norm(force))


def test_a_pull_is_a_spring_and_moves_what_a_constant_force_does():
    """At rest the force is k (t - x), and displaces the held cube as the same constant force on that sample does."""
    scene = GripScene(material=DAMPED, dt=0.02)
    grips, sample = scene.grips[0], int(np.argmax(cube().surface.points[:, 2]))
    grips.take(scene.points(-1, 12), scene.state)
    pull = grips.take(cube().surface.points[sample : sample + 1], scene.state, pulls=True)
    start = grips.points(pull, scene.state)[0]
    goal = start + np.array([0.01, 0.0, 0.005])
    grips.aim(pull, goal)
    scene.step(250)
    force, moved = grips.force(pull), grips.points(pull, scene.state)[0]
    size, mass = float(scene.reduced.view.instances.size.numpy()[0]), scene.mass()
    k = min(0.25 * 1.0e5 * size, mass * 250.0**2)
    np.testing.assert_allclose(force, k * (goal - moved), rtol=1e-5, atol=1e-5 * np.linalg.norm(force))
    assert np.linalg.norm(moved - start) > 1e-3

    other = GripScene(material=DAMPED, dt=0.02)
    other.grips[0].take(other.points(-1, 12), other.state)
    for _ in range(250):
        pushed = other.state.particle_f.numpy()
        pushed[sample] = force
        other.state.particle_f.assign(pushed)
        other.step()
    found = other.state.particle_q.numpy()[sample]
    np.testing.assert_allclose(found - start, moved - start, atol=1e-4 * np.linalg.norm(moved - start))


@pytest.mark.parametrize("youngs_modulus", [1.0e3, 1.0e5, 1.0e8])
def test_a_hold_carries_the_weight_and_keeps_its_shape(youngs_modulus):
    """Held by its top the cube hangs with the weight on the grip, whose points are within 1 % of the size."""
    material = Material(youngs_modulus=youngs_modulus, viscosity=0.02, mass_damping=20.0, density=500.0)
    scene = GripScene(gravity=DOWN, material=material, dt=0.02)
    grips = scene.grips[0]
    number = grips.take(scene.points(1), scene.state)
    scene.step(250)
    weight = scene.mass() * GRAVITY
    np.testing.assert_allclose(grips.force(number), [0.0, 0.0, weight], atol=1e-3 * weight)
    error = np.linalg.norm(grips.points(number, scene.state) - grips.targets(number), axis=1).max()
    assert error < 0.01 * np.sqrt(3.0) * EDGE


def test_a_hold_moves_and_turns_what_it_holds():
    """Moved and turned by a right angle over 100 steps, the held points keep their shape and the body follows."""
    scene = GripScene(material=DAMPED)
    grips = scene.grips[0]
    number = grips.take(scene.points(1, 12), scene.state)
    before, centre = grips.points(number, scene.state), grips.pose(number)[0]
    start = scene.centre()
    half = np.sqrt(0.5)
    grips.aim(number, centre + np.array([0.0, 0.1, 0.0]), (0.0, 0.0, half, half))
    grips.begin_frame(100)
    scene.step(50)
    np.testing.assert_allclose(grips.pose(number)[0], centre + np.array([0.0, 0.05, 0.0]), atol=1e-12)
    scene.step(450)
    turn = rotation((0, 0, 1), np.pi / 2)
    expected = centre + np.array([0.0, 0.1, 0.0]) + (before - centre) @ turn.T
    np.testing.assert_allclose(grips.targets(number), expected, atol=1e-12)
    size = np.sqrt(3.0) * EDGE
    np.testing.assert_allclose(grips.points(number, scene.state), expected, atol=1e-3 * size)
    np.testing.assert_allclose(
        scene.centre(), centre + np.array([0.0, 0.1, 0.0]) + turn @ (start - centre), atol=1e-2 * size
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_hold_turns_the_short_way(sign):
    """Half way to a right angle it has turned by half of that, whichever of q and -q says the goal."""
    scene = GripScene(material=DAMPED)
    grips = scene.grips[0]
    number = grips.take(scene.points(1, 12), scene.state)
    before, centre = grips.points(number, scene.state), grips.pose(number)[0]
    grips.aim(number, centre, tuple(sign * np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])))
    grips.begin_frame(4)
    scene.step(2)
    turn = rotation((0, 0, 1), np.pi / 4)
    np.testing.assert_allclose(grips.targets(number), centre + (before - centre) @ turn.T, atol=1e-12)


def test_let_go_leaves_nothing_behind():
    """After a grip has been let go, and with idle slots, a step is that of a scene without slots, bit by bit."""
    scene, plain = GripScene(gravity=DOWN), GripScene(gravity=DOWN, slots=0)
    grips = scene.grips[0]
    number = grips.take(scene.points(1), scene.state)
    pull = grips.take(cube().surface.points[:1], scene.state, pulls=True)
    grips.aim(pull, (0.3, 0.2, 1.1))
    scene.step(10)
    grips.let_go(number)
    scene.step(5)
    grips.let_go(pull)
    assert not grips.held
    plain.set(scene.q(), scene.qd())
    scene.state.softmode.dt_before.zero_()
    for _ in range(10):
        scene.step()
        plain.step()
        np.testing.assert_array_equal(scene.q(), plain.q())


def test_a_grip_in_one_world_leaves_the_others(tmp_path):
    """World 1 of three, gripped, is the single world that is gripped; worlds 0 and 2 fall as if alone, bit by bit."""
    many, single, alone = GripScene(gravity=DOWN, world_count=3), GripScene(gravity=DOWN), GripScene(gravity=DOWN)
    for scene, instance in ((many, 1), (single, 0)):
        scene.grips[instance].take(scene.points(1), scene.state)
    for scene in (many, single, alone):
        scene.step(20)
    np.testing.assert_array_equal(many.q(1), single.q())
    for world in (0, 2):
        np.testing.assert_array_equal(many.q(world), alone.q())


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
def test_a_captured_step_takes_grips_up(integrator):
    """Taking, moving and letting go between launches of one graph does what it does launch by launch."""
    results = []
    for captured in (False, True):
        scene = GripScene(gravity=DOWN, options=SolverReducedOptions(integrator=integrator))
        grips = scene.grips[0]
        run = lambda scene=scene: scene.step(2)  # noqa: E731
        if captured:
            with wp.ScopedCapture(device="cpu") as capture:
                for first, second in ((scene.state, scene.next_state), (scene.next_state, scene.state)):
                    grips.apply(first, scene.control, scene.dt)
                    scene.solver.step(first, second, scene.control, None, scene.dt)
            run = lambda capture=capture: wp.capture_launch(capture.graph)  # noqa: E731
            scene.solver.reset(scene.state)
        run()
        hold = grips.take(scene.points(1), scene.state)
        grips.begin_frame(6)
        grips.aim(hold, grips.pose(hold)[0] + np.array([0.01, 0.0, 0.0]))
        for _ in range(4):
            run()
        pull = grips.take(scene.points(-1, 1), scene.state, pulls=True)
        grips.aim(pull, grips.pose(pull)[0] + np.array([0.0, 0.02, 0.0]))
        grips.let_go(hold)
        for _ in range(4):
            run()
        results.append(scene.q())
    np.testing.assert_array_equal(results[0], results[1])


def test_an_idle_slot_does_not_hold_the_scale():
    """A body with idle slots may be given another size, one that is gripped may not."""
    scene = GripScene()
    size = wp.full(1, 1.2, dtype=float, device="cpu")
    flags = set_parameters(scene.solver, scale=size)
    assert flags.numpy()[0] == 0
    scene.reduced.reset(scene.state)
    number = scene.grips[0].take(scene.points(1), scene.state)
    X = scene.grips[0].points(number, scene.state)
    assert np.ptp(X, axis=0).max() > 1.1 * np.ptp(scene.points(1), axis=0).max() * 0.6
    size.fill_(1.0)
    assert set_parameters(scene.solver, scale=size).numpy()[0] == 32


def test_errors():
    """What cannot be held is refused, and nothing changes."""
    scene = GripScene(slots=8)
    grips = scene.grips[0]
    with pytest.raises(ConfigError, match="no room for a grip of 9 points"):
        grips.take(cube().surface.points[:9], scene.state)
    for wrong in ([[0.0, 0.0]], [[np.nan, 0.0, 0.0]], np.zeros((0, 3))):
        with pytest.raises(ConfigError, match="rest_points"):
            grips.take(wrong, scene.state)
    with pytest.raises(ConfigError, match="one for a pull"):
        grips.take(np.zeros((2, 3)), scene.state, pulls=True)
    for call in (grips.let_go, grips.pose, grips.force, lambda g: grips.aim(g, (0, 0, 0))):
        with pytest.raises(ConfigError, match="there is no grip 3"):
            call(3)
    assert not grips.held
    world = newton.ModelBuilder()
    instance = add_reduced_body(world, cube())
    add_grip_slots(world, instance, 2)
    add_pins(world, instance, cube().surface.points[:1], stiffness=1.0)
    with pytest.raises(ConfigError, match="no slots"):
        Grips(SolverReduced(world.finalize(device="cpu"), [cube()]), instance, slot_count=2)
    with pytest.raises(ConfigError, match="has 0 pins, not 9 slots"):
        Grips(GripScene(slots=0).solver, 0, slot_count=9)
