"""Functions of Q-GMLS: quadratic fields, derivatives, the printed equations that fail, and bodies of them.

Builds bodies of Q-GMLS functions, which is what it tests.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.deformables import (
    BuildOptions,
    ReducedBody,
    Region,
    build_body,
    quadrature_from_box,
    with_integrator_points,
)
from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.reduction.local_handles import COVERED, covering_radii, place_kernels
from softmode.errors import BasisError, ConfigError
from tests.shape_trials import drop

Array = NDArray[np.float64]
SIZE = (0.3, 0.06, 0.04)
CORNERS = np.array(list(itertools.product((-0.5, 0.0, 0.5), repeat=3)))
CURVE = np.random.default_rng(3).normal(size=(3, 3))
SLOPE = np.array([0.3, -1.1, 0.7])


def block(scale: float = 1.0, offset: float = 0.0) -> BasisQGMLS:
    """Return 27 kernels of a block."""
    return BasisQGMLS(centres=scale * CORNERS + offset, radii=np.full(27, 0.8 * scale))


def places(count: int, scale: float = 1.0, offset: float = 0.0) -> Array:
    """Return points of the block."""
    return scale * np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) + offset


def field(x: Array) -> tuple[Array, Array, Array]:
    """Return a quadratic field of unit size, its gradients and its second derivatives."""
    bent = CURVE + CURVE.T
    value = 0.4 + x @ SLOPE + np.einsum("pi,ij,pj->p", x, CURVE, x)
    return value, SLOPE + x @ bent, np.broadcast_to(bent, (len(x), 3, 3))


def coordinates(basis: BasisQGMLS, value: Array, slope: Array, bent: Array) -> Array:
    """Return the coefficients of a field from its value, gradient and second derivatives at the centres."""
    pairs = [bent[:, a, b] for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    columns = (value[:, None], basis.length * slope, basis.length**2 * np.stack(pairs, axis=1))
    return np.concatenate(columns, axis=1).ravel()


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (0.1, 5.0), (10.0, 0.0)])
def test_quadratic_fields_are_exact(scale: float, offset: float) -> None:
    """Value and gradient to 1e-12 of the field, small and far from the origin too."""
    basis, x = block(scale, offset), places(200, scale, offset)
    value, slope, bent = field((basis.centres - offset) / scale)
    u = coordinates(basis, value, slope / scale, bent / scale**2)
    found, gradient = basis.evaluate(x)
    expected = field((x - offset) / scale)
    np.testing.assert_allclose(found @ u, expected[0], atol=1e-12)
    np.testing.assert_allclose(scale * np.einsum("pnd,n->pd", gradient, u), expected[1], atol=1e-12)


def test_gradients_by_differences() -> None:
    """Gradients against central differences, for kernels in no order and of several radii."""
    rng = np.random.default_rng(1)
    basis = BasisQGMLS(centres=rng.uniform(-0.5, 0.5, (12, 3)), radii=rng.uniform(0.8, 1.0, 12))
    x, h = places(50, 0.8), 1e-5
    gradient = basis.evaluate(x)[1]
    for d, step in enumerate(h * np.eye(3)):
        difference = (basis.evaluate(x + step)[0] - basis.evaluate(x - step)[0]) / (2.0 * h)
        np.testing.assert_allclose(difference, gradient[..., d], atol=1e-8 * np.abs(gradient).max())


def test_printed_six_terms_lose_quadratic_fields() -> None:
    """Equations 6 to 8 with six functions of weight one beside nine terms in G: x y comes back with 0.1 % and more."""
    basis, x = block(), places(200)
    u = coordinates(basis, *field(basis.centres))
    printed = basis.evaluate(x)[0].reshape(-1, 27, 10) * [1, 1, 1, 1, 1, 0.5, 0.5, 1, 0.5, 1]
    exact = field(x)[0]
    error = np.abs(printed.reshape(len(x), -1) @ u - exact).max() / np.abs(exact).max()
    assert 1e-3 < error < 0.1


def test_printed_coordinates_lose_digits() -> None:
    """World coordinates in p, 0.1 m large and 5 m away: a thousand times the error of those of the kernels."""
    basis, x = block(0.1, 5.0), places(100, 0.1, 5.0)
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]

    def jets(X: Array) -> Array:
        """Return p, its three first and its six second derivatives in the world's coordinates, (N, 10, 10)."""
        found = np.zeros((len(X), 10, 10))
        found[:, 0, 0] = 1.0
        found[:, 0, 1:4] = X
        found[:, range(1, 4), range(1, 4)] = 1.0
        for k, (a, b) in enumerate(pairs, start=4):
            found[:, 0, k] = X[:, a] * X[:, b]
            found[:, 1 + a, k] += X[:, b]
            found[:, 1 + b, k] += X[:, a]
            found[:, k, k] = 2.0 if a == b else 1.0
        return found

    copies = np.array([1, 1, 1, 1, 1, 2, 2, 1, 2, 1.0])
    f, away = jets(basis.centres), x[:, None] - basis.centres
    w = np.maximum(1.0 - (away**2).sum(axis=2) / basis.radii**2, 0.0) ** 3
    G = np.einsum("pn,nfa,f,nfb->pab", w, f, copies, f, optimize=True)
    y = np.linalg.solve(G, jets(x)[:, 0, :, None])[..., 0]
    world = np.einsum("pn,nfa,f,pa->pnf", w, f, copies, y, optimize=True).reshape(len(x), -1)
    value, slope, bent = field((basis.centres - 5.0) / 0.1)
    second = np.stack([bent[:, a, b] / 0.01 for a, b in pairs], axis=1)
    raw = np.concatenate([value[:, None], slope / 0.1, second], axis=1).ravel()
    exact = field((x - 5.0) / 0.1)[0]
    far = np.abs(world @ raw - exact).max()
    near = np.abs(basis.evaluate(x)[0] @ coordinates(basis, value, slope / 0.1, bent / 0.01) - exact).max()
    assert far > 1e3 * near and near < 1e-13


