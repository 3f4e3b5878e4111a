"""Where Newton stops: forces and places against the same step solved far further, in grasps, presses, piles, alone."""

from collections.abc import Callable

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.envs.presets import RL_SOLVER
from tests.bodies import cube
from tests.scenes import GRAVITY, GRIPPER, Scene, add_gripper

EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
RAMP = 10
"""Steps in which the fingers of a grasp are driven to where they press hardest."""


def press(modulus: float, ratio: float, world_count: int = 1) -> Scene:
    """Return a cube on the ground onto which a rigid box of 0.8 kg falls askew, so that it is pressed and slides."""

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, poissons_ratio=ratio, friction=0.6)
        add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.5 * EDGE))
        turned = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.1)
        box = world.add_body(xform=wp.transform((0.01, 0.0, 1.25 * EDGE), turned))
        shape = newton.ModelBuilder.ShapeConfig(density=3000.0, mu=0.6)
        world.add_shape_box(box, hx=0.4 * EDGE, hy=0.4 * EDGE, hz=0.2 * EDGE, cfg=shape)

    return Scene(populate, [cube()], coupled=True, gravity=DOWN, ground=0.6, world_count=world_count)


def pile(modulus: float, ratio: float) -> Scene:
    """Return two cubes, one falling on the other."""

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, poissons_ratio=ratio, friction=0.6)
        for k in range(2):
            add_reduced_body(world, cube(), material=material, position=(0.02 * k, 0.0, (0.5 + 1.02 * k) * EDGE))

    return Scene(populate, [cube()], gravity=DOWN, ground=0.6)


def grasp(modulus: float, ratio: float, world_count: int = 1) -> Scene:
    """Return a cube of 60 mm on the ground between two fingers, which `close` drives together."""

    def populate(world: newton.ModelBuilder) -> None:
        add_gripper(world, 0.03)
        material = Material(youngs_modulus=modulus, poissons_ratio=ratio, friction=0.8)
        add_reduced_body(world, cube(0.06), material=material, position=(0.0, 0.0, 0.0301))

    return Scene(populate, [cube(0.06)], coupled=True, gravity=DOWN, ground=0.8, world_count=world_count)


def close(scene: Scene, step: int) -> None:
    """Drive the fingers of every world together, and lift them at the end."""
    squeeze = GRIPPER["squeeze"] * min((step + 1) / RAMP, 1.0)
    target = np.array([1.0e-3 * max(step - RAMP, 0), squeeze, squeeze], np.float32)
    scene.control.joint_target_q.assign(np.tile(target, scene.model.world_count))


def compare(
    scene: Scene,
    steps: int,
    act: Callable[[Scene, int], None] | None = None,
    given: SolverReducedOptions | None = None,
    relative: float = 1.0e-3,
) -> int:
    """Solve every step twice from one state; compare where it stops with residuals 10,000 times smaller.

    Args:
        scene: A scene in which bodies touch.
        steps: How many.
        act: Called before each of them.
        given: Where it stops, by default as `SolverReducedOptions` does.
        relative: Largest difference of the force on a body or finger, over the sum of all contact forces.

    Returns:
        Steps in which something was pressed.
    """
    given = given or SolverReducedOptions()
    options, size = scene.reduced.tables.step.options, EDGE * np.sqrt(3.0)
    pressed = 0
    for step in range(steps):
        if act:
            act(scene, step)
        found = []
        for tolerance, most in ((1.0e-9, 400), (given.force_tolerance, given.iteration_max)):
            options.force_tolerance, options.iteration_max = tolerance, most
            scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
            q, force = scene.next_state.softmode.q.numpy().copy(), scene.reduced.instance_force.numpy().copy()
            wrench = scene.reduced.body_wrench.numpy()[:, :3].reshape(scene.model.world_count, -1).copy()
            found.append((q, force, wrench))
            # at the limit of rounding the strict solve may find no descent: it is as far as it gets
            scene.reduced.status.zero_()
        (q, force, wrench), (q_default, force_default, wrench_default) = found
        sizes = np.linalg.norm(scene.reduced.tables.constraints.force.numpy(), axis=2).sum(axis=1)
        np.testing.assert_array_less(np.linalg.norm(force_default - force, axis=1), relative * sizes + 1.0e-6)
        if scene.model.body_count:
            np.testing.assert_array_less(np.abs(wrench_default - wrench).max(axis=1), relative * sizes + 1.0e-6)
        assert np.abs(q_default - q).max() < given.tolerance * size
        pressed += int((sizes > 0.1).all())
        scene.state, scene.next_state = scene.next_state, scene.state
    return pressed


