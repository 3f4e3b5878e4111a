"""Static responses and harmonic weights: closed forms, stationarity, the accuracy they buy.

Builds bodies with and without static responses, which is what it tests.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from softmode.deformables.body.regions import Envelope, Region
from softmode.deformables.body.rkpm import ShapeFunctions, make_basis
from softmode.deformables.body.skinning_weights import enveloped
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.eigenmodes import solve_eigenmodes
from softmode.deformables.reduction.galerkin import elastic_matrix, mass_and_gradient_matrix, mass_matrix
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.region_samples import pieces_near, refine_at_faces
from softmode.deformables.reduction.static_response import (
    lame_parameters,
    second_order_load,
    solve_harmonic_weights,
    solve_static_responses,
)
from tests.bodies import RECIPES, quadratic_box

INF = np.inf
SIZE = np.array([0.4, 0.1, 0.1])
LEFT = Region(name="left", box=((-INF, -INF, -INF), (-0.15, INF, INF)))
RIGHT = Region(name="right", box=((0.15, -INF, -INF), (INF, INF, INF)))


@pytest.fixture(scope="module")
def quadrature() -> Quadrature:
    """Return a short beam."""
    return quadrature_from_box(SIZE, point_count=1600, surface_count=40)


def held(quadrature: Quadrature, *regions: Region, kernel_count: int = 150) -> tuple[ShapeFunctions, np.ndarray]:
    """Return kernels that vanish on regions, and quadrature weights."""
    pieces = pieces_near(quadrature, regions)
    points, weights, _ = refine_at_faces(regions, pieces, np.zeros(3))
    basis = make_basis(pieces.points, kernel_count, spacing=quadrature.spacing)
    return enveloped(basis.evaluate(points), Envelope(regions, 0.1) if regions else None)[0], weights


def test_blocked_sums_equal_plain_ones(quadrature: Quadrature) -> None:
    """Matrices summed by groups of points equal products over all points, and are symmetric to the last bit."""
    shape, weights = held(quadrature)
    value, gradient = shape.value.toarray(), [g.toarray() for g in shape.gradient]
    mass, energy = mass_and_gradient_matrix(shape, weights, 2.0 * weights)
    np.testing.assert_array_equal(mass, mass_matrix(shape, weights))
    np.testing.assert_allclose(mass, value.T @ (weights[:, None] * value), atol=1e-13 * mass.max())
    plain = sum(g.T @ (2.0 * weights[:, None] * g) for g in gradient)
    np.testing.assert_allclose(energy, plain, atol=1e-12 * energy.max())
    mu, lame = lame_parameters(0.3)
    count = shape.centre_count
    stiffness = elastic_matrix(shape, weights, mu, lame)
    for matrix in (mass, energy, stiffness):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-16 * np.abs(matrix).max())
    # The energy of a random displacement: sum_p w_p (mu e : e + lambda/2 (tr e)^2).
    u = np.random.default_rng(0).normal(size=(3, count))
    slope = np.stack([[gradient[d] @ u[a] for d in range(3)] for a in range(3)])
    strain = 0.5 * (slope + slope.transpose(1, 0, 2))
    trace = strain[0, 0] + strain[1, 1] + strain[2, 2]
    expected = weights @ (mu * (strain**2).sum(axis=(0, 1)) + 0.5 * lame * trace**2)
    assert 0.5 * u.ravel() @ stiffness @ u.ravel() == pytest.approx(expected, rel=1e-12)


def test_rigid_motion_costs_no_elastic_energy(quadrature: Quadrature) -> None:
    """Translations and infinitesimal rotations lie in the null space of the elastic matrix."""
    basis = make_basis(quadrature.points, 150, spacing=quadrature.spacing)
    shape = basis.evaluate(quadrature.points)
    matrix = elastic_matrix(shape, quadrature.weights, *lame_parameters(0.3))
    ones, x = np.ones(150), basis.centres
    zero = np.zeros(150)
    motions = [np.concatenate(m) for m in ([ones, zero, zero], [zero, ones, zero], [zero, zero, ones])]
    motions += [np.concatenate(m) for m in ([-x[:, 1], x[:, 0], zero], [zero, -x[:, 2], x[:, 1]])]
    for motion in motions:
        assert motion @ matrix @ motion < 1e-10 * np.trace(matrix) * (motion @ motion) / len(motion)


def test_axial_response_is_that_of_a_hanging_bar(quadrature: Quadrature) -> None:
    """At nu = 0 the axial response to an axial force is u = f (L s - s^2 / 2) / E with s the distance to the clamp."""
    shape, weights = held(quadrature, LEFT)
    ones = np.ones(len(weights))
    found = solve_static_responses(shape, weights, density=ones, poissons_ratio=0.0, stiffness_scale=ones)
    axial = np.asarray(shape.value @ found)[:, 0]
    s = np.maximum(shape.points[:, 0] + 0.15, 0.0)
    expected = 0.35 * s - 0.5 * s**2
    expected /= np.sqrt((weights / weights.sum()) @ expected**2)
    error = np.sqrt((weights / weights.sum()) @ (axial - expected) ** 2)
    assert error < 5e-3


def test_response_of_a_stiff_half_and_a_dense_half(quadrature: Quadrature) -> None:
    """A bar ten times as stiff beyond its middle, and twice as dense there: u' = N(s) / E(s), N the weight beyond s."""
    shape, weights = held(quadrature, LEFT, kernel_count=300)
    x = shape.points[:, 0]
    stiff, dense = np.where(x > 0.0, 10.0, 1.0), np.where(x > 0.0, 2.0, 1.0)
    found = solve_static_responses(shape, weights, density=dense, poissons_ratio=0.0, stiffness_scale=stiff)
    axial = np.asarray(shape.value @ found)[:, 0]
    s = np.linspace(-0.15, 0.2, 20001)
    load = np.where(s > 0.0, 2.0 * (0.2 - s), 0.4 - s)
    slope = load / np.where(s > 0.0, 10.0, 1.0)
    exact = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(s))])
    expected = np.interp(x, s, exact)
    expected /= np.sqrt((weights / weights.sum()) @ expected**2)
    assert np.sqrt((weights / weights.sum()) @ (axial - expected) ** 2) < 0.02


