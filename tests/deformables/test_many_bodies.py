"""Several bodies per world and worlds that differ: each moves as it would alone, with parameters of its own."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body, drive_regions, register_custom_attributes
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from tests.bodies import ball, bar, clamped, cube
from tests.scenes import GRAVITY, Scene, rotation

DOWN = (0.0, 0.0, -GRAVITY)
FACE = np.array([[-0.2, y, z] for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
"""Corners of one end of the bar [m]."""
BDF2 = SolverReducedOptions(integrator="bdf2")


# Each world differs from the others in its bodies, their number, materials and pins.


def free_world(world):
    """Add a turning cube."""
    add_reduced_body(world, cube(), rotation=rotation((1, 1, 0), 0.4), angular_velocity=(0.0, 3.0, 1.0))


def held_world(world):
    """Add a clamped bar and, away from it, a ball."""
    add_reduced_body(world, clamped(), material=Material(youngs_modulus=4.0e4, poissons_ratio=0.45))
    material = Material(youngs_modulus=2.0e5, model=MaterialModel.COROTATED)
    add_reduced_body(world, ball(), material=material, position=(1.0, 0.0, 0.5), velocity=(0.3, 0.0, 0.0))


def pinned_world(world):
    """Add a pinned bar."""
    add_pins(world, add_reduced_body(world, bar(), material=Material(viscosity=0.01)), FACE, stiffness=2000.0)


WORLDS = (free_world, held_world, pinned_world)
INSTANCES = ((0,), (1, 2), (3,))
"""Instances of each world."""


def bodies():
    """Return every body of the worlds, in an order of its own."""
    return [bar(), ball(), clamped(), cube()]


class MixedScene(Scene):
    """A scene whose worlds differ.

    Args:
        worlds: What fills each world.
        merge: Build every world on a builder of its own and merge it, else add its bodies between ``begin_world`` and
            ``end_world``.
        gravity: Gravity [m/s^2].
        dt: Step [s].
        options: Solver options.
    """

    def __init__(self, worlds, *, merge=True, gravity=DOWN, dt=0.004, options=None):
        """Build model, solver and states."""
        builder = newton.ModelBuilder()
        register_custom_attributes(builder)
        for populate in worlds:
            if merge:
                world = newton.ModelBuilder()
                populate(world)
                builder.add_world(world)
            else:
                builder.begin_world()
                populate(builder)
                builder.end_world()
        self.bodies = bodies()
        self.dt = dt
        self.model = builder.finalize(device="cpu")
        self.model.set_gravity(gravity)
        self.solver = self.reduced = SolverReduced(self.model, self.bodies, options=options)
        self.control = self.model.control()
        self.restart()

    def motion(self, world):
        """Return q and qd of the instances of a world."""
        return [state for i in INSTANCES[world] for state in (self.q(i), self.qd(i))]


def assert_same_bits(first, second):
    """Compare two lists of arrays."""
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_bodies_differ():
    """The scenes below mix four function counts, sizes, numbers of points and of driven functions."""
    for name in ("function_count", "point_count", "surface_count", "driven_count"):
        assert len({getattr(body, name) for body in bodies()}) > 1
    assert len({body.function_count for body in bodies()}) == 4
    assert clamped().driven_count > 0


# -- several bodies in one world ---------------------------------------------------------------------------------------


def test_bodies_of_one_world_move_as_alone():
    """Held exactly, pinned and free bodies of one world that do not touch move as each alone, to the tolerance.

    Not to the bit: one line search and one stopping test serve all bodies of a world, so that those which converge
    early take further iterations.
    """

    def pinned(world):
        beside = np.array([0.0, 0.5, 0.0])
        instance = add_reduced_body(world, bar(), position=beside)
        add_pins(world, instance, FACE, stiffness=2000.0, targets=FACE + beside)

    def populate(world):
        add_reduced_body(world, clamped())
        pinned(world)
        add_reduced_body(world, cube(), position=(0.0, 1.0, 0.0), angular_velocity=(0.0, 0.0, 4.0))

    alone = [
        Scene(lambda world: add_reduced_body(world, clamped()), [clamped()], gravity=DOWN),
        Scene(pinned, [bar()], gravity=DOWN),
        Scene(
            lambda world: add_reduced_body(world, cube(), position=(0.0, 1.0, 0.0), angular_velocity=(0.0, 0.0, 4.0)),
            [cube()],
            gravity=DOWN,
        ),
    ]
    both = Scene(populate, [cube(), bar(), clamped()], gravity=DOWN)
    count = 10
    both.step(count)
    for i, scene in enumerate(alone):
        start = scene.q()
        scene.step(count)
        tolerance = count * both.reduced.view.instances.tolerance.numpy()[i]
        assert np.linalg.norm(both.q(i) - scene.q()) <= tolerance
        assert np.linalg.norm(both.q(i) - start) > 10 * tolerance  # a motion worth the name
    np.testing.assert_array_equal(both.q(0)[: clamped().driven_count], alone[0].q()[: clamped().driven_count])


def test_driving_one_body_leaves_the_others():
    """The driven functions of an instance are its own: moving one body's clamp moves no other body."""
    scenes = []
    for shift in (0.0, 0.05):
        scene = MixedScene(WORLDS)
        turn, t = rotation((1, 0, 0), 10 * shift)[None], np.array([[0.0, 0.0, shift]])
        drive_regions(scene.model, scene.control, 1, clamped(), turn, t)
        scene.step(5)
        scenes.append(scene)
    still, moved = scenes
    assert np.abs(moved.q(1) - still.q(1)).max() > 0.01
    # the free cube of the same world shares the line search
    assert np.linalg.norm(moved.q(2) - still.q(2)) <= 5 * still.reduced.view.instances.tolerance.numpy()[2]
    for world in (0, 2):
        assert_same_bits(moved.motion(world), still.motion(world))