@pytest.mark.parametrize("modulus, ratio", [(1.0e4, 0.3), (1.0e7, 0.3), (1.0e5, 0.49)])
def test_grasp(modulus: float, ratio: float) -> None:
    """Forces on body and fingers within a thousandth of all, places within the tolerance of 1e-5 of the size."""
    assert compare(grasp(modulus, ratio), 30, close) > 15


def test_grasp_of_worlds_with_ratios_of_their_own() -> None:
    """The same with stiffness and Poisson's ratio drawn per world."""
    scene = grasp(1.0e5, 0.3, world_count=4)
    rng = np.random.default_rng(1)
    scene.model.softmode.youngs_modulus.assign((10.0 ** rng.uniform(4.0, 7.0, 4)).astype(np.float32))
    scene.model.softmode.poissons_ratio.assign(rng.uniform(0.0, 0.49, 4).astype(np.float32))
    assert compare(scene, 24, close) > 8


@pytest.mark.parametrize("modulus, ratio", [(1.0e4, 0.3), (1.0e7, 0.3), (1.0e5, 0.49)])
def test_press(modulus: float, ratio: float) -> None:
    """Contact forces within a thousandth of all of them, places within the tolerance of 1e-5 of the size."""
    assert compare(press(modulus, ratio), 24) > 8


@pytest.mark.parametrize("modulus, ratio", [(1.0e4, 0.3), (1.0e7, 0.3), (1.0e5, 0.49)])
def test_pile(modulus: float, ratio: float) -> None:
    """The same where soft bodies touch each other."""
    assert compare(pile(modulus, ratio), 24) > 8


def test_press_of_worlds_with_ratios_of_their_own() -> None:
    """The same with Poisson's ratio drawn per world."""
    scene = press(1.0e5, 0.3, world_count=4)
    ratios = np.random.default_rng(0).uniform(0.05, 0.49, 4).astype(np.float32)
    scene.model.softmode.poissons_ratio.assign(ratios)
    assert compare(scene, 16) > 4


@pytest.mark.parametrize("modulus, ratio", [(1.0e4, 0.3), (1.0e7, 0.3), (1.0e5, 0.49)])
def test_body_that_touches_nothing(modulus: float, ratio: float) -> None:
    """A cube flies, turns and swings, where movement decides: each step ends within 1e-5 of the size of one to 1e-10.

    Both take every step from the state that the default reached.
    """

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, poissons_ratio=ratio)
        add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 1.0))

    given = SolverReducedOptions()
    scenes = [
        Scene(populate, [cube()], gravity=DOWN, options=options)
        for options in (given, SolverReducedOptions(tolerance=1.0e-10, iteration_max=100))
    ]
    default, strict = scenes
    qd = np.random.default_rng(0).normal(size=default.qd().shape)
    qd[4:] *= np.sqrt(min(1.0e4 / modulus, 1.0))  # swings that a stiff cube can make without turning inside out
    default.set(qd=qd)
    fewer = 0
    for _ in range(24):
        q, qd = default.q(), default.qd()
        strict.set(q=q, qd=qd)
        for scene in scenes:
            scene.step()
        assert np.abs(default.q() - q).max() > 1.0e-3 * EDGE
        assert np.abs(default.q() - strict.q()).max() < given.tolerance * np.sqrt(3.0) * EDGE
        fewer += int(default.reduced.iteration.numpy()[0] < strict.reduced.iteration.numpy()[0])
    assert fewer > 12


@pytest.mark.slow
@pytest.mark.parametrize("given, relative", [(SolverReducedOptions(), 1.0e-3), (RL_SOLVER, 1.0e-2)], ids=["", "rl"])
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.45, 0.49])
@pytest.mark.parametrize("modulus", [1.0e4, 1.0e5, 1.0e6, 1.0e7])
def test_whole_range(modulus: float, ratio: float, given: SolverReducedOptions, relative: float) -> None:
    """Grasps, presses and piles over all stiffnesses and ratios, with both tolerances."""
    assert compare(grasp(modulus, ratio), 60, close, given, relative) > 40
    assert compare(press(modulus, ratio), 40, None, given, relative) > 15
    assert compare(pile(modulus, ratio), 40, None, given, relative) > 15