def test_harmonic_weights_are_linear_between_two_ends(quadrature: Quadrature) -> None:
    """Springs pull a weight to one at an end and to zero at the other: of least gradient energy, it falls linearly."""
    basis = make_basis(quadrature.points, 250, spacing=quadrature.spacing)
    shape, springs, pull = basis.evaluate(quadrature.points), np.zeros((250, 250)), []
    for end in (LEFT, RIGHT):
        soft = dataclasses.replace(end, stiffness=1e6)
        pieces = pieces_near(quadrature, [soft])
        x, w = soft.integrate(pieces.points, pieces.weights, pieces.edges, pieces.axes)
        springs += mass_matrix(basis.evaluate(x), 1e6 * w)
        pull.append(basis.evaluate(x).value.T @ (1e6 * w))
    load, ones = np.stack(pull, axis=1), np.ones(len(quadrature.points))
    given = {"stiffness_scale": ones, "springs": springs, "spring_load": load}
    weight = np.asarray(shape.value @ solve_harmonic_weights(shape, quadrature.weights, **given))
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-9)
    expected = np.clip((0.15 - quadrature.points[:, 0]) / 0.3, 0.0, 1.0)
    assert np.abs(weight[:, 0] - expected).max() < 0.03


def test_modes_of_a_held_beam(quadrature: Quadrature) -> None:
    """Vanishing on one end, the axial eigenvalues are (pi (a + 1/2) / L)^2; springs that stiffen approach them."""
    shape, weights = held(quadrature, LEFT, kernel_count=250)
    modes = solve_eigenmodes(shape, weights, 2, vanishing=True)
    expected = (np.pi * np.array([0.5, 1.5]) / 0.35) ** 2
    np.testing.assert_allclose(modes.eigenvalues[1:], expected, rtol=0.02)
    basis = make_basis(quadrature.points, 250, spacing=quadrature.spacing)
    plain = basis.evaluate(quadrature.points)
    soft = dataclasses.replace(LEFT, stiffness=1.0)
    pieces = pieces_near(quadrature, [soft])
    x, w = soft.integrate(pieces.points, pieces.weights, pieces.edges, pieces.axes)
    previous = 0.0
    for stiffness in (1e1, 1e3, 1e5):
        springs = mass_matrix(basis.evaluate(x), stiffness * w)
        value = solve_eigenmodes(plain, quadrature.weights, 2, springs=springs).eigenvalues[1]
        assert previous < value < 1.1 * expected[0]
        previous = value
    assert previous > 0.8 * expected[0]


