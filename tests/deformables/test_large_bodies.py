"""Bodies of many functions: stiffness by tiles and systems by panels do what the launches for smaller bodies do.

On a CPU the same code runs with one thread; the marker ``gpu`` runs it on CUDA.
"""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.model.compile_ahead import compile_launches
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve
from softmode.deformables.solver.step_tables import newton_notes
from softmode.deformables.system.tile_kernels import TILE, assemble_tiles, chunk_count, tile_count
from tests.bodies import many_functions
from tests.marks import rest_but
from tests.scenes import GRAVITY, Scene

CUDA = pytest.param("cuda:0", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no GPU")])
DEVICES = ["cpu", CUDA]
pytestmark = pytest.mark.filterwarnings("ignore:pins hold")
SIZE = (0.3, 0.1, 0.1)


def scene_of(*counts: int, device: str = "cpu", worlds: int = 1) -> Scene:
    """Return bars above each other, pinned at one end, that bend under their weight."""
    bodies = [many_functions(count) for count in counts]

    def populate(world: newton.ModelBuilder) -> None:
        for level, body in enumerate(bodies):
            instance = add_reduced_body(world, body, position=(0.0, 0.0, 0.3 * level + 0.051))
            held = body.cubature.points[:, 0] < body.bounds[0, 0] + 0.03
            add_pins(world, instance, body.cubature.points[held], stiffness=1.0e9 * body.cubature.weights[held])

    given = {"gravity": (0.0, 0.0, -GRAVITY), "device": device, "world_count": worlds}
    scene = Scene(populate, bodies, **given)
    if device != "cpu":
        compile_launches(lambda: scene.step(1), device)
        scene.restart()
    return scene


def direction_of(scene: Scene, *, tiled: bool, by_panels: bool) -> tuple[np.ndarray, np.ndarray]:
    """Assemble and solve at the present state; return the sum over chunks of the stiffness and the direction."""
    t, dt = dataclasses.replace(scene.reduced.tables, tiled=tiled), scene.dt
    before, t.system.by_panels = t.system.by_panels, by_panels
    t.newton.active.fill_(1)
    t.newton.refresh.fill_(1)
    evaluate(t, dt, derivatives=True)
    gather_gradient(t, dt)
    t.arrays.stiffness.zero_()
    assemble(t, dt)
    solve(t)
    t.system.by_panels = before
    K = t.arrays.stiffness.numpy().sum(axis=1).reshape(t.layout.instance_count, t.system.size, -1)
    rows, columns = np.arange(K.shape[1])[:, None] // 8, np.arange(K.shape[2])[None] // 8
    return np.where(columns >= rows, K, 0.0), t.arrays.direction.numpy()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("counts", [pytest.param((64,), marks=pytest.mark.rest), (76,), (136, 76)])
def test_tiles_equal_blocks(counts: tuple[int, ...], device: str) -> None:
    """The same sums over the points, of bodies that end within a tile: to rounding of single precision."""
    scene = scene_of(*counts, device=device)
    scene.step(3)
    apart, tiled = (direction_of(scene, tiled=flag, by_panels=False) for flag in (False, True))
    assert scene.reduced.tables.layout.stride >= TILE
    assert np.abs(apart[0]).max() > 0.0 and np.abs(apart[1]).max() > 0.0
    np.testing.assert_allclose(tiled[0], apart[0], atol=2.0e-6 * np.abs(apart[0]).max())
    np.testing.assert_allclose(tiled[1], apart[1], atol=2.0e-3 * np.abs(apart[1]).max())


@pytest.mark.parametrize("device", DEVICES)
def test_points_in_chunks(device: str) -> None:
    """Sums over parts of the points add up to those over all."""
    scene = scene_of(76, device=device)
    scene.step(2)
    whole = direction_of(scene, tiled=True, by_panels=False)[0]
    t = scene.reduced.tables
    shape = t.arrays.stiffness.shape
    more = wp.zeros((shape[0], 5, *shape[2:]), dtype=t.arrays.stiffness.dtype, device=device)
    t.arrays.stiffness = t.step.arrays.stiffness = more
    parts = direction_of(scene, tiled=True, by_panels=False)[0]
    np.testing.assert_allclose(parts, whole, atol=2.0e-6 * np.abs(whole).max())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", rest_but([136], [8, 24, 56, 88, 136, 200]))
def test_no_capacity_cliff(count: int, device: str) -> None:
    """Bodies from 24 to 600 unknowns bend alike, whichever launches their size calls for: 1e-5 of the size."""
    tips = []
    for by_panels in (False, True):
        scene = scene_of(count, device=device)
        scene.reduced.tables.system.by_panels = by_panels
        scene.reduced.tables = dataclasses.replace(scene.reduced.tables, tiled=by_panels, one_launch=False)
        scene.step(12)
        assert not scene.reduced.status.numpy().any()
        tips.append(scene.state.particle_q.numpy())
    assert np.abs(tips[0] - scene.model.particle_q.numpy()).max() > 5.0e-4
    np.testing.assert_allclose(tips[1], tips[0], atol=1.0e-5 * SIZE[0])


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize("count", [88, 200])
def test_large_bodies_on_cuda(count: int) -> None:
    """CUDA chooses tiles and panels by size, says so, ends where a CPU does, and a graph gives the bits of launches."""
    places = []
    for device in ("cpu", "cuda:0"):
        scene = scene_of(count, device=device)
        scene.step(12)
        assert not scene.reduced.status.numpy().any()
        places.append(scene.state.particle_q.numpy())
    tables = scene.reduced.tables
    assert tables.tiled and tables.system.by_panels and "panel by panel" in scene.reduced.notes[0]
    np.testing.assert_allclose(places[1], places[0], atol=1.0e-5)
    scene.restart()
    replay = scene.capture()
    replay()
    captured = scene.state.softmode.q.numpy()
    scene.restart()
    scene.step(2)
    np.testing.assert_array_equal(captured, scene.state.softmode.q.numpy())


def test_slabs_of_points_keep_the_bits() -> None:
    """However one thread cuts points, each entry has the same sums in the same order, here of 17 blocks."""
    scene = scene_of(136)
    scene.step(2)
    t, found = scene.reduced.tables, []
    t.newton.active.fill_(1)
    t.newton.refresh.fill_(1)
    evaluate(t, scene.dt, derivatives=True)
    t.arrays.stiffness.fill_(np.nan)
    blocks = t.layout.block_count
    for slabs in (1, 3):
        step = t.newton_step(scene.dt)
        step.options.stiffness_slabs = slabs
        assemble(t, scene.dt)
        found.append(t.arrays.stiffness.numpy()[0, 0])
    tasks = tile_count(t.layout.stride)
    t.launch(assemble_tiles, (1, 1, tasks, 1), t.newton_step(scene.dt), 1)
    found.append(t.arrays.stiffness.numpy()[0, 0])
    upper = np.arange(3 * blocks) >= np.arange(24 * blocks)[:, None] // 8
    one, three, tiles = (K[upper] for K in found)
    assert np.isfinite(one).all()
    np.testing.assert_array_equal(three, one)
    np.testing.assert_allclose(tiles, one, atol=2.0e-6 * np.abs(one).max())


def test_tiles_cover_the_upper_triangle() -> None:
    """Six pairs of components, of three the upper triangle; points are split where tiles are too few for a device."""
    assert [tile_count(stride) for stride in (64, 72, 784)] == [6, 21, 780]
    assert chunk_count(1, 64) == 16 and chunk_count(1, 784) == 2 and chunk_count(4096, 64) == 1


def test_notes_name_the_panels() -> None:
    """Whoever asks why a large body takes a launch per phase reads how its system is solved."""
    (note,) = newton_notes(2352, one_launch=False, shared=False, by_panels=True)
    assert note.startswith("systems of 2352 unknowns") and note.endswith("panel by panel")
