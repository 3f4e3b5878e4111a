"""Quadrature of densities: mass, disks and integrator points; the equations as printed in PIE-NeRF fail.

Builds one body from a density's points on a grid and one from scattered points.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import pdist, squareform

from softmode.deformables import (
    BuildOptions,
    build_body,
    quadrature_from_box,
    quadrature_from_density,
    with_integrator_points,
)
from softmode.deformables.quadrature.quadrature_density import ALPHA, KAPPA, disk_radii
from softmode.errors import AssetError, ConfigError

BOX = np.array([[-0.07, -0.07, -0.05], [0.07, 0.07, 0.05]])
SIGMA = 2.0e3
"""Density of what is opaque over millimetres [1/m]."""
FEW = {"surface_count": 16}
"""Samples of the surface, which these tests do not look at."""


def opaque(inside):
    """Return a density that is SIGMA where a predicate holds, else 0."""
    return lambda x: np.where(inside(x), SIGMA, 0.0)


SOLIDS = {
    "sphere": (opaque(lambda x: np.linalg.norm(x, axis=1) < 0.04), 4.0 / 3.0 * np.pi * 0.04**3),
    "box": (opaque(lambda x: (np.abs(x) < [0.05, 0.03, 0.02]).all(axis=1)), 0.1 * 0.06 * 0.04),
    "torus": (
        opaque(lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.04, x[:, 2]) < 0.015),
        2.0 * np.pi**2 * 0.04 * 0.015**2,
    ),
}


@pytest.mark.parametrize("sampling", ["grid", "poisson"])
@pytest.mark.parametrize("name", SOLIDS)
def test_total_mass(name, sampling):
    """The weights sum to the volume within 1 %, and the centroid of a symmetric solid lies in its middle."""
    sigma, volume = SOLIDS[name]
    found = quadrature_from_density(sigma, BOX, sampling=sampling, point_count=2000, **FEW)
    assert found.weights.sum() == pytest.approx(volume, rel=0.01)
    assert abs(len(found.points) / 2000 - 1.0) < 0.3
    scatter = 0.1 / np.sqrt(2000) if sampling == "poisson" else 1.5e-4
    np.testing.assert_allclose(found.weights @ found.points / volume, 0.0, atol=scatter)
    assert (sigma(found.points) > 0.0).mean() > 0.9  # some lie on the far side of a face, by less than a voxel


def test_soft_density():
    """A Gaussian haze has the volume of its occupancy over the 95th percentile, whatever the unit of length."""
    small = quadrature_from_density(lambda x: 100.0 * np.exp(-((x / 0.02) ** 2).sum(axis=1)), BOX, **FEW)
    large = quadrature_from_density(
        lambda x: 100.0 / 128.0 * np.exp(-((x / 2.56) ** 2).sum(axis=1)), 128.0 * BOX, **FEW
    )
    assert large.volume == pytest.approx(128.0**3 * small.volume, rel=1e-6)
    np.testing.assert_allclose(large.points, 128.0 * small.points, atol=1e-6)


def test_fog():
    """A ball of fog with a thicker cap has the volume of the ball, and the report says that it is fog; walls are not.

    Half of the 95th percentile is the cap alone.
    """
    near, volume = lambda x: np.linalg.norm(x, axis=1) < 0.04, 4.0 / 3.0 * np.pi * 0.04**3
    found = quadrature_from_density(lambda x: np.where(near(x), np.where(x[:, 2] > 0.02, 400.0, 60.0), 0.0), BOX, **FEW)
    assert found.volume == pytest.approx(volume, rel=0.05)
    assert found.report["fog"] > 1.0 and found.report["level_share"] < 0.5
    walls = quadrature_from_density(opaque(near), BOX, **FEW)
    assert walls.report["fog"] < 0.5 and walls.report["level_share"] == 0.5


def shell(beta, wall):
    """Return the density of a hollow ball of 40 mm whose walls have a tail of some width: Psi(-s / beta) / beta."""

    def sigma(x):
        s = np.abs(np.linalg.norm(x, axis=1) - 0.04 + 0.5 * wall) - 0.5 * wall
        tail = 0.5 * np.exp(-np.abs(s) / beta)
        return np.where(s > 0.0, tail, 1.0 - tail) / beta

    return sigma


@pytest.mark.parametrize("beta", [1.0e-4, 4.0e-4, 1.0e-3])
def test_cut(beta):
    """Walls of 5 mm have their volume whatever the width of the tail, which is cut at s = 0.

    Half of the occupancy is up to 0.8 mm further out, a third of the wall; a narrow tail is followed in steps of a
    quarter of a voxel.
    """
    found = quadrature_from_density(shell(beta, 0.005), BOX, fill_voids=False, **FEW)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * (0.04**3 - 0.035**3), rel=0.02)
    assert found.report["fog"] < 0.7


@pytest.mark.parametrize("wall", [0.002, 0.004])
def test_cut_of_filled_voids(wall):
    """Behind walls of one or two voxels what was filled stays full: the ball has its volume."""
    found = quadrature_from_density(shell(4.0e-4, wall), BOX, **FEW)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.04**3, rel=0.02)


def test_voids_and_parts():
    """A hollow shell is filled, a floater is left out, and the report says so, and where a faint lid closes it."""

    def shell(x):
        return (np.abs(np.linalg.norm(x, axis=1) - 0.035) < 0.005) | (np.linalg.norm(x - 0.045, axis=1) < 0.005)

    filled = quadrature_from_density(opaque(shell), BOX, **FEW)
    assert filled.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.04**3, rel=0.01)
    assert filled.report["filled_share"] == pytest.approx((0.03 / 0.04) ** 3, rel=0.05)
    assert 1e-3 < filled.report["detached_share"] < 1e-2 and filled.report["open_share"] < 1e-3
    faint = quadrature_from_density(lambda x: np.where(x[:, 2] > 0.025, 0.12, 1.0) * opaque(shell)(x), BOX, **FEW)
    assert faint.report["open_share"] == pytest.approx((0.03 / 0.04) ** 3, rel=0.1)
    hollow = quadrature_from_density(opaque(shell), BOX, fill_voids=False, **FEW)
    assert hollow.volume == pytest.approx(4.0 / 3.0 * np.pi * (0.04**3 - 0.03**3), rel=0.01)


def test_disks_keep_apart():
    """No point lies in the disk of another: |x - y| >= max(r(x), r(y)) >= the least radius; a seed gives its bits."""
    found, again = (
        quadrature_from_density(SOLIDS["sphere"][0], BOX, sampling="poisson", point_count=800, **FEW) for _ in range(2)
    )
    np.testing.assert_array_equal(found.points, again.points)
    apart = squareform(pdist(found.points)) + np.eye(len(found.points))
    nearest = apart.min(axis=1)
    radii = (found.weights / found.weights.sum() * found.report["ball_volume"] * found.volume * 0.75 / np.pi) ** (1 / 3)
    assert (nearest >= radii * (1.0 - 1e-9)).all()
    rim = np.linalg.norm(found.points, axis=1) > 0.036
    assert nearest[rim].mean() < 0.8 * nearest[~rim].mean()  # finer where occupancy rises


def test_printed_volumes_are_too_large():
    """Equation 4, V = 4/3 pi r^3, weighs a filled solid half as much again and more: balls overlap."""
    for sigma, _ in SOLIDS.values():
        found = quadrature_from_density(sigma, BOX, sampling="poisson", point_count=1000, **FEW)
        assert found.report["ball_volume"] > 1.5


def test_printed_radius_depends_on_the_unit():
    """Equation 3 as printed, kappa / sqrt(|grad sigma| + alpha), is no length: r must scale with the object."""
    slope, spacing = np.array([0.0, 10.0, 300.0]), 0.01
    millimetres = disk_radii(slope / 1e3, spacing * 1e3)
    np.testing.assert_allclose(millimetres, 1e3 * disk_radii(slope, spacing), rtol=1e-12)
    printed = [KAPPA / np.sqrt(s + ALPHA) for s in (slope, slope / 1e3)]
    assert not np.allclose(printed[1], 1e3 * printed[0], rtol=0.1)


def test_integrator_points_keep_moments():
    """Volume, centroid and second moments are those of the fine points; the uncentred C of the paper moves along."""
    fine = quadrature_from_box((0.2, 0.05, 0.04), **FEW)
    coarse = with_integrator_points(fine, 60)
    for power in (lambda x: np.ones(len(x)), lambda x: x.T, lambda x: np.einsum("ni,nj->ijn", x, x)):
        exact, found = (power(q.points) @ q.weights for q in (fine, coarse))
        np.testing.assert_allclose(found, exact, rtol=1e-10, atol=1e-18)
    shift = np.array([1.0, 0.0, 0.0])
    printed = [np.einsum("n,ni,nj->ij", fine.weights, x, x) for x in (fine.points, fine.points + shift)]
    assert np.linalg.norm(printed[1] - printed[0]) > 10.0 * np.linalg.norm(printed[0])


def test_one_point_per_cell_loses_rank():
    """Monomials of degree two in 8 cells: one point each sees 8 of 10 functions, eight points all; equation 11."""
    coarse = with_integrator_points(quadrature_from_box((1.0, 0.8, 0.6), **FEW), 8)
    x = coarse.points - coarse.points.mean(axis=0)

    def mass(points):
        one = np.ones((len(points), 1))
        products = np.stack([points[:, i] * points[:, j] for i in range(3) for j in range(i, 3)], axis=1)
        values = np.concatenate([one, points, products], axis=1)
        return np.linalg.matrix_rank(values.T @ values, tol=1e-10)

    assert mass(x) == 10
    assert mass(x.reshape(-1, 8, 3).mean(axis=1)) < 10


def test_bodies_of_both_kinds():
    """A bar of disks and one of integrator points have functions as independent as a grid's are."""
    sigma = opaque(lambda x: (np.abs(x) < [0.06, 0.015, 0.015]).all(axis=1))
    grid = quadrature_from_density(sigma, BOX, point_count=3000, **FEW)
    options = BuildOptions(cubature_count=None, function_count=20, kernel_count=100)
    least = []
    disks = quadrature_from_density(sigma, BOX, sampling="poisson", point_count=3000, **FEW)
    for quadrature in (disks, with_integrator_points(grid, 200)):
        body = build_body(quadrature, options)
        assert body.volume == pytest.approx(0.12 * 0.03 * 0.03, rel=0.01)
        b = body.evaluate(quadrature.points - body.offset)[0]
        spectrum = np.linalg.eigvalsh((b.T * quadrature.weights) @ b / body.volume)
        least.append(spectrum[0] / spectrum[-1])
    assert min(least) > 1e-10


@pytest.mark.parametrize(
    ("sigma", "options", "word"),
    [
        (lambda x: np.full(len(x), np.nan), {}, "finite"),
        (lambda x: x[:, 0], {}, "negative"),
        (lambda x: np.zeros(len(x)), {}, "empty"),
        (lambda x: np.full(len(x), 5.0), {}, "everywhere"),
        (lambda x: np.zeros(3), {}, "shape"),
        (SOLIDS["box"][0], {"sampling": "mesh"}, "sampling"),
        (SOLIDS["box"][0], {"radius": -1.0}, "radius"),
        (SOLIDS["box"][0], {"resolution": 4}, "resolution"),
    ],
)
def test_bad_input(sigma, options, word):
    """What is no density of an object is refused by name."""
    with pytest.raises((AssetError, ConfigError), match=word):
        quadrature_from_density(sigma, BOX, **options)


def test_bad_bounds():
    """Bounds must be a box."""
    with pytest.raises(AssetError, match="bounds"):
        quadrature_from_density(SOLIDS["box"][0], BOX[::-1])
    with pytest.raises(ConfigError, match="count"):
        with_integrator_points(quadrature_from_box((1.0, 1.0, 1.0), point_count=100), 10**6)
