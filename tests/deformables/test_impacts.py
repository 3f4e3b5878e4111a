"""Impacts: Newton's start from the motion of a rigid body, finite rotations along a step, iterations, stiff pivots."""

import numpy as np
import pytest
import warp as wp

from benchmarks.impacts import drop
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.lane_kernels import from_blocks, to_blocks
from softmode.deformables.newton import rigid_start_kernels, search_kernels
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.evaluate import evaluate
from tests import reference
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene, rotation


def falling(modulus=1.0e7, *, friction=0.5, world_count=1):
    """Return a tumbling cube just above the ground, at 5 m/s."""

    def populate(world):
        motion = {"velocity": (0.0, 0.0, -5.0), "angular_velocity": (9.0, 5.0, 3.0)}
        material = Material(youngs_modulus=modulus, friction=friction)
        turned = rotation([1.0, 2.0, 3.0], 1.0)
        add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.1), rotation=turned, **motion)

    given = {"gravity": (0.0, 0.0, -GRAVITY), "ground": 0.5, "dt": 1.0 / 60.0, "world_count": world_count}
    return Scene(populate, [cube()], **given)


def iterate(scene):
    """Return the coordinates of the iterate."""
    return from_blocks(scene.reduced.tables.arrays.q.numpy()[0], cube().function_count)


def strain(q):
    """Return F^T F at the cubature points."""
    F = reference.FreeBody(body=cube(), material=Material(), dt=1.0).deformation_gradient(q)
    return np.swapaxes(F, 1, 2) @ F


def potential(scene):
    """Return the potential of a step at its iterate, from Newton's own sum."""
    t = scene.reduced.tables
    t.newton.active.fill_(1)
    t.newton.evaluated.zero_()
    evaluate(t, scene.dt, derivatives=True)
    t.launch_teams(search_kernels.check_iterates, 1, t.newton_step(scene.dt), t.team)
    return float(t.newton.potential.numpy()[0])


def test_start_is_a_rigid_motion_to_a_lower_potential():
    """The first iterate of an impact has the strains of the flight, less than 1 % of its potential, and no net force.

    What is left of the force and of its moment are those of a potential that falls by less than 1e-3 in an iteration.
    """
    scene = falling(friction=0.0)
    t = scene.reduced.tables
    scene.reduced.begin(scene.state, None, scene.dt)
    scene.reduced.detect(scene.state, None, scene.dt, prescribed=True)
    step = t.newton_step(scene.dt)
    t.launch(kernels.begin_newton, 1, step)
    flight, high = iterate(scene), potential(scene)
    t.launch_teams(rigid_start_kernels.start_rigidly, 1, step, t.samples, t.team)
    start, low = iterate(scene), potential(scene)
    np.testing.assert_allclose(strain(start), strain(flight), atol=1e-6)
    kinetic = scene.kinetic_energy()
    assert low < 0.01 * high and low < kinetic < 0.01 * high
    # any other rigid motion near it has more
    y = start + cube().linear_coordinates[:, :3]
    for shift in np.vstack([np.eye(6), -np.eye(6)]) * 2e-3:
        R = rotation(shift[3:], 0.04) if shift[3:].any() else np.eye(3)
        X = cube().mean_basis @ y
        moved = (y - np.outer(cube().linear_coordinates[:, 3], X)) @ R.T
        moved += np.outer(cube().linear_coordinates[:, 3], X + shift[:3]) - cube().linear_coordinates[:, :3]
        t.arrays.q.assign(to_blocks(moved[None], scene.reduced.view.layout.block_count))
        assert potential(scene) > low


def test_slow_bodies_start_as_they_fly():
    """A cube that lies on the ground, or falls by less than 2 % of its size in a step, keeps the bits of its start."""
    scene = falling()
    scene.set(qd=0.02 * scene.qd())
    t = scene.reduced.tables
    scene.reduced.begin(scene.state, None, scene.dt)
    scene.reduced.detect(scene.state, None, scene.dt, prescribed=True)
    before = iterate(scene)
    t.launch_teams(rigid_start_kernels.start_rigidly, 1, t.newton_step(scene.dt), t.samples, t.team)
    np.testing.assert_array_equal(iterate(scene), before)


