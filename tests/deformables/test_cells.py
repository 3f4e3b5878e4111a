"""Cells: what a contact sample stands for, against closed forms for whole faces, stacks, rest and slopes."""

import newton
import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.dents import CARRIED, cells, mean_curvature, neighbourhoods, sample_room
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.options import SolverReducedOptions
from tests import reference
from tests.bodies import bar, cube, default_ball, sheet, smooth_ball
from tests.scenes import GRAVITY, Scene

NU = 0.3
"""Poisson's ratio of what is pressed."""
DOWN = (0.0, 0.0, -GRAVITY)


def uniaxial(strain: float, modulus: float, ratio: float = NU) -> float:
    """Return the stress of the default material under a uniaxial strain, free across [Pa].

    P = m (1 - 1 / (I + 1)) F + l (J - a) cof F, m = 4/3 mu, l = lambda + 5/6 mu, a = 1 + 3 m / (4 l).
    """
    mu, lam = modulus / (2.0 + 2.0 * ratio), modulus * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
    m, k = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu

    def stress(along: float, across: float) -> tuple[float, float]:
        shear = m * (1.0 - 1.0 / (along**2 + 2.0 * across**2 + 1.0))
        volume = k * (along * across**2 - 1.0 - 0.75 * m / k)
        return shear * along + volume * across**2, shear * across + volume * across * along

    across = brentq(lambda x: stress(1.0 - strain, x)[1], 0.9, 1.3)
    return -stress(1.0 - strain, across)[0]


@pytest.mark.parametrize("strain", [0.01, pytest.param(0.04, marks=pytest.mark.rest), 0.1])
@pytest.mark.parametrize("body", [cube, bar, sheet])
def test_whole_faces(body, strain: float) -> None:
    """Between two plates without friction a block presses as the uniaxial law to 5 %, a thin one too, without a flag.

    The functions carry nearly the whole of it: what dents there is 2 % of the squeeze at most.
    """
    block, modulus = body(), 1.0e5
    size = np.ptp(block.bounds, axis=0)

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, poissons_ratio=NU, density=300.0, friction=0.0, mass_damping=100.0)
        add_reduced_body(world, block, material=material, position=tuple(-block.bounds.mean(axis=0)))
        for side in (-1.0, 1.0):
            z = side * (0.5 * (1.0 - strain) * size[2] + 0.02)
            world.add_shape_box(
                -1, xform=wp.transform(wp.vec3(0.0, 0.0, z), wp.quat_identity()), hx=0.4, hy=0.4, hz=0.02
            )

    scene = Scene(populate, [block], dt=0.01)
    forces = []
    for _ in range(45):
        scene.step()
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        forces.append(np.maximum(constraints.force.numpy()[0, :count, 2], 0.0).sum())
        assert scene.reduced.status.numpy()[0] == 0
    expected = uniaxial(strain, modulus) * size[0] * size[1]
    assert forces[-1] == pytest.approx(expected, rel=0.055 if body is sheet else 0.05)
    assert np.ptp(forces[-4:]) <= 1.0e-3 * expected
    assert np.abs(scene.state.softmode.dent.numpy()).max() <= 0.02 * strain * size[2]


def test_pinched_sheet_keeps_what_touches() -> None:
    """A sheet of 2 mm between a finger above and, below, another and the rim of a table: three shapes for two slots.

    A sample keeps the two nearest. The third is on the other side of the sheet, which has samples of its own: all that
    touches is kept, without a flag, and the upper finger presses as it does where one shape is below.
    """
    above = 0.01 + 0.9e-3
    upper, pressed = (0.0, above, 0.02), []
    for below in (((-0.05, -above, 0.05), (0.01, -above, 0.01)), ((-0.04, -above, 0.06),)):

        def populate(world: newton.ModelBuilder, below: tuple[tuple[float, float, float], ...] = below) -> None:
            material = Material(youngs_modulus=1.0e5, density=300.0, friction=0.0, mass_damping=100.0)
            add_reduced_body(world, sheet(), material=material, scale=0.5)
            for x, z, wide in (upper, *below):
                pose = wp.transform(wp.vec3(x, 0.0, z), wp.quat_identity())
                world.add_shape_box(-1, xform=pose, hx=wide, hy=0.01, hz=0.01)

        scene = Scene(populate, [sheet()], dt=0.004, options=SolverReducedOptions(contact_margin=0.03))
        scene.step(100)
        view, near = scene.reduced.view, 0
        assert scene.reduced.status.numpy()[0] == 0
        x, shape = view.samples.position.numpy()[0], view.samples.shape.numpy()[0]
        for k, (middle, z, wide) in enumerate((upper, *below)):
            gap = reference.distance_box(x - [middle, 0.0, z], np.array([wide, 0.01, 0.01]))
            assert (shape[gap < 0.0] == k).any(axis=1).all()
            near = near + (gap < 0.8 * float(view.instances.margin.numpy()[0]))
        assert np.max(near) == 1 + len(below)
        count = int(view.constraints.count.numpy()[0])
        upon = view.constraints.shape.numpy()[0, :count] == 0
        pressed.append(-view.constraints.force.numpy()[0, :count][upon, 2].sum())
    assert pressed[0] == pytest.approx(pressed[1], rel=0.02) and pressed[0] > 5.0


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.rest)])
def test_soft_stack_stands(count: int) -> None:
    """Cubes of 20 kPa with 4 mm offsets: the top stands where each sags under what is on it, within 1 %."""
    edge, modulus, density = 0.1, 2.0e4, 300.0
    block = cube(surface_count=400)

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, density=density, mass_damping=2.0)
        for k in range(count):
            place = (0.004 * k, -0.003 * k, 0.5 * edge + k * edge)
            add_reduced_body(world, block, material=material, position=place)

    scene = Scene(populate, [block], gravity=DOWN, ground=0.8, dt=1.0 / 240.0)
    replay, status = scene.capture(), 0
    for _ in range(180):
        replay()
        status |= int(scene.reduced.status.numpy()[0])
    sag = sum(density * GRAVITY * edge**2 / modulus * (k + 0.5) for k in range(count))
    top = scene.centre(count - 1)[2] + 0.5 * edge
    assert top == pytest.approx(count * edge - sag, rel=0.01)
    assert status == 0


