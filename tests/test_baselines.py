"""The baselines' own parts: interpolation on their meshes, the derivative of the network, and short runs of each."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.baselines import flex, reduced, vbd
from benchmarks.baselines.common import FREE, Row, hexahedral_interpolation, lines_of
from benchmarks.baselines.neural_weights import NeuralWeights, NeuralWeightsOptions, train_neural_weights
from benchmarks.baselines.vbd import kuhn_interpolation, kuhn_mesh
from softmode.deformables.reduction.options import BuildOptions

CELLS = (3, 2, 1)
SHORT = 40
"""Steps of a short run: 0.4 s, a sag of about half a metre."""


def _points(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(*FREE, size=(count, 3))


@pytest.mark.parametrize("degree", [1, 2])
def test_hexahedral_interpolation_reproduces_its_degree(degree: int) -> None:
    """The product of x^d, y^d, z^d is interpolated exactly at every point; points outside take nothing."""
    lines = lines_of(CELLS)
    nodes = np.meshgrid(
        *[np.linspace(line[0], line[-1], degree * (len(line) - 1) + 1) for line in lines], indexing="ij"
    )
    nodes = np.stack(nodes, axis=-1).reshape(-1, 3)
    x = _points()
    matrix = hexahedral_interpolation(lines, degree, x)
    np.testing.assert_allclose(matrix @ (nodes**degree).prod(axis=1), (x**degree).prod(axis=1), atol=1e-12)
    assert not hexahedral_interpolation(lines, degree, FREE[:1] - 0.1).toarray().any()


def test_tetrahedra_fill_the_box_and_interpolate_linearly() -> None:
    """Six tetrahedra per cell, all of positive volume, fill the box; linear functions are reproduced."""
    lines = lines_of(CELLS)
    vertices, tetrahedra = kuhn_mesh(lines)
    a, b, c, d = vertices[tetrahedra].transpose(1, 0, 2)
    volume = np.einsum("ti,ti->t", np.cross(b - a, c - a), d - a) / 6.0
    assert len(tetrahedra) == 6 * np.prod(CELLS)
    np.testing.assert_allclose(volume, (FREE[1] - FREE[0]).prod() / len(tetrahedra), rtol=1e-12)
    x = _points()
    np.testing.assert_allclose(kuhn_interpolation(lines, x) @ vertices, x, atol=1e-12)


def test_network_gradient_is_the_derivative_of_its_value() -> None:
    """Central differences, (W(x + h) - W(x - h)) / 2h, away from the kink that ELU's second derivative has."""
    rng = np.random.default_rng(1)
    widths = (3, 16, 16, 4)
    layers = [(rng.normal(size=(b, a)) / np.sqrt(a), rng.normal(size=b)) for a, b in pairwise(widths)]
    network = NeuralWeights(layers=layers, bounds=FREE, train_seconds=0.0)
    x, h = _points(50), 1e-5
    gradient = network.evaluate(x)[1]
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = (network.evaluate(x + step)[0] - network.evaluate(x - step)[0]) / (2.0 * h)
        np.testing.assert_allclose(gradient[:, :, axis], difference, atol=10.0 * h)


def test_training_makes_weights_orthogonal(tmp_path, monkeypatch) -> None:
    """A short training on a soft body makes the weights nearly orthogonal and of unit size, and is repeatable."""
    pytest.importorskip("torch")
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path / "one"))
    x = np.random.default_rng(2).uniform(size=(500, 3))
    options = NeuralWeightsOptions(mode_count=2, iterations=300, layer_count=1, width=16, sample_count=500)
    network = train_neural_weights(x, 1.0, options, youngs_modulus=1.0, poissons_ratio=0.3)
    weight = network.evaluate(x)[0][:, 1:]
    gram = weight.T @ weight
    assert 0.5 < gram[0, 0] < 2.0 and 0.5 < gram[1, 1] < 2.0
    assert abs(gram[0, 1]) < 0.3 * np.sqrt(gram[0, 0] * gram[1, 1])
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path / "two"))
    again = train_neural_weights(x, 1.0, options, youngs_modulus=1.0, poissons_ratio=0.3)
    np.testing.assert_array_equal(again.evaluate(x)[0], network.evaluate(x)[0])


@pytest.mark.slow
def test_short_runs_bend_as_the_reference_does() -> None:
    """Over 0.4 s, softmode is within 1e-5 of FEM, a cage within 1e-4, coarse tetrahedra within 1e-2; all sag."""
    runs: list[tuple[Row, float]] = [
        (reduced.run_softmode(BuildOptions(mode_count=6), SHORT, exact=True, label="short"), 1e-5),
        (flex.run("quadratic", (5, 1, 1), SHORT), 1e-4),
        (vbd.run((9, 2, 2), 100, SHORT), 1e-2),
    ]
    for row, bound in runs:
        assert row.nmse < bound, row
        assert 0.3 < row.amplitude < 1.1, row
