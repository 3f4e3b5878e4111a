"""Free frequencies of bodies as users build them, beside finite elements on the same domain."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.moduli import CASES, two_moduli, two_moduli_mesh
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_box, quadrature_from_mesh
from tests.oracle.fem import Mesh, free_eigenvalues
from tests.oracle.solids import SOLIDS, frequency_errors

LIMITS = {0.3: 0.03, 0.45: 0.04, 0.49: 0.05}
"""Largest error above finite elements with the default number of functions, by Poisson's ratio."""
CORNERS = {"L": 0.04, "frame": 0.07, "cross": 0.05}
"""Solids whose corners and crossings the space itself does not resolve: their own limits."""
BARS = ("bar 3:1", "bar 10:1", "bar 20:1", "plate 20:1", "slab 0.24 x 0.06 x 0.02")


def errors(name: str, poissons_ratio: float, **options: object) -> tuple[float, float]:
    """Return the range of errors of a body from a closed surface."""
    solid = SOLIDS[name]()
    quadrature = quadrature_from_mesh(*solid.surface())
    body = build_body(quadrature, BuildOptions(poissons_ratio=poissons_ratio, **options), progress=False)
    return frequency_errors(body, solid.eigenvalues(poissons_ratio), poissons_ratio)


def test_finite_elements_of_a_beam() -> None:
    """The first bending of a slender free beam is that of Euler and Bernoulli, (4.730)^2 sqrt(EI / rho A) / L^2."""
    lines = (np.linspace(0.0, 1.0, 31), np.linspace(0.0, 0.01, 2), np.linspace(0.0, 0.012, 2))
    value = free_eigenvalues(Mesh(lines, np.ones((30, 1, 1), dtype=bool)), 0.3, 2)
    inertia = np.array([0.01, 0.012]) ** 2 / 12.0
    np.testing.assert_allclose(np.sqrt(value), 4.7300407449**2 * np.sqrt(inertia), rtol=2e-3)


@pytest.mark.parametrize(("name", "poissons_ratio"), [("bar 10:1", 0.3), ("plate 20:1", 0.49)])
def test_default_frequencies(name: str, poissons_ratio: float) -> None:
    """The first six frequencies of the default body are those of finite elements."""
    low, high = errors(name, poissons_ratio)
    assert -0.01 < low and high < LIMITS[poissons_ratio]


@pytest.mark.slow
@pytest.mark.parametrize("poissons_ratio", LIMITS)
@pytest.mark.parametrize("name", [*BARS, *CORNERS])
def test_frequencies_of_every_solid(name: str, poissons_ratio: float) -> None:
    """Likewise for every solid and Poisson's ratio."""
    low, high = errors(name, poissons_ratio)
    assert -0.01 < low and high < max(LIMITS[poissons_ratio], CORNERS.get(name, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("poissons_ratio", LIMITS)
@pytest.mark.parametrize("name", BARS)
def test_eighty_functions(name: str, poissons_ratio: float) -> None:
    """With 80 functions bars and plates are within 2 %."""
    low, high = errors(name, poissons_ratio, function_count=80)
    assert -0.01 < low and high < 0.02


@pytest.mark.parametrize("name", CASES)
def test_two_moduli(name: str) -> None:
    """A jump of ten times, in no relation to the grid, costs 6 % at most in the first six frequencies."""
    size, axis, jump = CASES[name]
    mesh, moduli = two_moduli_mesh(size, axis, jump)
    quadrature = quadrature_from_box(size)
    options = BuildOptions(poissons_ratio=0.3)
    body = build_body(quadrature, options, stiffness_scale=two_moduli(axis, jump), progress=False)
    low, high = frequency_errors(body, free_eigenvalues(mesh, 0.3, stiffness=moduli), 0.3)
    assert -0.06 < low and high < 0.06


def test_few_points_are_not_soft() -> None:
    """A bar of 1,500 points is within 2 %: kernels do not move between the points."""
    solid = SOLIDS["bar 10:1"]()
    body = build_body(quadrature_from_mesh(*solid.surface(), point_count=1500), progress=False)
    low, high = frequency_errors(body, solid.eigenvalues(0.4), 0.4)
    assert -0.02 < low and high < 0.03
