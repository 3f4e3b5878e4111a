"""The protocols of FreeForm's tables on small cases: same domain and springs in both methods, descent, kernels.

Builds the bodies of the paper's tables.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from benchmarks.freeform import explicit, figures, grips, meshes, objects, training
from benchmarks.freeform.grips import CONDITIONS, PULL
from benchmarks.freeform.meshes import PART, MeshThing, References
from benchmarks.freeform.objects import Thing, compare, fem_motion, reduced_motion
from softmode.deformables.body.rkpm import make_basis
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError
from tests.shape_trials import Voxels

STEPS = 3


def _bar() -> Thing:
    """Return a bar of six cubes in a row, of 1e5 Pa, the last third ten times as stiff."""
    lines = tuple(np.arange(n + 1) / 6.0 for n in (6, 1, 1))
    voxels = Voxels(lines=lines, filled=np.ones((6, 1, 1), bool), axis=0)  # type: ignore[arg-type]
    return Thing(name="bar", voxels=voxels, youngs_modulus=1.0e5, factors=np.repeat([1.0, 1.0, 10.0], 2))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_springs_have_the_volume_of_the_held_cells(condition: str) -> None:
    """Sum k = kappa V of the held cells, points lie inside, targets go from rest to the pull."""
    bar = _bar()
    grip = bar.grip(condition)
    size = bar.voxels.cell
    cells = len(np.unique((grip.points / size).astype(int), axis=0))
    expected = grips.SPRINGS * bar.youngs_modulus / size.max() ** 2 * cells * size.prod()
    if condition != "farthest":  # two of the four points may share cells of so small a bar
        assert grip.stiffness.sum() == pytest.approx(expected)
    np.testing.assert_array_equal(grip.targets(0, STEPS), grip.points)
    np.testing.assert_allclose(grip.targets(STEPS, STEPS) - grip.points, grip.pull, atol=1e-15)
    length = np.linalg.norm(grip.pull, axis=1)
    np.testing.assert_allclose(length, 0.0 if condition == "fix" else PULL)


def test_moduli_are_those_of_the_cells() -> None:
    """Points take the factor of the cell that they lie in."""
    x = np.array([[0.1, 0.1, 0.1], [0.6, 0.1, 0.1], [0.7, 0.1, 0.1], [0.99, 0.1, 0.1]])
    np.testing.assert_array_equal(_bar().factors_at(x), [1.0, 1.0, 10.0, 10.0])


def test_both_methods_follow_one_protocol(tmp_path) -> None:
    """Pulled at both ends for three steps, softmode is near finite elements; stored frames are read again."""
    bar = _bar()
    grip = bar.grip("boundary")
    quadrature = bar.voxels.quadrature(400)
    body = build_body(
        quadrature,
        BuildOptions(mode_count=6, kernel_count=60, cubature_count=None),
        stiffness_scale=bar.factors_at(quadrature.points),
        progress=False,
    )
    expected = fem_motion(bar, grip, quadrature.points, STEPS, tmp_path)
    found, milliseconds, status = reduced_motion(bar, grip, body, quadrature.points, STEPS)
    error = compare(found, expected, quadrature.weights)
    assert status == 0 and milliseconds > 0.0
    assert error.mse < 3e-3 * error.moved
    assert error.mse <= error.worst_frame <= error.largest**2
    again = fem_motion(bar, grip, quadrature.points, STEPS, tmp_path)
    np.testing.assert_allclose(again, expected, atol=1e-7)
    softer = dataclasses.replace(bar, factors=np.ones(6))
    assert len(list(tmp_path.iterdir())) == 1
    fem_motion(softer, grip, quadrature.points, STEPS, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.fixture(scope="module")
def brick(tmp_path_factory: pytest.TempPathFactory) -> MeshThing:
    """Return a box of 2 x 1 x 1 m, read from a file that lacks a triangle."""
    folder = tmp_path_factory.mktemp("meshes")
    box = trimesh.creation.box(extents=(2.0, 1.0, 1.0))
    trimesh.Trimesh(box.vertices, box.faces[1:], process=False).export(folder / "brick.obj")
    (thing,) = meshes.read_folder(folder)
    return thing


def test_meshes_are_closed_scaled_and_held(brick: MeshThing) -> None:
    """Longest edge 1 m, volume 1/4 m^3; sum k = kappa V of an end of a tenth of the length; ends go apart."""
    assert np.ptp(brick.vertices, axis=0) == pytest.approx([1.0, 0.5, 0.5])
    assert brick.quadrature.volume == pytest.approx(0.25)
    grip = brick.grip("boundary")
    expected = 2.0 * grips.SPRINGS * brick.youngs_modulus / PART**2 * (0.25 * PART)
    assert grip.stiffness.sum() == pytest.approx(expected, rel=0.35)  # whole points of a coarse grid
    np.testing.assert_allclose(np.abs(grip.pull), np.tile([PULL, 0.0, 0.0], (len(grip.points), 1)))
    assert [len(brick.regions(brick.grip(condition))) for condition in CONDITIONS] == [1, 4, 2]


def test_references_are_refined_and_read_again(brick: MeshThing, tmp_path) -> None:
    """What is stored is what was made, to half a unit of each shape's 16 bits; particles of `mpm` follow it."""
    path, steps = tmp_path / "references.npz", 2
    made, count, distance = meshes.refine(brick, "boundary", steps)
    assert count > meshes.COUNTS[0] and distance <= meshes.STABLE
    references, size = References(path), np.abs(made).max()
    key = f"{brick.key}_boundary_{steps}"
    references.add(key, meshes.packed(made, count, distance))
    np.testing.assert_allclose(references.motion(brick, "boundary", steps), made, atol=meshes.SHAPES * size / 32767.0)
    grip = brick.grip("boundary")
    found = explicit.thing_motion(brick, grip, 0.1, steps)
    at = np.argmin(np.linalg.norm(brick.quadrature.points[:, None] - brick.points[None, :5], axis=2), axis=0)
    assert np.abs(found[:, at] - made[:, :5]).max() < 0.2 * size


