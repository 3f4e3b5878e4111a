"""Reproducing kernels: identities, gradients, coverage."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.deformables.body.rkpm import BasisRKPM, KernelName, make_basis, sample_farthest
from softmode.errors import BasisError, ConfigError

KERNELS: list[KernelName] = ["cubic", "gaussian"]


def grid(size: tuple[float, float, float], shape: tuple[int, int, int], origin: float = 0.0) -> np.ndarray:
    """Return cell centres of a uniform grid."""
    axes = [origin + (np.arange(n) + 0.5) / n * length for n, length in zip(shape, size, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    ("size", "shape", "origin"), [((0.06, 0.05, 0.04), (12, 10, 8), 0.0), ((5.0, 0.1, 0.1), (100, 4, 4), 100.0)]
)
def test_partition_of_unity_and_linear_reproduction(kernel, size, shape, origin) -> None:
    """Sum phi~ = 1, sum phi~ p = X and the gradients of both, for a small box and for a slender rod far away."""
    points = grid(size, shape, origin)
    basis = make_basis(points, 150, kernel=kernel)
    found = basis.evaluate(points)
    length = max(size)
    h = float(basis.support.mean())
    centred = basis.centres - points.mean(axis=0)
    assert np.abs(found.value.sum(axis=1) - 1.0).max() < 1e-12
    assert np.abs(found.value @ centred - (points - points.mean(axis=0))).max() < 1e-12 * length
    for d, gradient in enumerate(found.gradient):
        assert np.abs(gradient.sum(axis=1)).max() < 1e-10 / h
        assert np.abs(gradient @ centred - np.eye(3)[d]).max() < 1e-10 * length / h


@pytest.mark.parametrize("kernel", KERNELS)
def test_gradient_matches_finite_differences(kernel) -> None:
    """Central differences of step e agree to e^2: 1e-5 h gives a relative 1e-8."""
    points = grid((0.06, 0.05, 0.04), (12, 10, 8))
    basis = make_basis(points, 100, kernel=kernel)
    probe = points[::37] + 1e-4
    h = float(basis.radii.mean())
    step = 1e-5 * h
    found = basis.evaluate(probe)
    for d in range(3):
        shift = step * np.eye(3)[d]
        difference = (basis.evaluate(probe + shift).value - basis.evaluate(probe - shift).value) / (2.0 * step)
        assert np.abs((difference - found.gradient[d]).toarray()).max() < 1e-7 / h


def test_chunks_do_not_change_the_result(monkeypatch) -> None:
    """Evaluation in chunks of a few points is bitwise the evaluation at once."""
    points = grid((0.06, 0.05, 0.04), (8, 8, 8))
    basis = make_basis(points, 60)
    whole = basis.evaluate(points)
    monkeypatch.setattr("softmode.deformables.body.rkpm._PAIRS_PER_CHUNK", 60 * 7)
    parts = basis.evaluate(points)
    np.testing.assert_array_equal(whole.value.indices, parts.value.indices)
    np.testing.assert_allclose(whole.value.data, parts.value.data, rtol=1e-12, atol=1e-14)


def test_uncovered_point_is_named() -> None:
    """A floater far from all kernels raises with its row, instead of a singular solve."""
    points = grid((0.06, 0.05, 0.04), (8, 8, 8))
    basis = make_basis(points, 60)
    with pytest.raises(BasisError, match=r"1 of them \(first: row 1 "):
        basis.evaluate(np.array([[0.03, 0.02, 0.02], [1.0, 1.0, 1.0]]))


def test_coplanar_kernels_are_refused() -> None:
    """Kernels in one plane cannot reproduce the normal coordinate: the moment matrix is singular."""
    plane = grid((1.0, 1.0, 1e-12), (10, 10, 1))
    basis = BasisRKPM(centres=plane, radii=np.full(len(plane), 0.2))
    with pytest.raises(BasisError, match="not covered"):
        basis.evaluate(plane)


def test_bad_arguments_are_typed() -> None:
    """NaN, wrong shapes, unknown kernels and too few centres raise typed errors that name the argument."""
    points = grid((1.0, 1.0, 1.0), (4, 4, 4))
    basis = make_basis(points, 20)
    with pytest.raises(BasisError, match="points: not all finite"):
        basis.evaluate(np.array([[np.nan, 0.0, 0.0]]))
    with pytest.raises(BasisError, match="shape"):
        basis.evaluate(np.zeros((3, 2)))
    with pytest.raises(ConfigError, match="kernel:"):
        BasisRKPM(centres=points, radii=np.ones(len(points)), kernel="box")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="kernel_count"):
        make_basis(points, 3)
    with pytest.raises(BasisError, match="at least 4"):
        make_basis(points[:3], 4)


def test_farthest_points_spread_and_repeat() -> None:
    """The sampling is deterministic, has no duplicates, and halves the covering radius like N^(-1/3)."""
    points = np.random.default_rng(0).random((3000, 3))
    first = sample_farthest(points, 512, seed=3)
    np.testing.assert_array_equal(first, sample_farthest(points, 512, seed=3))
    assert len(set(first.tolist())) == 512
    np.testing.assert_array_equal(first[:64], sample_farthest(points, 64, seed=3))

    def radius(chosen: np.ndarray) -> float:
        return float(np.sqrt(((points[:, None] - points[chosen][None]) ** 2).sum(-1)).min(axis=1).max())

    assert 1.5 < radius(first[:64]) / radius(first) < 2.6
    assert len(sample_farthest(points[:5], 9)) == 5