# -- worlds that differ ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("merge", [True, False], ids=["add_world", "begin_world"])
@pytest.mark.parametrize("options", [None, BDF2], ids=["euler", "bdf2"])
def test_each_of_several_worlds_equals_itself_alone(merge, options):
    """World i of a model whose worlds hold different bodies equals a model of that world alone, bit for bit."""
    together = MixedScene(WORLDS, merge=merge, options=options)
    assert together.reduced.view.layout.instance_world.tolist() == [0, 1, 1, 2]
    together.step(10)
    for w, populate in enumerate(WORLDS):
        alone = MixedScene([populate], options=options)
        alone.step(10)
        motion = [state for i in range(alone.reduced.instance_count) for state in (alone.q(i), alone.qd(i))]
        assert_same_bits(together.motion(w), motion)
        assert together.reduced.iteration.numpy()[w] == alone.reduced.iteration.numpy()[0]
    assert not together.reduced.status.numpy().any()


def test_particles_of_worlds_that_differ():
    """Every instance's particles lie at x = X + sum_k b_k(X) q_k of its own body, in its own rows."""
    scene = MixedScene(WORLDS)
    scene.step(10)
    x = scene.state.particle_q.numpy()
    start = scene.reduced.view.instances.particle_start.numpy()
    assert len(x) == sum(scene.body(i).surface_count for i in range(4))
    for i in range(4):
        body = scene.body(i)
        expected = body.surface.points + body.surface.basis.astype(float) @ scene.q(i)
        np.testing.assert_allclose(x[start[i] : start[i] + body.surface_count], expected, atol=1e-6)


def test_captured_graph_of_worlds_that_differ():
    """A recorded graph gives the bits of kernel-by-kernel launches in every world."""
    scene = MixedScene(WORLDS)
    replay = scene.capture()
    for _ in range(5):
        replay()
    captured = [scene.motion(w) for w in range(3)]
    eager = MixedScene(WORLDS)
    eager.step(10)
    for w in range(3):
        assert_same_bits(captured[w], eager.motion(w))


@pytest.mark.parametrize("world", [0, 1, 2])
def test_reset_of_one_world_among_others_that_differ(world):
    """After a masked reset the world runs as from the start and the others as if nothing happened, bit for bit.

    With BDF2, so that the history of the world must go too.
    """
    scene = MixedScene(WORLDS, options=BDF2)
    scene.step(3)
    mask = np.arange(len(WORLDS) + 1) == world
    scene.solver.reset(scene.state, wp.array(mask, dtype=bool, device="cpu"))
    scene.step(4)
    undisturbed, fresh = (MixedScene(WORLDS, options=BDF2) for _ in range(2))
    undisturbed.step(7)
    fresh.step(4)
    for w in range(3):
        assert_same_bits(scene.motion(w), (fresh if w == world else undisturbed).motion(w))


# -- parameters per world ----------------------------------------------------------------------------------------------