def test_a_folder_without_meshes_is_refused(tmp_path) -> None:
    """The error says which folder, and where meshes are; a file that is none is named."""
    with pytest.raises(AssetError, match="no mesh"):
        meshes.read_folder(tmp_path)
    (tmp_path / "bad.obj").write_text("v 0 0 0")
    with pytest.raises(AssetError, match=r"bad\.obj"):
        meshes.read_folder(tmp_path)


def test_wins_count_objects_that_are_not_worse() -> None:
    """By condition, of those that have both rows."""
    rows = [{"condition": "fix", "basis": b, "mse": m} for b, m in (("one", 1.0), ("two", 2.0))]
    records = [{"name": "a", "rows": rows}, {"name": "b", "rows": [dict(r, mse=1.0) for r in rows]}]
    assert objects.wins(records, "one", "two")["fix"] == "2 of 2"
    assert objects.wins(records, "two", "one")["fix"] == "1 of 2"


@pytest.mark.parametrize(("loss", "sampling"), training.METHODS)
def test_descent_lowers_the_rayleigh_quotients(loss: str, sampling: str) -> None:
    """Sixty iterations make the weights larger and smoother than at the start: a lower mean of c^T H c / c^T M c."""
    pytest.importorskip("torch")
    problem = training.make_problem(kernel_count=60, point_count=400)

    def quotient(c: np.ndarray) -> float:
        mass, energy = np.diag(c.T @ problem.mass @ c), np.diag(c.T @ problem.energy @ c)
        return float((energy / mass).mean())

    first, last = (training.train(problem, loss, sampling, iterations=n, mode_count=3) for n in (1, 60))
    assert quotient(last) < 0.9 * quotient(first)


@pytest.mark.parametrize("kind", figures.KINDS)
def test_gradients_of_the_kernels(kind: str) -> None:
    """Central differences, and the sums that each kind has."""
    quadrature = quadrature_from_box(figures.SLAB, point_count=500)
    basis = make_basis(quadrature.points, 40, kernel="gaussian", spacing=0.0)
    x, h = np.random.default_rng(0).uniform(-0.2, 0.2, size=(20, 3)), 1e-5
    value, slope = figures.kernels(kind, basis, x)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = figures.kernels(kind, basis, x + step)[0] - figures.kernels(kind, basis, x - step)[0]
        np.testing.assert_allclose(slope[axis], difference / (2.0 * h), atol=1e-6)
    if kind != "RBF":
        np.testing.assert_allclose(value.sum(axis=1), 1.0)
    if kind == "RKPM":
        np.testing.assert_allclose(value @ basis.centres, x, atol=1e-10)


def test_gap_of_neighbours() -> None:
    """A row of points pulled apart at one place has its gap there."""
    rest = np.stack(np.meshgrid(np.arange(4.0), np.arange(2.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    moved = rest + np.where(rest[:, :1] > 1.5, [[2.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    assert figures.longest_gap(rest, moved) == pytest.approx(3.0)