def test_one_point_per_cell_loses_rank() -> None:
    """Equation 11: the mass of 8 kernels over 64 cells has rank 64 of 80 by their centres, 80 by eight points each."""
    basis = BasisQGMLS(centres=np.array(list(itertools.product((0.25, 0.75), repeat=3))), radii=np.full(8, 0.9))
    middle = np.array(list(itertools.product((np.arange(4) + 0.5) / 4.0, repeat=3)))

    def sizes(x: Array) -> Array:
        return np.asarray(np.linalg.svd(basis.evaluate(x)[0], compute_uv=False), dtype=np.float64)

    size = sizes(middle)
    assert len(size) == 64 and size[-1] > 1e-8 * size[0]
    cells = with_integrator_points(quadrature_from_box((1.0, 1.0, 1.0), point_count=4096), 64)
    size = sizes(cells.points - cells.bounds[0])
    assert len(size) == 80 and size[-1] ** 2 > 1e-10 * size[0] ** 2


@pytest.mark.parametrize("size", [(0.4, 0.4, 0.01), (0.5, 0.01, 0.01)])
def test_kernels_cover_thin_bodies(size: tuple[float, float, float]) -> None:
    """Every point of a plate 40:1 and a rod 50:1 sees two kernels, and one of them well."""
    quadrature = quadrature_from_box(size, point_count=2000)
    basis = place_kernels(quadrature.points, quadrature.weights, 16, np.zeros((0, 4)), seed=0)
    away = np.linalg.norm(quadrature.points[:, None] - basis.centres, axis=2)
    w = np.maximum(1.0 - (away / basis.radii) ** 2, 0.0) ** 3
    assert w.max(axis=1).min() >= COVERED and (w > 0.0).sum(axis=1).min() >= 2


def test_uncovered_points_are_refused() -> None:
    """Points far beyond all kernels: radii grow ten times, then an error says what to do."""
    line = np.arange(8.0)
    between, away = np.abs(line[:, None] - line), np.abs(line[:, None] - np.append(line, 60.0))
    with pytest.raises(BasisError, match="after 10 enlargements"):
        covering_radii(between, away)
    assert (covering_radii(between, np.abs(line[:, None] - np.append(line, 12.0))) >= 1.6 * 2.0).all()
    with pytest.raises(BasisError, match="covered by no kernel"):
        block().evaluate([[3.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def body() -> ReducedBody:
    """Return a bar of all functions of eight kernels."""
    options = BuildOptions(handles="qgmls", local_count=8, cubature_count=None)
    return build_body(quadrature_from_box(SIZE, point_count=2000), options, progress=False)


def test_affine_motion_is_exact(body: ReducedBody) -> None:
    """For 100 random maps, to 1e-10 of the length."""
    rng = np.random.default_rng(2)
    X = rng.uniform(*body.bounds, (100, 3))
    value = body.evaluate(X)[0]
    for _ in range(100):
        A, t = rng.normal(size=(3, 3)), rng.normal(size=3)
        np.testing.assert_allclose(X + value @ body.affine(A, t), X @ A.T + t, atol=1e-10 * SIZE[0])


def test_body_has_the_functions_of_its_kernels(body: ReducedBody) -> None:
    """Its span is theirs: 80 functions less those under the rank tolerance, orthonormal in mass."""
    x = body.sources["points"] - body.offset  # type: ignore[index]
    weight = np.full(len(x), 1.0 / len(x))
    value = body.evaluate(x)[0]
    np.testing.assert_allclose((value.T * weight) @ value, np.eye(body.function_count), atol=1e-9)
    own = BasisQGMLS(centres=body.kernels.centres, radii=body.kernels.radii).evaluate(x)[0]
    left = value - own @ np.linalg.lstsq(own, value, rcond=None)[0]
    assert np.abs(left).max() < 1e-7
    assert 60 < body.function_count <= 80


def test_body_falls_and_is_stored(body: ReducedBody, tmp_path) -> None:
    """The solver moves it; a file gives it back; what wants skinning weights or regions says so."""
    assert drop(body, steps=3) < 1e-6
    body.save(tmp_path / "bar.npz")
    again = ReducedBody.load(tmp_path / "bar.npz")
    x = np.array([[0.1, 0.01, 0.0], [0.5, 0.0, 0.0]])  # The second one lies outside: it is held constant there.
    for found, wanted in zip(again.evaluate(x), body.evaluate(x), strict=True):
        assert np.array_equal(found, wanted)
    assert body.covers(x).tolist() == [True, False]
    with pytest.raises(ConfigError, match="skinning weights"):
        body.skinning_weights(x)
    with pytest.raises(ConfigError, match="regions"):
        build_body(
            quadrature_from_box(SIZE, point_count=500),
            BuildOptions(handles="qgmls"),
            regions=[Region(name="end", box=((-1.0, -1.0, -1.0), (-0.1, 1.0, 1.0)))],
            progress=False,
        )
