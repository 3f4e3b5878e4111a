"""Materials: identities at rest, derivatives by finite differences, objectivity, projection, typed errors."""

import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials import HessianBlocks, Material, MaterialModel, MaterialParameters
from softmode.errors import MaterialError
from tests import reference
from tests.deformables.probe_kernels import evaluate_materials
from tests.scenes import random_rotation

MODELS = list(MaterialModel)
E = 1.0e5
NUS = (-0.5, 0.0, 0.3, 0.49)
FLOAT32 = float(np.finfo(np.float32).eps)
FLOAT64 = float(np.finfo(np.float64).eps)
DT = 0.01
DIRECTION = 2.0e-3
"""Relative error allowed of the Hessian, a search direction: `wp.svd3` takes a fixed number of sweeps and leaves
off-diagonals up to 4e-4 of F (worst of 500 random F; the median is at float32 rounding)."""


def evaluate(model, F, nu=0.3, *, F_start=None, viscosity=0.0):
    """Return energy (N,), stress (N, 3, 3) and Hessian (N, 3, 3, 3, 3) of the device code at F (N, 3, 3)."""
    F = np.asarray(F, float).reshape(-1, 3, 3)
    start = F if F_start is None else np.asarray(F_start, float).reshape(-1, 3, 3)
    parameters = MaterialParameters()
    parameters.model = int(model)
    parameters.mu, parameters.lam = (wp.float64(value) for value in reference.lame(E, nu))
    parameters.viscosity = wp.float64(viscosity)
    with wp.ScopedDevice("cpu"):
        out = [wp.zeros(len(F), dtype=dtype) for dtype in (wp.float64, wp.mat33d, HessianBlocks)]
        gradients = [wp.array(values - np.eye(3), dtype=wp.mat33d) for values in (F, start)]
        wp.launch(evaluate_materials, dim=len(F), inputs=[parameters, *gradients, wp.float64(DT)], outputs=out)
    return out[0].numpy(), out[1].numpy(), unpack(out[2].numpy())


def unpack(blocks):
    """Expand the six upper blocks (c, d) to H[c, a, d, b] = d2Psi / dF_ca dF_db."""
    H = np.zeros((len(blocks), 3, 3, 3, 3))
    for row, (c, d) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        block = blocks[:, 3 * row : 3 * row + 3]
        H[:, c, :, d, :] = block
        H[:, d, :, c, :] = np.swapaxes(block, 1, 2)
    return H


def stiffness(nu):
    """Return the largest modulus of Hooke's law, the unit of the tolerances below."""
    mu, lam = reference.lame(E, nu)
    return 2.0 * mu + 3.0 * abs(lam)


def random_gradients(count, low, high, seed=0):
    """Return deformation gradients whose determinant lies in [low, high]."""
    rng = np.random.default_rng(seed)
    F = np.eye(3) + 0.6 * rng.normal(size=(20 * count, 3, 3))
    J = np.linalg.det(F)
    F = F[(low <= J) & (high >= J)][:count]
    assert len(F) == count
    return F


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("model", MODELS)
def test_hooke_at_rest(model, nu):
    """At F = I: Psi = 0, P = 0 and d2Psi/dF2 = mu (dF + dF^T) + lambda tr(dF) I."""
    energy, stress, hessian = evaluate(model, np.eye(3), nu)
    unit = stiffness(nu)
    assert abs(energy[0]) <= 8 * FLOAT64 * unit
    np.testing.assert_allclose(stress[0], 0.0, atol=8 * FLOAT64 * unit)
    # The Hessian is a float32 direction built from a few dozen products.
    np.testing.assert_allclose(hessian[0], reference.hooke(*reference.lame(E, nu)), atol=64 * FLOAT32 * unit)


