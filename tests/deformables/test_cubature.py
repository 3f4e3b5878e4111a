"""Cubature: exact volume, non-negative weights, small force error on poses it has not seen.

Builds bodies with numbers of cubature points, which is what it tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction import cubature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cubature import select_cubature
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.reduced_stiffness import elastic_modes, reduced_stiffness
from softmode.errors import BasisError, ConfigError
from tests.bodies import RECIPES, cube, small_box
from tests.reference import lame, stress

LENGTH = 0.05


@pytest.fixture(scope="module")
def full() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, weights and basis gradients of a box on the full quadrature."""
    quadrature, body = RECIPES["small_box"]().integrate(), small_box()
    return quadrature.points, quadrature.weights, body.evaluate(quadrature.points - body.offset)[1]


def reduced_force(weights: np.ndarray, grad_basis: np.ndarray, stretch: np.ndarray, q: np.ndarray) -> np.ndarray:
    """f_k = sum_p w_p P(F_p) grad b_k with F = A (I + sum_k q_k grad b_k^T)."""
    deformation = stretch @ (np.eye(3) + np.einsum("ki,pkj->pij", q, grad_basis, optimize=True))
    found = stress(MaterialModel.STABLE_NEO_HOOKEAN_LOG, deformation, *lame(1.0, 0.4))
    return np.einsum("p,pij,pkj->ki", weights, found, grad_basis, optimize=True)


def test_stress_is_that_of_the_reference() -> None:
    """The vectorised stress agrees with the readable twin for random deformations, inverted ones included."""
    f = np.random.default_rng(0).normal(size=(20, 3, 3)) + np.eye(3)
    found = cubature._stress(np.moveaxis(f, 0, 2), *lame(1.0, cubature.POISSON_RATIO))
    expected = stress(MaterialModel.STABLE_NEO_HOOKEAN_LOG, f, *lame(1.0, cubature.POISSON_RATIO))
    np.testing.assert_allclose(np.moveaxis(found, 2, 0), expected, rtol=1e-12, atol=1e-12)


def test_volume_weights_and_count(full) -> None:
    """Weights are positive and sum to the volume; no point is taken twice."""
    _, weights, gradient = full
    found = select_cubature(weights, gradient, 100)
    assert len(found.index) == len(np.unique(found.index)) == 100
    assert (found.weights > 0.0).all()
    assert abs(found.weights.sum() / weights.sum() - 1.0) < 1e-14


def test_force_error_on_unseen_large_deformations(full) -> None:
    """At 256 points the reduced force under random large deformations equals that of all points to 1 % rms."""
    _, weights, gradient = full
    found = select_cubature(weights, gradient, 256)
    slope = np.sqrt(np.einsum("p,pkj->k", weights / weights.sum(), gradient**2))
    rng = np.random.default_rng(77)
    errors = []
    for k in range(10):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        stretch = rotation * np.sign(np.linalg.det(rotation)) @ np.diag(rng.uniform(0.7, 1.5, size=3))
        q = np.zeros((len(slope), 3))
        q[4:] = rng.normal(size=(len(slope) - 4, 3)) / slope[4:, None] ** (1 + k % 2)
        q *= rng.uniform(0.1, 0.35) / np.linalg.norm(q * slope[:, None])
        exact = reduced_force(weights, gradient, stretch, q)[1:] / slope[1:, None]
        few = reduced_force(found.weights, gradient[found.index], stretch, q)[1:] / slope[1:, None]
        errors.append(np.linalg.norm(few - exact) / np.linalg.norm(exact))
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert found.force_error < 0.01


def test_reduced_stiffness_is_the_derivative_of_the_force(full) -> None:
    """K q = (f(h q) - f(-h q)) / 2 h, h q of strain 1e-5; for any E, so for E per point too."""
    _, weights, gradient = full
    q = np.random.default_rng(3).normal(size=(gradient.shape[1], 3))
    h = 1e-5 / np.linalg.norm(np.einsum("pkj,ki->pij", gradient, q), axis=(1, 2)).max()
    ahead, behind = (reduced_force(weights, gradient, np.eye(3), sign * h * q) for sign in (1.0, -1.0))
    found = reduced_stiffness(gradient.transpose(1, 2, 0), weights, 0.4) @ q.T.ravel()
    np.testing.assert_allclose(found.reshape(3, -1).T, (ahead - behind) / (2.0 * h), atol=1e-8 * np.abs(found).max())


def test_elastic_modes_of_a_free_body(full) -> None:
    """All but six motions store energy; modes have energy phi^T K phi = 1 and none in common."""
    _, weights, gradient = full
    stiffness = reduced_stiffness(gradient.transpose(1, 2, 0), weights, 0.4)
    value, mode = elastic_modes(stiffness)
    assert len(value) == len(stiffness) - 6
    assert (np.diff(value) >= 0.0).all()
    np.testing.assert_allclose(mode.T @ stiffness @ mode, np.eye(len(value)), atol=1e-9)


@pytest.mark.rest
def test_soft_modes_of_a_thin_held_plate() -> None:
    """A plate 40:1, held at one end: the lowest 12 eigenvalues of few points are those of all points to 5 %."""
    quadrature = quadrature_from_box((1.0, 0.6, 0.025), point_count=4000)
    held = Region(name="held", box=((-np.inf,) * 3, (-0.4, np.inf, np.inf)))
    bodies = [
        build_body(quadrature, BuildOptions(kernel_count=200, cubature_count=count), regions=[held], progress=False)
        for count in (None, 384)
    ]
    full, few = (
        elastic_modes(
            reduced_stiffness(
                body.cubature.grad_basis[:, body.driven_count :].astype(np.float64).transpose(1, 2, 0),
                body.cubature.weights,
                0.4,
            )
        )[0][:12]
        for body in bodies
    )
    error = few / full - 1.0
    assert np.abs(error).max() < 0.05
    assert bodies[0].provenance["soft_mode_error"] == 0.0
    # Functions are stored in float32, which the reported error does not see.
    assert bodies[1].provenance["soft_mode_error"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.05)


