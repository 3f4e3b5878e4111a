"""Static responses: weights that know how a held body gives way, and harmonic weights of held regions.

Attachment modes of substructuring (Craig 1981), used as skinning weights: the displacement of linear elasticity under
a unit body force along each axis, with the known regions held; each of its three components serves as one scalar
weight. A few eigenmodes times affine motion cannot represent the anticlastic curvature of a bent beam, these can.

Where the body turns far, what counts next is the second derivative of the static equilibrium in the three forces
(modal derivatives: Idelsohn and Cardona 1985, doi:10.1016/0045-7949(85)90138-9; Barbic and James 2005,
doi:10.1145/1073204.1073300). Without them the axial shortening of a bent beam must come from eigenmodes, and the beam
is too stiff. Few of their eighteen components matter; those of most gradient energy are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from softmode.deformables.body.rkpm import ShapeFunctions
from softmode.deformables.reduction.galerkin import elastic_matrix, mass_and_gradient_matrix, mass_matrix
from softmode.errors import BasisError

Array = NDArray[np.float64]

MODE_SPARE, MODE_STEPS = 8, 5
"""Vectors beside the modes asked for, and steps of inverse iteration: they serve as weights, not as frequencies."""
MODE_LEAST = 1e-3
"""Components of modes under this fraction of the largest are dropped."""
NEGLIGIBLE = 1e-6
"""A response under this fraction of the largest is rounding, not physics, and is dropped."""


def lame_parameters(poissons_ratio: float) -> tuple[float, float]:
    """Return mu and lambda for E = 1."""
    nu = poissons_ratio
    return 1.0 / (2.0 * (1.0 + nu)), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def solve_static_responses(
    shape: ShapeFunctions,
    weights: Array,
    *,
    density: Array,
    poissons_ratio: float,
    stiffness_scale: Array,
    lame_ratio: Array | None = None,
    springs: Array | None = None,
    derivative_count: int = 0,
    mode_count: int = 0,
) -> Array:
    """Solve elasticity for unit body forces along the axes, to first and second order.

    Args:
        shape: Kernels at the quadrature points, (P, K); they vanish on exact regions.
        weights: Quadrature weights [m^3], shape (P,).
        density: Relative density, shape (P,); the forces are proportional to it.
        poissons_ratio: Poisson's ratio of the response.
        stiffness_scale: Relative shear modulus, shape (P,).
        lame_ratio: lambda / mu relative to the body's, shape (P,); None where it does not vary.
        springs: sum_r kappa / E V_r phi phi^T [m] of soft regions, shape (K, K).
        derivative_count: How many second-order weights to keep, 0..18.
        mode_count: Elastic modes of the kernels, whose components serve as weights too. They know the warping of a
            section that a bar needs to be twisted: products of smooth weights with quadratic motion do not.

    Returns:
        Coefficients of up to nine weights, three for each mode, then up to `derivative_count`, each of unit mean
        square, shape (K, .).

    Raises:
        BasisError: If nothing holds the body.
    """
    count = shape.centre_count
    stiff = weights * stiffness_scale
    mu, lame = lame_parameters(poissons_ratio)
    matrix = elastic_matrix(shape, stiff, mu, lame if lame_ratio is None else lame * lame_ratio)
    if springs is not None:
        for a in range(3):
            matrix[a * count : (a + 1) * count, a * count : (a + 1) * count] += springs
    solve = _factor(matrix)
    response = solve(np.kron(np.eye(3), (shape.value.T @ (weights * density))[:, None]))
    first = response.reshape(3, count, 3).transpose(2, 0, 1).reshape(9, count)
    mass = mass_matrix(shape, weights / weights.sum())
    size = np.sqrt(np.einsum("ik,kl,il->i", first, mass, first, optimize=True))
    parts = [first[size > NEGLIGIBLE * size.max()]]
    if mode_count:
        modes = _modes(solve, mass, mode_count).reshape(3, count, -1).transpose(2, 0, 1).reshape(-1, count)
        part = np.sqrt(np.einsum("ik,kl,il->i", modes, mass, modes, optimize=True))
        parts.append(modes[part > MODE_LEAST * part.max()])
    if derivative_count:
        energy = mass_and_gradient_matrix(shape, weights, stiff)[1]
        raw = response.T.reshape(3, 3, count)
        load = second_order_load(shape.gradient, stiff, raw, poissons_ratio, lame_ratio)[0]
        second = solve(load).reshape(3, count, -1).transpose(2, 0, 1).reshape(-1, count)
        # Without what the first order holds, in the gradient energy, and the rest by its share of that energy.
        flat = parts[0] / np.sqrt(np.einsum("ik,kl,il->i", parts[0], energy, parts[0], optimize=True))[:, None]
        for _ in range(2):
            second = second - (second @ energy @ flat.T) @ np.linalg.pinv(flat @ energy @ flat.T, hermitian=True) @ flat
        value, vector = np.linalg.eigh(second @ energy @ second.T)
        keep = np.argsort(-value, kind="stable")[:derivative_count]
        keep = keep[value[keep] > NEGLIGIBLE**2 * value.max()]
        found = vector[:, keep].T @ second
        parts.append(found * np.sign(found[np.arange(len(found)), np.abs(found).argmax(axis=1)])[:, None])
    found = np.concatenate(parts)
    return (found / np.sqrt(np.einsum("ik,kl,il->i", found, mass, found, optimize=True))[:, None]).T


def _modes(solve: Callable[[Array], Array], mass: Array, mode_count: int) -> Array:
    """Return about the first elastic modes, (3 K, mode_count), by inverse iteration in a block."""

    def weighed(vectors: Array) -> Array:
        return np.einsum("kl,alm->akm", mass, vectors.reshape(3, len(mass), -1), optimize=True).reshape(vectors.shape)

    found = np.random.default_rng(0).normal(size=(3 * len(mass), mode_count + MODE_SPARE))
    for _ in range(MODE_STEPS):
        found = np.linalg.qr(solve(weighed(found)))[0]
    load = weighed(found)
    turn = linalg.eigh(load.T @ solve(load), found.T @ load, check_finite=False)[1]
    return np.asarray(found @ turn[:, : -mode_count - 1 : -1])


def second_order_load(
    gradient: Sequence[sparse.csr_matrix | Array],
    stiff: Array,
    response: Array,
    poissons_ratio: float,
    lame_ratio: Array | None = None,
) -> tuple[Array, Array]:
    """Return the forces -d2f/dq_i dq_j of u = sum_i q_i u_i in St. Venant-Kirchhoff material, (3 K, 6), and sizes (3,).

    With H_i the gradient and e_i the strain of u_i, the second derivative of the stress is
    P_ij = C : sym(H_i^T H_j) + H_j C : e_i + H_i C : e_j.

    Args:
        gradient: Gradients of K functions at the quadrature points along each axis, three matrices (P, K).
        stiff: Volumes times relative shear modulus, shape (P,).
        response: Coefficients of u_i, (3, 3, K), divided here by the root mean squares of their gradients, the sizes.
        poissons_ratio: Poisson's ratio.
        lame_ratio: lambda / mu relative to that of this ratio, shape (P,); None where it does not vary.
    """
    mu, lame = lame_parameters(poissons_ratio)
    slopes, sizes = [], []
    for u in response:
        slope = np.stack([g @ u.T for g in gradient], axis=2)  # (P, component, axis)
        sizes.append(np.sqrt((stiff @ (slope**2).sum(axis=(1, 2))) / stiff.sum()))
        slopes.append(slope / sizes[-1])

    def stress(matrix: Array) -> Array:
        strain = 0.5 * (matrix + matrix.transpose(0, 2, 1))
        pressure = lame * np.trace(strain, axis1=1, axis2=2)
        pressure = pressure if lame_ratio is None else lame_ratio * pressure
        return pressure[:, None, None] * np.eye(3) + 2.0 * mu * strain

    stresses = []
    for i in range(3):
        for j in range(i, 3):
            h, k = slopes[i], slopes[j]
            stresses.append((stress(h.transpose(0, 2, 1) @ k) + k @ stress(h) + h @ stress(k)) * stiff[:, None, None])
    all_of_them = np.concatenate(stresses, axis=1)  # (P, pair and component, axis): each gradient is read once.
    loads = -np.sum([g.T @ np.ascontiguousarray(all_of_them[:, :, d]) for d, g in enumerate(gradient)], axis=0)
    return loads.T.reshape(len(stresses), -1).T, np.array(sizes)


def solve_harmonic_weights(
    shape: ShapeFunctions, weights: Array, *, stiffness_scale: Array, springs: Array, spring_load: Array
) -> Array:
    """Find the weights of soft regions: one on a region, zero on the others, of least gradient energy between.

    Args:
        shape: Kernels at the quadrature points, (P, K), vanishing on all exact regions.
        weights: Quadrature weights [m^3], shape (P,).
        stiffness_scale: Relative Young's modulus, shape (P,).
        springs: sum_r kappa / (lambda + 4 mu) V_r phi phi^T [m], shape (K, K).
        spring_load: Of each soft region its kappa / (lambda + 4 mu) V_r phi [m], shape (K, C).

    Returns:
        Coefficients in the kernels, shape (K, C).
    """
    energy = mass_and_gradient_matrix(shape, weights, weights * stiffness_scale)[1]
    return _factor(energy + springs)(spring_load)


def _factor(matrix: Array) -> Callable[[Array], Array]:
    """Factor a symmetric positive definite matrix, which is overwritten; kernels that vanish get zero."""
    diagonal = np.diag_indices(len(matrix))
    typical = float(matrix[diagonal].mean())
    matrix[diagonal] += np.where(matrix[diagonal] > 1e-13 * typical, 0.0, typical)
    for ridge in (0.0, 1e-12 * typical):  # The second for kernels that (numerically) repeat each other.
        matrix[diagonal] += ridge
        try:
            factor = linalg.cho_factor(matrix.T, lower=True, check_finite=False)
        except linalg.LinAlgError:
            continue
        return lambda load: linalg.cho_solve(factor, load, check_finite=False)
    raise BasisError("the static response has no solution", hint="Hold the body by a region.")
