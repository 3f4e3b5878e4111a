"""Skinning eigenmodes: orthonormality, the constant handle, closed-form eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.deformables.body.rkpm import KernelName, make_basis
from softmode.deformables.reduction.eigenmodes import solve_eigenmodes
from softmode.errors import ConfigError

SIZE = np.array([0.06, 0.05, 0.04])


def box(count: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """Return cell centres and equal weights of a uniform grid in the box."""
    axes = [(np.arange(count) + 0.5) / count * length for length in SIZE]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, np.full(len(points), SIZE.prod() / len(points))


def exact_eigenvalues(count: int) -> np.ndarray:
    """Return the smallest positive pi^2 sum (a_d / L_d)^2 over integers a."""
    integers = np.stack(np.meshgrid(*[range(12)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.sort(np.pi**2 * (integers**2 / SIZE**2).sum(axis=1))[1 : count + 1]


@pytest.mark.parametrize(
    ("kernel", "kernel_count", "bound"), [("cubic", 200, 0.015), ("cubic", 400, 0.006), ("gaussian", 400, 0.006)]
)
def test_box_eigenvalues(kernel: KernelName, kernel_count: int, bound: float) -> None:
    """Omega = pi^2 (a^2/Lx^2 + b^2/Ly^2 + c^2/Lz^2); the error falls with the number of kernels."""
    points, weights = box()
    modes = solve_eigenmodes(make_basis(points, kernel_count, kernel=kernel).evaluate(points), weights, 16)
    assert modes.eigenvalues[0] == 0.0
    np.testing.assert_allclose(modes.eigenvalues[1:], exact_eigenvalues(16), rtol=bound)
    assert (modes.eigenvalues[1:] > exact_eigenvalues(16) * (1.0 - 2e-3)).all(), "Galerkin eigenvalues lie above"


def test_orthonormal_with_exact_constant_and_fixed_sign() -> None:
    """Sum V_p/V W_i W_j = delta_ij, W_0 = 1, the largest coefficient of every other mode is positive."""
    points, weights = box(10)
    shape = make_basis(points, 200).evaluate(points)
    modes = solve_eigenmodes(shape, weights, 12)
    w = shape.value @ modes.coefficients
    gram = (w * (weights / weights.sum())[:, None]).T @ w
    assert np.abs(gram - np.eye(13)).max() < 1e-12
    assert np.abs(w[:, 0] - 1.0).max() < 1e-12
    other = modes.coefficients[:, 1:]
    assert (other[np.abs(other).argmax(axis=0), range(12)] > 0.0).all()


def test_gradient_energy_is_the_eigenvalue() -> None:
    """Sum V_p/V |grad W_j|^2 = omega_j."""
    points, weights = box(10)
    shape = make_basis(points, 200).evaluate(points)
    modes = solve_eigenmodes(shape, weights, 8)
    energy = np.sum([(weights / weights.sum()) @ (g @ modes.coefficients) ** 2 for g in shape.gradient], axis=0)
    np.testing.assert_allclose(energy[1:], modes.eigenvalues[1:], rtol=1e-9)


def test_stiff_half_deforms_less() -> None:
    """With one half a thousand times stiffer, the first mode is nearly constant there."""
    points, weights = box(10)
    shape = make_basis(points, 200).evaluate(points)
    stiff = np.where(points[:, 0] > 0.03, 1000.0, 1.0)
    modes = solve_eigenmodes(shape, weights, 1, stiffness_scale=stiff)
    w = (shape.value @ modes.coefficients)[:, 1]
    assert np.ptp(w[points[:, 0] > 0.04]) < 0.05 * np.ptp(w)


def test_size_does_not_matter() -> None:
    """Eigenvalues scale with 1/L^2, from a 60 mm box to a 61 m one."""
    points, weights = box(8)
    small = solve_eigenmodes(make_basis(points, 150).evaluate(points), weights, 6)
    points *= 1024.0  # A power of two: farthest points break ties alike.
    large = solve_eigenmodes(make_basis(points, 150).evaluate(points), 1024.0**3 * weights, 6)
    np.testing.assert_allclose(large.eigenvalues[1:], small.eigenvalues[1:] / 1024.0**2, rtol=1e-9)


def test_mode_count_is_checked() -> None:
    """More modes than kernels, or none, raise ConfigError."""
    points, weights = box(6)
    shape = make_basis(points, 20).evaluate(points)
    for count in (0, 20):
        with pytest.raises(ConfigError, match="mode_count"):
            solve_eigenmodes(shape, weights, count)