CONTACT_STIFFNESS = 1.0e8
"""Contact stiffness per area [Pa/m], which otherwise follows the stiffness given at the build."""
PARAMETERS = {
    "youngs_modulus": (5.0e4, 1.0e5, 4.0e6),
    "poissons_ratio": (0.0, 0.3, 0.49),
    "density": (100.0, 300.0, 1500.0),
    "viscosity": (0.0, 0.002, 0.02),
    "mass_damping": (0.0, 1.0, 5.0),
    "friction": (0.0, 0.3, 1.2),
}
"""Values of the three worlds."""
GRAVITIES = ((0.0, 0.0, -1.6), DOWN, (0.8, 0.0, -24.8))
"""Gravity of the three worlds [m/s^2]."""


def sliding_cubes(materials, world_count):
    """Return worlds with one cube that slides over the ground."""

    def populate(world):
        add_reduced_body(
            world,
            cube(),
            material=materials,
            position=(0.0, 0.0, 0.0495),
            velocity=(0.5, 0.0, -0.1),
            contact_stiffness_per_area=CONTACT_STIFFNESS,
        )

    return Scene(populate, [cube()], world_count=world_count, gravity=DOWN, ground=0.5)


def set_gravities(scene, gravities):
    """Change the gravity of every world at run time."""
    scene.model.set_gravity(gravities if len(gravities) > 1 else gravities[0])
    scene.solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)


@pytest.mark.parametrize("captured", [False, True], ids=["eager", "captured"])
@pytest.mark.parametrize("name", [*PARAMETERS, "gravity", "all"])
def test_parameters_of_each_world(name, captured):
    """Parameters set per world after the build give each world the bits of a model built with them.

    The cubes slide over the ground. The graph is recorded before they are set.
    """
    names = [name] if name in PARAMETERS else list(PARAMETERS) if name == "all" else []
    gravities = GRAVITIES if name in ("gravity", "all") else (DOWN,) * 3
    batch = sliding_cubes(Material(), 3)
    replay = batch.capture() if captured else lambda: batch.step(2)
    for each in names:
        batch.set_parameter(each, PARAMETERS[each])
    if name in ("gravity", "all"):
        set_gravities(batch, gravities)
    for _ in range(5):
        replay()
    ends = []
    for w in range(3):
        alone = sliding_cubes(Material(**{each: PARAMETERS[each][w] for each in names}), 1)
        set_gravities(alone, gravities[w : w + 1])
        alone.step(10)
        assert_same_bits([batch.q(w), batch.qd(w)], [alone.q(), alone.qd()])
        ends.append(alone.q())
    for first, second in ((0, 1), (1, 2)):  # the parameter matters
        assert np.linalg.norm(ends[first] - ends[second]) > 1e-5 * np.linalg.norm(ends[first])


def test_gravity_of_one_world():
    """Gravity set for one world alone: it falls z = -g dt^2 N (N + 1) / 2, the others stay."""
    scene = Scene(lambda world: add_reduced_body(world, cube()), [cube()], world_count=3)
    scene.model.set_gravity((0.0, 0.0, -2.0), world=1)
    scene.step(20)
    fall = [scene.centre(i)[2] for i in range(3)]
    assert fall[1] == pytest.approx(-2.0 * scene.dt**2 * 20 * 21 / 2, rel=1e-9)
    assert fall[0] == fall[2] == 0.0


def test_pins_of_each_world():
    """Pin stiffness and targets set per world: each has the bits of a world built with them."""
    stiffness, lift = (500.0, 2000.0, 1.0e5), (0.0, 0.01, -0.02)

    def populate(world, k=1000.0):
        add_pins(world, add_reduced_body(world, bar()), FACE, stiffness=k)

    def lifted(w):
        return FACE + np.array([0.0, 0.0, lift[w]])

    batch = Scene(populate, [bar()], world_count=3, gravity=DOWN)
    batch.model.softmode.pin_stiffness.assign(np.repeat(stiffness, len(FACE)).astype(np.float32))
    batch.solver.notify_model_changed(0)
    batch.control.softmode.pin_target.assign(np.concatenate([lifted(w) for w in range(3)]))
    batch.step(5)
    for w in range(3):
        alone = Scene(lambda world, k=stiffness[w]: populate(world, k), [bar()], gravity=DOWN)
        alone.control.softmode.pin_target.assign(lifted(w))
        alone.step(5)
        assert_same_bits([batch.q(w), batch.qd(w)], [alone.q(), alone.qd()])
