"""Materials: identities at rest, derivatives by finite differences, objectivity, projection, precision, errors."""

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials import paths
from softmode.deformables.materials.hessian_kernels import HessianBlocks
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_cpu_kernels import LANES
from softmode.deformables.materials.material_kernels import (
    MaterialModel,
    MaterialParameters,
    has_rotation,
    needs_volume,
)
from softmode.errors import MaterialError
from tests import reference
from tests.deformables.probe_kernels import decompose, evaluate_materials, evaluate_materials_in_lanes
from tests.scenes import random_rotation

MODELS = list(MaterialModel)
ROTATION_FREE = [model for model in MODELS if has_rotation(int(model))]
"""Models that need the polar decomposition, whose rotation jumps where two singular values add up to 0."""
E = 1.0e5
NUS = (-0.5, 0.0, 0.3, 0.49)
FLOAT32 = float(np.finfo(np.float32).eps)
FLOAT64 = float(np.finfo(np.float64).eps)
DT = 0.01


WAYS = {"point": (evaluate_materials, 1), "lanes": (evaluate_materials_in_lanes, LANES)}
"""Kernels that evaluate a material, and the points of a thread."""
CHOSEN = {"way": "point"}
"""The one that :func:`evaluate` takes."""


@pytest.fixture(autouse=True, params=WAYS)
def way(request, monkeypatch):
    """Test the device code of a point, and that of eight points at a time, which CPU takes."""
    monkeypatch.setitem(CHOSEN, "way", request.param)


class Evaluation(NamedTuple):
    """What the device code gives at N gradients."""

    energy: np.ndarray
    """(N,) [J/m^3]."""
    stress: np.ndarray
    """(N, 3, 3) [Pa]."""
    derivative: np.ndarray
    """dP[dF], (N, 3, 3) [Pa]."""
    hessian: np.ndarray
    """(N, 3, 3, 3, 3) [Pa], float32."""


