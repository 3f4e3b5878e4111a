"""Scenes without a robot: energies, overlap, pictures, graphs, what is refused."""

from __future__ import annotations

from dataclasses import replace

import newton
import numpy as np
import pytest

from softmode.deformables.build.options import BuildOptions
from softmode.deformables.materials.material import Material
from softmode.deformables.model.status import status_reasons
from softmode.errors import ConfigError
from softmode.objects import ObjectConfig, Placed, SoftObject, load
from softmode.scenes import SplatScene
from softmode.splats.pinhole import PinholeCamera
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
    moved = (scene.surface(1) - cube.body.surface_points - (0.3, 0.0, 1.0)).mean(axis=0)
    np.testing.assert_allclose(moved, (0.0, 0.0, -GRAVITY * DT**2 * 8 * 9 / 2), atol=1e-6)


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
    """Cubes of which one was placed 2 mm into the other overlap by that at the start of the first step."""
    scene = make_scene(cube, (0.0, 0.0, 0.5), (0.0, 0.0, 0.5 + EDGE - 0.002))
    scene.solver.begin(scene.state, None, DT)
    scene.solver.detect(scene.state, None, DT, prescribed=True)
    assert scene.soft_overlap() == pytest.approx(0.002, rel=0.05)
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


def test_bad_scenes_are_refused(cube: SoftObject) -> None:
    """No object, odd steps, no camera to draw with."""
    with pytest.raises(ConfigError, match="objects"):
        make_scene(cube)
    with pytest.raises(ConfigError, match="steps_per_frame"):
        make_scene(cube, (0.0, 0.0, 1.0), steps_per_frame=3)
    with pytest.raises(ConfigError, match="no camera"):
        make_scene(cube, (0.0, 0.0, 1.0)).draw()