@pytest.mark.parametrize("model", MODELS)
def test_small_strains(model):
    """Psi and P of F = I + 1e-5 A equal Hooke's law, mu |e|^2 + lambda/2 tr(e)^2 and its derivative, e = sym(F - I)."""
    mu, lam = reference.lame(E, 0.3)
    F = np.eye(3) + 1.0e-5 * np.random.default_rng(3).normal(size=(3, 3))
    G = F - np.eye(3)  # what survives the addition, exactly
    strain = 0.5 * (G + G.T)
    energy, stress, _ = evaluate(model, F)
    # Beyond Hooke's law come terms smaller by |G|; the sums s F + p cof F and Psi are of terms of size mu.
    size, rounding = np.linalg.norm(G), 8 * FLOAT64 * stiffness(0.3)
    expected = mu * (strain**2).sum() + 0.5 * lam * np.trace(G) ** 2
    assert abs(energy[0] - expected) <= 20 * size * expected + rounding
    expected = 2 * mu * strain + lam * np.trace(G) * np.eye(3)
    np.testing.assert_allclose(stress[0], expected, atol=20 * size * np.abs(expected).max() + rounding)


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("model", MODELS)
def test_matches_reference(model, nu):
    """Psi and P equal the dense formulas for det F in [-1, 3]."""
    F = random_gradients(500, -1.0, 3.0)
    energy, stress, _ = evaluate(model, F, nu)
    mu, lam = reference.lame(E, nu)
    size = (1.0 + np.linalg.norm(F, axis=(1, 2))) ** 6  # (J - 1)^2 is of sixth order
    assert (np.abs(energy - reference.energy(model, F, mu, lam)) <= 64 * FLOAT64 * stiffness(nu) * size).all()
    error = np.abs(stress - reference.stress(model, F, mu, lam)).max(axis=(1, 2))
    assert (error <= 64 * FLOAT64 * stiffness(nu) * size).all()


@pytest.mark.parametrize("viscosity", [0.0, 0.02], ids=["elastic", "viscous"])
@pytest.mark.parametrize("model", MODELS)
def test_stress_is_the_gradient(model, viscosity):
    """P_ij = (Psi(F + eps e_ij) - Psi(F - eps e_ij)) / (2 eps) for det F in [-1, 3], with the dissipation potential."""
    F = random_gradients(100, -1.0, 3.0)
    start = np.roll(F, 1, axis=0)
    _, stress, _ = evaluate(model, F, F_start=start, viscosity=viscosity)
    eps = 1.0e-5
    for i in range(3):
        for j in range(3):
            d = np.zeros((3, 3))
            d[i, j] = eps
            plus, minus = (evaluate(model, F + s * d, F_start=start, viscosity=viscosity)[0] for s in (1, -1))
            # Central differences: third derivatives times eps^2, and energies rounded and divided by eps.
            size = (1.0 + np.abs(plus) + stiffness(0.3)) * (1.0 + np.linalg.norm(F, axis=(1, 2)))
            error = np.abs((plus - minus) / (2 * eps) - stress[:, i, j])
            assert (error <= (10 * eps**2 + 8 * FLOAT64 / eps) * size).all()


@pytest.mark.parametrize("model", MODELS)
def test_hessian_is_the_projected_derivative(model):
    """The Hessian equals dP/dF with its negative eigenvalues set to 0 (eigenvalues of the 9x9 matrix, dense)."""
    F = random_gradients(500, -1.0, 3.0)
    mu, lam = reference.lame(E, 0.3)
    exact = reference.hessian(model, F, mu, lam)
    hessian = evaluate(model, F)[2].reshape(-1, 9, 9)
    expected = reference.projected(exact)
    negative = np.linalg.eigvalsh(exact.reshape(-1, 9, 9))[:, 0] < -1e-3 * mu
    assert 50 < negative.sum() < 450  # both cases occur
    size = np.linalg.norm(expected, axis=(1, 2))
    error = np.linalg.norm(hessian - expected, axis=(1, 2))
    assert (error / size).max() <= DIRECTION
    assert np.median(error / size) <= 32 * FLOAT32
    assert (np.linalg.eigvalsh(hessian)[:, 0] >= -64 * FLOAT32 * size).all()  # a sum of non-negative dyads


@pytest.mark.parametrize("model", MODELS)
def test_hessian_by_finite_differences(model):
    """Where nothing is projected, H[dF] = (P(F + eps dF) - P(F - eps dF)) / (2 eps), in random directions."""
    rng = np.random.default_rng(1)
    F = 1.1 * (np.eye(3) + 0.05 * rng.normal(size=(50, 3, 3)))  # in tension: no negative eigenvalue
    assert (np.linalg.eigvalsh(reference.hessian(model, F, *reference.lame(E, 0.3)).reshape(-1, 9, 9)) > 0).all()
    hessian = evaluate(model, F)[2]
    eps = 1.0e-6
    for _ in range(5):
        d = rng.normal(size=(3, 3))
        difference = (evaluate(model, F + eps * d)[1] - evaluate(model, F - eps * d)[1]) / (2 * eps)
        product = np.einsum("nijkl,kl->nij", hessian, d)
        np.testing.assert_allclose(product, difference, atol=DIRECTION * stiffness(0.3) * np.linalg.norm(d))


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 1.0, -1.0])], ids=str)
@pytest.mark.parametrize("model", MODELS)
def test_hessian_at_degenerate_gradients(model, F):
    """Collapsed, flattened and mirrored F, with repeated singular values, give a finite semidefinite Hessian."""
    hessian = evaluate(model, F)[2].reshape(9, 9)
    expected = reference.projected(reference.hessian(model, F, *reference.lame(E, 0.3)))
    assert np.isfinite(hessian).all()
    assert np.linalg.norm(hessian - expected) <= 64 * FLOAT32 * stiffness(0.3)