def evaluate(model, F, nu=0.3, *, F_start=None, viscosity=0.0, G=None, dF=None, project=True):
    """Evaluate the device code at F (N, 3, 3), or at G = F - I where F itself would round it away."""
    kernel, lanes = WAYS[CHOSEN["way"]]
    G = np.asarray(F, float).reshape(-1, 3, 3) - np.eye(3) if G is None else G
    start = G if F_start is None else np.asarray(F_start, float).reshape(-1, 3, 3) - np.eye(3)
    direction = np.zeros_like(G) if dF is None else np.broadcast_to(dF, G.shape)
    parameters = MaterialParameters()
    parameters.model = int(model)
    parameters.mu, parameters.lam = (wp.float64(value) for value in reference.lame(E, nu))
    parameters.viscosity = wp.float64(viscosity)
    with wp.ScopedDevice("cpu"):
        out = [wp.zeros(len(G), dtype=dtype) for dtype in (wp.float64, wp.mat33d, wp.mat33d, HessianBlocks)]
        gradients = [wp.array(values, dtype=wp.mat33d) for values in (G, start, direction)]
        inputs = [parameters, *gradients, wp.float64(DT)]
        wp.launch(kernel, dim=-(-len(G) // lanes), inputs=[*inputs, int(project)], outputs=out)
    energy, stress, derivative, blocks = (array.numpy() for array in out)
    return Evaluation(energy, stress, derivative, unpack(blocks))


def unpack(blocks):
    """Expand the six upper blocks (c, d) to H[c, a, d, b] = d2Psi / dF_ca dF_db."""
    H = np.zeros((len(blocks), 3, 3, 3, 3))
    for row, (c, d) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        block = blocks[:, 3 * row : 3 * row + 3]
        H[:, c, :, d, :] = block
        H[:, d, :, c, :] = np.swapaxes(block, 1, 2)
    return H


def moduli(model, nu):
    """Return mu and the lambda of Hooke's law."""
    return reference.hooke_moduli(model, *reference.lame(E, nu))


def stiffness(nu):
    """Return the largest modulus of Hooke's law, the unit of the tolerances below."""
    mu, lam = reference.lame(E, nu)
    return 2.0 * mu + 3.0 * abs(lam)


def lowest_determinant(model):
    """Return the least det F at which the tests look."""
    return 0.2 if needs_volume(int(model)) else -1.0


def random_gradients(count, low, high, seed=0):
    """Return deformation gradients whose determinant lies in [low, high] and no two singular values add up to 0."""
    rng = np.random.default_rng(seed)
    F = np.eye(3) + 0.6 * rng.normal(size=(20 * count, 3, 3))
    J = np.linalg.det(F)
    _, sigma, _ = np.linalg.svd(F)
    F = F[(low <= J) & (high >= J) & (sigma[:, 1] + np.sign(J) * sigma[:, 2] > 0.1)][:count]
    assert len(F) == count
    return F


def random_rotations(count, seed=0):
    """Return rotations (count, 3, 3)."""
    rng = np.random.default_rng(seed)
    return np.stack([random_rotation(rng) for _ in range(count)])


def difference(function, F, direction):
    """Return the derivative of a function of F in a direction, by central differences of fourth order."""
    h = 1.0e-3
    near = function(F + h * direction) - function(F - h * direction)
    far = function(F + 2 * h * direction) - function(F - 2 * h * direction)
    return (8 * near - far) / (12 * h)


# -- Hooke's law -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("model", MODELS)
def test_hooke_at_rest(model, nu):
    """At F = I: Psi = 0, P = 0 and d2Psi/dF2 = mu (dF + dF^T) + lambda tr(dF) I; in the twin to 1e-12."""
    at = evaluate(model, np.eye(3), nu)
    mu, lam = reference.lame(E, nu)
    unit = stiffness(nu)
    assert at.energy[0] == 0.0
    assert (at.stress == 0.0).all()
    expected = reference.hooke(*moduli(model, nu))
    np.testing.assert_allclose(at.hessian[0], expected, atol=FLOAT32 * unit)
    np.testing.assert_allclose(reference.hessian(model, np.eye(3), mu, lam), expected, atol=1e-12 * unit)
    np.testing.assert_allclose(reference.stress(model, np.eye(3), mu, lam), 0.0, atol=1e-12 * unit)


@pytest.mark.parametrize("strain", [1e-5, 1e-9, 1e-13])
@pytest.mark.parametrize("model", MODELS)
def test_small_strains(model, strain):
    """Psi and P of F = I + G equal mu |e|^2 + lambda/2 tr(e)^2 and its derivative, e = sym G, up to |G| relative.

    However small the strain: energy and stress are formed from G, and nothing of the size of mu cancels.
    """
    mu, lam = moduli(model, 0.3)
    G = strain * np.random.default_rng(3).normal(size=(20, 3, 3))
    e = 0.5 * (G + np.swapaxes(G, 1, 2))
    at = evaluate(model, None, G=G)
    trace = np.trace(e, axis1=1, axis2=2)
    expected = mu * (e**2).sum(axis=(1, 2)) + 0.5 * lam * trace**2
    relative = 20 * np.linalg.norm(G, axis=(1, 2)) + 64 * FLOAT64
    assert (np.abs(at.energy - expected) <= relative * expected).all()
    expected = 2 * mu * e + lam * trace[:, None, None] * np.eye(3)
    error = np.abs(at.stress - expected).max(axis=(1, 2))
    assert (error <= relative * np.linalg.norm(expected, axis=(1, 2))).all()


@pytest.mark.parametrize("model", MODELS)
def test_small_strains_of_a_turned_body(model):
    """Psi(R (I + G)) with |G| = 1e-8 equals Hooke's law to 1e-6: F rounds the strain by 1e-16, and no more is lost.

    The naive sums of terms of size mu would be wrong by 1e-16 mu where Psi is 1e-16 mu.
    """
    mu, lam = moduli(model, 0.3)
    G = 1e-8 * np.random.default_rng(3).normal(size=(50, 3, 3))
    F = random_rotations(50) @ (np.eye(3) + G)
    strain = reference.green_strain(F)
    e = 0.5 * (G + np.swapaxes(G, 1, 2))
    expected = mu * (e**2).sum(axis=(1, 2)) + 0.5 * lam * np.trace(strain, axis1=1, axis2=2) ** 2
    np.testing.assert_allclose(evaluate(model, F).energy, expected, rtol=1e-6)


# -- energy, stress, derivative ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("model", MODELS)
def test_matches_reference(model, nu):
    """Psi and P equal the dense formulas for det F in [-1, 3] (ln J: [0.2, 3])."""
    F = random_gradients(1000, lowest_determinant(model), 3.0)
    at = evaluate(model, F, nu)
    mu, lam = reference.lame(E, nu)
    size = (1.0 + np.linalg.norm(F, axis=(1, 2))) ** 6  # (J - 1)^2 is of sixth order
    assert (np.abs(at.energy - reference.energy(model, F, mu, lam)) <= 64 * FLOAT64 * stiffness(nu) * size).all()
    error = np.abs(at.stress - reference.stress(model, F, mu, lam)).max(axis=(1, 2))
    assert (error <= 64 * FLOAT64 * stiffness(nu) * size).all()


@pytest.mark.parametrize("viscosity", [0.0, 0.02], ids=["elastic", "viscous"])
@pytest.mark.parametrize("model", MODELS)
def test_stress_is_the_gradient(model, viscosity):
    """P : D = dPsi/dF[D] by finite differences to 1e-6, 1000 random F and D, with the dissipation potential."""
    F = random_gradients(1000, lowest_determinant(model), 3.0)
    start = np.roll(F, 1, axis=0)
    D = 0.1 * np.random.default_rng(1).normal(size=F.shape)
    at = evaluate(model, F, F_start=start, viscosity=viscosity)
    slope = difference(lambda F: evaluate(model, F, F_start=start, viscosity=viscosity).energy, F, D)
    size = np.linalg.norm(at.stress, axis=(1, 2)) * np.linalg.norm(D, axis=(1, 2)) + 1e-4 * np.abs(at.energy)
    assert (np.abs(slope - (at.stress * D).sum(axis=(1, 2))) <= 1e-6 * size).all()


@pytest.mark.parametrize("viscosity", [0.0, 0.02], ids=["elastic", "viscous"])
@pytest.mark.parametrize("model", MODELS)
def test_stress_derivative(model, viscosity):
    """dP[D] equals finite differences of P to 1e-6, 1000 random F and D, and so does the twin's Hessian."""
    F = random_gradients(1000, lowest_determinant(model), 3.0)
    start = np.roll(F, 1, axis=0)
    D = 0.1 * np.random.default_rng(1).normal(size=F.shape)
    at = evaluate(model, F, F_start=start, viscosity=viscosity, dF=D)
    slope = difference(lambda F: evaluate(model, F, F_start=start, viscosity=viscosity).stress, F, D)
    size = np.linalg.norm(at.derivative, axis=(1, 2)) + 1e-4 * np.linalg.norm(at.stress, axis=(1, 2))
    assert (np.linalg.norm(slope - at.derivative, axis=(1, 2)) <= 1e-6 * size).all()
    if viscosity == 0.0:
        exact = np.einsum("nijkl,nkl->nij", reference.hessian(model, F, *reference.lame(E, 0.3)), D)
        assert (np.linalg.norm(exact - at.derivative, axis=(1, 2)) <= 1e-10 * size).all()


@pytest.mark.parametrize("model", MODELS)
def test_objectivity(model):
    """Psi(Q F) = Psi(F) and P(Q F) = Q P(F), viscous part included, to 1e-12 relative to |F|^6."""
    F = random_gradients(1000, lowest_determinant(model), 3.0)
    start = np.roll(F, 1, axis=0)
    Q = random_rotations(1)[0]
    size = (1.0 + np.linalg.norm(F, axis=(1, 2)) + np.linalg.norm(start, axis=(1, 2))) ** 6
    for viscosity in (0.0, 0.02):
        at = evaluate(model, F, F_start=start, viscosity=viscosity)
        turned = evaluate(model, Q @ F, F_start=start, viscosity=viscosity)
        bound = 1e-12 * stiffness(0.3) * (1.0 + viscosity / DT) * size
        assert (np.abs(turned.energy - at.energy) <= bound).all()
        assert (np.abs(turned.stress - Q @ at.stress).max(axis=(1, 2)) <= bound).all()


# -- Hessian -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_does_not_resist_rotation(model, nu):
    """|H vec(W R)| <= 1e-6 mu for F = R and spins W of norm 1: a stress-free body turns freely, however stiff.

    At nu = 0.49 the rounding of lambda = 49 mu to float32 alone is larger.
    """
    R = random_rotations(200)
    hessian = evaluate(model, R, nu).hessian
    W = np.random.default_rng(1).normal(size=R.shape)
    W -= np.swapaxes(W, 1, 2)
    W /= np.linalg.norm(W, axis=(1, 2))[:, None, None]
    resisted = np.linalg.norm(np.einsum("nijkl,nkl->nij", hessian, W @ R), axis=(1, 2))
    mu = reference.lame(E, nu)[0]
    assert resisted.max() <= max(1e-6 * mu, FLOAT32 * stiffness(nu))


@pytest.mark.parametrize("low", [0.2, -1.0])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_is_the_projected_derivative(model, low):
    """The Hessian equals dP/dF with its negative eigenvalues set to 0 (9x9 eigenproblem, dense) up to float32."""
    F = random_gradients(1000, max(low, lowest_determinant(model)), 3.0)
    mu, lam = reference.lame(E, 0.3)
    exact = reference.hessian(model, F, mu, lam)
    hessian = evaluate(model, F).hessian.reshape(-1, 9, 9)
    expected = reference.projected(exact)
    negative = np.linalg.eigvalsh(exact.reshape(-1, 9, 9))[:, 0] < -1e-3 * mu
    assert 50 < negative.sum() < 950  # both cases occur
    size = np.linalg.norm(expected, axis=(1, 2))
    assert (np.linalg.norm(hessian - expected, axis=(1, 2)) / size).max() <= FLOAT32
    assert (np.linalg.eigvalsh(hessian)[:, 0] >= -FLOAT32 * size).all()


DEGENERATE = [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([2.0, 0.0, 0.0]), np.diag([1.0, 1.0, -1.0])]


@pytest.mark.parametrize("F", DEGENERATE, ids=["point", "flat", "line", "mirrored"])
@pytest.mark.parametrize("model", MODELS)
def test_degenerate_gradients(model, F):
    """Collapsed, flat and mirrored F: finite stress, finite semidefinite Hessian; infinite energy with ln J."""
    at = evaluate(model, F)
    assert np.isfinite(at.stress).all()
    assert np.isfinite(at.hessian).all()
    size = np.linalg.norm(at.hessian)
    assert np.linalg.eigvalsh(at.hessian.reshape(9, 9))[0] >= -4 * FLOAT32 * size
    if needs_volume(int(model)):
        assert at.energy[0] == np.inf
        return
    assert np.isfinite(at.energy).all()
    if model not in ROTATION_FREE:  # where two singular values add up to 0, the nearest rotation is one of many
        expected = reference.projected(reference.hessian(model, F, *reference.lame(E, 0.3)))
        assert np.linalg.norm(at.hessian.reshape(9, 9) - expected) <= 4 * FLOAT32 * stiffness(0.3)


def test_logarithm_of_a_negative_volume():
    """With ln J, det F <= 0 costs infinite energy; stress and Hessian stay those of J = 1e-9, finite."""
    F = random_gradients(200, -1.0, 0.0)
    at = evaluate(MaterialModel.NEO_HOOKEAN, F)
    assert (at.energy == np.inf).all()
    expected = reference.stress(MaterialModel.NEO_HOOKEAN, F, *reference.lame(E, 0.3))
    np.testing.assert_allclose(at.stress, expected, rtol=1e-9, atol=1e-6 * np.abs(expected).max())
    assert np.isfinite(at.hessian).all()


def test_origin_is_a_minimum_only_without_the_origin_term():
    """Psi(F = t I) at small t: falls away from t = 0 with the logarithm (dPsi/d(t^2) < 0), rises without it."""
    F = np.stack([np.zeros((3, 3)), 0.05 * np.eye(3)])
    with_log = evaluate(MaterialModel.STABLE_NEO_HOOKEAN_LOG, F).energy
    without = evaluate(MaterialModel.STABLE_NEO_HOOKEAN, F).energy
    assert without[1] > without[0]
    # m/2 [I_C - ln(I_C + 1)] = m/4 I_C^2 - ...: the quadratic term of the well is gone, the cubic -l a J pulls outward.
    assert with_log[1] < with_log[0]


@pytest.mark.parametrize("viscosity", [0.0, 0.02])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_without_projection(model, viscosity):
    """Not projected, H : dF is the derivative of the stress in the direction dF, with its viscous part."""
    F = random_gradients(200, max(lowest_determinant(model), 0.2), 3.0)
    dF = random_gradients(1, 0.2, 3.0)[0]
    at = evaluate(model, F, F_start=np.roll(F, 1, axis=0), viscosity=viscosity, dF=dF, project=False)
    product = np.einsum("ncadb,db->nca", at.hessian, dF)
    size = np.linalg.norm(at.hessian.reshape(-1, 81), axis=1) * np.linalg.norm(dF)
    assert (np.linalg.norm((product - at.derivative).reshape(-1, 9), axis=1) <= 4 * FLOAT32 * size).all()


# -- viscosity ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_viscous_hessian(model):
    """At E = E_n the viscous Hessian is tau / dt F (2 mu D + lambda tr(D) I), D = sym(F^T dF), exactly Gauss-Newton."""
    F = random_gradients(200, 0.2, 3.0)
    tau = 0.02
    whole = evaluate(model, F, viscosity=tau).hessian
    added = whole - evaluate(model, F).hessian
    expected = reference.viscous_hessian(F, *moduli(model, 0.3), tau, DT)
    # The difference of two float32 matrices carries the rounding of both.
    size = np.linalg.norm(whole.reshape(-1, 81), axis=1)
    assert (np.abs(added - expected).reshape(-1, 81).max(axis=1) <= FLOAT32 * size).all()


@pytest.mark.parametrize("nu", [-0.5, 0.3])
@pytest.mark.parametrize("model", MODELS)
def test_viscous_part_matches_reference(model, nu):
    """Viscous energy and stress equal tau / dt (mu |D|^2 + lambda/2 tr(D)^2), D = E - E_n, and its derivative."""
    F = random_gradients(200, 0.2, 3.0)
    start = np.roll(F, 1, axis=0)
    tau = 0.02
    elastic, whole = evaluate(model, F, nu), evaluate(model, F, nu, F_start=start, viscosity=tau)
    arguments = F, start, *moduli(model, nu), tau, DT
    size = (1.0 + np.linalg.norm(F, axis=(1, 2)) + np.linalg.norm(start, axis=(1, 2))) ** 6
    bound = 64 * FLOAT64 * stiffness(nu) * (1 + tau / DT) * size
    assert (np.abs(whole.energy - elastic.energy - reference.viscous_energy(*arguments)) <= bound).all()
    error = np.abs(whole.stress - elastic.stress - reference.viscous_stress(*arguments)).max(axis=(1, 2))
    assert (error <= bound).all()


@pytest.mark.parametrize("nu", [-0.5, 0.3])
@pytest.mark.parametrize("model", MODELS)
def test_viscous_power_is_never_negative(model, nu):
    """P_v : (F - F_n) >= 0 for small steps: viscosity takes energy from every deformation, none from a rotation."""
    rng = np.random.default_rng(4)
    start = random_gradients(100, 0.3, 3.0)
    F = start + 1e-4 * rng.normal(size=start.shape)
    tau = 0.02

    def viscous(F):
        return evaluate(model, F, nu, F_start=start, viscosity=tau).stress - evaluate(model, F, nu).stress

    assert ((viscous(F) * (F - start)).sum(axis=(1, 2)) > 0.0).all()
    size = (1.0 + np.linalg.norm(start, axis=(1, 2))) ** 5
    turned = np.abs(viscous(random_rotation(rng) @ start)).max(axis=(1, 2))
    assert (turned <= 64 * FLOAT64 * stiffness(nu) * size).all()


# -- singular values ---------------------------------------------------------------------------------------------------


def with_singular_values(*sigma):
    """Return 200 matrices with given singular values."""
    return random_rotations(200) @ np.diag(sigma) @ random_rotations(200, seed=1)


CASES = {
    "random": lambda: random_gradients(200, -3.0, 3.0),
    "rotation": lambda: random_rotations(200),
    "nearly a rotation": lambda: random_rotations(200) @ (np.eye(3) + 1e-8 * random_gradients(200, -3.0, 3.0)),
    "two equal": lambda: with_singular_values(2.0, 1.0, 1.0),
    "almost equal": lambda: with_singular_values(1.0 + 1e-9, 1.0, 1.0 - 1e-8),
    "mirrored": lambda: with_singular_values(1.0, 1.0, -1.0),
    "flat": lambda: with_singular_values(2.0, 1.0, 0.0),
    "line": lambda: with_singular_values(2.0, 0.0, 0.0),
    "point": lambda: np.zeros((200, 3, 3)),
    "far apart": lambda: with_singular_values(1e4, 1.0, 1e-4),
}


@pytest.mark.parametrize("case", CASES)
def test_singular_values(case):
    """F = U diag(sigma) V^T, U and V rotations; positive_part(F + F^T) is that of `eigh`; all to 1e-14."""
    F = CASES[case]()
    with wp.ScopedDevice("cpu"):
        out = [wp.zeros(len(F), dtype=dtype) for dtype in (wp.mat33d, wp.vec3d, wp.mat33d, wp.mat33d)]
        wp.launch(decompose, dim=len(F), inputs=[wp.array(F, dtype=wp.mat33d)], outputs=out)
    U, sigma, V, positive = (array.numpy() for array in out)
    size = max(np.abs(F).max(), 1.0)
    np.testing.assert_allclose(np.einsum("nij,nj,nkj->nik", U, sigma, V), F, atol=1e-14 * size)
    for rotation in (U, V):
        np.testing.assert_allclose(
            rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), F.shape), atol=1e-14
        )
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.abs(sigma), np.linalg.svd(F)[1], atol=1e-14 * size)
    value, vector = np.linalg.eigh(F + np.swapaxes(F, 1, 2))
    expected = np.einsum("nij,nj,nkj->nik", vector, np.maximum(value, 0.0), vector)
    np.testing.assert_allclose(positive, expected, atol=1e-14 * size)


# -- errors ------------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("path", paths.PATHS)
def test_a_model_that_a_path_lacks_does_not_start(path, monkeypatch):
    """A member that all code but one part compares with is refused, and the error names that part alone."""
    name = f"MADE_UP_{list(paths.PATHS).index(path)}"
    models: Any = IntEnum("MaterialModel", {**MaterialModel.__members__, name: len(MaterialModel)})
    monkeypatch.setattr(paths, "MaterialModel", models)
    for other, code in paths.PATHS.items():
        if other != path:
            monkeypatch.setitem(paths.PATHS, other, (*code, f"if (model == {name})"))
    with pytest.raises(MaterialError) as refused:
        Material(model=models[name])
    assert refused.value.message.endswith(f"is not known to {path}")


@pytest.mark.parametrize("model", [-1, len(MaterialModel), "ARAP"])
def test_what_is_no_model_is_refused(model):
    """A number or a name that no code knows: all of it is named."""
    with pytest.raises(MaterialError, match=", ".join(paths.PATHS)):
        Material(model=model)