@pytest.mark.parametrize("alpha", [0.25, 1.0, 2.0])
def test_rotation_in_a_step_is_finite(alpha):
    """Along q + alpha dq with dq = phi x r, r the place from the centre of mass, the body turns by exp(alpha phi)."""
    scene = falling()
    t, phi = scene.reduced.tables, np.array([0.3, -0.5, 0.4])
    scene.reduced.begin(scene.state, None, scene.dt)
    q = cube().affine(rotation([3.0, 1.0, 2.0], 0.4) @ np.diag([1.1, 0.9, 1.0]), (0.1, 0.2, 0.3))
    one = cube().linear_coordinates[:, 3]
    y = q + cube().linear_coordinates[:, :3]
    X = cube().mean_basis @ y
    r = y - np.outer(one, X)
    blocks = scene.reduced.view.layout.block_count
    t.arrays.q.assign(to_blocks(q[None], blocks))
    t.arrays.direction.assign(to_blocks((np.cross(phi, r) + np.outer(one, [0.01, 0.0, 0.02]))[None], blocks))
    t.newton.active.fill_(1)
    t.newton.iteration.zero_()
    step = t.newton_step(scene.dt)
    t.launch_teams(search_kernels.start_line_searches, 1, step, t.team)
    np.testing.assert_allclose(t.arrays.turn.numpy()[0], phi, rtol=1e-6)
    t.newton.step_length.fill_(alpha)
    t.launch(search_kernels.trial_functions, (1, 1), step, 1)
    R = reference.exponential(alpha * phi)
    expected = r @ R.T + np.outer(one, X + alpha * np.array([0.01, 0.0, 0.02])) - cube().linear_coordinates[:, :3]
    found = from_blocks(t.arrays.q_trial.numpy()[0], cube().function_count)
    np.testing.assert_allclose(found, expected, atol=1e-7)  # the direction is float32


@pytest.mark.parametrize(("modulus", "rate"), [(1e5, 60), (1e7, 60), (1e7, 240), (1e9, 1000)])
def test_hard_impacts_take_few_iterations(modulus, rate):
    """A cube that tumbles onto the ground at 5 m/s: at most 24 iterations in every step, and no status bit."""
    for seed in (0, 1):
        iterations, status = drop(modulus, 1.0 / rate, seed)
        assert max(iterations) <= 24 and status == 0


def test_worlds_of_impacts_are_single_worlds():
    """World i of three that meet the ground at other speeds is the single world, to the bit."""
    many = falling(world_count=3)
    speeds = [0.3, 1.0, 1.5]
    for i, speed in enumerate(speeds):
        many.set(qd=speed * many.qd(i), instance=i)
    many.step(12)
    for i, speed in enumerate(speeds):
        alone = falling()
        alone.set(qd=speed * alone.qd())
        alone.step(12)
        np.testing.assert_array_equal(many.q(i), alone.q())


def test_stiff_pivots_are_not_indefinite():
    """The Hessian of a cube of 3 cm and 1e9 Pa that has turned is definite: no rounding passes for a negative pivot."""
    scene = Scene(
        lambda world: add_reduced_body(world, cube(), material=Material(youngs_modulus=1.0e9), scale=0.3),
        [cube()],
        dt=1.0 / 60.0,
    )
    scene.set(q=cube().affine(0.3 * rotation([1.0, 2.0, 2.0], 1.0)))
    scene.step(3)
    assert not scene.reduced.tables.system.indefinite.numpy().any()
    assert not scene.reduced.status.numpy().any()


def test_a_rim_stops_what_comes_down_on_it() -> None:
    """A cube that falls 8 mm in a step on a box which ends under it is not pushed aside, without friction.

    Cells that the rim cuts lie on the box's face, also those whose samples pass its flank: 0.06 of the momentum went
    sideways.
    """

    def populate(world):
        material = Material(youngs_modulus=1.0e5, density=300.0, friction=0.0)
        add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.0533), velocity=(0.0, 0.0, -2.0))
        world.add_shape_box(
            -1, xform=wp.transform(wp.vec3(0.097, 0.0, -0.05), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.05
        )

    scene = Scene(populate, [cube()], dt=1.0 / 240.0)
    scene.step(2)
    part = scene.reduced.view.samples.part.numpy()
    assert ((part > 0.0) & (part < 1.0)).sum() > 3
    sideways, _across, down = scene.momentum()[0] / (2.0 * scene.mass())
    assert abs(down) < 0.5
    assert abs(sideways) < 1.0e-6