@pytest.mark.parametrize("model", MODELS)
def test_viscous_hessian(model):
    """At E = E_n the viscous Hessian is 2 mu tau / dt F sym(F^T dF), exactly Gauss-Newton."""
    F = random_gradients(200, 0.2, 3.0)
    tau = 0.02
    mu = reference.lame(E, 0.3)[0]
    added = evaluate(model, F, viscosity=tau)[2] - evaluate(model, F)[2]
    expected = reference.viscous_hessian(F, mu, tau, DT)
    # The difference of two float32 sums carries the rounding of the elastic part.
    size = np.linalg.norm(evaluate(model, F, viscosity=tau)[2].reshape(-1, 81), axis=1)
    assert (np.abs(added - expected).reshape(-1, 81).max(axis=1) <= 8 * FLOAT32 * size).all()


@pytest.mark.parametrize("model", MODELS)
def test_objectivity(model):
    """Psi(Q F) = Psi(F) and P(Q F) = Q P(F), viscous part included: rotations of space cost nothing."""
    rng = np.random.default_rng(2)
    F = random_gradients(100, -1.0, 3.0)
    start = np.roll(F, 1, axis=0)
    Q = random_rotation(rng)
    size = (1.0 + np.linalg.norm(F, axis=(1, 2)) + np.linalg.norm(start, axis=(1, 2))) ** 6
    for viscosity in (0.0, 0.02):
        energy, stress, _ = evaluate(model, F, F_start=start, viscosity=viscosity)
        turned, turned_stress, _ = evaluate(model, Q @ F, F_start=start, viscosity=viscosity)
        bound = 64 * FLOAT64 * stiffness(0.3) * (1.0 + viscosity / DT) * size
        assert (np.abs(turned - energy) <= bound).all()
        assert (np.abs(turned_stress - Q @ stress).max(axis=(1, 2)) <= bound).all()


@pytest.mark.parametrize("model", MODELS)
def test_viscous_power_is_never_negative(model):
    """P_v : (F - F_n) >= 0 for small steps: viscosity takes energy from every deformation, none from a rotation."""
    rng = np.random.default_rng(4)
    start = random_gradients(100, 0.3, 3.0)
    F = start + 1e-4 * rng.normal(size=start.shape)
    tau = 0.02
    viscous = evaluate(model, F, F_start=start, viscosity=tau)[1] - evaluate(model, F)[1]
    power = (viscous * (F - start)).sum(axis=(1, 2))
    assert (power > 0.0).all()
    turned = random_rotation(rng) @ start
    viscous = evaluate(model, turned, F_start=start, viscosity=tau)[1] - evaluate(model, turned)[1]
    size = (1.0 + np.linalg.norm(start, axis=(1, 2))) ** 5
    assert (np.abs(viscous).max(axis=(1, 2)) <= 64 * FLOAT64 * stiffness(0.3) * size).all()


def test_origin_is_a_minimum_only_without_the_origin_term():
    """Psi(F = t I) at small t: falls away from t = 0 with the logarithm (dPsi/d(t^2) < 0), rises without it."""
    F = np.stack([np.zeros((3, 3)), 0.05 * np.eye(3)])
    with_log = evaluate(MaterialModel.STABLE_NEO_HOOKEAN_LOG, F)[0]
    without = evaluate(MaterialModel.STABLE_NEO_HOOKEAN, F)[0]
    assert without[1] > without[0]
    # m/2 [I_C - ln(I_C + 1)] = m/4 I_C^2 - ...: the quadratic term of the well is gone, the cubic -l a J pulls outward.
    assert with_log[1] < with_log[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("youngs_modulus", 0.0),
        ("youngs_modulus", -1.0),
        ("youngs_modulus", float("nan")),
        ("youngs_modulus", float("inf")),
        ("poissons_ratio", 0.5),
        ("poissons_ratio", -1.0),
        ("poissons_ratio", float("nan")),
        ("density", 0.0),
        ("density", float("nan")),
        ("viscosity", -1e-9),
        ("viscosity", float("inf")),
        ("mass_damping", -1.0),
        ("friction", -0.1),
        ("friction", float("nan")),
    ],
)
def test_parameters_out_of_range(name, value):
    """E > 0, -1 < nu < 0.5, rho > 0, the rest >= 0: anything else raises an error that names the parameter."""
    with pytest.raises(MaterialError, match=name):
        Material(**{name: value})
