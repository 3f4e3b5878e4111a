"""Where Newton stops in contact: forces and places against the same step solved far further, in presses and piles."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.options import SolverReducedOptions
from tests.scenes import GRAVITY, Scene, cube

EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)


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


def compare(scene: Scene, steps: int) -> int:
    """Solve every step twice from one state; compare where it stops by default with residuals 10,000 times smaller.

    Returns:
        Steps in which something was pressed.
    """
    options, given = scene.reduced.tables.step.options, SolverReducedOptions()
    pressed = 0
    for _ in range(steps):
        found = []
        for tolerance, most in ((1.0e-4 * given.force_tolerance, 400), (given.force_tolerance, given.iteration_max)):
            options.force_tolerance, options.iteration_max = tolerance, most
            scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
            q, force = scene.next_state.softmode.q.numpy().copy(), scene.reduced.instance_force.numpy().copy()
            found.append((q, force))
            # at the limit of rounding the strict solve may find no descent: it is as far as it gets
            scene.reduced.status.zero_()
        (q, force), (q_default, force_default) = found
        sizes = np.linalg.norm(scene.reduced.tables.constraints.force.numpy(), axis=2).sum(axis=1)
        np.testing.assert_array_less(np.linalg.norm(force_default - force, axis=1), 1.0e-3 * sizes + 1.0e-6)
        assert np.abs(q_default - q).max() < given.tolerance * np.sqrt(3.0) * EDGE
        pressed += int((sizes > 0.1).all())
        scene.state, scene.next_state = scene.next_state, scene.state
    return pressed


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
