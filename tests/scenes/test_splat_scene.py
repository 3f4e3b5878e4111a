"""Scenes without a robot: energies, overlap, pictures, graphs, what is refused."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.status import status_reasons
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError
from softmode.objects import ObjectConfig, Placed, SoftObject, load
from softmode.scenes import SplatScene
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.viz.film import Film
from tests.scenes import GRAVITY

EDGE, DENSITY, DT = 0.06, 300.0, 1.0 / 240.0
STUFF = Material(youngs_modulus=1.0e5, poissons_ratio=0.3, density=DENSITY)
MASS = DENSITY * EDGE**3
CAMERA = PinholeCamera.look_at("eye", position=(0.3, -0.2, 0.2), target=(0.0, 0.0, 0.06), width=64, height=64)
RED, GREEN = ((0.9, 0.1, 0.1),) * 2, ((0.1, 0.9, 0.1),) * 2


@pytest.fixture(scope="module")
def cube() -> SoftObject:
    """Return a red cube."""
    build = BuildOptions(mode_count=3, kernel_count=150, cubature_count=128)
    shape = {"shape": "box", "extents": (EDGE,) * 3, "splat_count": 600, "surface_count": 100}
    return load(ObjectConfig(**shape, colors=RED, build=build))


def make_scene(cube: SoftObject, *places: tuple[float, float, float], **given) -> SplatScene:
    """Return cubes over the ground, every other one green."""
    world = newton.ModelBuilder()
    world.add_ground_plane()
    red = replace(cube, material=STUFF)
    green = replace(red, splats=replace(cube.visible_splats, sh=cube.visible_splats.sh[:, :, [1, 0, 2]]))
    things = [Placed(object=green if i % 2 else red, position=p) for i, p in enumerate(places)]
    return SplatScene(world, things, dt=DT, **given)


def test_kinetic_energy_of_free_fall_is_the_work_of_gravity(cube: SoftObject) -> None:
    """After n steps of implicit Euler v = n g dt, so that T = 2 m v^2 / 2 for two cubes; none is kept by the graph."""
    scene = make_scene(cube, (0.0, 0.0, 1.0), (0.3, 0.0, 1.0), steps_per_frame=4)
    for frame in (1, 2):
        scene.step()
        assert scene.kinetic_energy() == pytest.approx(MASS * (4 * frame * GRAVITY * DT) ** 2, rel=1e-5)
    moved = (scene.surface(1) - cube.body.surface.points - (0.3, 0.0, 1.0)).mean(axis=0)
    np.testing.assert_allclose(moved, (0.0, 0.0, -GRAVITY * DT**2 * 8 * 9 / 2), atol=1e-6)


def test_what_starts_inside_is_said(cube: SoftObject, caplog: pytest.LogCaptureFixture) -> None:
    """Cubes 20 mm in each other, one of them 5 mm in the ground, are named with depth and place; apart nothing is."""
    with caplog.at_level("WARNING", "softmode"):
        apart = make_scene(cube, (0.0, 0.0, 0.03), (0.2, 0.0, 0.03))
        apart.step()
        assert not apart.notes and not caplog.records
        scene = make_scene(cube, (0.0, 0.0, 0.03), (0.04, 0.0, 0.025))
        scene.step()
    ground = next(note for note in scene.notes if "ground_plane" in note)
    assert "soft body 1" in ground and "starts 5.0 mm deep" in ground and "-0.005) m" in ground
    assert any(note.startswith("soft body 0") and "deep in soft body 1" in note for note in scene.notes)
    assert [note for note in scene.notes if note in caplog.text] == list(scene.notes)


def test_pushed_samples_carry_the_weight(cube: SoftObject) -> None:
    """Forces on the surface that sum to the weight keep a cube at rest where it hangs; without them it falls."""
    scene = make_scene(cube, (0.0, 0.0, 1.0), steps_per_frame=4)
    share = cube.body.surface.areas / cube.body.surface.areas.sum()
    push = np.outer(share, (0.0, 0.0, MASS * GRAVITY))
    scene.push(0, push)
    for _ in range(3):
        scene.step()
    momentum = MASS * cube.body.mean_basis @ scene.state.softmode.qd.numpy()
    assert abs(momentum[2]) < 1e-6 * MASS * GRAVITY * 12 * DT  # of float32 forces
    scene.push(0, (0.0, 0.0, 0.0))
    scene.step()
    assert (MASS * cube.body.mean_basis @ scene.state.softmode.qd.numpy())[2] < -0.99 * MASS * GRAVITY * 4 * DT
    with pytest.raises(ConfigError, match="force"):
        scene.push(0, np.zeros((3, 3)))


def test_stack_comes_to_rest_and_the_film_tells(cube: SoftObject, tmp_path) -> None:
    """One cube falls on another: the record has the energy of the fall, no status, and overlaps far below the size."""
    drop = 0.04
    scene = make_scene(cube, (0.0, 0.0, 0.5 * EDGE), (0.0, 0.0, 1.5 * EDGE + drop), cameras=[CAMERA])
    with Film(tmp_path / "stack.mp4") as film:
        record = scene.record(film, 30, lambda scene: float(max(-scene.surface(0)[:, 2].min(), 0.0)))
        film.publish()
    assert record.reasons == ()
    assert 0.5 * MASS * GRAVITY * drop < record.peak_energy < MASS * GRAVITY * drop
    assert record.energy < 1e-4 * record.peak_energy
    assert 0.0 < record.depth < 0.02 * EDGE and 0.0 < record.overlap < 0.02 * EDGE
    assert "fine" in str(record)
    top = scene.surface(1)[:, 2]
    assert top.min() == pytest.approx(EDGE, abs=0.03 * EDGE)
    assert (tmp_path / "stack.mp4").stat().st_size > 0 and (tmp_path / "stack.png").is_file()


def test_overlap_is_how_far_one_was_put_into_the_other(cube: SoftObject) -> None:
    """Cubes of which one was placed 2 mm into the other are that deep in at the start; dents have a part."""
    scene = make_scene(cube, (0.0, 0.0, 0.5), (0.0, 0.0, 0.5 + EDGE - 0.002))
    assert isinstance(scene.solver, SolverReduced)
    scene.solver.begin(scene.state, None, DT)
    scene.solver.detect(scene.state, None, DT, prescribed=True)
    assert scene.solver.view.pairs is not None
    deep = -float(scene.solver.view.pairs.gap.numpy().min())
    assert deep == pytest.approx(0.002, rel=0.05) and 0.5 * deep < scene.soft_overlap() <= deep
    assert make_scene(cube, (0.0, 0.0, 0.5)).soft_overlap() == 0.0


def test_every_object_is_drawn_in_its_colours_where_it_is(cube: SoftObject) -> None:
    """Red below, green above; after the fall the same picture again is that of the same state."""
    scene = make_scene(cube, (0.0, 0.0, 0.5 * EDGE), (0.0, 0.0, 1.5 * EDGE), cameras=[CAMERA])
    picture = scene.draw().astype(int)
    red = picture[..., 0] > picture[..., 1] + 60
    green = picture[..., 1] > picture[..., 0] + 60
    assert red.sum() > 80 and green.sum() > 80
    assert np.nonzero(green)[0].mean() < np.nonzero(red)[0].mean() - 5
    np.testing.assert_array_equal(scene.draw("eye"), picture)


def test_graph_equals_single_steps(cube: SoftObject) -> None:
    """A frame is its physics steps, bit for bit, and the first one starts from the initial state."""
    scene, other = (make_scene(cube, (0.0, 0.0, 0.5 * EDGE + 1e-3), steps_per_frame=2) for _ in range(2))
    for _ in range(3):
        scene.step()
        other._steps()
    np.testing.assert_array_equal(scene.state.softmode.q.numpy(), other.state.softmode.q.numpy())
    assert not status_reasons(int(scene.solver.status.numpy()[0]))


def test_rigid_things_that_can_move_do(cube: SoftObject, caplog: pytest.LogCaptureFixture) -> None:
    """A free box falls as it should, a hinged flap carries the weight of a toy; the scene says once what steps it."""
    world = newton.ModelBuilder()
    world.add_ground_plane()
    box = world.add_body(xform=wp.transform((0.5, 0.0, 0.5), wp.quat_identity()), label="box")
    world.add_shape_box(box, hx=0.03, hy=0.03, hz=0.03)
    flap = world.add_link(label="flap")
    world.add_shape_box(flap, xform=wp.transform((0.1, 0.0, 0.0), wp.quat_identity()), hx=0.1, hy=0.05, hz=0.005)
    limit = {"limit_upper": 0.0, "limit_ke": 100.0, "limit_kd": 1.0}
    hinge = world.add_joint_revolute(
        *(-1, flap), parent_xform=wp.transform((-0.1, 0.0, 0.2), wp.quat_identity()), axis=(0, 1, 0), **limit
    )
    world.add_articulation([hinge])
    toys = [Placed(object=replace(cube, material=STUFF), position=p) for p in ((0.0, 0.0, 0.24), (0.5, 0.3, 0.04))]
    with caplog.at_level("WARNING", "softmode"):
        scenes = [SplatScene(deepcopy(world), toys, dt=DT, steps_per_frame=2) for _ in range(2)]
    said = [line for line in caplog.messages if "SolverCoupledReduced" in line]
    assert len(said) == 1 and "'box', 'flap' can move" in said[0] and "'box', 'flap'" in scenes[1].notes[0]
    scene = scenes[0]
    assert isinstance(scene.solver, SolverCoupledReduced)
    for frame in range(1, 151):
        scene.step()
        if frame == 30:
            n = 2 * frame
            fallen = 0.5 - scene.state.body_q.numpy()[box, 2]
            assert fallen == pytest.approx(0.5 * GRAVITY * DT**2 * n * (n + 1), rel=1e-3)
    assert scene.state.joint_q.numpy()[-1] == pytest.approx(0.0, abs=0.02)
    assert scene.surface(0)[:, 2].min() == pytest.approx(0.205, abs=0.004)
    assert scene.solver.body_wrench.numpy()[flap, 2] == pytest.approx(-MASS * GRAVITY, rel=0.05)
    assert scene.surface(1)[:, 2].min() == pytest.approx(0.0, abs=0.002)
    assert not status_reasons(int(scene.solver.status.numpy()[0]))
    before = scene.state.body_q.numpy().copy()
    scene.reset()
    np.testing.assert_array_equal(scene.state.body_q.numpy(), scenes[1].state.body_q.numpy())
    for _ in range(150):
        scene.step()
    np.testing.assert_allclose(scene.state.body_q.numpy(), before, atol=1e-4)


def test_what_cannot_move_needs_no_mujoco(cube: SoftObject) -> None:
    """Kinematic bodies and bodies that are fixed to the world leave the soft step alone."""
    world = newton.ModelBuilder()
    still = world.add_body(is_kinematic=True, label="still")
    fixed = world.add_link(label="fixed")
    world.add_articulation([world.add_joint_fixed(-1, fixed)])
    for body in (still, fixed):
        world.add_shape_box(body, hx=0.1, hy=0.1, hz=0.01)
    scene = SplatScene(world, [Placed(object=replace(cube, material=STUFF), position=(0.0, 0.0, 0.05))], dt=DT)
    assert isinstance(scene.solver, SolverReduced) and not scene.notes


def test_bad_scenes_are_refused(cube: SoftObject) -> None:
    """No object, odd steps, no camera to draw with."""
    with pytest.raises(ConfigError, match="objects"):
        make_scene(cube)
    with pytest.raises(ConfigError, match="steps_per_frame"):
        make_scene(cube, (0.0, 0.0, 1.0), steps_per_frame=3)
    with pytest.raises(ConfigError, match="no camera"):
        make_scene(cube, (0.0, 0.0, 1.0)).draw()