def still(body: ReducedBody, modulus: float) -> float:
    """Return the kinetic energy over m g R that a body has left after 2 s on the ground."""

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, density=300.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.0502))

    scene = Scene(populate, [body], gravity=DOWN, ground=0.8, dt=1.0 / 240.0)
    replay = scene.capture()
    replay()
    falling = scene.reduced.view.settled()[0]
    for _ in range(240):
        replay()
    assert scene.reduced.view.settled()[0] < 1.0e-6 < 0.1 * falling
    return scene.kinetic_energy() / (scene.mass() * GRAVITY * 0.05)


@pytest.mark.parametrize("surface_count", [80, 150, 400])
@pytest.mark.parametrize("modulus", [1.0e4, pytest.param(1.0e5, marks=pytest.mark.rest), 1.0e6])
def test_cubes_come_to_rest(modulus: float, surface_count: int) -> None:
    """Large cells and small ones: what a cell takes from the start of a step does not drive a face to and fro."""
    assert still(cube(surface_count=surface_count), modulus) < 1.0e-9


@pytest.mark.parametrize(
    ("degrees", "seconds", "error"),
    [(5.0, 0.5, 0.02), pytest.param(1.0, 1.0, 0.03, marks=pytest.mark.rest), (0.25, 3.0, 0.12)],
)
@pytest.mark.parametrize("modulus", [pytest.param(1.0e5, marks=pytest.mark.rest), 1.0e6])
def test_balls_roll_down(modulus: float, degrees: float, seconds: float, error: float) -> None:
    """A ball of 800 samples gains 5/7 g sin, also down a slope on which it is moved by a 230th of its weight."""
    body, slope = default_ball(), np.radians(degrees)

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, density=300.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.05))

    gravity = (GRAVITY * np.sin(slope), 0.0, -GRAVITY * np.cos(slope))
    scene = Scene(populate, [body], gravity=gravity, ground=0.8, dt=1.0 / 240.0)
    scene.step(60)
    before = scene.momentum()[0][0]
    scene.step(round(seconds * 240))
    gained = (scene.momentum()[0][0] - before) / scene.mass() / seconds
    assert gained == pytest.approx(5.0 / 7.0 * GRAVITY * np.sin(slope), rel=error)


def test_tables() -> None:
    """Neighbourhoods face one way and weigh what functions carry, a ball has the curvature 1/R, a sheet two sides.

    Cells of a ball have the middles and moments of what is nearest to their samples; those of a cube end at its edges.
    """
    body = smooth_ball(8, 400)
    np.testing.assert_allclose(np.median(mean_curvature(body)), 1.0 / 0.05, rtol=0.02)
    assert np.abs(mean_curvature(cube())).max() < 1.0e-9
    x, k = body.surface.points, np.arange(100_000) + 0.5
    height, angle = 1.0 - 2.0 * k / len(k), np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    dense = 0.05 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    own = KDTree(x).query(dense)[1]
    size, arm = np.bincount(own), dense - x[own]
    grown = np.sqrt(body.surface.areas / (4.0 * np.pi * 0.05**2 * size / len(k)))
    middle, moments = cells(body)
    for axis in range(3):  # across the normal, along which a ball's cells fall away
        mean = np.bincount(own, arm[:, axis]) / size
        expected = 12.0 * grown**2 * (np.bincount(own, arm[:, axis] ** 2) / size - mean**2)
        level = np.abs(x[:, axis]) < 0.01
        scale = 0.05 * np.sqrt(4.0 * np.pi / len(x))
        np.testing.assert_allclose(middle[level, axis], (grown * mean)[level], atol=0.015 * scale)
        np.testing.assert_allclose(moments[level, axis, axis], expected[level], atol=0.05 * scale**2)
    middle, moments = cells(cube())
    side = np.sqrt(6.0 / np.pi * cube().surface.areas)
    assert np.abs(cube().surface.points + middle).max() < 0.0501
    assert np.einsum("nk,nk->n", middle, cube().surface.normals) == pytest.approx(0.0, abs=1.0e-12)
    assert (np.trace(moments, axis1=1, axis2=2) > side**2).all()  # a disc has the least
    thin = sheet()
    for samples, weights in neighbourhoods(thin):
        assert weights.sum() == pytest.approx(CARRIED) and (weights > 0.0).all()
        assert np.ptp(thin.surface.normals[samples] @ thin.surface.normals[samples[0]]) <= 1.5
    assert sample_room(thin, 0.01) > 1.5 * thin.surface_count
    assert sample_room(cube(), 0.01) == cube().surface_count