def test_more_points_are_better_and_reported(full) -> None:
    """The reported trade-off falls with the count, and its entry is what a choice of that size reports."""
    _, weights, gradient = full
    found = select_cubature(weights, gradient, 192)
    assert sorted(found.trade_off) == [32, 64, 96, 128, 192]
    errors = [found.trade_off[k] for k in sorted(found.trade_off)]
    assert (np.diff(errors) < 0.0).all()
    assert found.trade_off[192] == found.force_error
    assert select_cubature(weights, gradient, 64).force_error == found.trade_off[64]


def test_homogeneous_stretch_keeps_its_force(full) -> None:
    """Sum w grad b is fitted directly, so the force of a uniform strain is better than the general error."""
    _, weights, gradient = full
    found = select_cubature(weights, gradient, 256)
    exact = np.einsum("p,pkj->kj", weights, gradient)
    few = np.einsum("p,pkj->kj", found.weights, gradient[found.index])
    assert np.linalg.norm(few - exact) < 0.01 * np.linalg.norm(exact)


def test_heterogeneous_modulus_is_weighed(full) -> None:
    """With a stiff inclusion the force error stays small and the volume exact."""
    points, weights, gradient = full
    modulus = np.where(np.linalg.norm(points, axis=1) < 0.015, 20.0, 1.0)
    found = select_cubature(weights, gradient, 256, stiffness_scale=modulus)
    assert found.force_error < 0.02
    assert abs(found.weights.sum() / weights.sum() - 1.0) < 1e-14


def test_deterministic_and_seeded(full) -> None:
    """One seed gives bitwise one result; another seed another choice."""
    _, weights, gradient = full
    first, again, other = (select_cubature(weights, gradient, 64, seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(first.index, again.index)
    np.testing.assert_array_equal(first.weights, again.weights)
    assert not np.array_equal(first.index, other.index)


@pytest.mark.rest
def test_the_best_trial_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no trial meets the goal the body has the one that errs least, though a later one errs more."""
    errors = []

    def poorer(weights: np.ndarray, gradient: np.ndarray, count: int, **settings: Any) -> cubature.Cubature:
        found = select_cubature(weights, gradient, count if len(errors) < 2 else 48, **settings)
        errors.append(found.force_error)
        return found

    monkeypatch.setattr("softmode.deformables.reduction.build_body.select_cubature", poorer)
    options = BuildOptions(function_count=36, cubature_count=384, cubature_error=1e-9)
    with pytest.warns(RuntimeWarning, match="cubature_error"):
        body = build_body(quadrature_from_box((0.06, 0.05, 0.04), point_count=800), options, progress=False)
    assert len(errors) == 4 and min(errors) < errors[-1]
    assert body.provenance["cubature_force_error"] == min(errors)
    assert len(body.cubature.points) > 48


def test_all_points_and_bad_input(full) -> None:
    """A count beyond P keeps everything; too few points and NaN gradients raise."""
    _, weights, gradient = full
    everything = select_cubature(weights, gradient, 10**6)
    np.testing.assert_array_equal(everything.weights, weights)
    assert everything.force_error == everything.soft_mode_error == 0.0
    with pytest.raises(ConfigError, match="cubature_count"):
        select_cubature(weights, gradient, 4)
    with pytest.raises(BasisError, match="grad_basis"):
        select_cubature(weights, np.full_like(gradient, np.nan), 16)


def test_points_end_where_the_fit_ends_in_rounding() -> None:
    """Few functions ask for few points: more than they need add none, and do not depend on how many were asked for."""
    quadrature, body = RECIPES["cube"](mode_count=1).integrate(), cube(mode_count=1)
    gradient = body.evaluate(quadrature.points - body.offset)[1]
    found, again = (select_cubature(quadrature.weights, gradient, count) for count in (600, 900))
    assert len(found.index) < 600 and found.force_error < 3e-4
    np.testing.assert_array_equal(found.index, again.index)
    np.testing.assert_array_equal(found.weights, again.weights)


def build(count: int, error: float | None) -> ReducedBody:
    """Return a brick of so many cubature points, or more where forces err by more than asked for."""
    quadrature = quadrature_from_box((0.1, 0.06, 0.03), point_count=1500, surface_count=100)
    options = BuildOptions(kernel_count=150, cubature_count=count, cubature_error=error)
    return build_body(quadrature, options, progress=False)


@pytest.mark.rest
def test_a_smaller_number_of_points_stays_and_what_cannot_be_reached_is_told() -> None:
    """96 points are not made more; 768 that leave an error raise a warning."""
    assert build(96, 1e-3).point_count == 96
    with pytest.warns(RuntimeWarning, match="cubature_error: 768 points leave"):
        build(384, 1e-6)


def test_poses_and_points_are_added_where_forces_want_them() -> None:
    """From 384 points on, more poses, then more points, until forces are right."""
    asked = build(384, None)
    left = float(str(asked.provenance["cubature_force_error"]))
    more = build(384, 0.9 * left)
    assert asked.point_count == 384 and more.point_count in (384, 576, 768)
    assert float(str(more.provenance["cubature_force_error"])) <= 0.9 * left
    assert not (more.point_count == 384 and np.array_equal(more.cubature.points, asked.cubature.points))
    assert abs(more.cubature.weights.sum() / more.volume - 1.0) < 1e-12
    with pytest.raises(ConfigError, match="cubature_error"):
        BuildOptions(cubature_error=0.0)