def test_responses_carry_a_clamped_beam(quadrature: Quadrature) -> None:
    """The linear sag of a held beam lies in the functions: with responses its compliance is that of all kernels."""
    options = BuildOptions(mode_count=3, kernel_count=150, cubature_count=None, poissons_ratio=0.45)
    mu, lame = lame_parameters(0.45)

    def compliance(grad: np.ndarray, weights: np.ndarray, load: np.ndarray) -> float:
        """Return f . u of K u = f, f along z."""
        n = grad.shape[1]
        product = np.einsum("p,pka,plb->kalb", weights, grad, grad, optimize=True)
        stiffness = lame * product.transpose(0, 1, 2, 3) + mu * product.transpose(0, 3, 2, 1)
        stiffness = stiffness + mu * np.einsum("kclc,ab->kalb", product, np.eye(3))
        force = np.zeros((n, 3))
        force[:, 2] = load
        return float(force.ravel() @ np.linalg.solve(stiffness.reshape(3 * n, 3 * n), force.ravel()))

    found = {}
    for responses in (True, False):
        body = build_body(quadrature, dataclasses.replace(options, static_responses=responses), regions=(LEFT,))
        r = body.driven_count
        grad = body.cubature.grad_basis[:, r:].astype(float)
        found[responses] = compliance(grad, body.cubature.weights, body.volume * body.mean_basis[r:])
    shape, weights = held(quadrature, LEFT)
    free = np.flatnonzero(np.asarray(shape.value.multiply(shape.value).sum(axis=0)).ravel() > 1e-12)
    grad = np.stack([g.toarray()[:, free] for g in shape.gradient], axis=2)
    reference = compliance(grad, weights, np.asarray(shape.value.T @ weights).ravel()[free])
    assert found[True] == pytest.approx(reference, rel=0.01)
    assert found[False] < 0.9 * reference


def test_second_order_load_is_the_second_derivative_of_the_force(quadrature: Quadrature) -> None:
    """Mixed central differences of f = sum_p V_p (I + H) S : grad phi, S = C : (H + H^T + H^T H) / 2, at H = 0."""
    shape, weights = held(quadrature, LEFT)
    rng = np.random.default_rng(1)
    stiff = weights * rng.uniform(0.5, 2.0, size=len(weights))
    mu, lame = lame_parameters(0.35)
    response = rng.normal(size=(3, 3, shape.centre_count))
    slopes = [np.stack([g @ u.T for g in shape.gradient], axis=2) for u in response]
    slopes = [h / np.sqrt(stiff @ (h**2).sum(axis=(1, 2)) / stiff.sum()) for h in slopes]

    def force(q: np.ndarray) -> np.ndarray:
        h = np.einsum("i,ipab->pab", q, np.array(slopes))
        strain = 0.5 * (h + h.transpose(0, 2, 1) + h.transpose(0, 2, 1) @ h)
        stress = lame * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2.0 * mu * strain
        p = (np.eye(3) + h) @ stress * stiff[:, None, None]
        return np.sum([(g.T @ p[:, :, d]).T for d, g in enumerate(shape.gradient)], axis=0).ravel()

    load = second_order_load(shape.gradient, stiff, response, 0.35)[0]
    step, unit = 1e-3, np.eye(3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    for column, (i, j) in enumerate(pairs):
        plus = force(step * (unit[i] + unit[j])) + force(-step * (unit[i] + unit[j]))
        minus = force(step * (unit[i] - unit[j])) + force(step * (unit[j] - unit[i]))
        second = (plus - minus) / (4.0 * step**2)
        np.testing.assert_allclose(load[:, column], -second, atol=10 * step**2 * np.abs(load).max())


def test_response_derivatives_come_after_the_responses(quadrature: Quadrature) -> None:
    """Nine weights of unit mean square first, the same with and without derivatives; then as many as asked for."""
    shape, weights = held(quadrature, LEFT)
    options = {"density": np.ones(len(weights)), "poissons_ratio": 0.4, "stiffness_scale": np.ones(len(weights))}
    first = solve_static_responses(shape, weights, **options)
    both = solve_static_responses(shape, weights, **options, derivative_count=6)
    np.testing.assert_array_equal(both[:, :9], first)
    assert both.shape[1] == 15
    value = np.asarray(shape.value @ both)
    np.testing.assert_allclose((weights / weights.sum()) @ value**2, 1.0, rtol=1e-10)


def test_quadratic_handles_reproduce_quadratics() -> None:
    """With quadratic handles every polynomial of degree two is a combination of the functions, and n counts them."""
    quadrature, body = RECIPES["quadratic_box"]().integrate(), quadratic_box()
    assert 20 < body.function_count <= 30
    x = quadrature.points - body.offset
    value, gradient = body.evaluate(x)
    share = quadrature.weights / quadrature.volume
    assert np.abs((value * share[:, None]).T @ value - np.eye(body.function_count)).max() < 1e-10
    polynomial = np.column_stack([x[:, 0] ** 2, x[:, 1] * x[:, 2], x[:, 2] ** 2 - x[:, 0] * x[:, 1]])
    q = value.T @ (share[:, None] * polynomial)
    np.testing.assert_allclose(value @ q, polynomial, atol=1e-10 * np.abs(polynomial).max())
    slope = np.einsum("pkd,kc->pcd", gradient, q)
    np.testing.assert_allclose(slope[:, 0, 0], 2.0 * x[:, 0], atol=1e-8 * np.abs(x).max())
    np.testing.assert_allclose(slope[:, 1, 1], x[:, 2], atol=1e-8 * np.abs(x).max())
