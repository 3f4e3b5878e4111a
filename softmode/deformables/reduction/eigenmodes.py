"""Skinning eigenmodes: the smoothest scalar weight functions an object admits.

The weights W_j are the lowest eigenfunctions of the weight-space Hessian (FreeForm eq. 15 and 35, after Benchekroun et
al. 2023),

    H v = omega M v,   H = sum_p V_p s_p grad phi~ grad phi~^T,   M = sum_p V_p phi~ phi~^T,

with s_p the relative stiffness (the factor lambda + 4 mu, divided by its reference value, so that omega is in 1/m^2
and does not depend on Young's modulus). For a homogeneous box omega = pi^2 (a^2/Lx^2 + b^2/Ly^2 + c^2/Lz^2) with
integers a, b, c.

On a held body the functions are boundary-aware: springs of a soft region add to H, and kernels that vanish on exact
regions leave no constant mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from softmode.deformables.body.rkpm import ShapeFunctions
from softmode.deformables.reduction.galerkin import mass_and_gradient_matrix
from softmode.errors import BasisError, ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Eigenmodes:
    """Skinning weights as combinations of the kernels; the constant handle is column 0."""

    coefficients: Array
    """Coefficients of W_j in the kernels, shape (K, mode_count + 1); column 0 is ones, so that W_0 = 1."""
    eigenvalues: Array
    """omega_j [1/m^2], ascending, shape (mode_count + 1,); the constant handle's is 0."""
    local_count: int = 0
    """How many of the last columns are local handles, whose eigenvalues are Rayleigh quotients in no order."""


def solve_eigenmodes(
    shape: ShapeFunctions,
    weights: Array,
    mode_count: int,
    *,
    stiffness_scale: Array | None = None,
    springs: Array | None = None,
    vanishing: bool = False,
) -> Eigenmodes:
    """Solve for the smoothest weight functions.

    LAPACK's subset solver is used: for 200-1000 kernels it beats Lanczos and LOBPCG.

    Args:
        shape: Kernels at the quadrature points, (P, K).
        weights: Quadrature weights [m^3], shape (P,).
        mode_count: Number of modes m beside the constant handle.
        stiffness_scale: Relative stiffness, shape (P,); ones when None.
        springs: What soft regions add to H, sum_r kappa / (lambda + 4 mu) V_r phi phi^T [m], shape (K, K).
        vanishing: Whether the kernels vanish on an exact region, so that they hold no constant.

    Returns:
        Modes with sum_p (V_p / V) W_i W_j = delta_ij for i, j > 0 (without springs and regions also with W_0); in each
        the entry of largest magnitude over the kernels is positive.

    Raises:
        ConfigError: If the kernels are too few for the modes asked for.
        BasisError: If the mass matrix is singular beyond repair.
    """
    kernel_count = shape.centre_count
    if not 1 <= mode_count < kernel_count:
        raise ConfigError(f"mode_count: expected 1..{kernel_count - 1} for {kernel_count} kernels, got {mode_count}")
    fraction = weights / weights.sum()
    stiff = fraction if stiffness_scale is None else fraction * stiffness_scale
    mass, energy = mass_and_gradient_matrix(shape, fraction, stiff)
    if springs is not None:
        energy += springs / weights.sum()
    free = springs is None and not vanishing
    values, modes = _lowest(energy, mass, mode_count + free)
    constant = np.ones(kernel_count)
    if free:
        # The lowest eigenvector is the constant up to rounding: replace it by the exact one and re-orthonormalise.
        values, modes = values[1:], modes[:, 1:]
        modes = modes - np.outer(constant, constant @ (mass @ modes))
        modes = modes @ np.linalg.inv(np.linalg.cholesky(modes.T @ (mass @ modes))).T
    modes *= np.sign(modes[np.abs(modes).argmax(axis=0), np.arange(mode_count)])
    coefficients = np.column_stack([constant, modes])
    return Eigenmodes(coefficients=coefficients, eigenvalues=np.concatenate([[0.0], np.maximum(values, 0.0)]))


def _lowest(energy: Array, mass: Array, count: int) -> tuple[Array, Array]:
    """Return the `count` lowest eigenpairs of energy v = omega mass v."""
    found, trace = {"subset_by_index": [0, count - 1], "check_finite": False}, np.trace(mass) / len(mass)
    try:
        return linalg.eigh(energy, mass, **found)
    except linalg.LinAlgError:
        # Kernels that (numerically) repeat each other, or vanish: a ridge far under the discretisation error restores
        # definiteness, and one on the energy keeps what has no mass at the upper end of the spectrum.
        ridge = 1e-12 * trace * np.eye(len(mass))
        try:
            return linalg.eigh(energy + ridge * (np.trace(energy) / trace), mass + ridge, **found)
        except linalg.LinAlgError as error:
            raise BasisError(
                f"the mass matrix of {len(mass)} kernels is singular", hint="Use fewer kernels or more points."
            ) from error
