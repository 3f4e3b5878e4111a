"""Skinning eigenmodes: the smoothest scalar weight functions an object admits.

The weights W_j are the lowest eigenfunctions of the weight-space Hessian (FreeForm eq. 15 and 35, after Benchekroun et
al. 2023),

    H v = omega M v,   H = sum_p V_p s_p grad phi~ grad phi~^T,   M = sum_p V_p phi~ phi~^T,

with s_p the relative stiffness (the factor lambda + 4 mu, divided by its reference value, so that omega is in 1/m^2
and does not depend on Young's modulus). For a homogeneous box omega = pi^2 (a^2/Lx^2 + b^2/Ly^2 + c^2/Lz^2) with
integers a, b, c.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from softmode.deformables.rkpm import ShapeFunctions
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Eigenmodes:
    """Skinning weights as combinations of the reproducing kernels; the constant handle is column 0."""

    coefficients: Array
    """Coefficients of W_j in the kernels, shape (K, mode_count + 1); column 0 is ones, so that W_0 = 1."""
    eigenvalues: Array
    """omega_j [1/m^2], ascending, shape (mode_count + 1,); the constant handle's is 0."""


def solve_eigenmodes(
    shape: ShapeFunctions, weights: Array, mode_count: int, *, stiffness_scale: Array | None = None
) -> Eigenmodes:
    """Solve for the smoothest non-constant weight functions.

    The matrices are formed with square roots of the weights, so both are exactly symmetric and positive semidefinite,
    and LAPACK's subset solver is used: for 200-1000 kernels it beats Lanczos and LOBPCG.

    Args:
        shape: Reproducing kernels at the quadrature points, (P, K).
        weights: Quadrature weights [m^3], shape (P,).
        mode_count: Number of non-constant modes m.
        stiffness_scale: Relative stiffness, shape (P,); ones when None.

    Returns:
        Modes with sum_p (V_p / V) W_i W_j = delta_ij; in each the entry of largest magnitude over the kernels is
        positive.

    Raises:
        ConfigError: If the kernels are too few for the modes asked for.
        BasisError: If the mass matrix is singular beyond repair.
    """
    kernel_count = int(shape.centre_count)
    if not 1 <= mode_count < kernel_count:
        raise ConfigError(f"mode_count: expected 1..{kernel_count - 1} for {kernel_count} kernels, got {mode_count}")
    root = np.sqrt(weights / weights.sum())
    mass = _gram(shape.value, root)
    stiff_root = root if stiffness_scale is None else root * np.sqrt(stiffness_scale)
    stiffness = np.sum([_gram(g, stiff_root) for g in shape.gradient], axis=0)
    constant = np.ones(kernel_count)
    try:
        values, vectors = linalg.eigh(stiffness, mass, subset_by_index=[0, mode_count], check_finite=False)
    except linalg.LinAlgError:
        # Kernels that (numerically) repeat each other: a ridge far under the discretisation error restores
        # definiteness.
        ridge = 1e-12 * np.trace(mass) / kernel_count * np.eye(kernel_count)
        try:
            values, vectors = linalg.eigh(stiffness, mass + ridge, subset_by_index=[0, mode_count], check_finite=False)
        except linalg.LinAlgError as error:
            raise BasisError(
                f"the mass matrix of {kernel_count} kernels is singular", hint="Use fewer kernels or more points."
            ) from error
    # The lowest eigenvector is the constant up to rounding: replace it by the exact one and re-orthonormalise the
    # others.
    modes = vectors[:, 1:]
    modes = modes - np.outer(constant, constant @ (mass @ modes))
    modes = modes @ np.linalg.inv(np.linalg.cholesky(modes.T @ (mass @ modes))).T
    modes *= np.sign(modes[np.abs(modes).argmax(axis=0), np.arange(mode_count)])
    coefficients = np.column_stack([constant, modes])
    return Eigenmodes(coefficients=coefficients, eigenvalues=np.concatenate([[0.0], np.maximum(values[1:], 0.0)]))


def _gram(matrix: object, root: Array) -> Array:
    """Return B^T B for B = diag(root) matrix, as a dense symmetric array."""
    scaled = matrix.multiply(root[:, None]).toarray(order="F")  # type: ignore[attr-defined]
    dsyrk: Any = linalg.get_blas_funcs("syrk", (scaled,))
    upper = dsyrk(1.0, scaled, trans=1)
    return np.triu(upper) + np.triu(upper, 1).T
