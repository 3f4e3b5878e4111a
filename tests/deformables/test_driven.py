"""Regions of a body that are held or moved: exactly, as driven coordinates, or softly, by pins."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.contact.dents import dent_lengths
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body, drive_regions
from softmode.deformables.model.lane_kernels import from_blocks
from softmode.deformables.solver.attachments import attach
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.errors import ConfigError
from tests.bodies import held_bar
from tests.scenes import GRAVITY, Scene, rotation

LENGTH, EDGE = 0.4, 0.1
DOWN = (0.0, 0.0, -GRAVITY)
MATERIAL = Material(youngs_modulus=2.0e5, mass_damping=20.0)
FINE = SolverReducedOptions(tolerance=1.0e-8)
FLOAT32 = float(np.finfo(np.float32).eps)


def scene_of(body, **options):
    """Return one bar under gravity."""
    return Scene(
        lambda world: add_reduced_body(world, body, material=MATERIAL), [body], gravity=DOWN, options=FINE, **options
    )


def region_positions(scene, name):
    """Return where the points of a region are [m]."""
    body = scene.body()
    rows = body.regions.rows(name)
    return body.regions.points[rows] + body.evaluate(body.regions.points[rows])[0] @ scene.q(), body.regions.points[
        rows
    ]


def test_exact_regions_have_no_dents():
    """Samples of an exact region are where they are driven to; all others may be dented."""
    body = held_bar()
    lengths, held = dent_lengths(body), body.surface.points[:, 0] < -0.5 * LENGTH + 0.05 - 1e-9
    assert held.sum() > 10 and not lengths[held].any() and (lengths[~held] > 0.0).all()


def test_exact_region_in_a_shape():
    """Stuck in a block, deep inside, an exact region is pressed by a million newtons, and the rest moves as without.

    To the force that a step may leave: before, that was a part of the million, and free ends gained energy.
    """
    body, half = held_bar(), 0.5 * LENGTH

    def populate(world, block):
        add_reduced_body(world, body, material=Material(youngs_modulus=1.0e7, viscosity=1.0e-3))
        if block:
            place = wp.transform((-half - 0.06, 0.0, 0.0), wp.quat_identity())
            world.add_shape_box(-1, xform=place, hx=0.09, hy=0.2, hz=0.2)

    found = []
    for block in (False, True):
        scene = Scene(lambda world, block=block: populate(world, block), [body], gravity=DOWN)
        scene.step(60)
        found.append(scene.q()[body.driven_count :])
    force = np.linalg.norm(scene.reduced.view.constraints.force.numpy(), axis=-1)
    assert force.sum() > 1.0e6
    np.testing.assert_allclose(found[1], found[0], atol=1.0e-4 * np.abs(found[0]).max())


def test_exact_region_stays_put():
    """Held exactly, x = X on the region while the rest sags; what holds it is the weight: sum_k c_k g_k = m g."""
    body = held_bar()
    scene = scene_of(body, dt=0.02)
    scene.step(150)
    x, X = region_positions(scene, "left")
    np.testing.assert_allclose(x, X, atol=1e-9)
    assert scene.q()[body.driven_count :].min() < -1e-3
    assert np.linalg.norm(scene.qd()) < 1e-6
    reaction = from_blocks(scene.reduced.reaction.numpy()[0], body.function_count)
    assert not reaction[body.driven_count :].any()
    force = body.regions.drive_affine[0][:, 3] @ reaction[: body.driven_count]
    np.testing.assert_allclose(force, [0.0, 0.0, scene.mass() * GRAVITY], atol=1e-5 * scene.mass() * GRAVITY)


def test_driven_regions_follow_their_poses():
    """Each exact region moves as x = A_i X + t_i, to rounding; the body between them twists without a status bit."""
    body = held_bar(ends=2)
    scene = scene_of(body, dt=0.01)
    for k in range(1, 21):
        turn = np.stack([np.eye(3), rotation((1, 0, 0), 0.05 * k)])
        shift = np.array([[0.0, 0.0, 0.0], [0.002 * k, 0.0, 0.0]])
        drive_regions(scene.model, scene.control, 0, body, turn, shift)
        scene.step()
        for i, name in enumerate(("left", "right")):
            x, X = region_positions(scene, name)
            np.testing.assert_allclose(x, X @ turn[i].T + shift[i], atol=8 * FLOAT32 * LENGTH)
    assert not scene.reduced.status.numpy().any()
    middle = body.evaluate(np.array([[0.0, 0.0, 0.5 * EDGE]]))[0] @ scene.q()
    assert 0.2 < -middle[0, 1] / (0.5 * EDGE) < 0.8  # about half of the radian


def test_driven_regions_are_moved_between_replays_of_a_graph():
    """What ``q_driven`` holds when a graph is replayed counts: written by drive_regions, or copied on the device."""
    body = held_bar()
    scene = scene_of(body, dt=0.01)
    replay = scene.capture()
    for k in range(1, 6):
        drive_regions(scene.model, scene.control, 0, body, np.eye(3)[None], np.array([[0.002 * k, 0.0, 0.0]]))
        replay()
        x, X = region_positions(scene, "left")
        np.testing.assert_allclose(x, X + np.array([0.002 * k, 0.0, 0.0]), atol=8 * FLOAT32 * LENGTH)
    wp.copy(scene.control.softmode.q_driven, scene.model.softmode.q)
    replay()
    x, X = region_positions(scene, "left")
    np.testing.assert_allclose(x, X, atol=8 * FLOAT32 * LENGTH)


def test_soft_region_is_held_by_its_pins():
    """Kappa sum_p V_p (x_p - X_p) = weight at rest: the region sinks by weight over its stiffness, at its own mean."""
    body = held_bar(stiffness=1.0e3)

    def populate(world):
        attach(world, add_reduced_body(world, body, material=MATERIAL), body, region="left")

    scene = Scene(populate, [body], gravity=DOWN, options=FINE, dt=0.02)
    scene.step(200)
    rows = body.regions.rows("left")
    x, X = region_positions(scene, "left")
    force = -1.0e3 * 2.0e5 * body.regions.weights[rows] @ (x - X)
    np.testing.assert_allclose(force, [0.0, 0.0, scene.mass() * GRAVITY], atol=1e-3 * scene.mass() * GRAVITY)


def test_region_pins_refuse_what_needs_none():
    """Unknown names and exact regions: an error that says what to do."""
    builder = newton.ModelBuilder()
    instance = add_reduced_body(builder, held_bar(), material=MATERIAL)
    with pytest.raises(ConfigError, match="no region"):
        attach(builder, instance, held_bar(), region="tip")
    with pytest.raises(ConfigError, match="exactly"):
        attach(builder, instance, held_bar(), region="left")
